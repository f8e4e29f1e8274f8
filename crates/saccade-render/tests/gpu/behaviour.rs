//! What must hold besides the picture being right.

use std::sync::Arc;

use glam::{DVec3, UVec2, UVec3};
use saccade_core::brick::{BRICK_STORED_VOXELS, BrickId};
use saccade_core::camera::Camera;
use saccade_core::page_table::PageTableShape;
use saccade_core::transfer::{ColorMap, TransferFunction};
use saccade_core::volume::{Polarity, Volume};
use saccade_render::{
    BrickVoxels, Delivery, DeliveryError, FrameReport, Gpu, Renderer, RendererError,
    RendererOptions, Traversal, View,
};

use crate::harness::{frame, gpu, read, settle};
use crate::scene::{Scene, ramp, tissue, waves};

pub(crate) const SIZE: UVec2 = UVec2::new(48, 40);

pub(crate) fn renderer(gpu: &Gpu, scene: &Scene, options: RendererOptions) -> Renderer {
    let mut renderer = Renderer::new(gpu, scene.volume.clone(), options).unwrap();
    renderer.set_transfer_function(&scene.transfer);
    renderer
}

pub(crate) fn close_up(scene: &Scene) -> View {
    View::new(Camera::around(&scene.volume).zoomed(3.0), SIZE)
}

/// Delivers bricks full of one value for whatever is missing, until nothing is.
fn settle_constant(renderer: &mut Renderer, view: &View, value: u8) -> FrameReport {
    let voxels = vec![value; BRICK_STORED_VOXELS];
    for _ in 0..100 {
        let report = frame(renderer, view);
        if report.is_complete() {
            return report;
        }
        for &id in &report.misses {
            renderer.deliver(id, BrickVoxels::Voxels(&voxels)).unwrap();
        }
    }
    panic!("not complete after 100 frames");
}

pub(crate) fn front(volume: &Volume) -> Camera {
    Camera {
        yaw: 0.0,
        pitch: 0.0,
        ..Camera::around(volume)
    }
}

#[test]
fn all_levels_of_a_constant_volume_transmit_what_they_should() {
    let Some(gpu) = gpu() else { return };
    let transfer = ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 0.2)], 100.0);
    let voxel_nm = DVec3::new(4.0, 4.0, 20.0);
    let volume = Arc::new(Volume::new("v", UVec3::new(300, 200, 40), voxel_nm).unwrap());
    let transmitted = 0.8_f64.powf(40.0 * 20.0 / 100.0);
    let mut steps = Vec::new();
    let traversals = [Traversal::PageTables, Traversal::ResidencyOctree];
    for (traversal, lod_bias) in traversals
        .into_iter()
        .flat_map(|t| [-2.0, 0.0, 1.0, 2.0, 3.0].map(|bias| (t, bias)))
    {
        let options = RendererOptions {
            traversal,
            ..RendererOptions::default()
        };
        let mut renderer = Renderer::new(&gpu, volume.clone(), options).unwrap();
        renderer.set_transfer_function(&transfer);
        let camera = Camera {
            fov: 0.5,
            distance_nm: 60_000.0,
            ..front(&volume)
        };
        let background = [1.0, 1.0, 1.0];
        let view = View {
            lod_bias,
            background,
            ..View::new(camera, UVec2::splat(8))
        };
        let report = settle_constant(&mut renderer, &view, 1);
        steps.push(report.statistics.samples);
        // Value 1 is all but black, so what is seen is what the white background sends through.
        let linear = transmitted + (1.0 - transmitted) * f64::from(transfer.table()[1][0]);
        let want = 255.0 * (1.055 * linear.powf(1.0 / 2.4) - 0.055);
        for pixel in read(&renderer).rgba.chunks_exact(4) {
            let off = (f64::from(pixel[0]) - want).abs();
            assert!(
                off <= 1.0,
                "bias {lod_bias}: {} instead of {want}",
                pixel[0]
            );
        }
    }
    assert!(
        steps[0] > 2 * steps[4],
        "the steps were meant to differ: {steps:?}"
    );
    assert_eq!(steps[5..], [0; 5], "all alike, and nothing to sample");
}

#[test]
fn two_and_three_steps_of_page_tables_give_the_same_picture() {
    let Some(gpu) = gpu() else { return };
    let scene = tissue();
    let view = View::new(Camera::around(&scene.volume).zoomed(1.6), SIZE);
    let shapes = [(2, 16), (2, 2), (3, 2), (3, 16)];
    let pictures = shapes.map(|(depth, block_edge)| {
        let page_table_shape = Some(PageTableShape { depth, block_edge });
        let options = RendererOptions {
            page_table_shape,
            ..RendererOptions::default()
        };
        let mut renderer = renderer(&gpu, &scene, options);
        settle(&mut renderer, &view, &scene);
        (read(&renderer), renderer.memory().tables_resident)
    });
    for (picture, _) in &pictures {
        assert!(picture == &pictures[0].0, "pictures differ by page table");
    }
    assert!(
        pictures[2].1 > pictures[1].1,
        "the third step has tables of its own"
    );
}

#[test]
fn frames_in_bands_are_the_same() {
    let Some(gpu) = gpu() else { return };
    let scene = waves();
    let view = View::new(Camera::around(&scene.volume), UVec2::new(37, 61));
    let pictures = [1, 3, 100].map(|bands| {
        let mut renderer = renderer(
            &gpu,
            &scene,
            RendererOptions {
                bands,
                ..Default::default()
            },
        );
        let last = settle(&mut renderer, &view, &scene).pop().unwrap();
        (read(&renderer), last.statistics)
    });
    assert!(pictures.iter().all(|p| p == &pictures[0]));
}

#[test]
fn what_the_transfer_function_hides_is_not_sampled() {
    let Some(gpu) = gpu() else { return };
    let scene = waves();
    let view = close_up(&scene);
    let mut renderer = renderer(&gpu, &scene, RendererOptions::default());
    let shown = settle(&mut renderer, &view, &scene).pop().unwrap();
    assert!(shown.statistics.samples > 0);
    let hidden = TransferFunction {
        opacity: Vec::new(),
        ..scene.transfer.clone()
    };
    let before = read(&renderer);
    renderer.set_transfer_function(&hidden);
    let report = frame(&mut renderer, &view);
    assert!(report.is_complete());
    assert_eq!(report.statistics.samples, 0);
    assert_eq!(report.statistics.lookups, 0, "hidden bricks are not needed");
    assert!(
        read(&renderer)
            .rgba
            .chunks_exact(4)
            .all(|p| p == [0, 0, 0, 255])
    );
    renderer.set_transfer_function(&scene.transfer);
    assert!(
        frame(&mut renderer, &view).is_complete(),
        "they stay while there is room: the next change may show them"
    );
    assert!(read(&renderer) == before);
}

#[test]
fn reports_never_hold_up_frames() {
    let Some(gpu) = gpu() else { return };
    let scene = waves();
    let view = View::new(Camera::around(&scene.volume), SIZE);
    let mut renderer = renderer(&gpu, &scene, RendererOptions::default());
    let frames: Vec<u64> = (0..10).map(|_| renderer.render(&view)).collect();
    assert_eq!(frames, (1..=10).collect::<Vec<_>>());
    let reports = pollster::block_on(renderer.finish());
    let reported: Vec<u64> = reports.iter().map(|r| r.frame).collect();
    assert_eq!(
        reported,
        [1, 2, 3],
        "the first three had a buffer each, the others go unreported"
    );
    assert!(renderer.poll().is_empty());
    assert_eq!(frame(&mut renderer, &view).frame, 11);
}

#[test]
fn mistakes_are_told() {
    let Some(gpu) = gpu() else { return };
    let scene = waves();
    let mut renderer = renderer(&gpu, &scene, RendererOptions::default());
    let id = BrickId::new(0, 0, UVec3::new(9, 0, 0)).unwrap();
    let empty = renderer.deliver(id, BrickVoxels::Empty);
    assert_eq!(empty, Err(DeliveryError::NoSuchBrick { id }));
    let other_channel = BrickId::new(1, 0, UVec3::ZERO).unwrap();
    assert!(renderer.deliver(other_channel, BrickVoxels::Empty).is_err());
    let id = BrickId::new(0, 0, UVec3::ZERO).unwrap();
    let short = renderer.deliver(id, BrickVoxels::Voxels(&[1, 2, 3]));
    assert!(matches!(short, Err(DeliveryError::Length { got: 3, .. })));
    let nothing = vec![0; BRICK_STORED_VOXELS];
    assert_eq!(
        renderer.deliver(id, BrickVoxels::Voxels(&nothing)),
        Ok(Delivery::Empty)
    );

    let new = |volume: &Arc<Volume>, options| Renderer::new(&gpu, volume.clone(), options).err();
    let small = RendererOptions {
        memory_bytes: 10_000,
        ..Default::default()
    };
    assert!(matches!(
        new(&scene.volume, small),
        Some(RendererError::Ceiling { .. })
    ));
    let page_table_shape = Some(PageTableShape {
        depth: 2,
        block_edge: 12,
    });
    let odd = RendererOptions {
        page_table_shape,
        ..Default::default()
    };
    assert!(matches!(
        new(&scene.volume, odd),
        Some(RendererError::PageTableShape { .. })
    ));
}

#[test]
fn a_lost_device_is_noticed_and_nobody_waits_for_it() {
    if gpu().is_none() {
        return;
    }
    let gpu = pollster::block_on(Gpu::headless()).unwrap();
    let scene = waves();
    let view = View::new(Camera::around(&scene.volume), SIZE);
    let mut renderer = renderer(&gpu, &scene, RendererOptions::default());
    frame(&mut renderer, &view);
    assert!(!gpu.is_lost());
    gpu.device().destroy();
    renderer.render(&view);
    assert!(pollster::block_on(renderer.finish()).is_empty());
    assert!(pollster::block_on(renderer.read_pixels()).is_err());
    assert!(gpu.is_lost());
}
