//! Voxels of a piece, copied to where they are in a chunk.

use glam::UVec3;
use saccade_core::voxel_box::VoxelBox;

/// Where a piece has its voxels, and in which order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Place {
    /// Voxels that it has \[voxels of the level\].
    pub(crate) voxels: VoxelBox,
    /// Values between neighbours along x, y, z.
    pub(crate) strides: [usize; 3],
    /// Values before the first.
    pub(crate) offset: usize,
}

impl Place {
    /// Values that a piece must have for the place to lie in it.
    pub(crate) fn reach(&self) -> usize {
        let size = self.voxels.size().to_array();
        let last = size
            .iter()
            .zip(self.strides)
            .map(|(n, stride)| (*n as usize - 1) * stride);
        self.offset + last.sum::<usize>() + 1
    }

    /// Whether a piece has exactly these voxels, as a chunk of `size` that they fill has them.
    pub(crate) fn is(&self, voxels: VoxelBox, size: UVec3) -> bool {
        let [sx, sy, _] = size.to_array().map(|n| n as usize);
        let whole = self.voxels == voxels && voxels.size() == size;
        whole && self.strides == [1, sx, sx * sy] && self.offset == 0
    }
}

/// A chunk that is put together, x fastest.
#[derive(Debug)]
pub(crate) struct ChunkMut<'a> {
    pub(crate) bytes: &'a mut [u8],
    /// \[voxels\]
    pub(crate) size: UVec3,
    /// Bytes of a value.
    pub(crate) width: usize,
    /// Its voxel from which on there is something.
    pub(crate) begin: UVec3,
}

impl ChunkMut<'_> {
    /// `count` voxels in a row, the first of them `to` from where something begins.
    fn row(&mut self, to: UVec3, count: usize) -> &mut [u8] {
        let [x, y, z] = (self.begin + to).to_array().map(|n| n as usize);
        let [sx, sy, _] = self.size.to_array().map(|n| n as usize);
        let at = (z * sy + y) * sx + x;
        &mut self.bytes[at * self.width..][..count * self.width]
    }
}

/// Copies what a piece has of `wanted`, which is what there is in a chunk.
///
/// # Panics
///
/// If the piece is shorter than its place.
pub(crate) fn copy(values: &[u8], place: &Place, wanted: VoxelBox, chunk: &mut ChunkMut<'_>) {
    let width = chunk.width;
    assert!(
        values.len() >= place.reach() * width,
        "a piece has all its values"
    );
    let both = place.voxels.intersection(wanted);
    let (Some(from), Some(to)) = (
        both.min.checked_sub(place.voxels.min),
        both.min.checked_sub(wanted.min),
    ) else {
        return;
    };
    let [fx, fy, fz] = from.to_array().map(|n| n as usize);
    let first =
        place.offset + fx * place.strides[0] + fy * place.strides[1] + fz * place.strides[2];
    let nx = both.size().x as usize;
    for row in rows(both) {
        let [y, z] = [row.y, row.z].map(|n| n as usize);
        let from = (first + y * place.strides[1] + z * place.strides[2]) * width;
        let row = chunk.row(to + row, nx);
        match (place.strides[0], width) {
            (1, _) => row.copy_from_slice(&values[from..][..nx * width]),
            (stride, 1) => {
                for (to, from) in row.iter_mut().zip(values[from..].iter().step_by(stride)) {
                    *to = *from;
                }
            }
            (stride, _) => {
                let from = values[from..].chunks(stride * width);
                for (to, from) in row.chunks_exact_mut(width).zip(from) {
                    to.copy_from_slice(&from[..width]);
                }
            }
        }
    }
}

/// Like [`copy`], of a piece that has the same value everywhere.
pub(crate) fn fill(value: u16, place: &Place, wanted: VoxelBox, chunk: &mut ChunkMut<'_>) {
    let both = place.voxels.intersection(wanted);
    let Some(to) = both.min.checked_sub(wanted.min) else {
        return;
    };
    let (nx, width) = (both.size().x as usize, chunk.width);
    for row in rows(both) {
        for voxel in chunk.row(to + row, nx).chunks_exact_mut(width) {
            voxel.copy_from_slice(&value.to_le_bytes()[..width]);
        }
    }
}

/// Where the rows of a box begin, from its first voxel.
fn rows(voxels: VoxelBox) -> impl Iterator<Item = UVec3> {
    VoxelBox::of_size(voxels.size().with_x(1)).iter()
}
