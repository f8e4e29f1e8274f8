//! Some values of an image, by which to choose how all of them are shown.

use glam::UVec3;
use saccade_core::voxel_box::VoxelBox;

use super::{ChunkMut, Place, copy};
use crate::values::{Number, Spread, Values};

/// Pieces and bytes that are looked at.
const MOST_PIECES: usize = 64;
const MOST_BYTES: usize = 64 << 20;

/// Boxes of a level whose pieces are looked at, of each of some channels; whether others are left. Pieces are of `piece` voxels
/// and `bytes_each` bytes.
pub(crate) fn sampled(
    extent: UVec3,
    piece: UVec3,
    bytes_each: usize,
    channels: u32,
) -> (Vec<VoxelBox>, bool) {
    let most = (MOST_BYTES / bytes_each.max(1)).clamp(1, MOST_PIECES) as u64;
    let most = (most / u64::from(channels.max(1))).max(1);
    let cells = extent.to_array().into_iter().zip(piece.to_array());
    let cells = cells.map(|(extent, piece)| u64::from(extent.div_ceil(piece.max(1))));
    if cells.fold(1_u64, u64::saturating_mul) <= most {
        return (vec![VoxelBox::of_size(extent)], false);
    }
    let per_axis = (1..=4_u32)
        .rev()
        .find(|n| u64::from(n.pow(3)) <= most)
        .unwrap_or(1);
    let middles = VoxelBox::of_size(UVec3::splat(per_axis));
    let boxes = middles.iter().map(|at| {
        let middle = (at.as_dvec3() + 0.5) / f64::from(per_axis) * extent.as_dvec3();
        let voxel = middle.as_uvec3().min(extent - 1);
        VoxelBox::new(voxel, voxel + 1)
    });
    (boxes.collect(), true)
}

/// The values seen so far.
#[derive(Debug)]
pub(crate) struct Sample {
    spread: Option<Spread>,
    /// Whether there may be others.
    partial: bool,
}

impl Sample {
    pub(crate) fn new(partial: bool) -> Self {
        Self {
            spread: None,
            partial,
        }
    }

    /// Adds the numbers that a piece has in its place.
    pub(crate) fn add(&mut self, stored: &[u8], place: &Place, number: Number, big_endian: bool) {
        let (size, width) = (place.voxels.size(), number.bytes());
        let mut inside = vec![0; size.as_usizevec3().element_product() * width];
        let mut all = ChunkMut {
            bytes: &mut inside,
            size,
            width,
            begin: UVec3::ZERO,
        };
        copy(stored, place, place.voxels, &mut all);
        if let Some(new) = Spread::of(number, big_endian, &inside) {
            self.widen(new);
        }
    }

    fn widen(&mut self, new: Spread) {
        self.spread = Some(self.spread.map_or(new, |spread| spread.with(new)));
    }

    /// What to make of such numbers. What the image declares of its values counts where it is not far wider than those
    /// that were seen; floating-point values are given room where not all were.
    pub(crate) fn values(
        mut self,
        number: Number,
        big_endian: bool,
        declared: impl Iterator<Item = [f64; 2]>,
    ) -> Values {
        if let Some(Spread::Real { min, max }) = self.spread {
            let largest = match number {
                Number::F32 => f64::from(f32::MAX),
                _ => f64::MAX,
            };
            let within = |min: f64, max: f64| Spread::Real {
                min: min.clamp(-largest, largest),
                max: max.clamp(-largest, largest),
            };
            // Half of it: all of it may be more than any number is.
            let half = max / 2.0 - min / 2.0;
            for [low, high] in declared {
                if high / 2.0 - low / 2.0 <= 8.0 * half {
                    self.widen(within(low, high));
                }
            }
            if self.partial {
                // Averages and samples have less extreme values.
                let low = if min >= 0.0 {
                    (min - half).max(0.0)
                } else {
                    min - half
                };
                self.widen(within(low, max + half));
            }
        }
        Values::fitted(number, big_endian, self.spread)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Room for what was not seen is no more than there are numbers.
    #[test]
    fn the_largest_numbers_have_no_infinite_window() {
        let largest = f64::from(f32::MAX);
        for (number, min, max) in [
            (Number::F64, f64::MIN, f64::MAX),
            (Number::F64, 1e307, 1.7e308),
            (Number::F32, -largest, largest),
        ] {
            let mut sample = Sample::new(true);
            sample.widen(Spread::Real { min, max });
            let declared = [[0.0, 1.0], [f64::MIN, f64::MAX]];
            let values = sample.values(number, false, declared.into_iter());
            let note = values.note().unwrap();
            assert!(!note.contains("inf "), "{note}");
            assert_eq!(note.contains("from -3.4"), number == Number::F32, "{note}");
            let (factor, shift) = values.scale();
            assert!(factor > 0.0 && shift.is_finite(), "{note}");
        }
    }

    #[test]
    fn small_levels_are_looked_at_wholly_and_large_ones_here_and_there() {
        let small = sampled(UVec3::new(100, 90, 9), UVec3::splat(64), 1 << 18, 2);
        assert_eq!(
            small,
            (vec![VoxelBox::of_size(UVec3::new(100, 90, 9))], false)
        );
        let extent = UVec3::new(1 << 20, 3, 1 << 19);
        let (boxes, partial) = sampled(extent, UVec3::ONE, 4, 1);
        assert!(partial && boxes.len() == 64);
        let whole = VoxelBox::of_size(extent);
        assert!(
            boxes
                .iter()
                .all(|b| b.voxels() == 1 && whole.contains(b.min))
        );
        assert_eq!(sampled(extent, UVec3::splat(512), 1 << 30, 9).0.len(), 1);
    }
}
