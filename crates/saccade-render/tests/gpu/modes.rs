//! Ways to draw, and what is cut away.

use std::collections::HashSet;
use std::sync::Arc;

use glam::{DVec3, UVec2, UVec3};
use saccade_core::brick::{BRICK_BORDER, BRICK_EDGE, BRICK_STORED_EDGE, BrickId};
use saccade_core::camera::Camera;
use saccade_core::space::Point;
use saccade_core::transfer::{ColorMap, linear_from_srgb};
use saccade_core::volume::{Polarity, Volume, VoxelKind};
use saccade_core::voxel_box::VoxelBox;
use saccade_render::{
    BrickVoxels, Clip, Gpu, HalfSpace, Heat, Image, Mode, Renderer, RendererOptions, Slab,
    Statistics, Traversal, View, Work,
};

use crate::harness::{caught_up, frame, gpu, keep, psnr, read, settle};
use crate::oracle::{self, Cut};
use crate::scene::{Scene, ramp, specks, stained, tissue, waves};

const SIZE: UVec2 = UVec2::new(72, 56);

fn picture(gpu: &Gpu, scene: &Scene, view: &View, traversal: Traversal) -> Image {
    let options = RendererOptions {
        traversal,
        ..RendererOptions::default()
    };
    let mut renderer = Renderer::new(gpu, scene.volume.clone(), options).unwrap();
    renderer.set_channels(&scene.views()).unwrap();
    settle(&mut renderer, view, scene);
    read(&renderer)
}

fn compare(gpu: &Gpu, name: &str, scene: &Scene, view: &View, least: f64) {
    let want = oracle::render(scene, view, Cut::HalfVoxels);
    keep(&format!("{name}-oracle"), &want);
    for traversal in [Traversal::ResidencyOctree, Traversal::PageTables] {
        let got = picture(gpu, scene, view, traversal);
        keep(&format!("{name}-{traversal:?}"), &got);
        let db = psnr(&got, &want);
        assert!(db >= least, "{name}, {traversal:?}: {db:.1} dB");
    }
}

fn views(scene: &Scene) -> [View; 2] {
    let around = Camera::around(&scene.volume);
    [around.zoomed(1.4), around.zoomed(5.0)].map(|camera| View {
        background: [0.1, 0.2, 0.4],
        ..View::new(camera, SIZE)
    })
}

#[test]
fn the_largest_value_is_drawn() {
    let Some(gpu) = gpu() else { return };
    for (name, scene) in [
        ("waves", waves()),
        ("tissue", tissue()),
        ("stained", stained()),
    ] {
        for (which, view) in views(&scene).into_iter().enumerate() {
            let view = View {
                mode: Mode::Maximum,
                ..view
            };
            compare(
                &gpu,
                &format!("maximum-{name}-{which}"),
                &scene,
                &view,
                45.0,
            );
        }
    }
}

/// How many colours a plane across two objects has, numbers 10 and 200 times a factor, besides the background.
fn colors_of_two(gpu: &Gpu, kind: VoxelKind, factor: u16, split_16_bit: bool) -> usize {
    let value = |nm: DVec3| if nm.x < 50.0 { 10.0 } else { 200.0 };
    let transfer = ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 1.0)], 100.0);
    let mut scene = Scene::new(UVec3::splat(40), DVec3::splat(2.5), transfer, value);
    if factor > 1 {
        scene = scene.deep(factor);
    }
    scene.volume = Arc::new(Volume {
        kind,
        ..(*scene.volume).clone()
    });
    let slab = Slab {
        point: Point::new(DVec3::splat(51.0)),
        normal: DVec3::Z,
        thickness_nm: 0.0,
    };
    let view = View {
        mode: Mode::Maximum,
        lod_bias: -20.0,
        clip: Clip {
            slab: Some(slab),
            ..Clip::default()
        },
        ..views(&scene)[0]
    };
    let options = RendererOptions {
        split_16_bit,
        ..RendererOptions::default()
    };
    let mut renderer = Renderer::new(gpu, scene.volume.clone(), options).unwrap();
    renderer.set_channels(&scene.views()).unwrap();
    settle(&mut renderer, &view, &scene);
    let pixels = read(&renderer).rgba;
    let colors: HashSet<_> = pixels.chunks_exact(4).collect();
    assert!(colors.contains(&pixels[..4]), "the background is seen");
    colors.len() - 1
}

#[test]
fn between_two_labels_there_is_no_third() {
    let Some(gpu) = gpu() else { return };
    for (factor, split) in [(1, false), (7, false), (7, true), (256, true)] {
        let colors = |kind| colors_of_two(&gpu, kind, factor, split);
        let case = format!("factor {factor}, in two parts: {split}");
        assert_eq!(colors(VoxelKind::Labels), 2, "{case}");
        assert!(colors(VoxelKind::Intensity) > 2, "shades are mixed, {case}");
    }
}

#[test]
fn surfaces_are_where_values_pass() {
    let Some(gpu) = gpu() else { return };
    let mut waves = waves();
    waves.iso = 150.0;
    let mut tissue = tissue();
    tissue.iso = 90.0;
    let mut stained = stained();
    stained.iso = 160.0;
    for (name, scene) in [("waves", waves), ("tissue", tissue), ("stained", stained)] {
        for (which, view) in views(&scene).into_iter().enumerate() {
            let view = View {
                mode: Mode::IsoSurface,
                ..view
            };
            // At edges a hair's breadth decides between a surface and the background.
            compare(
                &gpu,
                &format!("surface-{name}-{which}"),
                &scene,
                &view,
                30.0,
            );
        }
    }
}

/// Of values that are nearly black, and of matter that is cut through.
#[test]
fn surfaces_of_low_values_and_cuts_are_lit() {
    let Some(gpu) = gpu() else { return };
    for (name, mut scene) in [("waves", waves()), ("stained", stained())] {
        scene.iso = 4.0;
        let [view, _] = views(&scene);
        for (which, clip) in clips(&scene) {
            let view = View {
                mode: Mode::IsoSurface,
                clip,
                ..view
            };
            let name = format!("low-surface-{name}-{which}");
            compare(&gpu, &name, &scene, &view, 30.0);
        }
    }
}

#[test]
fn surfaces_move_with_their_value() {
    let Some(gpu) = gpu() else { return };
    let mut scene = waves();
    let [view, _] = views(&scene);
    let view = View {
        mode: Mode::IsoSurface,
        ..view
    };
    scene.iso = 150.0;
    let got = picture(&gpu, &scene, &view, Traversal::ResidencyOctree);
    let mut off = |iso| {
        scene.iso = iso;
        psnr(&got, &oracle::render(&scene, &view, Cut::HalfVoxels))
    };
    let there = off(150.0);
    for iso in [144.0, 156.0] {
        let db = off(iso);
        assert!(
            db < there - 6.0,
            "at {iso} it looks the same: {db:.1} of {there:.1} dB"
        );
    }
}

fn clips(scene: &Scene) -> Vec<(&'static str, Clip)> {
    let size = scene.volume.size_nm();
    let at = |share: DVec3| Point::new(size * share);
    let corner = [at(DVec3::new(0.9, 0.2, 0.8)), at(DVec3::new(0.3, 0.7, 0.1))];
    let half = |point, normal| {
        Some(HalfSpace {
            point: at(point),
            normal,
        })
    };
    let middle = DVec3::splat(0.5);
    vec![
        (
            "box",
            Clip {
                within: Some(corner),
                ..Clip::default()
            },
        ),
        (
            "planes",
            Clip {
                half_spaces: [
                    half(middle, DVec3::new(-0.3, 0.1, -2.0)),
                    half(middle, DVec3::X),
                    None,
                    half(DVec3::ZERO, DVec3::ZERO),
                ],
                ..Clip::default()
            },
        ),
        (
            "slab",
            Clip {
                slab: Some(Slab {
                    point: at(middle),
                    normal: DVec3::new(0.2, 0.3, 1.0),
                    thickness_nm: 90.0,
                }),
                ..Clip::default()
            },
        ),
    ]
}

#[test]
fn what_is_clipped_is_not_there() {
    let Some(gpu) = gpu() else { return };
    let scene = waves();
    for mode in [Mode::EmissionAbsorption, Mode::Maximum] {
        let [view, _] = views(&scene);
        let view = View { mode, ..view };
        let whole = oracle::render(&scene, &view, Cut::HalfVoxels);
        for (name, clip) in clips(&scene) {
            let view = View { clip, ..view };
            compare(&gpu, &format!("clip-{name}-{mode:?}"), &scene, &view, 40.0);
            let db = psnr(&whole, &oracle::render(&scene, &view, Cut::HalfVoxels));
            assert!(db < 30.0, "{name} takes nothing away: {db:.1} dB");
        }
    }
}

/// A slice shows what voxels are on it, whatever is before and behind.
#[test]
fn a_slice_has_one_sample_a_ray() {
    let Some(gpu) = gpu() else { return };
    let scene = tissue();
    let size = scene.volume.size_nm();
    for (name, normal) in [("axis", DVec3::Z), ("oblique", DVec3::new(0.4, 0.2, 1.0))] {
        let slab = Slab {
            point: Point::new(size / 2.0),
            normal,
            thickness_nm: 0.0,
        };
        let [view, _] = views(&scene);
        let view = View {
            mode: Mode::Maximum,
            clip: Clip {
                slab: Some(slab),
                ..Clip::default()
            },
            ..view
        };
        // The oracle draws no ray of no length.
        let thin = View {
            clip: Clip {
                slab: Some(Slab {
                    thickness_nm: 1e-3,
                    ..slab
                }),
                ..Clip::default()
            },
            ..view
        };
        let options = RendererOptions {
            traversal: Traversal::PageTables,
            ..RendererOptions::default()
        };
        let mut renderer = Renderer::new(&gpu, scene.volume.clone(), options).unwrap();
        renderer.set_channels(&scene.views()).unwrap();
        let reports = settle(&mut renderer, &view, &scene);
        let statistics = reports.last().unwrap().statistics;
        assert!(
            statistics.samples <= u64::from(statistics.rays),
            "{statistics:?}"
        );
        assert!(
            statistics.samples > u64::from(SIZE.element_product() / 8),
            "{statistics:?}"
        );
        let got = read(&renderer);
        keep(&format!("slice-{name}"), &got);
        let db = psnr(&got, &oracle::render(&scene, &thin, Cut::HalfVoxels));
        assert!(db >= 38.0, "{name}: {db:.1} dB");
    }
}

/// Seen as a whole, a large volume is so far away that f32 has but few depths there.
#[test]
fn slices_of_large_volumes_are_seen() {
    let Some(gpu) = gpu() else { return };
    let transfer = ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 1.0)], 100.0);
    for (extent, voxel_nm) in [
        // 86 um wide.
        (
            UVec3::new(21_500, 21_500, 2_150),
            DVec3::new(4.0, 4.0, 40.0),
        ),
        (
            UVec3::new(2_000_000, 2_000_000, 250_000),
            DVec3::new(5.0, 5.0, 40.0),
        ),
    ] {
        let volume = Arc::new(Volume::new("v", extent, voxel_nm).unwrap());
        let size = volume.size_nm();
        let value = |nm: DVec3| {
            let share = (nm / size).clamp(DVec3::ZERO, DVec3::ONE);
            30.0 + 100.0 * share.x + 100.0 * share.z
        };
        let options = RendererOptions {
            memory_bytes: 64 << 20,
            ..RendererOptions::default()
        };
        let mut renderer = Renderer::new(&gpu, volume.clone(), options).unwrap();
        renderer.set_transfer_function(&transfer);
        for (normal, at) in [
            (DVec3::Z, 0.3),
            (DVec3::Z, 0.8),
            (DVec3::X, 0.5),
            (DVec3::new(0.4, 0.2, 1.0), 0.5),
        ] {
            let point = size * at;
            let view = View {
                mode: Mode::Maximum,
                clip: Clip {
                    slab: Some(Slab {
                        point: Point::new(point),
                        normal,
                        thickness_nm: 0.0,
                    }),
                    ..Clip::default()
                },
                ..View::new(Camera::around(&volume), SIZE)
            };
            let mut report = frame(&mut renderer, &view);
            for _ in 0..40 {
                for id in &report.misses {
                    let voxels = brick_of(&volume, *id, value);
                    let voxels = BrickVoxels::Voxels(&voxels);
                    renderer.deliver(*id, voxels).unwrap();
                }
                if report.is_complete() {
                    break;
                }
                report = frame(&mut renderer, &view);
            }
            let case = format!("{extent}, {normal} at {at}");
            let statistics = report.statistics;
            assert!(report.is_complete(), "{case}");
            assert!(
                statistics.rays > SIZE.element_product() / 16,
                "{case}: {statistics:?}"
            );
            assert!(
                statistics.samples > 0,
                "no ray took a sample, {case}: {statistics:?}"
            );
            // Where the plane is inside of the volume and not near its end, the picture says what is there.
            let picture = read(&renderer);
            let eye = view.camera.eye().xyz;
            let mut told = 0;
            for (index, pixel) in (0..).zip(picture.rgba.chunks_exact(4)) {
                let pixel_at = UVec2::new(index % SIZE.x, index / SIZE.x).as_dvec2() + 0.5;
                let ray = view.camera.ray(pixel_at, SIZE.as_dvec2());
                let depth = normal.dot(point - eye) / normal.dot(ray);
                let nm = eye + ray * depth;
                let margin = size * 0.1;
                if nm.cmplt(margin).any() || nm.cmpgt(size - margin).any() {
                    continue;
                }
                let want = value(nm);
                let got = f64::from(pixel[0]);
                assert!((got - want).abs() < 6.0, "{case}: {got} instead of {want}");
                told += 1;
            }
            assert!(told > 40, "{case}: {told} pixels were looked at");
        }
    }
}

/// A brick's voxels with their border, of values by place.
fn brick_of(volume: &Volume, id: BrickId, value: impl Fn(DVec3) -> f64) -> Vec<u8> {
    let down = volume.levels[id.level() as usize].downsampling * volume.voxel_nm;
    let low = (id.brick() * BRICK_EDGE).as_dvec3() - f64::from(BRICK_BORDER);
    let cells = VoxelBox::of_size(UVec3::splat(BRICK_STORED_EDGE)).iter();
    let voxels = cells.map(|cell| value((low + cell.as_dvec3() + 0.5) * down) as u8);
    voxels.collect()
}

#[test]
fn planes_that_make_no_sense_do_no_harm() {
    let Some(gpu) = gpu() else { return };
    let scene = waves();
    let [view, _] = views(&scene);
    let whole = picture(&gpu, &scene, &view, Traversal::ResidencyOctree);
    let slab = |normal, thickness_nm| {
        let point = Point::new(scene.volume.size_nm() / 2.0);
        Clip {
            slab: Some(Slab {
                point,
                normal,
                thickness_nm,
            }),
            ..Clip::default()
        }
    };
    let nowhere = [Point::new(DVec3::splat(1e9)), Point::new(DVec3::splat(2e9))];
    let far = Clip {
        within: Some(nowhere),
        ..Clip::default()
    };
    let broken = Clip {
        half_spaces: [
            Some(HalfSpace {
                point: Point::new(DVec3::NAN),
                normal: DVec3::X,
            }),
            None,
            None,
            None,
        ],
        ..Clip::default()
    };
    for (clip, shows) in [
        (slab(DVec3::ZERO, 1.0), true),
        (slab(DVec3::X, f64::NAN), false),
        (slab(DVec3::X * 1e200, 1e200), true),
        (far, false),
        (broken, false),
    ] {
        for mode in [Mode::EmissionAbsorption, Mode::IsoSurface] {
            let view = View { clip, mode, ..view };
            let got = picture(&gpu, &scene, &view, Traversal::ResidencyOctree);
            if mode == Mode::EmissionAbsorption {
                assert_eq!(psnr(&got, &whole) > 60.0, shows, "{clip:?}");
            }
        }
    }
}

#[test]
fn heat_shows_the_work_of_rays() {
    let Some(gpu) = gpu() else { return };
    let scene = specks();
    let [view, _] = views(&scene);
    let mut renderer = Renderer::new(&gpu, scene.volume.clone(), Default::default()).unwrap();
    renderer.set_channels(&scene.views()).unwrap();
    settle(&mut renderer, &view, &scene);
    for of in [Work::Lookups, Work::Nodes, Work::Samples] {
        let heat = |full| View {
            heat: Some(Heat { of, full }),
            ..view
        };
        let mut light = Vec::new();
        for full in [10.0, 100.0] {
            let report = frame(&mut renderer, &heat(full));
            let statistics = report.statistics;
            let [fewest, most] = statistics.lookups_per_ray;
            assert!(statistics.rays > 0 && fewest <= most, "{statistics:?}");
            assert!(u64::from(statistics.lookups) <= u64::from(statistics.rays) * u64::from(most));
            assert!(statistics.lookups >= statistics.rays * fewest);
            let picture = read(&renderer);
            keep(&format!("heat-{of:?}-{full}"), &picture);
            light.push(picture.rgba.iter().map(|&v| u64::from(v)).sum::<u64>());
        }
        assert!(light[0] > light[1], "{of:?}: {light:?}");
    }
}

/// All the heat of a picture together is what the frame counted of that kind of work, and of no other.
#[test]
fn heat_is_of_the_work_it_says() {
    let Some(gpu) = gpu() else { return };
    let scene = specks();
    let [_, view] = views(&scene);
    let mut renderer = Renderer::new(&gpu, scene.volume.clone(), Default::default()).unwrap();
    renderer.set_channels(&scene.views()).unwrap();
    settle(&mut renderer, &view, &scene);
    let counts = |statistics: Statistics| {
        [
            f64::from(statistics.lookups),
            f64::from(statistics.nodes),
            statistics.samples as f64,
        ]
    };
    let plain = caught_up(&mut renderer, &view).statistics;
    for (index, of) in [Work::Lookups, Work::Nodes, Work::Samples]
        .into_iter()
        .enumerate()
    {
        let mut full = counts(plain)[index] / f64::from(plain.rays);
        // Up to a third of the scale heat is red alone, and rises with the count.
        let (seen, counted) = loop {
            full *= 1.5;
            let heat = Heat {
                of,
                full: full as f32,
            };
            let view = View {
                heat: Some(heat),
                ..view
            };
            let statistics = frame(&mut renderer, &view).statistics;
            let pixels = read(&renderer).rgba;
            if pixels.chunks_exact(4).all(|p| p[1] == 0) {
                let red = pixels
                    .chunks_exact(4)
                    .map(|p| linear_from_srgb(f32::from(p[0]) / 255.0));
                let sum: f64 = red.map(f64::from).sum();
                break (sum / 3.0 * full, counts(statistics));
            }
        };
        for (other, &count) in counted.iter().enumerate() {
            let same = (seen / count - 1.0).abs() < 0.03;
            assert_eq!(
                same,
                other == index,
                "{of:?}: {seen:.0} seen, counted were {counted:?}"
            );
        }
    }
}
