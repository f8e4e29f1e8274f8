//! Chunks kept in memory after their bricks were delivered, bounded in bytes.

use quick_cache::Weighter;
use quick_cache::unsync::Cache;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_source::{Chunk, ChunkId};

/// What keeping any chunk costs beside its voxels, roughly \[bytes\].
const OVERHEAD: u64 = 128;

/// Memory a chunk takes \[bytes\].
pub(crate) fn bytes_of(chunk: &Chunk) -> u64 {
    OVERHEAD
        + match chunk {
            Chunk::Voxels(voxels) => voxels.len() as u64,
            Chunk::Empty => 0,
        }
}

#[derive(Clone)]
struct Bytes;

impl Weighter<ChunkId, Chunk> for Bytes {
    fn weight(&self, _: &ChunkId, chunk: &Chunk) -> u64 {
        bytes_of(chunk)
    }
}

/// Whether a change of level-0 voxels may have changed a chunk. Chunks of no volume are touched.
pub(crate) fn is_touched(id: ChunkId, volume: &Volume, voxels: VoxelBox) -> bool {
    let of_chunk = id.voxels(volume);
    of_chunk.is_none_or(|of_chunk| {
        let level = &volume.levels[id.level as usize];
        level.box_from_voxels(voxels).intersects(of_chunk)
    })
}

/// Recently used chunks, at most so many bytes of them.
pub(crate) struct HostCache {
    chunks: Cache<ChunkId, Chunk, Bytes>,
}

impl HostCache {
    pub(crate) fn new(bytes: u64, chunk_bytes: u64) -> Self {
        let items = usize::try_from(bytes / chunk_bytes.max(OVERHEAD)).unwrap_or(usize::MAX);
        Self {
            chunks: Cache::with_weighter(items.clamp(16, 1 << 20), bytes, Bytes),
        }
    }

    pub(crate) fn get(&self, id: ChunkId) -> Option<&Chunk> {
        self.chunks.get(&id)
    }

    pub(crate) fn insert(&mut self, id: ChunkId, chunk: Chunk) {
        self.chunks.insert(id, chunk);
    }

    /// Drops the chunks that a change of level-0 voxels touches.
    pub(crate) fn invalidate(&mut self, volume: &Volume, voxels: VoxelBox) {
        self.chunks.retain(|&id, _| !is_touched(id, volume, voxels));
    }

    /// Memory in use \[bytes\].
    pub(crate) fn bytes(&self) -> u64 {
        self.chunks.weight()
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec3, UVec3};

    use super::*;

    fn id(level: u32, x: u32) -> ChunkId {
        ChunkId {
            channel: 0,
            level,
            chunk: UVec3::new(x, 0, 0),
        }
    }

    #[test]
    fn memory_stays_below_the_ceiling() {
        let mut cache = HostCache::new(100_000, 1_000);
        for x in 0..1_000 {
            cache.insert(id(0, x), Chunk::Voxels(vec![1; 1_000].into()));
            assert!(
                cache.bytes() <= 100_000,
                "{} bytes after {x} chunks",
                cache.bytes()
            );
        }
        assert!(cache.bytes() > 50_000, "and it is used");
    }

    #[test]
    fn changes_touch_every_level_and_nothing_else() {
        let volume = Volume {
            chunk: UVec3::splat(32),
            ..Volume::new("v", UVec3::splat(256), DVec3::ONE).unwrap()
        };
        let mut cache = HostCache::new(1 << 20, 32 * 32 * 32);
        for level in 0..4 {
            for x in 0..256 / (32 << level) {
                cache.insert(id(level, x), Chunk::Empty);
            }
        }
        // Voxels 64..66 of level 0: chunk 2 of level 0, 1 of level 1, 0 of levels 2 and 3.
        let change = VoxelBox::new(UVec3::new(64, 0, 0), UVec3::new(66, 1, 1));
        cache.invalidate(&volume, change);
        for level in 0..4 {
            for x in 0..256 / (32 << level) {
                let touched = matches!((level, x), (0, 2) | (1, 1) | (2, 0) | (3, 0));
                assert_eq!(
                    cache.get(id(level, x)).is_none(),
                    touched,
                    "level {level} chunk {x}"
                );
            }
        }
    }
}
