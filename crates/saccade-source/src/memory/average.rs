//! Coarser levels as means of what was acquired, or as the most frequent labels.

use glam::{DVec3, UVec3};
use saccade_core::volume::VoxelKind;
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

/// What a coarser voxel is that covers some: the mean of shades, the most frequent of labels.
pub(super) fn coarser(kind: VoxelKind, values: impl Iterator<Item = u8>) -> u8 {
    match kind {
        VoxelKind::Intensity => mean(values),
        VoxelKind::Labels => most_frequent(values),
    }
}

/// The most frequent value, 0 like any other, of several the smallest; 0 where there are none.
fn most_frequent(values: impl Iterator<Item = u8>) -> u8 {
    let mut votes = [0_u32; 256];
    values.for_each(|value| votes[usize::from(value)] += 1);
    let most = votes.iter().max().copied().unwrap_or(0);
    let labels = (0..=u8::MAX).zip(votes);
    let mut winners = labels.filter(|(_, votes)| *votes == most);
    winners.next().map_or(0, |(label, _)| label)
}

/// The mean of the nonzero values, rounded; 0 where there are none.
fn mean(values: impl Iterator<Item = u8>) -> u8 {
    let (mut sum, mut count) = (0_u64, 0_u64);
    for value in values {
        sum += u64::from(value);
        count += u64::from(value != 0);
    }
    let mean = (sum + count / 2).checked_div(count).unwrap_or(0);
    u8::try_from(mean).expect("a mean of bytes is a byte")
}
