//! Which tiles lie where.

mod acquired;
mod section;
#[cfg(test)]
mod tests;
mod tile;
mod tree;

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use saccade_archive::catalog::{Catalog, CatalogChange, CatalogError, ChangeReason, Tile, TileId};
use tokio::sync::OnceCell;

use super::along_z::{Reach, Reaches};
pub(super) use acquired::Acquired;
pub use section::{SectionIndex, TileUpdate};
pub(super) use tile::IndexedTile;

/// Any section that can be.
const ALL_SECTIONS: Range<u32> = 0..u32::MAX;

type Cell = Arc<OnceCell<Arc<SectionIndex>>>;

/// A section that is loaded, or being loaded.
#[derive(Default)]
struct Section {
    cell: Cell,
    /// When it was last asked for, in questions.
    used: u64,
    /// Memory it takes; 0 until it is loaded.
    bytes: u64,
}

#[derive(Default)]
struct Sections {
    by_number: BTreeMap<u32, Section>,
    /// Questions so far.
    asked: u64,
    /// Memory of all \[bytes\].
    bytes: u64,
}

impl Sections {
    fn cell(&mut self, z: u32) -> Cell {
        self.asked += 1;
        let section = self.by_number.entry(z).or_default();
        section.used = self.asked;
        section.cell.clone()
    }

    fn retain(&mut self, keep: impl Fn(u32, &Section) -> bool) {
        self.by_number.retain(|z, section| keep(*z, section));
        self.bytes = self.by_number.values().map(|s| s.bytes).sum();
    }

    /// Counts what was loaded, and forgets those not asked for longest beyond `most` bytes; never the
    /// one that was loaded.
    fn loaded(&mut self, z: u32, cell: &Cell, most: u64) {
        let section = self.by_number.get_mut(&z);
        let Some(section) = section.filter(|s| s.bytes == 0 && Arc::ptr_eq(&s.cell, cell)) else {
            return;
        };
        section.bytes = cell.get().map_or(0, |index| index.bytes() as u64);
        self.bytes += section.bytes;
        while self.bytes > most {
            let others = self.by_number.iter();
            let others = others.filter(|(number, section)| **number != z && section.bytes > 0);
            let Some(oldest) = others
                .min_by_key(|(_, s)| s.used)
                .map(|(number, _)| *number)
            else {
                return;
            };
            let removed = self.by_number.remove(&oldest);
            self.bytes -= removed.map_or(0, |section| section.bytes);
        }
    }

    /// Puts a newer state of a loaded section in its place.
    fn replace(&mut self, z: u32, update: impl FnOnce(&SectionIndex) -> SectionIndex) {
        if let Some(section) = self.by_number.get_mut(&z)
            && let Some(old) = section.cell.get()
        {
            let index = Arc::new(update(old));
            self.bytes -= section.bytes;
            section.bytes = index.bytes() as u64;
            self.bytes += section.bytes;
            section.cell = Arc::new(OnceCell::new_with(Some(index)));
        }
    }
}

/// Where the tiles of a volume lie \[000 §5.1\].
///
/// Knows from the start which sections have tiles, and of which channels, and loads a section's when it is first asked for.
/// From then on `apply` keeps it as the catalog has it, until others need its memory.
pub struct TileIndex {
    catalog: Catalog,
    volume: Box<str>,
    channels: u32,
    acquired: Mutex<Acquired>,
    sections: Mutex<Sections>,
    /// Memory for sections \[bytes\].
    most_bytes: u64,
}

impl TileIndex {
    /// Of a volume. Reads which sections have tiles of which channels, and nothing else of the tiles. Keeps sections of at most
    /// `most_bytes`, one at least.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn open(
        catalog: &Catalog,
        volume: &str,
        most_bytes: u64,
    ) -> Result<Self, CatalogError> {
        let channels = catalog.entry(volume).await?.volume.channels.len();
        let channels = u32::try_from(channels).unwrap_or(u32::MAX);
        let acquired = { catalog.sections_of_channels(volume, channels, ALL_SECTIONS) }.await?;
        Ok(Self {
            catalog: catalog.clone(),
            volume: volume.into(),
            channels,
            acquired: Mutex::new(Acquired::new(acquired)),
            sections: Mutex::default(),
            most_bytes,
        })
    }

    /// What it is an index of.
    pub(super) fn catalog(&self) -> &Catalog {
        &self.catalog
    }

    /// The sections in a range that have a tile of a channel, ascending.
    pub fn acquired(&self, channel: u32, sections: Range<u32>) -> Vec<u32> {
        lock(&self.acquired).within(channel, sections).collect()
    }

    /// The nearest sections with tiles of a channel below and above a range.
    pub(super) fn around(&self, channel: u32, sections: Range<u32>) -> (Option<u32>, Option<u32>) {
        lock(&self.acquired).around(channel, sections)
    }

    /// Whether a section in a range has a tile of a channel.
    pub fn any_acquired(&self, channel: u32, sections: Range<u32>) -> bool {
        { lock(&self.acquired).within(channel, sections).next() }.is_some()
    }

    /// The tiles of a section, loaded on first touch.
    ///
    /// # Errors
    ///
    /// What the database says; it is asked again the next time.
    pub async fn section(&self, z: u32) -> Result<Arc<SectionIndex>, CatalogError> {
        let cell = lock(&self.sections).cell(z);
        // A load that was under way when the section changed ends in a cell that nobody asks again.
        let load = async || {
            let tiles = self.catalog.section_tiles(&self.volume, z).await?;
            Ok(Arc::new(SectionIndex::new(&tiles)))
        };
        let index = cell.get_or_try_init(load).await.cloned();
        lock(&self.sections).loaded(z, &cell, self.most_bytes);
        index
    }

    /// Follows the catalog: what is asked for after this shows these changes. Returns where each is seen.
    ///
    /// Reads the tiles that changed. Where that fails, their sections are forgotten, to be loaded when
    /// they are asked for.
    ///
    /// # Errors
    ///
    /// What the database says where it does not tell which channels the sections have; to be told these changes
    /// once more then.
    pub(super) async fn apply(
        &self,
        changes: &[CatalogChange],
        reaches: &Reaches<'_>,
    ) -> Result<Vec<Reach>, CatalogError> {
        let mut changed: BTreeMap<u32, BTreeSet<TileId>> = BTreeMap::new();
        for change in changes {
            changed
                .entry(change.section)
                .or_default()
                .insert(change.tile);
        }
        // Whoever begins to load a section from here on sees the changes.
        let loading = |z: u32, s: &Section| changed.contains_key(&z) && !s.cell.initialized();
        lock(&self.sections).retain(|z, section| !loading(z, section));
        let forget = || lock(&self.sections).retain(|z, _| !changed.contains_key(&z));
        let mut now: BTreeMap<u32, Vec<bool>> = BTreeMap::new();
        for within in runs(changed.keys().copied()) {
            let of = self
                .catalog
                .sections_of_channels(&self.volume, self.channels, within.clone());
            let of = of.await.inspect_err(|_| forget())?;
            for (z, _) in changed.range(within) {
                let has = of.iter().map(|sections| sections.binary_search(z).is_ok());
                now.insert(*z, has.collect());
            }
        }
        let ids: BTreeSet<TileId> = changed.values().flatten().copied().collect();
        let ids: Vec<_> = ids.into_iter().collect();
        let tiles = match self.catalog.tiles(&self.volume, &ids).await {
            Ok(tiles) => Some(tiles),
            Err(error) => {
                log::warn!("changed tiles cannot be read, their sections are forgotten: {error}");
                forget();
                None
            }
        };
        let known: BTreeMap<_, _> = tiles.iter().flatten().map(|tile| (tile.id, tile)).collect();
        let reached = self.turn(changes, &now, &known, reaches);
        if tiles.is_some() {
            for (z, ids) in changed {
                let updates = ids.iter().map(|id| match known.get(id) {
                    Some(tile) if tile.section == z => TileUpdate::Put(tile),
                    // It lies in another section now, whose change says so.
                    _ => TileUpdate::Remove(*id),
                });
                lock(&self.sections).replace(z, |old| old.updated(updates));
            }
        }
        Ok(reached)
    }

    /// Sections have tiles of these channels now. Returns where each change is seen, by what was and by what is.
    fn turn(
        &self,
        changes: &[CatalogChange],
        now: &BTreeMap<u32, Vec<bool>>,
        tiles: &BTreeMap<TileId, &Tile>,
        reaches: &Reaches<'_>,
    ) -> Vec<Reach> {
        let mut acquired = lock(&self.acquired);
        let turned: BTreeMap<u32, Vec<u32>> = { now.iter() }
            .map(|(z, has)| (*z, acquired.turned(*z, has)))
            .collect();
        let reach = |acquired: &Acquired, change: &CatalogChange| {
            let turned = turned.get(&change.section).map_or(&[][..], Vec::as_slice);
            // What moves keeps its channel. Of what else is new, that of the tile before is not known: it is one that the
            // section had.
            let own = { tiles.get(&change.tile) }
                .filter(|_| change.reason == ChangeReason::Transform)
                .map(|tile| tile.channel);
            let may_be = |channel| match own {
                Some(own) => own == channel,
                None => acquired.has(channel, change.section),
            };
            let channels = acquired.channels();
            channels.fold(Reach::own(change.section), |reach, channel| {
                let turned = turned.contains(&channel);
                if !turned && !may_be(channel) {
                    return reach;
                }
                reach.union(reaches.of(acquired, channel, change.section, turned))
            })
        };
        let before: Vec<Reach> = changes.iter().map(|c| reach(&acquired, c)).collect();
        for (z, channels) in &turned {
            acquired.turn(*z, channels);
        }
        let after = changes.iter().map(|c| reach(&acquired, c));
        before
            .into_iter()
            .zip(after)
            .map(|(a, b)| a.union(b))
            .collect()
    }

    /// Forgets all it knows, where it cannot be told what changed.
    ///
    /// # Errors
    ///
    /// What the database says; it knows then what it knew before.
    pub async fn reload(&self) -> Result<(), CatalogError> {
        // Whoever begins to load a section after these were read sees what is in the catalog now.
        let acquired =
            { &self.catalog }.sections_of_channels(&self.volume, self.channels, ALL_SECTIONS);
        *lock(&self.acquired) = Acquired::new(acquired.await?);
        lock(&self.sections).retain(|_, _| false);
        Ok(())
    }

    /// Tiles of the sections that are loaded.
    pub fn tiles(&self) -> u64 {
        let sections = lock(&self.sections);
        let loaded = { sections.by_number.values() }.filter_map(|section| section.cell.get());
        loaded.map(|index| index.tiles() as u64).sum()
    }

    /// Memory that it takes: all that is kept of tiles whose pyramid is not open \[bytes\].
    pub fn bytes(&self) -> u64 {
        // Entries of the two trees, which are at least half full.
        let each = size_of::<(u32, Section)>() + size_of::<OnceCell<Arc<SectionIndex>>>() / 2;
        let acquired = lock(&self.acquired).bytes();
        let sections = lock(&self.sections);
        let entries = 2 * sections.by_number.len() * each;
        (size_of::<Self>() + entries + acquired) as u64 + sections.bytes
    }
}

/// The ranges that hold these ascending sections, and few others: a registration changes all sections, and is to cost few questions.
fn runs(sections: impl IntoIterator<Item = u32>) -> Vec<Range<u32>> {
    /// Sections between two of which one question is asked.
    const NEAR: u32 = 64;
    let mut runs: Vec<Range<u32>> = Vec::new();
    for section in sections {
        let end = section.saturating_add(1);
        match runs.last_mut() {
            Some(run) if section - run.end <= NEAR => run.end = end,
            _ => runs.push(section..end),
        }
    }
    runs
}

/// Every change under these locks is one insertion or removal: whole even after a panic.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
