//! From decoded sub-tiles to samples.

use bytes::Bytes;
use glam::{DVec2, UVec2};
use saccade_archive::pyramid::{PyramidLevel, SUB_TILE_EDGE};

/// Bits after the point of interpolation weights: 8 + 11 + 11 fit 32 bits with room to round.
const WEIGHT_BITS: u32 = 11;
const ONE: u32 = 1 << WEIGHT_BITS;
/// Bits after the point of positions.
const POSITION_BITS: u32 = 32;

/// A rectangle of a pyramid level in one piece, with a border of one pixel, in which the level's
/// edge pixels are repeated.
pub(super) struct Patch {
    values: Vec<u8>,
    width: usize,
    /// Pixel of the level that the patch's first one is.
    origin: DVec2,
}

impl Patch {
    /// From all sub-tiles that will be sampled; blank ones may be left out.
    pub(super) fn new(level: PyramidLevel, sub_tiles: &[(UVec2, Bytes)]) -> Self {
        let places = || sub_tiles.iter().map(|(at, _)| *at);
        let first = places().reduce(UVec2::min).unwrap_or(UVec2::ZERO);
        let last = places().reduce(UVec2::max).unwrap_or(UVec2::ZERO);
        let size = UVec2::new(level.width, level.height);
        let (start, end) = (
            first * SUB_TILE_EDGE,
            ((last + 1) * SUB_TILE_EDGE).min(size),
        );
        let inner = (end - start).as_usizevec2();
        let width = inner.x + 2;
        let mut values = vec![0; width * (inner.y + 2)];
        let edge = SUB_TILE_EDGE as usize;
        for (at, voxels) in sub_tiles {
            let corner = *at * SUB_TILE_EDGE;
            let valid = (size - corner)
                .min(UVec2::splat(SUB_TILE_EDGE))
                .as_usizevec2();
            let to = (corner - start).as_usizevec2() + 1;
            for (y, row) in voxels.chunks_exact(edge).take(valid.y).enumerate() {
                let at = (to.y + y) * width + to.x;
                values[at..at + valid.x].copy_from_slice(&row[..valid.x]);
            }
        }
        for row in values.chunks_exact_mut(width) {
            if start.x == 0 {
                row[0] = row[1];
            }
            if end.x == size.x {
                row[width - 1] = row[width - 2];
            }
        }
        if start.y == 0 {
            values.copy_within(width..2 * width, 0);
        }
        if end.y == size.y {
            let after = values.len() - width;
            values.copy_within(after - width..after, after);
        }
        Self {
            values,
            width,
            origin: start.as_dvec2() - 1.0,
        }
    }

    /// Interpolates along a line from `pixel` in steps of `along` \[pixels of the level\]. All
    /// samples must lie in the level and in sub-tiles the patch was made of, or in blank ones.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "fixed point: positions in a patch are small and not negative, weights below 2^11"
    )]
    pub(super) fn sample(&self, pixel: DVec2, along: DVec2, out: &mut [u8]) {
        let at = pixel - 0.5 - self.origin;
        let fixed = |v: f64| (v * (1_u64 << POSITION_BITS) as f64).round() as i64;
        let weight = |v: i64| (v >> (POSITION_BITS - WEIGHT_BITS)) as u32 & (ONE - 1);
        let mix = |a: [u8; 2], b: [u8; 2], x: u32, y: u32| {
            let [a0, a1, b0, b1] = [a[0], a[1], b[0], b[1]].map(u32::from);
            let top = a0 * (ONE - x) + a1 * x;
            let bottom = b0 * (ONE - x) + b1 * x;
            let sum = top * (ONE - y) + bottom * y + (1 << (2 * WEIGHT_BITS - 1));
            ((sum >> (2 * WEIGHT_BITS)) as u8).max(1)
        };
        let (mut x, mut y) = (fixed(at.x), fixed(at.y));
        let index = |x: i64, y: i64| {
            (y >> POSITION_BITS) as usize * self.width + (x >> POSITION_BITS) as usize
        };
        let length = out.len() as f64;
        if (along.x - 1.0).abs() * length < 1e-4 && along.y.abs() * length < 1e-4 {
            // Pixel for pixel: the same weights all along. Rounding must not straddle a pixel.
            let half = 1_i64 << (POSITION_BITS - WEIGHT_BITS - 1);
            (x, y) = (x + half, y + half);
            let (wx, wy, first) = (weight(x), weight(y), index(x, y));
            let (n, width) = (out.len(), self.width);
            if wx == 0 && wy == 0 {
                for (out, value) in out.iter_mut().zip(&self.values[first..first + n]) {
                    *out = (*value).max(1);
                }
                return;
            }
            let top = &self.values[first..first + n + 1];
            let bottom = &self.values[first + width..first + width + n + 1];
            for (out, (a, b)) in out.iter_mut().zip(top.windows(2).zip(bottom.windows(2))) {
                *out = mix([a[0], a[1]], [b[0], b[1]], wx, wy);
            }
            return;
        }
        let (dx, dy) = (fixed(along.x), fixed(along.y));
        for out in out {
            let first = index(x, y);
            let a = &self.values[first..first + 2];
            let b = &self.values[first + self.width..first + self.width + 2];
            *out = mix([a[0], a[1]], [b[0], b[1]], weight(x), weight(y));
            (x, y) = (x + dx, y + dy);
        }
    }
}

/// Each `by` x `by` values become one: the mean of those that are not 0.
pub(super) fn averaged(values: &[u8], size: UVec2, by: u32) -> Vec<u8> {
    let (width, by) = (size.x as usize * by as usize, by as usize);
    let mut averaged = Vec::with_capacity(size.x as usize * size.y as usize);
    let mut sums = vec![(0_u32, 0_u32); size.x as usize];
    for rows in values.chunks_exact(width * by) {
        sums.fill((0, 0));
        for row in rows.chunks_exact(width) {
            for (values, (sum, count)) in row.chunks_exact(by).zip(&mut sums) {
                *sum += values.iter().map(|v| u32::from(*v)).sum::<u32>();
                *count += values.iter().map(|v| u32::from(*v != 0)).sum::<u32>();
            }
        }
        averaged.extend(sums.iter().map(|(sum, count)| {
            let mean = (sum + count / 2).checked_div(*count).unwrap_or(0);
            u8::try_from(mean).expect("a mean of bytes is a byte")
        }));
    }
    averaged
}

#[cfg(test)]
#[allow(clippy::cast_possible_truncation, reason = "test volumes are small")]
mod tests {
    use super::*;

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
        (Patch::new(level, &sub_tiles), clamped)
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
            patch.sample(start, along, &mut out);
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

    #[test]
    fn means_leave_out_what_is_not_there() {
        let values = [1, 2, 0, 0, 4, 6, 0, 9, 0, 0, 255, 255, 0, 0, 255, 254];
        assert_eq!(averaged(&values, UVec2::new(2, 2), 2), [3, 9, 0, 255]);
        assert_eq!(averaged(&values, UVec2::new(4, 4), 1), values);
    }
}
