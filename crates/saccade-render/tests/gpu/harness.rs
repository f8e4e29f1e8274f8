//! One device for all tests, and the loop that a streaming client runs.

use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use saccade_core::brick::BrickId;
use saccade_render::{BrickVoxels, Delivery, FrameReport, Gpu, Image, Renderer, View};

use crate::scene::Scene;

/// The device, for one test at a time; `None`, with a message, where there is none.
pub(crate) fn gpu() -> Option<MutexGuard<'static, Gpu>> {
    static GPU: OnceLock<Option<Mutex<Gpu>>> = OnceLock::new();
    let gpu = GPU.get_or_init(|| match pollster::block_on(Gpu::headless()) {
        Ok(gpu) => Some(Mutex::new(gpu)),
        Err(error) => {
            let required = std::env::var("SACCADE_GPU_TESTS").is_ok_and(|v| v == "require");
            assert!(!required, "SACCADE_GPU_TESTS=require, but: {error}");
            #[expect(
                clippy::print_stderr,
                reason = "the only way to say that a test is skipped"
            )]
            {
                eprintln!("skipped: {error}");
            }
            None
        }
    });
    Some(gpu.as_ref()?.lock().unwrap_or_else(PoisonError::into_inner))
}

/// Draws one frame and waits for what it says.
pub(crate) fn frame(renderer: &mut Renderer, view: &View) -> FrameReport {
    let frame = renderer.render(view);
    let mut reports = pollster::block_on(renderer.finish());
    let report = reports
        .pop()
        .expect("one frame at a time always has its report");
    assert_eq!(report.frame, frame);
    report
}

/// The same, until the octree knows all that was delivered.
pub(crate) fn caught_up(renderer: &mut Renderer, view: &View) -> FrameReport {
    for _ in 0..200 {
        let report = frame(renderer, view);
        if report.octree_is_current {
            return report;
        }
    }
    panic!("the octree is behind after 200 frames");
}

/// Delivers one brick of the scene.
pub(crate) fn deliver(renderer: &mut Renderer, scene: &Scene, id: BrickId) -> Delivery {
    let delivered = match scene.brick(id) {
        Some(voxels) => renderer.deliver(id, BrickVoxels::Voxels(&voxels)),
        None => renderer.deliver(id, BrickVoxels::Empty),
    };
    delivered.unwrap()
}

/// Draws and delivers until the picture is complete; returns all reports.
pub(crate) fn settle(renderer: &mut Renderer, view: &View, scene: &Scene) -> Vec<FrameReport> {
    let mut reports = Vec::new();
    for _ in 0..200 {
        let report = frame(renderer, view);
        for &id in &report.misses {
            deliver(renderer, scene, id);
        }
        reports.push(report);
        if reports.last().unwrap().is_complete() {
            return reports;
        }
    }
    panic!(
        "not complete after 200 frames: {:?}",
        reports.last().unwrap()
    );
}

pub(crate) fn read(renderer: &Renderer) -> Image {
    pollster::block_on(renderer.read_pixels()).unwrap()
}

/// Peak signal to noise of colours \[dB\].
pub(crate) fn psnr(a: &Image, b: &Image) -> f64 {
    assert_eq!(a.size, b.size);
    let squares = a
        .rgba
        .iter()
        .zip(&b.rgba)
        .map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2));
    // Opacities are all alike: a quarter of the sum's terms say nothing.
    let mean = squares.sum::<f64>() / (a.rgba.len() as f64 * 0.75);
    10.0 * (255.0_f64.powi(2) / mean.max(1e-6)).log10()
}

/// Writes a picture where `SACCADE_GPU_TEST_IMAGES` says, if it does.
pub(crate) fn keep(name: &str, image: &Image) {
    if let Some(dir) = std::env::var_os("SACCADE_GPU_TEST_IMAGES") {
        let path = std::path::Path::new(&dir).join(format!("{name}.png"));
        let buffer = image::RgbaImage::from_raw(image.size.x, image.size.y, image.rgba.clone());
        buffer.unwrap().save(path).unwrap();
    }
}
