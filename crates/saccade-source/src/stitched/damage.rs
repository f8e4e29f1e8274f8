//! Tiles whose pyramids could not be read when they were looked at last.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::error::StitchError;
use super::index::IndexedTile;
use crate::Damage;

/// Tiles that are remembered.
const MOST: usize = 4096;

/// Section and reason of pyramids, by name.
#[derive(Default)]
pub(super) struct DamagedTiles {
    tiles: Mutex<BTreeMap<Box<str>, (u32, String)>>,
    /// Nearly always 0, which costs no lock.
    count: AtomicUsize,
}

impl DamagedTiles {
    fn change(&self, change: impl FnOnce(&mut BTreeMap<Box<str>, (u32, String)>)) {
        let mut tiles = self.lock();
        change(&mut tiles);
        self.count.store(tiles.len(), Ordering::Relaxed);
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<Box<str>, (u32, String)>> {
        self.tiles.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A tile could not be read. What a store or a catalog that is away keeps from being read is not damaged.
    pub(super) fn note(&self, tile: &IndexedTile, error: &StitchError) {
        if error.is_damage() {
            self.change(|tiles| {
                if tiles.len() < MOST {
                    let found = (tile.section, error.without_place());
                    tiles.insert(tile.pyramid.clone(), found);
                }
            });
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
            self.change(|tiles| tiles.retain(|_, (section, _)| !changed(*section)));
        }
    }

    pub(super) fn list(&self) -> Vec<Damage> {
        let tiles = self.lock();
        let damage = tiles.iter().map(|(object, (section, reason))| Damage {
            section: *section,
            object: object.to_string(),
            reason: reason.clone(),
        });
        damage.collect()
    }
}
