//! The types of voxels that a pyramid can hold.

use std::fmt::Debug;

use saccade_core::volume::Dtype;

/// A voxel's type: `u8` or `u16`.
pub trait Voxel: pixel::Pixel {}

impl Voxel for u8 {}
impl Voxel for u16 {}

pub(crate) mod pixel {
    use bytemuck::Pod;

    use super::{Debug, Dtype};

    /// What pyramids do with voxels. Additions wrap: sums are of a width that holds them, and checks
    /// would keep the vector unit idle.
    pub trait Pixel: Copy + Ord + Default + Debug + Pod + Send + Sync + 'static {
        /// Its name in descriptions.
        const DTYPE: Dtype;

        /// Holds sums of 256 values: of levels up to 4.
        type Sum: Copy + Default + Debug + Into<u64> + Send + Sync;

        /// Sum of two neighbours.
        fn sum_of_pair(pair: [Self; 2]) -> Self::Sum;

        /// The value as a sum.
        fn sum(self) -> Self::Sum;

        /// Sum of two sums.
        fn add(a: Self::Sum, b: Self::Sum) -> Self::Sum;

        /// The mean of 4^level values, rounded half up.
        fn mean_of_box(sum: Self::Sum, level: usize) -> Self;

        /// A value that is known to fit.
        fn from_wide(value: u64) -> Self;

        /// The value.
        fn value(self) -> u16;

        /// The voxels as bytes, if each is one.
        fn bytes(voxels: &[Self]) -> Option<&[u8]>;

        /// Differences of a row's neighbours, little-endian; the first as it is.
        fn differences(row: &[Self], to: &mut [u8]);
    }

    impl Pixel for u8 {
        const DTYPE: Dtype = Dtype::Uint8;
        type Sum = u16;

        // Two neighbours are one 16-bit word: its bytes are added without moving any.
        fn sum_of_pair(pair: [Self; 2]) -> u16 {
            let word = u16::from_le_bytes(pair);
            (word & 0xff).wrapping_add(word >> 8)
        }

        fn sum(self) -> u16 {
            self.into()
        }

        fn add(a: u16, b: u16) -> u16 {
            a.wrapping_add(b)
        }

        #[expect(
            clippy::cast_possible_truncation,
            reason = "the mean of bytes is a byte"
        )]
        fn mean_of_box(sum: u16, level: usize) -> Self {
            (sum.wrapping_add(1 << (2 * level - 1)) >> (2 * level)) as Self
        }

        #[expect(clippy::cast_possible_truncation, reason = "it is known to fit")]
        fn from_wide(value: u64) -> Self {
            value as Self
        }

        fn value(self) -> u16 {
            self.into()
        }

        fn bytes(voxels: &[Self]) -> Option<&[u8]> {
            Some(voxels)
        }

        fn differences(row: &[Self], to: &mut [u8]) {
            to[0] = row[0];
            for (to, pair) in to[1..].iter_mut().zip(row.windows(2)) {
                *to = pair[1].wrapping_sub(pair[0]);
            }
        }
    }

    impl Pixel for u16 {
        const DTYPE: Dtype = Dtype::Uint16;
        type Sum = u32;

        fn sum_of_pair([a, b]: [Self; 2]) -> u32 {
            u32::from(a).wrapping_add(u32::from(b))
        }

        fn sum(self) -> u32 {
            self.into()
        }

        fn add(a: u32, b: u32) -> u32 {
            a.wrapping_add(b)
        }

        #[expect(
            clippy::cast_possible_truncation,
            reason = "the mean of 16 bits has 16 bits"
        )]
        fn mean_of_box(sum: u32, level: usize) -> Self {
            (sum.wrapping_add(1 << (2 * level - 1)) >> (2 * level)) as Self
        }

        #[expect(clippy::cast_possible_truncation, reason = "it is known to fit")]
        fn from_wide(value: u64) -> Self {
            value as Self
        }

        fn value(self) -> u16 {
            self
        }

        fn bytes(_: &[Self]) -> Option<&[u8]> {
            None
        }

        fn differences(row: &[Self], to: &mut [u8]) {
            let (to, _) = to.as_chunks_mut::<2>();
            to[0] = row[0].to_le_bytes();
            for (to, pair) in to[1..].iter_mut().zip(row.windows(2)) {
                *to = pair[1].wrapping_sub(pair[0]).to_le_bytes();
            }
        }
    }
}
