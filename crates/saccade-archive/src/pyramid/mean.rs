//! Exact box averages: sums are kept, and divided once per level.
//!
//! A pixel of level k is the mean of the level-0 pixels it covers that exist, rounded half up.
//! Averaging rounded averages would drift by up to half a grey level per level; sums do not.
//! Twice a voxel's bits hold the sums of levels 1 to 4 (256 values), 64 bits those of level 12.

use std::marker::PhantomData;

use glam::UVec2;

use super::SUB_TILE_VOXELS;
use super::filter::{EDGE, Filter, TASK_LEVEL, covered, quadrant};
use super::voxel::pixel::Pixel;

/// Highest level whose sums fit [`Pixel::Sum`].
const MAX_SUM_LEVEL: usize = 4;

const _: () = assert!(
    TASK_LEVEL < MAX_SUM_LEVEL,
    "a task hands on the sums of the next level"
);

/// The mean of `n` values, rounded half up.
pub(super) fn mean<T: Pixel>(sum: u64, n: u64) -> T {
    T::from_wide((sum + n / 2) / n)
}

/// Averages.
pub(super) struct Mean<T>(PhantomData<T>);

/// A whole level's sums: the coarse levels, where there is little left to do.
#[derive(Debug)]
pub(super) struct SumPlane {
    width: usize,
    height: usize,
    sums: Vec<u64>,
}

impl<T: Pixel> Filter for Mean<T> {
    type Pixel = T;
    /// Sums of one sub-tile's pixels; 0 where no pixel exists.
    type Block = Box<[T::Sum; SUB_TILE_VOXELS]>;
    type Plane = SumPlane;

    fn block() -> Self::Block {
        Box::new([T::Sum::default(); SUB_TILE_VOXELS])
    }

    fn clear(block: &mut Self::Block) {
        block.fill(T::Sum::default());
    }

    fn take_pixels(
        block: &mut Self::Block,
        at: UVec2,
        pixels: &[T],
        pitch: usize,
        (width, height): (usize, usize),
    ) {
        let to = block[quadrant(at)..].chunks_mut(EDGE);
        for (y, to) in to.take(height.div_ceil(2)).enumerate() {
            let row = |y: usize| pixels[y * pitch..][..width].as_chunks::<2>();
            let (pairs, last) = row(2 * y);
            if 2 * y + 1 < height {
                let (pairs_below, last_below) = row(2 * y + 1);
                for ((to, &a), &b) in to.iter_mut().zip(pairs).zip(pairs_below) {
                    *to = T::add(T::sum_of_pair(a), T::sum_of_pair(b));
                }
                if let (&[a], &[b]) = (last, last_below) {
                    to[pairs.len()] = T::sum_of_pair([a, b]);
                }
            } else {
                for (to, &a) in to.iter_mut().zip(pairs) {
                    *to = T::sum_of_pair(a);
                }
                if let [a] = last {
                    to[pairs.len()] = a.sum();
                }
            }
        }
    }

    fn take_block(block: &mut Self::Block, at: UVec2, finer: &Self::Block) {
        let to = block[quadrant(at)..].chunks_mut(EDGE);
        for (to, rows) in to.zip(finer.chunks_exact(2 * EDGE)) {
            let (above, below) = rows.split_at(EDGE);
            let (above, below) = (above.as_chunks::<2>().0, below.as_chunks::<2>().0);
            for (to, (&[a, b], &[c, d])) in to.iter_mut().zip(above.iter().zip(below)) {
                *to = T::add(T::add(a, b), T::add(c, d));
            }
        }
    }

    fn values(
        block: &Self::Block,
        level: usize,
        (width, height): (usize, usize),
        (columns, rows): (u32, u32),
        to: &mut [T; SUB_TILE_VOXELS],
    ) {
        let full = 1_u32 << level;
        let lines = block.chunks_exact(EDGE).zip(to.chunks_exact_mut(EDGE));
        for (y, (sums, to)) in lines.take(height).enumerate() {
            let rows = if y + 1 == height { rows } else { full };
            if rows == full {
                for (to, &sum) in to.iter_mut().zip(sums) {
                    *to = T::mean_of_box(sum, level);
                }
            } else {
                for (to, &sum) in to.iter_mut().zip(&sums[..width]) {
                    *to = mean(sum.into(), (full * rows).into());
                }
            }
            if columns != full {
                to[width - 1] = mean(sums[width - 1].into(), (columns * rows).into());
            }
        }
    }

    fn plane(width: u32, height: u32) -> SumPlane {
        let (width, height) = (width as usize, height as usize);
        SumPlane {
            width,
            height,
            sums: vec![0; width * height],
        }
    }

    fn put(plane: &mut SumPlane, at: UVec2, block: Self::Block) {
        let (x, y) = (at.x as usize * EDGE / 2, at.y as usize * EDGE / 2);
        let width = (EDGE / 2).min(plane.width - x);
        let from = block[quadrant(at)..].chunks(EDGE).take(EDGE / 2);
        let to = plane.sums[y * plane.width..].chunks_mut(plane.width);
        for (to, from) in to.zip(from) {
            for (to, &from) in to[x..x + width].iter_mut().zip(from) {
                *to = from.into();
            }
        }
    }

    fn halved(plane: SumPlane) -> SumPlane {
        let (width, height) = (plane.width.div_ceil(2), plane.height.div_ceil(2));
        let mut sums = Vec::with_capacity(width * height);
        for rows in plane.sums.chunks(2 * plane.width) {
            let (above, below) = rows.split_at(plane.width);
            for x in 0..width {
                let pair = |row: &[u64]| row.iter().skip(2 * x).take(2).sum::<u64>();
                sums.push(pair(above) + pair(below));
            }
        }
        SumPlane {
            width,
            height,
            sums,
        }
    }

    fn plane_values(plane: &SumPlane, level: usize, image: (u32, u32)) -> Vec<T> {
        let count = |at: usize, len| {
            let at = u32::try_from(at).expect("a level is no larger than its image");
            u64::from(covered(at, level, len))
        };
        let columns: Vec<u64> = (0..plane.width).map(|x| count(x, image.0)).collect();
        let rows = plane.sums.chunks_exact(plane.width).enumerate();
        rows.flat_map(|(y, sums)| {
            let rows = count(y, image.1);
            let cells = sums.iter().zip(&columns);
            cells.map(move |(&sum, columns)| mean(sum, columns * rows))
        })
        .collect()
    }
}
