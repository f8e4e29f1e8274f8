//! Samples a tile from a section by its true transform.

use glam::{DVec2, UVec2};
use rayon::prelude::*;
use saccade_archive::image::GrayImage;
use saccade_core::transform::TilePoint;

use super::PlannedTile;
use super::stack::{Stack, StackError};

/// The tile's image: bilinear, edges of the section replicated beyond it.
///
/// # Errors
///
/// [`StackError`].
pub fn cut(stack: &dyn Stack, tile: &PlannedTile) -> Result<GrayImage, StackError> {
    let extent = stack.info().extent.truncate();
    let (low, high) = tile.truth.bounds(tile.size.as_dvec2());
    // One voxel more on each side for the interpolation; at least one where the tile is outside.
    let last = extent - 1;
    let min = (low.0 - 1.0).floor().as_uvec2().min(last);
    let max = ((high.0 + 1.0).ceil().as_uvec2()).clamp(min + 1, extent);
    let part = Part {
        min,
        image: stack.region(tile.section, min, max - min)?,
    };

    let width = tile.size.x as usize;
    let mut voxels = vec![0; width * tile.size.y as usize];
    let along_x =
        tile.truth.apply(TilePoint(DVec2::X)).0 - tile.truth.apply(TilePoint(DVec2::ZERO)).0;
    let rows = voxels.par_chunks_mut(width).with_min_len(16).enumerate();
    rows.for_each(|(y, row)| {
        let start = tile
            .truth
            .apply(TilePoint(DVec2::new(0.5, y as f64 + 0.5)))
            .0;
        part.sample(start, along_x, row);
    });
    Ok(GrayImage::new(tile.size.x, tile.size.y, voxels))
}

/// A part of a section.
struct Part {
    min: UVec2,
    image: GrayImage,
}

impl Part {
    /// Samples at `start`, `start + step`, .. \[voxels of the section\].
    fn sample(&self, start: DVec2, step: DVec2, row: &mut [u8]) {
        // Samples sit in the middle of voxels.
        let start = start - 0.5 - self.min.as_dvec2();
        let size = UVec2::new(self.image.width, self.image.height);
        let (width, voxels) = (size.x as usize, &self.image.voxels);
        // Below this a sample has four neighbours in the part.
        let inner = size.as_dvec2() - 1.0;
        for (x, value) in row.iter_mut().enumerate() {
            let at = start + step * x as f64;
            let clamped = at.clamp(DVec2::ZERO, inner);
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "clamped to the image, whose edges fit 32 bits"
            )]
            let (column, line) = (clamped.x as usize, clamped.y as usize);
            #[expect(clippy::cast_possible_truncation, reason = "shares of one voxel")]
            let (u, v) = (
                (clamped.x - column as f64) as f32,
                (clamped.y - line as f64) as f32,
            );
            let right = usize::from(column + 1 < width);
            let below = if line + 1 < size.y as usize { width } else { 0 };
            let at = line * width + column;
            let read = |offset: usize| f32::from(voxels[at + offset]);
            let top = read(0) + (read(right) - read(0)) * u;
            let bottom = read(below) + (read(below + right) - read(below)) * u;
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "a mean of four u8 stays in the range of u8"
            )]
            let rounded = (top + (bottom - top) * v + 0.5) as u8;
            *value = rounded;
        }
    }
}
