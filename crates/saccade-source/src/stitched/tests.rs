#![allow(clippy::cast_possible_truncation, reason = "test volumes are small")]

mod changes;
mod coarse;
mod disk;
mod failures;
mod fixture;
mod gaps;
mod labels;
mod load;
mod options;
mod oracle;
mod since;

use std::future::Future;
use std::time::Duration;

use glam::{DVec3, UVec2, UVec3};
use proptest::prelude::*;

use super::StitchedOptions;
use crate::conformance::check_reading;
use crate::{Chunk, ChunkId, SourceError, VolumeSource};
pub(super) use changes::Wrong;
pub(super) use fixture::noise;
use fixture::{Fixture, chunk_of, difference, expected, numbers, read_all, tile};

/// Runs a test with a limit, so that a lost answer fails instead of hanging.
fn run<T>(test: impl Future<Output = T>) -> T {
    let mut runtime = tokio::runtime::Builder::new_multi_thread();
    let runtime = runtime.worker_threads(2).enable_all().build().unwrap();
    let limited = async { tokio::time::timeout(Duration::from_secs(60), test).await };
    let ended = runtime.block_on(limited);
    // As the program ends: a cache on disk that has not been closed and frees a unit while its threads are told to
    // stop holds a lock for ever, and whoever waits for the threads with it.
    runtime.shutdown_background();
    ended.expect("the test ends in time")
}

/// Where tiles lie: most sections have six, some have none.
#[derive(Clone, Debug)]
struct Layout {
    extent: UVec3,
    size: (usize, usize),
    scale: f64,
    sections: Vec<bool>,
    jitter: Vec<(f64, f64)>,
    degrees: Vec<f64>,
    seed: u64,
}

fn layouts() -> impl Strategy<Value = Layout> {
    let (tiles, sections) = (6 * 7, 7);
    (
        (150..270_u32, 140..210_u32),
        (110..190_usize, 90..170_usize),
        prop_oneof![Just(1.0), Just(0.5), Just(2.0), 0.8..1.25],
        prop::collection::vec(prop::bool::weighted(0.7), sections),
        prop::collection::vec((-14.0..14.0, -14.0..14.0), tiles),
        prop_oneof![
            prop::collection::vec(Just(0.0), tiles),
            prop::collection::vec(-5.0..5.0, tiles),
            prop::collection::vec(-180.0..180.0, tiles),
        ],
        any::<u64>(),
    )
        .prop_map(
            |((x, y), size, scale, sections, jitter, degrees, seed)| Layout {
                extent: UVec3::new(x, y, sections.len() as u32),
                size,
                scale,
                sections,
                jitter,
                degrees,
                seed,
            },
        )
}

async fn lay(layout: &Layout) -> Fixture {
    let mut fixture = Fixture::new(layout.extent, DVec3::new(4.0, 4.0, 30.0)).await;
    let mut n = 0;
    let sections = (0..).zip(&layout.sections).filter(|(_, there)| **there);
    for (section, _) in sections {
        for (column, row) in [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1)] {
            let (dx, dy) = layout.jitter[n];
            let (w, h) = (layout.size.0 as f64, layout.size.1 as f64);
            let (w, h) = (w * layout.scale, h * layout.scale);
            // Begins left of and above the volume, overlaps by a tenth, and may leave holes.
            let x = f64::from(column) * w * 0.9 - 20.0 + dx;
            let y = f64::from(row) * h * 0.9 - 15.0 + dy;
            let seed = layout.seed ^ n as u64;
            let mut tile = tile(
                layout.size,
                section,
                (x, y),
                layout.degrees[n],
                layout.scale,
                seed,
            );
            if n % 4 == 3 {
                // Black corners are nothing where they fill a sub-tile, and a measurement elsewhere.
                for (at, pixel) in tile.pixels.iter_mut().enumerate() {
                    if at % layout.size.0 < 128 && at / layout.size.0 < 128 {
                        *pixel = 0;
                    }
                }
            }
            let bounds = fixture::bounds(&tile);
            let extent = layout.extent.as_dvec3();
            if bounds.2 > 0.0 && bounds.3 > 0.0 && bounds.0 < extent.x && bounds.1 < extent.y {
                fixture.put(&format!("t{n}"), tile).await;
            }
            n += 1;
        }
    }
    fixture
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 10, ..ProptestConfig::default() })]
    #[test]
    fn equals_brute_force(layout in layouts()) {
        run(async {
            let fixture = lay(&layout).await;
            let source = fixture.open().await;
            let (got, want) = (read_all(&source).await, fixture.expected());
            let (coverage, most) = difference(&got, &want);
            prop_assert_eq!(coverage, 0);
            prop_assert!(most <= 1, "{} grey levels", most);
            Ok(())
        })?;
    }
}

/// Tiles at whole voxels, whose edges and bisectors run through the samples of coarser levels.
async fn aligned() -> Fixture {
    let mut fixture = Fixture::new(UVec3::new(700, 150, 40), DVec3::new(4.0, 4.0, 9.0)).await;
    for section in [0, 1, 2, 5, 33, 39] {
        for n in 0..3 {
            let corner = (f64::from(n) * 230.0 - 16.0, 8.0);
            let seed = u64::from(section * 3 + n);
            let tile = tile((264, 140), section, corner, 0.0, 1.0, seed);
            fixture.put(&format!("s{section}n{n}"), tile).await;
        }
    }
    fixture
}

#[test]
fn ties_and_edges_are_as_written() {
    run(async {
        let fixture = aligned().await;
        let got = read_all(&fixture.open().await).await;
        let want = fixture.expected();
        assert_eq!(got[0], want[0], "at level 0 pixels are voxels");
        let (coverage, most) = difference(&got, &want);
        assert_eq!(coverage, 0);
        assert!(most <= 1, "{most}");
        assert!(
            fixture.volume.levels.len() > 4,
            "levels coarser than the pyramids are compared"
        );
    });
}

#[test]
fn the_comparison_can_fail() {
    run(async {
        let fixture = aligned().await;
        let got = read_all(&fixture.open().await).await;
        let compared = |change: &dyn Fn(&mut oracle::RawTile)| {
            let mut tiles = fixture.tiles.clone();
            change(tiles.values_mut().next().unwrap());
            difference(&got, &expected(&fixture.volume, &tiles))
        };
        assert!(
            compared(&|tile| tile.transform[4] += 1.0).1 > 1,
            "a pixel to the right"
        );
        assert!(
            compared(&|tile| tile.transform[5] -= 0.05).1 > 1,
            "a twentieth up"
        );
        assert!(compared(&|tile| tile.section = 3).0 > 0, "another section");
        assert!(
            compared(&|tile| tile.age = 1000).1 > 1,
            "another winner of ties"
        );
        assert!(
            compared(&|tile| tile.pixels[9_040] ^= 64).1 > 1,
            "one other pixel"
        );
        assert!(compared(&|_| ()).1 <= 1);
    });
}

#[test]
fn conforms() {
    run(async {
        let fixture = aligned().await;
        let want = fixture.expected();
        let source = fixture.open().await;
        let oracle = |id| chunk_of(&fixture.volume, &want, id);
        check_reading(&source, oracle, 1).await.unwrap();
    });
}

#[test]
fn a_block_is_built_once_and_its_sub_tiles_are_decoded_once() {
    run(async {
        let fixture = aligned().await;
        let source = fixture.open().await;
        let volume = fixture.volume.clone();
        let all = saccade_core::voxel_box::VoxelBox::of_size(volume.chunks(0)).iter();
        let ids = all.map(|chunk| ChunkId {
            channel: 0,
            level: 0,
            chunk,
        });
        futures::future::try_join_all(ids.map(|id| source.read(id)))
            .await
            .unwrap();
        let statistics = source.statistics();
        // 700 x 150 x 40 voxels are 2 x 1 x 2 blocks.
        assert_eq!(statistics.blocks_built, 4);
        assert_eq!(statistics.voxels_built, 700 * 150 * 40);
        // Six sections of three tiles of 3 x 2 sub-tiles. The border between blocks is decoded
        // by one of them, or by both if they are built at the same time.
        let decoded = statistics.sub_tiles_decoded;
        assert!(decoded <= 6 * 3 * (6 + 2), "{decoded} sub-tiles");
        assert!(decoded >= 6 * 3 * 4, "{decoded} sub-tiles");
        assert_eq!(statistics.tiles_indexed, 18);
    });
}

#[test]
fn nothing_is_decoded_where_nothing_is() {
    run(async {
        let mut fixture = Fixture::new(UVec3::new(600, 500, 9), DVec3::new(4.0, 4.0, 30.0)).await;
        let mut black = tile((300, 200), 2, (10.0, 20.0), 3.0, 1.0, 1);
        black.pixels.fill(0);
        fixture.put("black", black).await;
        let source = fixture.open().await;
        let got = read_all(&source).await;
        assert!(got.iter().flatten().all(|v| *v == 0));
        assert_eq!(source.statistics().sub_tiles_decoded, 0);
        let id = ChunkId {
            channel: 0,
            level: 0,
            chunk: UVec3::ZERO,
        };
        assert_eq!(source.read(id).await.unwrap(), Chunk::Empty);
    });
}

#[test]
fn memory_is_bounded() {
    run(async {
        let fixture = aligned().await;
        let limit = 12 << 20;
        let options = StitchedOptions {
            block_bytes: limit,
            sub_tile_bytes: 1 << 20,
            index_bytes: 1 << 16,
            builds: 2,
            ..StitchedOptions::default()
        };
        let source = fixture.open_with(options).await;
        let got = read_all(&source).await;
        assert!(source.statistics().block_bytes <= limit);
        let (coverage, most) = difference(&got, &fixture.expected());
        assert_eq!((coverage, most <= 1), (0, true));
    });
}

#[test]
fn values_are_within_their_bounds_and_known_after_reading() {
    run(async {
        let fixture = aligned().await;
        let source = fixture.open().await;
        let id = ChunkId {
            channel: 0,
            level: 0,
            chunk: UVec3::new(1, 1, 0),
        };
        assert_eq!(source.value_range(id), None);
        source.read(id).await.unwrap();
        let range = source.value_range(id).unwrap();
        assert_eq!((range.min, range.max), (1, 255), "of noise");
    });
}

#[test]
fn bounds_are_found_without_decoding() {
    run(async {
        let extent = UVec3::new(700, 300, 9);
        let mut fixture = Fixture::new(extent, DVec3::new(4.0, 4.0, 30.0)).await;
        for section in [0, 1, 2, 5] {
            let mut dim = tile((300, 260), section, (10.0, 20.0), 3.0, 1.0, 1);
            dim.pixels.iter_mut().for_each(|p| *p = 10 + *p % 50);
            fixture.put(&format!("dim{section}"), dim).await;
            let mut bright = tile((300, 260), section, (330.0, 8.0), -2.0, 1.0, 2);
            bright.pixels.iter_mut().for_each(|p| *p = 200 + *p % 40);
            fixture.put(&format!("bright{section}"), bright).await;
        }
        let source = fixture.open().await;
        let (volume, want) = (fixture.volume.clone(), fixture.expected());
        let (mut tight, mut nothing) = (0, 0);
        for level in 0..volume.levels.len() as u32 {
            let chunks = saccade_core::voxel_box::VoxelBox::of_size(volume.chunks(level as usize));
            for chunk in chunks.iter() {
                let id = ChunkId {
                    channel: 0,
                    level,
                    chunk,
                };
                let found = source.find_value_range(id).await.unwrap();
                let values = chunk_of(&volume, &want, id);
                let values = values.iter().filter(|v| **v != 0).map(|v| u16::from(*v));
                match (values.clone().min(), values.max()) {
                    (Some(min), Some(max)) => {
                        let found = found.unwrap();
                        assert!(found.min <= min && max <= found.max, "{id}: {found:?}");
                        tight += u32::from(found.max < 60 || found.min >= 200);
                    }
                    _ => nothing += u32::from(found.is_none()),
                }
            }
        }
        assert!(tight > 20, "{tight} chunks are of one tile");
        assert!(nothing > 0, "a chunk is known to be empty");
        let statistics = source.statistics();
        assert_eq!(
            (statistics.sub_tiles_decoded, statistics.blocks_built),
            (0, 0)
        );
    });
}

#[test]
fn cross_sections_are_cut_out_of_the_volume() {
    run(async {
        let fixture = aligned().await;
        let source = fixture.open().await;
        let whole = read_all(&source).await;
        for (level, z, min, size) in [
            (0, 1, (200, 30), (333, 77)),
            (0, 33, (0, 0), (700, 150)),
            (1, 2, (111, 5), (512, 512)),
            (3, 0, (0, 0), (40, 9)),
            (0, 3, (0, 0), (64, 64)),
            (0, 1, (700, 0), (64, 64)),
            (0, 40, (0, 0), (64, 64)),
        ] {
            let extent = fixture.volume.levels[level as usize].extent;
            let (min, size) = (UVec2::from(min), UVec2::from(size));
            let got = source.cross_section(0, level, z, min, size).await.unwrap();
            let end = (min + size).min(extent.truncate());
            let rows = (min.y..end.y).flat_map(|y| (min.x..end.x).map(move |x| (x, y)));
            let inside = rows.filter(|_| z < extent.z).map(|(x, y)| {
                let at = (z as usize * extent.y as usize + y as usize) * extent.x as usize;
                whole[level as usize][at + x as usize]
            });
            let want: Vec<u16> = inside.collect();
            match got {
                Some(got) => {
                    assert_eq!(got.size, end - min);
                    assert_eq!(
                        numbers(&fixture.volume, &got.values),
                        want,
                        "level {level}, z {z}"
                    );
                    assert!(want.iter().any(|v| *v != 0));
                }
                None => assert!(want.iter().all(|v| *v == 0), "level {level}, z {z}"),
            }
        }
    });
}

#[test]
fn what_has_one_value_is_not_decoded() {
    run(async {
        let mut fixture = Fixture::new(UVec3::new(600, 300, 3), DVec3::new(4.0, 4.0, 30.0)).await;
        let mut resin = tile((512, 256), 1, (20.5, 10.25), 0.0, 1.0, 3);
        for (at, pixel) in resin.pixels.iter_mut().enumerate() {
            if at % 512 >= 128 || at / 512 >= 128 {
                *pixel = 177;
            }
        }
        fixture.put("resin", resin).await;
        let source = fixture.open().await;
        let block = source
            .cross_section(0, 0, 1, UVec2::ZERO, UVec2::splat(600))
            .await;
        let (got, want) = (block.unwrap().unwrap().values, fixture.expected());
        let want = &want[0][600 * 300..2 * 600 * 300];
        let got = numbers(&fixture.volume, &got);
        assert!(got.iter().zip(want).all(|(a, b)| a.abs_diff(*b) <= 1));
        assert_eq!(source.statistics().sub_tiles_decoded, 1, "of eight");
    });
}

#[test]
fn unknown_volumes_are_told() {
    run(async {
        let fixture = aligned().await;
        let error = super::StitchedSource::open(&fixture.archive, "w", StitchedOptions::default());
        match error.await.map(|_| ()) {
            Err(SourceError::NoVolume { name, known }) => {
                assert_eq!((name.as_str(), known), ("w", vec!["v".to_owned()]));
            }
            other => panic!("{other:?}"),
        }
    });
}

#[test]
fn coarse_levels_look_at_few_sections_and_open_few_pyramids() {
    run(async {
        const SECTIONS: u32 = 96;
        let extent = UVec3::new(300, 200, SECTIONS);
        let mut fixture = Fixture::new(extent, DVec3::splat(4.0)).await;
        for section in 0..SECTIONS {
            // Two tiles that leave the right end of the volume free, so that no section covers all.
            for n in 0..2 {
                let corner = (f64::from(n) * 90.0, 0.0);
                let seed = u64::from(section * 2 + n);
                let tile = tile((100, 190), section, corner, 0.0, 1.0, seed);
                fixture.put(&format!("s{section}n{n}"), tile).await;
            }
        }
        let source = fixture.open().await;
        let volume = fixture.volume.clone();
        let coarsest = volume.levels.len() as u32 - 1;
        let span = volume.levels[coarsest as usize].downsampling.z as u32;
        assert!(span >= 16, "voxels span {span} sections");
        let id = ChunkId {
            channel: 0,
            level: coarsest,
            chunk: UVec3::ZERO,
        };
        let got = source.read(id).await.unwrap();
        let statistics = source.statistics();
        // Of 16 sections seven at most are looked at; tiles whose every sample is hidden by a nearer
        // section's are not opened.
        let slices = u64::from(volume.levels[coarsest as usize].extent.z);
        assert!(statistics.tiles_indexed <= slices * 7 * 2, "{statistics:?}");
        assert!(
            statistics.tiles_indexed < u64::from(SECTIONS * 2),
            "{statistics:?}"
        );
        assert!(statistics.pyramids_opened <= slices * 2, "{statistics:?}");
        let want = chunk_of(&volume, &fixture.expected(), id);
        let Chunk::Voxels(got) = got else {
            panic!("the chunk is empty");
        };
        assert!(got.iter().zip(&want).all(|(a, b)| a.abs_diff(*b) <= 1));
    });
}
