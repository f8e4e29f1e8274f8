use glam::{DVec3, UVec3};
use saccade_core::brick::BRICK_STORED_VOXELS;
use saccade_core::camera::Camera;
use saccade_core::page_table::PageTableShape;
use saccade_core::transfer::{ColorMap, OpacityPoint};

use super::*;
use crate::delivery::BrickVoxels;
use crate::layout::Counting;

/// The test adapter. Without one the test is skipped, unless `SACCADE_GPU_TESTS=require`.
fn test_gpu() -> Option<Gpu> {
    let gpu = pollster::block_on(Gpu::headless());
    let required = std::env::var("SACCADE_GPU_TESTS").is_ok_and(|v| v == "require");
    assert!(gpu.is_ok() || !required, "SACCADE_GPU_TESTS=require");
    gpu.ok()
}

fn views(channels: std::ops::Range<u32>, polarity: Polarity) -> Vec<ChannelView> {
    let transfer = TransferFunction {
        polarity,
        color_map: ColorMap::Gray,
        window: [0.0, 1.0],
        opacity: vec![OpacityPoint {
            value: 0.0,
            opacity: 0.1,
        }],
        opacity_length_nm: 100.0,
    };
    channels
        .map(|channel| ChannelView::new(channel, transfer.clone()))
        .collect()
}

/// One frame, and what it says.
fn frame(renderer: &mut Renderer, view: &View) -> FrameReport {
    renderer.render(view);
    let reports = pollster::block_on(renderer.finish());
    reports.into_iter().next_back().expect("a report")
}

/// A volume of as many channels, with room for so few page table blocks that other channels cost some theirs.
fn crowded(gpu: &Gpu, channels: usize) -> (Renderer, View) {
    let volume = Volume::new("v", UVec3::splat(40), DVec3::splat(4.0)).unwrap();
    let volume = Arc::new(Volume {
        channels: (0..channels).map(|n| format!("c{n}")).collect(),
        ..volume
    });
    let options = RendererOptions {
        memory_bytes: 3 << 20,
        page_table_shape: Some(PageTableShape {
            depth: 2,
            block_edge: 16,
        }),
        ..RendererOptions::default()
    };
    let view = View {
        lod_bias: -20.0,
        ..View::new(Camera::around(&volume), UVec2::new(16, 12))
    };
    let renderer = Renderer::new(gpu, volume, options).unwrap();
    (renderer, view)
}

/// Bricks that lose their slots to page tables of other channels are not thought to be there, whatever else happens before
/// the next brick comes.
#[test]
fn evictions_before_a_change_of_polarity_are_noted() {
    let Some(gpu) = test_gpu() else { return };
    let (mut renderer, view) = crowded(&gpu, 16);
    let voxels = vec![90; BRICK_STORED_VOXELS];
    renderer
        .set_channels(&views(0..5, Polarity::Bright))
        .unwrap();
    for _ in 0..20 {
        for id in frame(&mut renderer, &view).misses {
            let voxels = BrickVoxels::Voxels(&voxels);
            renderer.deliver(id, voxels).unwrap();
        }
    }
    let resident = |renderer: &Renderer| {
        let ids = (0..16).flat_map(|channel| renderer.memory.resident(channel));
        let mut ids: Vec<_> = ids.collect();
        ids.sort_unstable();
        ids
    };
    let before = resident(&renderer);
    renderer
        .set_channels(&views(5..13, Polarity::Bright))
        .unwrap();
    frame(&mut renderer, &view);
    frame(&mut renderer, &view);
    assert!(
        resident(&renderer).len() < before.len(),
        "no brick lost its slot"
    );
    renderer
        .set_channels(&views(5..13, Polarity::Dark))
        .unwrap();
    let octree = renderer.octree.as_mut().unwrap();
    octree.advance(u64::MAX / 2);
    let noted = octree.noted();
    assert_eq!(noted, resident(&renderer), "the octree knows of others");
}

/// Many bricks at once are worked into the octree a few at a time, and all of them in the end.
#[test]
fn a_burst_of_bricks_is_spread_over_frames() {
    let Some(gpu) = test_gpu() else { return };
    let extent = UVec3::new(330, 290, 150);
    let volume = Volume::new("v", extent, DVec3::splat(4.0)).unwrap();
    let volume = Arc::new(volume);
    let options = RendererOptions {
        memory_bytes: 64 << 20,
        ..RendererOptions::default()
    };
    let mut renderer = Renderer::new(&gpu, Arc::clone(&volume), options).unwrap();
    renderer
        .set_channels(&views(0..1, Polarity::Bright))
        .unwrap();
    let view = View::new(Camera::around(&volume), UVec2::new(8, 8));
    assert!(frame(&mut renderer, &view).octree_is_current, "of nothing");
    // Values that no two regions have in common.
    let noise: Vec<u8> = (0..BRICK_STORED_VOXELS)
        .map(|i| u8::try_from(i * 7919 / 13 % 251).unwrap())
        .collect();
    let bricks = saccade_core::brick::bricks_of(extent);
    for brick in saccade_core::voxel_box::VoxelBox::of_size(bricks).iter() {
        let id = BrickId::new(0, 0, brick).unwrap();
        renderer.deliver(id, BrickVoxels::Voxels(&noise)).unwrap();
    }
    // What one brick takes, or one step of a change.
    let brick = 1024;
    let mut frames = 0;
    loop {
        let visited = |renderer: &Renderer| renderer.octree.as_ref().unwrap().visited();
        let before = visited(&renderer);
        let report = frame(&mut renderer, &view);
        frames += 1;
        let visits = visited(&renderer) - before;
        let most = RendererOptions::default().nodes_per_frame + brick;
        assert!(visits <= most, "{visits} visits before frame {frames}");
        if report.octree_is_current {
            break;
        }
        assert!(frames < 200, "it never ends");
    }
    assert!(frames > 5, "{frames} frames are not many");
    let octree = renderer.octree.as_ref().unwrap();
    let resident: Vec<_> = renderer.memory.resident(0).collect();
    assert_eq!(octree.noted().len(), resident.len());
    assert!(octree.residency_is_complete());
}

/// What is counted does not depend on how.
#[test]
fn rays_are_counted_alike_alone_and_by_groups() {
    let count = |counting, pixels| {
        let gpu = test_gpu()?;
        gpu.count(counting);
        let (mut renderer, view) = crowded(&gpu, 1);
        let size = UVec2::new(pixels, 13);
        let view = View { size, ..view };
        renderer
            .set_channels(&views(0..1, Polarity::Bright))
            .unwrap();
        let voxels = vec![90; BRICK_STORED_VOXELS];
        let mut counted = Vec::new();
        for _ in 0..6 {
            let report = frame(&mut renderer, &view);
            // The finest level stays away: others stand in.
            for id in report.misses.iter().filter(|id| id.level() > 0) {
                let voxels = BrickVoxels::Voxels(&voxels);
                renderer.deliver(*id, voxels).unwrap();
            }
            counted.push((report.statistics, report.fidelity));
        }
        Some(counted)
    };
    let Some(alone) = count(Counting::ByRays, 19) else {
        return;
    };
    let groups = count(Counting::ByGroups, 19).expect("there was one");
    assert_eq!(alone, groups);
    let (last, fidelity) = alone[5];
    assert!(last.samples > 0 && last.rays > 0 && last.lookups > 0 && last.nodes > 0);
    assert!(last.substituted > 0 && fidelity.substituted_levels > 0);
    assert!(fidelity.level.is_some(), "{fidelity:?}");
    let [fewest, most] = last.lookups_per_ray;
    assert!(fewest <= most && most > 0, "{last:?}");
    let narrower = count(Counting::ByGroups, 18).expect("there was one");
    assert_ne!(alone, narrower, "the comparison notices a column");
}

/// While a variant is compiled another draws, and nobody can tell.
#[test]
fn a_stand_in_draws_the_same_picture() {
    let Some(gpu) = test_gpu() else { return };
    let (mut renderer, view) = crowded(&gpu, 3);
    let voxels: Vec<u8> = (0..BRICK_STORED_VOXELS)
        .map(|i| u8::try_from(i / 34 % 34 * 7 + i % 5).unwrap())
        .collect();
    let settle = |renderer: &mut Renderer| {
        for _ in 0..20 {
            for id in frame(renderer, &view).misses {
                let voxels = BrickVoxels::Voxels(&voxels);
                renderer.deliver(id, voxels).unwrap();
            }
        }
        pollster::block_on(renderer.read_pixels()).unwrap()
    };
    let wanted = |channels| {
        let mode = mode_of(Mode::EmissionAbsorption);
        Variant::new(channels, mode, false, crate::layout::FALSE_NONE, false)
    };
    // Three channels are compiled for at once: nothing could stand in.
    renderer
        .set_channels(&views(0..3, Polarity::Bright))
        .unwrap();
    let three = settle(&mut renderer);
    assert!(gpu.ray_caster().is_ready(wanted(3)) && !gpu.ray_caster().is_ready(wanted(1)));
    gpu.ray_caster().compile_in_background();
    renderer
        .set_channels(&views(0..1, Polarity::Bright))
        .unwrap();
    renderer.render(&view);
    let stood_in = !gpu.ray_caster().is_ready(wanted(1));
    pollster::block_on(renderer.finish());
    let first = pollster::block_on(renderer.read_pixels()).unwrap();
    let mut looks = 0;
    let next = wanted(1).likely_next(3);
    let ready = |variant: &Variant| gpu.ray_caster().is_ready(*variant);
    while !(ready(&wanted(1)) && next.iter().all(ready)) {
        looks += 1;
        assert!(looks < 15_000, "it is never compiled");
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    let own = settle(&mut renderer);
    assert!(stood_in, "it was there before the frame was");
    let differences = first.rgba.iter().zip(&own.rgba);
    let most = differences.map(|(a, b)| a.abs_diff(*b)).max();
    assert!(most <= Some(1), "{most:?} apart");
    assert!(own.rgba.chunks(4).any(|p| p[0] > 30), "something is seen");
    assert!(three != own, "the comparison notices channels");
}
