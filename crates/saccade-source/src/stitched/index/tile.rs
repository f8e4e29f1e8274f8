use glam::{DVec2, UVec2};
use saccade_archive::catalog::{Tile, TileId};
use saccade_archive::pyramid::levels_of;
use saccade_core::transform::{SectionPoint, TileFromSection, TilePoint};

/// What an allocation takes beside its bytes, about.
pub(super) const PER_ALLOCATION: usize = 16;

/// A tile as the stitcher needs it.
#[derive(Clone, Debug)]
pub(in crate::stitched) struct IndexedTile {
    pub(in crate::stitched) id: TileId,
    pub(in crate::stitched) revision: u64,
    /// Position of its image's record: which of two images is newer.
    pub(in crate::stitched) recorded: u64,
    pub(in crate::stitched) section: u32,
    pub(in crate::stitched) channel: u32,
    /// Pixels of level 0.
    pub(in crate::stitched) size: UVec2,
    pub(in crate::stitched) pyramid: Box<str>,
    pub(in crate::stitched) tile_from_section: TileFromSection,
    /// In the section \[level-0 voxels\].
    pub(in crate::stitched) centre: DVec2,
    /// In the section \[level-0 voxels\].
    pub(in crate::stitched) min: DVec2,
    /// In the section \[level-0 voxels\].
    pub(in crate::stitched) max: DVec2,
}

impl IndexedTile {
    pub(super) fn new(tile: &Tile) -> Self {
        let size = tile.size.as_dvec2();
        let (min, max) = tile.transform.bounds(size);
        Self {
            id: tile.id,
            revision: tile.revision,
            recorded: tile.position,
            section: tile.section,
            channel: tile.channel,
            size: tile.size,
            pyramid: tile.pyramid.as_str().into(),
            tile_from_section: tile.transform.tile_from_section(),
            centre: tile.transform.apply(TilePoint(size / 2.0)).0,
            min: min.0,
            max: max.0,
        }
    }

    /// Pixels of level 0 in a level-0 voxel.
    pub(in crate::stitched) fn pixels_per_voxel(&self) -> f64 {
        let (x, y) = (
            self.tile_from_section.along_x(),
            self.tile_from_section.along_y(),
        );
        x.perp_dot(y).abs()
    }

    /// What tells it from all others of its volume, the newer image's larger. Who enters an acquisition once more, with other
    /// workers or in other steps, gets the same order.
    pub(in crate::stitched) fn age(&self) -> (u64, TileId) {
        (self.recorded, self.id)
    }

    /// The position in the tile \[pixels of level 0\] of a position in the section.
    pub(in crate::stitched) fn position(&self, point: DVec2) -> DVec2 {
        self.tile_from_section.apply(SectionPoint(point)).0
    }

    /// Whether a position in the tile is inside its rectangle.
    pub(in crate::stitched) fn contains(&self, position: DVec2) -> bool {
        position.cmpge(DVec2::ZERO).all() && position.cmplt(self.size.as_dvec2()).all()
    }

    /// Whether its bounds touch a rectangle of the section.
    pub(super) fn touches(&self, min: DVec2, max: DVec2) -> bool {
        self.min.cmple(max).all() && self.max.cmpge(min).all()
    }

    /// The pyramid level whose pixels are most like a sample of `step` level-0 voxels in size,
    /// coarser ones than there are included.
    pub(in crate::stitched) fn wanted_level(&self, step: DVec2) -> u32 {
        let pixels = (self.pixels_per_voxel() * step.x * step.y).abs().sqrt();
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
    pub(in crate::stitched) fn coarsest_level(&self) -> u32 {
        let levels = levels_of(self.size.x, self.size.y).len();
        u32::try_from(levels).map_or(0, |levels| levels.saturating_sub(1))
    }

    /// Memory it takes on the heap, shared by count \[bytes\].
    pub(super) fn bytes(&self) -> usize {
        let counts = 2 * size_of::<usize>();
        size_of::<Self>() + counts + self.pyramid.len() + 2 * PER_ALLOCATION
    }
}
