//! Samples a tile from a section by its true transform.

use std::ops::Range;

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
        // Samples in here have four neighbours in the part, whatever rounding does.
        let last = UVec2::new(self.image.width, self.image.height).as_dvec2() - 2.0;
        let inner = within(start, step, DVec2::splat(0.001), last - 0.001, row.len());
        let (before, rest) = row.split_at_mut(inner.start);
        let (inside, after) = rest.split_at_mut(inner.len());
        self.sample_anywhere(start, step, before);
        self.sample_inside(start + step * inner.start as f64, step, inside);
        self.sample_anywhere(start + step * inner.end as f64, step, after);
    }

    /// Of samples that all have four neighbours.
    fn sample_inside(&self, start: DVec2, step: DVec2, row: &mut [u8]) {
        #[expect(
            clippy::cast_possible_truncation,
            reason = "an edge fits 32 bits; what is less than a 2^32nd of a voxel does not show"
        )]
        let fixed = |at: f64| (at * FIXED) as i64;
        let (mut x, mut y) = (fixed(start.x), fixed(start.y));
        let (dx, dy) = (fixed(step.x), fixed(step.y));
        let (width, voxels) = (self.image.width as usize, &self.image.voxels[..]);
        for value in row {
            let at = (y >> 32) as usize * width + (x >> 32) as usize;
            let (u, v) = (share(x), share(y));
            let (above, below) = (&voxels[at..at + 2], &voxels[at + width..at + width + 2]);
            let along = |pair: &[u8]| u32::from(pair[0]) * (ONE - u) + u32::from(pair[1]) * u;
            // At most 255 * 2^24 + 2^23.
            let sum = along(above) * (ONE - v) + along(below) * v + ONE * ONE / 2;
            *value = sum.to_be_bytes()[0];
            x += dx;
            y += dy;
        }
    }

    /// Of samples that may lie beyond the part, whose edges are replicated.
    fn sample_anywhere(&self, start: DVec2, step: DVec2, row: &mut [u8]) {
        let size = UVec2::new(self.image.width, self.image.height);
        let (width, voxels) = (size.x as usize, &self.image.voxels);
        let last = size.as_dvec2() - 1.0;
        for (x, value) in row.iter_mut().enumerate() {
            let at = start + step * x as f64;
            let clamped = at.clamp(DVec2::ZERO, last);
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

/// What positions are counted in \[voxels^-1\].
const FIXED: f64 = 4_294_967_296.0;
/// What shares of a voxel are counted in: their product, of 24 bits, leaves 8 for the value.
const ONE: u32 = 1 << 12;

/// How far a position is from its voxel to the next.
fn share(at: i64) -> u32 {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "the lower half is what is meant"
    )]
    let fraction = at as u32;
    fraction >> 20
}

/// Which of `len` samples lie between `low` and `high` on both axes: a part of the line without gaps.
fn within(start: DVec2, step: DVec2, low: DVec2, high: DVec2, len: usize) -> Range<usize> {
    let (mut first, mut end) = (0.0_f64, len as f64);
    for axis in 0..2 {
        let (start, step) = (start[axis], step[axis]);
        let (low, high) = (low[axis], high[axis]);
        if step == 0.0 {
            if !(low..=high).contains(&start) {
                return 0..0;
            }
            continue;
        }
        let (a, b) = ((low - start) / step, (high - start) / step);
        first = first.max(a.min(b).ceil());
        end = end.min(a.max(b).floor() + 1.0);
    }
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "between 0 and the length of a row"
    )]
    let (first, end) = (first as usize, end.max(0.0) as usize);
    if first < end { first..end } else { 0..0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inside_is_as_anywhere() {
        let (width, height) = (37, 29);
        let voxels = (0..width * height).map(|n: u32| n.wrapping_mul(0x9e37_79b9).to_be_bytes()[0]);
        let part = Part {
            min: UVec2::new(5, 7),
            image: GrayImage::new(width, height, voxels.collect()),
        };
        let (mut differ, mut inside) = (0, 0);
        for n in 0..500 {
            let angle = f64::from(n) * 0.37;
            let step = DVec2::from_angle(angle) * (0.3 + f64::from(n % 7) * 0.4);
            let start = DVec2::new(f64::from(n * 17 % 60) - 9.3, f64::from(n * 23 % 50) - 8.8);
            let (mut fast, mut slow) = ([0; 61], [0; 61]);
            part.sample(start, step, &mut fast);
            part.sample_anywhere(start - 0.5 - part.min.as_dvec2(), step, &mut slow);
            for (fast, slow) in fast.into_iter().zip(slow) {
                assert!(fast.abs_diff(slow) <= 1, "{fast} for {slow}, line {n}");
                differ += u32::from(fast != slow);
            }
            let last = DVec2::new(f64::from(width), f64::from(height)) - 2.0;
            inside += within(
                start - 0.5 - part.min.as_dvec2(),
                step,
                DVec2::ZERO,
                last,
                61,
            )
            .len();
        }
        assert!(
            differ < 200 && inside > 4_000,
            "{differ} of {inside} differ"
        );
    }
}
