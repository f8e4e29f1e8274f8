//! Whether an archive is whole: what the catalog names against what the storage holds.
//!
//! Objects are listed first and the catalog is read afterwards, so that a running ingest disturbs
//! nothing: what it enters meanwhile is named by then, and what it is about to enter is young.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::hash::BuildHasher as _;
use std::path::PathBuf;
use std::time::Duration;

use bytes::Bytes;
use futures::{StreamExt as _, stream};
use saccade_core::volume::Dtype;

use crate::VisualizationArchive;
use crate::acquisition::Cursor;
use crate::catalog::{
    CatalogError, History, Naming, Placing, SpoiltTile, Tile, TileId, VolumeEntry, place,
};
use crate::pyramid::{self, PyramidError, Verified};
use crate::randomness::Keyed;
use crate::storage::{Entry, StorageError};

mod ahead;
mod called;
mod cursor;
mod described;
mod doubled;
mod half_deleted;
mod lost_volumes;
mod misnamed;
mod misplaced;
mod moved;
mod names;
mod orphans;
mod records;
mod repair;
mod report;
mod revisions;
mod set_aside;
mod shared;
#[cfg(test)]
mod tests;
mod undeleted;
mod unsound;

use names::Name;
use repair::{Source, position_of};
use revisions::Revisions;

pub use report::{CheckReport, Finding, FindingKind, Repair, count};

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
/// listed. With [`CheckOptions::repair`], orphans of a safe age are deleted if no row of the catalog names them, be it of no volume, and if they are of records that the catalog has
/// read: others are of later ones, if the catalog is an older copy, or somebody's own. A tile whose pyramid is
/// missing or damaged is given back to ingest if the acquisition still has its record and image,
/// and put into quarantine otherwise. What is whole and named is never touched, and neither is a
/// damaged object: ingest replaces it. A folder in the place of a pyramid is found as damage and not repaired:
/// somebody has to take it away first. Wrong counts are made right. A tile that lies outside of the volume, or nowhere, is
/// moved to where its records say, and of tiles that name one pyramid, those of whose records it was not made are given back to
/// ingest.
///
/// The catalog's own file is looked at before, if it is SQLite's: where it is damaged, that alone is found. With
/// [`CheckOptions::repair`] its indexes are made anew, and where it is sound then, the rest follows. Where the index of names is gone and
/// rows have one name, the one that its newest record speaks of is kept, and the index made.
///
/// Where the records are at hand, the catalog is held against them: a tile that it lacks, or of which it says something else
/// than the record, is found, and given back to ingest if that is wanted; one that has another tile's name is called as its record is; one that lies elsewhere than its newest record says is moved
/// there, unless somebody may have moved it since. So are what the catalog says of the volume, and of how far its records were read.
/// A tile that the catalog lost is taken in again, be it that somebody other than the microscope had deleted it: nothing tells.
/// A row that is called deleted and that no deletion took is brought back, and one that a deletion took and is there is taken
/// away. Where a tile does not name its own pyramid and that is there, it is named again.
///
/// # Errors
///
/// [`CheckError`]: of what made going on pointless, not of a single object.
pub async fn check(
    archive: &VisualizationArchive,
    options: &CheckOptions,
    progress: &(dyn Fn(u64, u64) + Sync),
) -> Result<CheckReport, CheckError> {
    let unsound = unsound::look(archive, options).await?;
    let is_sound = { unsound.iter() }.all(|finding| finding.repair.is_some());
    let mut report = CheckReport::default();
    report.findings.extend(unsound);
    if !is_sound {
        return Ok(report);
    }
    let lacking = unsound::lacking_indexes(archive, options).await?;
    let mut pending = Vec::new();
    for (index, finding) in lacking {
        if finding.repair.is_none() {
            pending.push((report.findings.len(), index));
        }
        report.findings.push(finding);
    }
    let objects = archive.storage().entries("tiles/").await?;
    let revisions = Revisions::look(archive, options).await?;
    let volumes = archive.catalog().volumes().await?;
    report.findings.extend(revisions.findings);
    let known = volumes
        .iter()
        .filter_map(|volume| volume.entry.as_ref().ok());
    let total = known.map(|entry| entry.tiles).sum();
    let mut check = Check {
        archive,
        options,
        progress,
        total,
        report,
        hasher: Keyed::new(archive.randomness()),
        named: HashSet::new(),
        shared: HashSet::new(),
        lacks_index: !pending.is_empty(),
        undecided: HashSet::new(),
        given_back: HashSet::new(),
        unknown: HashSet::new(),
        known: volumes.iter().map(|volume| volume.name.clone()).collect(),
        read: None,
        records: None,
        strays: None,
        compared: HashSet::new(),
        kept: HashSet::new(),
        miscounted: Vec::new(),
        lacking: HashSet::new(),
        doubtful: HashSet::new(),
        unread: HashSet::new(),
        placings: None,
        of_other_types: Vec::new(),
        of_its_type: 0,
        objects: &objects,
        by_record: None,
        history: History::default(),
        is_history_sure: false,
        of_others: HashSet::new(),
        renamed: HashSet::new(),
        called: HashMap::new(),
    };
    check.lost_volumes().await?;
    check.find_owner(&volumes).await?;
    let mut looked_at = Vec::new();
    for volume in volumes {
        match volume.entry {
            Ok(entry) => {
                check.volume(&entry).await?;
                looked_at.push(volume.name);
            }
            // It is told what it is about.
            Err(_) if revisions.unknown.contains(&volume.name) => {
                check.unknown.insert(volume.name);
            }
            Err(error) => check.not_understood(volume.name, &error),
        }
    }
    check.orphans().await?;
    check.recount().await?;
    for volume in &looked_at {
        check.no_longer_set_aside(volume).await?;
    }
    let mut report = check.report;
    for (number, index) in pending.into_iter().filter(|_| options.repair) {
        let finding = &mut report.findings[number];
        unsound::make_at_last(archive, options, &index, finding).await?;
    }
    // As repairs left them.
    for volume in looked_at {
        let counts = archive.catalog().statistics(&volume).await?;
        report.set_aside += counts.quarantined;
        report.queued += counts.waiting + counts.queued;
    }
    if options.quick {
        let sizes = objects.iter().map(|object| object.size);
        report.bytes = sizes.sum();
    }
    Ok(report)
}

/// A row, with what was seen of its pyramid: what it is, and how many bytes were read.
type Looked = Result<(Tile, Result<(Verified, u64), PyramidError>), SpoiltTile>;

struct Check<'a> {
    archive: &'a VisualizationArchive,
    options: &'a CheckOptions,
    progress: &'a (dyn Fn(u64, u64) + Sync),
    total: u64,
    report: CheckReport,
    hasher: Keyed,
    /// Hashes of the names that the catalog knows: millions of names would take much memory.
    named: HashSet<u64>,
    /// Pyramids of which it was found that several tiles name them.
    shared: HashSet<String>,
    /// Whether the catalog lacks an index, so that rows may have one name.
    lacks_index: bool,
    /// Rows of the volume at hand that have one name, where nothing tells whose it is.
    undecided: HashSet<TileId>,
    /// Volume and name of tiles that were given back for that.
    given_back: HashSet<(String, String)>,
    /// Volumes of whose tiles nothing is known.
    unknown: HashSet<String>,
    /// Volumes that the catalog names.
    known: HashSet<String>,
    /// How far the records of the volume at hand were read, if that can be understood.
    read: Option<Cursor>,
    /// What they say, if they are at hand.
    records: Option<records::Records>,
    /// Rows by the hashes of the pyramids that they name, of those that no volume's tiles name; `None` until that is wanted.
    strays: Option<HashMap<u64, Naming>>,
    /// Volumes that were held against their records.
    compared: HashSet<String>,
    /// Volumes and positions of records of tiles whose rows do not name the pyramid that may be theirs.
    kept: HashSet<(String, u64)>,
    /// Volumes whose tiles are counted wrongly, the findings that say so, and the sections that were left out.
    miscounted: Vec<(String, usize, Vec<u32>)>,
    /// Those of them that have fewer than are counted, with nothing that says which.
    lacking: HashSet<String>,
    /// Those of them with objects that may be of tiles that were lost.
    doubtful: HashSet<String>,
    /// Volumes of which it is not known how far their records were read.
    unread: HashSet<String>,
    /// What brought the tiles of a section to where they lie, once that is wanted.
    placings: Option<(u32, HashMap<TileId, Placing>)>,
    /// Tiles of the volume at hand whose voxels are of another type than the volume's.
    of_other_types: Vec<(Tile, Dtype)>,
    /// How many tiles of the volume at hand are of its type.
    of_its_type: u64,
    /// What the storage has.
    objects: &'a [Entry],
    /// Which of it is of which volume's record, by the hashes of both; `None` until that is wanted.
    by_record: Option<HashMap<u64, Vec<usize>>>,
    /// What the changes tell of the tiles of the volume at hand.
    history: History,
    /// Whether it was read once more, since something was missed in it.
    is_history_sure: bool,
    /// Volumes that the acquisition at hand is not of.
    of_others: HashSet<String>,
    /// Pyramids that a repair had their own tiles name again.
    renamed: HashSet<String>,
    /// Names of tiles that a repair gave them in exchange for another's.
    called: HashMap<TileId, String>,
}

impl Check<'_> {
    async fn volume(&mut self, entry: &VolumeEntry) -> Result<(), CheckError> {
        let catalog = self.archive.catalog();
        let volume = &entry.volume;
        let before = self.report.tiles;
        self.history = catalog.history(&volume.name).await?;
        self.is_history_sure = false;
        self.read_up_to(entry).await?;
        self.read_records(entry).await;
        self.doubled(entry).await?;
        self.described(entry);
        self.ahead(entry).await?;
        // Not those that are counted: what the counts leave out would be called nobody's.
        let sections = catalog.sections_of_tiles(&volume.name).await?;
        for &z in &sections {
            self.placings = None;
            for tile in self.section(&volume.name, z).await? {
                self.report.tiles += 1;
                match tile {
                    Ok((tile, looked)) => self.tile(entry, &tile, looked).await?,
                    Err(spoilt) => self.spoilt(entry, spoilt).await?,
                }
            }
            (self.progress)(self.report.tiles, self.total);
        }
        for spoilt in catalog.rows_without_section(&volume.name).await? {
            self.report.tiles += 1;
            self.spoilt(entry, spoilt).await?;
        }
        self.half_deleted(entry).await?;
        self.undeleted(entry).await?;
        self.of_other_types(entry).await?;
        self.lost(entry).await?;
        self.spoilt_waiting(entry).await?;
        let tiles = self.report.tiles - before;
        // Others may have entered some meanwhile: only what cannot be so is wrong.
        let now = catalog.entry(&volume.name).await?;
        // Those that the volume does not have are told with their tiles.
        let depth = entry.volume.extent().z;
        let lacking = catalog.uncounted_sections(&volume.name).await?;
        let lacking: Vec<u32> = lacking.into_iter().filter(|z| *z < depth).collect();
        let lacks = lacking.len();
        let all = (entry.tiles.min(now.tiles)..=entry.tiles.max(now.tiles)).contains(&tiles);
        // One that went to another section meanwhile was met there as well, or not at all.
        let has_changed = now.revision != entry.revision;
        let all = all || (has_changed && catalog.is_counted(&volume.name).await?);
        if !all || lacks > 0 {
            let mut reason = format!(
                "the catalog counts {} tiles, but has {tiles}; of {} sections with tiles it lacks {lacks}",
                now.tiles,
                sections.len()
            );
            if tiles < now.tiles && !self.compared.contains(&volume.name) {
                self.lacking.insert(volume.name.clone());
                reason.push_str("; where tiles are lost, --acquisition FOLDER tells which");
            }
            let number = self.report.findings.len();
            self.find(FindingKind::Miscounted, entry, None, reason);
            self.miscounted.push((volume.name.clone(), number, lacking));
        }
        let later = catalog.clock().now() + Duration::from_secs(1 << 32);
        for retired in catalog.retired(&volume.name, later, u32::MAX).await? {
            self.report.retired += 1;
            if !self.named.insert(self.hasher.hash_one(&retired.pyramid)) {
                self.living(entry, &retired.pyramid).await?;
            }
        }
        Ok(())
    }

    /// The rows of a section, with what was seen of their pyramids. Those that change meanwhile are looked at once more, for what was
    /// seen says nothing of what is there now.
    async fn section(&mut self, volume: &str, z: u32) -> Result<Vec<Looked>, CheckError> {
        /// Who is imaged anew without end is not waited for.
        const TURNS: u32 = 4;
        let catalog = self.archive.catalog();
        let workers = self.options.workers.max(1);
        let mut rows = catalog.section_rows(volume, z).await?;
        let mut all = Vec::new();
        for _ in 0..TURNS {
            let looks = rows.into_iter().map(async |row| match row {
                Ok(tile) => {
                    let looked = self.look(&tile).await;
                    Ok((tile, looked))
                }
                Err(spoilt) => Err(spoilt),
            });
            let looks: Vec<Looked> = stream::iter(looks).buffered(workers).collect().await;
            let now = catalog.section_rows(volume, z).await?.into_iter();
            let id_of = |row: &Result<Tile, SpoiltTile>| match row {
                Ok(tile) => tile.id,
                Err(spoilt) => spoilt.id,
            };
            let mut now: BTreeMap<_, _> = now.map(|row| (id_of(&row), row)).collect();
            for look in looks {
                let id = match &look {
                    Ok((tile, _)) => tile.id,
                    Err(spoilt) => spoilt.id,
                };
                let is_so = match (&look, now.get(&id)) {
                    (Ok((before, _)), Some(Ok(now))) => before == now,
                    (Err(_), Some(Err(_))) => true,
                    _ => false,
                };
                if is_so {
                    now.remove(&id);
                    all.push(look);
                }
            }
            rows = now.into_values().collect();
            if rows.is_empty() {
                break;
            }
        }
        for row in rows {
            let tile = match row {
                Ok(tile) => tile,
                Err(spoilt) => {
                    all.push(Err(spoilt));
                    continue;
                }
            };
            self.report.tiles += 1;
            self.named.insert(self.hasher.hash_one(&tile.pyramid));
            if let Some(records) = &mut self.records {
                records.meet(&tile.name);
            }
        }
        Ok(all)
    }

    /// A pyramid is on the list of those that are to be deleted; somebody may have taken it there since its tile was looked at.
    async fn living(&mut self, entry: &VolumeEntry, pyramid: &str) -> Result<(), CheckError> {
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let origins = catalog.origins(volume, pyramid).await?;
        let Some(origin) = origins.into_iter().next() else {
            return Ok(());
        };
        let mut repair = None;
        if self.options.repair {
            let mut commit = catalog.begin(volume).await?;
            commit.forget_retired(pyramid).await?;
            commit.finish().await?;
            repair = Some(Repair::Kept);
        }
        let reason =
            "the catalog says that nothing names its pyramid, and that it is to be deleted";
        self.report.findings.push(Finding {
            kind: FindingKind::Spoilt,
            volume: Some(volume.clone()),
            tile: Some(origin.tile),
            object: Some(pyramid.to_owned()),
            reason: reason.to_owned(),
            repair,
        });
        Ok(())
    }

    /// Counts anew what is counted wrongly, where that is no sign of something that is lost.
    async fn recount(&mut self) -> Result<(), CheckError> {
        let catalog = self.archive.catalog();
        for (volume, number, lacking) in std::mem::take(&mut self.miscounted) {
            if !self.options.repair || self.doubtful.contains(&volume) {
                continue;
            }
            catalog.recount(&volume).await?;
            // Who follows the volume took these for sections without tiles.
            let mut commit = catalog.begin(&volume).await?;
            for z in lacking {
                commit.show_again(z).await?;
            }
            commit.finish().await?;
            self.report.findings[number].repair = Some(Repair::Recounted);
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
        if self.is_undecided(tile.id, Some(&tile.name), &tile.pyramid) {
            return Ok(());
        }
        let known = (entry.volume.name.clone(), tile.name.clone());
        if self.given_back.contains(&known) {
            return Ok(());
        }
        if self.history.was_deleted(tile.id, tile.revision) {
            return self.end_again(entry, &tile.name, &tile.pyramid).await;
        }
        let Some(tile) = self.rightly_called(entry, tile).await? else {
            return Ok(());
        };
        let tile = &*tile;
        let settled = self.settle(entry, tile).await?;
        let tile = settled.as_ref().unwrap_or(tile);
        self.misnumbered(entry, tile).await?;
        if let Some(reason) = self.contradicted(entry, tile) {
            self.named.insert(self.hasher.hash_one(&tile.pyramid));
            return self.mend(FindingKind::Spoilt, entry, tile, reason).await;
        }
        if self.misnamed(entry, tile, &looked).await? {
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
                    self.compare_type(entry, tile, verified.index.dtype());
                    self.compare_section(entry, tile);
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
                StorageError::Occupied { .. } if Name::of(&tile.pyramid).is_none() => {
                    return self.names_folder(entry, tile).await;
                }
                // Ingest could not write there either: it is a person's to mend, and is only told.
                StorageError::Occupied { .. } => {
                    let reason =
                        "a folder lies in the place of the pyramid, and is left as it is; take it \
                                  away, then `saccade check --repair` mends the tile"
                            .to_owned();
                    self.find(FindingKind::Damaged, entry, Some(tile), reason);
                    return Ok(());
                }
                StorageError::NoFile { .. } => {
                    let reason = "a named pipe, a socket or a device lies in the place of the pyramid, and nothing is read of it";
                    (FindingKind::Damaged, reason.to_owned())
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
        mut reason: String,
    ) -> Result<(), CheckError> {
        if let Some(own) = self.own_pyramid(entry, tile).await? {
            return self.rename_pyramid(kind, entry, tile, own, reason).await;
        }
        let position = self.position(entry, tile).await?;
        // What there is of it is kept until it is whole again.
        if let Some(position) = position.filter(|at| position_of(&tile.pyramid) != Some(*at)) {
            self.kept.insert((entry.volume.name.clone(), position));
        }
        let source = self.source(entry, Some(&tile.name), position);
        // Without a repair, what is at hand is told only where it will not do.
        if self.options.repair || matches!(source, Source::ImageGone(_)) {
            reason.push_str(&source.advice(kind != FindingKind::Spoilt));
        }
        let repair = match self.options.repair {
            true => Some(self.repair(entry, tile, kind, source, &reason).await?),
            false => None,
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
}
