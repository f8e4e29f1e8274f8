//! Which tile each sample takes: geometry alone, before any pixel is read.

use std::cmp::Ordering;
use std::ops::Range;
use std::sync::Arc;

use glam::{DVec2, UVec2};
use saccade_archive::pyramid::{PyramidLevel, SUB_TILE_EDGE};
use saccade_core::levels::Level;
use saccade_core::voxel_box::VoxelBox;

use super::index::IndexedTile;
use super::resample::Interpolation;
use super::tiles::Image;

/// Of the tiles at a sample, those take part whose pixels are at most so many times as large as the
/// smallest ones there \[003 §3.3\].
const ALIKE: f64 = 1.5;

/// What is seen where tiles overlap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Overlaps {
    /// The tile whose centre is nearest.
    #[default]
    NearestCentre,
    /// The mean of all tiles, weighted by how far each reaches from there: by the distance to the
    /// nearest of its edges. Seams fade, which suits light microscopy; what does not match doubles.
    Blend,
}

/// Samples on a section, `size` of them, of which the first is number `first` of the whole level.
#[derive(Clone, Copy, Debug)]
pub(super) struct Grid {
    pub(super) first: UVec2,
    pub(super) size: UVec2,
    /// Between samples \[level-0 voxels\].
    pub(super) step: DVec2,
}

impl Grid {
    /// The voxels of a box, at their z.
    pub(super) fn of_level(level: Level, voxels: VoxelBox) -> Self {
        Self {
            first: voxels.min.truncate(),
            size: voxels.size().truncate(),
            step: level.downsampling.truncate(),
        }
    }

    /// With `by` x `by` samples for each.
    pub(super) fn finer(&self, by: u32) -> Self {
        Self {
            first: self.first * by,
            size: self.size * by,
            step: self.step / f64::from(by),
        }
    }

    /// The level of a tile's pyramid that suits it.
    pub(super) fn level_of(&self, tile: &IndexedTile) -> u32 {
        tile.wanted_level(self.step).min(tile.coarsest_level())
    }

    /// Where sample (x, y) sits \[level-0 voxels\].
    pub(super) fn point(&self, x: u32, y: u32) -> DVec2 {
        self.point_at(self.first + UVec2::new(x, y))
    }

    /// Where a sample sits, by its number in the whole level \[level-0 voxels\].
    fn point_at(&self, number: UVec2) -> DVec2 {
        (number.as_dvec2() + 0.5) * self.step
    }

    /// Corners of all samples \[level-0 voxels\].
    pub(super) fn bounds(&self) -> (DVec2, DVec2) {
        let end = self.first.as_dvec2() + self.size.as_dvec2();
        (self.first.as_dvec2() * self.step, end * self.step)
    }
}

/// Samples of a row that take their values from one tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Segment {
    pub(super) y: u32,
    pub(super) start: u32,
    pub(super) end: u32,
}

/// A tile that may be seen.
#[derive(Clone)]
pub(super) struct Candidate {
    pub(super) tile: Arc<IndexedTile>,
    pub(super) image: Image,
    /// The level of the pyramid that suits the grid.
    pub(super) level: u32,
    /// Whether a blank sub-tile says that nothing is there. One of labels says that there is no object, which
    /// is as much as any other label, and depends on the level.
    blanks_are_holes: bool,
}

impl Candidate {
    /// Of a tile, of labels or not, drawn from an image at a level that suits the grid, see
    /// [`Grid::level_of`].
    pub(super) fn new(tile: Arc<IndexedTile>, image: Image, level: u32, labels: bool) -> Self {
        Self {
            tile,
            image,
            level,
            blanks_are_holes: !labels,
        }
    }

    pub(super) fn size(&self) -> PyramidLevel {
        self.image.level(self.level)
    }

    /// Position \[pixels of the level\] of a sample; pixel `i` covers `[i, i + 1)`.
    pub(super) fn pixel(&self, grid: &Grid, x: u32, y: u32) -> DVec2 {
        self.pixel_at(grid, grid.first + UVec2::new(x, y))
    }

    /// The same of a sample by its number in the whole level, which the tile may be far from.
    pub(super) fn pixel_at(&self, grid: &Grid, number: UVec2) -> DVec2 {
        self.tile.position(grid.point_at(number)) / f64::from(1_u32 << self.level)
    }

    /// How far that position moves from one sample to the next.
    pub(super) fn pixels_along_x(&self, grid: &Grid) -> DVec2 {
        self.tile.tile_from_section.along_x() * grid.step.x / f64::from(1_u32 << self.level)
    }

    /// Whether it is seen where another is that is there as well: its pixels are not much larger.
    pub(super) fn is_fine_beside(&self, other: &Self) -> bool {
        let (own, others) = (self.tile.pixels_per_voxel(), other.tile.pixels_per_voxel());
        others <= own * (ALIKE * ALIKE)
    }

    /// How much it counts for in a mean of tiles at a position \[pixels of its level 0\].
    pub(super) fn weight(&self, position: DVec2) -> f64 {
        // At its edge, where it may be alone, still something.
        const LEAST: f64 = 1e-3;
        let to_edge = position.min(self.tile.size.as_dvec2() - position);
        to_edge.min_element().max(LEAST) / self.tile.pixels_per_voxel().sqrt()
    }

    /// Bounds of the values that it may give to samples, and whether it covers all of them.
    pub(super) fn range(
        &self,
        grid: &Grid,
        interpolation: Interpolation,
    ) -> (Option<(u16, u16)>, bool) {
        let UVec2 { x, y } = grid.size - 1;
        let corners = [(0, 0), (x, 0), (0, y), (x, y)];
        let inside = |(x, y)| self.tile.contains(self.tile.position(grid.point(x, y)));
        let pixels = corners.map(|(x, y)| self.pixel(grid, x, y));
        let min = pixels.into_iter().fold(DVec2::INFINITY, DVec2::min);
        let max = pixels.into_iter().fold(DVec2::NEG_INFINITY, DVec2::max);
        let size = self.size();
        let size = UVec2::new(size.width, size.height).as_dvec2();
        if min.cmpgt(size + 1.0).any() || max.cmplt(DVec2::splat(-1.0)).any() {
            return (None, false);
        }
        let range = self
            .image
            .range(self.level, min, max, interpolation.reach());
        let range = range.map(|range| interpolation.bounds(range));
        let covers = corners.into_iter().all(inside);
        if !self.blanks_are_holes {
            return (range, covers);
        }
        let to_finest = f64::from(1_u32 << self.level);
        let holes = self.image.holes();
        let (some, all) = holes.map_or((false, false), |h| {
            h.within(min * to_finest, max * to_finest)
        });
        // Where the level's pixels are rounded to 0 and something was acquired, samples are 1.
        let range = range.or(Some((0, 0))).filter(|_| !all);
        (range, !some && covers)
    }

    /// Cuts a row where the tile has holes; calls `keep` with the rest.
    fn without_blanks(
        &self,
        grid: &Grid,
        y: u32,
        row: Range<u32>,
        mut keep: impl FnMut(Range<u32>),
    ) {
        let Some(holes) = self.image.holes().filter(|_| self.blanks_are_holes) else {
            return keep(row);
        };
        let mut start = None;
        for x in row.clone() {
            let seen = !holes.has(self.tile.position(grid.point(x, y)));
            match (seen, start) {
                (true, None) => start = Some(x),
                (false, Some(first)) => {
                    keep(first..x);
                    start = None;
                }
                _ => {}
            }
        }
        if let Some(first) = start {
            keep(first..row.end);
        }
    }

    /// `Less` where this tile goes before another at a sample.
    fn compare(&self, other: &Self, point: DVec2) -> Ordering {
        let distance = |c: &Self| point.distance_squared(c.tile.centre);
        let nearer = distance(self).total_cmp(&distance(other));
        nearer.then(other.tile.age().cmp(&self.tile.age()))
    }

    /// The sub-tiles that the samples of these segments touch.
    pub(super) fn sub_tiles(
        &self,
        grid: &Grid,
        segments: &[Segment],
        interpolation: Interpolation,
    ) -> Vec<UVec2> {
        const PIECE: u32 = 32;
        // More than positions are off by in fixed point.
        const MARGIN: f64 = 1e-3;
        let size = self.size();
        let last = DVec2::new(f64::from(size.width - 1), f64::from(size.height - 1));
        let columns = size.sub_tiles.x;
        let reach = interpolation.reach();
        let mut wanted = vec![false; (columns * size.sub_tiles.y) as usize];
        for segment in segments {
            let mut start = segment.start;
            while start < segment.end {
                let end = (start + PIECE).min(segment.end);
                let a = self.pixel(grid, start, segment.y);
                let b = self.pixel(grid, end - 1, segment.y);
                // Between the centres of pixels in each direction.
                let low = (a.min(b) - (0.5 + MARGIN)).floor() - (reach - 1.0);
                let high = (a.max(b) - (0.5 - MARGIN)).floor() + reach;
                let low = low.clamp(DVec2::ZERO, last).as_uvec2() / SUB_TILE_EDGE;
                let high = high.clamp(DVec2::ZERO, last).as_uvec2() / SUB_TILE_EDGE;
                for y in low.y..=high.y {
                    for x in low.x..=high.x {
                        wanted[(y * columns + x) as usize] = true;
                    }
                }
                start = end;
            }
        }
        let wanted = (0..).zip(wanted).filter(|(_, wanted)| *wanted);
        wanted
            .map(|(n, _)| UVec2::new(n % columns, n / columns))
            .collect()
    }
}

/// The samples of a row that lie in a tile's rectangle.
fn row_within(tile: &IndexedTile, grid: &Grid, y: u32) -> Range<u32> {
    let inside = |x| tile.contains(tile.position(grid.point(x, y)));
    let first = tile.position(grid.point(0, y));
    let along = tile.tile_from_section.along_x() * grid.step.x;
    let size = tile.size.as_dvec2();
    let width = f64::from(grid.size.x);
    let (mut low, mut high) = (0.0_f64, width);
    for (first, along, size) in [(first.x, along.x, size.x), (first.y, along.y, size.y)] {
        // A row that runs along an edge is judged sample by sample at its ends, below.
        if along.abs() * width > 1e-9 {
            let (a, b) = (-first / along, (size - first) / along);
            (low, high) = (low.max(a.min(b)), high.min(a.max(b)));
        }
    }
    if high < low - 1.0 {
        return 0..0;
    }
    // Rounding may have moved the ends by a sample: the samples themselves decide.
    let whole = |v: f64| DVec2::splat(v.clamp(0.0, width)).as_uvec2().x;
    let (mut start, mut end) = (whole(low.floor() - 1.0), whole(high.ceil() + 1.0));
    while start < end && !inside(start) {
        start += 1;
    }
    while end > start && !inside(end - 1) {
        end -= 1;
    }
    start..end
}

/// Samples that no tile was found for yet: of each row, what is left.
pub(super) struct Uncovered {
    rows: Vec<Vec<Range<u32>>>,
}

impl Uncovered {
    pub(super) fn all(grid: &Grid) -> Self {
        let row = if grid.size.x == 0 {
            0..0
        } else {
            0..grid.size.x
        };
        Self {
            rows: vec![vec![row]; grid.size.y as usize],
        }
    }

    pub(super) fn none(grid: &Grid) -> Self {
        Self {
            rows: vec![Vec::new(); grid.size.y as usize],
        }
    }

    /// The rows of samples of a row of voxels of `by` x `by` samples, and where its samples begin and end.
    fn rows_of(
        &mut self,
        by: u32,
        row: u32,
        voxels: Range<u32>,
    ) -> (&mut [Vec<Range<u32>>], Range<u32>) {
        let rows = (row * by) as usize..((row + 1) * by) as usize;
        (&mut self.rows[rows], voxels.start * by..voxels.end * by)
    }

    /// Adds some voxels of a row, of `by` x `by` samples each, none of which is there.
    pub(super) fn add(&mut self, by: u32, row: u32, voxels: Range<u32>) {
        let (rows, samples) = self.rows_of(by, row, voxels);
        for left in rows {
            left.push(samples.clone());
        }
    }

    /// Takes away some voxels of a row, of `by` x `by` samples each.
    pub(super) fn remove(&mut self, by: u32, row: u32, voxels: Range<u32>) {
        let (rows, samples) = self.rows_of(by, row, voxels);
        for left in rows {
            take(left, samples.clone(), |_| {});
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.rows.iter().all(Vec::is_empty)
    }

    /// Whether a tile's rectangle holds a sample that is left.
    pub(super) fn touches(&self, grid: &Grid, tile: &IndexedTile) -> bool {
        let row_at = |y: f64| (y / grid.step.y - f64::from(grid.first.y)).max(0.0);
        // A row more on either side, since these are rounded.
        let low = DVec2::splat(row_at(tile.min.y).floor() - 1.0).as_uvec2().x;
        let high = DVec2::splat(row_at(tile.max.y).ceil() + 1.0).as_uvec2().x;
        (low..high.min(grid.size.y)).any(|y| {
            let (left, height) = (&self.rows[y as usize], grid.point(0, y).y);
            if left.is_empty() || height < tile.min.y || tile.max.y < height {
                return false;
            }
            let row = row_within(tile, grid, y);
            !row.is_empty() && left.iter().any(|l| l.start < row.end && row.start < l.end)
        })
    }

    /// Gives what is left to the candidates that cover it; returns each one's segments. Blended ones
    /// have samples in common.
    pub(super) fn cover(
        &mut self,
        grid: &Grid,
        overlaps: Overlaps,
        candidates: &[Candidate],
    ) -> Vec<Vec<Segment>> {
        let mut segments = vec![Vec::new(); candidates.len()];
        let mut pieces = Vec::new();
        let mut ends = Vec::new();
        for (y, left) in (0..).zip(&mut self.rows) {
            if left.is_empty() {
                continue;
            }
            pieces.clear();
            let height = grid.point(0, y).y;
            for (n, candidate) in candidates.iter().enumerate() {
                if candidate.tile.min.y <= height && height <= candidate.tile.max.y {
                    let row = row_within(&candidate.tile, grid, y);
                    if !row.is_empty() {
                        candidate.without_blanks(grid, y, row, |piece| pieces.push((n, piece)));
                    }
                }
            }
            let rules = (grid, overlaps, candidates);
            winners(rules, y, &mut pieces, &mut ends, |seen, run| {
                take(left, run, |part| {
                    for n in seen {
                        segments[*n].push(Segment {
                            y,
                            start: part.start,
                            end: part.end,
                        });
                    }
                });
            });
        }
        segments
    }
}

/// Takes `won` out of the ranges `left`; calls `part` with what was in both.
fn take(left: &mut Vec<Range<u32>>, won: Range<u32>, mut part: impl FnMut(Range<u32>)) {
    let mut n = 0;
    while n < left.len() {
        let range = left[n].clone();
        let both = range.start.max(won.start)..range.end.min(won.end);
        if both.is_empty() {
            n += 1;
            continue;
        }
        let rests = [range.start..both.start, both.end..range.end];
        let rests = rests.into_iter().filter(|r| !r.is_empty());
        let count = rests.clone().count();
        left.splice(n..=n, rests);
        n += count;
        part(both);
    }
}

/// Calls `won` with the candidates that are seen in each run of samples.
fn winners(
    (grid, overlaps, candidates): (&Grid, Overlaps, &[Candidate]),
    y: u32,
    pieces: &mut [(usize, Range<u32>)],
    ends: &mut Vec<u32>,
    mut won: impl FnMut(&[usize], Range<u32>),
) {
    pieces.sort_unstable_by_key(|(n, piece)| (piece.start, *n));
    let apart = pieces.windows(2).all(|p| p[0].1.end <= p[1].1.start);
    if apart {
        for (n, piece) in pieces {
            won(&[*n], piece.clone());
        }
        return;
    }
    // Between two neighbouring `ends` the same pieces are there, in the same order of preference.
    ends.clear();
    for (n, (a, piece)) in pieces.iter().enumerate() {
        ends.extend([piece.start, piece.end]);
        if overlaps == Overlaps::Blend {
            continue;
        }
        let later = pieces[n + 1..].iter();
        for (b, other) in later.take_while(|(_, other)| other.start < piece.end) {
            let both = other.start..piece.end.min(other.end);
            let before = |x| {
                candidates[*a]
                    .compare(&candidates[*b], grid.point(x, y))
                    .is_lt()
            };
            // Which of two centres is nearer changes once along a row at most.
            let at_end = before(both.end - 1);
            if before(both.start) != at_end {
                let (mut low, mut high) = (both.start, both.end - 1);
                while high - low > 1 {
                    let middle = low.midpoint(high);
                    if before(middle) == at_end {
                        high = middle;
                    } else {
                        low = middle;
                    }
                }
                ends.push(high);
            }
        }
    }
    ends.sort_unstable();
    ends.dedup();
    let mut seen = Vec::new();
    for run in ends.windows(2) {
        let (start, end) = (run[0], run[1]);
        let here = pieces.iter().filter(|(_, p)| p.contains(&start));
        seen.clear();
        seen.extend(here.map(|(n, _)| *n));
        let pixels = |n: &&usize| candidates[**n].tile.pixels_per_voxel();
        let finest = seen.iter().max_by(|a, b| pixels(a).total_cmp(&pixels(b)));
        if let Some(&finest) = finest {
            seen.retain(|n| candidates[*n].is_fine_beside(&candidates[finest]));
        }
        if overlaps == Overlaps::NearestCentre {
            let point = grid.point(start, y);
            let nearest = |a: &&usize, b: &&usize| candidates[**a].compare(&candidates[**b], point);
            let first = seen.iter().min_by(nearest).copied();
            seen.clear();
            seen.extend(first);
        }
        if !seen.is_empty() {
            won(&seen, start..end);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn taking_leaves_the_rest(
            taken in prop::collection::vec((0..40_u32, 0..40_u32), 0..8),
        ) {
            let mut left = Vec::from_iter(std::iter::once(0..40));
            let mut seen = [false; 40];
            for (a, b) in taken {
                let won = a.min(b)..a.max(b);
                let mut got = [false; 40];
                take(&mut left, won.clone(), |part| part.for_each(|x| got[x as usize] = true));
                for x in 0..40 {
                    let before = seen[x as usize];
                    prop_assert_eq!(got[x as usize], won.contains(&x) && !before);
                    seen[x as usize] |= won.contains(&x);
                    let is_left = left.iter().any(|r| r.contains(&x));
                    prop_assert_eq!(is_left, !seen[x as usize]);
                }
            }
        }
    }
}
