//! What is one voxel thin is seen as bright as it is, from wherever it is looked at.

use glam::{DVec3, UVec2, UVec3};
use saccade_core::camera::Camera;
use saccade_core::space::Point;
use saccade_core::transfer::{ColorMap, TransferFunction};
use saccade_core::volume::Polarity;
use saccade_render::{Clip, Gpu, HalfSpace, Image, Mode, Renderer, RendererOptions, Slab, View};

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
            // Along the sheet they pass beside it.
            if direction(&view)[axis].abs() < 0.3 {
                continue;
            }
            let seen = picture(&gpu, &scene, &view);
            keep(&format!("sheet-{axis}-{yaw}-{pitch}"), &seen);
            let wrong = { seen.rgba.chunks_exact(4) }.find(|pixel| !is_shade(pixel, BRIGHT));
            assert_eq!(wrong, None, "axis {axis} from {yaw}, {pitch}");
            // What a sample a quarter of a voxel beside it has is another shade.
            assert!(!is_shade(&seen.rgba, BRIGHT / 4 * 3));
            met += 1;
        }
    }
    assert!(met >= DIRECTIONS.len() + 3, "{met}");
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
    let mut none = scene(|at| if at.z == EDGE / 2 { BRIGHT } else { 1 });
    for axis in 0..3 {
        let mut scene = scene(|at| if at[axis] == EDGE / 2 { BRIGHT } else { 1 });
        scene.iso = f64::from(BRIGHT) - 3.0;
        for (yaw, pitch) in DIRECTIONS {
            let view = view(Mode::IsoSurface, yaw, pitch, 8.0, UVec2::new(31, 23));
            if direction(&view)[axis].abs() < 0.3 {
                continue;
            }
            let seen = picture(&gpu, &scene, &view);
            keep(&format!("sheet-surface-{axis}-{yaw}-{pitch}"), &seen);
            // Behind it is blue.
            let holes = { seen.rgba.chunks_exact(4) }.filter(|pixel| pixel[0] == 0);
            assert_eq!(holes.count(), 0, "axis {axis} from {yaw}, {pitch}");
        }
    }
    // Where no value is so high, all is a hole.
    none.iso = f64::from(BRIGHT) + 3.0;
    let view = view(Mode::IsoSurface, 0.0, 0.0, 8.0, UVec2::new(31, 23));
    let seen = picture(&gpu, &none, &view);
    assert!({ seen.rgba.chunks_exact(4) }.all(|pixel| pixel[0] == 0));
}

/// What is cut within a sheet is closed there, from either side, and wherever no value is so high it is open.
#[test]
fn a_sheet_that_is_cut_has_no_holes() {
    let Some(gpu) = gpu() else { return };
    for axis in 0..3 {
        let mut scene = scene(|at| if at[axis] == EDGE / 2 { BRIGHT } else { 1 });
        let middle = f64::from(EDGE) / 2.0;
        // Interpolated, half of it is left half a voxel beside the middle.
        for (beside, share) in [
            (0.0, 0.9),
            (0.25, 0.7),
            (0.5, 0.4),
            (-0.25, 0.7),
            (-0.5, 0.4),
        ] {
            let mut point = DVec3::splat(middle);
            point[axis] += beside;
            for side in [1.0, -1.0] {
                let half = HalfSpace {
                    point: Point::new(point * VOXEL),
                    normal: DVec3::AXES[axis] * side,
                };
                let clip = Clip {
                    half_spaces: [Some(half), None, None, None],
                    ..Clip::default()
                };
                for (yaw, pitch) in [
                    (0.0, 0.0),
                    (35.0, 25.0),
                    (200.0, -30.0),
                    (90.0, 0.0),
                    (10.0, 89.0),
                ] {
                    let view = View {
                        clip,
                        ..view(Mode::IsoSurface, yaw, pitch, 8.0, UVec2::new(21, 15))
                    };
                    if direction(&view)[axis].abs() < 0.3 {
                        continue;
                    }
                    let what = format!("axis {axis} from {yaw}, {pitch}: {beside}, {side}");
                    let open = |scene: &Scene| {
                        let seen = picture(&gpu, scene, &view);
                        { seen.rgba.chunks_exact(4) }
                            .filter(|pixel| pixel[0] == 0)
                            .count()
                    };
                    scene.iso = f64::from(BRIGHT) * share;
                    assert_eq!(open(&scene), 0, "{what}");
                    // Only what lies behind the cut has the sheet's middle.
                    let has_middle = beside * side <= 0.0;
                    scene.iso = f64::from(BRIGHT) * if has_middle { 1.02 } else { share + 0.15 };
                    assert_eq!(open(&scene), 21 * 15, "{what}");
                }
            }
        }
    }
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

/// What a thin slab shows is in a thick one, however its sheet lies and wherever it ends beside it.
#[test]
fn thicker_slabs_are_no_darker() {
    let Some(gpu) = gpu() else { return };
    for axis in 0..3 {
        let scene = scene(|at| if at[axis] == 7 { BRIGHT } else { 1 });
        for (yaw, pitch) in [(0.0, 0.0), (35.0, 25.0), (-60.0, 40.0)] {
            let view = view(Mode::Maximum, yaw, pitch, 8.0, UVec2::new(15, 9));
            if direction(&view)[axis].abs() < 0.3 {
                continue;
            }
            for beside in [0.0, 0.3, -0.45] {
                let mut before = 0;
                for thickness_nm in [0.0, 0.1, 1.0, 5.0, 9.0, 10.0, 13.0, 20.0, 30.0, 90.0] {
                    let mut at = DVec3::splat(f64::from(EDGE) * VOXEL / 2.0);
                    at[axis] = (7.5 + beside) * VOXEL;
                    let slab = Slab {
                        point: Point::new(at),
                        normal: DVec3::AXES[axis],
                        thickness_nm,
                    };
                    let mut view = View {
                        clip: Clip {
                            slab: Some(slab),
                            ..Clip::default()
                        },
                        ..view
                    };
                    view.camera.target = Point::new(at);
                    let seen = picture(&gpu, &scene, &view);
                    let darkest = seen.rgba.chunks_exact(4).map(|pixel| pixel[0]).min();
                    let darkest = darkest.unwrap();
                    let what =
                        format!("axis {axis} from {yaw}, {pitch}: {thickness_nm} nm, {beside}");
                    assert!(darkest + 1 >= before, "{what}: {darkest} after {before}");
                    before = before.max(darkest);
                    let reaches = thickness_nm / VOXEL / 2.0 >= f64::abs(beside);
                    if reaches {
                        let wrong =
                            { seen.rgba.chunks_exact(4) }.find(|pixel| !is_shade(pixel, BRIGHT));
                        assert_eq!(wrong, None, "{what}");
                    }
                }
            }
        }
    }
}

/// Of an eye in a sheet the value where it is counts as well.
#[test]
fn an_eye_within_a_sheet_sees_how_bright_it_is_there() {
    let Some(gpu) = gpu() else { return };
    let scene = scene(|at| if at.y == EDGE / 2 { BRIGHT } else { 1 });
    let middle = f64::from(EDGE) / 2.0;
    for beside in [0.0, 0.1, -0.2, 0.4] {
        let eye = DVec3::new(middle - 3.3, middle + beside, middle + 1.7) * VOXEL;
        for (yaw, pitch) in DIRECTIONS {
            let mut view = view(Mode::Maximum, yaw, pitch, 8.0, UVec2::new(13, 9));
            view.camera.distance_nm = 10.0 * VOXEL;
            view.camera.fov = 20.0;
            let from_target = view.camera.eye().xyz - view.camera.target.xyz;
            view.camera.target = Point::new(eye - from_target);
            let seen = picture(&gpu, &scene, &view);
            let here = 1.0 + f64::from(BRIGHT - 1) * (1.0 - f64::abs(beside));
            let least = (here - 2.0) as u8;
            let [linear, ..] = transfer().table()[usize::from(least)];
            let least = (encoded(f64::from(linear)) * 255.0) as u8;
            let darkest = seen
                .rgba
                .chunks_exact(4)
                .map(|pixel| pixel[0])
                .min()
                .unwrap();
            assert!(
                darkest >= least,
                "{beside} from {yaw}, {pitch}: {darkest}, not {least}"
            );
        }
    }
}
