//! Exact box averages: sums are kept, and divided once per level.
//!
//! A pixel of level k is the mean of the level-0 pixels it covers that exist, rounded half up.
//! Averaging rounded averages would drift by up to half a grey level per level; sums do not.
//! Sixteen bits hold the sums of levels 1 to 4 (256 * 255), 32 bits those of level 12.

use glam::UVec2;

use super::{SUB_TILE_EDGE, SUB_TILE_VOXELS};

/// Edge of a sub-tile, as an index.
const EDGE: usize = SUB_TILE_EDGE as usize;

/// Highest level whose sums fit 16 bits.
pub(super) const MAX_U16_LEVEL: usize = 4;

/// Sums of one sub-tile's pixels; 0 where no pixel exists.
pub(super) type Sums = [u16; SUB_TILE_VOXELS];

/// Level-0 pixels that pixel `at` of `level` covers, along an axis of `len` level-0 pixels.
pub(super) fn covered(at: u32, level: usize, len: u32) -> u32 {
    (len - (at << level)).min(1 << level)
}

/// The mean of `n` values, rounded half up.
#[expect(
    clippy::cast_possible_truncation,
    reason = "the mean of bytes is a byte"
)]
pub(super) fn mean(sum: u32, n: u32) -> u8 {
    ((sum + n / 2) / n) as u8
}

/// Adds 2 x 2 pixels of an image's sub-tile into the quadrant of level 1's sums that begins at
/// `to`. `pixels` begins at the sub-tile's first; `width` and `height` of it exist.
pub(super) fn halve_pixels(
    pixels: &[u8],
    pitch: usize,
    (width, height): (usize, usize),
    to: &mut [u16],
) {
    // Two neighbours are one 16-bit word: its bytes are added without moving any.
    let pair_sum = |pair: [u8; 2]| {
        let word = u16::from_le_bytes(pair);
        (word & 0xff).wrapping_add(word >> 8)
    };
    for (y, to) in to.chunks_mut(EDGE).take(height.div_ceil(2)).enumerate() {
        let row = |y: usize| pixels[y * pitch..][..width].as_chunks::<2>();
        let (pairs, last) = row(2 * y);
        if 2 * y + 1 < height {
            let (pairs_below, last_below) = row(2 * y + 1);
            for ((to, &a), &b) in to.iter_mut().zip(pairs).zip(pairs_below) {
                *to = pair_sum(a).wrapping_add(pair_sum(b));
            }
            if let ([a], [b]) = (last, last_below) {
                to[pairs.len()] = u16::from(*a) + u16::from(*b);
            }
        } else {
            for (to, &a) in to.iter_mut().zip(pairs) {
                *to = pair_sum(a);
            }
            if let [a] = last {
                to[pairs.len()] = u16::from(*a);
            }
        }
    }
}

/// Adds 2 x 2 sums of a whole sub-tile into the quadrant of the next level's that begins at `to`.
pub(super) fn halve_sums(from: &Sums, to: &mut [u16]) {
    for (to, rows) in to.chunks_mut(EDGE).zip(from.chunks_exact(2 * EDGE)) {
        let (above, below) = rows.split_at(EDGE);
        let pairs = above
            .as_chunks::<2>()
            .0
            .iter()
            .zip(below.as_chunks::<2>().0);
        for (to, ([a, b], [c, d])) in to.iter_mut().zip(pairs) {
            // Four sums of at most 64 pixels fit; checking each addition would cost the vector unit.
            *to = a.wrapping_add(*b).wrapping_add(*c).wrapping_add(*d);
        }
    }
}

/// Where quadrant (x, y) of a sub-tile begins.
pub(super) fn quadrant(x: u32, y: u32) -> usize {
    ((y & 1) as usize * EDGE + (x & 1) as usize) * (EDGE / 2)
}

/// Means of a sub-tile's sums, `height` rows of `width`. `columns` and `rows` are the level-0
/// pixels that the last column and row cover.
pub(super) fn means(
    sums: &Sums,
    level: usize,
    (width, height): (usize, usize),
    (columns, rows): (u32, u32),
    to: &mut [u8; SUB_TILE_VOXELS],
) {
    let full = 1_u32 << level;
    let (shift, half) = (2 * level, 1_u16 << (2 * level - 1));
    for (y, (sums, to)) in sums
        .chunks_exact(EDGE)
        .zip(to.chunks_exact_mut(EDGE))
        .enumerate()
    {
        if y >= height {
            break;
        }
        let rows = if y + 1 == height { rows } else { full };
        if rows == full {
            for (to, &sum) in to.iter_mut().zip(sums) {
                #[expect(
                    clippy::cast_possible_truncation,
                    reason = "the mean of bytes is a byte"
                )]
                let mean = (sum.wrapping_add(half) >> shift) as u8;
                *to = mean;
            }
        } else {
            for (to, &sum) in to.iter_mut().zip(&sums[..width]) {
                *to = mean(sum.into(), full * rows);
            }
        }
        if columns != full {
            to[width - 1] = mean(sums[width - 1].into(), columns * rows);
        }
    }
}

/// A whole level's sums: the coarse levels, where there is little left to do.
#[derive(Debug)]
pub(super) struct SumPlane {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) sums: Vec<u32>,
}

impl SumPlane {
    pub(super) fn new(width: u32, height: u32) -> Self {
        let (width, height) = (width as usize, height as usize);
        Self {
            width,
            height,
            sums: vec![0; width * height],
        }
    }

    /// Copies a quadrant of a sub-tile's sums to its place, as far as it lies within the plane.
    /// `at` counts quadrants of the plane.
    pub(super) fn put(&mut self, at: UVec2, sums: &Sums) {
        let (x, y) = (at.x as usize * EDGE / 2, at.y as usize * EDGE / 2);
        let width = (EDGE / 2).min(self.width - x);
        let from = sums[quadrant(at.x, at.y)..].chunks(EDGE).take(EDGE / 2);
        for (to, from) in self.sums[y * self.width..].chunks_mut(self.width).zip(from) {
            for (to, &from) in to[x..x + width].iter_mut().zip(from) {
                *to = from.into();
            }
        }
    }

    /// The next level's sums.
    pub(super) fn halved(&self) -> Self {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut sums = Vec::with_capacity(width * height);
        for rows in self.sums.chunks(2 * self.width) {
            let (above, below) = rows.split_at(self.width);
            for x in 0..width {
                let pair = |row: &[u32]| row.iter().skip(2 * x).take(2).sum::<u32>();
                sums.push(pair(above) + pair(below));
            }
        }
        Self {
            width,
            height,
            sums,
        }
    }

    /// The level's pixels, of an image of `image` level-0 pixels.
    pub(super) fn means(&self, level: usize, image: (u32, u32)) -> Vec<u8> {
        let count = |at: usize, len| {
            covered(
                u32::try_from(at).expect("a level is no larger than its image"),
                level,
                len,
            )
        };
        let columns: Vec<u32> = (0..self.width).map(|x| count(x, image.0)).collect();
        let rows = self.sums.chunks_exact(self.width).enumerate();
        rows.flat_map(|(y, sums)| {
            let rows = count(y, image.1);
            sums.iter()
                .zip(&columns)
                .map(move |(&sum, columns)| mean(sum, columns * rows))
        })
        .collect()
    }
}
