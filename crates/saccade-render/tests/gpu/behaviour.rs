//! What must hold besides the picture being right.

use std::sync::Arc;

use glam::{DVec3, UVec2, UVec3};
use saccade_core::brick::{
    BRICK_BORDER, BRICK_EDGE, BRICK_STORED_EDGE, BRICK_STORED_VOXELS, BrickId,
};
use saccade_core::camera::Camera;
use saccade_core::page_table::PageTableShape;
use saccade_core::space::Point;
use saccade_core::transfer::{ColorMap, TransferFunction};
use saccade_core::volume::{Polarity, Volume};
use saccade_core::voxel_box::VoxelBox;
use saccade_render::{
    BrickVoxels, Delivery, DeliveryError, FalseColors, FrameReport, Gpu, Renderer, RendererError,
    RendererOptions, Traversal, View,
};

use crate::harness::{deliver, frame, gpu, psnr, read, settle};
use crate::scene::{Scene, ramp, tissue, waves};

const SIZE: UVec2 = UVec2::new(48, 40);

fn renderer(gpu: &Gpu, scene: &Scene, options: RendererOptions) -> Renderer {
    let mut renderer = Renderer::new(gpu, scene.volume.clone(), options).unwrap();
    renderer.set_transfer_function(&scene.transfer);
    renderer
}

fn close_up(scene: &Scene) -> View {
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

fn front(volume: &Volume) -> Camera {
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

#[test]
fn huge_volumes_open_within_the_ceiling() {
    let Some(gpu) = gpu() else { return };
    let transfer = ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 0.1)], 100_000.0);
    let volumes = [
        (UVec3::new(32_768, 32_768, 4_096), 256 << 20, 2),
        (UVec3::new(2_000_000, 2_000_000, 250_000), 512 << 20, 3),
    ];
    for (extent, memory_bytes, depth) in volumes {
        let volume = Volume::new("v", extent, DVec3::new(5.0, 5.0, 40.0)).unwrap();
        let shape = PageTableShape::for_volume(&volume.levels, 1);
        assert_eq!(shape.depth, depth);
        let options = RendererOptions {
            memory_bytes,
            ..RendererOptions::default()
        };
        let mut renderer = Renderer::new(&gpu, Arc::new(volume), options).unwrap();
        renderer.set_transfer_function(&transfer);
        assert!(
            renderer.memory().total() <= memory_bytes,
            "{:?}",
            renderer.memory()
        );
        assert!(renderer.memory().brick_slots > 4000);

        // One voxel in a million was acquired: a box near the far corner, seen from nearby.
        let size = renderer.volume().size_nm();
        let target = Point::new(size * 0.9);
        let camera = Camera {
            target,
            distance_nm: 3_000.0,
            ..Camera::around(renderer.volume())
        };
        let view = View::new(camera, SIZE);
        let voxels = vec![200; BRICK_STORED_VOXELS];
        let levels = renderer.volume().levels.clone();
        let mut last = None;
        for _ in 0..60 {
            let report = frame(&mut renderer, &view);
            for &id in &report.misses {
                let level = &levels[id.level() as usize];
                let middle = extent.as_dvec3() * 0.9;
                let brick = level.voxels_from_box(id.voxels(level));
                let inside = VoxelBox::around(middle - 300.0, middle + 300.0).intersects(brick);
                let content = BrickVoxels::Voxels(&voxels);
                let content = if inside { content } else { BrickVoxels::Empty };
                renderer.deliver(id, content).unwrap();
            }
            let done = report.is_complete();
            last = Some(report);
            if done {
                break;
            }
        }
        let last = last.unwrap();
        assert!(last.is_complete(), "{extent}: {last:?}");
        let seen = read(&renderer)
            .rgba
            .chunks_exact(4)
            .filter(|p| p[0] > 20)
            .count();
        assert!(seen > 100, "{extent}: {seen} pixels show the box");
    }
}

/// What is seen depends on where the eye is within the matter, not on where that is in the volume.
#[test]
fn precision_is_the_same_everywhere_in_a_petascale_volume() {
    let Some(gpu) = gpu() else { return };
    let extent = UVec3::new(2_000_000, 2_000_000, 250_000);
    let voxel_nm = DVec3::new(5.0, 5.0, 40.0);
    let volume = Arc::new(Volume::new("v", extent, voxel_nm).unwrap());
    let transfer = ramp(
        Polarity::Bright,
        ColorMap::Gray,
        &[(0.3, 0.0), (0.8, 0.7)],
        40.0,
    );
    let matter = DVec3::new(200.0, 200.0, 25.0);
    // Whole bricks at every level that is close enough to be seen.
    let places = [
        DVec3::splat(1024.0),
        DVec3::new(1_573_888.0, 1_836_032.0, 197_632.0),
    ];
    let pictures = places.map(|middle| {
        let options = RendererOptions {
            memory_bytes: 64 << 20,
            ..RendererOptions::default()
        };
        let mut renderer = Renderer::new(&gpu, volume.clone(), options).unwrap();
        renderer.set_transfer_function(&transfer);
        let target = Point::new(middle * voxel_nm);
        let camera = Camera {
            target,
            distance_nm: 250.0,
            ..Camera::around(&volume)
        };
        let view = View {
            background: [0.3; 3],
            ..View::new(camera, SIZE)
        };
        for _ in 0..60 {
            let report = frame(&mut renderer, &view);
            if report.is_complete() {
                return (read(&renderer), report.statistics.samples);
            }
            for &id in &report.misses {
                let down = volume.levels[id.level() as usize].downsampling;
                let low = (id.brick() * BRICK_EDGE).as_dvec3() - f64::from(BRICK_BORDER);
                let cells = VoxelBox::of_size(UVec3::splat(BRICK_STORED_EDGE)).iter();
                let voxels: Vec<u8> = cells
                    .map(|cell| {
                        let at = (low + cell.as_dvec3() + 0.5) * down - middle;
                        let wave = (at.x / 9.0).sin() + (at.y / 7.0).cos() + (at.z / 2.0).sin();
                        let inside = at.abs().cmplt(matter).all();
                        if inside {
                            (128.0 + 40.0 * wave) as u8
                        } else {
                            0
                        }
                    })
                    .collect();
                renderer.deliver(id, BrickVoxels::Voxels(&voxels)).unwrap();
            }
        }
        panic!("not complete after 60 frames");
    });
    let [(near, samples), (far, _)] = &pictures;
    assert!(*samples > 10_000);
    crate::harness::keep("place-near", near);
    crate::harness::keep("place-far", far);
    let db = psnr(near, far);
    // With positions in plain f32 they would be 60 dB apart.
    assert!(db >= 80.0, "{db:.1} dB between the two places");
}

#[test]
fn impossible_views_end_in_background() {
    let Some(gpu) = gpu() else { return };
    let scene = waves();
    let mut renderer = renderer(&gpu, &scene, RendererOptions::default());
    let around = Camera::around(&scene.volume);
    let corner = Point::new(scene.volume.size_nm());
    let at = |xyz| Camera {
        target: Point::new(xyz),
        ..around
    };
    let cameras = [
        at(DVec3::NAN),
        at(DVec3::splat(f64::INFINITY)),
        at(DVec3::splat(1e300)),
        Camera { fov: 0.0, ..around },
        Camera {
            fov: 180.0,
            ..around
        },
        Camera {
            fov: 179.9,
            ..around
        },
        Camera {
            fov: 1e-9,
            ..around
        },
        Camera {
            distance_nm: 0.0,
            target: Point::new(DVec3::ZERO),
            ..front(&scene.volume)
        },
        Camera {
            distance_nm: 0.0,
            target: corner,
            ..around
        },
        Camera {
            distance_nm: 1e15,
            ..around
        },
        Camera {
            yaw: 90.0,
            pitch: 90.0,
            ..around
        },
        Camera {
            yaw: f64::NAN,
            ..around
        },
    ];
    for camera in cameras {
        for lod_bias in [0.0, -1e9, 1e9, f32::NAN] {
            let view = View {
                lod_bias,
                ..View::new(camera, UVec2::new(9, 7))
            };
            frame(&mut renderer, &view);
            let picture = read(&renderer);
            assert_eq!(picture.rgba.len(), 9 * 7 * 4);
            assert!(
                picture.rgba.chunks_exact(4).all(|p| p[3] == 255),
                "{view:?}"
            );
        }
    }
    for size in [
        UVec2::ZERO,
        UVec2::new(0, 5),
        UVec2::ONE,
        UVec2::new(1, 300),
    ] {
        frame(&mut renderer, &View::new(around, size));
        assert_eq!(renderer.size(), size.max(UVec2::ONE));
    }
    assert!(!gpu.is_lost());
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
