//! Bilinear interpolation with 32-byte registers, where the processor has them (AVX2).
//!
//! The same arithmetic as [`super::line`], which serves all other processors and is the oracle of
//! this: they agree bit for bit.
//!
//! Sixteen neighbouring samples of a turned tile touch few rows, and of each row few neighbouring
//! pixels. Each row is loaded once, its pixels are shuffled to the samples that lie right of them,
//! and every sample keeps those of its own two rows. Where sixteen samples touch many rows, their
//! pixels are loaded one by one and only the arithmetic is wide.

use std::arch::x86_64::*;

use super::line::{Line, MARGIN, OfSum, rounded};

/// Samples at once.
const LANES: usize = 16;
/// Steps along y up to which rows are shuffled \[2^-16 pixels\]: the two ways are equally fast there.
const FLAT: i64 = 40_000;
/// Steps along x up to which 8 samples lie within 16 pixels \[2^-16 pixels\].
const NEAR: i64 = 117_000;
/// The steepest step for which 16 samples fit into lanes of 32 bits \[2^-16 pixels\].
const FAR: i64 = 1 << 26;

/// Whether the processor, and what is fast here, serve a line in an image.
pub(super) fn serves(values: &[u8], line: Line) -> bool {
    let steepest = rounded(line.dx).abs().max(rounded(line.dy).abs());
    steepest <= FAR && i32::try_from(values.len()).is_ok() && is_x86_feature_detected!("avx2")
}

/// Interpolates as many whole groups of samples as there are, see [`super::line::interpolate`]; returns how many samples:
/// none where [`serves`] says so.
pub(super) fn interpolate<K: OfSum>(
    values: &[u8],
    width: usize,
    line: Line,
    out: &mut [K],
) -> usize {
    let whole = out.len() / LANES * LANES;
    let (dx, dy) = (rounded(line.dx), rounded(line.dy));
    if whole == 0 || !serves(values, line) {
        return 0;
    }
    let out = &mut out[..whole];
    let flat = dy.abs() <= FLAT && dx.abs() <= NEAR;
    #[expect(
        unsafe_code,
        reason = "code for a processor's extension must not run without it: the one thing the \
                  compiler cannot see"
    )]
    // SAFETY: the processor has AVX2, as was just asked.
    unsafe {
        if flat {
            by_rows(values, width, line, out);
        } else {
            one_by_one(values, width, line, out);
        }
    }
    whole
}

/// Sixteen samples: how far they lie from the first one's pixel.
struct Steps {
    /// \[2^-16 pixels\], lanes 0 to 7 and 8 to 15.
    x: [__m256i; 2],
    y: [__m256i; 2],
}

impl Steps {
    #[target_feature(enable = "avx2")]
    fn new(dx: i32, dy: i32) -> Self {
        let lanes = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
        let both = |step: i32| {
            let first = _mm256_mullo_epi32(lanes, _mm256_set1_epi32(step));
            [first, _mm256_add_epi32(first, _mm256_set1_epi32(8 * step))]
        };
        Self {
            x: both(dx),
            y: both(dy),
        }
    }

    #[target_feature(enable = "avx2")]
    fn from(&self, x: i32, y: i32) -> Self {
        let add = |steps: [__m256i; 2], first: i32| {
            let first = _mm256_set1_epi32(first);
            [
                _mm256_add_epi32(steps[0], first),
                _mm256_add_epi32(steps[1], first),
            ]
        };
        Self {
            x: add(self.x, x),
            y: add(self.y, y),
        }
    }
}

/// What follows the point, of 16 positions.
#[target_feature(enable = "avx2")]
fn weights(positions: [__m256i; 2]) -> __m256i {
    let low = _mm256_set1_epi32(0xffff);
    let [a, b] = positions;
    in_order(_mm256_packus_epi32(
        _mm256_and_si256(a, low),
        _mm256_and_si256(b, low),
    ))
}

/// What is before the point, of 16 positions.
#[target_feature(enable = "avx2")]
fn pixels([a, b]: [__m256i; 2]) -> __m256i {
    in_order(_mm256_packs_epi32(
        _mm256_srai_epi32::<16>(a),
        _mm256_srai_epi32::<16>(b),
    ))
}

/// Packing works within halves of a register.
#[target_feature(enable = "avx2")]
fn in_order(packed: __m256i) -> __m256i {
    _mm256_permute4x64_epi64::<0b11_01_10_00>(packed)
}

/// [`super::line`]'s interpolation between pairs of neighbours, the left one in the low byte: 8 bits after the point.
#[target_feature(enable = "avx2")]
fn lerp(top: __m256i, bottom: __m256i, wx: __m256i, wy: __m256i) -> __m256i {
    let rounded = _mm256_add_epi16(_mm256_srli_epi16::<1>(wx), _mm256_set1_epi16(64));
    let right = _mm256_srli_epi16::<7>(rounded);
    let left = _mm256_sub_epi16(_mm256_set1_epi16(256), right);
    let along = |pairs: __m256i| {
        let a = _mm256_and_si256(pairs, _mm256_set1_epi16(0xff));
        let b = _mm256_srli_epi16::<8>(pairs);
        _mm256_add_epi16(_mm256_mullo_epi16(a, left), _mm256_mullo_epi16(b, right))
    };
    let (top, bottom) = (along(top), along(bottom));
    let upper = _mm256_sub_epi16(top, _mm256_mulhi_epu16(top, wy));
    _mm256_add_epi16(upper, _mm256_mulhi_epu16(bottom, wy))
}

/// [`OfSum::of_sum`] of 16.
#[target_feature(enable = "avx2")]
fn keep<K: OfSum>(sums: __m256i, out: &mut [K]) {
    if size_of::<K>() == size_of::<u8>() {
        let rounded = _mm256_srli_epi16::<8>(_mm256_add_epi16(sums, _mm256_set1_epi16(128)));
        let rounded = _mm256_max_epi16(rounded, _mm256_set1_epi16(1));
        let packed = _mm256_packus_epi16(rounded, rounded);
        let packed = _mm256_castsi256_si128(_mm256_permute4x64_epi64::<0b10_00>(packed));
        let rounded: [u8; LANES] = bytemuck::cast(packed);
        bytemuck::cast_slice_mut(out).copy_from_slice(&rounded);
    } else {
        let sums: [u16; LANES] = bytemuck::cast(_mm256_max_epu16(sums, _mm256_set1_epi16(1 << 8)));
        bytemuck::cast_slice_mut(out).copy_from_slice(&sums);
    }
}

/// A step in lanes of 32 bits.
fn narrow(step: i64) -> i32 {
    i32::try_from(rounded(step)).expect("steps are looked at before")
}

#[target_feature(enable = "avx2")]
fn by_rows<K: OfSum>(values: &[u8], width: usize, mut line: Line, out: &mut [K]) {
    let (dx, dy) = (narrow(line.dx), narrow(line.dy));
    let steps = Steps::new(dx, dy);
    let one = _mm256_set1_epi16(1);
    for out in out.as_chunks_mut::<LANES>().0 {
        let [fx, fy] = line.weights().map(i32::from);
        let places = steps.from(fx, fy);
        // Rows and columns from the first sample's pixel; a half of the lanes begins at its own column.
        let ends_at = (fy + 15 * dy) >> 16;
        let (first, last) = (ends_at.min(0), ends_at.max(0));
        let column = |lane: i32| (fx + lane * dx) >> 16;
        let columns = [column(0).min(column(7)), column(8).min(column(15))];
        let rows = _mm256_sub_epi16(pixels(places.y), splat(first));
        let starts = _mm256_setr_m128i(half(columns[0]), half(columns[1]));
        let left = _mm256_sub_epi16(pixels(places.x), starts);
        let pairs = _mm256_or_si256(left, _mm256_slli_epi16::<8>(_mm256_add_epi16(left, one)));
        let first_row = at(line.pixel(width), first, width);
        let [low, high] = columns.map(|column| at(first_row, column, 1));
        let load = |row: usize| {
            let part = |from: usize| {
                let from = from + row * width;
                let bytes: [u8; LANES] = *values[from..].first_chunk().expect("the margin");
                bytemuck::cast::<_, __m128i>(bytes)
            };
            _mm256_shuffle_epi8(_mm256_setr_m128i(part(low), part(high)), pairs)
        };
        let (mut top, mut bottom) = (load(0), load(1));
        let mut upper = bottom;
        let mut number = one;
        for row in 1..=last.abs_diff(first) as usize {
            let lower = load(row + 1);
            let here = _mm256_cmpeq_epi16(rows, number);
            top = _mm256_blendv_epi8(top, upper, here);
            bottom = _mm256_blendv_epi8(bottom, lower, here);
            upper = lower;
            number = _mm256_add_epi16(number, one);
        }
        keep(lerp(top, bottom, weights(places.x), weights(places.y)), out);
        line.step(LANES);
    }
}

#[target_feature(enable = "avx2")]
fn one_by_one<K: OfSum>(values: &[u8], width: usize, mut line: Line, out: &mut [K]) {
    let steps = Steps::new(narrow(line.dx), narrow(line.dy));
    let stride = _mm256_set1_epi32(i32::try_from(width).expect("rows are shorter than images"));
    let lower = &values[width..];
    for out in out.as_chunks_mut::<LANES>().0 {
        let [fx, fy] = line.weights().map(i32::from);
        let places = steps.from(fx, fy);
        let first = i32::try_from(line.pixel(width)).expect("images are looked at before");
        let first = _mm256_set1_epi32(first);
        let index = |n: usize| {
            let row = _mm256_mullo_epi32(_mm256_srai_epi32::<16>(places.y[n]), stride);
            let column = _mm256_srai_epi32::<16>(places.x[n]);
            _mm256_add_epi32(first, _mm256_add_epi32(row, column))
        };
        let indices: [[u32; 8]; 2] = [0, 1].map(|n| bytemuck::cast(index(n)));
        let mut pairs = [[0_u16; LANES]; 2];
        for (n, index) in indices.as_flattened().iter().enumerate() {
            let from = *index as usize;
            for (pairs, values) in pairs.iter_mut().zip([values, lower]) {
                let pair: [u8; 2] = *values[from..].first_chunk().expect("the margin");
                pairs[n] = u16::from_le_bytes(pair);
            }
        }
        let [top, bottom] = pairs.map(bytemuck::cast::<_, __m256i>);
        keep(lerp(top, bottom, weights(places.x), weights(places.y)), out);
        line.step(LANES);
    }
}

/// `steps` strides from a pixel.
fn at(pixel: usize, steps: i32, stride: usize) -> usize {
    pixel.wrapping_add_signed(steps as isize * stride.cast_signed())
}

#[target_feature(enable = "avx2")]
fn splat(value: i32) -> __m256i {
    // Of few bits: pixels that 16 samples lie apart.
    _mm256_broadcastw_epi16(_mm_cvtsi32_si128(value))
}

#[target_feature(enable = "avx2")]
fn half(value: i32) -> __m128i {
    _mm_broadcastw_epi16(_mm_cvtsi32_si128(value))
}

// A load of 16 pixels right of an image's last one stays in its margin.
const _: () = assert!(MARGIN >= LANES);

#[cfg(test)]
mod tests {
    use glam::{DVec2, UVec2};
    use proptest::prelude::*;

    use super::super::line::gathered;
    use super::*;

    proptest! {
        /// Every angle, and steps at which rows are shuffled and pixels loaded one by one.
        #[test]
        fn wide_registers_change_nothing(
            degrees in prop_oneof![-3.0..3.0, -45.0..45.0, -180.0..180.0],
            scale in prop_oneof![0.995..1.005, 0.3..2.5],
            start in (0.0..1.0, 0.0..1.0),
            seed in any::<u64>(),
        ) {
            let size = UVec2::new(190, 170);
            let values = crate::stitched::tests::noise(190 * 171, 1, seed);
            let along = DVec2::from_angle(f64::to_radians(degrees)) * scale;
            let room = size.as_dvec2() - 1.01;
            let start = DVec2::from(start) * room;
            let inside = |n: &usize| {
                let at: DVec2 = start + along * *n as f64;
                at.cmpge(DVec2::splat(0.01)).all() && at.cmplt(room).all()
            };
            let length = (0..200).take_while(inside).count();
            let line = Line::new(start, DVec2::ZERO, along);
            let (mut wide, mut narrow) = (vec![0_u8; length], vec![0_u8; length]);
            let (mut fine, mut fine_narrow) = (vec![0_u16; length], vec![0_u16; length]);
            let done = interpolate(&values, 190, line, &mut wide);
            gathered(&values, 190, line, 0, &mut narrow);
            let has = is_x86_feature_detected!("avx2");
            prop_assert_eq!(done, if has { length / LANES * LANES } else { 0 });
            prop_assert_eq!(&wide[..done], &narrow[..done]);
            prop_assert_eq!(done, interpolate(&values, 190, line, &mut fine));
            gathered(&values, 190, line, 0, &mut fine_narrow);
            prop_assert_eq!(&fine[..done], &fine_narrow[..done]);
            // The comparison can fail: a pixel further all is different.
            if done > 0 {
                let mut other = vec![0; length];
                gathered(&values[1..], 190, line, 0, &mut other);
                prop_assert_ne!(&other[..done], &wide[..done]);
            }
        }
    }
}
