//! Blocks: the boxes that are built at once, and the chunks they are cut into.

use std::sync::Arc;
use std::time::Duration;

use bytes::{Buf, BufMut, Bytes, BytesMut};
use glam::{DVec2, UVec2, UVec3};
use saccade_core::levels::Level;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use tokio::time::Instant;

use super::coverage::Segment;
use super::error::StitchError;
use super::index::IndexedTile;
use super::resample::Sample;
use crate::{ChunkId, ValueRange};

/// Voxels of a block, about: whole chunks are taken \[000 §5.2\].
const BLOCK: UVec3 = UVec3::new(512, 512, 32);

/// Names a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct BlockKey {
    pub(super) channel: u32,
    pub(super) level: u32,
    block: UVec3,
}

/// How a volume is divided into blocks.
pub(super) struct BlockGrid {
    volume: Arc<Volume>,
    /// Chunks of a block.
    chunks: UVec3,
}

impl BlockGrid {
    pub(super) fn new(volume: &Arc<Volume>) -> Self {
        Self {
            chunks: (BLOCK / volume.chunk).max(UVec3::ONE),
            volume: volume.clone(),
        }
    }

    pub(super) fn chunk(&self) -> UVec3 {
        self.volume.chunk
    }

    /// The block that holds a chunk, and which of its chunks that is.
    pub(super) fn block_of(&self, id: ChunkId) -> (BlockKey, UVec3) {
        let key = BlockKey {
            channel: id.channel,
            level: id.level,
            block: id.chunk / self.chunks,
        };
        (key, id.chunk % self.chunks)
    }

    /// The voxels of a block, cut at the level's end.
    pub(super) fn voxels(&self, key: BlockKey) -> VoxelBox {
        let extent = self.volume.levels[key.level as usize].extent;
        let size = self.chunks * self.volume.chunk;
        let min = key.block * size;
        VoxelBox::new(min, min.saturating_add(size).min(extent))
    }

    /// Whether a block shows level-0 voxels of a box.
    pub(super) fn touches(&self, key: BlockKey, level0: VoxelBox) -> bool {
        let level = self.volume.levels[key.level as usize];
        level.box_from_voxels(level0).intersects(self.voxels(key))
    }
}

/// One z of a block.
pub(super) struct Slice<S> {
    /// Without padding, x fastest; `None` if there is nothing.
    pub(super) values: Option<Vec<S>>,
    pub(super) failures: Vec<Failure>,
}

/// A tile that could not be read.
pub(super) struct Failure {
    error: Arc<StitchError>,
    /// Where it would be seen \[voxels of the block\].
    min: UVec2,
    max: UVec2,
}

impl Failure {
    /// Of all that the bounds of a tile touch.
    pub(super) fn bounds(
        error: StitchError,
        tile: &IndexedTile,
        level: Level,
        block: VoxelBox,
    ) -> Self {
        let step = level.downsampling.truncate();
        let low = block.min.truncate().as_dvec2();
        let voxel = |p: DVec2| (p / step - low).max(DVec2::ZERO);
        Self {
            error: Arc::new(error),
            min: voxel(tile.min).floor().as_uvec2(),
            max: voxel(tile.max).ceil().as_uvec2(),
        }
    }

    /// Of segments of a grid with `by` x `by` samples per voxel.
    pub(super) fn segments(error: StitchError, segments: &[Segment], by: u32) -> Self {
        let min = segments.iter().map(|s| UVec2::new(s.start, s.y));
        let max = segments.iter().map(|s| UVec2::new(s.end, s.y + 1));
        let none = UVec2::ZERO;
        Self {
            error: Arc::new(error),
            min: min.reduce(UVec2::min).unwrap_or(none) / by,
            max: (max.reduce(UVec2::max).unwrap_or(none) + (by - 1)) / by,
        }
    }

    pub(super) fn error(&self) -> Arc<StitchError> {
        self.error.clone()
    }

    fn touches(&self, min: UVec2, max: UVec2) -> bool {
        self.min.cmplt(max).all() && self.max.cmpgt(min).all()
    }
}

/// A chunk of a block.
#[derive(Clone)]
pub(super) enum CutChunk {
    Empty,
    Voxels(Bytes, ValueRange),
    Failed(Arc<StitchError>),
}

/// A finished block.
pub(super) struct Block {
    /// Chunks per axis; none where all are empty.
    size: UVec3,
    chunks: Vec<CutChunk>,
    /// When to build it again, if a tile could not be read.
    until: Option<Instant>,
}

impl Block {
    /// Cuts what was built of `voxels`. Where a tile could not be read, it is good for `try_again`.
    pub(super) fn cut<S: Sample>(
        voxels: VoxelBox,
        chunk: UVec3,
        slices: &[Slice<S>],
        try_again: Duration,
    ) -> Self {
        let failed = slices.iter().any(|s| !s.failures.is_empty());
        let size = (voxels.size() + (chunk - 1)) / chunk;
        let chunks: Vec<_> = if failed || slices.iter().any(|s| s.values.is_some()) {
            let all = VoxelBox::of_size(size).iter();
            all.map(|at| cut(voxels.size(), chunk, at * chunk, slices))
                .collect()
        } else {
            Vec::new()
        };
        let empty = chunks.iter().all(|c| matches!(c, CutChunk::Empty));
        Self {
            size,
            chunks: if empty { Vec::new() } else { chunks },
            until: failed.then(|| Instant::now() + try_again),
        }
    }

    /// One of its chunks.
    pub(super) fn chunk(&self, at: UVec3) -> &CutChunk {
        let (at, size) = (at.as_usizevec3(), self.size.as_usizevec3());
        let index = (at.z * size.y + at.y) * size.x + at.x;
        self.chunks.get(index).unwrap_or(&CutChunk::Empty)
    }

    /// As bytes, for [`Self::from_bytes`]; `None` if there is nothing worth keeping, or a tile could not be
    /// read.
    pub(super) fn to_bytes(&self) -> Option<Bytes> {
        if self.until.is_some() || self.chunks.is_empty() {
            return None;
        }
        let mut bytes = BytesMut::with_capacity(usize::try_from(self.memory()).ok()?);
        { self.size.to_array().into_iter() }.for_each(|n| bytes.put_u32_le(n));
        for chunk in &self.chunks {
            let (length, range) = match chunk {
                CutChunk::Voxels(voxels, range) => (u32::try_from(voxels.len()).ok()?, *range),
                CutChunk::Empty => (0, ValueRange { min: 0, max: 0 }),
                CutChunk::Failed(_) => return None,
            };
            bytes.put_u32_le(length);
            bytes.put_u16_le(range.min);
            bytes.put_u16_le(range.max);
        }
        for chunk in &self.chunks {
            if let CutChunk::Voxels(voxels, _) = chunk {
                bytes.put_slice(voxels);
            }
        }
        Some(bytes.freeze())
    }

    /// A block that was made bytes of, whose chunks have `chunk_bytes` each; `None` if it was not. They share the bytes' memory.
    pub(super) fn from_bytes(bytes: &Bytes, chunk_bytes: usize) -> Option<Self> {
        let mut table = bytes.clone();
        let mut number = || table.try_get_u32_le().ok();
        let size = UVec3::new(number()?, number()?, number()?);
        let axes = size.as_usizevec3().to_array();
        let entries = axes
            .iter()
            .try_fold(1_usize, |n, axis| n.checked_mul(*axis))?;
        let mut voxels = bytes.slice(entries.checked_mul(8)?.checked_add(12)?.min(bytes.len())..);
        let mut chunks = Vec::new();
        for _ in 0..entries {
            let length = table.try_get_u32_le().ok()? as usize;
            let min = table.try_get_u16_le().ok()?;
            let max = table.try_get_u16_le().ok()?;
            chunks.push(match length {
                0 if (min, max) == (0, 0) => CutChunk::Empty,
                _ if length != chunk_bytes || length > voxels.len() => return None,
                _ => CutChunk::Voxels(voxels.split_to(length), ValueRange { min, max }),
            });
        }
        let is_whole = voxels.is_empty() && !chunks.is_empty();
        is_whole.then_some(Self {
            size,
            chunks,
            until: None,
        })
    }

    /// Whether it should be built again.
    pub(super) fn is_outdated(&self) -> bool {
        self.until.is_some_and(|until| until <= Instant::now())
    }

    /// Memory it takes \[bytes\].
    pub(super) fn memory(&self) -> u64 {
        let voxels = self.chunks.iter().map(|chunk| match chunk {
            CutChunk::Voxels(bytes, _) => bytes.len(),
            CutChunk::Empty | CutChunk::Failed(_) => 0,
        });
        let chunks = self.chunks.len() * size_of::<CutChunk>() + size_of::<Self>() + 64;
        (voxels.sum::<usize>() + chunks) as u64
    }
}

/// What lies in the cache on disk as a block: it is one, or it is built anew. Behind the length of its chunks.
#[cfg(any(test, fuzzing))]
pub(crate) fn fuzz(bytes: &[u8]) {
    let mut bytes = Bytes::copy_from_slice(bytes);
    let Some(chunk_bytes) = bytes.try_get_u8().ok().map(usize::from).filter(|n| *n > 0) else {
        return;
    };
    let Some(block) = Block::from_bytes(&bytes, chunk_bytes) else {
        return;
    };
    assert!(
        block.chunks.iter().all(|chunk| match chunk {
            CutChunk::Voxels(voxels, _) => voxels.len() == chunk_bytes,
            CutChunk::Empty | CutChunk::Failed(_) => true,
        }),
        "chunks of other lengths"
    );
    assert_eq!(
        block.to_bytes(),
        Some(bytes.clone()),
        "it is written as it was"
    );
    let size = block.size.as_usizevec3();
    assert_eq!(block.chunks.len(), size.element_product());
    // Of each chunk there are eight bytes.
    let most = bytes.len() * (1 + size_of::<CutChunk>() / 8) + 256;
    assert!(block.memory() <= most as u64);
    let inside = [UVec3::ZERO, block.size / 2, block.size - 1];
    let voxels = inside.map(|at| match block.chunk(at) {
        CutChunk::Voxels(voxels, _) => voxels.len(),
        CutChunk::Empty | CutChunk::Failed(_) => 0,
    });
    assert!(voxels.iter().all(|len| *len <= bytes.len()));
    assert!(
        Block::from_bytes(&bytes.slice(..bytes.len() - 1), chunk_bytes).is_none(),
        "it is cut"
    );
}

/// The chunk whose first voxel is `min` \[voxels of the block\].
fn cut<S: Sample>(size: UVec3, chunk: UVec3, min: UVec3, slices: &[Slice<S>]) -> CutChunk {
    let max = (min + chunk).min(size);
    let own = &slices[min.z as usize..max.z as usize];
    let failures = own.iter().flat_map(|s| &s.failures);
    let (low, high) = (min.truncate(), max.truncate());
    if let Some(failure) = { failures }.find(|f| f.touches(low, high)) {
        return CutChunk::Failed(failure.error.clone());
    }
    let [width, height, depth] = chunk.as_usizevec3().to_array();
    let bytes = S::DTYPE.bytes();
    let mut voxels = vec![0; width * height * depth * bytes];
    let (mut least, mut most) = (S::MOST, S::default());
    let planes = voxels.chunks_exact_mut(width * height * bytes);
    for (slice, to) in own.iter().zip(planes) {
        let Some(values) = &slice.values else {
            continue;
        };
        let rows = values.chunks_exact(size.x as usize);
        let rows = rows.skip(min.y as usize).take((max.y - min.y) as usize);
        for (row, to) in rows.zip(to.chunks_exact_mut(width * bytes)) {
            let row = &row[min.x as usize..max.x as usize];
            S::write(row, &mut to[..row.len() * bytes]);
            // 0 becomes the largest for the smallest: it is no value.
            least = row.iter().fold(least, |least, v| least.min(v.before()));
            most = row.iter().fold(most, |most, v| most.max(*v));
        }
    }
    if most == S::default() {
        return CutChunk::Empty;
    }
    let range = ValueRange {
        min: least.into() + 1,
        max: most.into(),
    };
    CutChunk::Voxels(Bytes::from(voxels), range)
}
