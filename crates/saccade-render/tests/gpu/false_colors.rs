//! What colours tell besides values, in every way to draw.

use glam::{DVec3, UVec2, UVec3};
use saccade_core::brick::BrickId;
use saccade_core::camera::Camera;
use saccade_core::space::Point;
use saccade_core::transfer::ColorMap;
use saccade_core::volume::Polarity;
use saccade_render::{Clip, FalseColors, Gpu, Image, Mode, Renderer, Slab, View};

use crate::harness::{deliver, frame, gpu, keep, psnr, read, settle};
use crate::scene::{Scene, ramp};

const SIZE: UVec2 = UVec2::new(64, 48);

/// One thing, large enough to be there at all of four levels.
fn ball() -> Scene {
    let points = [(0.3, 0.0), (0.7, 0.8)];
    let transfer = ramp(Polarity::Bright, ColorMap::Gray, &points, 20.0);
    let extent = UVec3::new(142, 129, 75);
    let middle = extent.as_dvec3() * 2.0;
    Scene::new(extent, DVec3::splat(4.0), transfer, move |nm| {
        let off = (nm - middle).length();
        20.0 + 200.0 * (2.0 - off / 70.0).clamp(0.0, 1.0)
    })
}

/// All ways to draw, a slice among them.
fn views(scene: &Scene) -> Vec<(&'static str, View)> {
    let around = View::new(Camera::around(&scene.volume).zoomed(1.4), SIZE);
    let slice = Clip {
        slab: Some(Slab {
            point: Point::new(scene.volume.size_nm() * 0.5),
            normal: DVec3::new(0.1, 0.2, 1.0),
            thickness_nm: 0.0,
        }),
        ..Clip::default()
    };
    let modes = [
        ("light", Mode::EmissionAbsorption, Clip::default()),
        ("maximum", Mode::Maximum, Clip::default()),
        ("surface", Mode::IsoSurface, Clip::default()),
        ("slice", Mode::Maximum, slice),
    ];
    let view = |(name, mode, clip)| {
        let view = View {
            mode,
            clip,
            ..around
        };
        (name, view)
    };
    modes.into_iter().map(view).collect()
}

fn renderer(gpu: &Gpu, scene: &Scene) -> Renderer {
    let mut renderer = Renderer::new(gpu, scene.volume.clone(), Default::default()).unwrap();
    renderer.set_channels(&scene.views()).unwrap();
    renderer
}

fn drawn(renderer: &mut Renderer, view: &View, false_colors: FalseColors) -> Image {
    let view = View {
        false_colors,
        ..*view
    };
    frame(renderer, &view);
    read(renderer)
}

/// How much redder than blue a picture is, per pixel.
fn redness(image: &Image) -> f64 {
    let pixels = image.rgba.chunks_exact(4);
    let redder = pixels.map(|p| f64::from(p[0]) - f64::from(p[2]));
    redder.sum::<f64>() / f64::from(SIZE.element_product())
}

#[test]
fn substitutes_are_tinted_however_they_are_drawn() {
    let Some(gpu) = gpu() else { return };
    let scene = ball();
    let coarsest = u32::try_from(scene.volume.levels.len() - 1).unwrap();
    for (name, view) in views(&scene) {
        let view = View {
            lod_bias: -20.0,
            ..view
        };
        let mut renderer = renderer(&gpu, &scene);
        let one = BrickId::new(0, coarsest, UVec3::ZERO).unwrap();
        deliver(&mut renderer, &scene, one);
        frame(&mut renderer, &view);
        let plain = drawn(&mut renderer, &view, FalseColors::None);
        assert_eq!(redness(&plain), 0.0, "{name}: values are grey");
        let lit = plain.rgba.chunks_exact(4).filter(|p| p[0] > 20).count();
        assert!(lit > 50, "{name}: {lit} pixels show something");
        let tinted = drawn(&mut renderer, &view, FalseColors::Residency);
        keep(&format!("false-residency-{name}"), &tinted);
        assert!(redness(&tinted) > 1.0, "{name}: {}", redness(&tinted));
        // Nothing is tinted that is at its level.
        settle(&mut renderer, &view, &scene);
        let plain = drawn(&mut renderer, &view, FalseColors::None);
        let tinted = drawn(&mut renderer, &view, FalseColors::Residency);
        let db = psnr(&plain, &tinted);
        assert!(db > 60.0, "{name}: {db:.1} dB");
    }
}

#[test]
fn levels_are_told_however_they_are_drawn() {
    let Some(gpu) = gpu() else { return };
    let scene = ball();
    let coarsest = u32::try_from(scene.volume.levels.len() - 1).unwrap();
    // Red against cyan.
    let [red, _, blue] = FalseColors::of_level(coarsest);
    assert!(coarsest == 3 && blue > red);
    for (name, view) in views(&scene) {
        let mut renderer = renderer(&gpu, &scene);
        for (lod_bias, level) in [(-20.0, 0), (20.0, coarsest)] {
            let view = View { lod_bias, ..view };
            let reports = settle(&mut renderer, &view, &scene);
            let fidelity = reports.last().unwrap().fidelity;
            assert_eq!(fidelity.level, Some(level), "{name}");
            let plain = drawn(&mut renderer, &view, FalseColors::None);
            assert_eq!(redness(&plain), 0.0, "{name}");
            let told = drawn(&mut renderer, &view, FalseColors::Level);
            keep(&format!("false-level-{name}-{level}"), &told);
            let redness = redness(&told);
            assert!(redness.abs() > 1.0, "{name}, level {level}: {redness}");
            assert_eq!(redness > 0.0, level == 0, "{name}, level {level}");
        }
    }
}
