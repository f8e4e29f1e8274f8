//! Which shard is next, and what has changed meanwhile.

use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use futures::{FutureExt, StreamExt};
use saccade_core::voxel_box::VoxelBox;
use tokio::time::{Instant, timeout_at};

use super::plan::ShardId;
use crate::maybe_send::BoxStream;
use crate::{Change, VolumeSource};

/// Longest wait for a volume that rests, in pauses.
const MOST_PAUSES: u32 = 15;

/// Shards that are to be exported, each by one at a time.
#[derive(Debug)]
pub(super) struct Queue {
    /// For the first time: the coarsest levels first, so that what is wrong shows soon.
    first: BTreeSet<(Reverse<usize>, ShardId)>,
    /// Once more: the finest levels first, so that coarse ones, in which many changes meet, wait for them.
    again: BTreeSet<ShardId>,
    running: BTreeSet<ShardId>,
}

impl Queue {
    pub(super) fn new(shards: impl IntoIterator<Item = ShardId>) -> Self {
        let first = shards.into_iter();
        Self {
            first: { first }
                .map(|shard| (Reverse(shard.level), shard))
                .collect(),
            again: BTreeSet::new(),
            running: BTreeSet::new(),
        }
    }

    /// Takes note of shards that have changed; how many of them have to be exported once more for it. One that has not been
    /// begun has not.
    pub(super) fn changed(&mut self, shards: impl IntoIterator<Item = ShardId>) -> u64 {
        let mut count = 0;
        for shard in shards {
            if !self.first.contains(&(Reverse(shard.level), shard)) {
                count += u64::from(self.again.insert(shard));
            }
        }
        count
    }

    /// The next shard to work on, if there is one that nobody works on.
    pub(super) fn begin(&mut self) -> Option<ShardId> {
        let next = match self.first.pop_first() {
            Some((_, shard)) => shard,
            None => {
                let mut again = self.again.iter();
                let next = *again.find(|shard| !self.running.contains(*shard))?;
                self.again.remove(&next);
                next
            }
        };
        self.running.insert(next);
        Some(next)
    }

    /// A shard is worked on no longer.
    pub(super) fn end(&mut self, shard: ShardId) {
        self.running.remove(&shard);
    }

    /// Whether all that waits was exported before.
    pub(super) fn is_only_again(&self) -> bool {
        self.first.is_empty() && !self.again.is_empty()
    }
}

/// What changes in a volume.
pub(super) struct Changes {
    /// `None` once it has ended: nothing changes any more.
    stream: Option<BoxStream<'static, Change>>,
    /// Newest that is known.
    revision: u64,
    /// Not taken yet.
    heard: Vec<VoxelBox>,
}

impl Changes {
    /// From now on.
    pub(super) fn of(source: &Arc<dyn VolumeSource>) -> Self {
        Self {
            stream: Some(source.changes()),
            revision: source.revision(),
            heard: Vec::new(),
        }
    }

    /// State of the volume after all that was taken, or at the beginning.
    pub(super) fn revision(&self) -> u64 {
        self.revision
    }

    /// Boxes that have changed up to now, since the last call \[voxels of level 0\].
    pub(super) fn take(&mut self) -> Vec<VoxelBox> {
        // The runtime makes a stream pretend that it has nothing when a task was busy for long, which would
        // end an export in a mixture of states.
        while let Some(stream) = &mut self.stream
            && let Some(next) = tokio::task::unconstrained(stream.next()).now_or_never()
        {
            self.hear(next);
        }
        std::mem::take(&mut self.heard)
    }

    /// Waits until nothing has changed for so long, or until that is not to be expected.
    pub(super) async fn wait_for_quiet(&mut self, quiet: Duration) {
        let end = Instant::now() + quiet * MOST_PAUSES;
        loop {
            let until = end.min(Instant::now() + quiet);
            let Some(stream) = &mut self.stream else {
                return;
            };
            match timeout_at(until, stream.next()).await {
                Ok(next) => self.hear(next),
                Err(_) => return,
            }
        }
    }

    fn hear(&mut self, next: Option<Change>) {
        match next {
            Some(change) => {
                self.revision = self.revision.max(change.revision);
                self.heard.push(change.voxels);
            }
            None => self.stream = None,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use proptest::prelude::*;

    use super::*;
    use crate::export::tests::array;

    fn shard(level: usize, x: u32) -> ShardId {
        ShardId {
            level,
            channel: 0,
            zyx: [0, 0, x],
        }
    }

    #[derive(Clone, Debug)]
    enum Step {
        Begin,
        End(usize),
        Changed(Vec<(usize, u32)>),
    }

    fn any_step() -> impl Strategy<Value = Step> {
        prop_oneof![
            3 => Just(Step::Begin),
            3 => any::<usize>().prop_map(Step::End),
            1 => prop::collection::vec((0..3_usize, 0..4_u32), 1..4).prop_map(Step::Changed),
        ]
    }

    proptest! {
        /// Whatever changes when: nothing is worked on twice at a time, what has changed is begun after it, what has not is begun
        /// once, and none is counted that is not.
        #[test]
        fn each_is_exported_after_its_last_change(steps in prop::collection::vec(any_step(), 0..80)) {
            let all = (0..3).flat_map(|level| (0..4).map(move |x| shard(level, x)));
            let mut queue = Queue::new(all.clone());
            let (mut running, mut again, mut now) = (Vec::new(), 0, 0_u64);
            let mut begun: BTreeMap<ShardId, Vec<u64>> = BTreeMap::new();
            let mut changed: BTreeMap<ShardId, u64> = BTreeMap::new();
            let ends = std::iter::repeat_with(|| [Step::Begin, Step::End(0)]);
            let mut ends = ends.flatten();
            let mut steps = steps.into_iter();
            loop {
                now += 1;
                let Some(step) = steps.next().or_else(|| {
                    let over = queue.first.is_empty() && queue.again.is_empty() && running.is_empty();
                    ends.next().filter(|_| !over)
                }) else {
                    break;
                };
                match step {
                    Step::Begin => {
                        let Some(next) = queue.begin() else { continue };
                        prop_assert!(!running.contains(&next), "twice at a time");
                        running.push(next);
                        begun.entry(next).or_default().push(now);
                    }
                    Step::End(which) if !running.is_empty() => {
                        queue.end(running.remove(which % running.len()));
                    }
                    Step::End(_) => {}
                    Step::Changed(shards) => {
                        let shards: Vec<_> = shards.into_iter().map(|(level, x)| shard(level, x)).collect();
                        again += queue.changed(shards.iter().copied());
                        changed.extend(shards.into_iter().map(|shard| (shard, now)));
                    }
                }
            }
            for shard in all {
                let times = &begun[&shard];
                let last = changed.get(&shard).copied().unwrap_or(0);
                prop_assert!(*times.last().unwrap() > last, "not after its change");
                prop_assert!(changed.contains_key(&shard) || times.len() == 1, "for nothing");
            }
            let times: usize = begun.values().map(Vec::len).sum();
            prop_assert_eq!(times as u64, 12 + again);
        }
    }

    #[test]
    fn coarse_levels_come_first_and_then_last() {
        let mut queue = Queue::new([shard(0, 1), shard(1, 0), shard(0, 0)]);
        let mut order = || {
            let begun: Vec<_> = std::iter::from_fn(|| queue.begin()).collect();
            begun.iter().for_each(|shard| queue.end(*shard));
            queue.changed([shard(1, 0), shard(0, 0)]);
            begun
        };
        assert_eq!(order(), [shard(1, 0), shard(0, 0), shard(0, 1)]);
        assert_eq!(order(), [shard(0, 0), shard(1, 0)]);
    }

    /// More than the runtime lets a task hear at a time.
    #[tokio::test]
    async fn all_that_has_changed_is_heard() {
        let live = Arc::new(array(glam::UVec3::new(300, 40, 20)));
        let source: Arc<dyn VolumeSource> = live.clone();
        let mut changes = Changes::of(&source);
        let boxes = { 0..200 }.map(|x| {
            let corner = glam::UVec3::new(x, 1, 2);
            VoxelBox::new(corner, corner + 1)
        });
        let boxes: Vec<_> = boxes.collect();
        for voxels in &boxes {
            live.set(*voxels, &[7]).unwrap();
        }
        assert_eq!(changes.take(), boxes);
        assert_eq!(changes.revision(), live.revision());
        assert!(changes.take().is_empty());
    }

    #[tokio::test]
    async fn a_volume_that_rests_is_waited_for_but_not_for_ever() {
        let quiet = Duration::from_millis(40);
        // How many times it changes, one right after the other.
        for times in [0, 20, u32::MAX] {
            let live = Arc::new(array(glam::UVec3::new(30, 40, 20)));
            let source: Arc<dyn VolumeSource> = live.clone();
            let mut changes = Changes::of(&source);
            let mut last = Instant::now();
            let keeps_changing = async {
                for _ in 0..times {
                    live.set(VoxelBox::of_size(glam::UVec3::ONE), &[9]).unwrap();
                    last = Instant::now();
                    tokio::time::sleep(quiet / 20).await;
                }
                std::future::pending::<()>().await;
            };
            tokio::select! {
                () = changes.wait_for_quiet(quiet) => {}
                () = keeps_changing => {}
            }
            assert!(times > 20 || last.elapsed() >= quiet, "it had not rested");
            assert_eq!(changes.take().is_empty(), times == 0);
        }
    }
}
