use std::sync::{Arc, PoisonError, RwLock};

use glam::UVec3;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;

use super::average::{coarser, level0_voxels};
use super::{build_chunk, only_bytes};
use crate::changes::Changes;
use crate::maybe_send::{BoxFuture, BoxStream};
use crate::{Change, ChangeReason, Chunk, ChunkError, ChunkId, VolumeSource};

/// Samples per axis that [`ProceduralSource::averaged`] takes of a coarse voxel at most.
const SAMPLES: u32 = 4;

type Value = dyn Fn(u32, UVec3) -> u8 + Send + Sync;

/// An 8-bit volume of any extent whose voxels are computed when they are asked for.
///
/// Only what lies in a box that was acquired is computed; all other chunks are empty for free, so
/// that a volume of terabytes costs nothing. Every channel has the same voxels.
pub struct ProceduralSource {
    volume: Arc<Volume>,
    value: Box<Value>,
    /// Level-0 voxels.
    acquired: RwLock<Vec<VoxelBox>>,
    changes: Arc<Changes>,
}

impl ProceduralSource {
    /// `value` gives a voxel of a level; it is asked only inside `acquired` \[level-0 voxels\].
    ///
    /// # Panics
    ///
    /// On a volume that is not 8 bit.
    pub fn new(
        volume: Volume,
        acquired: VoxelBox,
        value: impl Fn(u32, UVec3) -> u8 + Send + Sync + 'static,
    ) -> Self {
        let volume = only_bytes(volume);
        Self {
            changes: Changes::new(VoxelBox::of_size(volume.extent()), 0),
            volume,
            value: Box::new(value),
            acquired: RwLock::new(vec![acquired]),
        }
    }

    /// `value` gives a level-0 voxel. Voxels of coarser levels are means of those they cover and
    /// that are not 0, or of a regular 4 x 4 x 4 choice of them where they cover more; those of labels are the
    /// most frequent of these, of several the smallest.
    ///
    /// # Panics
    ///
    /// On a volume that is not 8 bit.
    pub fn averaged(
        volume: Volume,
        acquired: VoxelBox,
        value: impl Fn(UVec3) -> u8 + Send + Sync + 'static,
    ) -> Self {
        let (levels, kind) = (volume.levels.clone(), volume.kind);
        Self::new(volume, acquired, move |level, voxel| {
            if level == 0 {
                return value(voxel);
            }
            let downsampling = levels[level as usize].downsampling;
            let covered = level0_voxels(voxel, downsampling, levels[0].extent);
            let size = covered.size();
            let samples = size.min(UVec3::splat(SAMPLES));
            let chosen = VoxelBox::of_size(samples).iter().map(|s| {
                // The middle of each of `samples` equal parts; every voxel where there are few.
                covered.min + (s * 2 + 1) * size / (samples * 2)
            });
            coarser(kind, chosen.map(&value))
        })
    }

    /// Counts a further box of level-0 voxels as acquired and tells listeners. Returns the revision.
    pub fn acquire(&self, voxels: VoxelBox) -> u64 {
        let voxels = voxels.intersection(VoxelBox::of_size(self.volume.extent()));
        let mut acquired = self
            .acquired
            .write()
            .unwrap_or_else(PoisonError::into_inner);
        acquired.push(voxels);
        drop(acquired);
        self.changes.send_next(voxels, ChangeReason::Tile)
    }

    fn chunk(&self, id: ChunkId) -> Result<Chunk, ChunkError> {
        let covered = id.voxels(&self.volume);
        let covered = covered.ok_or(ChunkError::OutOfRange { id })?;
        let level = self.volume.levels[id.level as usize];
        let acquired = self.acquired.read().unwrap_or_else(PoisonError::into_inner);
        let of_level = acquired.iter().map(|a| level.box_from_voxels(*a));
        let here: Vec<_> = of_level.filter(|a| a.intersects(covered)).collect();
        drop(acquired);
        if here.is_empty() {
            return Ok(Chunk::Empty);
        }
        build_chunk(&self.volume, id, |start, row| {
            for (x, voxel) in (start.x..).zip(row) {
                let at = UVec3::new(x, start.y, start.z);
                if here.iter().any(|a| a.contains(at)) {
                    *voxel = (self.value)(id.level, at);
                }
            }
        })
    }
}

impl VolumeSource for ProceduralSource {
    fn volume(&self) -> &Arc<Volume> {
        &self.volume
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        Box::pin(async move { self.chunk(id) })
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        self.changes.stream()
    }

    fn revision(&self) -> u64 {
        self.changes.revision()
    }
}
