//! What can be chosen, and volumes of several channels, magnifications and 16 bits: against brute force,
//! which must not agree with any other choice.

use std::sync::Arc;

use glam::{DVec3, UVec2, UVec3};
use saccade_archive::storage::MemoryStorage;
use saccade_core::volume::{Dtype, Volume};
use saccade_core::voxel_box::VoxelBox;

use super::fixture::{
    Fixture, Levels, chunk_of, difference, expected_as, read_all, read_channel, tile,
};
use super::oracle::{Between, How, RawTile};
use super::run;
use crate::stitched::{AlongZ, Interpolation, Overlaps, StitchedOptions};
use crate::{ChunkId, VolumeSource};

/// Neighbours that overlap, turned a little, in sections of which one has none and one has holes.
async fn overlapping() -> Fixture {
    let mut fixture = Fixture::new(UVec3::new(420, 230, 13), DVec3::new(4.0, 4.0, 12.0)).await;
    for section in [0, 1, 2, 4, 5, 6, 8, 11, 12] {
        for n in 0..4 {
            if section == 4 && n == 1 {
                continue;
            }
            let corner = (
                f64::from(n % 2) * 190.0 - 13.0,
                f64::from(n / 2) * 95.0 - 8.0,
            );
            let seed = u64::from(section * 4 + n);
            let degrees = f64::from(n) * 1.5 - 2.0;
            let tile = tile((260, 150), section, corner, degrees, 1.0, seed);
            fixture.put(&format!("s{section}n{n}"), tile).await;
        }
    }
    fixture
}

#[test]
fn every_choice_equals_brute_force_and_no_other() {
    run(async {
        let fixture = overlapping().await;
        let plain = How::PLAIN;
        let choices = [
            (StitchedOptions::default(), plain),
            (
                StitchedOptions {
                    interpolation: Some(Interpolation::Nearest),
                    ..StitchedOptions::default()
                },
                How {
                    between: Between::Box,
                    ..plain
                },
            ),
            (
                StitchedOptions {
                    interpolation: Some(Interpolation::Cubic),
                    ..StitchedOptions::default()
                },
                How {
                    between: Between::Keys,
                    ..plain
                },
            ),
            (
                StitchedOptions {
                    overlaps: Overlaps::Blend,
                    ..StitchedOptions::default()
                },
                How {
                    blend: true,
                    ..plain
                },
            ),
            (
                StitchedOptions {
                    along_z: AlongZ::Linear,
                    ..StitchedOptions::default()
                },
                How {
                    along_z: true,
                    ..plain
                },
            ),
            (
                StitchedOptions {
                    interpolation: Some(Interpolation::Cubic),
                    overlaps: Overlaps::Blend,
                    along_z: AlongZ::Linear,
                    ..StitchedOptions::default()
                },
                How {
                    between: Between::Keys,
                    blend: true,
                    along_z: true,
                    ..plain
                },
            ),
        ];
        let wanted = { choices.each_ref() }
            .map(|(_, how)| expected_as(&fixture.volume, &fixture.tiles, *how));
        for (n, (options, how)) in choices.into_iter().enumerate() {
            let got = read_all(&fixture.open_with(options.clone()).await).await;
            for (other, want) in wanted.iter().enumerate() {
                let (coverage, most) = difference(&got, want);
                if n == other {
                    // Means are of rounded samples, of rounded pixels.
                    let off = if how.blend && how.along_z { 2 } else { 1 };
                    assert_eq!(coverage, 0, "{how:?}");
                    assert!(most <= off, "{how:?}: {most}");
                } else {
                    assert!(most > 5, "{how:?} is like choice {other}: {most}");
                }
            }
        }
    });
}

/// Bounds are asked for before anything is built; how many are close, and how many there are.
async fn check_ranges(fixture: &Fixture, options: StitchedOptions, got: &Levels) -> (u32, u32) {
    let (volume, unread) = (&fixture.volume, fixture.open_with(options).await);
    let (mut tight, mut all) = (0, 0);
    for level in 0..volume.levels.len() as u32 {
        let chunks = volume.chunks(level as usize);
        for chunk in VoxelBox::of_size(chunks).iter() {
            let id = ChunkId {
                channel: 0,
                level,
                chunk,
            };
            let found = unread.find_value_range(id).await.unwrap();
            let values = chunk_of(volume, got, id);
            let values = values.into_iter().filter(|v| *v != 0).map(u16::from);
            for value in values {
                let found = found.unwrap();
                assert!(found.min <= value && value <= found.max, "{id} {found:?}");
            }
            all += 1;
            tight += u32::from(found.is_none_or(|r| r.max - r.min < 150));
        }
    }
    (tight, all)
}

#[test]
fn bounds_hold_for_every_choice() {
    run(async {
        let mut fixture = Fixture::new(UVec3::new(420, 230, 8), DVec3::new(4.0, 4.0, 12.0)).await;
        for n in 0..6_u32 {
            let corner = (f64::from(n % 2) * 170.0 + 3.0, 5.0);
            let mut tile = tile((260, 220), n / 2 * 3, corner, 1.0, 1.0, n.into());
            // Steep steps, a blank sub-tile, and parts of few values.
            for (at, pixel) in tile.pixels.iter_mut().enumerate() {
                let (x, y) = (at % 260, at / 260);
                *pixel = match (x / 128, y / 128) {
                    (0, 0) if n == 1 => 0,
                    (0, _) => 60 + 100 * u16::from(*pixel > 127),
                    _ => 200 + *pixel % 7,
                };
            }
            fixture.put(&format!("t{n}"), tile).await;
        }
        let volume = fixture.volume.clone();
        for (interpolation, between) in [
            (Interpolation::Linear, Between::Tent),
            (Interpolation::Cubic, Between::Keys),
        ] {
            for overlaps in [Overlaps::NearestCentre, Overlaps::Blend] {
                let options = StitchedOptions {
                    interpolation: Some(interpolation),
                    overlaps,
                    along_z: AlongZ::Linear,
                    ..StitchedOptions::default()
                };
                let source = fixture.open_with(options.clone()).await;
                let got = read_all(&source).await;
                let how = How {
                    between,
                    blend: overlaps == Overlaps::Blend,
                    along_z: true,
                    ..How::PLAIN
                };
                let want = expected_as(&volume, &fixture.tiles, how);
                let (coverage, most) = difference(&got, &want);
                assert!(coverage == 0 && most <= 1, "{options:?}: {most}");
                let (tight, all) = check_ranges(&fixture, options, &got).await;
                assert!(tight > 0 && all > tight, "{tight} of {all}");
            }
        }
    });
}

/// Several workers enter tiles in the order in which they get ready.
#[test]
fn what_is_seen_does_not_depend_on_who_came_first() {
    run(async {
        const TILES: usize = 5;
        let blend = StitchedOptions {
            overlaps: Overlaps::Blend,
            ..StitchedOptions::default()
        };
        let choices = [StitchedOptions::default(), blend];
        let mut seen: Vec<Vec<_>> = vec![Vec::new(); choices.len()];
        for turn in 0..TILES {
            let mut fixture =
                Fixture::new(UVec3::new(150, 140, 2), DVec3::new(4.0, 4.0, 9.0)).await;
            for n in (0..TILES).map(|n| (n + turn) % TILES) {
                // All about one centre: none is nearer.
                let tile = tile((131, 121), 1, (7.0, 3.0), 0.0, 1.0, n as u64 + 1);
                // Before all moves.
                fixture.put_at(&format!("t{n}"), tile, n as u64).await;
            }
            for (options, seen) in choices.iter().zip(&mut seen) {
                let levels = read_all(&fixture.open_with(options.clone()).await).await;
                seen.push(levels);
            }
            // Nor on who was moved, and back.
            let at = fixture.tiles.values().next().unwrap().transform;
            let mut away = at;
            away[4] += 40.0;
            for (name, hides) in [("t1", false), ("t4", true)] {
                fixture.transform(name, away).await;
                let moved = read_all(&fixture.open().await).await;
                assert!(
                    !hides || moved != seen[0][turn],
                    "{name} has hidden nothing"
                );
                fixture.transform(name, at).await;
            }
            let back = read_all(&fixture.open().await).await;
            assert!(back == seen[0][turn], "{turn}");
            let (coverage, most) = difference(&back, &fixture.expected());
            assert!(coverage == 0 && most <= 1, "{turn}: {coverage} {most}");
        }
        for seen in &seen {
            assert!(seen.iter().all(|levels| *levels == seen[0]));
        }
        assert!(seen[0][0] != seen[1][0], "blended");
    });
}

/// An image that was turned is black beside what was imaged, at its finest level in whole squares.
#[test]
fn what_is_seen_through_holes_is_seen_at_every_level() {
    run(async {
        const EDGE: usize = 700;
        let mut fixture = Fixture::new(UVec3::new(740, 720, 2), DVec3::new(4.0, 4.0, 9.0)).await;
        let mut overview = tile((190, 190), 0, (0.0, 0.0), 0.0, 1.0, 1);
        overview.pixels.fill(200);
        overview.transform = [4.0, 0.0, 0.0, 4.0, -3.0, -2.0];
        let mut region = tile((EDGE, EDGE), 0, (10.0, 6.0), 0.0, 1.0, 2);
        let mut fill = |column: usize, row: usize, value: u16| {
            for y in row * 128..((row + 1) * 128).min(EDGE) {
                region.pixels[y * EDGE..][column * 128..((column + 1) * 128).min(EDGE)].fill(value);
            }
        };
        for hole in [(1, 1), (2, 3), (5, 5)] {
            fill(hole.0, hole.1, 0);
        }
        // Dark, and no hole: at coarse levels it is rounded to 0.
        fill(4, 1, 0);
        for pixel in [(600, 200), (530, 140)] {
            region.pixels[pixel.1 * EDGE + pixel.0] = 1;
        }
        fixture.put("overview", overview).await;
        fixture.put("region", region).await;
        for overlaps in [Overlaps::NearestCentre, Overlaps::Blend] {
            let options = StitchedOptions {
                overlaps,
                ..StitchedOptions::default()
            };
            let got = read_all(&fixture.open_with(options.clone()).await).await;
            let how = How {
                blend: overlaps == Overlaps::Blend,
                ..How::PLAIN
            };
            let want = expected_as(&fixture.volume, &fixture.tiles, how);
            let (coverage, most) = difference(&got, &want);
            assert!(coverage == 0 && most <= 1, "{coverage} {most}");
            let mut looked_at = 0;
            for (level, voxels) in fixture.volume.levels.iter().zip(&got) {
                let at = |x: f64, y: f64| {
                    let voxel = (DVec3::new(x, y, 0.5) / level.downsampling).as_usizevec3();
                    let extent = level.extent.as_usizevec3();
                    voxels[voxel.y * extent.x + voxel.x]
                };
                // Where a voxel lies within the hole, with its neighbours.
                if level.downsampling.x <= 16.0 {
                    assert_eq!(at(10.0 + 192.0, 6.0 + 192.0), 200, "level {level:?}");
                    assert_eq!(at(10.0 + 320.0, 6.0 + 448.0), 200, "level {level:?}");
                    assert_eq!(at(10.0 + 576.0, 6.0 + 192.0), 1, "level {level:?}");
                    looked_at += 1;
                }
            }
            assert!(looked_at > 2, "{looked_at} levels");
            check_ranges(&fixture, options, &got).await;
        }
        // Without its holes it is another picture, also at coarse levels.
        let mut tiles = fixture.tiles.clone();
        let region = tiles.values_mut().find(|tile| tile.width == EDGE).unwrap();
        region
            .pixels
            .iter_mut()
            .for_each(|value| *value = (*value).max(1));
        let other = super::fixture::expected(&fixture.volume, &tiles);
        let want = fixture.expected();
        for (want, other) in want.iter().zip(other).skip(1).take(3) {
            assert!(want.iter().zip(&other).any(|(a, b)| a.abs_diff(*b) > 100));
        }
    });
}

/// An overview of three times larger pixels under two overlapping regions; beside them what is nearly as
/// large.
async fn magnified() -> Fixture {
    let mut fixture = Fixture::new(UVec3::new(450, 380, 3), DVec3::new(4.0, 4.0, 9.0)).await;
    for section in 0..3 {
        let seed = u64::from(section) * 10;
        let overview = tile((150, 130), section, (140.0, 110.0), 4.0, 3.0, seed);
        // Its centre is far from the overview's: by centres alone it would lose.
        let region = tile((140, 130), section, (250.0, 200.0), -3.0, 1.0, seed + 1);
        let other = tile((140, 130), section, (330.0, 190.0), 2.0, 1.2, seed + 2);
        fixture.put(&format!("overview{section}"), overview).await;
        fixture.put(&format!("region{section}"), region).await;
        if section != 1 {
            fixture.put(&format!("other{section}"), other).await;
        }
    }
    fixture
}

#[test]
fn finer_tiles_are_seen_where_there_are_such() {
    run(async {
        let fixture = magnified().await;
        let want = fixture.expected();
        for overlaps in [Overlaps::NearestCentre, Overlaps::Blend] {
            let options = StitchedOptions {
                overlaps,
                ..StitchedOptions::default()
            };
            let source = fixture.open_with(options.clone()).await;
            let got = read_all(&source).await;
            let how = How {
                blend: overlaps == Overlaps::Blend,
                ..How::PLAIN
            };
            let want = expected_as(&fixture.volume, &fixture.tiles, how);
            let (coverage, most) = difference(&got, &want);
            assert_eq!(coverage, 0);
            assert!(most <= 1, "{most}");
        }
        // Without the rule, or with pixels that are alike, it would be another picture.
        let of = |change: &dyn Fn(&mut RawTile)| {
            let mut tiles = fixture.tiles.clone();
            tiles.values_mut().for_each(change);
            let other = super::fixture::expected(&fixture.volume, &tiles);
            difference(&want, &other)
        };
        assert_eq!(of(&|_| ()), (0, 0));
        let removed = of(&|tile| {
            if tile.transform[0] < 1.5 {
                tile.section = 2;
            }
        });
        assert!(removed.1 > 50, "regions are seen: {removed:?}");
    });
}

#[test]
fn what_a_finer_tile_hides_is_outside_the_bounds() {
    run(async {
        let mut fixture = Fixture::new(UVec3::new(256, 256, 1), DVec3::new(4.0, 4.0, 40.0)).await;
        let mut overview = tile((100, 100), 0, (78.0, 78.0), 0.0, 3.0, 1);
        overview.pixels.fill(250);
        let mut region = tile((128, 128), 0, (0.0, 0.0), 0.0, 1.0, 2);
        region.pixels.iter_mut().for_each(|p| *p = 20 + *p % 9);
        fixture.put("overview", overview).await;
        fixture.put("region", region).await;
        let source = fixture.open().await;
        let range = async |x| {
            let id = ChunkId {
                channel: 0,
                level: 0,
                chunk: UVec3::new(x, 0, 0),
            };
            source.find_value_range(id).await.unwrap().unwrap()
        };
        assert!(range(0).await.max < 30, "{:?}", range(0).await);
        assert_eq!(range(3).await.max, 250);
    });
}

#[test]
fn channels_show_their_own_tiles() {
    run(async {
        let mut volume =
            Volume::new("v", UVec3::new(300, 200, 9), DVec3::new(4.0, 4.0, 16.0)).unwrap();
        volume.channels = vec!["nuclei".into(), "membranes".into(), "nothing".into()];
        let mut fixture = Fixture::of(Arc::new(MemoryStorage::new()), volume).await;
        for section in [0, 1, 4, 7, 8] {
            for channel in 0..2_u32 {
                // The second channel misses a section.
                if (section, channel) == (4, 1) {
                    continue;
                }
                let corner = (f64::from(channel) * 21.0 - 9.0, 4.0);
                let seed = u64::from(section * 2 + channel);
                let mut tile = tile((280, 190), section, corner, 2.0, 1.0, seed);
                tile.channel = channel;
                fixture.put(&format!("s{section}c{channel}"), tile).await;
            }
        }
        let source = fixture.open().await;
        let how = |channel| How {
            channel,
            ..How::PLAIN
        };
        let want = [0, 1, 2].map(|c| expected_as(&fixture.volume, &fixture.tiles, how(c)));
        for channel in 0..3 {
            let got = read_channel(&source, channel).await;
            for (other, want) in (0..).zip(&want) {
                let (coverage, most) = difference(&got, want);
                assert_eq!(
                    other == channel,
                    coverage == 0 && most <= 1,
                    "{coverage} {most}"
                );
            }
        }
        assert!(want[2].iter().flatten().all(|v| *v == 0));
        let plane = source.cross_section(1, 0, 0, UVec2::ZERO, UVec2::new(300, 200));
        let plane = plane.await.unwrap().unwrap().values;
        let want = &want[1][0][..300 * 200];
        assert!({ plane.iter().zip(want) }.all(|(a, b)| u16::from(*a).abs_diff(*b) <= 1));
    });
}

#[test]
fn sixteen_bits_are_exact() {
    run(async {
        let extent = UVec3::new(330, 200, 9);
        let mut volume = Volume::new("v", extent, DVec3::new(4.0, 4.0, 16.0)).unwrap();
        volume.dtype = Dtype::Uint16;
        let mut fixture = Fixture::of(Arc::new(MemoryStorage::new()), volume).await;
        for section in [0, 1, 2, 3, 5, 8] {
            for n in 0..2_u32 {
                let corner = (f64::from(n) * 140.0 - 9.3, 4.0);
                let seed = u64::from(section * 2 + n);
                let mut tile = tile((190, 180), section, corner, 2.0 * f64::from(n), 1.0, seed);
                let fine = super::noise(190, 180, seed + 99);
                for (pixel, fine) in tile.pixels.iter_mut().zip(fine) {
                    *pixel = (*pixel << 8) | u16::from(fine);
                }
                fixture.put(&format!("s{section}n{n}"), tile).await;
            }
        }
        for (interpolation, between) in [
            (Interpolation::Nearest, Between::Box),
            (Interpolation::Linear, Between::Tent),
            (Interpolation::Cubic, Between::Keys),
        ] {
            let options = StitchedOptions {
                interpolation: Some(interpolation),
                overlaps: Overlaps::Blend,
                along_z: AlongZ::Linear,
                ..StitchedOptions::default()
            };
            let mut how = How {
                between,
                most: u16::MAX,
                ..How::PLAIN
            };
            for options in [
                StitchedOptions {
                    interpolation: Some(interpolation),
                    ..Default::default()
                },
                options,
            ] {
                let source = fixture.open_with(options.clone()).await;
                let got = read_all(&source).await;
                let want = expected_as(&fixture.volume, &fixture.tiles, how);
                let (coverage, most) = difference(&got, &want);
                assert_eq!(coverage, 0, "{options:?}");
                // Means are of rounded samples, of rounded pixels.
                let off = if how.along_z { 2 } else { 1 };
                assert!(most <= off, "{options:?}: {most}");
                (how.blend, how.along_z) = (true, true);
                check_bytes(&source, &fixture, &got).await;
            }
        }
    });
}

/// The bytes are little-endian, and ranges those of the values.
async fn check_bytes(source: &crate::stitched::StitchedSource, fixture: &Fixture, levels: &Levels) {
    let id = ChunkId {
        channel: 0,
        level: 0,
        chunk: UVec3::new(1, 1, 0),
    };
    let crate::Chunk::Voxels(bytes) = source.read(id).await.unwrap() else {
        panic!("the chunk is empty");
    };
    assert_eq!(
        bytes.len(),
        fixture.volume.chunk.element_product() as usize * 2
    );
    let values = super::fixture::numbers(&fixture.volume, &bytes);
    let measured = || values.iter().filter(|v| **v != 0);
    let range = source.value_range(id).unwrap();
    assert_eq!(Some(&range.min), measured().min());
    assert_eq!(Some(&range.max), measured().max());
    assert!(range.max > 60_000);
    assert_eq!(bytes[..], chunk_of(&fixture.volume, levels, id));
}
