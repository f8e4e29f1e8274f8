//! How finely the voxels of a plane are sampled.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::Arc;

use glam::{DVec2, UVec2};

use super::coverage::{Grid, Uncovered};
use super::index::IndexedTile;

/// Samples per axis that a voxel larger than any pixel is made of, at most: 2^4.
const FINEST: u32 = 4;

/// How many times voxels of `step` level-0 voxels must be halved to be like a pixel of the tile's
/// coarsest level.
pub(super) fn halvings(tile: &IndexedTile, step: DVec2) -> u32 {
    let coarser = tile
        .wanted_level(step)
        .saturating_sub(tile.coarsest_level());
    coarser.min(FINEST)
}

/// Voxels that are sampled alike.
pub(super) struct Layer {
    /// Of the whole plane; samples of voxels of other layers are none of its uncovered ones.
    pub(super) grid: Grid,
    /// Samples of a voxel along each axis.
    pub(super) by: u32,
    pub(super) uncovered: Uncovered,
}

impl Layer {
    fn new(whole: &Grid, halvings: u32, uncovered: impl FnOnce(&Grid) -> Uncovered) -> Self {
        let by = 1 << halvings;
        let grid = whole.finer(by);
        let uncovered = uncovered(&grid);
        Self {
            grid,
            by,
            uncovered,
        }
    }
}

/// The voxels of a plane by how finely they are sampled: as the first section needs that has a tile
/// there, and of its tiles there the one that needs most. So what a voxel is depends on no tile that
/// does not touch it.
pub(super) struct Layers {
    voxels: Grid,
    by_halvings: BTreeMap<u32, Layer>,
    /// The tiles looked at, as long as one layer does for all.
    alike: Vec<Vec<Arc<IndexedTile>>>,
    /// Of each voxel, if there are several layers, which is its own; none yet where no tile is.
    of_voxels: Option<Vec<Option<u32>>>,
}

impl Layers {
    /// Of a plane of voxels, on which no tile was seen yet.
    pub(super) fn new(voxels: Grid) -> Self {
        Self {
            voxels,
            by_halvings: BTreeMap::new(),
            alike: Vec::new(),
            of_voxels: None,
        }
    }

    /// Looks at the tiles of the next section, one at least.
    pub(super) fn look_at(&mut self, tiles: &[Arc<IndexedTile>]) {
        let step = self.voxels.step;
        let needed: BTreeSet<u32> = tiles.iter().map(|tile| halvings(tile, step)).collect();
        if self.by_halvings.is_empty()
            && let [halvings] = Vec::from_iter(&needed)[..]
        {
            let layer = Layer::new(&self.voxels, *halvings, Uncovered::all);
            self.by_halvings.insert(*halvings, layer);
        }
        let mut known = needed.iter().all(|n| self.by_halvings.contains_key(n));
        known &= self.of_voxels.is_none();
        if known {
            self.alike.push(tiles.to_vec());
            return;
        }
        let mut of_voxels = self.of_voxels.take().unwrap_or_else(|| self.divided());
        let claimed = claim(&self.voxels, &mut of_voxels, tiles);
        for halvings in needed {
            let layer = self.by_halvings.entry(halvings);
            let layer =
                layer.or_insert_with(|| Layer::new(&self.voxels, halvings, Uncovered::none));
            let own = |n: usize| claimed[n] == Some(halvings);
            for (row, run) in runs(self.voxels.size, own) {
                layer.uncovered.add(layer.by, row, run);
            }
        }
        self.of_voxels = Some(of_voxels);
    }

    /// Finds each voxel's layer, and takes those out of the only one on which no tile was.
    fn divided(&mut self) -> Vec<Option<u32>> {
        let voxels = self.voxels.size.as_usizevec2().element_product();
        let mut of_voxels = vec![None; voxels];
        for tiles in std::mem::take(&mut self.alike) {
            claim(&self.voxels, &mut of_voxels, &tiles);
        }
        for layer in self.by_halvings.values_mut() {
            for (row, run) in runs(self.voxels.size, |n| of_voxels[n].is_none()) {
                layer.uncovered.remove(layer.by, row, run);
            }
        }
        of_voxels
    }

    /// Takes a layer away to work on it.
    pub(super) fn take(&mut self, halvings: u32) -> Option<Layer> {
        self.by_halvings.remove(&halvings)
    }

    /// Puts a layer back.
    pub(super) fn put(&mut self, halvings: u32, layer: Layer) {
        self.by_halvings.insert(halvings, layer);
    }

    /// The layers, by how many times their voxels are halved.
    pub(super) fn halvings(&self) -> Vec<u32> {
        self.by_halvings.keys().copied().collect()
    }

    /// Whether nothing is left to be covered.
    pub(super) fn all_covered(&self) -> bool {
        let claimed = |of: &Vec<Option<u32>>| of.iter().all(Option::is_some);
        self.of_voxels.as_ref().is_none_or(claimed) && !self.by_halvings.is_empty() && {
            self.by_halvings.values()
        }
        .all(|layer| layer.uncovered.is_empty())
    }
}

/// Gives the voxels that have no layer yet the one that these tiles need; returns which it gave.
fn claim(
    grid: &Grid,
    of_voxels: &mut [Option<u32>],
    tiles: &[Arc<IndexedTile>],
) -> Vec<Option<u32>> {
    let mut needed: Vec<Option<u32>> = vec![None; of_voxels.len()];
    for tile in tiles {
        let halvings = Some(halvings(tile, grid.step));
        let (columns, rows) = touched(grid, tile);
        for row in rows {
            let first = row as usize * grid.size.x as usize;
            let of_row = first + columns.start as usize..first + columns.end as usize;
            for of_voxel in &mut needed[of_row] {
                *of_voxel = halvings.max(*of_voxel);
            }
        }
    }
    for (of_voxel, needed) in of_voxels.iter_mut().zip(&mut needed) {
        match of_voxel {
            Some(_) => *needed = None,
            None => *of_voxel = *needed,
        }
    }
    needed
}

/// Columns and rows of the voxels that a tile's bounds touch.
fn touched(grid: &Grid, tile: &IndexedTile) -> (Range<u32>, Range<u32>) {
    let first = grid.first.as_dvec2();
    let within = |v: DVec2| v.clamp(DVec2::ZERO, grid.size.as_dvec2()).as_uvec2();
    let min = within((tile.min / grid.step).floor() - first);
    let max = within((tile.max / grid.step).ceil() - first);
    (min.x..max.x, min.y..max.y)
}

/// Runs of voxels in rows, for which `own` says so of their number.
fn runs(size: UVec2, own: impl Fn(usize) -> bool) -> Vec<(u32, Range<u32>)> {
    let mut runs = Vec::new();
    for y in 0..size.y {
        let mut start = None;
        for x in 0..=size.x {
            let own = x < size.x && own(y as usize * size.x as usize + x as usize);
            match (own, start) {
                (true, None) => start = Some(x),
                (false, Some(first)) => {
                    runs.push((y, first..x));
                    start = None;
                }
                _ => {}
            }
        }
    }
    runs
}
