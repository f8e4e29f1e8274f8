//! Lost sections are filled from those around them, and nothing of it is stale.

use futures::StreamExt;
use glam::{DVec3, UVec3};
use saccade_core::voxel_box::VoxelBox;

use super::fixture::{Fixture, Levels, read_all, tile};
use super::run;
use crate::VolumeSource;
use crate::conformance::check_reading;
use crate::stitched::{Gaps, StitchedOptions, StitchedSource};

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
