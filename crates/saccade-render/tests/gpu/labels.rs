//! Numbers of objects: they say which colours objects have, and nothing of their shapes.

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

/// A ball of objects with these numbers, in octants; all of one colour.
fn ball(kind: VoxelKind, numbers: [u8; 8], factor: u16) -> Scene {
    let mut transfer = ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 1.0)], 1.0);
    transfer.window = [0.0, 1.0 / 255.0];
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

/// As the other modes have them.
#[test]
fn objects_have_the_colors_of_their_numbers() {
    let Some(gpu) = gpu() else { return };
    // Of one hue each, as the map has them at the ends of its range and in between.
    let numbers = [20, 250, 120, 180, 20, 250, 120, 180];
    for (factor, split) in [(1, false), (200, false), (200, true)] {
        let colored = |kind, numbers| {
            let mut scene = ball(kind, numbers, factor);
            scene.transfer.color_map = ColorMap::Viridis;
            scene.transfer.window = [0.0, 1.0];
            let seen = picture(&gpu, &scene, split);
            (scene, seen)
        };
        let (scene, many) = colored(VoxelKind::Labels, numbers);
        keep(&format!("labels-colors-{factor}-{split}"), &many);
        for number in &numbers[..4] {
            let [red, green, blue] = scene.transfer.color_at(f32::from(*number) / 255.0);
            let expected = hue([red, green, blue].map(f64::from));
            let alone = colored(VoxelKind::Labels, [*number; 8]).1;
            let near = |image: &Image| {
                let seen = image.rgba.chunks_exact(4).filter(|pixel| pixel[1] > 40);
                let apart = seen.map(|pixel| {
                    let own = hue(linear(pixel));
                    (0..3).map(|c| (own[c] - expected[c]).abs()).sum::<f64>()
                });
                let (near, far): (Vec<f64>, Vec<f64>) = apart.partition(|apart| *apart < 0.1);
                (near.len(), far.len())
            };
            let (of_it, of_others) = near(&alone);
            assert!(
                of_it > 500 && of_others == 0,
                "{number}: {of_it} pixels, {of_others} others"
            );
            // Among others, too; not all have as much of the side that is seen.
            let (of_it, of_others) = near(&many);
            assert!(
                of_it > 50 && of_others > 500,
                "{number} of several: {of_it}, {of_others}"
            );
            // Shades have that of the surface, whatever lies behind it.
            let (of_it, _) = near(&colored(VoxelKind::Intensity, [*number; 8]).1);
            assert_eq!(of_it, 0, "{number} as a shade");
        }
    }
}

fn linear(pixel: &[u8]) -> [f64; 3] {
    [0, 1, 2].map(|c| f64::from(linear_from_srgb(f32::from(pixel[c]) / 255.0)))
}

/// Shares of a colour's parts, whatever its brightness.
fn hue(color: [f64; 3]) -> [f64; 3] {
    let sum: f64 = color.iter().sum();
    color.map(|part| part / sum.max(1e-9))
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
        sum += (f64::from(linear) - lit).abs();
        count += 1.0;
        most = most.max(pixel[0]);
        least = least.min(pixel[0]);
    }
    let error = sum / count;
    assert!(count > 500.0 && error < 0.1, "{error:.3} of {count}");
    assert!(most - least > 30, "{least} to {most}: it is flat");
}
