//! A level of an image: an array whose axes are known, where it lies, and which voxels its chunks and shards have.

use std::sync::Arc;

use glam::{DVec3, UVec3};
use saccade_core::levels::Level;
use saccade_core::voxel_box::VoxelBox;

use super::array::Array;
use super::error::Refusal;
use super::metadata::Axis;
use super::packing::Packing;
use crate::stored::{Place, Placed};
use crate::values::{Inside, Number};

/// How far off a level may be because its writer meant another point of its voxels \[voxels of the level\].
const MEANT_OTHERWISE: f64 = 0.501;

/// A level: an array whose axes are known.
#[derive(Debug)]
pub(super) struct LevelArray {
    path: String,
    pub(super) array: Arc<Array>,
    pub(super) packing: Packing,
    axes: Vec<Axis>,
    grid: Vec<u64>,
    extent: UVec3,
    pub(super) placed: Placed,
    note: Option<String>,
    channels: u32,
    /// Values between neighbours along each axis of the array, in a decoded chunk.
    strides: Vec<usize>,
}

impl LevelArray {
    pub(super) fn new(path: &str, array: Array, axes: &[Axis]) -> Result<Self, Refusal> {
        if array.shape.len() != axes.len() {
            let (got, named) = (array.shape.len(), axes.len());
            return Err(Refusal::Wrong(format!(
                "it has {got} axes, and {named} have names"
            )));
        }
        let mut extent = UVec3::ONE;
        let mut channels = 1;
        for (axis, &length) in axes.iter().zip(&array.shape) {
            let length = u32::try_from(length);
            let length = length.map_err(|_| Refusal::wrong("an axis is far too long"))?;
            match axis {
                Axis::T => {}
                Axis::C => channels = length,
                Axis::Space(axis) => extent[*axis] = length,
            }
        }
        let mut strides = vec![0; axes.len()];
        let mut stride = 1;
        for &axis in array.encoding.order.iter().rev() {
            strides[axis] = stride;
            stride *= usize::try_from(array.chunk[axis]).map_err(Refusal::wrong)?;
        }
        Ok(Self {
            path: path.to_owned(),
            grid: array.grid(),
            packing: Packing::new(array.encoding.codecs.clone(), array.chunk_bytes()),
            array: Arc::new(array),
            axes: axes.to_vec(),
            extent,
            placed: Placed::new(extent, DVec3::ZERO, 0.0),
            note: None,
            channels,
            strides,
        })
    }

    /// Puts it where its first corner lies, from that of a volume of so many voxels, of which one of its own is so many: the
    /// level that it is then.
    pub(super) fn place(
        &mut self,
        corner: DVec3,
        finest: UVec3,
        downsampling: DVec3,
    ) -> Result<Level, Refusal> {
        self.placed = Placed::new(self.extent, corner, MEANT_OTHERWISE);
        let level = self.placed.level(finest, downsampling).ok_or_else(|| {
            let path = &self.path;
            Refusal::Unsupported(format!(
                "its level {path:?} lies elsewhere than the finest one (translation)"
            ))
        })?;
        self.note = self.placed.note(&format!("{:?}", self.path), level.extent);
        Ok(level)
    }

    /// How much further it lies than its voxels are put \[voxels of the level\].
    pub(super) fn off(&self) -> DVec3 {
        self.placed.off()
    }

    /// What a user should know of where it lies.
    pub(super) fn note(&self) -> Option<String> {
        self.note.clone()
    }

    pub(super) fn extent(&self) -> UVec3 {
        self.extent
    }

    pub(super) fn channels(&self) -> u32 {
        self.channels
    }

    pub(super) fn number(&self) -> Number {
        self.array.number
    }

    /// Voxels of a chunk along x, y and z.
    pub(super) fn cell(&self) -> UVec3 {
        let mut cell = UVec3::ONE;
        for (axis, chunk) in self.axes.iter().zip(&self.array.chunk) {
            if let Axis::Space(axis) = axis {
                cell[*axis] = u32::try_from(*chunk).unwrap_or(u32::MAX);
            }
        }
        cell
    }

    /// Where a chunk is in the grid of chunks.
    pub(super) fn chunk(&self, number: u64) -> Vec<u64> {
        unravel(number, &self.grid)
    }

    /// The object with these indices, of a chunk or of a shard.
    pub(super) fn key(&self, index: &[u64]) -> String {
        super::below(&self.path, &self.array.keys.key(index))
    }

    /// The shard that a chunk lies in, if there are shards.
    pub(super) fn shard(&self, chunk: u64) -> Option<Vec<u64>> {
        let sharding = self.array.sharding.as_ref()?;
        let index = self.chunk(chunk).into_iter();
        let shard = index.zip(&sharding.chunks).map(|(at, count)| at / count);
        Some(shard.collect())
    }

    /// The number of a shard.
    pub(super) fn shard_number(&self, shard: &[u64]) -> u64 {
        let each = self.array.sharding.as_ref().map(|each| &each.chunks[..]);
        let axes = self.grid.iter().zip(each.unwrap_or_default());
        let shards: Vec<u64> = axes.map(|(chunks, each)| chunks.div_ceil(*each)).collect();
        ravel(shard, &shards)
    }

    /// The number of a chunk within its shard, 0 where there are none.
    pub(super) fn number_in_shard(&self, chunk: u64) -> u64 {
        let each = self.array.sharding.as_ref().map(|each| &each.chunks[..]);
        let each = each.unwrap_or_default();
        let index = self.chunk(chunk).into_iter();
        let inside: Vec<u64> = index.zip(each).map(|(at, count)| at % count).collect();
        ravel(&inside, each)
    }

    /// Stored voxels of a shard, of all its channels.
    pub(super) fn voxels_of_shard(&self, shard: &[u64]) -> VoxelBox {
        let mut voxels = VoxelBox::of_size(self.extent);
        let each = self.array.sharding.as_ref().map(|each| &each.chunks[..]);
        for (n, (axis, each)) in self.axes.iter().zip(each.unwrap_or_default()).enumerate() {
            if let Axis::Space(axis) = *axis {
                let edge = |more: u64| {
                    let edge = (shard[n] + more).saturating_mul(each * self.array.chunk[n]);
                    u32::try_from(edge)
                        .unwrap_or(u32::MAX)
                        .min(self.extent[axis])
                };
                (voxels.min[axis], voxels.max[axis]) = (edge(0), edge(1));
            }
        }
        voxels
    }

    /// Which numbers of a chunk are voxels that are shown, where not all are.
    pub(super) fn inside(&self, number: u64) -> Option<Inside> {
        let at = self.chunk(number);
        let length = |n: u64| usize::try_from(n).expect("checked when it was read");
        Inside::new(self.array.encoding.order.iter().map(|&axis| {
            let (chunk, all) = (self.array.chunk[axis], self.array.shape[axis]);
            let inside = match self.axes[axis] {
                Axis::T => 1,
                _ => chunk.min(all - at[axis] * chunk),
            };
            (length(chunk), length(inside))
        }))
    }

    /// Chunks that a box of a channel's stored voxels touches: their numbers, and where they have their voxels.
    pub(super) fn touched(&self, channel: u32, voxels: VoxelBox) -> Vec<(u64, Place)> {
        let mut index = vec![0; self.axes.len()];
        let mut offset = 0;
        let (mut strides, mut cell, mut spatial) = ([0; 3], [1_u64; 3], [None; 3]);
        for (n, axis) in self.axes.iter().enumerate() {
            let chunk = self.array.chunk[n];
            match axis {
                Axis::T => {}
                Axis::C => {
                    index[n] = u64::from(channel) / chunk;
                    let inside = u64::from(channel) % chunk;
                    offset = usize::try_from(inside).expect("within a chunk") * self.strides[n];
                }
                Axis::Space(axis) => {
                    strides[*axis] = self.strides[n];
                    cell[*axis] = chunk;
                    spatial[*axis] = Some(n);
                }
            }
        }
        let cells = |axis: usize| {
            let (min, max) = (u64::from(voxels.min[axis]), u64::from(voxels.max[axis]));
            min / cell[axis]..max.div_ceil(cell[axis])
        };
        let mut touched = Vec::new();
        for z in cells(2) {
            for y in cells(1) {
                for x in cells(0) {
                    let at = [x, y, z];
                    let edge = |axis: usize, more: u64| {
                        let edge = (at[axis] + more).saturating_mul(cell[axis]);
                        u32::try_from(edge)
                            .unwrap_or(u32::MAX)
                            .min(self.extent[axis])
                    };
                    let corner = |more| UVec3::new(edge(0, more), edge(1, more), edge(2, more));
                    for (axis, n) in spatial.iter().enumerate() {
                        if let Some(n) = n {
                            index[*n] = at[axis];
                        }
                    }
                    let place = Place {
                        voxels: VoxelBox::new(corner(0), corner(1)),
                        strides,
                        offset,
                    };
                    touched.push((ravel(&index, &self.grid), place));
                }
            }
        }
        touched
    }
}

/// The number of an index, last axis fastest.
fn ravel(index: &[u64], counts: &[u64]) -> u64 {
    index
        .iter()
        .zip(counts)
        .fold(0, |number, (at, count)| number * count + at)
}

fn unravel(mut number: u64, counts: &[u64]) -> Vec<u64> {
    let mut index = vec![0; counts.len()];
    for (at, count) in index.iter_mut().zip(counts).rev() {
        *at = number % count;
        number /= count;
    }
    index
}
