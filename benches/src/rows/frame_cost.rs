//! What a frame costs besides drawing: processor time, and the upkeep of tables and octree.

use anyhow::{Result, ensure};
use glam::{UVec2, UVec3};
use saccade_core::brick::{BrickId, bricks_of};
use saccade_core::camera::Camera;
use saccade_core::voxel_box::VoxelBox;
use saccade_render::{BrickVoxels, Gpu, Renderer, RendererOptions, Traversal, View};

use crate::bricks::{all_bricks, ramp, settle};
use crate::cpu;
use crate::report::Row;
use crate::settings::Settings;
use crate::volumes::{DataSet, Tissue};

pub(crate) const CPU_IDS: &[&str] = &["render.cpu_ms_16ch"];
pub(crate) const OCTREE_IDS: &[&str] = &["render.octree_us_per_brick"];

/// Processor time of the thread that draws, a frame, with sixteen channels and a camera that moves.
///
/// On drivers that draw on the CPU, other threads do that. What the driver does when commands are submitted counts.
pub(crate) fn cpu_time(settings: &Settings) -> Result<Vec<Row>> {
    const FRAMES: u32 = 100;
    const RUNS: usize = 5;
    let gpu = &pollster::block_on(Gpu::headless())?;
    let scale = settings.scale(gpu);
    let case = DataSet::CycifSmall.case(scale, 16)?;
    let options = RendererOptions {
        memory_bytes: 4 << 30,
        ..RendererOptions::default()
    };
    let mut renderer = Renderer::new(gpu, case.formula.volume.clone(), options)?;
    renderer.set_channels(&case.views)?;
    let camera = Camera::around(&case.formula.volume);
    let view = |degrees: f64| View::new(camera.orbited(degrees, 0.0), UVec2::new(64, 48));
    for degrees in [0.0, 1.0, 2.0] {
        settle(&mut renderer, &view(degrees), &case.formula)?;
    }
    let mut runs = Vec::new();
    for _ in 0..RUNS {
        let before = cpu::of_thread()?;
        for frame in 0..FRAMES {
            renderer.render(&view(2.0 * f64::from(frame) / f64::from(FRAMES)));
            pollster::block_on(renderer.finish());
        }
        let spent = cpu::of_thread()?.saturating_sub(before);
        runs.push(spent.as_secs_f64() * 1e3 / f64::from(FRAMES));
    }
    let row = Row::new(CPU_IDS[0], "ms of the drawing thread a frame", runs)
        .setting("channels", 16)
        .setting("data", "all resident; the camera turns from frame to frame")
        .setting("frames a run", FRAMES);
    Ok(vec![row])
}

/// Bricks that arrive between two frames.
const BATCHES: [usize; 4] = [1, 8, 64, 512];
/// Bricks handed over for each size of batch.
const PER_BATCH: [usize; 4] = [64, 256, 1024, 4096];

/// What a brick that arrives costs the thread that draws, by how many arrive between two frames and by the volume's size; with
/// the octree, and with page tables alone.
pub(crate) fn octree() -> Result<Vec<Row>> {
    let gpu = &pollster::block_on(Gpu::headless())?;
    let extents = [
        UVec3::new(4_096, 4_096, 512),
        UVec3::new(120_000, 120_000, 15_000),
        UVec3::new(2_000_000, 2_000_000, 250_000),
    ];
    let mut row = Row::new(
        OCTREE_IDS[0],
        "µs of the drawing thread a brick, with the octree",
        vec![0.0],
    );
    for extent in extents {
        let tissue = Tissue::new(extent)?;
        let voxels = all_bricks(&tissue, &block(&tissue, 8)?);
        let [with, without] = [Traversal::ResidencyOctree, Traversal::PageTables]
            .map(|traversal| arrivals(gpu, &tissue, &voxels, traversal));
        let (with, without) = (with?, without?);
        let name = |what: &str| format!("{} x {} x {}: {what}", extent.x, extent.y, extent.z);
        let told = |costs: &[f64]| {
            let costs = BATCHES.iter().zip(costs);
            let costs: Vec<_> = costs.map(|(n, us)| format!("{us:.1} by {n}")).collect();
            costs.join(", ")
        };
        let pairs = with.per_brick.iter().zip(&without.per_brick);
        let of_octree: Vec<_> = pairs.map(|(a, b)| a - b).collect();
        eprintln!(
            "  {}; page tables alone {}",
            name(&told(&with.per_brick)),
            told(&without.per_brick)
        );
        row = row
            .setting(&name("µs a brick"), told(&with.per_brick))
            .setting(&name("of it for the octree"), told(&of_octree))
            .setting(
                &name("longest frame after 2048 bricks at once, and one without, ms"),
                format!("{:.2}, {:.2}", with.burst_ms, with.idle_us / 1e3),
            )
            .with_runs(vec![with.per_brick[2]]);
    }
    Ok(vec![row.setting(
        "the row is",
        "64 bricks between two frames in the largest volume",
    )])
}

/// Bricks of level 0 in a block in the middle of a volume, `edge` to a side and half as many deep.
fn block(tissue: &Tissue, edge: u32) -> Result<Vec<BrickId>> {
    let all = bricks_of(tissue.volume.levels[0].extent);
    let low = (all - UVec3::new(edge, edge, edge / 2)) / 2;
    let places = VoxelBox::new(low, low + UVec3::new(edge, edge, edge / 2)).iter();
    let ids = places.map(|at| Ok(BrickId::new(0, 0, at)?));
    ids.collect()
}

/// Processor time that arriving bricks take.
#[derive(Debug, Default)]
struct Cost {
    /// By size of batch \[µs\].
    per_brick: Vec<f64>,
    /// Of a frame before which nothing arrived \[µs\].
    idle_us: f64,
    /// The longest frame after as many bricks at once as are ever handed over \[ms\].
    burst_ms: f64,
}

fn arrivals(
    gpu: &Gpu,
    tissue: &Tissue,
    voxels: &[Option<Vec<u8>>],
    traversal: Traversal,
) -> Result<Cost> {
    let options = RendererOptions {
        traversal,
        ..RendererOptions::default()
    };
    let mut renderer = Renderer::new(gpu, tissue.volume.clone(), options)?;
    renderer.set_transfer_function(&ramp(0.0, 1.0, 0.9, 200.0));
    // Of the whole volume, of which nothing is delivered: frames cost nearly nothing.
    let view = View::new(Camera::around(&tissue.volume), UVec2::new(16, 12));
    let frame = |renderer: &mut Renderer| -> Result<f64> {
        let before = cpu::of_thread()?;
        renderer.render(&view);
        let spent = cpu::of_thread()?.saturating_sub(before);
        pollster::block_on(renderer.finish());
        Ok(spent.as_secs_f64() * 1e6)
    };
    let idle: Vec<_> = (0..60)
        .map(|_| frame(&mut renderer))
        .collect::<Result<_>>()?;
    let mut cost = Cost {
        idle_us: median(&idle[10..]),
        ..Cost::default()
    };
    let mut ids = block(tissue, 32)?.into_iter();
    let mut hand_over = |renderer: &mut Renderer, count: usize| -> Result<f64> {
        let ids: Vec<_> = ids.by_ref().take(count).collect();
        ensure!(ids.len() == count, "too few bricks");
        let before = cpu::of_thread()?;
        for (id, voxels) in ids.into_iter().zip(voxels.iter().cycle()) {
            let voxels = voxels.as_deref();
            renderer.deliver(id, voxels.map_or(BrickVoxels::Empty, BrickVoxels::Voxels))?;
        }
        let spent = cpu::of_thread()?.saturating_sub(before);
        Ok(spent.as_secs_f64() * 1e6)
    };
    for (batch, count) in BATCHES.into_iter().zip(PER_BATCH) {
        let mut spent = 0.0;
        for _ in 0..count / batch {
            spent += hand_over(&mut renderer, batch)?;
            spent += frame(&mut renderer)? - cost.idle_us;
        }
        cost.per_brick.push(spent / count as f64);
    }
    hand_over(&mut renderer, 2048)?;
    for _ in 0..40 {
        cost.burst_ms = cost.burst_ms.max(frame(&mut renderer)? / 1e3);
    }
    Ok(cost)
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or_default()
}
