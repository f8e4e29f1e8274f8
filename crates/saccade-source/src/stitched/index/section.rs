use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use glam::DVec2;
use saccade_archive::catalog::{Tile, TileId};
use saccade_core::transform::SectionPoint;

use super::tile::{IndexedTile, PER_ALLOCATION};
use super::tree::{PackedTree, hilbert_order};

/// News of a tile, for [`SectionIndex::updated`].
#[derive(Clone, Copy, Debug)]
pub enum TileUpdate<'t> {
    /// It came, moved, or was imaged again. Counts only if it is newer than what is known.
    Put(&'t Tile),
    /// The section no longer has it.
    Remove(TileId),
}

/// The tiles of one section: which of them lie where.
///
/// Finds the tiles that touch a rectangle in time that grows with the logarithm of their number
/// \[000 §5.1\]. Never changes: [`Self::updated`] makes another one that shares nearly all of it,
/// so whoever holds one sees one state of the section.
#[derive(Clone)]
pub struct SectionIndex {
    packed: Arc<Packed>,
    /// Of the packed tiles, those that no longer count. Ascending.
    pub(super) hidden: Vec<u32>,
    /// Tiles that came or changed since packing, by id.
    pub(super) recent: BTreeMap<TileId, Arc<IndexedTile>>,
}

/// Tiles in the order of a Hilbert curve through their centres, and a tree over their bounds.
struct Packed {
    tiles: Box<[Arc<IndexedTile>]>,
    tree: PackedTree,
    /// Numbers of the tiles in the order of their ids.
    by_id: Box<[u32]>,
}

impl Packed {
    fn new(tiles: &[Arc<IndexedTile>]) -> Self {
        let middle = |tile: &Arc<IndexedTile>| (tile.min + tile.max) / 2.0;
        let middles: Vec<DVec2> = tiles.iter().map(middle).collect();
        let order = hilbert_order(&middles).into_iter();
        let tiles: Box<[_]> = order.map(|number| tiles[number].clone()).collect();
        let count = u32::try_from(tiles.len()).expect("sections have fewer than 4 G tiles");
        let mut by_id: Box<[u32]> = (0..count).collect();
        by_id.sort_unstable_by_key(|number| tiles[*number as usize].id);
        let tree = PackedTree::new(tiles.iter().map(|tile| (tile.min, tile.max)));
        Self { tiles, tree, by_id }
    }

    fn number_of(&self, id: TileId) -> Option<u32> {
        let tile = |number: &u32| self.tiles[*number as usize].id;
        let at = self.by_id.binary_search_by_key(&id, tile).ok()?;
        Some(self.by_id[at])
    }
}

impl SectionIndex {
    /// Of a section's tiles, each id once.
    pub fn new(tiles: &[Tile]) -> Self {
        let tiles = tiles.iter().map(|tile| Arc::new(IndexedTile::new(tile)));
        Self::pack(&tiles.collect::<Vec<_>>())
    }

    fn pack(tiles: &[Arc<IndexedTile>]) -> Self {
        Self {
            packed: Arc::new(Packed::new(tiles)),
            hidden: Vec::new(),
            recent: BTreeMap::new(),
        }
    }

    /// The index after these changes. Costs the changes, and now and then, when the square root of
    /// the number of tiles have changed, packing anew.
    #[must_use]
    pub fn updated<'t>(&self, updates: impl IntoIterator<Item = TileUpdate<'t>>) -> Self {
        let mut updated = self.clone();
        for update in updates {
            match update {
                TileUpdate::Put(tile) => updated.put(tile),
                TileUpdate::Remove(id) => updated.remove(id),
            }
        }
        if updated.hidden.len() + updated.recent.len() > updated.most_changes() {
            Self::pack(&updated.all().cloned().collect::<Vec<_>>())
        } else {
            updated
        }
    }

    /// Changes that are looked through one by one, before it is packed anew.
    pub(super) fn most_changes(&self) -> usize {
        64 + 4 * self.packed.tiles.len().isqrt()
    }

    fn get(&self, id: TileId) -> Option<&Arc<IndexedTile>> {
        self.recent.get(&id).or_else(|| {
            let number = self.packed.number_of(id)?;
            let counts = self.hidden.binary_search(&number).is_err();
            counts.then(|| &self.packed.tiles[number as usize])
        })
    }

    fn put(&mut self, tile: &Tile) {
        let known = self.get(tile.id).map(|known| known.revision);
        if known.is_none_or(|known| known < tile.revision) {
            self.remove(tile.id);
            let tile = Arc::new(IndexedTile::new(tile));
            self.recent.insert(tile.id, tile);
        }
    }

    fn remove(&mut self, id: TileId) {
        self.recent.remove(&id);
        if let Some(number) = self.packed.number_of(id)
            && let Err(at) = self.hidden.binary_search(&number)
        {
            self.hidden.insert(at, number);
        }
    }

    fn all(&self) -> impl Iterator<Item = &Arc<IndexedTile>> {
        let packed = (0..).zip(&self.packed.tiles);
        let packed = packed.filter(|(number, _)| self.hidden.binary_search(number).is_err());
        packed.map(|(_, tile)| tile).chain(self.recent.values())
    }

    /// The tiles of a channel whose bounds touch a rectangle of the section \[level-0 voxels\], by id.
    pub(in crate::stitched) fn near(
        &self,
        channel: u32,
        min: DVec2,
        max: DVec2,
    ) -> Vec<Arc<IndexedTile>> {
        self.found(min, max, |tile| tile.channel == channel)
    }

    fn found(
        &self,
        min: DVec2,
        max: DVec2,
        counts: impl Fn(&IndexedTile) -> bool,
    ) -> Vec<Arc<IndexedTile>> {
        let touches = |tile: &IndexedTile| counts(tile) && tile.touches(min, max);
        let mut found = Vec::new();
        self.packed.tree.touching(min, max, |number| {
            let tile = &self.packed.tiles[number];
            let hidden = || {
                let number =
                    u32::try_from(number).is_ok_and(|n| self.hidden.binary_search(&n).is_ok());
                !self.hidden.is_empty() && number
            };
            if touches(tile) && !hidden() {
                found.push(tile.clone());
            }
        });
        let recent = self.recent.values();
        found.extend(recent.filter(|tile| touches(tile)).cloned());
        found.sort_unstable_by_key(|tile| tile.id);
        found
    }

    /// The tiles of all channels whose bounds touch a rectangle, edges included, by id.
    pub fn touching(&self, min: SectionPoint, max: SectionPoint) -> Vec<TileId> {
        let found = self.found(min.0, max.0, |_| true);
        found.iter().map(|tile| tile.id).collect()
    }

    /// How many tiles it has.
    pub fn tiles(&self) -> usize {
        self.packed.tiles.len() - self.hidden.len() + self.recent.len()
    }

    /// Memory it takes, the tiles' included \[bytes\].
    pub fn bytes(&self) -> usize {
        let packed = &self.packed;
        let held = packed.tiles.iter().chain(self.recent.values());
        size_of::<Self>()
            + size_of::<Packed>()
            + size_of_val(&*packed.tiles)
            + size_of_val(&*packed.by_id)
            + packed.tree.bytes()
            + self.hidden.capacity() * size_of::<u32>()
            // A tree of maps is at least half full.
            + self.recent.len() * 2 * size_of::<(TileId, Arc<IndexedTile>)>()
            + held.map(|tile| tile.bytes()).sum::<usize>()
            + 8 * PER_ALLOCATION
    }
}

impl fmt::Debug for SectionIndex {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SectionIndex")
            .field("tiles", &self.tiles())
            .field("bytes", &self.bytes())
            .finish()
    }
}
