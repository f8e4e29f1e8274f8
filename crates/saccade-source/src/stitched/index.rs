//! Which tiles of a section lie where.

use std::ops::Range;

use glam::{DVec2, UVec2};
use saccade_archive::catalog::{Tile, TileId};
use saccade_archive::pyramid::levels_of;
use saccade_core::transform::{SectionPoint, TileFromSection, TilePoint};

/// A tile as the stitcher needs it.
#[derive(Clone, Debug)]
pub(super) struct IndexedTile {
    pub(super) id: TileId,
    pub(super) revision: u64,
    pub(super) section: u32,
    /// Pixels of level 0.
    pub(super) size: UVec2,
    pub(super) pyramid: Box<str>,
    pub(super) tile_from_section: TileFromSection,
    /// In the section \[level-0 voxels\].
    pub(super) centre: DVec2,
    /// In the section \[level-0 voxels\].
    pub(super) min: DVec2,
    pub(super) max: DVec2,
}

impl IndexedTile {
    fn new(tile: &Tile) -> Self {
        let size = tile.size.as_dvec2();
        let (min, max) = tile.transform.bounds(size);
        Self {
            id: tile.id,
            revision: tile.revision,
            section: tile.section,
            size: tile.size,
            pyramid: tile.pyramid.as_str().into(),
            tile_from_section: tile.transform.tile_from_section(),
            centre: tile.transform.apply(TilePoint(size / 2.0)).0,
            min: min.0,
            max: max.0,
        }
    }

    /// The position in the tile \[pixels of level 0\] of a position in the section.
    pub(super) fn position(&self, point: DVec2) -> DVec2 {
        self.tile_from_section.apply(SectionPoint(point)).0
    }

    /// Whether a position in the tile is inside its rectangle.
    pub(super) fn contains(&self, position: DVec2) -> bool {
        position.cmpge(DVec2::ZERO).all() && position.cmplt(self.size.as_dvec2()).all()
    }

    /// The pyramid level whose pixels are most like a sample of `step` level-0 voxels in size,
    /// coarser ones than there are included.
    pub(super) fn wanted_level(&self, step: DVec2) -> u32 {
        let (x, y) = (
            self.tile_from_section.along_x(),
            self.tile_from_section.along_y(),
        );
        let pixels = (x.perp_dot(y) * step.x * step.y).abs().sqrt();
        let level = pixels.log2().round();
        // In 0..=64 for every size that is not absurd.
        #[expect(
            clippy::cast_possible_truncation,
            reason = "clamped to small whole numbers; not-a-number becomes 0"
        )]
        let level = level.clamp(0.0, 64.0) as u32;
        level
    }

    /// The coarsest level its pyramid has.
    pub(super) fn coarsest_level(&self) -> u32 {
        let levels = levels_of(self.size.x, self.size.y).len();
        u32::try_from(levels).map_or(0, |levels| levels.saturating_sub(1))
    }
}

/// The tiles of one section on a coarse grid of cells, each of which lists the tiles it touches.
pub struct SectionIndex {
    tiles: Vec<IndexedTile>,
    /// Low corner of cell 0 \[level-0 voxels\].
    origin: DVec2,
    cell: DVec2,
    cells: UVec2,
    /// Where each cell's tiles begin in `listed`; one more than there are cells.
    starts: Vec<u32>,
    listed: Vec<u32>,
}

impl SectionIndex {
    /// Of a section's tiles.
    pub fn new(tiles: &[Tile]) -> Self {
        let tiles: Vec<_> = tiles.iter().map(IndexedTile::new).collect();
        let min = tiles.iter().fold(DVec2::INFINITY, |m, t| m.min(t.min));
        let max = tiles.iter().fold(DVec2::NEG_INFINITY, |m, t| m.max(t.max));
        let count = u32::try_from(tiles.len()).expect("sections have fewer than 4 G tiles");
        let mean = tiles.iter().fold(DVec2::ZERO, |s, t| s + (t.max - t.min));
        let mean = mean / f64::from(count.max(1));
        let mut index = Self {
            cells: UVec2::ONE,
            origin: min,
            cell: DVec2::ONE,
            starts: Vec::new(),
            listed: Vec::new(),
            tiles,
        };
        if count > 0 {
            // Cells as large as tiles, but never many more cells than tiles.
            let at_most = f64::from(count).sqrt().ceil() * 2.0;
            let cells = ((max - min) / mean)
                .ceil()
                .clamp(DVec2::ONE, DVec2::splat(at_most));
            index.cells = cells.as_uvec2();
            index.cell = (max - min) / cells;
        }
        index.list();
        index
    }

    fn list(&mut self) {
        let mut pairs: Vec<(u32, u32)> = Vec::new();
        for (tile, n) in self.tiles.iter().zip(0..) {
            let cells = self.touched(tile.min, tile.max);
            pairs.extend(cells.map(|cell| (cell, n)));
        }
        pairs.sort_unstable();
        let count = self.cells.x * self.cells.y;
        let first = |cell| pairs.partition_point(|p| p.0 < cell);
        let starts = (0..=count).map(|cell| u32::try_from(first(cell)));
        let starts: Result<_, _> = starts.collect();
        self.starts = starts.expect("tiles touch few cells each");
        self.listed = pairs.iter().map(|p| p.1).collect();
    }

    /// Numbers of the cells that a rectangle touches.
    fn touched(&self, min: DVec2, max: DVec2) -> impl Iterator<Item = u32> + use<> {
        let last = self.cells - 1;
        let cell = |p: DVec2| ((p - self.origin) / self.cell).floor().max(DVec2::ZERO);
        // `as` saturates and then `min` cuts.
        let (first, end) = (
            cell(min).as_uvec2().min(last),
            cell(max).as_uvec2().min(last),
        );
        let width = self.cells.x;
        (first.y..=end.y).flat_map(move |y| (first.x..=end.x).map(move |x| y * width + x))
    }

    /// The tiles whose bounds touch a rectangle of the section \[level-0 voxels\], by id.
    pub(super) fn touching(&self, min: DVec2, max: DVec2) -> Vec<&IndexedTile> {
        if self.tiles.is_empty() {
            return Vec::new();
        }
        let range = |cell: u32| -> Range<usize> {
            let cell = cell as usize;
            self.starts[cell] as usize..self.starts[cell + 1] as usize
        };
        let cells = self.touched(min, max);
        let listed = cells.flat_map(|cell| self.listed[range(cell)].iter().copied());
        let mut numbers: Vec<u32> = listed.collect();
        numbers.sort_unstable();
        numbers.dedup();
        let tiles = numbers.iter().map(|n| &self.tiles[*n as usize]);
        let touching = |t: &&IndexedTile| t.min.cmple(max).all() && t.max.cmpge(min).all();
        tiles.filter(touching).collect()
    }

    /// How many tiles it has.
    pub fn tiles(&self) -> usize {
        self.tiles.len()
    }

    /// Memory it takes \[bytes\].
    pub fn memory(&self) -> usize {
        let names: usize = self.tiles.iter().map(|t| t.pyramid.len() + 16).sum();
        size_of::<Self>()
            + names
            + self.tiles.capacity() * size_of::<IndexedTile>()
            + (self.starts.capacity() + self.listed.capacity()) * size_of::<u32>()
    }
}

#[cfg(test)]
#[allow(clippy::cast_possible_truncation, reason = "test volumes are small")]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use saccade_core::transform::SectionFromTile;

    fn tile(n: usize, size: UVec2, turn: f64, corner: DVec2) -> Tile {
        Tile {
            id: TileId(i64::try_from(n).unwrap()),
            name: format!("section0003_tile{n:06}"),
            section: 3,
            size,
            transform: SectionFromTile::rotated(size.as_dvec2(), turn, corner),
            pyramid: format!("tiles/section0003/section0003_tile{n:06}-0123456789abcdef.tif"),
            revision: 1,
        }
    }

    fn tiles() -> impl Strategy<Value = Vec<Tile>> {
        let one = (
            1..300_u32,
            1..300_u32,
            -3.0..3.0,
            -900.0..900.0,
            -900.0..900.0,
        );
        prop::collection::vec(one, 0..40).prop_map(|all| {
            let tiles = all.into_iter().enumerate();
            let tiles = tiles
                .map(|(n, (w, h, turn, x, y))| tile(n, UVec2::new(w, h), turn, DVec2::new(x, y)));
            tiles.collect()
        })
    }

    proptest! {
        #[test]
        fn finds_what_a_search_through_all_finds(
            tiles in tiles(),
            x in -1000.0..1000.0, y in -1000.0..1000.0, w in 0.0..500.0, h in 0.0..500.0,
        ) {
            let (min, max) = (DVec2::new(x, y), DVec2::new(x + w, y + h));
            let index = SectionIndex::new(&tiles);
            let found: Vec<_> = index.touching(min, max).iter().map(|t| t.id).collect();
            let all = tiles.iter().filter(|tile| {
                let (low, high) = tile.transform.bounds(tile.size.as_dvec2());
                low.0.x <= max.x && low.0.y <= max.y && high.0.x >= min.x && high.0.y >= min.y
            });
            let all: Vec<_> = all.map(|t| t.id).collect();
            prop_assert_eq!(found, all);
        }
    }

    #[test]
    fn is_small() {
        for side in [10, 108] {
            let grid = (0..side).flat_map(|y| (0..side).map(move |x| (x, y)));
            let tiles: Vec<_> = grid
                .map(|(x, y)| {
                    let corner = DVec2::new(f64::from(x), f64::from(y)) * 11_000.0;
                    tile((y * side + x) as usize, UVec2::splat(12_000), 0.02, corner)
                })
                .collect();
            let bytes = SectionIndex::new(&tiles).memory() / tiles.len();
            assert!(bytes < 1200, "{bytes} bytes per tile");
        }
    }

    #[test]
    fn one_tile_far_out_costs_nothing() {
        let near = (0..50).map(|n| tile(n, UVec2::splat(100), 0.0, DVec2::splat(90.0 * n as f64)));
        let far = tile(50, UVec2::splat(100), 0.0, DVec2::splat(1e15));
        let tiles: Vec<_> = near.chain([far]).collect();
        assert!(SectionIndex::new(&tiles).memory() / tiles.len() < 1200);
    }
}
