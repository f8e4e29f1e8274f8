//! How pixels of coarser levels come of finer ones.

use glam::UVec2;

use super::voxel::pixel::Pixel;
use super::{SUB_TILE_EDGE, SUB_TILE_VOXELS};

/// Edge of a sub-tile, as an index.
pub(super) const EDGE: usize = SUB_TILE_EDGE as usize;

/// Level of which one sub-tile, with all that it covers, is one thread's piece of work: a
/// megapixel, small enough to share out, and its sums stay in the processor's cache.
pub(super) const TASK_LEVEL: usize = 3;

/// A filter over the level-0 pixels that a coarser pixel covers, whatever lies between. Up to the
/// level after [`TASK_LEVEL`] it works in blocks of one sub-tile, above in planes of a whole level.
pub(super) trait Filter {
    /// What it filters.
    type Pixel: Pixel;
    /// What is known of the pixels of one sub-tile.
    type Block: Send;
    /// The same of a whole level.
    type Plane;

    /// Nothing is known yet.
    fn block() -> Self::Block;

    /// Forgets everything.
    fn clear(block: &mut Self::Block);

    /// Takes in a sub-tile of level 0 as a quadrant of its parent, of which `at` says which. `pixels`
    /// begins at the sub-tile's first; `width` and `height` of it exist.
    fn take_pixels(
        block: &mut Self::Block,
        at: UVec2,
        pixels: &[Self::Pixel],
        pitch: usize,
        size: (usize, usize),
    );

    /// Takes in a whole block of the finer level as a quadrant.
    fn take_block(block: &mut Self::Block, at: UVec2, finer: &Self::Block);

    /// The pixels of a block of `level`, `height` rows of `width`. `columns` and `rows` are the
    /// level-0 pixels that the last column and row cover.
    fn values(
        block: &Self::Block,
        level: usize,
        size: (usize, usize),
        covered: (u32, u32),
        to: &mut [Self::Pixel; SUB_TILE_VOXELS],
    );

    /// Nothing is known of a level of this size.
    fn plane(width: u32, height: u32) -> Self::Plane;

    /// Takes a quadrant of a block to its place in the plane of its level; `at` counts quadrants.
    fn put(plane: &mut Self::Plane, at: UVec2, block: Self::Block);

    /// The next level.
    fn halved(plane: Self::Plane) -> Self::Plane;

    /// The pixels of a level, row by row, of an image of `image` level-0 pixels.
    fn plane_values(plane: &Self::Plane, level: usize, image: (u32, u32)) -> Vec<Self::Pixel>;
}

/// Where quadrant (x, y) of a sub-tile begins.
pub(super) fn quadrant(at: UVec2) -> usize {
    ((at.y & 1) as usize * EDGE + (at.x & 1) as usize) * (EDGE / 2)
}

/// Level-0 pixels that pixel `at` of `level` covers, along an axis of `len` level-0 pixels.
pub(super) fn covered(at: u32, level: usize, len: u32) -> u32 {
    (len - (at << level)).min(1 << level)
}
