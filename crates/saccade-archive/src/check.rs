//! Whether an archive is whole: what the catalog names against what the storage holds.
//!
//! Objects are listed first and the catalog is read afterwards, so that a running ingest disturbs
//! nothing: what it enters meanwhile is named by then, and what it is about to enter is young.

use std::collections::{BTreeMap, HashSet};
use std::hash::{BuildHasher, RandomState};
use std::path::PathBuf;
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use futures::{StreamExt as _, stream};
use serde::Serialize;

use crate::VisualizationArchive;
use crate::acquisition::{Cursor, Record, RecordReader, TileRecord, image_path};
use crate::catalog::{CatalogError, Origin, Quarantined, Tile, VolumeEntry, Waiting, place};
use crate::pyramid::{self, PyramidError, Verified};
use crate::storage::{Entry, StorageError};

mod misplaced;
#[cfg(test)]
mod tests;

/// What to look at, and what to do about it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CheckOptions {
    /// Look at descriptions and lengths only, and read no voxels.
    pub quick: bool,
    /// Mend what can be: see [`check`].
    pub repair: bool,
    /// The acquisition archive whose records say how to make damaged pyramids anew.
    pub acquisition: Option<PathBuf>,
    /// The folder in which the records of bare folders and lists are kept, those of each volume in a folder of its
    /// name: where there are some, they are what damaged pyramids are made anew of.
    pub watched: Option<PathBuf>,
    /// Objects that nobody names may be about to be entered until they are so old.
    pub safe_age: Duration,
    /// Tiles in work at once. Each holds its pyramid in memory.
    pub workers: usize,
}

impl Default for CheckOptions {
    fn default() -> Self {
        Self {
            quick: false,
            repair: false,
            acquisition: None,
            watched: None,
            safe_age: Duration::from_secs(3600),
            workers: 4,
        }
    }
}

/// What was looked at, and what was found.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct CheckReport {
    /// Tiles that the catalog names.
    pub tiles: u64,
    /// Their pyramids' size \[bytes\]; of quick checks, what the storage says.
    pub bytes: u64,
    /// Pyramids without checksums, which older versions wrote.
    pub without_checksums: u64,
    /// Replaced pyramids that wait for their deletion.
    pub retired: u64,
    /// Unnamed objects that are too young to be called orphans.
    pub young: u64,
    /// What is not as it should be.
    pub findings: Vec<Finding>,
}

/// Something that is not as it should be.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What it is.
    pub kind: FindingKind,
    /// The volume, if it belongs to one.
    pub volume: Option<String>,
    /// The tile, if it is one's.
    pub tile: Option<String>,
    /// The object in the storage.
    pub object: Option<String>,
    /// What is wrong.
    pub reason: String,
    /// What was done about it.
    pub repair: Option<Repair>,
}

impl Finding {
    /// Whether it is mended, or will be.
    fn is_mended(&self) -> bool {
        matches!(
            self.repair,
            Some(Repair::Queued | Repair::Recounted | Repair::Moved)
        )
    }
}

/// What can be wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum FindingKind {
    /// The catalog names a pyramid that is not there.
    Missing,
    /// A pyramid is not what was written.
    Damaged,
    /// A pyramid is whole, but that of another tile.
    Mistaken,
    /// A tile lies where nothing can: numbers that are none, or outside the volume.
    Misplaced,
    /// Two tiles name one pyramid.
    Shared,
    /// What the catalog says of a tile or of a volume cannot be understood.
    Spoilt,
    /// The catalog's counts are not those of its tiles.
    Miscounted,
    /// A pyramid that nothing names. Harmless, but it takes space.
    Orphan,
}

/// What was done about a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Repair {
    /// The object is deleted.
    Deleted,
    /// The tile's record waits for ingest, which makes the pyramid anew.
    Queued,
    /// The tiles were counted anew.
    Recounted,
    /// The tile lies where its records say.
    Moved,
    /// The tile is in quarantine, for its record or image is not to be had.
    Quarantined,
}

impl FindingKind {
    /// Whether something is lost; else only space is.
    pub fn is_damage(self) -> bool {
        self != Self::Orphan
    }
}

impl CheckReport {
    /// Findings that are damage and not on the way to be mended.
    pub fn damage(&self) -> usize {
        let damage = self
            .findings
            .iter()
            .filter(|finding| finding.kind.is_damage() && !finding.is_mended());
        damage.count()
    }
}

/// Why an archive could not be checked to its end.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CheckError {
    /// The catalog cannot be used.
    #[error(transparent)]
    Catalog(#[from] CatalogError),
    /// The storage cannot be used at all.
    #[error("the archive's objects cannot be read")]
    Storage {
        /// What went wrong.
        #[from]
        source: StorageError,
    },
}

/// Checks an archive. `progress` hears how many tiles of how many were looked at.
///
/// Each tile's pyramid is read whole and decoded, and held against its checksums, its size, and its
/// name; transforms and counts of the catalog are looked at, and objects that nothing names are
/// listed. With [`CheckOptions::repair`], orphans of a safe age are deleted if they are of records that the catalog has
/// read: others are of later ones, if the catalog is an older copy, or somebody's own. A tile whose pyramid is
/// missing or damaged is given back to ingest if the acquisition still has its record and image,
/// and put into quarantine otherwise. What is whole and named is never touched, and neither is a
/// damaged object: ingest replaces it. A folder in the place of a pyramid is found as damage and not repaired:
/// somebody has to take it away first. Wrong counts are made right. A tile that lies outside of the volume, or nowhere, is
/// moved to where its records say, and of tiles that name one pyramid, those of whose records it was not made are given back to
/// ingest.
///
/// # Errors
///
/// [`CheckError`]: of what made going on pointless, not of a single object.
pub async fn check(
    archive: &VisualizationArchive,
    options: &CheckOptions,
    progress: &(dyn Fn(u64, u64) + Sync),
) -> Result<CheckReport, CheckError> {
    let objects = archive.storage().entries("tiles/").await?;
    let volumes = archive.catalog().volumes().await?;
    let known = volumes
        .iter()
        .filter_map(|volume| volume.entry.as_ref().ok());
    let total = known.map(|entry| entry.tiles).sum();
    let mut check = Check {
        archive,
        options,
        progress,
        total,
        report: CheckReport::default(),
        hasher: RandomState::new(),
        named: HashSet::new(),
        shared: HashSet::new(),
        given_back: HashSet::new(),
        unknown: HashSet::new(),
    };
    for volume in volumes {
        match volume.entry {
            Ok(entry) => check.volume(&entry).await?,
            Err(error) => check.not_understood(volume.name, &error),
        }
    }
    check.orphans(&objects).await?;
    let mut report = check.report;
    if options.quick {
        let sizes = objects.iter().map(|object| object.size);
        report.bytes = sizes.sum();
    }
    Ok(report)
}

struct Check<'a> {
    archive: &'a VisualizationArchive,
    options: &'a CheckOptions,
    progress: &'a (dyn Fn(u64, u64) + Sync),
    total: u64,
    report: CheckReport,
    hasher: RandomState,
    /// Hashes of the names that the catalog knows: millions of names would take much memory.
    named: HashSet<u64>,
    /// Pyramids of which it was found that several tiles name them.
    shared: HashSet<String>,
    /// Volume and name of tiles that were given back for that.
    given_back: HashSet<(String, String)>,
    /// Volumes of whose tiles nothing is known.
    unknown: HashSet<String>,
}

impl Check<'_> {
    async fn volume(&mut self, entry: &VolumeEntry) -> Result<(), CheckError> {
        let catalog = self.archive.catalog();
        let volume = &entry.volume;
        let before = self.report.tiles;
        // Not those that are counted: what the counts leave out would be called nobody's.
        let sections = catalog.sections_of_tiles(&volume.name).await?;
        for &z in &sections {
            let tiles = catalog.section_rows(&volume.name, z).await?;
            let looks = tiles.into_iter().map(async |tile| match tile {
                Ok(tile) => {
                    let looked = self.look(&tile).await;
                    Ok((tile, looked))
                }
                Err(spoilt) => Err(spoilt),
            });
            let workers = self.options.workers.max(1);
            let looks: Vec<_> = stream::iter(looks).buffered(workers).collect().await;
            for tile in looks {
                self.report.tiles += 1;
                match tile {
                    Ok((tile, looked)) => self.tile(entry, &tile, looked).await?,
                    Err(spoilt) => self.spoilt(entry, spoilt).await?,
                }
            }
            (self.progress)(self.report.tiles, self.total);
        }
        let tiles = self.report.tiles - before;
        // Others may have entered some meanwhile: only what cannot be so is wrong.
        let now = catalog.entry(&volume.name).await?;
        let counted = catalog.sections(&volume.name).await?;
        let still = catalog.sections_of_tiles(&volume.name).await?;
        let lacks = |z: &&u32| still.binary_search(z).is_ok() && counted.binary_search(z).is_err();
        let lacks = sections.iter().filter(lacks).count();
        let all = (entry.tiles.min(now.tiles)..=entry.tiles.max(now.tiles)).contains(&tiles);
        if !all || lacks > 0 {
            let reason = format!(
                "the catalog counts {} tiles, but has {tiles}; of {} sections with tiles it lacks {lacks}",
                now.tiles,
                sections.len()
            );
            let repair = match self.options.repair {
                true => {
                    catalog.recount(&volume.name).await?;
                    Some(Repair::Recounted)
                }
                false => None,
            };
            let found = self.find(FindingKind::Miscounted, entry, None, reason);
            found.repair = repair;
        }
        let later = SystemTime::now() + Duration::from_secs(1 << 32);
        for retired in catalog.retired(&volume.name, later, u32::MAX).await? {
            self.report.retired += 1;
            self.named.insert(self.hasher.hash_one(&retired.pyramid));
        }
        Ok(())
    }

    /// Looks at a tile's pyramid.
    async fn look(&self, tile: &Tile) -> Result<(Verified, u64), PyramidError> {
        let (storage, name) = (self.archive.storage(), tile.pyramid.clone());
        if self.options.quick {
            let verified = pyramid::verify_quickly(storage.as_ref(), &name).await?;
            return Ok((verified, 0));
        }
        let read = storage.read(&name, None).await;
        let bytes: Bytes = read.map_err(|source| PyramidError::Storage {
            source,
            name: name.clone(),
        })?;
        let len = bytes.len() as u64;
        let work = tokio::task::spawn_blocking(move || pyramid::verify(&bytes, &name));
        let verified = work.await.unwrap_or_else(|panicked| {
            Err(PyramidError::Broken {
                reason: format!("decoding it failed unexpectedly: {panicked}"),
                name: tile.pyramid.clone(),
            })
        });
        Ok((verified?, len))
    }

    async fn tile(
        &mut self,
        entry: &VolumeEntry,
        tile: &Tile,
        looked: Result<(Verified, u64), PyramidError>,
    ) -> Result<(), CheckError> {
        let known = (entry.volume.name.clone(), tile.name.clone());
        if self.given_back.contains(&known) {
            return Ok(());
        }
        let extent = entry.volume.extent();
        if place(extent, tile.section, tile.size, tile.transform).is_none() {
            self.misplaced(entry, tile).await?;
        }
        if !self.named.insert(self.hasher.hash_one(&tile.pyramid)) {
            // It was looked at with the first of them.
            return self.shared(entry, tile).await;
        }
        let (kind, reason) = match looked {
            Ok((verified, len)) => {
                self.report.bytes += len;
                self.report.without_checksums += u64::from(!verified.checksums);
                let level = verified.index.levels()[0];
                if verified.mistaken {
                    let reason = "the pyramid was made for another tile".to_owned();
                    return self.mend(FindingKind::Mistaken, entry, tile, reason).await;
                }
                if [level.width, level.height] == tile.size.to_array() {
                    return Ok(());
                }
                let catalog = self.archive.catalog();
                let named = catalog.origins(&entry.volume.name, &tile.pyramid).await?;
                if named.len() > 1 {
                    // Found with the next of them.
                    return Ok(());
                }
                let reason = format!(
                    "the pyramid has {} x {} pixels, the tile {} x {}",
                    level.width, level.height, tile.size.x, tile.size.y
                );
                (FindingKind::Mistaken, reason)
            }
            Err(PyramidError::Storage {
                source: StorageError::NotFound { .. },
                ..
            }) => (FindingKind::Missing, "the pyramid is not there".to_owned()),
            Err(PyramidError::Storage { source, .. }) => match source {
                // Ingest could not write there either: it is a person's to mend, and is only told.
                StorageError::Occupied { .. } => {
                    let reason =
                        "a folder lies in the place of the pyramid, and is left as it is; take it \
                                  away, then `saccade check --repair` mends the tile"
                            .to_owned();
                    self.find(FindingKind::Damaged, entry, Some(tile), reason);
                    return Ok(());
                }
                // One file that the disk cannot read is damaged; a store that is away says nothing.
                StorageError::Io { source, .. } => {
                    (FindingKind::Damaged, format!("it cannot be read: {source}"))
                }
                other => return Err(other.into()),
            },
            Err(PyramidError::Broken { reason, .. }) => (FindingKind::Damaged, reason),
            Err(other) => (FindingKind::Damaged, other.to_string()),
        };
        self.mend(kind, entry, tile, reason).await
    }

    /// Notes that a tile's pyramid is not right, and repairs it if that is wanted.
    async fn mend(
        &mut self,
        kind: FindingKind,
        entry: &VolumeEntry,
        tile: &Tile,
        reason: String,
    ) -> Result<(), CheckError> {
        let repair = if self.options.repair {
            Some(self.repair(entry, tile, &reason).await?)
        } else {
            None
        };
        self.find(kind, entry, Some(tile), reason).repair = repair;
        Ok(())
    }

    fn find(
        &mut self,
        kind: FindingKind,
        entry: &VolumeEntry,
        tile: Option<&Tile>,
        reason: String,
    ) -> &mut Finding {
        self.report.findings.push_mut(Finding {
            kind,
            volume: Some(entry.volume.name.clone()),
            tile: tile.map(|tile| tile.name.clone()),
            object: tile.map(|tile| tile.pyramid.clone()),
            reason,
            repair: None,
        })
    }

    /// A tile names a pyramid that one before it names, too. It was made of one record: the tiles of others are found.
    async fn shared(&mut self, entry: &VolumeEntry, tile: &Tile) -> Result<(), CheckError> {
        if !self.shared.insert(tile.pyramid.clone()) {
            return Ok(());
        }
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let origins = catalog.origins(volume, &tile.pyramid).await?;
        let made_of = position_of(&tile.pyramid);
        let owner = |origin: &&Origin| Some(origin.position) == made_of;
        let mut owners = origins.iter().filter(owner);
        let owner = owners.next().filter(|_| owners.next().is_none());
        // All of them at once. Where only one is left, somebody has mended it since it was listed.
        let others = origins.iter().filter(|origin| owner != Some(*origin));
        for origin in others.filter(|_| origins.len() > 1) {
            let reason = match owner {
                Some(owner) => format!("it names the pyramid of tile {}", owner.tile),
                None => "it names a pyramid that others name, too, and that is nobody's".to_owned(),
            };
            let mut repair = None;
            if self.options.repair {
                repair = Some(self.give_back(entry, origin, &reason).await?);
                let given_back = (volume.clone(), origin.tile.clone());
                self.given_back.insert(given_back);
            }
            self.report.findings.push(Finding {
                kind: FindingKind::Shared,
                volume: Some(volume.clone()),
                tile: Some(origin.tile.clone()),
                object: Some(tile.pyramid.clone()),
                reason,
                repair,
            });
        }
        Ok(())
    }

    /// Takes a pyramid that is not its own from a tile, and has it made anew.
    async fn give_back(
        &self,
        entry: &VolumeEntry,
        origin: &Origin,
        reason: &str,
    ) -> Result<Repair, CheckError> {
        let catalog = self.archive.catalog();
        let read = catalog.cursor(&entry.volume.name).await?;
        let record = self.tile_record(entry, &origin.tile, origin.position, read);
        let mut commit = catalog.begin(&entry.volume.name).await?;
        commit.detach(&origin.tile).await?;
        let repair = match record {
            Some(record) => {
                let waiting = Waiting {
                    position: origin.position,
                    record,
                    reason: reason.to_owned(),
                };
                commit.wait(&waiting).await?;
                Repair::Queued
            }
            None => {
                let what = Quarantined {
                    file: RecordReader::FILE.to_owned(),
                    tile: Some(origin.tile.clone()),
                    reason: format!(
                        "{reason}; append the tile's record to its acquisition once more, and ingest makes its own"
                    ),
                    bytes: Some(0),
                    at: SystemTime::now(),
                };
                commit.quarantine(&what).await?;
                Repair::Quarantined
            }
        };
        commit.finish().await?;
        Ok(repair)
    }

    /// Gives a tile back to ingest, or puts it into quarantine.
    async fn repair(
        &self,
        entry: &VolumeEntry,
        tile: &Tile,
        reason: &str,
    ) -> Result<Repair, CheckError> {
        let read = self.archive.catalog().cursor(&entry.volume.name).await?;
        let position = match position_of(&tile.pyramid) {
            // One that had another's, and was given back.
            None => {
                let catalog = self.archive.catalog();
                let origins = catalog.origins(&entry.volume.name, &tile.pyramid).await?;
                let own = origins.iter().find(|origin| origin.tile == tile.name);
                own.map(|origin| origin.position)
            }
            position => position,
        };
        let record = position.and_then(|at| self.tile_record(entry, &tile.name, at, read));
        let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
        let repair = match position.zip(record) {
            Some((position, record)) => {
                let reason = format!("its pyramid was found damaged: {reason}");
                let waiting = Waiting {
                    position,
                    record,
                    reason,
                };
                commit.wait(&waiting).await?;
                Repair::Queued
            }
            None => {
                let what = Quarantined {
                    file: tile.pyramid.clone(),
                    tile: Some(tile.name.clone()),
                    reason: format!(
                        "the pyramid was found damaged ({reason}); append the tile's record to its \
                         acquisition once more, and ingest makes it anew"
                    ),
                    bytes: None,
                    at: SystemTime::now(),
                };
                commit.quarantine(&what).await?;
                Repair::Quarantined
            }
        };
        commit.finish().await?;
        Ok(repair)
    }

    /// The record at a position, and the folder of its acquisition, if the records are those that were `read`.
    fn record_at(&self, entry: &VolumeEntry, at: u64, read: Cursor) -> Option<(PathBuf, Record)> {
        let kept = { self.options.watched.iter() }.map(|all| all.join(&entry.volume.name));
        let mut kept = kept.filter(|folder| folder.join(RecordReader::FILE).is_file());
        let folder = kept.next().or_else(|| self.options.acquisition.clone())?;
        RecordReader::new(&folder, read).recognize().ok()?;
        let cursor = Cursor {
            offset: at,
            ..Cursor::default()
        };
        let mut reader = RecordReader::new(&folder, cursor);
        let line = reader.read(1).ok()?.into_iter().next()?;
        let record = line.record.ok().filter(|_| line.offset == at)?;
        Some((folder, record))
    }

    /// A tile's record at a position, if its image is still there.
    fn tile_record(
        &self,
        entry: &VolumeEntry,
        tile: &str,
        at: u64,
        read: Cursor,
    ) -> Option<TileRecord> {
        match self.record_at(entry, at, read)? {
            (folder, Record::Tile(record)) if record.tile == tile => {
                let image = image_path(&folder, &record.file)?;
                image.is_file().then_some(record)
            }
            _ => None,
        }
    }

    /// Finds what nothing names.
    async fn orphans(&mut self, objects: &[Entry]) -> Result<(), CheckError> {
        let now = SystemTime::now();
        for object in objects {
            let is_unknown = volume_of(&object.name).is_some_and(|v| self.unknown.contains(v));
            if is_unknown || self.named.contains(&self.hasher.hash_one(&object.name)) {
                continue;
            }
            let age = object.modified.and_then(|at| now.duration_since(at).ok());
            if age.is_none_or(|age| age < self.options.safe_age) {
                self.report.young += 1;
                continue;
            }
            let origin = self.whence(&object.name).await?;
            let repair = if self.options.repair && origin == Whence::Read {
                self.archive.storage().delete(&object.name).await?;
                Some(Repair::Deleted)
            } else {
                None
            };
            let why = match origin {
                Whence::Read => "",
                Whence::Later => {
                    ", which are of a record that the catalog has not read: if it is an older copy, `saccade ingest` goes on \
                     from there; they are never deleted"
                }
                Whence::Foreign => {
                    ", and they are no pyramid of this catalog's; they are never deleted"
                }
            };
            self.report.findings.push(Finding {
                kind: FindingKind::Orphan,
                volume: None,
                tile: None,
                object: Some(object.name.clone()),
                reason: format!("nothing names these {} bytes{why}", object.size),
                repair,
            });
        }
        Ok(())
    }
}

/// Where an object comes from that nothing names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Whence {
    /// A record that the catalog has read: what came of it is entered, or will never be.
    Read,
    /// One that it has not read.
    Later,
    /// None of this catalog's volumes.
    Foreign,
}

impl Check<'_> {
    async fn whence(&self, object: &str) -> Result<Whence, CheckError> {
        let parts: Vec<&str> = object.split('/').collect();
        let ["tiles", volume, section, pyramid] = parts[..] else {
            return Ok(Whence::Foreign);
        };
        let (Some(position), Ok(_)) = (position_of(pyramid), section.parse::<u32>()) else {
            return Ok(Whence::Foreign);
        };
        match self.archive.catalog().cursor(volume).await {
            Ok(read) if position < read.offset => Ok(Whence::Read),
            Ok(_) => Ok(Whence::Later),
            Err(CatalogError::UnknownVolume { .. }) => Ok(Whence::Foreign),
            Err(error) => Err(error.into()),
        }
    }
}

/// The volume whose tile's a pyramid is.
fn volume_of(pyramid: &str) -> Option<&str> {
    Some(pyramid.strip_prefix("tiles/")?.split_once('/')?.0)
}

/// The position of the record that a pyramid was made of: ingest ends names with it.
fn position_of(pyramid: &str) -> Option<u64> {
    let stem = pyramid.strip_suffix(".tif")?;
    u64::from_str_radix(stem.rsplit_once('-')?.1, 16).ok()
}

/// How many findings there are of each kind.
pub fn count(findings: &[Finding]) -> BTreeMap<FindingKind, usize> {
    let mut counts = BTreeMap::new();
    for finding in findings {
        *counts.entry(finding.kind).or_default() += 1;
    }
    counts
}
