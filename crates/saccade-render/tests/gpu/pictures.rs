//! Against the oracle.

use std::collections::HashSet;

use glam::{DVec3, UVec2, UVec3};
use saccade_core::camera::Camera;
use saccade_core::space::Point;
use saccade_core::transfer::ColorMap;
use saccade_core::volume::Polarity;
use saccade_render::{Image, Renderer, RendererOptions, View};

use crate::harness::{gpu, keep, psnr, read, settle};
use crate::oracle::{self, Cut};
use crate::scene::{Scene, ramp, tissue, waves};

/// A picture counts as the oracle's from here on \[dB\].
const SAME: f64 = 45.0;
const SIZE: UVec2 = UVec2::new(72, 56);

fn cameras(scene: &Scene) -> Vec<(&'static str, Camera)> {
    let around = Camera::around(&scene.volume);
    let middle = scene.volume.size_nm() / 2.0;
    let front = Camera {
        yaw: 0.0,
        pitch: 0.0,
        ..around
    };
    let inside = Camera {
        distance_nm: 1e-3,
        target: Point::new(middle * 0.9),
        ..around
    };
    vec![
        ("corner", around),
        ("front", front),
        (
            "above",
            Camera {
                pitch: 88.0,
                ..around
            },
        ),
        (
            "side",
            Camera {
                yaw: 90.0,
                pitch: 0.0,
                ..around
            },
        ),
        ("near", around.zoomed(4.0)),
        ("far", around.zoomed(0.2)),
        ("inside", inside),
        (
            "behind",
            Camera {
                target: Point::new(middle - DVec3::Z * 1e5),
                yaw: 180.0,
                ..front
            },
        ),
    ]
}

fn picture(scene: &Scene, view: &View, options: RendererOptions) -> Option<Image> {
    let gpu = gpu()?;
    let mut renderer = Renderer::new(&gpu, scene.volume.clone(), options).unwrap();
    renderer.set_transfer_function(&scene.transfer);
    let reports = settle(&mut renderer, view, scene);
    assert!(reports.last().unwrap().is_complete());
    Some(read(&renderer))
}

fn compare(name: &str, scene: &Scene) {
    for (camera_name, camera) in cameras(scene) {
        let view = View {
            background: [0.1, 0.2, 0.4],
            ..View::new(camera, SIZE)
        };
        let Some(got) = picture(scene, &view, RendererOptions::default()) else {
            return;
        };
        let want = oracle::render(scene, &view, Cut::HalfVoxels);
        let name = format!("{name}-{camera_name}");
        keep(&format!("{name}-gpu"), &got);
        keep(&format!("{name}-oracle"), &want);
        let db = psnr(&got, &want);
        assert!(db >= SAME, "{name}: {db:.1} dB");
    }
}

#[test]
fn waves_look_as_the_oracle_says() {
    compare("waves", &waves());
}

#[test]
fn tissue_looks_as_the_oracle_says() {
    compare("tissue", &tissue());
}

/// Levels as other programs write them: by three, by two and a half, and by another factor on each axis.
#[test]
fn levels_of_any_downsampling_look_as_the_oracle_says() {
    let transfer = ramp(
        Polarity::Bright,
        ColorMap::Bone,
        &[(0.3, 0.0), (0.8, 0.5)],
        60.0,
    );
    let factors = [
        DVec3::ONE,
        DVec3::new(3.0, 3.0, 1.0),
        DVec3::new(7.5, 6.0, 2.5),
        DVec3::new(15.0, 21.0, 7.0),
    ];
    let value = |nm: DVec3| {
        let wave = (nm.x / 130.0).sin() + (nm.y / 170.0).cos() + (nm.z / 110.0).sin();
        120.0 + 40.0 * wave
    };
    let extent = UVec3::new(131, 97, 53);
    let scene = Scene::with_levels(
        extent,
        DVec3::new(4.0, 4.0, 10.0),
        &factors,
        transfer,
        value,
    );
    compare("downsampling", &scene);
    // All of them were seen.
    let Some(gpu) = gpu() else { return };
    let mut renderer = Renderer::new(&gpu, scene.volume.clone(), Default::default()).unwrap();
    renderer.set_transfer_function(&scene.transfer);
    let mut seen = HashSet::new();
    for (_, camera) in cameras(&scene) {
        let reports = settle(&mut renderer, &View::new(camera, SIZE), &scene);
        let misses = reports.iter().flat_map(|report| &report.misses);
        seen.extend(misses.map(|id| id.level()));
    }
    assert_eq!(seen, HashSet::from([0, 1, 2, 3]));
}

#[test]
fn half_voxels_are_fine_enough() {
    let scene = waves();
    let view = View::new(Camera::around(&scene.volume).zoomed(1.5), SIZE);
    let Some(got) = picture(&scene, &view, RendererOptions::default()) else {
        return;
    };
    let db = psnr(&got, &oracle::render(&scene, &view, Cut::Fine));
    assert!(db >= 38.0, "{db:.1} dB from the integral");
    let jitter = View {
        jitter: true,
        ..view
    };
    let Some(jittered) = picture(&scene, &jitter, RendererOptions::default()) else {
        return;
    };
    assert!(jittered != got);
    let db = psnr(&got, &jittered);
    assert!(db >= 33.0, "{db:.1} dB from jitter");
}

/// A comparison that cannot fail proves nothing.
#[test]
fn the_comparison_notices_small_differences() {
    let scene = waves();
    let camera = Camera::around(&scene.volume).zoomed(1.5);
    let view = View::new(camera, SIZE);
    let Some(got) = picture(&scene, &view, RendererOptions::default()) else {
        return;
    };
    let want = |view: &View| oracle::render(&scene, view, Cut::HalfVoxels);
    assert!(psnr(&got, &want(&view)) >= SAME);
    let turned = View::new(camera.orbited(1.0, 0.0), SIZE);
    let panned = View::new(camera.panned(glam::DVec2::X, f64::from(SIZE.y)), SIZE);
    let coarser = View {
        lod_bias: 1.0,
        ..view
    };
    for (what, other) in [("turned", turned), ("panned", panned), ("coarser", coarser)] {
        let db = psnr(&got, &want(&other));
        assert!(db < SAME - 3.0, "{what}: {db:.1} dB");
    }
    let mut scene = waves();
    for level in &mut scene.levels {
        level.rotate_right(1);
    }
    let db = psnr(&got, &oracle::render(&scene, &view, Cut::HalfVoxels));
    assert!(db < SAME - 3.0, "volume moved by a voxel: {db:.1} dB");
}
