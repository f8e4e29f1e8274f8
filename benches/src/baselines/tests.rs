use glam::{DVec3, UVec2, UVec3};
use saccade_core::camera::Camera;
use saccade_core::transfer::ColorMap;
use saccade_core::volume::Dtype;
use saccade_render::{ChannelView, Gpu, Renderer, RendererOptions, View};

use super::{Baseline, Method, Work};
use crate::bricks::{ramp, settle};
use crate::dense::tests::{gpu, psnr};
use crate::volumes::Formula;

/// Waves in odd extents, with nothing in one corner.
fn waves(dtype: Dtype, channels: u32) -> (Formula, Vec<ChannelView>) {
    let extent = UVec3::new(151, 93, 61);
    let value = |channel, at: DVec3| {
        let k = 1.0 + 0.3 * f64::from(channel);
        let wave =
            (k * at.x / 9.0).sin() + (at.y / 7.0).cos() + (k * at.z / 5.0 + at.x / 19.0).sin();
        let nothing = at.x > 90.0 && at.y < 40.0;
        if nothing { 0.0 } else { 0.5 + 0.15 * wave }
    };
    let formula = Formula::new(extent, DVec3::new(4.0, 4.0, 10.0), dtype, channels, value).unwrap();
    let colors = [ColorMap::Gray, ColorMap::Green, ColorMap::Magenta];
    let views = (0..channels).map(|channel| {
        let mut transfer = ramp(0.55, 0.9, 0.6, 40.0);
        transfer.color_map = colors[channel as usize];
        ChannelView::new(channel, transfer)
    });
    (formula, views.collect())
}

fn product(gpu: &Gpu, formula: &Formula, views: &[ChannelView], view: &View) -> Vec<u8> {
    let mut renderer =
        Renderer::new(gpu, formula.volume.clone(), RendererOptions::default()).unwrap();
    renderer.set_channels(views).unwrap();
    settle(&mut renderer, view, formula).unwrap();
    pollster::block_on(renderer.read_pixels()).unwrap().rgba
}

fn baseline(
    gpu: &Gpu,
    (formula, views): (&Formula, &[ChannelView]),
    view: &View,
    method: Method,
    start_level: u32,
) -> (Vec<u8>, Work, Baseline) {
    let volume = &formula.volume;
    let mut baseline = Baseline::new(gpu, volume, views, method, start_level, 64 << 20).unwrap();
    let work = baseline.settle(view, formula).unwrap();
    baseline.frames(view, 1).unwrap();
    (baseline.pixels(), work, baseline)
}

#[test]
fn every_shader_is_valid_without_any_optional_feature() {
    for method in Method::ALL {
        for channels in [1, 16] {
            let source = super::caster::shader(method, channels);
            let module = naga::front::wgsl::parse_str(&source)
                .unwrap_or_else(|e| panic!("{}", e.emit_to_string(&source)));
            let mut validator = naga::valid::Validator::new(
                naga::valid::ValidationFlags::all(),
                naga::valid::Capabilities::empty(),
            );
            validator
                .validate(&module)
                .unwrap_or_else(|e| panic!("{}", e.emit_to_string(&source)));
        }
    }
}

/// Several levels in one picture, several channels, both voxel types.
#[test]
fn every_baseline_draws_the_products_picture() {
    let Some(gpu) = gpu() else { return };
    for (dtype, channels) in [(Dtype::Uint8, 1), (Dtype::Uint8, 3), (Dtype::Uint16, 2)] {
        let (formula, views) = waves(dtype, channels);
        let camera = Camera::around(&formula.volume).zoomed(1.2);
        let view = View {
            lod_bias: -0.8,
            ..View::new(camera, UVec2::new(64, 48))
        };
        let want = product(&gpu, &formula, &views, &view);
        for method in Method::ALL {
            let start_levels: &[u32] = if method.is_octree() {
                &[u32::MAX, 1]
            } else {
                &[0]
            };
            for &start_level in start_levels {
                let scene = (&formula, &views[..]);
                let (got, work, _) = baseline(&gpu, scene, &view, method, start_level);
                let db = psnr(&got, &want);
                assert!(db >= 45.0, "{method:?}, {dtype:?} x {channels}: {db:.1} dB");
                assert!(work.samples > 0 && work.rays > 0);
            }
        }
        let turned = View {
            camera: camera.orbited(2.0, 0.0),
            ..view
        };
        let scene = (&formula, &views[..]);
        let (other, ..) = baseline(&gpu, scene, &turned, Method::PageTables, 0);
        let db = psnr(&other, &want);
        assert!(db < 42.0, "turned: {db:.1} dB");
    }
}

/// What tells the methods apart, in numbers.
#[test]
fn baselines_differ_as_they_should() {
    let Some(gpu) = gpu() else { return };
    let (formula, views) = waves(Dtype::Uint8, 1);
    let view = View {
        lod_bias: -20.0,
        ..View::new(Camera::around(&formula.volume), UVec2::new(60, 44))
    };
    let scene = (&formula, &views[..]);
    let [tables, hiding, restart, stack] =
        Method::BY_BRICK.map(|method| baseline(&gpu, scene, &view, method, u32::MAX).1);
    assert_eq!(tables.rays, restart.rays);
    assert!(hiding.samples <= tables.samples && restart.samples <= hiding.samples);
    assert_eq!(restart.samples, stack.samples);
    assert!(
        stack.work < restart.work,
        "{} of {}",
        stack.work,
        restart.work
    );
    assert!(tables.per_ray[0] >= 1 && restart.per_ray[0] >= tables.per_ray[0]);
    assert!(
        restart.bricks > hiding.bricks,
        "octrees need the levels above as well"
    );
    assert_eq!(restart.bricks, stack.bricks);
    // The same samples of the same bricks, with a search for each.
    for (method, by_brick) in [
        (Method::SampledPageTables, tables),
        (Method::SampledOctree, stack),
    ] {
        let sampled = baseline(&gpu, scene, &view, method, u32::MAX).1;
        assert_eq!(sampled.bricks, by_brick.bricks);
        // A sample between two bricks may be either's, by the last digit.
        let differ = sampled.samples.abs_diff(by_brick.samples);
        assert!(differ < by_brick.samples / 1000, "{sampled:?}");
        assert!(sampled.work > 4 * by_brick.work, "{sampled:?}");
    }
    // The last brick that is there is not enough.
    let mut few = Baseline::new(
        &gpu,
        &formula.volume,
        &views,
        Method::PageTables,
        0,
        100_000,
    )
    .unwrap();
    assert!(few.settle(&view, &formula).is_err());
}
