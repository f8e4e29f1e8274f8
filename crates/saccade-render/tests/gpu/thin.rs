//! What is one voxel thin is seen as bright as it is, from wherever it is looked at.

use glam::{DVec3, UVec2, UVec3};
use saccade_core::camera::Camera;
use saccade_core::space::Point;
use saccade_core::transfer::{ColorMap, TransferFunction};
use saccade_core::volume::Polarity;
use saccade_render::{Clip, Gpu, Image, Mode, Renderer, RendererOptions, Slab, View};

use crate::harness::{gpu, keep, read, settle};
use crate::oracle::encoded;
use crate::scene::{Scene, ramp};

/// Length of a voxel \[nm\].
const VOXEL: f64 = 10.0;
const EDGE: u32 = 39;
const BRIGHT: u8 = 250;

fn transfer() -> TransferFunction {
    ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 1.0)], 1.0)
}

/// Values of voxels, by their places.
fn scene(value: impl Fn(UVec3) -> u8) -> Scene {
    let at = |nm: DVec3| f64::from(value((nm / VOXEL).floor().as_uvec3()));
    Scene::new(UVec3::splat(EDGE), DVec3::splat(VOXEL), transfer(), at)
}

/// From afar, so that rays are all but parallel, towards the volume's middle; all of `across` voxels of the finest level.
fn view(mode: Mode, yaw: f64, pitch: f64, across: f64, size: UVec2) -> View {
    let distance_nm = 1e5;
    let camera = Camera {
        target: Point::new(DVec3::splat(f64::from(EDGE) * VOXEL / 2.0)),
        distance_nm,
        yaw,
        pitch,
        fov: 2.0 * (across * VOXEL / 2.0 / distance_nm).atan().to_degrees(),
    };
    View {
        mode,
        lod_bias: -20.0,
        background: [0.0, 0.0, 1.0],
        ..View::new(camera, size)
    }
}

fn picture(gpu: &Gpu, scene: &Scene, view: &View) -> Image {
    let mut renderer =
        Renderer::new(gpu, scene.volume.clone(), RendererOptions::default()).unwrap();
    renderer.set_channels(&scene.views()).unwrap();
    settle(&mut renderer, view, scene);
    read(&renderer)
}

/// Shades of the picture of a stored value, with the ones that differ by a step.
fn is_shade(pixel: &[u8], stored: u8) -> bool {
    let [linear, ..] = transfer().table()[usize::from(stored)];
    let want = encoded(f64::from(linear)) * 255.0;
    { pixel[..3].iter() }.all(|&part| (f64::from(part) - want).abs() < 1.6)
}

/// Yaw and pitch \[degrees\].
const DIRECTIONS: [(f64, f64); 6] = [
    (0.0, 0.0),
    (0.0, 20.0),
    (35.0, 25.0),
    (90.0, 0.0),
    (200.0, -30.0),
    (10.0, 89.0),
];

#[test]
fn a_sheet_is_as_bright_from_all_sides() {
    let Some(gpu) = gpu() else { return };
    let mut met = 0;
    for axis in 0..3 {
        let scene = scene(|at| if at[axis] == EDGE / 2 { BRIGHT } else { 1 });
        for (yaw, pitch) in DIRECTIONS {
            let view = view(Mode::Maximum, yaw, pitch, 8.0, UVec2::new(31, 23));
            let direction = direction(&view);
            // Rays that pass more voxels along another axis meet the sheet where they meet it.
            let is_ahead = direction[axis].abs() > 0.99 * direction.abs().max_element();
            let least = if is_ahead { BRIGHT } else { BRIGHT / 4 * 3 };
            // Along the sheet they pass beside it.
            if direction[axis].abs() < 0.3 {
                continue;
            }
            let seen = picture(&gpu, &scene, &view);
            keep(&format!("sheet-{axis}-{yaw}-{pitch}"), &seen);
            let is_right = |pixel: &[u8]| (least..=BRIGHT).any(|stored| is_shade(pixel, stored));
            let wrong = { seen.rgba.chunks_exact(4) }.find(|pixel| !is_right(pixel));
            assert_eq!(wrong, None, "axis {axis} from {yaw}, {pitch}");
            met += u32::from(is_ahead);
            // Three quarters, which a sample half way to the next plane has, are another shade.
            if is_ahead {
                assert!(!is_shade(&seen.rgba, BRIGHT / 4 * 3));
            }
        }
    }
    assert!(met >= DIRECTIONS.len().try_into().unwrap(), "{met}");
}

fn direction(view: &View) -> DVec3 {
    let middle = view.size.as_dvec2() / 2.0;
    view.camera
        .ray(middle, view.size.as_dvec2())
        .normalize_or_zero()
}

#[test]
fn a_sheet_has_a_surface_from_all_sides() {
    let Some(gpu) = gpu() else { return };
    let mut scene = scene(|at| if at.z == EDGE / 2 { BRIGHT } else { 1 });
    scene.iso = f64::from(BRIGHT) - 5.0;
    for (yaw, pitch) in DIRECTIONS {
        let view = view(Mode::IsoSurface, yaw, pitch, 8.0, UVec2::new(31, 23));
        if direction(&view).z.abs() < 0.5 {
            continue;
        }
        let seen = picture(&gpu, &scene, &view);
        keep(&format!("sheet-surface-{yaw}-{pitch}"), &seen);
        // Behind it is blue.
        let holes = { seen.rgba.chunks_exact(4) }.filter(|pixel| pixel[0] == 0);
        assert_eq!(holes.count(), 0, "from {yaw}, {pitch}");
    }
    // Where no value is so high, all is a hole.
    scene.iso = f64::from(BRIGHT) + 3.0;
    let view = view(Mode::IsoSurface, 0.0, 0.0, 8.0, UVec2::new(31, 23));
    let seen = picture(&gpu, &scene, &view);
    assert!({ seen.rgba.chunks_exact(4) }.all(|pixel| pixel[0] == 0));
}

/// As the largest voxel of each column is, and not what lies between two.
#[test]
fn along_an_axis_the_largest_voxel_is_seen() {
    let Some(gpu) = gpu() else { return };
    let value = |at: UVec3| {
        let mixed = at.x * 7919 + at.y * 104_729 + at.z * 1_299_709;
        ((mixed ^ (mixed >> 7)) % 251) as u8 + 1
    };
    let scene = scene(value);
    // A pixel a voxel.
    let view = view(Mode::Maximum, 0.0, 0.0, f64::from(EDGE), UVec2::splat(EDGE));
    let seen = picture(&gpu, &scene, &view);
    keep("largest-voxels", &seen);
    let mut lower = 0;
    for (n, pixel) in (0..EDGE * EDGE).zip(seen.rgba.chunks_exact(4)) {
        let column = |z| value(UVec3::new(n % EDGE, n / EDGE, z));
        let want = (0..EDGE).map(column).max().unwrap();
        // Rays are not quite parallel: off the middle they pass beside those of voxels by some hundredths.
        let near = (want - 12..=want).any(|stored| is_shade(pixel, stored));
        assert!(near, "at {n}: {pixel:?} for {want}");
        lower += u32::from(!is_shade(pixel, want));
    }
    assert!(lower < EDGE * EDGE / 2, "{lower} are darker");
}

/// What a thin slab shows is in a thick one.
#[test]
fn thicker_slabs_are_no_darker() {
    let Some(gpu) = gpu() else { return };
    let scene = scene(|at| if at.z == 7 { BRIGHT } else { 1 });
    for thickness_nm in [0.0, 0.1, 1.0, 5.0, 9.0, 10.0, 13.0, 20.0, 30.0, 90.0] {
        let slab = Slab {
            point: Point::new(DVec3::splat(7.5 * VOXEL)),
            normal: DVec3::Z,
            thickness_nm,
        };
        let view = View {
            clip: Clip {
                slab: Some(slab),
                ..Clip::default()
            },
            ..view(Mode::Maximum, 0.0, 0.0, 8.0, UVec2::new(15, 9))
        };
        let seen = picture(&gpu, &scene, &view);
        let wrong = { seen.rgba.chunks_exact(4) }.find(|pixel| !is_shade(pixel, BRIGHT));
        assert_eq!(wrong, None, "{thickness_nm} nm");
    }
}
