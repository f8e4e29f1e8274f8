use std::fmt::Debug;

use saccade_core::volume::Dtype;

use super::{float, line};
use line::Line;

/// A measured value: `u8` or `u16`.
pub trait Sample: sealed::Arithmetic {}

impl Sample for u8 {}
impl Sample for u16 {}

pub(in crate::stitched) mod sealed {
    use super::{Debug, Dtype, Line};

    /// What stitching does with values. 0 is none.
    pub trait Arithmetic: Copy + Ord + Default + Debug + Into<u16> + Send + Sync + 'static {
        const DTYPE: Dtype;
        const MOST: Self;

        /// A value that is known to fit.
        fn of(value: u16) -> Self;

        /// One less; of 0, the largest.
        fn before(self) -> Self;

        /// As a number.
        fn number(self) -> f32;

        /// Rounded half up, at least 1.
        fn rounded(number: f32) -> Self;

        /// From little-endian bytes.
        fn read(bytes: &[u8], to: &mut [Self]);

        /// To little-endian bytes.
        fn write(values: &[Self], to: &mut [u8]);

        /// Interpolates linearly along a line from its sample `skip` on, see [`super::line::interpolate`].
        #[allow(private_interfaces, reason = "the trait is sealed")]
        fn interpolate(values: &[Self], width: usize, line: Line, skip: usize, out: &mut [Self]);
    }
}

impl sealed::Arithmetic for u8 {
    const DTYPE: Dtype = Dtype::Uint8;
    const MOST: Self = Self::MAX;

    fn of(value: u16) -> Self {
        Self::try_from(value).unwrap_or(Self::MAX)
    }

    #[inline(always)]
    fn before(self) -> Self {
        self.wrapping_sub(1)
    }

    #[inline(always)]
    fn number(self) -> f32 {
        f32::from(self)
    }

    #[inline(always)]
    #[expect(
        clippy::cast_possible_truncation,
        reason = "what is too large becomes the largest"
    )]
    #[expect(clippy::cast_sign_loss, reason = "what is negative becomes 0, then 1")]
    fn rounded(number: f32) -> Self {
        ((number + 0.5) as Self).max(1)
    }

    fn read(bytes: &[u8], to: &mut [Self]) {
        to.copy_from_slice(bytes);
    }

    fn write(values: &[Self], to: &mut [u8]) {
        to.copy_from_slice(values);
    }

    #[allow(private_interfaces, reason = "the trait is sealed")]
    fn interpolate(values: &[Self], width: usize, line: Line, skip: usize, out: &mut [Self]) {
        line::interpolate(values, width, line, skip, out);
    }
}

impl sealed::Arithmetic for u16 {
    const DTYPE: Dtype = Dtype::Uint16;
    const MOST: Self = Self::MAX;

    fn of(value: u16) -> Self {
        value
    }

    #[inline(always)]
    fn before(self) -> Self {
        self.wrapping_sub(1)
    }

    #[inline(always)]
    fn number(self) -> f32 {
        f32::from(self)
    }

    #[inline(always)]
    #[expect(
        clippy::cast_possible_truncation,
        reason = "what is too large becomes the largest"
    )]
    #[expect(clippy::cast_sign_loss, reason = "what is negative becomes 0, then 1")]
    fn rounded(number: f32) -> Self {
        ((number + 0.5) as Self).max(1)
    }

    fn read(bytes: &[u8], to: &mut [Self]) {
        for (to, bytes) in to.iter_mut().zip(bytes.as_chunks().0) {
            *to = Self::from_le_bytes(*bytes);
        }
    }

    fn write(values: &[Self], to: &mut [u8]) {
        for (value, to) in values.iter().zip(to.as_chunks_mut().0) {
            *to = value.to_le_bytes();
        }
    }

    #[allow(private_interfaces, reason = "the trait is sealed")]
    fn interpolate(values: &[Self], width: usize, mut line: Line, skip: usize, out: &mut [Self]) {
        line.step(skip);
        float::linear(values, width, line, out);
    }
}
