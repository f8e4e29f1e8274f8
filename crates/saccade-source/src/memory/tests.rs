#![allow(clippy::cast_possible_truncation, reason = "test volumes are small")]

use futures::{FutureExt, StreamExt};
use glam::{DVec3, UVec3};
use pollster::block_on;
use saccade_core::volume::{Volume, VoxelKind};
use saccade_core::voxel_box::VoxelBox;

use super::*;
use crate::changes::BACKLOG;
use crate::conformance::{check_changes, check_missed, check_reading};
use crate::{ChangeReason, VolumeSource};

fn volume() -> Volume {
    let mut volume = Volume::new("v", UVec3::new(70, 33, 9), DVec3::new(4.0, 4.0, 9.0)).unwrap();
    volume.chunk = UVec3::new(16, 16, 4);
    volume
}

/// Level 0 of the test volume; a third of it was not acquired.
fn level0(voxel: UVec3) -> u8 {
    if voxel.x < 24 {
        return 0;
    }
    ((voxel.x * 7 + voxel.y * 31 + voxel.z * 101) % 255 + 1) as u8
}

/// A chunk by definition: the mean of acquired voxels, in floating point.
fn by_definition(volume: &Volume, value: impl Fn(UVec3) -> u8, id: ChunkId) -> Vec<u8> {
    let level = volume.levels[id.level as usize];
    let by = level.downsampling.as_uvec3();
    let extent = volume.extent();
    let voxels = VoxelBox::of_size(volume.chunk).iter();
    let mean = voxels.map(|v| {
        let v = v + id.chunk * volume.chunk;
        let (mut sum, mut count) = (0.0, 0.0);
        for z in (v.z * by.z..(v.z + 1) * by.z).filter(|z| *z < extent.z) {
            for y in (v.y * by.y..(v.y + 1) * by.y).filter(|y| *y < extent.y) {
                for x in (v.x * by.x..(v.x + 1) * by.x).filter(|x| *x < extent.x) {
                    let value = f64::from(value(UVec3::new(x, y, z)));
                    sum += value;
                    count += if value > 0.0 { 1.0 } else { 0.0 };
                }
            }
        }
        if count > 0.0 {
            (sum / count).round() as u8
        } else {
            0
        }
    });
    mean.collect()
}

fn array() -> ArraySource {
    let values = VoxelBox::of_size(volume().extent()).iter().map(level0);
    ArraySource::new(volume(), values.collect()).unwrap()
}

#[test]
fn arrays_conform() {
    let volume = volume();
    block_on(check_reading(
        &array(),
        |id| by_definition(&volume, level0, id),
        0,
    ))
    .unwrap();
}

#[test]
fn arrays_change() {
    let (volume, source) = (volume(), array());
    let touched = VoxelBox::new(UVec3::new(3, 5, 2), UVec3::new(40, 20, 8));
    let filled = std::cell::Cell::new(0);
    let change = async || {
        filled.set(filled.get() + 70);
        let values = vec![filled.get(); touched.voxels() as usize];
        source.set(touched, &values).unwrap();
        touched
    };
    let now = |v: UVec3| {
        if touched.contains(v) {
            filled.get()
        } else {
            level0(v)
        }
    };
    let oracle = |id| by_definition(&volume, now, id);
    block_on(check_changes(&source, 3, change, oracle, 0)).unwrap();
}

/// What is kept of chunks' values follows their voxels, at all levels.
#[test]
fn ranges_are_those_of_the_voxels_that_are_there_now() {
    let source = array();
    let volume = source.volume().clone();
    let check = || {
        let mut empty = 0;
        for level in 0..volume.levels.len() {
            for chunk in VoxelBox::of_size(volume.chunks(level)).iter() {
                let level = level as u32;
                let id = ChunkId {
                    channel: 0,
                    level,
                    chunk,
                };
                let voxels = match block_on(source.read(id)).unwrap() {
                    Chunk::Voxels(voxels) => voxels.to_vec(),
                    Chunk::Empty => Vec::new(),
                };
                let measured = || voxels.iter().filter(|value| **value != 0);
                let want = measured().min().zip(measured().max());
                let got = source.value_range(id).map(|range| (range.min, range.max));
                let want = want.map(|(min, max)| (u16::from(*min), u16::from(*max)));
                assert_eq!(got, want, "{id}");
                empty += u32::from(want.is_none());
            }
        }
        empty
    };
    let before = check();
    assert!(before > 0, "a third is empty");
    // Across chunks, to the largest value, to the smallest, and to nothing at all.
    let corner = |x, y, z| UVec3::new(x, y, z);
    for (min, max, value) in [
        (corner(15, 15, 3), corner(17, 17, 5), 255),
        (corner(3, 1, 0), corner(4, 2, 1), 1),
        (corner(32, 16, 4), corner(70, 33, 9), 0),
    ] {
        let voxels = VoxelBox::new(min, max);
        let values = vec![value; voxels.voxels() as usize];
        source.set(voxels, &values).unwrap();
        check();
    }
    assert!(check() > before, "more is empty");
    let beyond = ChunkId {
        channel: 0,
        level: 0,
        chunk: volume.chunks(0),
    };
    assert_eq!(source.value_range(beyond), None);
}

#[test]
fn listeners_that_fall_behind_are_told() {
    let source = array();
    let one = VoxelBox::of_size(UVec3::ONE);
    let change = async || {
        source.set(one, &[9]).unwrap();
        one
    };
    let cause = async || {
        for _ in 0..BACKLOG + 1 {
            source.set(one, &[7]).unwrap();
        }
    };
    block_on(check_missed(&source, cause, change)).unwrap();
    let few = async || assert!(source.set(one, &[7]).is_ok());
    let told = block_on(check_missed(&source, few, async || one));
    assert!(
        told.is_err(),
        "one change is not missed by a listener that keeps up"
    );
}

#[test]
fn arrays_of_the_wrong_size_are_refused() {
    let expected = WrongLength {
        expected: 70 * 33 * 9,
        got: 5,
    };
    assert_eq!(ArraySource::new(volume(), vec![1; 5]).err(), Some(expected));
    let source = array();
    let outside = VoxelBox::new(UVec3::new(69, 0, 0), UVec3::new(71, 1, 1));
    assert!(source.set(outside, &[1, 1]).is_err());
    assert!(source.set(outside, &[1]).is_err());
}

#[test]
fn procedures_conform() {
    let volume = volume();
    let acquired = VoxelBox::new(UVec3::new(24, 0, 0), volume.extent());
    // Means over at most 4 voxels an axis are exact.
    let source = ProceduralSource::averaged(volume.clone(), acquired, level0);
    block_on(check_reading(
        &source,
        |id| by_definition(&volume, level0, id),
        0,
    ))
    .unwrap();
}

/// The label that most level-0 voxels of a voxel have, of several the smallest, by definition.
fn most_frequent(volume: &Volume, value: impl Fn(UVec3) -> u8, id: ChunkId) -> Vec<u8> {
    let level = volume.levels[id.level as usize];
    let by = level.downsampling.as_uvec3();
    let voxels = VoxelBox::of_size(volume.chunk).iter();
    let winner = voxels.map(|v| {
        let v = v + id.chunk * volume.chunk;
        let covered = VoxelBox::new(v * by, (v + 1) * by);
        let covered = covered.intersection(VoxelBox::of_size(volume.extent()));
        let mut labels: Vec<u8> = covered.iter().map(&value).collect();
        labels.sort_unstable();
        let runs: Vec<&[u8]> = labels.chunk_by(|a, b| a == b).collect();
        let most = runs.iter().map(|run| run.len()).max();
        let first = runs.iter().find(|run| Some(run.len()) == most);
        first.map_or(0, |run| run[0])
    });
    winner.collect()
}

#[test]
fn labels_in_memory_are_never_averaged() {
    let mut volume = volume();
    volume.kind = VoxelKind::Labels;
    let value = |v: UVec3| [0, 3, 90, 200][usize::from(level0(v)) / 5 % 4];
    let oracle = |id| most_frequent(&volume, value, id);
    let values = VoxelBox::of_size(volume.extent()).iter().map(value);
    let array = ArraySource::new(volume.clone(), values.collect()).unwrap();
    block_on(check_reading(&array, oracle, 0)).unwrap();
    let acquired = VoxelBox::of_size(volume.extent());
    let procedure = ProceduralSource::averaged(volume.clone(), acquired, value);
    block_on(check_reading(&procedure, oracle, 0)).unwrap();
    let shades = |id| by_definition(&volume, value, id);
    assert!(block_on(check_reading(&array, shades, 0)).is_err());
}

#[test]
fn what_was_not_acquired_is_never_computed() {
    let volume = Volume::new(
        "petascale",
        UVec3::new(32_768, 32_768, 4_096),
        DVec3::new(5.0, 5.0, 40.0),
    )
    .unwrap();
    let acquired = VoxelBox::new(
        UVec3::new(16_000, 16_000, 2_000),
        UVec3::new(16_100, 16_100, 2_010),
    );
    let source = ProceduralSource::new(volume.clone(), acquired, move |level, voxel| {
        let covered = volume.levels[level as usize];
        let covered = covered.voxels_from_box(VoxelBox::new(voxel, voxel + 1));
        assert!(covered.intersects(acquired), "{level} {voxel}");
        200
    });
    let id = |level, x, y, z| ChunkId {
        channel: 0,
        level,
        chunk: UVec3::new(x, y, z),
    };
    assert_eq!(block_on(source.read(id(0, 0, 0, 0))).unwrap(), Chunk::Empty);
    assert!(matches!(
        block_on(source.read(id(0, 250, 250, 62))).unwrap(),
        Chunk::Voxels(_)
    ));
    let coarsest = u32::try_from(source.volume().levels.len() - 1).unwrap();
    assert!(matches!(
        block_on(source.read(id(coarsest, 0, 0, 0))).unwrap(),
        Chunk::Voxels(_)
    ));

    let mut changes = source.changes();
    assert!(changes.next().now_or_never().is_none());
    source.acquire(VoxelBox::of_size(UVec3::splat(8)));
    let change = block_on(changes.next()).unwrap();
    assert_eq!((change.revision, change.reason), (1, ChangeReason::Tile));
}
