//! What changed in a volume: enough to tag chunks and to let clients catch up.
//!
//! Changes are told apart by their position in the order in which they came, not by revision: one
//! revision may bring several, and "anything may have changed" has no revision of its own.

use std::collections::VecDeque;

use glam::UVec3;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_source::{Change, ChangeReason};

/// Changes kept for clients that come back.
const KEPT: usize = 4096;

/// The recent changes of one volume, and when each of its regions changed last.
#[derive(Debug)]
pub(crate) struct History {
    log: VecDeque<Change>,
    /// Position of the log's first change among all changes ever seen.
    first: u64,
    /// A client that has seen this revision, or a later one, misses nothing that left the log.
    resumable_from: u64,
    revision: u64,
    regions: Regions,
    extent: UVec3,
}

/// How far a client has read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Cursor {
    /// It has seen all changes before this position.
    At(u64),
    /// Unknown: it may have missed any change.
    Lost,
}

impl History {
    /// No change yet since `revision`.
    pub(crate) fn new(volume: &Volume, revision: u64) -> Self {
        Self {
            log: VecDeque::new(),
            first: 0,
            resumable_from: revision,
            revision,
            regions: Regions::new(volume),
            extent: volume.extent(),
        }
    }

    /// Revision after the last change.
    pub(crate) fn revision(&self) -> u64 {
        self.revision
    }

    /// Position behind the last change.
    pub(crate) fn end(&self) -> u64 {
        self.first + self.log.len() as u64
    }

    /// Adds a change.
    pub(crate) fn push(&mut self, change: Change) {
        self.revision = self.revision.max(change.revision);
        self.log.push_back(change);
        self.regions.touch(change.voxels, self.end());
        if self.log.len() > KEPT
            && let Some(gone) = self.log.pop_front()
        {
            self.first += 1;
            // Others of the same revision may have gone with it: only later ones are safe.
            self.resumable_from = self.resumable_from.max(gone.revision + 1);
        }
    }

    /// Where a client continues that has seen `revision`; a client that names none sees what comes.
    pub(crate) fn cursor(&self, revision: Option<u64>) -> Cursor {
        let Some(revision) = revision else {
            return Cursor::At(self.end());
        };
        if revision < self.resumable_from || revision > self.revision {
            return Cursor::Lost;
        }
        let seen = self
            .log
            .partition_point(|change| change.revision <= revision);
        let begun = self
            .log
            .partition_point(|change| change.revision < revision);
        // Of several changes with one revision the client may have seen only the first.
        let next = if seen - begun > 1 { begun } else { seen };
        Cursor::At(self.first + next as u64)
    }

    /// The changes a client has not seen, and where it is afterwards. One that lost track gets a
    /// single change that covers everything.
    pub(crate) fn since(&self, cursor: Cursor) -> (Vec<Change>, Cursor) {
        let now = Cursor::At(self.end());
        let unseen = match cursor {
            Cursor::At(position) if position >= self.first => {
                let skip = usize::try_from(position - self.first).unwrap_or(usize::MAX);
                self.log.iter().skip(skip).copied().collect()
            }
            _ => vec![Change {
                revision: self.revision,
                voxels: VoxelBox::of_size(self.extent),
                reason: ChangeReason::Missed,
            }],
        };
        (unseen, now)
    }

    /// Position behind the last change that touched any of these level-0 voxels, or a later one.
    pub(crate) fn last_touched(&self, voxels: VoxelBox) -> u64 {
        self.regions.latest(voxels)
    }
}

/// The last change per cell of a coarse grid: bounded for any volume and any number of changes.
#[derive(Debug)]
struct Regions {
    cell: UVec3,
    cells: UVec3,
    latest: Vec<u64>,
}

impl Regions {
    /// At most 64³ cells: 2 MiB.
    const CELLS_PER_AXIS: u32 = 64;

    fn new(volume: &Volume) -> Self {
        let extent = volume.extent();
        let edge = |extent: u32, chunk: u32| {
            let mut edge = chunk.max(1);
            while extent.div_ceil(edge) > Self::CELLS_PER_AXIS {
                edge = edge.saturating_mul(2);
            }
            edge
        };
        let chunk = volume.chunk;
        let cell = UVec3::new(
            edge(extent.x, chunk.x),
            edge(extent.y, chunk.y),
            edge(extent.z, chunk.z),
        );
        let cells = (extent.saturating_sub(UVec3::ONE) / cell) + 1;
        let count = cells.x as usize * cells.y as usize * cells.z as usize;
        Self {
            cell,
            cells,
            latest: vec![0; count],
        }
    }

    fn indices(&self, voxels: VoxelBox) -> impl Iterator<Item = usize> + use<> {
        let cells = self.cells;
        let inside = voxels.intersection(VoxelBox::of_size(cells * self.cell));
        inside.cells(self.cell).map(move |cell| {
            (cell.z as usize * cells.y as usize + cell.y as usize) * cells.x as usize
                + cell.x as usize
        })
    }

    fn touch(&mut self, voxels: VoxelBox, position: u64) {
        for index in self.indices(voxels) {
            self.latest[index] = self.latest[index].max(position);
        }
    }

    fn latest(&self, voxels: VoxelBox) -> u64 {
        self.indices(voxels)
            .map(|index| self.latest[index])
            .max()
            .unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn volume() -> Volume {
        Volume::new("v", UVec3::new(5000, 700, 33), DVec3::new(4.0, 4.0, 40.0)).unwrap()
    }

    fn change(revision: u64, x: u32) -> Change {
        let min = UVec3::new(x, 0, 0);
        let voxels = VoxelBox::new(min, min + UVec3::ONE);
        Change {
            revision,
            voxels,
            reason: ChangeReason::Tile,
        }
    }

    fn revisions(history: &History, cursor: Cursor) -> Vec<u64> {
        history
            .since(cursor)
            .0
            .iter()
            .map(|change| change.revision)
            .collect()
    }

    #[test]
    fn clients_catch_up_from_the_revision_they_name() {
        let mut history = History::new(&volume(), 10);
        for revision in 11..=14 {
            history.push(change(revision, 0));
        }
        assert_eq!(revisions(&history, history.cursor(Some(12))), [13, 14]);
        assert_eq!(
            revisions(&history, history.cursor(Some(10))),
            [11, 12, 13, 14]
        );
        assert!(revisions(&history, history.cursor(Some(14))).is_empty());
        assert!(revisions(&history, history.cursor(None)).is_empty());
    }

    #[test]
    fn clients_from_elsewhere_are_told_that_everything_may_have_changed() {
        let mut history = History::new(&volume(), 10);
        history.push(change(11, 0));
        for unknown in [0, 9, 12, u64::MAX] {
            let (changes, next) = history.since(history.cursor(Some(unknown)));
            let [missed] = changes[..] else {
                panic!("{changes:?}")
            };
            assert_eq!((missed.reason, missed.revision), (ChangeReason::Missed, 11));
            assert_eq!(missed.voxels, VoxelBox::of_size(volume().extent()));
            assert!(history.since(next).0.is_empty());
        }
    }

    #[test]
    fn a_client_slower_than_the_log_is_told_so() {
        let mut history = History::new(&volume(), 0);
        let slow = history.cursor(None);
        for revision in 1..=KEPT as u64 + 5 {
            history.push(change(revision, 0));
        }
        assert_eq!(history.log.len(), KEPT);
        assert_eq!(history.since(slow).0[0].reason, ChangeReason::Missed);
        assert_eq!(history.cursor(Some(5)), Cursor::Lost);
        assert_eq!(revisions(&history, history.cursor(Some(6)))[0], 7);
    }

    #[test]
    fn a_revision_of_several_changes_is_never_cut() {
        let mut history = History::new(&volume(), 0);
        history.push(change(1, 0));
        history.push(change(2, 10));
        history.push(change(2, 20));
        assert_eq!(revisions(&history, history.cursor(Some(2))), [2, 2]);
    }

    #[test]
    fn a_change_ages_its_region_alone() {
        let volume = volume();
        let mut history = History::new(&volume, 3);
        let here = VoxelBox::new(UVec3::new(4999, 0, 0), UVec3::new(5000, 1, 1));
        let far = VoxelBox::new(UVec3::ZERO, UVec3::ONE);
        history.push(change(9, 4999));
        let touched = |history: &History| [here, far].map(|voxels| history.last_touched(voxels));
        assert_eq!(touched(&history), [1, 0]);
        let whole = VoxelBox::of_size(volume.extent());
        assert_eq!(history.last_touched(whole), 1);
        // What was missed has no revision of its own.
        let missed = ChangeReason::Missed;
        history.push(Change {
            revision: 9,
            voxels: whole,
            reason: missed,
        });
        assert_eq!(touched(&history), [2, 2]);
    }

    #[test]
    fn regions_stay_small_for_the_largest_volumes() {
        let extent = UVec3::new(2_000_000, 2_000_000, 250_000);
        let regions = Regions::new(&Volume::new("v", extent, DVec3::ONE).unwrap());
        assert!(regions.latest.len() <= 64 * 64 * 64);
        assert_eq!(regions.latest(VoxelBox::of_size(extent)), 0);
    }
}
