//! Draws what tiles give to a section of a block.

use glam::UVec2;
use rayon::prelude::*;

use super::build::{Part, Rules};
use super::coverage::{Grid, Overlaps, Segment};
use super::error::StitchError;
use super::resample::{Patch, Sample, averaged, most_frequent};
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
pub(super) struct Canvas<S> {
    grid: Grid,
    by: u32,
    rules: Rules,
    values: Vec<S>,
    /// Of labels of which several make a voxel: where a tile is, also one that has 0 there.
    there: Vec<bool>,
    /// Where tiles are blended: sums of weighted values, and of weights.
    sums: Vec<(f32, f32)>,
}

impl<S: Sample> Canvas<S> {
    pub(super) fn new(grid: Grid, by: u32, rules: Rules) -> Self {
        let samples = grid.size.as_usizevec2().element_product();
        let votes = rules.labels && by > 1;
        let (values, sums) = match rules.overlaps {
            Overlaps::NearestCentre => (vec![S::default(); samples], Vec::new()),
            Overlaps::Blend => (Vec::new(), vec![(0.0, 0.0); samples]),
        };
        Self {
            grid,
            by,
            rules,
            values,
            there: vec![false; if votes { samples } else { 0 }],
            sums,
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
            if self.rules.labels {
                if let Some(there) = self.there.get_mut(place.clone()) {
                    there.fill(true);
                }
                patch.labels_from(line, skip, &mut self.values[place]);
            } else if self.rules.overlaps == Overlaps::NearestCentre {
                patch.sample_from(interpolation, line, skip, &mut self.values[place]);
            } else {
                row.resize(place.len(), S::default());
                patch.sample_from(interpolation, line, skip, &mut row);
                self.add(part, segment, &row);
            }
        }
        Ok(())
    }

    /// Adds a segment's values to the sums.
    fn add(&mut self, part: &Part, segment: Segment, values: &[S]) {
        let candidate = &part.candidate;
        let first = segment.y as usize * self.grid.size.x as usize;
        let sums = &mut self.sums[first + segment.start as usize..first + segment.end as usize];
        for ((x, value), (sum, weights)) in (segment.start..).zip(values).zip(sums) {
            let position = candidate.tile.position(self.grid.point(x, segment.y));
            #[expect(
                clippy::cast_possible_truncation,
                reason = "a weight of seven digits is good enough for values of five"
            )]
            let weight = candidate.weight(position) as f32;
            *sum += weight * value.number();
            *weights += weight;
        }
    }

    /// The voxels.
    pub(super) fn finish(self) -> Vec<S> {
        let size = self.grid.size / self.by;
        let samples = match self.rules.overlaps {
            Overlaps::NearestCentre => self.values,
            Overlaps::Blend => {
                let mean = |(sum, weights): (f32, f32)| match weights {
                    0.0 => S::default(),
                    _ => S::rounded(sum / weights),
                };
                self.sums.into_iter().map(mean).collect()
            }
        };
        match self.by {
            1 => samples,
            by if self.rules.labels => most_frequent(&samples, &self.there, size, by),
            by => averaged(&samples, size, by),
        }
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
