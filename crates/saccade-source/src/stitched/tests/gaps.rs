//! Lost sections are filled from those around them, and nothing of it is stale.

use std::sync::Arc;

use futures::StreamExt;
use glam::{DVec3, UVec3};
use saccade_archive::storage::MemoryStorage;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;

use super::changes::Wrong;
use super::fixture::{Fixture, Levels, difference, expected_as, read_all, read_channel, tile};
use super::oracle::How;
use super::run;
use crate::conformance::check_reading;
use crate::stitched::{Gaps, StitchedOptions, StitchedSource};
use crate::{Change, ChunkId, VolumeSource};

const EXTENT: UVec3 = UVec3::new(90, 70, 14);

/// One tile in each of these sections, of which 2 is smaller than the others.
async fn with_sections(sections: &[u32]) -> Fixture {
    let mut fixture = Fixture::new(EXTENT, DVec3::new(4.0, 4.0, 40.0)).await;
    for &section in sections {
        put(&mut fixture, section).await;
    }
    fixture
}

async fn put(fixture: &mut Fixture, section: u32) {
    let size = if section == 2 { (50, 70) } else { (90, 70) };
    let tile = tile(size, section, (0.0, 0.0), 0.0, 1.0, u64::from(section) + 40);
    fixture.put(&format!("s{section}"), tile).await;
}

async fn open(fixture: &Fixture, gaps: Gaps) -> StitchedSource {
    let options = StitchedOptions {
        gaps,
        ..StitchedOptions::default()
    };
    fixture.open_with(options).await
}

/// A section of level 0.
fn plane(levels: &Levels, z: usize) -> &[u16] {
    let size = (EXTENT.x * EXTENT.y) as usize;
    &levels[0][z * size..(z + 1) * size]
}

#[test]
fn gaps_are_filled_as_told_and_no_longer_ones() {
    run(async {
        // Gaps of two, one and three; before 2 and behind 12 there is nothing to fill from.
        let fixture = with_sections(&[2, 5, 7, 11, 12]).await;
        let measured = fixture.expected();
        for (gaps, from) in [
            (Gaps::Empty, [None; 5]),
            (Gaps::Nearest(2), [Some(2), Some(5), Some(5), None, None]),
            (
                Gaps::Nearest(3),
                [Some(2), Some(5), Some(5), Some(7), Some(11)],
            ),
        ] {
            let got = read_all(&open(&fixture, gaps).await).await;
            for (z, from) in [3, 4, 6, 9, 10].into_iter().zip(from) {
                match from {
                    Some(from) => {
                        assert_eq!(plane(&got, z), plane(&measured, from), "{gaps:?} {z}")
                    }
                    None => assert!(plane(&got, z).iter().all(|v| *v == 0), "{gaps:?} {z}"),
                }
            }
            for z in [2, 5, 7, 11, 12] {
                assert_eq!(plane(&got, z), plane(&measured, z), "{gaps:?}, measured");
            }
            for z in [0, 1, 13] {
                assert!(plane(&got, z).iter().all(|v| *v == 0), "{gaps:?}, outside");
            }
        }
        let got = read_all(&open(&fixture, Gaps::Linear(3)).await).await;
        for (z, below, above) in [(3, 2, 5), (4, 2, 5), (6, 5, 7), (8, 7, 11), (10, 7, 11)] {
            let part = (z - below) as f64 / (above - below) as f64;
            let pairs = plane(&measured, below).iter().zip(plane(&measured, above));
            let mut differs = false;
            for (got, (below, above)) in plane(&got, z).iter().zip(pairs) {
                let (a, b) = (f64::from(*below), f64::from(*above));
                let want = if *below == 0 { b } else { a + (b - a) * part };
                assert!(
                    (f64::from(*got) - want).abs() < 1.0,
                    "z {z}: {got}, not {want}"
                );
                differs |= (want - a).abs() > 20.0;
            }
            assert!(differs, "another weight would be seen");
        }
    });
}

/// Every level, bounds included, reads as the source itself says at other times.
#[test]
fn sources_with_filled_gaps_conform() {
    run(async {
        let fixture = with_sections(&[2, 5, 7, 11]).await;
        for gaps in [Gaps::Nearest(2), Gaps::Linear(9)] {
            let source = open(&fixture, gaps).await;
            let levels = read_all(&open(&fixture, gaps).await).await;
            let volume = fixture.volume.clone();
            let oracle = |id| super::chunk_of(&volume, &levels, id);
            check_reading(&source, oracle, 0).await.unwrap();
        }
    });
}

#[test]
fn what_fills_gaps_follows_changes() {
    run(async {
        for gaps in [Gaps::Nearest(3), Gaps::Linear(3)] {
            let mut fixture = with_sections(&[2, 9]).await;
            let source = open(&fixture, gaps).await;
            let mut changes = source.changes();
            let mut before = read_all(&source).await;
            // The gap of six falls into smaller ones; then a section around one changes, and moves.
            for section in [5, 7, 6, 5, 2] {
                put(&mut fixture, section).await;
                let newest = fixture.archive.catalog().revision("v").await.unwrap();
                let mut told = Vec::new();
                loop {
                    let change = changes.next().await.unwrap();
                    told.push(change.voxels);
                    if change.revision >= newest {
                        break;
                    }
                }
                let after = read_all(&source).await;
                let fresh = read_all(&open(&fixture, gaps).await).await;
                assert!(after == fresh, "{gaps:?}: stale after {section}");
                for (voxel, (a, b)) in VoxelBox::of_size(EXTENT)
                    .iter()
                    .zip(before[0].iter().zip(&after[0]))
                {
                    let is_told = || told.iter().any(|told| told.contains(voxel));
                    assert!(
                        a == b || is_told(),
                        "{gaps:?}: {voxel} changed with {section}"
                    );
                }
                before = after;
            }
        }
    });
}

/// Two channels, the second one in every second section only.
async fn alternating() -> Fixture {
    let extent = EXTENT.with_z(15);
    let mut volume = Volume::new("v", extent, DVec3::new(4.0, 4.0, 12.0)).unwrap();
    volume.channels = vec!["structure".into(), "marker".into()];
    let mut fixture = Fixture::of(Arc::new(MemoryStorage::new()), volume).await;
    for section in 0..15 {
        put_of(&mut fixture, section, 0, (90, 70)).await;
        if section % 2 == 1 {
            put_of(&mut fixture, section, 1, (90, 70)).await;
        }
    }
    fixture
}

/// A new image each time.
async fn put_of(fixture: &mut Fixture, section: u32, channel: u32, size: (usize, usize)) {
    let seed = fixture.archive.catalog().revision("v").await.unwrap() + 7;
    let mut tile = tile(size, section, (0.0, 0.0), 0.0, 1.0, seed);
    tile.channel = channel;
    fixture.put(&format!("s{section}c{channel}"), tile).await;
}

const FILLED: [Gaps; 5] = [
    Gaps::Empty,
    Gaps::Nearest(1),
    Gaps::Nearest(3),
    Gaps::Linear(1),
    Gaps::Linear(3),
];

/// A channel as it should be.
fn expected_of(fixture: &Fixture, gaps: Gaps, channel: u32) -> Levels {
    let how = How {
        gaps: gaps.longest(),
        gaps_mix: matches!(gaps, Gaps::Linear(_)),
        channel,
        ..How::PLAIN
    };
    expected_as(&fixture.volume, &fixture.tiles, how)
}

fn check(got: &Levels, want: &Levels) {
    let (coverage, most) = difference(got, want);
    assert_eq!((coverage, most <= 1), (0, true), "{most} grey levels");
}

#[test]
fn what_a_channel_leaves_out_is_filled_as_by_brute_force() {
    run(async {
        let mut fixture = alternating().await;
        // One that it leaves out as well, and one of which it has a part.
        fixture.delete("s7c1").await;
        put_of(&mut fixture, 11, 1, (40, 70)).await;
        let wanted = FILLED.map(|gaps| expected_of(&fixture, gaps, 1));
        for (n, gaps) in FILLED.into_iter().enumerate() {
            let source = open(&fixture, gaps).await;
            check(
                &read_channel(&source, 0).await,
                &expected_of(&fixture, gaps, 0),
            );
            let got = read_channel(&source, 1).await;
            for (other, want) in wanted.iter().enumerate() {
                let (coverage, most) = difference(&got, want);
                assert_eq!(n == other, coverage == 0 && most <= 1, "{gaps:?} {other}");
            }
            // Bounds hold, and nothing is said to be there where nothing is.
            let wanted = [expected_of(&fixture, gaps, 0), wanted[n].clone()];
            let oracle =
                |id: ChunkId| super::chunk_of(&fixture.volume, &wanted[id.channel as usize], id);
            check_reading(&open(&fixture, gaps).await, oracle, 1)
                .await
                .unwrap();
        }
    });
}

/// What is told is what is another now: all planes that show it, and none besides.
#[test]
fn a_channel_that_comes_late_takes_the_place_of_what_filled_it() {
    run(async {
        for gaps in FILLED {
            let mut fixture = alternating().await;
            let source = open(&fixture, gaps).await;
            let mut changes = source.changes();
            let mut before = [
                read_channel(&source, 0).await,
                read_channel(&source, 1).await,
            ];
            for step in 0..7 {
                match step {
                    // Between two, a part; before the first and behind the last.
                    0 => put_of(&mut fixture, 4, 1, (50, 70)).await,
                    1 => put_of(&mut fixture, 0, 1, (90, 70)).await,
                    2 => put_of(&mut fixture, 14, 1, (90, 40)).await,
                    // A gap of three, that is none, and is one again.
                    3 => drop(fixture.delete("s9c1").await),
                    4 => put_of(&mut fixture, 9, 1, (90, 70)).await,
                    // Its neighbours show it; those of the other channel do not.
                    5 => {
                        let to = tile((90, 70), 11, (30.0, 9.0), 0.0, 1.0, 0).transform;
                        fixture.transform("s11c1", to).await;
                    }
                    _ => put_of(&mut fixture, 2, 0, (90, 70)).await,
                }
                let newest = fixture.archive.catalog().revision("v").await.unwrap();
                let mut told = Vec::new();
                while told
                    .last()
                    .is_none_or(|last: &Change| last.revision < newest)
                {
                    told.push(changes.next().await.unwrap());
                }
                let after = [
                    read_channel(&source, 0).await,
                    read_channel(&source, 1).await,
                ];
                for (channel, after) in (0..).zip(&after) {
                    check(after, &expected_of(&fixture, gaps, channel));
                }
                let extent = fixture.volume.extent();
                let mut planes = vec![false; extent.z as usize];
                for (before, after) in before.iter().zip(&after) {
                    let pairs = before[0].iter().zip(&after[0]);
                    for (voxel, (a, b)) in VoxelBox::of_size(extent).iter().zip(pairs) {
                        let is_told = || told.iter().any(|told| told.voxels.contains(voxel));
                        assert!(a == b || is_told(), "{gaps:?}, step {step}: {voxel}");
                        planes[voxel.z as usize] |= a != b;
                    }
                }
                let is_told = |z| {
                    told.iter()
                        .any(|told| (told.voxels.min.z..told.voxels.max.z).contains(&z))
                };
                let told: Vec<bool> = (0..extent.z).map(is_told).collect();
                // Where a gap begins or ends to be one, all of it is told, though a part shows the same section as before.
                if !(gaps == Gaps::Nearest(3) && [3, 4].contains(&step)) {
                    assert_eq!(told, planes, "{gaps:?}, step {step}");
                }
                before = after;
            }
        }
    });
}

/// Negative control: a source that tells only where what changed lies changes elsewhere as well.
#[test]
fn what_is_filled_and_not_told_is_found() {
    run(async {
        let mut fixture = alternating().await;
        let source = open(&fixture, Gaps::Nearest(1)).await;
        source.go_wrong(Some(Wrong::Filled));
        let mut changes = source.changes();
        let before = read_channel(&source, 1).await;
        put_of(&mut fixture, 9, 1, (90, 70)).await;
        let told = changes.next().await.unwrap().voxels;
        let after = read_channel(&source, 1).await;
        let pairs = before[0].iter().zip(&after[0]);
        let all = VoxelBox::of_size(fixture.volume.extent()).iter().zip(pairs);
        let untold = all.filter(|(voxel, (a, b))| a != b && !told.contains(*voxel));
        assert!(untold.count() > 1000);
    });
}
