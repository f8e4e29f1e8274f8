//! Numbers of objects: which they are says nothing of how objects look.

use std::sync::Arc;

use glam::{DVec2, DVec3, UVec2, UVec3};
use saccade_core::camera::Camera;
use saccade_core::transfer::{ColorMap, linear_from_srgb};
use saccade_core::volume::{Polarity, Volume, VoxelKind};
use saccade_render::{Gpu, Image, Mode, Renderer, RendererOptions, View};

use crate::harness::{gpu, keep, psnr, read, settle};
use crate::scene::{Scene, ramp};

const EDGE: u32 = 45;
const VOXEL: f64 = 4.0;
const RADIUS: f64 = 18.0;

/// A ball of objects with these numbers, in octants.
fn ball(kind: VoxelKind, numbers: [u8; 8], factor: u16) -> Scene {
    let transfer = ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 1.0)], 1.0);
    let value = |nm: DVec3| {
        let from_middle = nm / VOXEL - f64::from(EDGE) / 2.0;
        let octant = usize::from(from_middle.x > 0.0)
            + 2 * usize::from(from_middle.y > 0.0)
            + 4 * usize::from(from_middle.z > 0.0);
        if from_middle.length() < RADIUS {
            f64::from(numbers[octant])
        } else {
            0.0
        }
    };
    let mut scene = Scene::new(UVec3::splat(EDGE), DVec3::splat(VOXEL), transfer, value);
    if factor > 1 {
        scene = scene.deep(factor);
    }
    scene.iso = 0.5;
    scene.volume = Arc::new(Volume {
        kind,
        ..(*scene.volume).clone()
    });
    scene
}

fn picture(gpu: &Gpu, scene: &Scene, split_16_bit: bool) -> Image {
    let view = View {
        mode: Mode::IsoSurface,
        lod_bias: -20.0,
        ..View::new(Camera::around(&scene.volume).zoomed(1.6), UVec2::splat(64))
    };
    let options = RendererOptions {
        split_16_bit,
        ..RendererOptions::default()
    };
    let mut renderer = Renderer::new(gpu, scene.volume.clone(), options).unwrap();
    renderer.set_channels(&scene.views()).unwrap();
    settle(&mut renderer, &view, scene);
    read(&renderer)
}

#[test]
fn surfaces_do_not_depend_on_numbers() {
    let Some(gpu) = gpu() else { return };
    let numbers = [3, 200, 17, 90, 251, 1, 44, 120];
    for (factor, split) in [(1, false), (200, false), (200, true)] {
        let seen = |kind, numbers| picture(&gpu, &ball(kind, numbers, factor), split);
        let one = seen(VoxelKind::Labels, [90; 8]);
        let many = seen(VoxelKind::Labels, numbers);
        keep(&format!("labels-{factor}-{split}"), &many);
        let db = psnr(&many, &one);
        assert!(db > 60.0, "factor {factor}: {db:.1} dB");
        // As values they do: other shades have other slopes.
        let shades = seen(VoxelKind::Intensity, numbers);
        let flat = seen(VoxelKind::Intensity, [90; 8]);
        let db = psnr(&shades, &flat);
        assert!(db < 30.0, "factor {factor}: {db:.1} dB");
    }
}

/// A ball is brightest in its middle and darker towards its edge, smoothly enough to be seen as one.
#[test]
fn objects_are_lit_as_round_as_they_are() {
    let Some(gpu) = gpu() else { return };
    let scene = ball(VoxelKind::Labels, [3, 200, 17, 90, 251, 1, 44, 120], 1);
    let seen = picture(&gpu, &scene, false);
    let camera = Camera::around(&scene.volume).zoomed(1.6);
    let size = DVec2::splat(64.0);
    let (mut sum, mut count) = (0.0, 0.0);
    let (mut most, mut least) = (0_u8, u8::MAX);
    for (n, pixel) in (0..64 * 64).zip(seen.rgba.chunks_exact(4)) {
        let ray = camera.ray(DVec2::new(f64::from(n % 64), f64::from(n / 64)) + 0.5, size);
        let ray = ray.normalize_or_zero();
        // Where the ray meets the ball, if it is not near its edge.
        let middle = DVec3::splat(f64::from(EDGE) * VOXEL / 2.0) - camera.eye().xyz;
        let along = middle.dot(ray);
        let beside = (middle - along * ray).length() / (RADIUS * VOXEL);
        if beside > 0.85 {
            continue;
        }
        let facing = (1.0 - beside * beside).sqrt();
        let lit = 0.15 + 0.85 * facing;
        let linear = linear_from_srgb(f32::from(pixel[0]) / 255.0);
        // The surface's own colour is half as bright as can be.
        sum += (f64::from(linear) / 0.5 - lit).abs();
        count += 1.0;
        most = most.max(pixel[0]);
        least = least.min(pixel[0]);
    }
    let error = sum / count;
    assert!(count > 500.0 && error < 0.1, "{error:.3} of {count}");
    assert!(most - least > 30, "{least} to {most}: it is flat");
}
