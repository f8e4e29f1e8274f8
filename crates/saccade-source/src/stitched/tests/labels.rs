//! Labels are never mixed: against brute force where tiles lie on whole voxels, and everywhere as a property.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use glam::{DVec3, UVec2, UVec3};
use proptest::prelude::*;
use saccade_archive::storage::MemoryStorage;
use saccade_core::volume::{Dtype, Volume, VoxelKind};

use super::fixture::{Fixture, Levels, bounds, chunk_of, noise, read_all, tile};
use super::oracle::RawTile;
use super::run;
use crate::conformance::check_reading;
use crate::stitched::{AlongZ, Gaps, Interpolation, Overlaps, StitchedOptions};

/// All that labels must not be done.
fn everything() -> StitchedOptions {
    StitchedOptions {
        interpolation: Some(Interpolation::Cubic),
        overlaps: Overlaps::Blend,
        along_z: AlongZ::Linear,
        gaps: Gaps::Linear(2),
        ..StitchedOptions::default()
    }
}

async fn empty(kind: VoxelKind, dtype: Dtype, extent: UVec3, nm: DVec3) -> Fixture {
    let mut volume = Volume::new("v", extent, nm).unwrap();
    (volume.kind, volume.dtype) = (kind, dtype);
    Fixture::of(Arc::new(MemoryStorage::new()), volume).await
}

/// Objects of some pixels each, with single pixels of others strewn in; 0 between them. `labels` are the numbers of
/// objects.
fn draw(tile: &mut RawTile, labels: &[u16], seed: u64) {
    let (w, h) = (tile.width, tile.height);
    let (cells, strewn) = (noise(w, h, seed), noise(w, h, seed ^ 0x55));
    for y in 0..h {
        for x in 0..w {
            let cell = cells[y / 13 * w + x / 17];
            let own = if strewn[y * w + x] < 40 {
                strewn[y * w + x]
            } else {
                cell
            };
            let label = labels.get(usize::from(own) % (labels.len() + 1));
            tile.pixels[y * w + x] = label.copied().unwrap_or(0);
        }
    }
}

/// The most frequent, of several the smallest; 0 of none.
fn mode(values: impl Iterator<Item = u16>) -> u16 {
    let mut votes = BTreeMap::<u16, u32>::new();
    values.for_each(|value| *votes.entry(value).or_default() += 1);
    let most = votes.values().copied().max();
    let winner = votes.iter().find(|(_, count)| Some(**count) == most);
    winner.map_or(0, |(label, _)| *label)
}

/// A tile as its pyramid shows it at level `k`: width, height, and labels.
fn shown(tile: &RawTile, k: u32) -> (usize, usize, Vec<u16>) {
    let f = 1 << k;
    let (w, h) = (tile.width.div_ceil(f), tile.height.div_ceil(f));
    let covered = |x: usize, y: usize| {
        let rows = y * f..((y + 1) * f).min(tile.height);
        let columns = x * f..((x + 1) * f).min(tile.width);
        rows.flat_map(move |y| {
            columns
                .clone()
                .map(move |x| tile.pixels[y * tile.width + x])
        })
    };
    let pixels = (0..h).flat_map(|y| (0..w).map(move |x| mode(covered(x, y))));
    (w, h, pixels.collect())
}

/// All voxels, of tiles of one size that lie on whole voxels, unturned.
fn expected(volume: &Volume, tiles: &BTreeMap<i64, RawTile>) -> Levels {
    let first = tiles.values().next().unwrap();
    let largest = first.width.max(first.height);
    let coarsest = (0..).find(|k| largest.div_ceil(1 << k) <= 128).unwrap();
    let sections: BTreeSet<u32> = tiles.values().map(|tile| tile.section).collect();
    let levels = volume.levels.iter().map(|level| {
        let down = level.downsampling;
        let wanted = down.x.log2() as u32;
        let k = wanted.min(coarsest);
        let by = 1_u32 << (wanted - k).min(4);
        let step = down.x / f64::from(by);
        let images: BTreeMap<_, _> = tiles.iter().map(|(id, t)| (*id, shown(t, k))).collect();
        // The label at a point of a section, if a tile is there.
        let seen = |section: u32, x: f64, y: f64| {
            let mut best: Option<(f64, u64, u16)> = None;
            for (id, tile) in tiles.iter().filter(|(_, tile)| tile.section == section) {
                let (u, v) = (x - tile.transform[4], y - tile.transform[5]);
                let (w, h) = (tile.width as f64, tile.height as f64);
                if u < 0.0 || v < 0.0 || u >= w || v >= h {
                    continue;
                }
                let off = (u - w / 2.0).powi(2) + (v - h / 2.0).powi(2);
                let (width, _, labels) = &images[id];
                let f = f64::from(1_u32 << k);
                let label = labels[(v / f) as usize * width + (u / f) as usize];
                if best
                    .is_none_or(|(least, age, _)| off < least || (off == least && tile.age > age))
                {
                    best = Some((off, tile.age, label));
                }
            }
            best.map(|(_, _, label)| label)
        };
        let mut voxels = Vec::new();
        for z in 0..level.extent.z {
            let (low, high) = (f64::from(z) * down.z, f64::from(z + 1) * down.z);
            let middle = |s: u32| f64::from(s) + 0.5;
            let off = |s: &u32| (middle(*s) - (low + high) / 2.0).abs();
            let mut near: Vec<u32> = sections.iter().copied().collect();
            near.retain(|s| (low..high).contains(&middle(*s)));
            near.sort_by(|a, b| off(a).partial_cmp(&off(b)).unwrap());
            // The first four, then the 8th, 16th and so on.
            let mut rank = 0_u32;
            near.retain(|_| {
                rank += 1;
                rank <= 4 || rank.count_ones() == 1
            });
            for (y, x) in (0..level.extent.y).flat_map(|y| (0..level.extent.x).map(move |x| (y, x)))
            {
                let point = |v: u32, n: u32| (f64::from(v * by + n) + 0.5) * step;
                let samples = (0..by * by).map(|n| (point(x, n % by), point(y, n / by)));
                let labels = samples.filter_map(|(x, y)| near.iter().find_map(|s| seen(*s, x, y)));
                voxels.push(mode(labels));
            }
        }
        voxels
    });
    levels.collect()
}

/// Tiles at odd places that overlap, of which one is empty and one nearly so, in some sections.
async fn aligned(kind: VoxelKind, dtype: Dtype) -> Fixture {
    let extent = UVec3::new(610, 330, 7);
    let mut fixture = empty(kind, dtype, extent, DVec3::new(4.0, 4.0, 9.0)).await;
    let labels: [u16; 4] = match dtype {
        Dtype::Uint16 => [3, 300, 40_000, 65_535],
        _ => [3, 90, 200, 255],
    };
    let mut n = 0;
    for section in [0, 1, 3, 4, 6] {
        for (x, y) in [
            (-7, 3),
            (181, 5),
            (371, -9),
            (1, 161),
            (190, 149),
            (377, 155),
        ] {
            n += 1;
            let corner = (f64::from(x), f64::from(y));
            let mut tile = tile((203, 171), section, corner, 0.0, 1.0, n);
            draw(&mut tile, &labels, n);
            match n % 6 {
                1 => tile.pixels.fill(0),
                // Two sub-tiles without an object, and a coarsest level nearly without.
                3 => {
                    let pixels = tile.pixels.iter_mut().enumerate();
                    let hidden = pixels.filter(|(at, _)| at % 203 < 130 || at % 5 > 1);
                    hidden.for_each(|(_, pixel)| *pixel = 0);
                }
                _ => {}
            }
            fixture.put(&format!("t{n}"), tile).await;
        }
    }
    fixture
}

/// Voxels that differ.
fn differing(a: &Levels, b: &Levels) -> usize {
    a.iter()
        .flatten()
        .zip(b.iter().flatten())
        .filter(|(a, b)| a != b)
        .count()
}

#[test]
fn every_level_is_exactly_what_the_tiles_have() {
    run(async {
        for dtype in [Dtype::Uint8, Dtype::Uint16] {
            let fixture = aligned(VoxelKind::Labels, dtype).await;
            let want = expected(&fixture.volume, &fixture.tiles);
            let coarse = fixture
                .volume
                .levels
                .iter()
                .filter(|l| l.downsampling.x > 2.0);
            assert!(
                coarse.count() >= 2,
                "levels coarser than the pyramids are compared"
            );
            for (options, gaps) in [(StitchedOptions::default(), false), (everything(), true)] {
                let got = read_all(&fixture.open_with(options).await).await;
                for (level, (got, want)) in got.iter().zip(&want).enumerate() {
                    let plane = fixture.volume.levels[level]
                        .extent
                        .truncate()
                        .element_product();
                    for (z, (got, want)) in got
                        .chunks(plane as usize)
                        .zip(want.chunks(plane as usize))
                        .enumerate()
                    {
                        // Sections 2 and 5 are filled from the first of their neighbours.
                        if !(gaps && level < 2 && [2, 5].contains(&z)) {
                            assert!(got == want, "{dtype:?}: section {z} of level {level}");
                        }
                    }
                }
                let section = |z: usize| &got[0][z * 610 * 330..(z + 1) * 610 * 330];
                assert_eq!(section(2) == section(1), gaps);
                assert_eq!(section(5) == section(4), gaps);
            }
            let source = fixture.open().await;
            let oracle = |id| chunk_of(&fixture.volume, &want, id);
            check_reading(&source, oracle, 0).await.unwrap();

            // What is compared would tell another pixel, place, winner of overlaps and of votes.
            let with = |change: &dyn Fn(&mut RawTile)| {
                let mut tiles = fixture.tiles.clone();
                change(tiles.values_mut().nth(1).unwrap());
                differing(&expected(&fixture.volume, &tiles), &want)
            };
            assert_eq!(with(&|_| ()), 0);
            assert!(with(&|tile| tile.pixels[90 * 203 + 90] ^= 1) > 0);
            assert!(with(&|tile| tile.transform[4] += 1.0) > 100);
            assert!(with(&|tile| tile.section = 6) > 100);
        }
    });
}

#[test]
fn shades_of_the_same_tiles_have_values_that_no_object_has() {
    run(async {
        for options in [
            StitchedOptions::default(),
            StitchedOptions {
                interpolation: Some(Interpolation::Nearest),
                ..StitchedOptions::default()
            },
        ] {
            let fixture = aligned(VoxelKind::Intensity, Dtype::Uint8).await;
            let known = labels_of(&fixture);
            let got = read_all(&fixture.open_with(options).await).await;
            let coarse = got[2..].iter().flatten();
            let (all, strange) = coarse.fold((0, 0), |(all, strange), value| {
                (all + 1, strange + usize::from(!known.contains(value)))
            });
            assert!(strange > all / 4, "{strange} of {all}");
        }
    });
}

fn labels_of(fixture: &Fixture) -> BTreeSet<u16> {
    let pixels = fixture.tiles.values().flat_map(|tile| &tile.pixels);
    pixels.copied().chain([0]).collect()
}

#[test]
fn whoever_asks_for_mixing_is_told() {
    use crate::stitched::build::Rules;
    let of = |kind, options: &StitchedOptions| Rules::refused(options, kind);
    assert_eq!(of(VoxelKind::Labels, &StitchedOptions::default()).len(), 0);
    assert_eq!(of(VoxelKind::Labels, &everything()).len(), 4);
    assert_eq!(of(VoxelKind::Intensity, &everything()).len(), 0);
    for (interpolation, told) in [
        (Interpolation::Nearest, 0),
        (Interpolation::Linear, 1),
        (Interpolation::Cubic, 1),
    ] {
        let options = StitchedOptions {
            interpolation: Some(interpolation),
            gaps: Gaps::Nearest(4),
            ..StitchedOptions::default()
        };
        assert_eq!(of(VoxelKind::Labels, &options).len(), told);
    }
}

/// A tile's size, corner, turn and scale.
type Lay = ((usize, usize), (f64, f64), f64, f64);

fn lays() -> impl Strategy<Value = Vec<Lay>> {
    let lay = (
        (40..330_usize, 40..300_usize),
        (-60.0..300.0, -60.0..200.0),
        prop_oneof![Just(0.0), Just(90.0), -4.0..4.0, -180.0..180.0],
        prop_oneof![Just(1.0), 0.4..2.5],
    );
    prop::collection::vec(lay, 1..9)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]
    /// However tiles lie, a voxel is 0 or has a label of a tile that is there.
    #[test]
    fn every_voxel_has_a_label_of_a_tile_that_is_there(
        lays in lays(), deep in any::<bool>(), mixing in any::<bool>(), seed in any::<u64>(),
    ) {
        run(async {
            let extent = UVec3::new(333, 241, 5);
            let nm = DVec3::new(4.0, 4.0, if seed % 2 == 0 { 4.0 } else { 11.0 });
            let dtype = if deep { Dtype::Uint16 } else { Dtype::Uint8 };
            let mut fixture = empty(VoxelKind::Labels, dtype, extent, nm).await;
            // Far apart: nothing between two labels of any tiles is one.
            let spread = if deep { 1_999 } else { 8 };
            for (n, (size, corner, degrees, scale)) in (0_u16..).zip(&lays) {
                let section = u32::from(n) % 4;
                let mut tile = tile(*size, section, *corner, *degrees, *scale, seed);
                draw(&mut tile, &[1, 2, 3].map(|label| (n * 3 + label) * spread), seed ^ u64::from(n));
                let (x0, y0, x1, y1) = bounds(&tile);
                if x1 > 0.0 && y1 > 0.0 && x0 < 333.0 && y0 < 241.0 {
                    fixture.put(&format!("t{n}"), tile).await;
                }
            }
            let options = if mixing { everything() } else { StitchedOptions::default() };
            let filled = if mixing { 2.0 } else { 0.0 };
            let got = read_all(&fixture.open_with(options).await).await;
            let owners: BTreeMap<u16, &RawTile> = { fixture.tiles.values() }
                .flat_map(|tile| tile.pixels.iter().map(move |label| (*label, tile)))
                .collect();
            let mut seen = 0;
            for (level, values) in fixture.volume.levels.iter().zip(&got) {
                let mut at = values.iter();
                for v in saccade_core::voxel_box::VoxelBox::of_size(level.extent).iter() {
                    let label = *at.next().unwrap();
                    if label == 0 {
                        continue;
                    }
                    seen += 1;
                    let tile = owners.get(&label);
                    prop_assert!(tile.is_some(), "{label} at {v} is no label of any tile");
                    let tile = tile.unwrap();
                    let (x0, y0, x1, y1) = bounds(tile);
                    let low = v.as_dvec3() * level.downsampling;
                    let high = (v + 1).as_dvec3() * level.downsampling;
                    let z = f64::from(tile.section) + 0.5;
                    let there = high.x >= x0 && high.y >= y0 && low.x <= x1 && low.y <= y1
                        && high.z + filled >= z && low.z - filled <= z;
                    prop_assert!(there, "{label} at {v} is far from its tile");
                }
            }
            let covers = |tile: &RawTile| UVec2::new(tile.width as u32, tile.height as u32);
            let any = fixture.tiles.values().any(|tile| {
                let (x0, y0, x1, y1) = bounds(tile);
                covers(tile).min_element() > 60 && x0 > 0.0 && y0 > 0.0 && x1 < 333.0 && y1 < 241.0
            });
            prop_assert!(!any || seen > 100, "{} voxels", seen);
            Ok(())
        })?;
    }
}
