//! Draws what tiles give to a section of a block.

use glam::UVec2;
use rayon::prelude::*;

use super::build::{Part, Rules};
use super::coverage::{Grid, Overlaps, Segment};
use super::error::StitchError;
use super::resample::{Patch, Sample, averaged, most_frequent};
use super::tiles::{Fetched, Tiles};

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
        let mut row = Vec::new();
        for segment in &part.segments {
            let first = segment.y as usize * self.grid.size.x as usize;
            let place = first + segment.start as usize..first + segment.end as usize;
            let pixel = candidate.pixel(&self.grid, segment.start, segment.y);
            let interpolation = self.rules.interpolation;
            if self.rules.labels {
                if let Some(there) = self.there.get_mut(place.clone()) {
                    there.fill(true);
                }
                patch.labels(pixel, along, &mut self.values[place]);
            } else if self.rules.overlaps == Overlaps::NearestCentre {
                patch.sample(interpolation, pixel, along, &mut self.values[place]);
            } else {
                row.resize(place.len(), S::default());
                patch.sample(interpolation, pixel, along, &mut row);
                self.add(part, *segment, &row);
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
