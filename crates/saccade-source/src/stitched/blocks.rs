//! Finished blocks, and those that are being built.

use std::collections::HashMap;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use futures::FutureExt;
use futures::future::{BoxFuture, Shared, WeakShared};
use quick_cache::Weighter;
use quick_cache::unsync::Cache;
use saccade_core::voxel_box::VoxelBox;
use tokio::task::JoinHandle;

use super::Inner;
use super::block::{Block, BlockKey};
use super::build::Place;
use super::error::StitchError;

/// Sections that a voxel of a block on disk spans, at most: to know whether it is still what it was, all of
/// its tiles must be looked up, which of coarser blocks takes as long as building them.
const MOST_SECTIONS: f64 = 16.0;

type Built = Result<Arc<Block>, Arc<StitchError>>;
type Building = BoxFuture<'static, Built>;

#[derive(Clone)]
struct ByMemory;

impl Weighter<BlockKey, Arc<Block>> for ByMemory {
    fn weight(&self, _: &BlockKey, block: &Arc<Block>) -> u64 {
        block.memory()
    }
}

/// A block that is being built, for as long as somebody waits for it.
struct Flight {
    number: u64,
    building: WeakShared<Building>,
}

struct State {
    finished: Cache<BlockKey, Arc<Block>, ByMemory>,
    flights: HashMap<BlockKey, Flight>,
    next: u64,
}

pub(super) struct Blocks(Mutex<State>);

impl Blocks {
    pub(super) fn new(bytes: u64) -> Self {
        Self(Mutex::new(State {
            finished: Cache::with_weighter(1024, bytes, ByMemory),
            flights: HashMap::new(),
            next: 0,
        }))
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A finished block.
    pub(super) fn peek(&self, key: BlockKey) -> Option<Arc<Block>> {
        self.lock().finished.peek(&key).cloned()
    }

    /// Memory that finished blocks take \[bytes\].
    pub(super) fn bytes(&self) -> u64 {
        self.lock().finished.weight()
    }

    /// Forgets blocks, and does not keep those that are being built.
    pub(super) fn forget(&self, is_touched: impl Fn(BlockKey) -> bool) {
        let mut state = self.lock();
        state.finished.retain(|key, _| !is_touched(*key));
        state.flights.retain(|key, _| !is_touched(*key));
    }
}

/// Takes a block off the list when its building ends, however it ends.
struct Landing {
    inner: Arc<Inner>,
    key: BlockKey,
    number: u64,
}

impl Landing {
    /// Keeps the block, unless it was touched by a change since its building began.
    fn keep(&self, block: &Arc<Block>) {
        let mut state = self.inner.blocks.lock();
        let current = state.flights.get(&self.key);
        if current.is_some_and(|flight| flight.number == self.number) {
            state.finished.insert(self.key, block.clone());
        }
    }
}

impl Drop for Landing {
    fn drop(&mut self) {
        let mut state = self.inner.blocks.lock();
        let current = state.flights.get(&self.key);
        if current.is_some_and(|flight| flight.number == self.number) {
            state.flights.remove(&self.key);
        }
    }
}

/// Ends a task when it is dropped.
struct Task(JoinHandle<Built>);

impl Drop for Task {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl Inner {
    /// A block: finished, or being built for somebody else, or built now. When all who wait for it
    /// have gone, building ends.
    pub(super) async fn block(self: &Arc<Self>, key: BlockKey) -> Built {
        let building = {
            let mut state = self.blocks.lock();
            if let Some(block) = state.finished.get(&key).filter(|b| !b.is_outdated()) {
                return Ok(block.clone());
            }
            let flying = state.flights.get(&key).and_then(|f| f.building.upgrade());
            flying.unwrap_or_else(|| {
                state.next += 1;
                let number = state.next;
                let building = self.build(key, number);
                if let Some(building) = building.downgrade() {
                    state.flights.insert(key, Flight { number, building });
                }
                building
            })
        };
        building.await
    }

    /// On a task of its own, so that it goes on while those who wait for it do something else.
    fn build(self: &Arc<Self>, key: BlockKey, number: u64) -> Shared<Building> {
        let inner = self.clone();
        let landing = Landing {
            inner: self.clone(),
            key,
            number,
        };
        // Whoever asks first is built first: tasks begin in another order than they are spawned in.
        let mut turn = Box::pin(self.builds.clone().acquire_owned());
        let come = (&mut turn).now_or_never();
        let task = Task(self.runtime.spawn(async move {
            let permit = match come {
                Some(permit) => permit,
                None => turn.await,
            };
            let place = inner.place(key);
            let built = inner.kept_or_built(place).await;
            drop(permit);
            let block = Arc::new(built.map_err(Arc::new)?);
            landing.keep(&block);
            Ok(block)
        }));
        let building = async move {
            let mut task = task;
            let ended = (&mut task.0).await;
            ended.unwrap_or_else(|source| Err(Arc::new(StitchError::Stopped { source })))
        };
        building.boxed().shared()
    }

    pub(super) fn place(&self, key: BlockKey) -> Place {
        Place {
            channel: key.channel,
            level: key.level,
            voxels: self.grid.voxels(key),
        }
    }

    /// A block from the cache on disk, or built now.
    async fn kept_or_built(&self, place: Place) -> Result<Block, StitchError> {
        let spans = self.volume.levels[place.level as usize].downsampling.z;
        let Some((disk, identity)) = self.disk.as_ref().filter(|_| spans <= MOST_SECTIONS) else {
            return self.builder.block(&self.grid, place, None).await;
        };
        let plan = self.builder.plan(place).await?;
        let description = self.builder.description(place, &plan);
        #[cfg(test)]
        let description = match self.wrong.get() {
            Some(super::tests::Wrong::Disk) => format!("{place:?}"),
            _ => description,
        };
        let description = [identity, description.as_bytes()].concat();
        let kept = disk.get(&description).await;
        let chunk_bytes =
            self.volume.chunk.as_usizevec3().element_product() * self.volume.dtype.bytes();
        if let Some(block) = kept.and_then(|bytes| Block::from_bytes(&bytes, chunk_bytes)) {
            self.from_disk.fetch_add(1, Ordering::Relaxed);
            return Ok(block);
        }
        let block = self.builder.block(&self.grid, place, Some(&plan)).await?;
        if let Some(bytes) = block.to_bytes() {
            disk.put(&description, &bytes);
        }
        Ok(block)
    }

    /// Forgets all that shows level-0 voxels of a box.
    pub(super) fn forget(&self, voxels: VoxelBox) {
        #[cfg(test)]
        if self.wrong.get() == Some(&super::tests::Wrong::Blocks) {
            return;
        }
        self.blocks.forget(|key| self.grid.touches(key, voxels));
    }
}
