//! The volumes on offer.

use std::collections::BTreeMap;
use std::hash::{BuildHasher, RandomState};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};

use futures::StreamExt;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_source::{ChunkId, VolumeSource};
use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::history::History;
use crate::http::Tag;
use crate::status::StatusSource;

/// The volumes on offer, by name. Clones share the same set, which may grow at any time.
#[derive(Clone, Default)]
pub struct Volumes(Arc<RwLock<BTreeMap<String, Arc<Published>>>>);

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
        self.0
            .write()
            .unwrap_or_else(PoisonError::into_inner)
            .insert(name, published);
    }

    /// Names, in order.
    pub fn names(&self) -> Vec<String> {
        self.0
            .read()
            .unwrap_or_else(PoisonError::into_inner)
            .keys()
            .cloned()
            .collect()
    }

    pub(crate) fn all(&self) -> Vec<Arc<Published>> {
        self.0
            .read()
            .unwrap_or_else(PoisonError::into_inner)
            .values()
            .cloned()
            .collect()
    }

    pub(crate) fn get(&self, name: &str) -> Option<Arc<Published>> {
        self.0
            .read()
            .unwrap_or_else(PoisonError::into_inner)
            .get(name)
            .cloned()
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
}

impl Published {
    fn new(source: Arc<dyn VolumeSource>, status: Option<Arc<dyn StatusSource>>) -> Self {
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
        }
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

    /// Names the state of a chunk: equal tags, equal bytes. `None` for no such chunk.
    pub(crate) fn tag(&self, id: ChunkId) -> Option<Tag> {
        let volume = self.volume();
        let level = volume.levels.get(usize::try_from(id.level).ok()?)?;
        // Changes are boxes of level-0 voxels; the filters of coarser levels reach a voxel beyond.
        let reach = u32::from(id.level > 0);
        let touched = level.voxels_from_box(id.voxels(volume)?.grown(reach));
        let touched = touched.intersection(VoxelBox::of_size(volume.extent()));
        let position = self.history().last_touched(touched);
        Some(Tag::new(&format!("{:016x}-{position}", self.instance)))
    }
}

impl Drop for Published {
    fn drop(&mut self) {
        self.follower.abort();
    }
}

/// A history is valid after every step: a panic elsewhere cannot have left it half-changed.
fn lock(history: &Mutex<History>) -> MutexGuard<'_, History> {
    history.lock().unwrap_or_else(PoisonError::into_inner)
}
