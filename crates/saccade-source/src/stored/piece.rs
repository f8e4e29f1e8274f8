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
}

/// Copies what a piece has of `wanted` into a chunk of `size` that begins where `wanted` does.
///
/// # Panics
///
/// If the piece is shorter than its place.
pub(crate) fn copy(
    values: &[u8],
    place: &Place,
    wanted: VoxelBox,
    chunk: &mut [u8],
    size: UVec3,
    width: usize,
) {
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
    let [nx, ny, nz] = both.size().to_array().map(|n| n as usize);
    let [fx, fy, fz] = from.to_array().map(|n| n as usize);
    let first =
        place.offset + fx * place.strides[0] + fy * place.strides[1] + fz * place.strides[2];
    for z in 0..nz {
        for y in 0..ny {
            let from = (first + y * place.strides[1] + z * place.strides[2]) * width;
            let row = row(chunk, to, y, z, nx, size, width);
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
}

/// Like [`copy`], of a piece that has the same value everywhere.
pub(crate) fn fill(
    value: u16,
    place: &Place,
    wanted: VoxelBox,
    chunk: &mut [u8],
    size: UVec3,
    width: usize,
) {
    let both = place.voxels.intersection(wanted);
    let Some(to) = both.min.checked_sub(wanted.min) else {
        return;
    };
    let [nx, ny, nz] = both.size().to_array().map(|n| n as usize);
    for z in 0..nz {
        for y in 0..ny {
            let row = row(chunk, to, y, z, nx, size, width);
            for voxel in row.chunks_exact_mut(width) {
                voxel.copy_from_slice(&value.to_le_bytes()[..width]);
            }
        }
    }
}

/// `count` voxels of a chunk, from `to` on, `y` rows and `z` sections further.
fn row(
    chunk: &mut [u8],
    to: UVec3,
    y: usize,
    z: usize,
    count: usize,
    size: UVec3,
    width: usize,
) -> &mut [u8] {
    let [x0, y0, z0] = to.to_array().map(|n| n as usize);
    let [sx, sy, _] = size.to_array().map(|n| n as usize);
    let at = ((z0 + z) * sy + y0 + y) * sx + x0;
    &mut chunk[at * width..][..count * width]
}
