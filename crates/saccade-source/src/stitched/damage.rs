//! Tiles whose pyramids could not be read when they were looked at last.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use glam::UVec2;
use saccade_archive::catalog::CatalogError;
use tokio::time::Instant;

use super::error::StitchError;
use super::index::IndexedTile;
use crate::Damage;

/// Tiles that are remembered.
const MOST: usize = 4096;

/// What could not be read of a tile.
enum What {
    /// What the catalog says of it, without which nothing of its section can be read.
    Row,
    /// Its pyramid's index.
    Index,
    /// Some of these sub-tiles: level and place. Others tell nothing of them.
    SubTiles(BTreeSet<(u32, u32, u32)>),
}

/// Of a pyramid that could not be read.
struct Found {
    section: u32,
    what: What,
    reason: String,
    /// When it was first not there, if that is what is wrong.
    missing: Option<Instant>,
}

type Tiles = BTreeMap<Box<str>, Found>;

/// By the names of pyramids; of tiles, where the catalog's row of one is what cannot be read.
pub(super) struct DamagedTiles {
    tiles: Mutex<Tiles>,
    /// Nearly always 0, which costs no lock.
    count: AtomicUsize,
    /// How long one that is not there counts as one on its way.
    may_come_for: Duration,
}

impl DamagedTiles {
    pub(super) fn new(may_come_for: Duration) -> Self {
        Self {
            tiles: Mutex::default(),
            count: AtomicUsize::default(),
            may_come_for,
        }
    }

    fn change(&self, change: impl FnOnce(&mut Tiles)) {
        let mut tiles = self.lock();
        change(&mut tiles);
        self.count.store(tiles.len(), Ordering::Relaxed);
    }

    fn lock(&self) -> MutexGuard<'_, Tiles> {
        self.tiles.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A tile's pyramid could not be opened. What a store or a catalog that is away keeps from being read is not damaged.
    /// Returns why, which of a pyramid that was missing before becomes another reason.
    pub(super) fn note(&self, tile: &IndexedTile, error: StitchError) -> StitchError {
        self.note_what(tile, What::Index, error)
    }

    /// The same where some of these sub-tiles of a level could not be read.
    pub(super) fn note_sub_tiles(
        &self,
        tile: &IndexedTile,
        level: u32,
        sub_tiles: &[UVec2],
        error: StitchError,
    ) -> StitchError {
        let sub_tiles = sub_tiles.iter().map(|at| (level, at.x, at.y));
        self.note_what(tile, What::SubTiles(sub_tiles.collect()), error)
    }

    fn note_what(&self, tile: &IndexedTile, mut what: What, error: StitchError) -> StitchError {
        if !error.is_damage() {
            return error;
        }
        let section = tile.section;
        let missing = error.missing().map(str::to_owned);
        let now = Instant::now();
        let mut since = missing.is_some().then_some(now);
        self.change(|tiles| {
            let before = tiles.get(&tile.pyramid).and_then(|found| found.missing);
            since = since.map(|now| before.unwrap_or(now));
            if tiles.len() < MOST || tiles.contains_key(&tile.pyramid) {
                if let What::SubTiles(more) = &mut what
                    && let Some(What::SubTiles(before)) = tiles.get(&tile.pyramid).map(|f| &f.what)
                {
                    more.extend(before);
                }
                let found = Found {
                    section,
                    what,
                    reason: error.without_place(),
                    missing: since,
                };
                tiles.insert(tile.pyramid.clone(), found);
            }
        });
        let late = since.is_some_and(|since| now - since >= self.may_come_for);
        match missing.filter(|_| late) {
            Some(name) => StitchError::Missing { section, name },
            None => error,
        }
    }

    /// These sub-tiles of a level were read; which, is asked only where something is damaged.
    pub(super) fn clear(&self, tile: &IndexedTile, read: impl FnOnce() -> (u32, Vec<UVec2>)) {
        if self.count.load(Ordering::Relaxed) == 0 {
            return;
        }
        self.change(|tiles| {
            let Some(found) = tiles.get_mut(&tile.pyramid) else {
                return;
            };
            let is_whole = match &mut found.what {
                What::Row | What::Index => true,
                What::SubTiles(sub_tiles) => {
                    let (level, read) = read();
                    for at in read {
                        sub_tiles.remove(&(level, at.x, at.y));
                    }
                    sub_tiles.is_empty()
                }
            };
            if is_whole {
                tiles.remove(&tile.pyramid);
            }
        });
    }

    /// The tiles of a section could not be looked up. Returns why.
    pub(super) fn note_section(&self, section: u32, error: CatalogError) -> StitchError {
        if let CatalogError::SpoiltTile { tile, .. } = &error {
            let reason = error.without_place();
            let found = Found {
                section,
                what: What::Row,
                reason,
                missing: None,
            };
            self.change(|tiles| {
                if tiles.len() < MOST {
                    tiles.insert(tile.as_str().into(), found);
                }
            });
        }
        StitchError::Catalog { source: error }
    }

    /// The tiles of a section were looked up.
    pub(super) fn clear_section(&self, section: u32) {
        if self.count.load(Ordering::Relaxed) > 0 {
            let is_row = |f: &Found| f.section == section && matches!(f.what, What::Row);
            self.change(|tiles| tiles.retain(|_, found| !is_row(found)));
        }
    }

    /// Tiles of these sections may be others now.
    pub(super) fn forget(&self, changed: impl Fn(u32) -> bool) {
        if self.count.load(Ordering::Relaxed) > 0 {
            self.change(|tiles| tiles.retain(|_, found| !changed(found.section)));
        }
    }

    pub(super) fn list(&self) -> Vec<Damage> {
        let tiles = self.lock();
        let damage = tiles.iter().map(|(object, found)| Damage {
            section: found.section,
            object: object.to_string(),
            reason: found.reason.clone(),
        });
        damage.collect()
    }
}
