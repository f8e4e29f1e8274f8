//! Coarser levels as means of what was acquired.

use glam::{DVec3, UVec3};
use saccade_core::voxel_box::VoxelBox;

/// The level-0 voxels whose centres lie inside voxel `v` of a level, cut at the volume's end.
pub(super) fn level0_voxels(v: UVec3, downsampling: DVec3, extent: UVec3) -> VoxelBox {
    let first = |v: UVec3| {
        (v.as_dvec3() * downsampling - 0.5)
            .ceil()
            .max(DVec3::ZERO)
            .as_uvec3()
    };
    VoxelBox::new(first(v), first(v.saturating_add(UVec3::ONE)).min(extent))
}

/// The mean of the nonzero values, rounded; 0 where there are none.
pub(super) fn mean(values: impl Iterator<Item = u8>) -> u8 {
    let (mut sum, mut count) = (0_u64, 0_u64);
    for value in values {
        sum += u64::from(value);
        count += u64::from(value != 0);
    }
    let mean = (sum + count / 2).checked_div(count).unwrap_or(0);
    u8::try_from(mean).expect("a mean of bytes is a byte")
}
