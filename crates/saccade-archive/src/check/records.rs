//! What the catalog says against what the records say.

use std::collections::HashMap;
use std::hash::BuildHasher as _;
use std::path::Path;

use glam::UVec2;
use saccade_core::transform::SectionFromTile;
use saccade_core::volume::Volume;

use super::repair::{Source, position_of};
use super::{Check, CheckError, Finding, FindingKind, Repair};
use crate::acquisition::{Cursor, DeleteRecord, Record, RecordReader, TileRecord, TransformRecord};
use crate::catalog::{Tile, VolumeEntry, place};
use crate::randomness::Keyed;

/// Records that are read at once.
pub(super) const AT_ONCE: usize = 4096;

/// What the records that were read say of each tile, by hashes of names: some 120 bytes of memory per tile.
#[derive(Debug)]
pub(super) struct Records {
    newest: HashMap<u64, Newest>,
    hasher: Keyed,
}

/// What says where a tile lies.
#[derive(Clone, Copy, Debug)]
pub(super) struct Said {
    /// Position of the record.
    pub(super) record: u64,
    /// From which position on the catalog follows it: one that came before its tile counts from there.
    pub(super) position: u64,
    /// Hash of the transform.
    hash: u64,
}

/// The newest record of a tile's image, or of its end.
#[derive(Debug)]
struct Newest {
    position: u64,
    /// `None`: it was deleted.
    image: Option<Image>,
    /// Where the tile lies, if it is inside of the volume there.
    said: Option<Said>,
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

impl Image {
    fn of(tile: &Tile) -> Self {
        Self {
            section: tile.section,
            size: tile.size,
            channel: Some(tile.channel),
        }
    }
}

impl Records {
    /// Those of a volume up to `read`, if they are what was read.
    fn read(folder: &Path, read: Cursor, volume: &Volume, hasher: Keyed) -> Option<Self> {
        RecordReader::new(folder, read).recognize().ok()?;
        let mut records = Self {
            newest: HashMap::new(),
            hasher,
        };
        // Transforms whose tile comes later.
        let mut early = HashMap::new();
        let mut reader = RecordReader::new(folder, Cursor::default());
        while reader.cursor().offset < read.offset {
            let lines = reader.read(AT_ONCE).ok()?;
            if lines.is_empty() {
                break;
            }
            for line in lines.into_iter().filter(|line| line.offset < read.offset) {
                if let Ok(record) = line.record {
                    records.note(line.offset, &record, volume, &mut early);
                }
            }
        }
        Some(records)
    }

    /// Notes what the record at a position says, after those before it.
    fn note(
        &mut self,
        position: u64,
        record: &Record,
        volume: &Volume,
        early: &mut HashMap<u64, (u64, SectionFromTile)>,
    ) {
        let extent = volume.extent();
        let name = match record {
            Record::Tile(TileRecord { tile, .. })
            | Record::Transform(TransformRecord { tile, .. })
            | Record::Delete(DeleteRecord { tile }) => self.hasher.hash_one(tile),
        };
        let known = self.newest.get_mut(&name);
        let inside = |image: Image, at| place(extent, image.section, image.size, at).is_some();
        let (image, said) = match record {
            Record::Tile(record) => {
                let image = Image {
                    section: record.section,
                    size: record.size,
                    channel: record.channel_among(&volume.channels),
                };
                let is_new = known.is_none_or(|known| known.image.is_none());
                let before = early.remove(&name).filter(|_| is_new);
                let own = (position, record.transform);
                let said = before.into_iter().chain([own]);
                let said = { said }.find(|(_, at)| inside(image, *at));
                (Some(image), said)
            }
            // Ingest has set it aside.
            Record::Transform(record) if !Record::is_sensible(record.transform) => return,
            Record::Transform(record) => {
                let at = (position, record.transform);
                match known.and_then(|known| Some((known.image?, &mut known.said))) {
                    Some((image, said)) if inside(image, at.1) => {
                        *said = Some(Said {
                            record: position,
                            position,
                            hash: self.hasher.hash_one(bits(at.1)),
                        });
                    }
                    Some(_) => {}
                    None => drop(early.insert(name, at)),
                }
                return;
            }
            Record::Delete(_) => {
                early.remove(&name);
                (None, None)
            }
        };
        let said = said.map(|(record, at)| Said {
            record,
            position,
            hash: self.hasher.hash_one(bits(at)),
        });
        let newest = Newest {
            position,
            image,
            said,
            met: false,
        };
        self.newest.insert(name, newest);
    }

    /// What the newest record of a tile's place says, if the catalog has the tile of its newest image and it does not lie there.
    pub(super) fn elsewhere(&self, tile: &Tile) -> Option<Said> {
        let newest = self.newest.get(&self.hasher.hash_one(&tile.name))?;
        let of = [position_of(&tile.pyramid), Some(tile.position)];
        let is_newest = of.contains(&Some(newest.position));
        let said = newest.said.filter(|_| is_newest);
        said.filter(|said| said.hash != self.hasher.hash_one(bits(tile.transform)))
    }

    /// A tile with the section and the size that its newest record says.
    pub(super) fn shaped(&self, tile: &Tile) -> Tile {
        let newest = self.newest.get(&self.hasher.hash_one(&tile.name));
        let mut tile = tile.clone();
        if let Some(image) = newest.and_then(|newest| newest.image) {
            (tile.section, tile.size) = (image.section, image.size);
        }
        tile
    }

    /// Whether any record is of a tile's image, or of its end.
    pub(super) fn know(&self, tile: &str) -> bool {
        self.newest.contains_key(&self.hasher.hash_one(tile))
    }

    /// Whether a row that has a tile's name is of the section, the size and the channel that its newest record says.
    pub(super) fn has_shape(&self, tile: &Tile) -> bool {
        let newest = self.newest.get(&self.hasher.hash_one(&tile.name));
        let image = newest.and_then(|newest| newest.image);
        image == Some(Image::of(tile))
    }

    /// The position of the newest record of a tile's image, or of its end.
    pub(super) fn position_of(&self, tile: &str) -> Option<u64> {
        let newest = self.newest.get(&self.hasher.hash_one(tile))?;
        Some(newest.position)
    }

    /// The position of the newest record of a tile's image, if it is not deleted since.
    pub(super) fn newest_of(&self, tile: &str) -> Option<u64> {
        let newest = self.newest.get(&self.hasher.hash_one(tile))?;
        newest.image.map(|_| newest.position)
    }

    /// What says where a tile lies.
    pub(super) fn said(&self, tile: &str) -> Option<Said> {
        self.newest.get(&self.hasher.hash_one(tile))?.said
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
        let has = Image::of(tile);
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

/// What of a transform tells it from others, as a catalog keeps it: one without signs of zeros.
fn bits(transform: SectionFromTile) -> [u64; 6] {
    transform
        .elements()
        .map(|element| (element + 0.0).to_bits())
}

impl Check<'_> {
    /// What the records say, if they are at hand.
    pub(super) async fn read_records(&mut self, entry: &VolumeEntry) {
        self.records = None;
        let Some((folder, read)) = self.folder_of(entry).zip(self.read) else {
            return;
        };
        let volume = entry.volume.clone();
        let hasher = Keyed::new(self.archive.randomness());
        let work = move || Records::read(&folder, read, &volume, hasher);
        self.records = tokio::task::spawn_blocking(work).await.unwrap_or_default();
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
        let mut lost: Vec<_> = lost.map(|newest| (newest.position, newest.said)).collect();
        drop(records);
        lost.sort_unstable_by_key(|(position, _)| *position);
        for (position, said) in lost {
            let Some((_, Record::Tile(record))) = self.record_at(entry, position) else {
                continue;
            };
            if catalog.knows(volume, &record.tile).await? {
                continue;
            }
            self.kept.insert((volume.clone(), position));
            let mut reason = "its record was read, and the catalog knows nothing of it, nor whether `saccade update` has \
                              deleted it since"
                .to_owned();
            let (tile, mut repair) = (record.tile, None);
            match self.source(entry, Some(&tile), Some(position)) {
                Source::There(position, record) if self.options.repair => {
                    let why = "the catalog had lost it: its record was read, and nothing was known of it";
                    self.queue(entry, position, record, why.to_owned()).await?;
                    self.keep_place(entry, &tile, said.filter(|said| said.record > position)).await?;
                    repair = Some(Repair::Queued);
                }
                Source::There(..) => {}
                _ => reason.push_str(
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

    /// Where a tile that is made anew is to lie, if a record said so after its own: nobody reads that one again.
    pub(super) async fn keep_place(
        &self,
        entry: &VolumeEntry,
        tile: &str,
        said: Option<Said>,
    ) -> Result<(), CheckError> {
        let record = said.and_then(|said| self.record_at(entry, said.record));
        if let Some((said, (_, Record::Transform(record)))) = said.zip(record)
            && record.tile == tile
        {
            let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
            commit
                .transform(tile, record.transform, Some(said.record))
                .await?;
            commit.finish().await?;
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
