use glam::{DVec3, UVec3};
use saccade_core::brick::BRICK_STORED_VOXELS;
use saccade_core::camera::Camera;
use saccade_core::page_table::PageTableShape;
use saccade_core::transfer::{ColorMap, OpacityPoint};

use super::*;
use crate::delivery::BrickVoxels;

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
