//! Tiles whose pyramids could not be read when they were looked at last.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::time::Instant;

use super::error::StitchError;
use super::index::IndexedTile;
use crate::Damage;

/// Tiles that are remembered.
const MOST: usize = 4096;

/// Of a pyramid that could not be read.
struct Found {
    section: u32,
    reason: String,
    /// When it was first not there, if that is what is wrong.
    missing: Option<Instant>,
}

type Tiles = BTreeMap<Box<str>, Found>;

/// By the names of pyramids.
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

    /// A tile could not be read. What a store or a catalog that is away keeps from being read is not damaged.
    /// Returns why, which of a pyramid that was missing before becomes another reason.
    pub(super) fn note(&self, tile: &IndexedTile, error: StitchError) -> StitchError {
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
                let found = Found {
                    section,
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

    /// A tile was read.
    pub(super) fn clear(&self, tile: &IndexedTile) {
        if self.count.load(Ordering::Relaxed) > 0 {
            self.change(|tiles| {
                tiles.remove(&tile.pyramid);
            });
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
