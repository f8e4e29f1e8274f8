//! What is there, what stands in for what is not, and what does not fit.

use std::sync::Arc;

use glam::{DVec3, UVec3};
use saccade_core::brick::{BRICK_STORED_VOXELS, BrickId};
use saccade_core::camera::Camera;
use saccade_core::transfer::{ColorMap, TransferFunction};
use saccade_core::volume::{Polarity, Volume};
use saccade_core::voxel_box::VoxelBox;
use saccade_render::{
    BrickVoxels, ChannelError, ChannelView, Delivery, FalseColors, FrameReport, Gpu, Renderer,
    RendererError, RendererOptions, View,
};

use crate::behaviour::{SIZE, close_up, renderer};
use crate::harness::{deliver, frame, gpu, psnr, read, settle};
use crate::scene::{ramp, tissue, waves};

#[test]
fn misses_end_and_come_front_first() {
    let Some(gpu) = gpu() else { return };
    let scene = tissue();
    let view = View {
        lod_bias: -1.0,
        ..close_up(&scene)
    };
    let mut renderer = renderer(&gpu, &scene, RendererOptions::default());
    let reports = settle(&mut renderer, &view, &scene);
    assert!(
        reports[0].misses.is_empty() && reports[0].redraw,
        "first the tables"
    );
    let first = reports.iter().find(|r| !r.misses.is_empty()).unwrap();
    let coarsest = u32::try_from(scene.volume.levels.len() - 1).unwrap();
    assert_eq!(
        first.misses[0].level(),
        coarsest,
        "one brick that shows everything, at once"
    );
    let again = frame(&mut renderer, &view);
    assert!(again.is_complete() && again.misses.is_empty());
    assert_eq!(again.fidelity.substituted_levels, 0);
    let total: usize = reports.iter().map(|r| r.misses.len()).sum();
    assert!(
        total as u32 <= renderer.memory().brick_slots * 2,
        "bricks were asked for in vain"
    );
}

#[test]
fn coarser_bricks_stand_in_and_say_so() {
    let Some(gpu) = gpu() else { return };
    let scene = tissue();
    let coarsest = u32::try_from(scene.volume.levels.len() - 1).unwrap();
    let mut renderer = renderer(&gpu, &scene, RendererOptions::default());
    deliver(
        &mut renderer,
        &scene,
        BrickId::new(0, coarsest, UVec3::ZERO).unwrap(),
    );
    let view = close_up(&scene);
    let report = frame(&mut renderer, &view);
    let substituted = read(&renderer);
    assert!(report.fidelity.missing > 0 && report.statistics.substituted > 0);
    assert_eq!(report.fidelity.level, Some(0));
    assert_eq!(report.fidelity.substituted_levels, coarsest);

    frame(
        &mut renderer,
        &View {
            false_colors: FalseColors::Residency,
            ..view
        },
    );
    let tinted = read(&renderer);
    let red = |image: &saccade_render::Image| {
        image
            .rgba
            .chunks_exact(4)
            .map(|p| i64::from(p[0]) - i64::from(p[2]))
            .sum::<i64>()
    };
    assert!(
        red(&tinted) > red(&substituted) + 1000,
        "far substitutes are red"
    );

    frame(
        &mut renderer,
        &View {
            substitute: false,
            ..view
        },
    );
    let skipped = read(&renderer);
    assert!(
        skipped.rgba.chunks_exact(4).all(|p| p == [0, 0, 0, 255]),
        "nothing stands in"
    );

    settle(&mut renderer, &view, &scene);
    let complete = read(&renderer);
    let [near, far] = [psnr(&substituted, &complete), psnr(&skipped, &complete)];
    assert!(
        near > far,
        "a substitute ({near:.1} dB) is better than nothing ({far:.1} dB)"
    );
}

#[test]
fn a_change_of_polarity_asks_for_the_bricks_again() {
    let Some(gpu) = gpu() else { return };
    let scene = waves();
    let view = close_up(&scene);
    let mut renderer = renderer(&gpu, &scene, RendererOptions::default());
    settle(&mut renderer, &view, &scene);
    renderer.set_transfer_function(&TransferFunction {
        polarity: Polarity::Dark,
        ..scene.transfer.clone()
    });
    assert_eq!(renderer.memory().bricks_resident, 0);
    assert!(!frame(&mut renderer, &view).is_complete());
}

#[test]
fn changed_bricks_stay_until_their_replacement_comes() {
    let Some(gpu) = gpu() else { return };
    let scene = tissue();
    let view = close_up(&scene);
    let mut renderer = renderer(&gpu, &scene, RendererOptions::default());
    settle(&mut renderer, &view, &scene);
    let before = read(&renderer);
    renderer.invalidate(VoxelBox::of_size(UVec3::new(90, 90, 20)));
    let report = frame(&mut renderer, &view);
    assert!(!report.is_complete() && report.fidelity.stale > 0 && !report.misses.is_empty());
    assert!(read(&renderer) == before, "the picture flickers");
    for &id in &report.misses {
        let delivered = renderer.deliver(id, BrickVoxels::Empty).unwrap();
        assert_eq!(delivered, Delivery::Empty);
    }
    frame(&mut renderer, &view);
    assert!(read(&renderer) != before, "the change is seen");
    settle(&mut renderer, &view, &scene);
}

#[test]
fn bricks_out_of_date_on_arrival_are_drawn_and_missed_again() {
    let Some(gpu) = gpu() else { return };
    let scene = tissue();
    let view = close_up(&scene);
    let mut renderer = renderer(&gpu, &scene, RendererOptions::default());
    settle(&mut renderer, &view, &scene);
    let right = read(&renderer);
    renderer.invalidate(VoxelBox::of_size(scene.volume.extent()));
    let mut missed = frame(&mut renderer, &view).misses;
    assert!(!missed.is_empty());
    // Out of date and empty, then out of date with voxels: neither may end the asking.
    let voxels = vec![200; BRICK_STORED_VOXELS];
    for content in [BrickVoxels::Empty, BrickVoxels::Voxels(&voxels)] {
        for &id in &missed {
            renderer.deliver_outdated(id, content).unwrap();
        }
        let report = frame(&mut renderer, &view);
        assert!(!report.is_complete() && !report.misses.is_empty());
        assert!(psnr(&read(&renderer), &right) < 40.0, "they are drawn");
        missed = report.misses;
    }
    settle(&mut renderer, &view, &scene);
    let db = psnr(&read(&renderer), &right);
    assert!(db > 50.0, "replacements came for all of them: {db} dB");
}

#[test]
fn a_working_set_that_does_not_fit_becomes_coarser_and_settles() {
    let Some(gpu) = gpu() else { return };
    let transfer = ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 0.01)], 100.0);
    let extent = UVec3::new(700, 600, 300);
    let volume = Arc::new(Volume::new("v", extent, DVec3::splat(4.0)).unwrap());
    let memory_bytes = 5 << 20;
    let options = RendererOptions {
        memory_bytes,
        ..RendererOptions::default()
    };
    let mut renderer = Renderer::new(&gpu, volume.clone(), options).unwrap();
    renderer.set_transfer_function(&transfer);
    let voxels = vec![100; BRICK_STORED_VOXELS];
    let run = |renderer: &mut Renderer, view: &View, frames| {
        let mut delivered = Vec::new();
        let mut reports: Vec<FrameReport> = Vec::new();
        for _ in 0..frames {
            let report = frame(renderer, view);
            assert!(report.memory.total() <= memory_bytes);
            let bricks = report.misses.iter().filter(|&&id| {
                let brick = BrickVoxels::Voxels(&voxels);
                renderer.deliver(id, brick).unwrap() == Delivery::Resident
            });
            delivered.push(bricks.count());
            reports.push(report);
        }
        (reports, delivered)
    };

    let view = View {
        lod_bias: -2.5,
        ..View::new(Camera::around(&volume).zoomed(1.5), SIZE)
    };
    let (reports, delivered) = run(&mut renderer, &view, 60);
    let last = reports.last().unwrap();
    assert!(last.memory_bias > 0.0, "all fits: {:?}", last.statistics);
    assert!(last.is_complete(), "{last:?}");
    assert!(
        reports[30..]
            .iter()
            .all(|r| r.memory_bias == last.memory_bias),
        "the bias swings"
    );
    assert_eq!(
        delivered[45..].iter().sum::<usize>(),
        0,
        "bricks come and go: {delivered:?}"
    );
    assert!(!last.redraw);

    let far = View {
        camera: view.camera.zoomed(0.01),
        ..view
    };
    let (reports, _) = run(&mut renderer, &far, 120);
    assert_eq!(
        reports.last().unwrap().memory_bias,
        0.0,
        "it falls again where it can"
    );
}

/// As a client that draws only when there is a reason to.
#[test]
fn reasons_to_draw_lead_to_a_complete_picture() {
    let Some(gpu) = gpu() else { return };
    let transfer = ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 0.01)], 100.0);
    let extent = UVec3::new(500, 400, 300);
    let volume = Arc::new(Volume::new("v", extent, DVec3::splat(4.0)).unwrap());
    let voxels = vec![100; BRICK_STORED_VOXELS];
    for memory_bytes in [4 << 20, 5 << 20, 256 << 20] {
        let options = RendererOptions {
            memory_bytes,
            ..RendererOptions::default()
        };
        let mut renderer = Renderer::new(&gpu, volume.clone(), options).unwrap();
        renderer.set_transfer_function(&transfer);
        for zoom in [1.5, 0.02, 4.0] {
            let camera = Camera::around(&volume).zoomed(zoom);
            let view = View {
                lod_bias: -2.0,
                ..View::new(camera, SIZE)
            };
            let mut reason = true;
            let mut last = None;
            for _ in 0..100 {
                if !std::mem::take(&mut reason) {
                    break;
                }
                let report = frame(&mut renderer, &view);
                reason |= report.redraw;
                for &id in &report.misses {
                    renderer.deliver(id, BrickVoxels::Voxels(&voxels)).unwrap();
                    reason = true;
                }
                last = Some(report);
            }
            let last = last.unwrap();
            assert!(
                last.is_complete(),
                "{memory_bytes} bytes, zoom {zoom}: {last:?}"
            );
            assert!(!reason, "there is always a reason");
            assert_eq!(
                last.memory_bias > 0.0,
                memory_bytes < 10 << 20 && zoom > 1.0
            );
        }
    }
}

/// Draws and delivers until the picture is complete or nothing changes any more.
fn run(renderer: &mut Renderer, view: &View) -> FrameReport {
    let voxels: Vec<u8> = (0..BRICK_STORED_VOXELS)
        .map(|i| 100 + (i % 90) as u8)
        .collect();
    for _ in 0..100 {
        let report = frame(renderer, view);
        assert!(report.memory.total() <= report.memory.ceiling);
        if report.is_complete() || report.starved {
            return report;
        }
        for &id in &report.misses {
            renderer.deliver(id, BrickVoxels::Voxels(&voxels)).unwrap();
        }
    }
    panic!("neither complete nor starved after 100 frames");
}

fn within(gpu: &Gpu, volume: &Arc<Volume>, memory_bytes: u64) -> Result<Renderer, RendererError> {
    let picture_bytes = u64::from(SIZE.element_product()) * 4;
    let options = RendererOptions {
        memory_bytes,
        picture_bytes,
        ..RendererOptions::default()
    };
    Renderer::new(gpu, volume.clone(), options)
}

/// So that all of a volume is seen.
fn see_through(channels: u32) -> Vec<ChannelView> {
    let transfer = ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 0.01)], 1e5);
    let view = |channel| ChannelView::new(channel, transfer.clone());
    (0..channels).map(view).collect()
}

/// The least ceiling that is named suffices for as many channels as are seen, wherever they are seen from.
#[test]
fn the_least_memory_counts_the_channels_that_are_seen() {
    let Some(gpu) = gpu() else { return };
    for extent in [[330, 290, 150], [1000, 990, 970], [1330, 1290, 1150]] {
        let volume = Volume::new("v", extent.into(), DVec3::splat(4.0)).unwrap();
        let volume = Arc::new(Volume {
            channels: (0..16).map(|n| format!("channel {n}")).collect(),
            ..volume
        });
        let Err(RendererError::Ceiling { needed, .. }) = within(&gpu, &volume, 1) else {
            panic!("a byte is too little");
        };
        let mut ceiling = needed;
        for seen in [1, 5, 16] {
            let mut renderer = within(&gpu, &volume, ceiling).unwrap();
            match renderer.set_channels(&see_through(seen)) {
                Ok(()) => {}
                Err(ChannelError::Memory {
                    got, most, needed, ..
                }) => {
                    assert!(most < seen as usize && got == seen as usize && needed > ceiling);
                    // What is seen stays.
                    assert_eq!(renderer.channels().len(), 0);
                    renderer.set_channels(&see_through(most as u32)).unwrap();
                    ceiling = needed;
                    renderer = within(&gpu, &volume, ceiling).unwrap();
                    renderer.set_channels(&see_through(seen)).unwrap();
                }
                Err(error) => panic!("{error}"),
            }
            for lod_bias in [-2.5, -1.0, 0.0, 9.0] {
                let view = View {
                    lod_bias,
                    ..View::new(Camera::around(&volume), SIZE)
                };
                let report = run(&mut renderer, &view);
                assert!(
                    report.is_complete(),
                    "{seen} channels of {extent:?}, {lod_bias}: {report:?}"
                );
            }
        }
        assert!(ceiling > needed, "16 channels need more than one");
        assert!(ceiling < 8 << 20, "{ceiling}");
    }
}

/// Where there is no coarser level, what would do is told, and does.
#[test]
fn what_does_not_fit_at_any_level_is_told() {
    let Some(gpu) = gpu() else { return };
    let volume = Volume::new("v", UVec3::new(330, 290, 150), DVec3::splat(4.0)).unwrap();
    let volume = Arc::new(Volume {
        levels: volume.levels[..1].to_vec(),
        ..volume
    });
    let view = View::new(Camera::around(&volume), SIZE);
    let mut renderer = within(&gpu, &volume, 5 << 20).unwrap();
    renderer.set_channels(&see_through(1)).unwrap();
    let report = run(&mut renderer, &view);
    assert!(report.starved && !report.is_complete() && !report.redraw);
    let near = View {
        camera: view.camera.zoomed(30.0),
        ..view
    };
    assert!(run(&mut renderer, &near).is_complete(), "a part of it fits");
    let enough = renderer.enough_memory().unwrap();
    assert!(enough > 20 << 20, "550 bricks do not fit {enough} bytes");
    let mut renderer = within(&gpu, &volume, enough).unwrap();
    renderer.set_channels(&see_through(1)).unwrap();
    assert!(run(&mut renderer, &view).is_complete());
}
