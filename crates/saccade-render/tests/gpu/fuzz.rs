//! Any camera and any transfer function: a frame ends, the device stays, and the picture holds numbers.

use std::sync::Arc;

use glam::{DVec3, UVec2};
use proptest::prelude::*;
use proptest::test_runner::{Config, RngAlgorithm, TestRng, TestRunner};
use saccade_core::camera::Camera;
use saccade_core::space::Point;
use saccade_core::transfer::{ColorMap, OpacityPoint, TransferFunction};
use saccade_core::volume::{Polarity, Volume};
use saccade_render::{
    ChannelView, Clip, FalseColors, HalfSpace, Heat, Mode, Renderer, RendererOptions, Slab, View,
    Work,
};

use crate::harness::{deliver, frame, gpu, read};
use crate::scene::{Scene, stained, tissue};

/// Numbers as they should be, or now and then of any size, or none.
fn numbers(usual: std::ops::Range<f64>) -> impl Strategy<Value = f64> {
    prop_oneof![
        40 => usual,
        1 => (-30.0..30.0_f64).prop_map(f64::exp2),
        1 => prop::num::f64::ANY,
        1 => prop::sample::select(vec![
            0.0, -0.0, 1.0, -1.0, f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX, f64::MIN_POSITIVE, 1e15, -1e300,
        ]),
    ]
}

fn number() -> impl Strategy<Value = f64> {
    numbers(-2.0..2.0)
}

fn single() -> impl Strategy<Value = f32> {
    number().prop_map(|v| v as f32)
}

fn vector() -> impl Strategy<Value = DVec3> {
    [number(), number(), number()].prop_map(DVec3::from_array)
}

/// From inside of the volume, from behind it, from nowhere.
fn camera(volume: &Volume) -> impl Strategy<Value = Camera> + use<> {
    let size = volume.size_nm();
    let around = Camera::around(volume);
    let target = [(); 3].map(|()| numbers(-0.1..1.1));
    let target = target.prop_map(DVec3::from_array);
    let angles = (number(), numbers(-1.1..1.1), numbers(0.05..1.9));
    (target, numbers(0.0..1.2), angles).prop_map(move |(target, distance, (yaw, pitch, fov))| {
        Camera {
            target: Point::new(size * target),
            distance_nm: around.distance_nm * distance,
            yaw: yaw * 180.0,
            pitch: pitch * 90.0,
            fov: fov * 90.0,
        }
    })
}

fn transfer() -> impl Strategy<Value = TransferFunction> {
    let point = (numbers(0.0..1.0), numbers(-0.2..1.2)).prop_map(|(value, opacity)| OpacityPoint {
        value: value as f32,
        opacity: opacity as f32,
    });
    let polarity = prop::sample::select(vec![Polarity::Bright, Polarity::Dark]);
    let map = prop_oneof![1 => Just(ColorMap::Gray), 4 => Just(ColorMap::Viridis)];
    let window = [single(), single()];
    let opacity = prop::collection::vec(point, 1..5);
    (polarity, map, window, opacity, numbers(1.0..100.0)).prop_map(
        |(polarity, color_map, window, opacity, opacity_length_nm)| TransferFunction {
            polarity,
            color_map,
            window,
            opacity,
            opacity_length_nm,
        },
    )
}

fn clip(volume: &Volume) -> impl Strategy<Value = Clip> + use<> {
    let size = volume.size_nm();
    let plane = (vector(), vector()).prop_map(move |(point, normal)| HalfSpace {
        point: Point::new(size * point),
        normal,
    });
    let slab = (vector(), vector(), number()).prop_map(move |(point, normal, thickness)| Slab {
        point: Point::new(size * point),
        normal,
        thickness_nm: size.x * thickness,
    });
    let within =
        [vector(), vector()].prop_map(move |corners| corners.map(|c| Point::new(size * c)));
    let some = 0.1;
    (
        prop::option::weighted(some, within),
        prop::option::weighted(some, plane),
        prop::option::weighted(some, slab),
    )
        .prop_map(|(within, plane, slab)| Clip {
            within,
            half_spaces: [None, plane, None, None],
            slab,
        })
}

fn view(volume: &Volume) -> impl Strategy<Value = View> + use<> {
    let modes = vec![Mode::EmissionAbsorption, Mode::Maximum, Mode::IsoSurface];
    let heat = prop::sample::select(vec![Work::Lookups, Work::Nodes, Work::Samples]);
    let heat = (heat, single()).prop_map(|(of, full)| Heat { of, full });
    let size = (0..24_u32, 0..24_u32).prop_map(|(x, y)| UVec2::new(x, y));
    let false_colors = prop_oneof![
        8 => Just(FalseColors::None),
        1 => Just(FalseColors::Residency),
        1 => Just(FalseColors::Level),
    ];
    let flags = (any::<bool>(), false_colors, any::<bool>());
    (
        (camera(volume), clip(volume), size, numbers(-3.0..3.0)),
        prop::sample::select(modes),
        prop::option::weighted(0.1, heat),
        flags,
        [single(), single(), single()],
    )
        .prop_map(
            |((camera, clip, size, lod_bias), mode, heat, flags, background)| {
                let (substitute, false_colors, jitter) = flags;
                View {
                    mode,
                    clip,
                    lod_bias: lod_bias as f32,
                    substitute,
                    false_colors,
                    heat,
                    background,
                    jitter,
                    ..View::new(camera, size)
                }
            },
        )
}

/// What cases met.
#[derive(Debug, Default)]
struct Met {
    cases: u32,
    /// Whose rays met the volume.
    seen: u32,
    /// In which a pixel that is no number would show.
    telling: u32,
    /// With more than one channel.
    several: u32,
}

/// What is drawn by a renderer that was used for all views before this one.
fn draw(
    renderer: &mut Renderer,
    scene: &Scene,
    view: &View,
    channels: &[ChannelView],
    met: &mut Met,
) -> Result<(), TestCaseError> {
    // Whatever is drawn on white in colours that are never black is not black. What is no number is
    // stored as 0.
    let tells = |channel: &ChannelView| {
        channel.transfer.color_map == ColorMap::Viridis
            // A surface of what no voxel can be has no colour.
            && (view.mode != Mode::IsoSurface || (0.01..=1.0).contains(&channel.iso))
    };
    let telling =
        view.heat.is_none() && view.false_colors == FalseColors::None && channels.iter().all(tells);
    let view = &View {
        background: if telling { [1.0; 3] } else { view.background },
        ..*view
    };
    renderer.set_channels(channels).unwrap();
    let mut rays = 0;
    for _ in 0..3 {
        let report = frame(renderer, view);
        for &id in report.misses.iter().take(40) {
            deliver(renderer, scene, id);
        }
        prop_assert!(report.memory.total() <= report.memory.ceiling);
        rays = report.statistics.rays;
        prop_assert!(rays <= view.size.max(UVec2::ONE).element_product());
        prop_assert!(report.memory_bias.is_finite());
    }
    prop_assert!(!renderer.gpu().is_lost());
    let picture = read(renderer);
    prop_assert_eq!(picture.size, view.size.max(UVec2::ONE));
    let mut pixels = picture.rgba.chunks_exact(4);
    prop_assert!(pixels.all(|p| p[3] == 255));
    let black = picture.rgba.chunks_exact(4).any(|p| p[..3] == [0; 3]);
    prop_assert!(!(telling && black), "a pixel is no number");
    met.cases += 1;
    met.seen += u32::from(rays > 0);
    met.telling += u32::from(rays > 0 && telling);
    met.several += u32::from(rays > 0 && channels.len() > 1);
    Ok(())
}

/// How a channel is drawn, whichever it is.
fn channel() -> impl Strategy<Value = ChannelView> {
    (transfer(), single(), 0..40_u32, 0..40_u32).prop_map(|(transfer, iso, first, coarser)| {
        ChannelView {
            iso,
            levels: first / 8..=u32::MAX - coarser,
            coarser: coarser / 8,
            ..ChannelView::new(0, transfer)
        }
    })
}

/// Draws a scene by views of all kinds, each with some of its channels in some order.
fn fuzz(scene: &Scene, cases: u32) -> Option<Met> {
    let gpu = gpu()?;
    let options = RendererOptions {
        memory_bytes: scene.channels().map(|_| 6 << 20).sum(),
        ..RendererOptions::default()
    };
    let mut renderer = Renderer::new(&gpu, scene.volume.clone(), options).unwrap();
    // The same picture before and after: what came between left no trace.
    let plain = View::new(Camera::around(&scene.volume), UVec2::new(40, 30));
    let settled = |renderer: &mut Renderer| {
        renderer.set_channels(&scene.views()).unwrap();
        crate::harness::settle(renderer, &plain, scene);
        read(renderer)
    };
    let before = settled(&mut renderer);
    let all: Vec<u32> = (0..).take(scene.channels().count()).collect();
    let count = 1..=all.len();
    let order = (Just(all.clone()).prop_shuffle(), count);
    let looks = prop::collection::vec(channel(), all.len());
    let config = Config {
        cases,
        failure_persistence: None,
        ..Config::default()
    };
    // The same cases each time: a frame takes long where a processor draws it.
    let rng = TestRng::deterministic_rng(RngAlgorithm::ChaCha);
    let mut runner = TestRunner::new_with_rng(config, rng);
    let renderer = std::cell::RefCell::new((renderer, Met::default()));
    let all_views = (view(&scene.volume), order, looks);
    runner
        .run(&all_views, |(view, (order, count), looks)| {
            let shown = order.into_iter().take(count).zip(looks);
            let shown = shown.map(|(channel, look)| ChannelView { channel, ..look });
            let (renderer, met) = &mut *renderer.borrow_mut();
            draw(renderer, scene, &view, &shown.collect::<Vec<_>>(), met)
        })
        .unwrap();
    let (mut renderer, met) = renderer.into_inner();
    for _ in 0..40 {
        // The level of detail that memory asked for falls again.
        frame(&mut renderer, &plain);
    }
    let after = settled(&mut renderer);
    let db = crate::harness::psnr(&before, &after);
    assert!(db > 60.0, "{db:.1} dB");
    Some(met)
}

#[test]
fn no_view_hangs_or_breaks_anything() {
    if let Some(met) = fuzz(&tissue(), 96) {
        assert!(met.seen * 8 > met.cases && met.telling > 8, "{met:?}");
    }
}

#[test]
fn no_view_of_several_channels_hangs_or_breaks_anything() {
    if let Some(met) = fuzz(&stained(), 64) {
        assert!(met.seen * 8 > met.cases && met.telling > 2, "{met:?}");
        assert!(met.several * 4 > met.cases, "{met:?}");
    }
}

/// Numbers that are none must not reach the picture: with a background that every value differs from, only what is drawn or
/// the background itself can be seen.
#[test]
fn cameras_that_are_none_show_the_background() {
    let Some(gpu) = gpu() else { return };
    let scene = tissue();
    let volume: &Arc<Volume> = &scene.volume;
    let mut renderer = Renderer::new(&gpu, volume.clone(), RendererOptions::default()).unwrap();
    renderer.set_transfer_function(&scene.transfer);
    let plain = View {
        background: [0.0, 0.0, 1.0],
        ..View::new(Camera::around(volume), UVec2::new(24, 18))
    };
    crate::harness::settle(&mut renderer, &plain, &scene);
    let is_background = |renderer: &Renderer| {
        let picture = read(renderer);
        let blue = |p: &[u8]| p == [0, 0, 255, 255];
        picture.rgba.chunks_exact(4).all(blue)
    };
    assert!(!is_background(&renderer), "the volume is seen otherwise");
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let mut cameras = vec![plain.camera; 4];
        cameras[0].target = Point::new(DVec3::new(0.0, bad, 0.0));
        cameras[1].distance_nm = bad;
        cameras[2].yaw = bad;
        cameras[3].fov = bad;
        for camera in cameras {
            frame(&mut renderer, &View { camera, ..plain });
            assert!(is_background(&renderer), "{camera:?}");
        }
    }
}
