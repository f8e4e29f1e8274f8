//! The most frequent label: votes are kept, and counted once per level.
//!
//! A pixel of level k has the label that most of the level-0 pixels it covers have; of several, the
//! smallest. Labels cannot be averaged, and the winner of winners need not be the winner: votes are kept
//! for all labels. That costs memory where labels change, up to 8 bytes per pixel of an image in which
//! no two neighbours are alike; inside of cells there is one entry per pixel.

use std::marker::PhantomData;

use glam::UVec2;

use super::SUB_TILE_VOXELS;
use super::filter::{EDGE, Filter, quadrant};
use super::voxel::pixel::Pixel;

/// Takes the most frequent value.
pub(super) struct Mode<T>(PhantomData<T>);

/// How many of the pixels that a pixel covers have which label.
#[derive(Clone, Debug, Default)]
pub(super) struct Votes<T> {
    /// The only label and its votes, if `all` is empty; no votes: nothing is covered.
    only: (T, u32),
    /// Two labels or more, in ascending order.
    all: Vec<(T, u32)>,
}

impl<T: Pixel> Votes<T> {
    fn get(&self) -> &[(T, u32)] {
        match self.only {
            _ if !self.all.is_empty() => &self.all,
            (_, 0) => &[],
            _ => std::slice::from_ref(&self.only),
        }
    }

    fn one(label: T) -> Self {
        Self {
            only: (label, 1),
            all: Vec::new(),
        }
    }

    /// Adds other votes.
    fn add(&mut self, other: &Self) {
        match (self.get(), other.get()) {
            (_, []) => {}
            ([], _) => self.clone_from(other),
            (&[(label, votes)], &[(same, more)]) if label == same => self.only.1 = votes + more,
            (mut a, mut b) => {
                let mut all = Vec::with_capacity(a.len() + b.len());
                while let (Some(&x), Some(&y)) = (a.first(), b.first()) {
                    let (less, more) = (x.0 <= y.0, y.0 <= x.0);
                    let votes = u32::from(less) * x.1 + u32::from(more) * y.1;
                    all.push((x.0.min(y.0), votes));
                    a = &a[usize::from(less)..];
                    b = &b[usize::from(more)..];
                }
                all.extend_from_slice(a);
                all.extend_from_slice(b);
                self.all = all;
            }
        }
    }

    /// The winner; of several the smallest.
    fn winner(&self) -> T {
        let none = (T::default(), 0);
        let best = self.get().iter().fold(
            none,
            |best, vote| if vote.1 > best.1 { *vote } else { best },
        );
        best.0
    }
}

/// The votes of a whole level.
#[derive(Debug)]
pub(super) struct VotePlane<T> {
    width: usize,
    votes: Vec<Votes<T>>,
}

impl<T: Pixel> Filter for Mode<T> {
    type Pixel = T;
    type Block = Vec<Votes<T>>;
    type Plane = VotePlane<T>;

    fn block() -> Self::Block {
        vec![Votes::default(); SUB_TILE_VOXELS]
    }

    fn clear(block: &mut Self::Block) {
        block.fill(Votes::default());
    }

    fn take_pixels(
        block: &mut Self::Block,
        at: UVec2,
        pixels: &[T],
        pitch: usize,
        (width, height): (usize, usize),
    ) {
        for (y, row) in pixels.chunks(pitch).take(height).enumerate() {
            let to = &mut block[quadrant(at) + y / 2 * EDGE..];
            for (x, &label) in row[..width].iter().enumerate() {
                to[x / 2].add(&Votes::one(label));
            }
        }
    }

    fn take_block(block: &mut Self::Block, at: UVec2, finer: &Self::Block) {
        for (y, row) in finer.chunks_exact(EDGE).enumerate() {
            let to = &mut block[quadrant(at) + y / 2 * EDGE..];
            for (x, votes) in row.iter().enumerate() {
                to[x / 2].add(votes);
            }
        }
    }

    fn values(
        block: &Self::Block,
        _: usize,
        _: (usize, usize),
        _: (u32, u32),
        to: &mut [T; SUB_TILE_VOXELS],
    ) {
        for (to, votes) in to.iter_mut().zip(block) {
            *to = votes.winner();
        }
    }

    fn plane(width: u32, height: u32) -> VotePlane<T> {
        let (width, height) = (width as usize, height as usize);
        VotePlane {
            width,
            votes: vec![Votes::default(); width * height],
        }
    }

    fn put(plane: &mut VotePlane<T>, at: UVec2, mut block: Self::Block) {
        let (x, y) = (at.x as usize * EDGE / 2, at.y as usize * EDGE / 2);
        let width = (EDGE / 2).min(plane.width - x);
        let from = block[quadrant(at)..].chunks_mut(EDGE).take(EDGE / 2);
        let to = plane.votes[y * plane.width..].chunks_mut(plane.width);
        for (to, from) in to.zip(from) {
            to[x..x + width].swap_with_slice(&mut from[..width]);
        }
    }

    fn halved(plane: VotePlane<T>) -> VotePlane<T> {
        let width = plane.width.div_ceil(2);
        let height = (plane.votes.len() / plane.width).div_ceil(2);
        let mut votes = vec![Votes::default(); width * height];
        for (i, finer) in plane.votes.into_iter().enumerate() {
            let (x, y) = (i % plane.width, i / plane.width);
            votes[y / 2 * width + x / 2].add(&finer);
        }
        VotePlane { width, votes }
    }

    fn plane_values(plane: &VotePlane<T>, _: usize, _: (u32, u32)) -> Vec<T> {
        plane.votes.iter().map(Votes::winner).collect()
    }
}
