//! Volumes that need no archive: arrays in memory, and voxels computed by a function.

mod array;
mod average;
mod procedural;

pub use array::{ArraySource, WrongLength};
pub use procedural::ProceduralSource;

use std::sync::Arc;

use bytes::Bytes;
use glam::UVec3;
use saccade_core::volume::Volume;

use crate::{Chunk, ChunkError, ChunkId};

/// Fills a chunk from `row`, which writes the voxels from `start` on along x; nonzero is data.
fn build_chunk(
    volume: &Volume,
    id: ChunkId,
    mut row: impl FnMut(UVec3, &mut [u8]),
) -> Result<Chunk, ChunkError> {
    let voxels = id.voxels(volume).ok_or(ChunkError::OutOfRange { id })?;
    let [width, height, depth] = volume.chunk.as_usizevec3().to_array();
    let mut chunk = vec![0; width * height * depth];
    let size = voxels.size();
    for z in 0..size.z {
        for y in 0..size.y {
            let at = (z as usize * height + y as usize) * width;
            row(
                voxels.min + UVec3::new(0, y, z),
                &mut chunk[at..at + size.x as usize],
            );
        }
    }
    Ok(if chunk.iter().all(|v| *v == 0) {
        Chunk::Empty
    } else {
        Chunk::Voxels(Bytes::from(chunk))
    })
}

/// Refuses what these sources cannot hold.
fn only_bytes(volume: Volume) -> Arc<Volume> {
    assert!(
        volume.dtype == saccade_core::volume::Dtype::Uint8,
        "sources in memory hold 8-bit volumes only"
    );
    Arc::new(volume)
}

#[cfg(test)]
mod tests;
