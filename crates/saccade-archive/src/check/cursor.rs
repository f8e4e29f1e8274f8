//! How far the records of a volume were read.

use std::collections::HashSet;
use std::path::Path;

use super::records::AT_ONCE;
use super::{Check, CheckError, FindingKind, Repair};
use crate::acquisition::{AcquisitionError, AcquisitionInfo, Cursor, Record, RecordReader};
use crate::catalog::{CatalogError, Listed, VolumeEntry};

/// Newest tiles of a volume whose records are looked for among those that may be its own.
const KNOWN_BY: u32 = 8;

impl Check<'_> {
    /// How far the records of a volume were read. Where that cannot be understood, or cannot be so, it is found out if it is to
    /// be repaired.
    pub(super) async fn read_up_to(&mut self, entry: &VolumeEntry) -> Result<(), CheckError> {
        let catalog = self.archive.catalog();
        let mut reason = match catalog.cursor(&entry.volume.name).await {
            Ok(read) => {
                self.read = Some(read);
                let Some(misread) = self.misread(entry, read).await? else {
                    return Ok(());
                };
                let more = match self.are_its_own(entry).await? {
                    true => {
                        ": `saccade check --repair --acquisition FOLDER` finds out how far they were"
                    }
                    false => {
                        ", and they are not those that the catalog's tiles were taken in from: name the folder of those with \
                         --acquisition"
                    }
                };
                misread + more
            }
            Err(error @ CatalogError::SpoiltCursor { .. }) => error.without_place(),
            Err(error) => return Err(error.into()),
        };
        self.read = None;
        let mut repair = None;
        if self.options.repair
            && self.are_its_own(entry).await?
            && let Some(found) = self.find_cursor(entry).await?
        {
            let mut commit = catalog.begin(&entry.volume.name).await?;
            commit.cursor(found).await?;
            commit.finish().await?;
            self.read = Some(found);
            repair = Some(Repair::Reread);
        } else {
            self.unread.insert(entry.volume.name.clone());
            reason.push_str("; nothing is compared with records, and no pyramid deleted of which nothing is known");
        }
        self.find(FindingKind::Spoilt, entry, None, reason).repair = repair;
        Ok(())
    }

    /// Why a volume's records were not read up to where the catalog says, if they are at hand.
    async fn misread(
        &self,
        entry: &VolumeEntry,
        read: Cursor,
    ) -> Result<Option<String>, CheckError> {
        let folder = self.folder_of(entry);
        let Some(folder) = folder.filter(|folder| folder.join(RecordReader::FILE).is_file()) else {
            return Ok(None);
        };
        if read.offset > 0 {
            return Ok(misread_in(&folder, read));
        }
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let last = catalog.last_position(volume).await?;
        // Another may have begun meanwhile.
        let still = catalog.cursor(volume).await?.offset == 0;
        Ok(last.filter(|_| still).map(|last| {
            format!("the catalog says that none of its records was read, but has what the one at byte {last} says")
        }))
    }

    /// Finds out of which of several volumes the acquisition at hand is: that whose newest tiles are of its records, whatever
    /// name it was taken in under; if none is, that of its name.
    pub(super) async fn find_owner(&mut self, volumes: &[Listed]) -> Result<(), CheckError> {
        let Some(folder) = self
            .options
            .acquisition
            .clone()
            .filter(|_| volumes.len() > 1)
        else {
            return Ok(());
        };
        let mut owners = HashSet::new();
        for Listed { name, entry } in volumes {
            let is_its = match entry {
                Ok(_) => self.is_most(&folder, name).await?,
                Err(_) => Some(false),
            };
            // One that lost all of its tiles may know what was read.
            let is_known = async || match self.archive.catalog().cursor(name).await {
                Ok(read) if read.offset > 0 && read.seen.is_some() => {
                    RecordReader::new(&folder, read).recognize().is_ok()
                }
                _ => false,
            };
            let is_its = match is_its {
                Some(is_its) => is_its,
                None => is_known().await,
            };
            if is_its {
                owners.insert(name.clone());
            }
        }
        if owners.is_empty() {
            let info = AcquisitionInfo::read(&folder).ok();
            owners.extend(info.map(|info| info.name));
        }
        let others = volumes.iter().filter(|of| !owners.contains(&of.name));
        self.of_others = others.map(|of| of.name.clone()).collect();
        Ok(())
    }

    /// Whether most of the newest tiles of a volume are of these records; `None` if it has none.
    async fn is_most(&self, folder: &Path, volume: &str) -> Result<Option<bool>, CheckError> {
        let newest = self.archive.catalog().newest_records(volume, KNOWN_BY);
        let newest = newest.await?;
        let is_of = |(tile, at): &&(String, u64)| matches!(record_at(folder, *at), Some(Record::Tile(record)) if record.tile == *tile);
        let own = newest.iter().filter(is_of).count();
        Ok((!newest.is_empty()).then_some(own * 2 > newest.len()))
    }

    /// Whether the records at hand are those of which the newest tiles of a volume were taken in.
    async fn are_its_own(&self, entry: &VolumeEntry) -> Result<bool, CheckError> {
        match self.folder_of(entry) {
            Some(folder) => Ok(self.is_most(&folder, &entry.volume.name).await? != Some(false)),
            None => Ok(false),
        }
    }

    /// The end of the last record of which the catalog has anything. What of those after it was read already says nothing
    /// new when it is read once more.
    async fn find_cursor(&self, entry: &VolumeEntry) -> Result<Option<Cursor>, CheckError> {
        let Some(folder) = self.folder_of(entry) else {
            return Ok(None);
        };
        let last = self
            .archive
            .catalog()
            .last_position(&entry.volume.name)
            .await?;
        let Some(last) = last else {
            return Ok(Some(Cursor::default()));
        };
        let mut reader = RecordReader::new(&folder, Cursor::default());
        loop {
            let Ok(lines) = reader.read(AT_ONCE) else {
                return Ok(None);
            };
            // Records that end before are another acquisition's.
            if lines.is_empty() {
                return Ok(None);
            }
            let behind = lines.into_iter().map(|line| line.next);
            if let Some(next) = behind.filter(|next| next.offset > last).min() {
                return Ok(Some(next));
            }
        }
    }
}

/// Why records were not read up to a place in them, as far as can be told.
fn misread_in(folder: &Path, read: Cursor) -> Option<String> {
    let mut reader = RecordReader::new(folder, read);
    let at = format!(
        "the catalog says that its records were read up to byte {}",
        read.offset
    );
    match reader.recognize() {
        Err(AcquisitionError::RecordsCut { len, .. }) => {
            Some(format!("{at}, but they have {len} bytes"))
        }
        Err(AcquisitionError::RecordsReplaced { .. }) => Some(format!(
            "{at}, but what lies before that is not what was read"
        )),
        Err(_) => None,
        Ok(_) => match reader.is_between_lines() {
            Ok(false) => Some(format!("{at}, but that is in the midst of a line")),
            // What cannot be read says nothing.
            Ok(true) | Err(_) => None,
        },
    }
}

/// The record that begins at a position.
pub(super) fn record_at(folder: &Path, at: u64) -> Option<Record> {
    let cursor = Cursor {
        offset: at,
        ..Cursor::default()
    };
    let mut reader = RecordReader::new(folder, cursor);
    let line = reader.read(1).ok()?.into_iter().next()?;
    line.record.ok().filter(|_| line.offset == at)
}
