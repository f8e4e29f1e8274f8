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
    pub trait Arithmetic:
        Copy + Ord + Default + Debug + Into<u16> + Kept<Self> + Send + Sync + 'static
    {
        const DTYPE: Dtype;
        const MOST: Self;
        /// A value with [`FINE_BITS`] bits after the point, of which means are taken.
        type Fine: Kept<Self> + Into<u32> + PartialEq + Debug + Send + Sync + 'static;

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
    }

    /// As what a sample of pixels `S` is kept: rounded, or finely. 0 is none.
    pub trait Kept<S>: Copy + Default {
        /// A pixel's value.
        fn of_pixel(value: S) -> Self;

        /// Rounded half up, at least 1.
        fn of_number(number: f32) -> Self;

        /// Interpolates linearly along a line from its sample `skip` on, see [`super::line::interpolate`].
        #[allow(private_interfaces, reason = "the trait is sealed")]
        fn interpolate(values: &[S], width: usize, line: Line, skip: usize, out: &mut [Self]);
    }
}

/// Bits after the point of values of which means are taken: they are rounded once, in the end.
pub(in crate::stitched) const FINE_BITS: u32 = 8;

/// What is as much as 1.
const FINE_ONE: u16 = 1 << FINE_BITS;

/// A fine value as a number.
#[expect(
    clippy::cast_precision_loss,
    reason = "they have 24 bits, as numbers have"
)]
pub(in crate::stitched) fn fine_number(value: impl Into<u32>) -> f32 {
    value.into() as f32 / f32::from(FINE_ONE)
}

impl sealed::Arithmetic for u8 {
    const DTYPE: Dtype = Dtype::Uint8;
    const MOST: Self = Self::MAX;
    type Fine = u16;

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
}

impl sealed::Kept<Self> for u8 {
    #[inline(always)]
    fn of_pixel(value: Self) -> Self {
        value
    }

    #[inline(always)]
    fn of_number(number: f32) -> Self {
        sealed::Arithmetic::rounded(number)
    }

    #[allow(private_interfaces, reason = "the trait is sealed")]
    fn interpolate(values: &[Self], width: usize, line: Line, skip: usize, out: &mut [Self]) {
        line::interpolate(values, width, line, skip, out);
    }
}

impl sealed::Kept<u8> for u16 {
    #[inline(always)]
    fn of_pixel(value: u8) -> Self {
        Self::from(value) << FINE_BITS
    }

    #[inline(always)]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "what is too large becomes the largest, what is negative becomes 1"
    )]
    fn of_number(number: f32) -> Self {
        let most = Self::of_pixel(u8::MAX);
        ((number * f32::from(FINE_ONE) + 0.5) as Self).clamp(FINE_ONE, most)
    }

    #[allow(private_interfaces, reason = "the trait is sealed")]
    fn interpolate(values: &[u8], width: usize, line: Line, skip: usize, out: &mut [Self]) {
        line::interpolate(values, width, line, skip, out);
    }
}

impl sealed::Arithmetic for u16 {
    const DTYPE: Dtype = Dtype::Uint16;
    const MOST: Self = Self::MAX;
    type Fine = u32;

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
}

impl sealed::Kept<Self> for u16 {
    #[inline(always)]
    fn of_pixel(value: Self) -> Self {
        value
    }

    #[inline(always)]
    fn of_number(number: f32) -> Self {
        sealed::Arithmetic::rounded(number)
    }

    #[allow(private_interfaces, reason = "the trait is sealed")]
    fn interpolate(values: &[Self], width: usize, mut line: Line, skip: usize, out: &mut [Self]) {
        line.step(skip);
        float::linear(values, width, line, out);
    }
}

impl sealed::Kept<u16> for u32 {
    #[inline(always)]
    fn of_pixel(value: u16) -> Self {
        Self::from(value) << FINE_BITS
    }

    #[inline(always)]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "what is too large becomes the largest, what is negative becomes 1"
    )]
    fn of_number(number: f32) -> Self {
        let most = Self::of_pixel(u16::MAX);
        ((number * f32::from(FINE_ONE) + 0.5) as Self).clamp(FINE_ONE.into(), most)
    }

    #[allow(private_interfaces, reason = "the trait is sealed")]
    fn interpolate(values: &[u16], width: usize, mut line: Line, skip: usize, out: &mut [Self]) {
        line.step(skip);
        float::linear(values, width, line, out);
    }
}
