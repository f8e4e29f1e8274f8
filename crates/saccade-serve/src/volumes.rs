//! The volumes on offer.

use std::collections::BTreeMap;
use std::hash::{BuildHasher, RandomState};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
use std::time::Duration;

use futures::StreamExt;
use glam::UVec3;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_source::{ChunkId, VolumeSource};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::Instant;

use crate::history::{Cursor, History};
use crate::http::Tag;
use crate::lingering::Lingering;
use crate::status::StatusSource;

/// Between two messages that chunks of a volume take long.
const TELL_AGAIN: Duration = Duration::from_secs(60);

/// Longest wait for news that are on their way.
const NEWS: Duration = Duration::from_millis(100);

/// The volumes on offer, by name. Clones share the same set, which may grow at any time.
#[derive(Clone, Default)]
pub struct Volumes(Arc<RwLock<Offered>>);

#[derive(Default)]
struct Offered {
    published: BTreeMap<String, Arc<Published>>,
    /// Those that should be offered and cannot be opened, and why, in words for clients.
    failing: BTreeMap<String, String>,
}

impl Volumes {
    /// No volumes.
    pub fn new() -> Self {
        Self::default()
    }

    /// Offers a volume under the name it has, in place of one that had the name.
    ///
    /// Must be called within a Tokio runtime: a task follows the source until the volume is
    /// replaced.
    pub fn publish(&self, source: Arc<dyn VolumeSource>, status: Option<Arc<dyn StatusSource>>) {
        let published = Arc::new(Published::new(source, status));
        let name = published.volume().name.clone();
        let mut offered = self.write();
        offered.failing.remove(&name);
        offered.published.insert(name, published);
    }

    /// Offers a volume no more.
    pub(crate) fn withdraw(&self, name: &str) {
        self.write().published.remove(name);
    }

    /// Lists a volume as one that cannot be offered now, and why. Whether that is news.
    pub(crate) fn fail(&self, name: &str, cause: String) -> bool {
        let mut offered = self.write();
        let before = offered.failing.insert(name.to_owned(), cause);
        before.as_ref() != offered.failing.get(name)
    }

    /// Forgets failing volumes of which there are none any more.
    pub(crate) fn keep_failing(&self, mut is_there: impl FnMut(&str) -> bool) {
        self.write().failing.retain(|name, _| is_there(name));
    }

    /// Why that volume cannot be offered now, if it should be.
    pub(crate) fn failure(&self, name: &str) -> Option<String> {
        self.read().failing.get(name).cloned()
    }

    /// Those that cannot be offered now, and why.
    pub(crate) fn failing(&self) -> Vec<(String, String)> {
        let of = |(name, cause): (&String, &String)| (name.clone(), cause.clone());
        self.read().failing.iter().map(of).collect()
    }

    fn read(&self) -> RwLockReadGuard<'_, Offered> {
        self.0.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, Offered> {
        self.0.write().unwrap_or_else(PoisonError::into_inner)
    }

    /// Names, in order.
    pub fn names(&self) -> Vec<String> {
        self.read().published.keys().cloned().collect()
    }

    pub(crate) fn all(&self) -> Vec<Arc<Published>> {
        self.read().published.values().cloned().collect()
    }

    pub(crate) fn get(&self, name: &str) -> Option<Arc<Published>> {
        self.read().published.get(name).cloned()
    }
}

/// One volume on offer.
pub(crate) struct Published {
    pub(crate) source: Arc<dyn VolumeSource>,
    pub(crate) status: Option<Arc<dyn StatusSource>>,
    /// Told apart from the same name in another process, whose revisions may count otherwise.
    instance: u64,
    history: Arc<Mutex<History>>,
    /// Position behind the last change, for those who wait for the next.
    end: watch::Receiver<u64>,
    follower: JoinHandle<()>,
    /// When it was told last that a chunk takes long.
    told_of_late: Mutex<Option<Instant>>,
    /// Why chunks could not be read, and when each was told last: one damaged tile is in many chunks.
    told_of_failures: Mutex<BTreeMap<String, Instant>>,
    /// Reads that took too long for one answer.
    pub(crate) lingering: Lingering,
}

impl Published {
    pub(crate) fn new(
        source: Arc<dyn VolumeSource>,
        status: Option<Arc<dyn StatusSource>>,
    ) -> Self {
        // Listen first: a change that comes now is then in the revision, in the stream or in both.
        let mut changes = source.changes();
        let revision = source.revision();
        let history = Arc::new(Mutex::new(History::new(source.volume(), revision)));
        let (behind, end) = watch::channel(0);
        let name = source.volume().name.clone();
        let follower = tokio::spawn({
            let history = history.clone();
            async move {
                while let Some(change) = changes.next().await {
                    let mut history = lock(&history);
                    history.push(change);
                    behind.send_replace(history.end());
                }
                log::warn!("volume {name:?} will not change any more: its source ended the stream");
                // Dropping the sender would end the clients' streams, and they would come back.
                std::future::pending::<()>().await;
                drop(behind);
            }
        });
        // Random, so that a client never takes chunks of an earlier process for current ones.
        let instance = RandomState::new().hash_one(&source.volume().name);
        Self {
            source,
            status,
            instance,
            history,
            end,
            follower,
            told_of_late: Mutex::new(None),
            told_of_failures: Mutex::default(),
            lingering: Lingering::default(),
        }
    }

    /// Whether it should be told now that a chunk takes long: where one does, most do.
    pub(crate) fn is_to_tell_of_late(&self) -> bool {
        let mut told = { self.told_of_late.lock() }.unwrap_or_else(PoisonError::into_inner);
        let is_due = told.is_none_or(|told| told.elapsed() >= TELL_AGAIN);
        if is_due {
            *told = Some(Instant::now());
        }
        is_due
    }

    /// Whether it should be told now that chunks cannot be read for this reason.
    pub(crate) fn is_to_tell_of(&self, why: &str) -> bool {
        /// Reasons that are remembered. Of more, some are told too often.
        const MOST: usize = 1024;
        let mut told = lock(&self.told_of_failures);
        if told
            .get(why)
            .is_some_and(|told| told.elapsed() < TELL_AGAIN)
        {
            return false;
        }
        if told.len() >= MOST {
            told.clear();
        }
        told.insert(why.to_owned(), Instant::now());
        true
    }

    pub(crate) fn volume(&self) -> &Arc<Volume> {
        self.source.volume()
    }

    pub(crate) fn history(&self) -> MutexGuard<'_, History> {
        lock(&self.history)
    }

    /// Yields the position behind the last change whenever it grows.
    pub(crate) fn end(&self) -> watch::Receiver<u64> {
        self.end.clone()
    }

    /// Waits until all that its source knows to have changed is in the tags; `false` if that takes too long.
    pub(crate) async fn is_caught_up(&self) -> bool {
        let now = self.source.revision();
        let is_there = || self.history().revision() >= now;
        if is_there() {
            return true;
        }
        let mut end = self.end();
        let news = async { while !is_there() && end.changed().await.is_ok() {} };
        tokio::time::timeout(NEWS, news).await.is_ok() && is_there()
    }

    /// Names the state of a chunk of a level: equal tags, equal bytes.
    pub(crate) fn tag(&self, (level, chunk): (u32, UVec3)) -> Tag {
        let touched = self.touched(level, chunk);
        let position = self.history().last_touched(touched);
        Tag::new(&format!("{:016x}-{position}", self.instance))
    }

    /// Names the state of the whole volume: in addresses, for clients that keep what they have and
    /// never ask again.
    pub(crate) fn version(&self) -> String {
        self.state().1
    }

    /// The revision, and the version of the same moment.
    pub(crate) fn state(&self) -> (u64, String) {
        let revision = self.history().revision();
        (revision, format!("{:016x}-{revision}", self.instance))
    }

    /// Whether a chunk is still what it was in that version. `false` for a version of another
    /// process, or longer ago than changes are remembered.
    pub(crate) fn is_as_in(&self, version: &str, (level, chunk): (u32, UVec3)) -> bool {
        let own = format!("{:016x}-", self.instance);
        let revision = version.strip_prefix(&own).and_then(|r| r.parse().ok());
        let Some(revision) = revision else {
            return false;
        };
        let touched = self.touched(level, chunk);
        let history = self.history();
        match history.cursor(Some(revision)) {
            Cursor::At(position) => history.last_touched(touched) <= position,
            Cursor::Lost => false,
        }
    }

    /// The level-0 voxels that a chunk is made of. All of them for a chunk that does not exist.
    fn touched(&self, level: u32, chunk: UVec3) -> VoxelBox {
        let volume = self.volume();
        let whole = VoxelBox::of_size(volume.extent());
        let id = ChunkId {
            channel: 0,
            level,
            chunk,
        };
        let Some(voxels) = id.voxels(volume) else {
            return whole;
        };
        // Changes are boxes of level-0 voxels; the filters of coarser levels reach a voxel beyond.
        let reach = u32::from(level > 0);
        let level = volume.levels[level as usize];
        level
            .voxels_from_box(voxels.grown(reach))
            .intersection(whole)
    }
}

impl Drop for Published {
    fn drop(&mut self) {
        self.follower.abort();
    }
}

/// A history is valid after every step: a panic elsewhere cannot have left it half-changed.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use saccade_source::memory::ArraySource;

    #[tokio::test]
    async fn that_chunks_take_long_is_not_told_of_each() {
        let volume = Volume::new("v", UVec3::ONE, DVec3::ONE).unwrap();
        let source = Arc::new(ArraySource::new(volume, vec![1]).unwrap());
        let published = Published::new(source, None);
        let told = (0..100).filter(|_| published.is_to_tell_of_late());
        assert_eq!(told.count(), 1);
        let before = Instant::now().checked_sub(TELL_AGAIN);
        *published.told_of_late.lock().unwrap() = before;
        assert!(published.is_to_tell_of_late());

        // A damaged tile, of which many chunks have something.
        for tile in ["a.tif is damaged", "b.tif is damaged"] {
            let told = (0..100).filter(|_| published.is_to_tell_of(tile));
            assert_eq!(told.count(), 1, "{tile}");
        }
        for n in 0..5000 {
            assert!(published.is_to_tell_of(&n.to_string()));
        }
        assert!(published.told_of_failures.lock().unwrap().len() < 2000);
    }
}
