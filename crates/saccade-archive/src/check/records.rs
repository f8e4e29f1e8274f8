//! What the catalog says against what the records say.

use std::collections::HashMap;
use std::hash::BuildHasher as _;
use std::path::Path;

use glam::UVec2;

use super::repair::position_of;
use super::{Check, CheckError, Finding, FindingKind, Repair};
use crate::acquisition::{AcquisitionInfo, Cursor, Record, RecordReader};
use crate::catalog::{Tile, VolumeEntry};
use crate::randomness::Keyed;

/// Records that are read at once.
pub(super) const AT_ONCE: usize = 4096;

/// What the records that were read say of each tile, by hashes of names: some 60 bytes of memory per tile.
#[derive(Debug)]
pub(super) struct Records {
    newest: HashMap<u64, Newest>,
    hasher: Keyed,
}

/// The newest record of a tile's image, or of its end.
#[derive(Debug)]
struct Newest {
    position: u64,
    /// `None`: it was deleted.
    image: Option<Image>,
    /// Whether the catalog has the tile.
    met: bool,
}

/// What a record says of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Image {
    section: u32,
    size: UVec2,
    /// `None`: the volume has no such channel.
    channel: Option<u32>,
}

impl Records {
    /// Those up to `read`, if they are what was read.
    fn read(folder: &Path, read: Cursor, channels: &[String], hasher: Keyed) -> Option<Self> {
        RecordReader::new(folder, read).recognize().ok()?;
        let mut records = Self {
            newest: HashMap::new(),
            hasher,
        };
        let mut reader = RecordReader::new(folder, Cursor::default());
        while reader.cursor().offset < read.offset {
            let lines = reader.read(AT_ONCE).ok()?;
            if lines.is_empty() {
                break;
            }
            for line in lines.into_iter().filter(|line| line.offset < read.offset) {
                let (tile, image) = match line.record {
                    Ok(Record::Tile(record)) => {
                        let image = Image {
                            section: record.section,
                            size: record.size,
                            channel: record.channel_among(channels),
                        };
                        (record.tile, Some(image))
                    }
                    Ok(Record::Delete(record)) => (record.tile, None),
                    Ok(Record::Transform(_)) | Err(_) => continue,
                };
                let newest = Newest {
                    position: line.offset,
                    image,
                    met: false,
                };
                records
                    .newest
                    .insert(records.hasher.hash_one(&tile), newest);
            }
        }
        Some(records)
    }

    /// Whether the newest of a tile's records is its end.
    pub(super) fn is_deleted(&self, tile: &str) -> bool {
        let newest = self.newest.get(&self.hasher.hash_one(tile));
        newest.is_some_and(|newest| newest.image.is_none())
    }

    /// The catalog has a tile.
    pub(super) fn meet(&mut self, tile: &str) {
        let hash = self.hasher.hash_one(tile);
        if let Some(newest) = self.newest.get_mut(&hash) {
            newest.met = true;
        }
    }

    /// What of a tile is not as its record says, if the catalog has the tile of its newest.
    fn contradict(&self, tile: &Tile) -> Option<String> {
        let newest = self.newest.get(&self.hasher.hash_one(&tile.name))?;
        if position_of(&tile.pyramid) != Some(newest.position) {
            return None;
        }
        let image = newest.image?;
        let has = Image {
            section: tile.section,
            size: tile.size,
            channel: Some(tile.channel),
        };
        let shape = |of: Image| {
            let channel = of
                .channel
                .map_or_else(|| "none".to_owned(), |c| c.to_string());
            format!(
                "section {}, {} x {} pixels, channel {channel}",
                of.section, of.size.x, of.size.y
            )
        };
        let differs = image != has;
        differs.then(|| {
            format!(
                "the catalog says {} of it, its record {}",
                shape(has),
                shape(image)
            )
        })
    }
}

impl Check<'_> {
    /// What the records say, if they are at hand; and whether the volume is as they say.
    pub(super) async fn read_records(&mut self, entry: &VolumeEntry) -> Result<(), CheckError> {
        self.records = None;
        let Some((folder, read)) = self.folder_of(entry).zip(self.read) else {
            return Ok(());
        };
        let (channels, of) = (entry.volume.channels.clone(), folder.clone());
        let hasher = Keyed::new(self.archive.randomness());
        let work = move || Records::read(&of, read, &channels, hasher);
        self.records = tokio::task::spawn_blocking(work).await.unwrap_or_default();
        let info = AcquisitionInfo::read(&folder).ok();
        let Some(volume) = info.and_then(|info| info.volume().ok()) else {
            return Ok(());
        };
        let (has, said) = (entry.volume.extent(), volume.extent());
        if self.records.is_some() && has != said {
            let reason = format!(
                "the catalog says that the volume has {has} voxels, its acquisition {said}: put a copy of the catalog in its \
                 place, from which `saccade ingest` goes on"
            );
            self.find(FindingKind::Spoilt, entry, None, reason);
        }
        Ok(())
    }

    /// What the catalog says of a tile that cannot be so, or not if its record is right.
    pub(super) fn contradicted(&mut self, entry: &VolumeEntry, tile: &Tile) -> Option<String> {
        let channels = entry.volume.channels.len();
        let said = self.records.as_mut().and_then(|records| {
            records.meet(&tile.name);
            records.contradict(tile)
        });
        said.or_else(|| {
            let is_one = usize::try_from(tile.channel).is_ok_and(|channel| channel < channels);
            (!is_one).then(|| {
                format!(
                    "the catalog says channel {} of it, of a volume with {channels}",
                    tile.channel
                )
            })
        })
    }

    /// Finds tiles whose records were read and of which the catalog knows nothing.
    pub(super) async fn lost(&mut self, entry: &VolumeEntry) -> Result<(), CheckError> {
        let Some(records) = self.records.take() else {
            return Ok(());
        };
        self.compared.insert(entry.volume.name.clone());
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let lost =
            { records.newest.values() }.filter(|newest| !newest.met && newest.image.is_some());
        let mut lost: Vec<u64> = lost.map(|newest| newest.position).collect();
        drop(records);
        lost.sort_unstable();
        for position in lost {
            let Some((_, Record::Tile(record))) = self.record_at(entry, position) else {
                continue;
            };
            if catalog.knows(volume, &record.tile).await? {
                continue;
            }
            self.kept.insert((volume.clone(), position));
            let mut reason = "its record was read, and the catalog knows nothing of it".to_owned();
            let (tile, mut repair) = (record.tile, None);
            match self.tile_record(entry, Some(&tile), position) {
                Some(record) if self.options.repair => {
                    let why = format!("the catalog had lost it: {reason}");
                    self.queue(entry, position, record, why).await?;
                    repair = Some(Repair::Queued);
                }
                Some(_) => {}
                None => reason.push_str(
                    ", and its image is not there any more: put it back, or append a record that it is deleted",
                ),
            }
            self.report.findings.push(Finding {
                kind: FindingKind::Lost,
                volume: Some(volume.clone()),
                tile: Some(tile),
                object: None,
                reason,
                repair,
            });
        }
        Ok(())
    }

    /// Finds what waits for ingest and cannot be understood.
    pub(super) async fn spoilt_waiting(&mut self, entry: &VolumeEntry) -> Result<(), CheckError> {
        let catalog = self.archive.catalog();
        for (position, tile, wrong) in catalog.spoilt_waiting(&entry.volume.name).await? {
            let mut reason = format!("what waits for ingest of it cannot be understood ({wrong})");
            let mut repair = None;
            let at = u64::try_from(position).ok();
            let record = at.and_then(|at| Some((at, self.tile_record(entry, Some(&tile), at)?)));
            match record {
                Some((position, record)) if self.options.repair => {
                    let why = "what waited of it could not be understood".to_owned();
                    self.queue(entry, position, record, why).await?;
                    repair = Some(Repair::Queued);
                }
                Some(_) => {}
                None => {
                    reason.push_str("; `saccade ingest` sets it aside: append its record once more")
                }
            }
            self.report.findings.push(Finding {
                kind: FindingKind::Spoilt,
                volume: Some(entry.volume.name.clone()),
                tile: Some(tile),
                object: None,
                reason,
                repair,
            });
        }
        Ok(())
    }
}
