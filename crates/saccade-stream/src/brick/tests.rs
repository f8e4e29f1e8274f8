use std::collections::HashMap;

use glam::{DVec3, IVec3};
use proptest::prelude::*;

use super::*;

/// A value for every voxel position, never 0, different from its neighbours'.
fn value(at: UVec3) -> u8 {
    let mixed = at.x.wrapping_mul(7) ^ at.y.wrapping_mul(31) ^ at.z.wrapping_mul(113);
    u8::try_from(mixed % 255).unwrap() + 1
}

fn volume(extent: UVec3, chunk: UVec3) -> Volume {
    Volume {
        chunk,
        ..Volume::new("v", extent, DVec3::ONE).unwrap()
    }
}

/// Chunks of level 0, padded with poison: nothing outside of the volume may be read.
fn chunks(volume: &Volume, value: impl Fn(UVec3) -> u8) -> HashMap<ChunkId, Chunk> {
    let all = VoxelBox::of_size(volume.chunks(0));
    let chunk = |chunk: UVec3| {
        let min = chunk * volume.chunk;
        let voxels: Vec<u8> = VoxelBox::new(min, min + volume.chunk)
            .iter()
            .map(|at| {
                if at.cmplt(volume.extent()).all() {
                    value(at)
                } else {
                    0xEE
                }
            })
            .collect();
        let empty = voxels.iter().all(|&v| v == 0 || v == 0xEE);
        let chunk_of = if empty {
            Chunk::Empty
        } else {
            Chunk::Voxels(voxels.into())
        };
        (
            ChunkId {
                channel: 0,
                level: 0,
                chunk,
            },
            chunk_of,
        )
    };
    all.iter().map(chunk).collect()
}

/// The same brick from the positions alone: clamp, look up.
fn expected(id: BrickId, extent: UVec3, value: impl Fn(UVec3) -> u8) -> Vec<u8> {
    let first = id.brick().as_ivec3() * 32 - 1;
    let mut voxels = Vec::new();
    for z in 0..34 {
        for y in 0..34 {
            for x in 0..34 {
                let at = first + IVec3::new(x, y, z);
                let at = at.clamp(IVec3::ZERO, extent.as_ivec3() - 1);
                voxels.push(value(at.as_uvec3()));
            }
        }
    }
    voxels
}

fn brick(x: u32, y: u32, z: u32) -> BrickId {
    BrickId::new(0, 0, UVec3::new(x, y, z)).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn bricks_equal_the_plain_array(
        extent in (1_u32..80, 1_u32..80, 1_u32..80).prop_map(UVec3::from),
        chunk in (3_u32..70, 3_u32..70, 3_u32..70).prop_map(UVec3::from),
        pick in (0_u32..3, 0_u32..3, 0_u32..3).prop_map(UVec3::from),
    ) {
        let bricks = saccade_core::brick::bricks_of(extent);
        let id = BrickId::new(0, 0, pick.min(bricks - 1)).unwrap();
        let volume = volume(extent, chunk);
        let chunks = chunks(&volume, value);
        let mut assembler = Assembler::default();
        let got = assembler.assemble(id, &volume, |id| chunks.get(&id)).unwrap();
        let BrickVoxels::Voxels(got) = got else { panic!("no voxel is 0") };
        prop_assert!(got == expected(id, extent, value));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Each byte of a wider voxel goes where the voxel goes.
    #[test]
    fn sixteen_bit_bricks_are_two_of_eight_bit(
        extent in (1_u32..80, 1_u32..80, 1_u32..80).prop_map(UVec3::from),
        chunk in (3_u32..70, 3_u32..70, 3_u32..70).prop_map(UVec3::from),
        pick in (0_u32..3, 0_u32..3, 0_u32..3).prop_map(UVec3::from),
    ) {
        let bricks = saccade_core::brick::bricks_of(extent);
        let id = BrickId::new(0, 0, pick.min(bricks - 1)).unwrap();
        let narrow = volume(extent, chunk);
        let high = |at: UVec3| value(at) ^ 1;
        let [lows, highs] = [chunks(&narrow, value), chunks(&narrow, high)];
        let wide = |id: &ChunkId| match (&lows[id], &highs[id]) {
            (Chunk::Voxels(low), Chunk::Voxels(high)) => {
                let pairs = low.iter().zip(high);
                Chunk::Voxels(pairs.flat_map(|(&low, &high)| [low, high]).collect())
            }
            _ => Chunk::Empty,
        };
        let chunks: HashMap<_, _> = lows.keys().map(|id| (*id, wide(id))).collect();
        let deep = Volume { dtype: saccade_core::volume::Dtype::Uint16, ..narrow };
        let mut assembler = Assembler::default();
        let got = assembler.assemble(id, &deep, |id| chunks.get(&id)).unwrap();
        let BrickVoxels::Voxels(got) = got else { panic!("no voxel is 0") };
        let part = |n: usize| got.iter().skip(n).step_by(2).copied().collect::<Vec<_>>();
        prop_assert!(part(0) == expected(id, extent, value));
        prop_assert!(part(1) == expected(id, extent, high));
    }
}

#[test]
fn the_comparison_notices_one_wrong_voxel() {
    let (extent, id) = (UVec3::new(40, 33, 35), brick(1, 1, 1));
    let changed = |at| {
        if at == UVec3::new(31, 32, 34) {
            0
        } else {
            value(at)
        }
    };
    assert_ne!(expected(id, extent, changed), expected(id, extent, value));
}

#[test]
fn borders_come_from_the_neighbour_and_need_its_chunk() {
    let volume = volume(UVec3::splat(64), UVec3::splat(32));
    let mut chunks = chunks(&volume, value);
    let id = brick(0, 0, 0);
    assert_eq!(
        chunks_of(id, &volume).count(),
        8,
        "the far borders lie in seven other chunks"
    );
    let corner = ChunkId {
        channel: 0,
        level: 0,
        chunk: UVec3::ONE,
    };
    chunks.remove(&corner);
    let mut assembler = Assembler::default();
    assert!(
        assembler
            .assemble(id, &volume, |id| chunks.get(&id))
            .is_none()
    );
}

#[test]
fn bricks_without_a_measured_voxel_are_empty() {
    let volume = volume(UVec3::new(70, 40, 40), UVec3::splat(32));
    let zero = Chunk::Voxels(vec![0; 32 * 32 * 32].into());
    for chunk in [Chunk::Empty, zero] {
        let mut assembler = Assembler::default();
        let got = assembler
            .assemble(brick(1, 0, 0), &volume, |_| Some(&chunk))
            .unwrap();
        assert!(matches!(got, BrickVoxels::Empty));
        let allocated = assembler.voxels.capacity() > 0;
        assert_eq!(
            allocated,
            chunk != Chunk::Empty,
            "empty chunks need no memory"
        );
    }
}

#[test]
fn a_single_voxel_in_the_border_makes_a_brick() {
    // Interpolation reaches it, so the brick is not empty.
    let volume = volume(UVec3::splat(64), UVec3::splat(64));
    let chunks = chunks(&volume, |at| u8::from(at == UVec3::new(32, 5, 5)));
    let mut assembler = Assembler::default();
    let got = assembler
        .assemble(brick(0, 0, 0), &volume, |id| chunks.get(&id))
        .unwrap();
    let BrickVoxels::Voxels(got) = got else {
        panic!("one voxel is measured")
    };
    assert_eq!(got.iter().filter(|&&v| v != 0).count(), 1);
    assert_eq!(got[(6 * 34 + 6) * 34 + 33], 1);
}

#[test]
fn bricks_outside_of_the_volume_have_no_chunks() {
    let volume = volume(UVec3::splat(40), UVec3::splat(32));
    assert_eq!(chunks_of(brick(2, 0, 0), &volume).count(), 0);
    let other_channel = BrickId::new(3, 0, UVec3::ZERO).unwrap();
    assert_eq!(chunks_of(other_channel, &volume).count(), 0);
    let other_level = BrickId::new(0, 9, UVec3::ZERO).unwrap();
    assert_eq!(chunks_of(other_level, &volume).count(), 0);
}
