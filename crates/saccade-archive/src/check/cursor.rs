//! How far the records of a volume were read.

use std::path::Path;

use super::records::AT_ONCE;
use super::{Check, CheckError, FindingKind, Repair};
use crate::acquisition::{AcquisitionError, AcquisitionInfo, Cursor, Record, RecordReader};
use crate::catalog::{CatalogError, VolumeEntry};

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
                let Some(misread) = self.misread(entry, read) else {
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
    fn misread(&self, entry: &VolumeEntry, read: Cursor) -> Option<String> {
        let folder = self.folder_of(entry).filter(|_| read.offset > 0)?;
        // Of several volumes, an acquisition is one's.
        let is_its =
            || AcquisitionInfo::read(&folder).is_ok_and(|info| info.name == entry.volume.name);
        let is_there = folder.join(RecordReader::FILE).is_file();
        if !is_there || !(self.known.len() == 1 || is_its()) {
            return None;
        }
        let mut reader = RecordReader::new(&folder, read);
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

    /// Whether the records at hand are those of which the newest tiles of a volume were taken in.
    async fn are_its_own(&self, entry: &VolumeEntry) -> Result<bool, CheckError> {
        let Some(folder) = self.folder_of(entry) else {
            return Ok(false);
        };
        let catalog = self.archive.catalog();
        let newest = catalog.newest_records(&entry.volume.name, KNOWN_BY).await?;
        let is_of = |(tile, at): &(String, u64)| matches!(record_at(&folder, *at), Some(Record::Tile(record)) if record.tile == *tile);
        Ok(newest.iter().all(is_of))
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
