//! Volumes as large as they can be, and views that nobody should ask for.

use std::sync::Arc;

use glam::{DVec3, UVec2, UVec3};
use saccade_core::brick::{BRICK_BORDER, BRICK_EDGE, BRICK_STORED_EDGE, BRICK_STORED_VOXELS};
use saccade_core::camera::Camera;
use saccade_core::page_table::PageTableShape;
use saccade_core::space::Point;
use saccade_core::transfer::ColorMap;
use saccade_core::volume::{Polarity, Volume};
use saccade_core::voxel_box::VoxelBox;
use saccade_render::{BrickVoxels, Renderer, RendererOptions, View};

use crate::behaviour::{SIZE, front, renderer};
use crate::harness::{frame, gpu, psnr, read};
use crate::scene::{ramp, waves};

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
