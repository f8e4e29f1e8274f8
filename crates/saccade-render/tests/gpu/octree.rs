//! The residency octree: the same pictures as without it, for less.

use std::collections::BTreeSet;

use glam::{DVec3, UVec2, UVec3};
use saccade_core::brick::{BRICK_STORED_VOXELS, BrickId};
use saccade_core::camera::Camera;
use saccade_core::transfer::{OpacityPoint, TransferFunction};
use saccade_core::volume::Polarity;
use saccade_core::voxel_box::VoxelBox;
use saccade_render::{
    BrickVoxels, FrameReport, Gpu, Image, Renderer, RendererOptions, Traversal, View,
};

use crate::harness::{caught_up, deliver, frame, gpu, keep, psnr, read, settle};
use crate::oracle::{self, Cut};
use crate::scene::{Scene, specks, tissue, waves};

const SIZE: UVec2 = UVec2::new(64, 48);
/// Pictures that differ by rounding alone \[dB\].
const SAME: f64 = 65.0;

const CELLS: [[u32; 3]; 4] = [[8, 8, 4], [8, 8, 8], [16, 16, 16], [32, 32, 32]];

fn renderer(gpu: &Gpu, scene: &Scene, traversal: Traversal, cell: Option<[u32; 3]>) -> Renderer {
    let options = RendererOptions {
        traversal,
        octree_cell: cell.map(UVec3::from_array),
        ..RendererOptions::default()
    };
    let mut renderer = Renderer::new(gpu, scene.volume.clone(), options).unwrap();
    renderer.set_transfer_function(&scene.transfer);
    renderer
}

/// The picture with everything resident, and what a frame took that began with all that known.
fn picture(renderer: &mut Renderer, view: &View, scene: &Scene) -> (Image, FrameReport) {
    settle(renderer, view, scene);
    let report = caught_up(renderer, view);
    assert!(report.is_complete());
    (read(renderer), report)
}

#[test]
fn pictures_are_the_same_with_and_without() {
    let Some(gpu) = gpu() else { return };
    for (name, scene) in [
        ("waves", waves()),
        ("tissue", tissue()),
        ("specks", specks()),
    ] {
        let around = Camera::around(&scene.volume);
        for (camera_name, camera) in [
            ("corner", around),
            ("near", around.zoomed(3.0).orbited(50.0, -20.0)),
            ("far", around.zoomed(0.6)),
        ] {
            let view = View {
                background: [0.1, 0.2, 0.4],
                ..View::new(camera, SIZE)
            };
            let mut without = renderer(&gpu, &scene, Traversal::PageTables, None);
            let (want, _) = picture(&mut without, &view, &scene);
            keep(&format!("octree-{name}-{camera_name}-without"), &want);
            for cell in CELLS {
                let mut with = renderer(&gpu, &scene, Traversal::ResidencyOctree, Some(cell));
                let (got, _) = picture(&mut with, &view, &scene);
                keep(&format!("octree-{name}-{camera_name}-with"), &got);
                let db = psnr(&got, &want);
                assert!(
                    db >= SAME,
                    "{name}, {camera_name}, cells {cell:?}: {db:.1} dB"
                );
            }
            // A comparison that cannot fail proves nothing.
            let turned = View {
                camera: camera.orbited(2.0, 0.0),
                ..view
            };
            let (turned, _) = picture(&mut without, &turned, &scene);
            let db = psnr(&turned, &want);
            assert!(db < SAME, "{name}, {camera_name}, turned: {db:.1} dB");
        }
    }
}

#[test]
fn specks_look_as_the_oracle_says() {
    let Some(gpu) = gpu() else { return };
    let scene = specks();
    let view = View::new(Camera::around(&scene.volume).zoomed(1.5), SIZE);
    let mut renderer = renderer(&gpu, &scene, Traversal::ResidencyOctree, None);
    let (got, _) = picture(&mut renderer, &view, &scene);
    let want = oracle::render(&scene, &view, Cut::HalfVoxels);
    let db = psnr(&got, &want);
    assert!(db >= 45.0, "{db:.1} dB");
}

#[test]
fn finer_boxes_leave_less_to_sample() {
    let Some(gpu) = gpu() else { return };
    let scene = specks();
    let view = View::new(Camera::around(&scene.volume).zoomed(2.0), SIZE);
    let mut without = renderer(&gpu, &scene, Traversal::PageTables, None);
    let without = picture(&mut without, &view, &scene).1.statistics;
    assert_eq!(without.nodes, 0);
    let samples = [[32; 3], [16; 3], [8; 3]].map(|cell| {
        let mut with = renderer(&gpu, &scene, Traversal::ResidencyOctree, Some(cell));
        let with = picture(&mut with, &view, &scene).1.statistics;
        assert!(with.nodes > 0 && with.lookups < without.lookups);
        with.samples
    });
    assert!(samples.is_sorted_by(|a, b| a > b), "{samples:?}");
    assert!(
        4 * samples[2] < without.samples,
        "{samples:?} of {}",
        without.samples
    );
}

/// Two peaks with a gap between: smallest and largest alone would not tell that nothing is seen.
#[test]
fn gaps_in_the_transfer_function_are_skipped_by_bins() {
    let Some(gpu) = gpu() else { return };
    let scene = specks();
    let point = |value, opacity| OpacityPoint { value, opacity };
    let transfer = TransferFunction {
        opacity: vec![
            point(0.0, 0.5),
            point(0.03, 0.0),
            point(0.35, 0.0),
            point(0.4, 0.6),
        ],
        ..scene.transfer.clone()
    };
    let scene = Scene {
        table: transfer.table(),
        transfer,
        ..scene
    };
    let view = View::new(Camera::around(&scene.volume).zoomed(2.0), SIZE);
    let mut with = renderer(&gpu, &scene, Traversal::ResidencyOctree, None);
    let (got, with) = picture(&mut with, &view, &scene);
    let mut without = renderer(&gpu, &scene, Traversal::PageTables, None);
    let (want, without) = picture(&mut without, &view, &scene);
    assert!(psnr(&got, &want) >= SAME);
    let samples = [&with, &without].map(|report| report.statistics.samples);
    assert!(samples[0] * 3 < samples[1] * 2, "{samples:?}");
}

#[test]
fn what_is_known_to_be_hidden_is_not_asked_for_again() {
    let Some(gpu) = gpu() else { return };
    let scene = specks();
    let hidden = TransferFunction {
        opacity: Vec::new(),
        ..scene.transfer.clone()
    };
    for traversal in [Traversal::ResidencyOctree, Traversal::PageTables] {
        let options = RendererOptions {
            // Room for a part of the volume's bricks.
            memory_bytes: 3 << 20,
            traversal,
            ..RendererOptions::default()
        };
        let mut renderer = Renderer::new(&gpu, scene.volume.clone(), options).unwrap();
        renderer.set_transfer_function(&hidden);
        for level in 0..scene.volume.levels.len() {
            let extent = (scene.volume.levels[level].extent + 31) / 32;
            for brick in VoxelBox::of_size(extent).iter() {
                let id = BrickId::new(0, u32::try_from(level).unwrap(), brick).unwrap();
                deliver(&mut renderer, &scene, id);
            }
        }
        let view = View {
            lod_bias: -2.0,
            ..View::new(Camera::around(&scene.volume), SIZE)
        };
        let report = caught_up(&mut renderer, &view);
        let (resident, slots) = (report.memory.bricks_resident, report.memory.brick_slots);
        let bricks = renderer
            .volume()
            .levels
            .iter()
            .map(|l| (l.extent + 31) / 32);
        let bricks: u32 = bricks.map(|n| n.element_product()).sum();
        assert!(resident <= slots && slots < bricks, "{slots} of {bricks}");
        let octree = traversal == Traversal::ResidencyOctree;
        assert_eq!(report.is_complete(), octree, "{traversal:?}: {report:?}");
    }
}

#[test]
fn what_changed_is_not_skipped() {
    let Some(gpu) = gpu() else { return };
    let scene = specks();
    let empty = Scene {
        levels: scene.levels.iter().map(|l| vec![0; l.len()]).collect(),
        ..specks()
    };
    let view = View::new(Camera::around(&scene.volume).zoomed(1.5), SIZE);
    let mut renderer = renderer(&gpu, &scene, Traversal::ResidencyOctree, None);
    let (nothing, report) = picture(&mut renderer, &view, &empty);
    assert!(report.memory.node_blocks_used < 20, "{:?}", report.memory);
    assert!(nothing.rgba.chunks_exact(4).all(|p| p == [0, 0, 0, 255]));
    renderer.invalidate(VoxelBox::of_size(scene.volume.extent()));
    assert!(!frame(&mut renderer, &view).is_complete());
    let (got, _) = picture(&mut renderer, &view, &scene);
    let db = psnr(&got, &oracle::render(&scene, &view, Cut::HalfVoxels));
    assert!(db >= 45.0, "{db:.1} dB");
}

/// Where bits name the levels that are there, the others need no look.
#[test]
fn substitutes_are_found_without_a_search() {
    let Some(gpu) = gpu() else { return };
    let scene = tissue();
    let coarsest = u32::try_from(scene.volume.levels.len() - 1).unwrap();
    let view = View {
        lod_bias: -1.0,
        ..View::new(Camera::around(&scene.volume).zoomed(2.0), SIZE)
    };
    let [with, without] = [Traversal::ResidencyOctree, Traversal::PageTables].map(|traversal| {
        let mut renderer = renderer(&gpu, &scene, traversal, None);
        let id = BrickId::new(0, coarsest, UVec3::ZERO).unwrap();
        deliver(&mut renderer, &scene, id);
        // The first frame only makes page tables.
        frame(&mut renderer, &view);
        let report = frame(&mut renderer, &view);
        assert_eq!(report.fidelity.substituted_levels, coarsest);
        (read(&renderer), report)
    });
    assert!(psnr(&with.0, &without.0) >= SAME, "the same substitutes");
    let lookups = [&with.1, &without.1].map(|report| report.statistics.lookups);
    assert!(lookups[0] * 4 < lookups[1] * 3, "{lookups:?}");
    // In any order: rays are drawn at once.
    let misses = [&with.1, &without.1].map(|report| {
        let mut misses = report.misses.clone();
        misses.sort();
        misses
    });
    assert_eq!(misses[0], misses[1]);
}

#[test]
fn an_octree_without_room_is_no_obstacle() {
    let Some(gpu) = gpu() else { return };
    let scene = specks();
    let view = View::new(Camera::around(&scene.volume).zoomed(1.5), SIZE);
    let options = RendererOptions {
        octree_cell: Some(UVec3::splat(2)),
        memory_bytes: 4 << 20,
        ..RendererOptions::default()
    };
    let mut renderer = Renderer::new(&gpu, scene.volume.clone(), options).unwrap();
    renderer.set_transfer_function(&scene.transfer);
    let (got, report) = picture(&mut renderer, &view, &scene);
    assert_eq!(
        report.memory.node_blocks_used, report.memory.node_blocks,
        "it was meant to be full"
    );
    let db = psnr(&got, &oracle::render(&scene, &view, Cut::HalfVoxels));
    assert!(db >= 45.0, "{db:.1} dB");
    let voxels = vec![77; BRICK_STORED_VOXELS];
    let id = BrickId::new(0, 0, UVec3::ZERO).unwrap();
    renderer.deliver(id, BrickVoxels::Voxels(&voxels)).unwrap();
    frame(&mut renderer, &view);
}

/// A source that knows the values of a brick before it is built saves building it.
#[test]
fn what_a_source_knows_to_be_hidden_is_never_asked_for() {
    let Some(gpu) = gpu() else { return };
    let scene = specks();
    let view = View {
        lod_bias: -1.0,
        ..View::new(Camera::around(&scene.volume).zoomed(1.5), SIZE)
    };
    let mut with = renderer(&gpu, &scene, Traversal::ResidencyOctree, None);
    let mut noted = BTreeSet::new();
    for _ in 0..200 {
        let report = frame(&mut with, &view);
        if report.is_complete() {
            break;
        }
        for &id in &report.misses {
            let raw = scene.brick(id).unwrap_or_default();
            let measured = || raw.iter().copied().filter(|&v| v != 0);
            let range = measured().min().zip(measured().max());
            let hidden = noted.insert(id)
                && range.is_some_and(|(min, max)| with.note_range(id, [min, max].map(u16::from)));
            if !hidden {
                deliver(&mut with, &scene, id);
            }
        }
    }
    assert!(frame(&mut with, &view).is_complete());
    let mut without = renderer(&gpu, &scene, Traversal::PageTables, None);
    let (want, without) = picture(&mut without, &view, &scene);
    let db = psnr(&read(&with), &want);
    assert!(db >= SAME, "{db:.1} dB");
    let resident = [&with.memory(), &without.memory].map(|m| m.bricks_resident);
    assert!(resident[0] < resident[1], "{resident:?} resident");
}

/// Cubes of four voxels, every second of which is seen, so that each leaf holds both; nothing of what lies where `gap` says.
fn chequered(extent: UVec3, gap: impl Fn(f64) -> bool) -> Scene {
    let point = |(value, opacity): (f32, f32)| OpacityPoint {
        value: value / 255.0,
        opacity,
    };
    let opacity = [(100.0, 0.0), (110.0, 0.2)];
    let transfer = TransferFunction {
        opacity: opacity.map(point).to_vec(),
        opacity_length_nm: 2e5,
        polarity: Polarity::Bright,
        ..tissue().transfer
    };
    let nm = 1000.0;
    Scene::new(extent, DVec3::splat(nm), transfer, |at| {
        let cube = (at / (4.0 * nm)).floor();
        let is_seen = (cube.x + cube.y + cube.z).rem_euclid(2.0) < 0.5 && !gap(at.x / nm);
        if is_seen { 200.0 } else { 20.0 }
    })
}

/// Looks along x, from where it is 0, with rays that are nearly parallel and pass all of it.
fn along_x(scene: &Scene) -> View {
    let around = Camera::around(&scene.volume);
    let turned = (0..4).map(|quarter| Camera {
        yaw: 90.0 * f64::from(quarter),
        pitch: 0.0,
        fov: 3.0,
        distance_nm: 2.0 * scene.volume.size_nm().x,
        ..around
    });
    let along = |camera: &Camera| camera.physical_from_eye_axes().z_axis.x.abs() > 0.999;
    let mut cameras = turned.filter(along);
    let ahead = |camera: &Camera| camera.physical_from_eye_axes().z_axis.x > 0.0;
    let camera = cameras.find(ahead).expect("one of four");
    View {
        // Of the finest level.
        lod_bias: -8.0,
        ..View::new(camera, SIZE)
    }
}

#[test]
fn rays_that_find_nothing_to_skip_look_less_often() {
    let Some(gpu) = gpu() else { return };
    let scene = chequered(UVec3::new(224, 40, 40), |_| false);
    let view = along_x(&scene);
    let cells = Some([8, 8, 8]);
    let mut with = renderer(&gpu, &scene, Traversal::ResidencyOctree, cells);
    let (got, report) = picture(&mut with, &view, &scene);
    let mut without = renderer(&gpu, &scene, Traversal::PageTables, None);
    let (want, all) = picture(&mut without, &view, &scene);
    assert!(psnr(&got, &want) >= SAME);
    // Nothing is skipped, so that each of the leaves, of sixteen samples at most where rays go straight, would be visited.
    let [samples, of_all] = [&report, &all].map(|report| report.statistics.samples);
    assert_eq!(samples, of_all);
    let nodes = u64::from(report.statistics.nodes);
    assert!(nodes * 14 < samples, "{nodes} nodes, {samples} samples");
    // Where there is something to skip behind all that, it is skipped.
    let scene = chequered(UVec3::new(224, 40, 40), |x| x > 144.0);
    let mut with = renderer(&gpu, &scene, Traversal::ResidencyOctree, cells);
    let (_, report) = picture(&mut with, &view, &scene);
    let half = report.statistics.samples;
    assert!(half * 4 < samples * 3, "{half} of {samples} samples");
}

#[test]
fn what_is_hidden_behind_much_that_is_seen_is_not_asked_for() {
    let Some(gpu) = gpu() else { return };
    let scene = chequered(UVec3::new(320, 40, 40), |x| (250.0..294.0).contains(&x));
    let view = along_x(&scene);
    let mut renderer = renderer(&gpu, &scene, Traversal::ResidencyOctree, Some([8, 8, 8]));
    let bricks = VoxelBox::new(UVec3::new(8, 0, 0), UVec3::new(9, 2, 2));
    let bricks = bricks.iter().map(|at| BrickId::new(0, 0, at).unwrap());
    let hidden: BTreeSet<_> = bricks.collect();
    let (mut noted, mut behind) = (BTreeSet::new(), false);
    for _ in 0..200 {
        let report = caught_up(&mut renderer, &view);
        if report.is_complete() {
            break;
        }
        for &id in &report.misses {
            if hidden.contains(&id) {
                // Before it is noted nothing is known.
                assert!(!noted.contains(&id), "{id:?} is asked for again");
                if renderer.note_range(id, [20, 20]) {
                    noted.insert(id);
                } else {
                    deliver(&mut renderer, &scene, id);
                }
                continue;
            }
            behind |= id.level() == 0 && id.brick().x == 9;
            deliver(&mut renderer, &scene, id);
        }
    }
    assert!(frame(&mut renderer, &view).is_complete());
    assert!(
        behind && !noted.is_empty(),
        "rays end before they come that far"
    );
}

/// That all values are seen does not say that there is something everywhere.
#[test]
fn what_was_not_acquired_is_skipped_among_what_is_all_seen() {
    let Some(gpu) = gpu() else { return };
    let plain = chequered(UVec3::splat(8), |_| false);
    let transfer = TransferFunction {
        opacity: vec![OpacityPoint {
            value: 0.0,
            opacity: 0.01,
        }],
        ..plain.transfer
    };
    // Half of it, nowhere a whole brick.
    let extent = UVec3::new(192, 40, 40);
    let scene = Scene::new(extent, DVec3::splat(1000.0), transfer, |at| {
        let is_there = (at.x / 1000.0 + 10.0).rem_euclid(64.0) < 32.0;
        if is_there { 150.0 } else { 0.0 }
    });
    let view = along_x(&scene);
    let mut with = renderer(&gpu, &scene, Traversal::ResidencyOctree, Some([8, 8, 8]));
    let (got, with) = picture(&mut with, &view, &scene);
    let mut without = renderer(&gpu, &scene, Traversal::PageTables, None);
    let (want, without) = picture(&mut without, &view, &scene);
    let db = psnr(&got, &want);
    assert!(db >= SAME, "{db:.1} dB");
    let samples = [&with, &without].map(|report| report.statistics.samples);
    assert!(samples[0] * 5 < samples[1] * 4, "{samples:?}");
}
