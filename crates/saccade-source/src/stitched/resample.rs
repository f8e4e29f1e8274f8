//! From decoded sub-tiles to samples.

mod coarse;
mod float;
mod line;
mod sample;
#[cfg(target_arch = "x86_64")]
mod wide;
#[cfg(not(target_arch = "x86_64"))]
#[path = "resample/narrow.rs"]
mod wide;

use bytes::Bytes;
use glam::{DVec2, UVec2};
use saccade_archive::pyramid::{PyramidLevel, SUB_TILE_EDGE};

pub(super) use coarse::{averaged, most_frequent};
use line::{Line, MARGIN};
pub use sample::Sample;
pub(super) use sample::fine_number;
pub(super) use sample::sealed::Kept;

/// What a sample that lies between pixels is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Interpolation {
    /// The value of the pixel it lies in, as labels need it: nothing lies between two of them.
    Nearest,
    /// In proportion between the four pixels around it.
    #[default]
    Linear,
    /// On the cubic curves through the pixels around it whose slope at each pixel is half the difference of
    /// its neighbours (Catmull and Rom), 4 x 4 of them: sharper, and five times as much work. Where values change
    /// abruptly, it passes over them by up to an eighth of the change.
    Cubic,
}

impl Interpolation {
    /// How far from a sample's place the pixels that it depends on begin and end \[pixels\].
    pub(super) fn reach(self) -> f64 {
        match self {
            Self::Nearest | Self::Linear => 1.0,
            Self::Cubic => 2.0,
        }
    }

    /// Bounds of what becomes of values within bounds.
    pub(super) fn bounds(self, (least, most): (u16, u16)) -> (u16, u16) {
        // Weights are from -1/8 to 9/8 along each axis: those below zero sum up to 9/32.
        let over = match self {
            Self::Nearest | Self::Linear => 0,
            Self::Cubic => u32::from(most - least) * 9 / 32 + 1,
        };
        let over = u16::try_from(over).unwrap_or(u16::MAX);
        (least.saturating_sub(over), most.saturating_add(over))
    }
}

/// Pixels that are repeated outside an image.
const BORDER: usize = 2;

/// An image, or a rectangle of a pyramid's level, in one piece, to be sampled along lines.
///
/// It has a border of two pixels, in which the image's edge pixels are repeated.
#[derive(Clone, Debug)]
pub struct Patch<S = u8> {
    values: Vec<S>,
    width: usize,
    /// Pixel of the level that the patch's first one is.
    origin: DVec2,
}

impl<S: Sample> Patch<S> {
    /// Of an image of `size` pixels, x fastest.
    ///
    /// # Panics
    ///
    /// If there are not as many pixels, or none.
    pub fn of_image(pixels: &[S], size: UVec2) -> Self {
        let [width, height] = size.as_usizevec2().to_array();
        assert!(
            width * height == pixels.len() && !pixels.is_empty(),
            "{} pixels are no image of {size}",
            pixels.len()
        );
        let stride = width + 2 * BORDER;
        let mut values = vec![S::default(); stride * (height + 2 * BORDER)];
        let rows = values.chunks_exact_mut(stride).skip(BORDER);
        for (to, row) in rows.zip(pixels.chunks_exact(width)) {
            to[BORDER..][..width].copy_from_slice(row);
        }
        Self::with_border(values, UVec2::ZERO, size, size)
    }

    /// From all sub-tiles that will be sampled, as little-endian bytes; blank ones may be left out.
    pub(super) fn of_sub_tiles(level: PyramidLevel, sub_tiles: &[(UVec2, Bytes)]) -> Self {
        let places = || sub_tiles.iter().map(|(at, _)| *at);
        let first = places().reduce(UVec2::min).unwrap_or(UVec2::ZERO);
        let last = places().reduce(UVec2::max).unwrap_or(UVec2::ZERO);
        let size = UVec2::new(level.width, level.height);
        let (start, end) = (
            first * SUB_TILE_EDGE,
            ((last + 1) * SUB_TILE_EDGE).min(size),
        );
        let inner = (end - start).as_usizevec2();
        let width = inner.x + 2 * BORDER;
        let mut values = vec![S::default(); width * (inner.y + 2 * BORDER)];
        let bytes = S::DTYPE.bytes();
        let edge = SUB_TILE_EDGE as usize * bytes;
        for (at, voxels) in sub_tiles {
            let corner = *at * SUB_TILE_EDGE;
            let valid = (size - corner)
                .min(UVec2::splat(SUB_TILE_EDGE))
                .as_usizevec2();
            let to = (corner - start).as_usizevec2() + BORDER;
            for (y, row) in voxels.chunks_exact(edge).take(valid.y).enumerate() {
                let at = (to.y + y) * width + to.x;
                S::read(&row[..valid.x * bytes], &mut values[at..at + valid.x]);
            }
        }
        Self::with_border(values, start, end, size)
    }

    /// Fills the border around pixels `start` to `end` of an image of `size` where it ends there.
    fn with_border(mut values: Vec<S>, start: UVec2, end: UVec2, size: UVec2) -> Self {
        let width = (end.x - start.x) as usize + 2 * BORDER;
        for row in values.chunks_exact_mut(width) {
            if start.x == 0 {
                let (border, inner) = row.split_at_mut(BORDER);
                border.fill(inner[0]);
            }
            if end.x == size.x {
                let (inner, border) = row.split_at_mut(width - BORDER);
                border.fill(inner[inner.len() - 1]);
            }
        }
        let after = values.len() - BORDER * width;
        for row in 0..BORDER {
            if start.y == 0 {
                values.copy_within(BORDER * width..(BORDER + 1) * width, row * width);
            }
            if end.y == size.y {
                values.copy_within(after - width..after, after + row * width);
            }
        }
        values.resize(values.len() + MARGIN, S::default());
        Self {
            values,
            width,
            origin: start.as_dvec2() - BORDER as f64,
        }
    }

    /// Interpolates along a line from `pixel` in steps of `along` \[pixels; pixel `i` covers
    /// `[i, i + 1)`\], less than one grey level off, and at least 1. All samples must lie in the image,
    /// and in sub-tiles the patch was made of, or in blank ones.
    pub fn sample(&self, interpolation: Interpolation, pixel: DVec2, along: DVec2, out: &mut [S]) {
        self.sample_from(interpolation, (pixel, along), 0, out);
    }

    /// The same without the first `skip` samples, which may lie anywhere. The others are what they are with them, to the last
    /// bit.
    pub(super) fn sample_from<K: Kept<S>>(
        &self,
        interpolation: Interpolation,
        line: (DVec2, DVec2),
        skip: usize,
        out: &mut [K],
    ) {
        let mut line = self.line(line);
        if interpolation != Interpolation::Linear {
            line.step(skip);
        }
        match interpolation {
            Interpolation::Nearest => {
                float::nearest(&self.values, self.width, line, S::of(1), out);
            }
            Interpolation::Cubic => float::cubic(&self.values, self.width, line, out),
            Interpolation::Linear => K::interpolate(&self.values, self.width, line, skip, out),
        }
    }

    /// The labels of the pixels that samples along a line lie in, as they are, 0 included; see [`Self::sample_from`].
    pub(super) fn labels_from(&self, line: (DVec2, DVec2), skip: usize, out: &mut [S]) {
        let mut line = self.line(line);
        line.step(skip);
        float::nearest(&self.values, self.width, line, S::default(), out);
    }

    fn line(&self, (pixel, along): (DVec2, DVec2)) -> Line {
        Line::new(pixel - 0.5, self.origin, along)
    }
}

#[cfg(test)]
#[allow(clippy::cast_possible_truncation, reason = "test volumes are small")]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// 200 x 140 pixels, of which the last sub-tiles are mostly padding (77, to be ignored).
    fn patch() -> (Patch, impl Fn(i64, i64) -> f64) {
        let level = PyramidLevel {
            width: 200,
            height: 140,
            sub_tiles: UVec2::new(2, 2),
        };
        let value = |x: i64, y: i64| ((x * 13 + y * 29) % 200 + 30) as u8;
        let sub_tiles: Vec<_> = [(0, 0), (1, 0), (0, 1), (1, 1)]
            .map(|(x, y)| {
                let voxels = (0..128 * 128).map(|n| {
                    let (x, y) = (x * 128 + n % 128, y * 128 + n / 128);
                    if x < 200 && y < 140 { value(x, y) } else { 77 }
                });
                let at = UVec2::new(x as u32, y as u32);
                (at, Bytes::from(voxels.collect::<Vec<_>>()))
            })
            .into();
        let clamped = move |x: i64, y: i64| f64::from(value(x.clamp(0, 199), y.clamp(0, 139)));
        (Patch::of_sub_tiles(level, &sub_tiles), clamped)
    }

    fn exact(value: &impl Fn(i64, i64) -> f64, at: DVec2) -> f64 {
        let low = (at - 0.5).floor();
        let (w, x, y) = (at - 0.5 - low, low.x as i64, low.y as i64);
        let row = |y| value(x, y) * (1.0 - w.x) + value(x + 1, y) * w.x;
        row(y) * (1.0 - w.y) + row(y + 1) * w.y
    }

    #[test]
    fn interpolates_along_any_line() {
        let (patch, value) = patch();
        for (start, along) in [
            ((0.0, 0.0), (1.0, 0.0)),
            ((0.5, 0.5), (1.0, 0.0)),
            ((3.25, 139.9), (1.0, 0.0)),
            ((0.0, 70.0), (1.3, 0.4)),
            ((199.9, 139.9), (-1.1, -0.7)),
            ((10.0, 0.0), (0.01, 0.999)),
            ((127.0, 127.0), (0.03, 0.02)),
        ] {
            let (start, along) = (DVec2::from(start), DVec2::from(along));
            let mut out = [0; 130];
            let mut shift = 0.0_f64;
            patch.sample(Interpolation::Linear, start, along, &mut out);
            for (n, got) in out.iter().enumerate() {
                let at = start + along * n as f64;
                let want = exact(&value, at);
                assert!(
                    (f64::from(*got) - want).abs() < 0.7,
                    "{at}: {got}, not {want}"
                );
                shift = shift.max((exact(&value, at + DVec2::X) - want).abs());
            }
            assert!(shift > 10.0, "a pixel further would be seen: {shift}");
        }
    }

    proptest! {
        /// What a sample is does not depend on where its line begins to be drawn, nor on what else of the image is at hand.
        #[test]
        fn a_line_is_the_same_wherever_it_begins(
            degrees in prop_oneof![Just(0.0), -1e-7..1e-7, -0.2..0.2, -3.0..3.0, -180.0..180.0],
            scale in prop_oneof![Just(1.0), 0.995..1.005, 0.5..2.0],
            start in (0.0..1.0, 0.0..1.0),
            skip in 0..90_usize,
            length in 1..90_usize,
            seed in any::<u64>(),
        ) {
            let size = UVec2::new(190, 170);
            let pixels = crate::stitched::tests::noise(190, 170, seed);
            let patch = Patch::of_image(&pixels, size);
            let along = DVec2::from_angle(f64::to_radians(degrees)) * scale;
            let start = DVec2::from(start) * (size.as_dvec2() - 0.01);
            let inside = |n: &usize| {
                let at = start + along * *n as f64;
                at.cmpge(DVec2::splat(0.01)).all() && at.cmplt(size.as_dvec2() - 0.01).all()
            };
            let whole = (0..200).take_while(inside).count();
            prop_assume!(whole > 0);
            let skip = skip % whole;
            let end = (skip + length).min(whole);
            let line = patch.line((start, along));
            let mut all = [vec![0_u8; whole], vec![0; whole], vec![0; whole]];
            let mut part = [vec![0_u8; end - skip], vec![0; end - skip], vec![0; end - skip]];
            for (out, skip) in [(&mut all, 0), (&mut part, skip)] {
                line::interpolate(&patch.values, patch.width, line, skip, &mut out[0]);
                line::gathered(&patch.values, patch.width, line, skip, &mut out[1]);
                // Runs are for lines along which pixels lie almost as samples do.
                if degrees.abs() <= 3.0 && (scale - 1.0).abs() < 0.01 {
                    line::in_runs(&patch.values, patch.width, line, skip, &mut out[2]);
                }
            }
            for (all, part) in all.iter().zip(&part) {
                prop_assert_eq!(&all[skip..end], &part[..]);
            }
            let wide: Vec<u16> = pixels.iter().map(|v| u16::from(*v) * 251).collect();
            let wide = Patch::of_image(&wide, size);
            for interpolation in [Interpolation::Nearest, Interpolation::Linear, Interpolation::Cubic] {
                let mut all = vec![0; whole];
                wide.sample(interpolation, start, along, &mut all);
                let mut part = vec![0; end - skip];
                wide.sample_from(interpolation, (start, along), skip, &mut part);
                prop_assert_eq!(&all[skip..end], &part[..]);
            }
        }

        /// Every way of sampling: runs, gathered, shifted, and all lengths of what is left over.
        #[test]
        fn is_less_than_a_level_off(
            degrees in prop_oneof![Just(0.0), -0.2..0.2, -3.0..3.0, -180.0..180.0],
            scale in prop_oneof![Just(1.0), 0.995..1.005, 0.5..2.0],
            start in (0.0..1.0, 0.0..1.0),
            length in 1..160_usize,
            seed in any::<u64>(),
        ) {
            let size = UVec2::new(190, 170);
            let pixels = crate::stitched::tests::noise(190, 170, seed);
            let patch = Patch::of_image(&pixels, size);
            let value = |x: i64, y: i64| {
                f64::from(pixels[(y.clamp(0, 169) * 190 + x.clamp(0, 189)) as usize])
            };
            let along = DVec2::from_angle(f64::to_radians(degrees)) * scale;
            let size = size.as_dvec2();
            // As many samples as there is room for from here.
            let start = DVec2::from(start) * (size - 0.01);
            let inside = |n: &usize| {
                let at = start + along * *n as f64;
                at.cmpge(DVec2::ZERO).all() && at.cmplt(size).all()
            };
            let length = (0..length).take_while(inside).count();
            let mut out = vec![0; length];
            patch.sample(Interpolation::Linear, start, along, &mut out);
            for (n, got) in out.iter().enumerate() {
                let want = exact(&value, start + along * n as f64).max(1.0);
                let off = (f64::from(*got) - want).abs();
                // Half a level of it is the last rounding.
                prop_assert!(off < 1.5, "sample {} is {}, not {}", n, got, want);
                prop_assert!(got.abs_diff(want.round() as u8) <= 1);
            }
            // Finely, it is what the other was rounded from; half a level is of the weights' eight bits.
            let mut fine = vec![0_u16; length];
            patch.sample_from(Interpolation::Linear, (start, along), 0, &mut fine);
            for (n, (fine, got)) in fine.iter().zip(&out).enumerate() {
                prop_assert_eq!(((fine + 128) >> 8) as u8, *got);
                let want = exact(&value, start + along * n as f64).max(1.0);
                let off = (f64::from(*fine) / 256.0 - want).abs();
                prop_assert!(off < 0.6, "sample {} is {}, not {}", n, fine, want);
            }
        }
    }
}
