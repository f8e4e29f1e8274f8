//! Which of the bricks that a frame misses are asked for: not those that hold nothing to be seen.

use std::collections::HashSet;

use saccade_core::brick::BrickId;
use saccade_core::voxel_box::VoxelBox;
use saccade_source::ChunkId;

use super::{MOST_TOLD, Session};
use crate::brick::{chunks_of, range_of};
use crate::host_cache::is_touched;

/// Chunks whose bounds are looked up together.
const RANGES_TOGETHER: usize = 128;

impl Session {
    /// Forgets the bounds of what changed. What changes again and again is not waited for.
    pub(super) fn forget_ranges(&mut self, voxels: VoxelBox) {
        let volume = self.renderer.volume();
        let touched = |chunk: &ChunkId| is_touched(*chunk, volume, voxels);
        self.ranges.retain(|chunk, _| !touched(chunk));
        if self.searched.1.iter().any(touched) {
            if self.lost.len() > MOST_TOLD {
                self.lost.clear();
            }
            let (bricks, _) = std::mem::take(&mut self.searched);
            self.lost.extend(bricks);
            self.requests.drop_ranges();
        }
    }

    /// Wants what the newest report misses, but for what is hidden, or may be as far as is known.
    pub(super) fn want_missed(&mut self) {
        let Some(report) = &self.report else {
            return;
        };
        if report.starved {
            // It would find no room.
            let frame = report.frame;
            self.pull.want(frame, &[]);
            return;
        }
        let (frame, misses) = (report.frame, report.misses.clone());
        // What a frame does not know yet it misses.
        let knows = report.octree_is_current.then_some(frame);
        let (hidden, unknown) = self.hidden(&misses, knows);
        let seen = misses.into_iter();
        let seen = seen.filter(|id| !hidden.contains(id) && !unknown.contains(id));
        self.pull.want(frame, &seen.collect::<Vec<_>>());
        // Without what is hidden, the next frame may be complete.
        self.dirty |= !hidden.is_empty();
    }

    /// Of the bricks missed, those that the source knows to hold nothing that can be seen, and those of
    /// which that is being looked up. The renderer is told of the former, once: a brick that is missed
    /// again, by a frame that knows, is needed.
    fn hidden(
        &mut self,
        misses: &[BrickId],
        knows: Option<u64>,
    ) -> (HashSet<BrickId>, HashSet<BrickId>) {
        if self.told.len() > MOST_TOLD {
            self.told.clear();
        }
        let volume = self.renderer.volume().clone();
        let (mut hidden, mut unknown) = (HashSet::new(), HashSet::new());
        let (mut bricks, mut chunks) = (HashSet::new(), Vec::new());
        let mut seen = HashSet::new();
        for &id in misses {
            if let Some(told) = self.told.get(&id) {
                if told.is_some_and(|first| knows.is_none_or(|frame| frame < first)) {
                    hidden.insert(id);
                }
                continue;
            }
            let (ranges, requests) = (&self.ranges, &self.requests);
            let known = |chunk| {
                let at_hand = || requests.value_range(chunk).map(Some);
                ranges.get(&chunk).copied().or_else(at_hand)
            };
            let range = range_of(id, &volume, known);
            let lost = self.lost.contains(&id);
            if range.is_none() && !lost && self.renderer.may_hide(id.channel()) {
                if chunks.len() < RANGES_TOGETHER {
                    let new = chunks_of(id, &volume).filter(|chunk| known(*chunk).is_none());
                    chunks.extend(new.filter(|chunk| seen.insert(*chunk)));
                    bricks.insert(id);
                }
                unknown.insert(id);
                continue;
            }
            let hides = range
                .flatten()
                .is_some_and(|range| self.renderer.note_range(id, [range.min, range.max]));
            if hides {
                hidden.insert(id);
            }
            self.told.insert(id, hides.then_some(self.drawn + 1));
        }
        if !chunks.is_empty() && !self.requests.is_finding() {
            self.requests.find_ranges(chunks.clone());
            self.searched = (bricks, chunks);
        }
        (hidden, unknown)
    }
}
