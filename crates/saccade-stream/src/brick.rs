//! Bricks with border, assembled from the chunks that hold their voxels.
//!
//! Pure functions: no cache, no clock, no source. Chunks may have any size.

use glam::UVec3;
use saccade_core::brick::{
    BRICK_BORDER, BRICK_EDGE, BRICK_STORED_EDGE, BRICK_STORED_VOXELS, BrickId,
};
use saccade_core::levels::Level;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_render::BrickVoxels;
use saccade_source::{Chunk, ChunkId, ValueRange};

const EDGE: usize = BRICK_STORED_EDGE as usize;

/// Voxels of the level that a brick stores, its border included, cut at the volume's ends.
///
/// Stored voxel `i` of a brick is voxel `32 * brick - 1 + i` of the level; those outside of the
/// volume repeat the volume's nearest voxel, so they need no data of their own.
pub fn stored_voxels(id: BrickId, level: &Level) -> VoxelBox {
    let first = id.brick() * BRICK_EDGE;
    let min = first.saturating_sub(UVec3::splat(BRICK_BORDER));
    let max = first
        .saturating_add(UVec3::splat(BRICK_EDGE + BRICK_BORDER))
        .min(level.extent);
    VoxelBox::new(min, max)
}

/// The chunks that hold a brick's stored voxels, x fastest; none for a brick outside of the volume.
pub fn chunks_of(id: BrickId, volume: &Volume) -> impl Iterator<Item = ChunkId> + use<> {
    let level = volume.levels.get(id.level() as usize);
    let exists = (id.channel() as usize) < volume.channels.len();
    let inside = level.filter(|level| exists && !id.voxels(level).is_empty());
    let stored = inside.map_or(VoxelBox::EMPTY, |level| stored_voxels(id, level));
    let (channel, level) = (id.channel(), id.level());
    stored.cells(volume.chunk).map(move |chunk| ChunkId {
        channel,
        level,
        chunk,
    })
}

/// Bounds of the measured voxels of a brick and its border, if `range` knows those of all its chunks; of
/// one in which nothing was acquired, none.
pub fn range_of(
    id: BrickId,
    volume: &Volume,
    range: impl Fn(ChunkId) -> Option<Option<ValueRange>>,
) -> Option<Option<ValueRange>> {
    let join = |a: ValueRange, b: ValueRange| ValueRange {
        min: a.min.min(b.min),
        max: a.max.max(b.max),
    };
    let mut ranges = chunks_of(id, volume).map(range);
    ranges.try_fold(None, |all: Option<ValueRange>, range| {
        Some(all.into_iter().chain(range?).reduce(join))
    })
}

/// Assembles bricks one after another in the same memory.
#[derive(Debug, Default)]
pub struct Assembler {
    voxels: Vec<u8>,
}

impl Assembler {
    /// The voxels of a brick, of the volume's type, from its chunks as `chunk` finds them.
    ///
    /// `None` when `chunk` lacks one of [`chunks_of`]. A brick without a single measured voxel is
    /// [`BrickVoxels::Empty`]; where every chunk is empty, no memory is touched to find that out.
    pub fn assemble<'c>(
        &mut self,
        id: BrickId,
        volume: &Volume,
        chunk: impl Fn(ChunkId) -> Option<&'c Chunk>,
    ) -> Option<BrickVoxels<'_>> {
        let mut filled = Vec::new();
        for chunk_id in chunks_of(id, volume) {
            if let Chunk::Voxels(voxels) = chunk(chunk_id)? {
                filled.push((chunk_id, voxels));
            }
        }
        let Some(level) = volume.levels.get(id.level() as usize) else {
            return Some(BrickVoxels::Empty);
        };
        if filled.is_empty() {
            return Some(BrickVoxels::Empty);
        }
        self.voxels.clear();
        let bytes = volume.dtype.bytes();
        self.voxels.resize(BRICK_STORED_VOXELS * bytes, 0);
        let stored = stored_voxels(id, level);
        for (chunk_id, voxels) in filled {
            let min = chunk_id.chunk * volume.chunk;
            let of_chunk = VoxelBox::new(min, min.saturating_add(volume.chunk));
            let part = stored.intersection(of_chunk);
            copy_box(id, bytes, (part, of_chunk), voxels, &mut self.voxels);
        }
        if self.voxels.iter().all(|&v| v == 0) {
            return Some(BrickVoxels::Empty);
        }
        replicate_ends(id, bytes, stored, &mut self.voxels);
        Some(BrickVoxels::Voxels(&self.voxels))
    }
}

/// Index in a brick of the voxel `at` of its level, along each axis.
fn stored_index(id: BrickId, at: UVec3) -> [usize; 3] {
    (at + BRICK_BORDER - id.brick() * BRICK_EDGE)
        .to_array()
        .map(|i| i as usize)
}

/// Copies the voxels of `part`, each of some `bytes`, from a chunk that covers `of_chunk`.
fn copy_box(
    id: BrickId,
    bytes: usize,
    (part, of_chunk): (VoxelBox, VoxelBox),
    chunk: &[u8],
    brick: &mut [u8],
) {
    if part.is_empty() {
        return;
    }
    let [x, y, z] = stored_index(id, part.min);
    let [width, height, depth] = part.size().to_array().map(|s| s as usize);
    let [cx, cy, cz] = (part.min - of_chunk.min).to_array().map(|i| i as usize);
    let [row, rows, _] = of_chunk.size().to_array().map(|s| s as usize);
    for dz in 0..depth {
        for dy in 0..height {
            let to = (((z + dz) * EDGE + y + dy) * EDGE + x) * bytes;
            let from = (((cz + dz) * rows + cy + dy) * row + cx) * bytes;
            let width = width * bytes;
            brick[to..to + width].copy_from_slice(&chunk[from..from + width]);
        }
    }
}

/// Repeats the volume's outermost voxels into the part of a brick that lies outside of it.
fn replicate_ends(id: BrickId, bytes: usize, stored: VoxelBox, brick: &mut [u8]) {
    let [x0, y0, z0] = stored_index(id, stored.min);
    let [x1, y1, z1] = stored_index(id, stored.max - 1);
    let row_bytes = EDGE * bytes;
    let slice_bytes = EDGE * row_bytes;
    for z in z0..=z1 {
        for y in y0..=y1 {
            let row = &mut brick[(z * EDGE + y) * row_bytes..][..row_bytes];
            for x in (0..x0).chain(x1 + 1..EDGE) {
                let from = x.clamp(x0, x1) * bytes;
                row.copy_within(from..from + bytes, x * bytes);
            }
        }
        let slice = &mut brick[z * slice_bytes..][..slice_bytes];
        for y in (0..y0).chain(y1 + 1..EDGE) {
            let from = y.clamp(y0, y1) * row_bytes;
            slice.copy_within(from..from + row_bytes, y * row_bytes);
        }
    }
    for z in (0..z0).chain(z1 + 1..EDGE) {
        let from = z.clamp(z0, z1) * slice_bytes;
        brick.copy_within(from..from + slice_bytes, z * slice_bytes);
    }
}

#[cfg(test)]
mod tests;
