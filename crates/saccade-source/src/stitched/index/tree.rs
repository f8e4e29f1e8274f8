//! Rectangles in a static tree that is one array: no pointers, 17 bytes each.
//!
//! The rectangles come in the order of a Hilbert curve, so that neighbours in the array are neighbours
//! in the plane; every [`FANOUT`] of them get a rectangle around them, every [`FANOUT`] of those again,
//! up to the root.

use std::ops::Range;

use glam::DVec2;

/// Rectangles below one of the next level.
const FANOUT: usize = 16;

/// Half the precision of what it stands for, rounded outward.
#[derive(Clone, Copy, Debug)]
struct Rectangle {
    min: [f32; 2],
    max: [f32; 2],
}

impl Rectangle {
    fn around(min: DVec2, max: DVec2) -> Self {
        Self {
            min: [below(min.x), below(min.y)],
            max: [-below(-max.x), -below(-max.y)],
        }
    }

    fn union(self, other: Self) -> Self {
        let min = |n: usize| self.min[n].min(other.min[n]);
        let max = |n: usize| self.max[n].max(other.max[n]);
        Self {
            min: [min(0), min(1)],
            max: [max(0), max(1)],
        }
    }

    fn touches(&self, other: &Self) -> bool {
        let along = |n: usize| self.min[n] <= other.max[n] && self.max[n] >= other.min[n];
        along(0) & along(1)
    }
}

/// The largest f32 that is not larger.
fn below(value: f64) -> f32 {
    #[expect(
        clippy::cast_possible_truncation,
        reason = "rounds, which the next line mends"
    )]
    let near = value as f32;
    if f64::from(near) > value {
        near.next_down()
    } else {
        near
    }
}

#[derive(Debug)]
pub(super) struct PackedTree {
    /// What was put in, then the rectangles around groups of them, and so on; the root last.
    rectangles: Box<[Rectangle]>,
    /// Where each level begins in `rectangles`, and where the last one ends.
    levels: Box<[usize]>,
}

impl PackedTree {
    /// Of rectangles `(min, max)` in an order that keeps neighbours together, see [`hilbert_order`].
    pub(super) fn new(bounds: impl ExactSizeIterator<Item = (DVec2, DVec2)>) -> Self {
        let mut rectangles = Vec::with_capacity(bounds.len() + bounds.len() / (FANOUT - 1) + 8);
        rectangles.extend(bounds.map(|(min, max)| Rectangle::around(min, max)));
        let mut levels = vec![0, rectangles.len()];
        let mut begin = 0;
        while rectangles.len() - begin > FANOUT {
            let end = rectangles.len();
            for first in (begin..end).step_by(FANOUT) {
                let group = &rectangles[first..(first + FANOUT).min(end)];
                let around = group.iter().copied().reduce(Rectangle::union);
                rectangles.extend(around);
            }
            begin = end;
            levels.push(rectangles.len());
        }
        Self {
            rectangles: rectangles.into(),
            levels: levels.into(),
        }
    }

    /// Calls `found` with the number of each rectangle that may touch this one: all that do, and
    /// hardly others.
    pub(super) fn touching(&self, min: DVec2, max: DVec2, mut found: impl FnMut(usize)) {
        let top = self.levels.len() - 2;
        let wanted = Rectangle::around(min, max);
        self.visit(top, 0..self.count(top), &wanted, &mut found);
    }

    fn count(&self, level: usize) -> usize {
        self.levels[level + 1] - self.levels[level]
    }

    fn visit(
        &self,
        level: usize,
        numbers: Range<usize>,
        wanted: &Rectangle,
        found: &mut impl FnMut(usize),
    ) {
        let all = &self.rectangles[self.levels[level]..self.levels[level + 1]];
        for number in numbers {
            if !all[number].touches(wanted) {
            } else if level == 0 {
                found(number);
            } else {
                let first = number * FANOUT;
                let end = (first + FANOUT).min(self.count(level - 1));
                self.visit(level - 1, first..end, wanted, found);
            }
        }
    }

    /// Memory on the heap \[bytes\].
    pub(super) fn bytes(&self) -> usize {
        size_of_val(&*self.rectangles) + size_of_val(&*self.levels)
    }
}

/// The order of points along a Hilbert curve through all of them.
pub(super) fn hilbert_order(points: &[DVec2]) -> Vec<usize> {
    let min = points.iter().copied().fold(DVec2::INFINITY, DVec2::min);
    let max = points.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
    let scale = f64::from(u16::MAX) / (max - min).max(DVec2::splat(f64::MIN_POSITIVE));
    let place = |point: &DVec2| {
        let cell = ((*point - min) * scale).as_uvec2();
        hilbert(cell.x.min(0xffff), cell.y.min(0xffff))
    };
    let mut order: Vec<(u32, usize)> = points.iter().map(place).zip(0..).collect();
    order.sort_unstable();
    order.into_iter().map(|(_, number)| number).collect()
}

/// How far along the curve a cell lies, of 2^16 x 2^16.
fn hilbert(mut x: u32, mut y: u32) -> u32 {
    let mut distance = 0;
    for bit in (0..16).rev() {
        let (right, up) = (x >> bit & 1, y >> bit & 1);
        distance = distance << 2 | ((3 * right) ^ up);
        // Each quarter is the whole, turned so that its ends meet its neighbours'.
        if up == 0 {
            if right == 1 {
                (x, y) = (!x, !y);
            }
            (x, y) = (y, x);
        }
    }
    distance
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_curve_passes_every_cell_and_makes_no_jumps() {
        let mut cells: Vec<(u32, u32)> =
            (0..32).flat_map(|y| (0..32).map(move |x| (x, y))).collect();
        cells.sort_by_key(|(x, y)| hilbert(x << 11, y << 11));
        for pair in cells.windows(2) {
            let ((a, b), (c, d)) = (pair[0], pair[1]);
            assert_eq!(a.abs_diff(c) + b.abs_diff(d), 1, "{pair:?}");
        }
    }

    #[test]
    fn rounding_is_outward() {
        for value in [0.0, 0.1, -0.1, 16_777_217.0, -16_777_217.0, 1e300, -1e300] {
            assert!(f64::from(below(value)) <= value, "{value}");
            assert!(f64::from(-below(-value)) >= value, "{value}");
        }
    }

    proptest! {
        #[test]
        fn finds_all_that_touch(
            all in prop::collection::vec((-1e6..1e6, -1e6..1e6, 0.0..1e5, 0.0..1e5), 0..900),
            x in -1e6..1e6, y in -1e6..1e6, w in 0.0..3e5, h in 0.0..3e5,
        ) {
            let rectangle = |(x, y, w, h)| (DVec2::new(x, y), DVec2::new(x + w, y + h));
            let all: Vec<_> = all.into_iter().map(rectangle).collect();
            let middles: Vec<_> = all.iter().map(|(min, max)| (*min + *max) / 2.0).collect();
            let order = hilbert_order(&middles);
            let tree = PackedTree::new(order.iter().map(|n| all[*n]));
            let (min, max) = rectangle((x, y, w, h));
            let mut found = Vec::new();
            tree.touching(min, max, |n| found.push(order[n]));
            found.sort_unstable();
            let touching = |n: &usize| {
                let (low, high) = all[*n];
                low.cmple(max).all() && high.cmpge(min).all()
            };
            let want: Vec<_> = (0..all.len()).filter(touching).collect();
            prop_assert!(want.iter().all(|n| found.binary_search(n).is_ok()));
            // What rounding adds misses by less than a voxel.
            let near = |n: &usize| {
                let (low, high) = all[*n];
                low.cmple(max + 1.0).all() && high.cmpge(min - 1.0).all()
            };
            prop_assert!(found.iter().all(near));
            prop_assert!(found.windows(2).all(|pair| pair[0] < pair[1]), "each once");
        }
    }
}
