//! Draws what tiles give to a section of a block.

use glam::UVec2;
use rayon::prelude::*;

use super::build::{Part, Rules};
use super::coverage::{Grid, Overlaps, Segment};
use super::error::StitchError;
use super::resample::{Kept, Patch, Sample, averaged, fine_number, most_frequent};
use super::tiles::{Fetched, Tiles};

/// Samples of a row of a level from one line's beginning to the next. Blocks begin there as well.
const LINE: u32 = 512;

/// Samples that are drawn along one line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Piece {
    segment: Segment,
    /// The line's first sample, by its number in the level.
    first: UVec2,
    /// Samples of the line before these.
    skip: usize,
}

/// Cuts a segment where lines begin: at places that are the same whatever else is drawn.
fn pieces(grid: &Grid, segment: Segment) -> impl Iterator<Item = Piece> + use<> {
    let Segment { y, start, end } = segment;
    let (left, row) = (grid.first.x, grid.first.y + y);
    let lines = (left + start) / LINE..(left + end).div_ceil(LINE);
    lines.map(move |line| {
        let first = line * LINE;
        let start = start.max(first.saturating_sub(left));
        let segment = Segment {
            y,
            start,
            end: end.min(first.saturating_add(LINE) - left),
        };
        Piece {
            segment,
            first: UVec2::new(first, row),
            skip: (left + start - first) as usize,
        }
    })
}

/// Samples of a grid, `by` x `by` of each voxel, 0 where nothing is drawn yet.
pub(super) struct Canvas<S: Sample> {
    grid: Grid,
    by: u32,
    rules: Rules,
    samples: Samples<S>,
}

/// Rounded only where nothing is done with them after, so that voxels are rounded once.
enum Samples<S: Sample> {
    /// Each is a voxel.
    Voxels(Vec<S>),
    /// Several make a voxel.
    Fine(Vec<S::Fine>),
    /// Several labels make a voxel: these, and where a tile is, also one that has 0 there.
    Votes(Vec<S>, Vec<bool>),
    /// Where tiles are blended: sums of weighted values, and of weights.
    Sums(Vec<(f32, f32)>),
}

impl<S: Sample> Canvas<S> {
    pub(super) fn new(grid: Grid, by: u32, rules: Rules) -> Self {
        let samples = grid.size.as_usizevec2().element_product();
        let samples = match (rules.overlaps, by) {
            (Overlaps::Blend, _) => Samples::Sums(vec![(0.0, 0.0); samples]),
            (Overlaps::NearestCentre, 1) => Samples::Voxels(vec![S::default(); samples]),
            (Overlaps::NearestCentre, _) if rules.labels => {
                Samples::Votes(vec![S::default(); samples], vec![false; samples])
            }
            (Overlaps::NearestCentre, _) => Samples::Fine(vec![S::Fine::default(); samples]),
        };
        Self {
            grid,
            by,
            rules,
            samples,
        }
    }

    /// Decodes what a tile gives and draws it.
    pub(super) fn draw(
        &mut self,
        tiles: &Tiles,
        part: &Part,
        fetched: Vec<(UVec2, Fetched)>,
    ) -> Result<(), StitchError> {
        let candidate = &part.candidate;
        let decode = |(at, fetched)| {
            let (section, level) = (candidate.tile.section, candidate.level);
            let voxels = tiles.decode(section, level, at, fetched)?;
            Ok((at, voxels))
        };
        let decoded: Result<Vec<_>, StitchError> = fetched.into_par_iter().map(decode).collect();
        let patch = Patch::<S>::of_sub_tiles(candidate.size(), &decoded?);
        let along = candidate.pixels_along_x(&self.grid);
        let interpolation = self.rules.interpolation;
        let mut row = Vec::new();
        let grid = self.grid;
        for segment in part.segments.iter().flat_map(|s| pieces(&grid, *s)) {
            let Piece {
                segment,
                first,
                skip,
            } = segment;
            let begin = segment.y as usize * grid.size.x as usize;
            let place = begin + segment.start as usize..begin + segment.end as usize;
            let line = (candidate.pixel_at(&grid, first), along);
            match &mut self.samples {
                Samples::Voxels(values) if self.rules.labels => {
                    patch.labels_from(line, skip, &mut values[place]);
                }
                Samples::Votes(values, there) => {
                    there[place.clone()].fill(true);
                    patch.labels_from(line, skip, &mut values[place]);
                }
                Samples::Voxels(values) => {
                    patch.sample_from(interpolation, line, skip, &mut values[place]);
                }
                Samples::Fine(values) => {
                    patch.sample_from(interpolation, line, skip, &mut values[place]);
                }
                Samples::Sums(sums) => {
                    row.resize(place.len(), S::Fine::default());
                    patch.sample_from(interpolation, line, skip, &mut row);
                    add::<S>(&mut sums[place], &grid, part, segment, &row);
                }
            }
        }
        Ok(())
    }

    /// The voxels.
    pub(super) fn finish(self) -> Vec<S> {
        let (size, by) = (self.grid.size / self.by, self.by);
        match self.samples {
            Samples::Voxels(voxels) => voxels,
            Samples::Fine(values) => averaged(&values, size, by),
            Samples::Votes(values, there) => most_frequent(&values, &there, size, by),
            Samples::Sums(sums) if by == 1 => sums.into_iter().map(blended).collect(),
            Samples::Sums(sums) => {
                let values: Vec<S::Fine> = sums.into_iter().map(blended::<S, _>).collect();
                averaged(&values, size, by)
            }
        }
    }
}

/// Adds a segment's values to its sums.
fn add<S: Sample>(
    sums: &mut [(f32, f32)],
    grid: &Grid,
    part: &Part,
    segment: Segment,
    values: &[S::Fine],
) {
    let candidate = &part.candidate;
    for ((x, value), (sum, weights)) in (segment.start..).zip(values).zip(sums) {
        let position = candidate.tile.position(grid.point(x, segment.y));
        #[expect(
            clippy::cast_possible_truncation,
            reason = "a weight of seven digits is good enough for values of five"
        )]
        let weight = candidate.weight(position) as f32;
        *sum += weight * fine_number(*value);
        *weights += weight;
    }
}

/// What tiles that are blended give together.
fn blended<S: Sample, K: Kept<S>>((sum, weights): (f32, f32)) -> K {
    match weights {
        0.0 => K::default(),
        _ => K::of_number(sum / weights),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec2;

    #[test]
    fn pieces_are_a_segment_cut_where_lines_begin() {
        for (left, start, end) in [
            (0, 0, 512),
            (1024, 3, 511),
            (1020, 0, 1100),
            (7, 505, 506),
            (7, 100, 505),
        ] {
            let grid = Grid {
                first: UVec2::new(left, 30),
                size: UVec2::new(2000, 9),
                step: DVec2::ONE,
            };
            let mut next = start;
            for piece in pieces(&grid, Segment { y: 4, start, end }) {
                let Piece {
                    segment,
                    first,
                    skip,
                } = piece;
                assert_eq!((segment.start, segment.y, first.y), (next, 4, 34));
                assert_eq!(first.x % LINE, 0);
                assert_eq!(
                    u64::from(left + segment.start),
                    u64::from(first.x) + skip as u64
                );
                assert!(segment.start < segment.end && left + segment.end <= first.x + LINE);
                next = segment.end;
            }
            assert_eq!(next, end);
        }
    }
}
