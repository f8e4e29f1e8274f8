//! Volumes given by a function, straight into a renderer.

use std::sync::Arc;

use anyhow::{Result, bail};
use glam::{DVec3, IVec3, UVec3};
use saccade_core::brick::{BRICK_BORDER, BRICK_EDGE, BRICK_STORED_EDGE, BrickId};
use saccade_core::transfer::{ColorMap, OpacityPoint, TransferFunction};
use saccade_core::volume::{Polarity, Volume};
use saccade_core::voxel_box::VoxelBox;
use saccade_render::{BrickVoxels, FrameReport, Renderer, RendererOptions, View};

use crate::clock::DrawClock;

/// Bricks of any level.
pub(crate) trait Bricks {
    /// The voxels of a brick with its border; `None` where nothing was acquired.
    fn brick(&self, id: BrickId) -> Option<Vec<u8>>;
}

/// All levels in main memory. Voxels outside repeat the nearest one inside.
pub(crate) struct Arrays {
    pub(crate) volume: Arc<Volume>,
    /// Per level, x fastest.
    pub(crate) levels: Vec<Vec<u8>>,
}

impl Arrays {
    /// `value` of each level-0 voxel; coarser levels are averages of the next finer one.
    pub(crate) fn new(extent: UVec3, voxel_nm: DVec3, value: impl Fn(UVec3) -> u8) -> Result<Self> {
        let volume = Volume::new("bench", extent, voxel_nm)?;
        let mut levels = vec![VoxelBox::of_size(extent).iter().map(value).collect()];
        for pair in volume.levels.windows(2) {
            let finer: &Vec<u8> = &levels[levels.len() - 1];
            let down = (pair[1].downsampling / pair[0].downsampling).as_uvec3();
            let average = |voxel: UVec3| {
                let covered = VoxelBox::new(voxel * down, (voxel + 1) * down);
                let covered = covered.intersection(VoxelBox::of_size(pair[0].extent));
                let values = covered.iter().map(|v| finer[flat(v, pair[0].extent)]);
                let sum: u64 = values.map(u64::from).sum();
                u8::try_from((sum + covered.voxels() / 2) / covered.voxels().max(1))
                    .unwrap_or(u8::MAX)
            };
            let coarser = VoxelBox::of_size(pair[1].extent).iter().map(average);
            levels.push(coarser.collect());
        }
        Ok(Self {
            volume: Arc::new(volume),
            levels,
        })
    }
}

impl Bricks for Arrays {
    fn brick(&self, id: BrickId) -> Option<Vec<u8>> {
        let level = id.level() as usize;
        let extent = self.volume.levels[level].extent;
        let low = (id.brick() * BRICK_EDGE).as_ivec3() - BRICK_BORDER.cast_signed();
        let cells = VoxelBox::of_size(UVec3::splat(BRICK_STORED_EDGE)).iter();
        let voxels = cells.map(|cell| {
            let at = (low + cell.as_ivec3()).clamp(IVec3::ZERO, extent.as_ivec3() - 1);
            self.levels[level][flat(at.as_uvec3(), extent)]
        });
        Some(voxels.collect())
    }
}

fn flat(voxel: UVec3, extent: UVec3) -> usize {
    ((voxel.z * extent.y + voxel.y) * extent.x + voxel.x) as usize
}

/// Bright matter from `low` on, opaque at `high`.
pub(crate) fn ramp(low: f32, high: f32, opacity: f32, nm: f64) -> TransferFunction {
    let point = |value, opacity| OpacityPoint { value, opacity };
    TransferFunction {
        polarity: Polarity::Bright,
        color_map: ColorMap::Gray,
        window: [0.0, 1.0],
        opacity: vec![point(low, 0.0), point(high, opacity)],
        opacity_length_nm: nm,
    }
}

/// Draws and delivers until all that a view needs is resident.
pub(crate) fn settle(
    renderer: &mut Renderer,
    view: &View,
    bricks: &(impl Bricks + Sync),
) -> Result<FrameReport> {
    Ok(settle_loading(renderer, view, bricks)?.0)
}

/// The same; also tells which bricks were delivered.
pub(crate) fn settle_loading(
    renderer: &mut Renderer,
    view: &View,
    bricks: &(impl Bricks + Sync),
) -> Result<(FrameReport, Vec<BrickId>)> {
    let mut delivered = Vec::new();
    for _ in 0..2_000 {
        renderer.render(view);
        let Some(report) = pollster::block_on(renderer.finish()).pop() else {
            continue;
        };
        if report.is_complete() && !report.redraw {
            // The octree may still be growing: as many frames as that takes, and more.
            for _ in 0..8 {
                renderer.render(view);
                pollster::block_on(renderer.finish());
            }
            renderer.render(view);
            let last = pollster::block_on(renderer.finish()).pop();
            let last = last.ok_or_else(|| anyhow::anyhow!("a frame without a report"))?;
            return Ok((last, delivered));
        }
        for (&id, voxels) in report.misses.iter().zip(all_bricks(bricks, &report.misses)) {
            let voxels = voxels
                .as_deref()
                .map_or(BrickVoxels::Empty, BrickVoxels::Voxels);
            renderer.deliver(id, voxels)?;
            delivered.push(id);
        }
    }
    bail!("the view does not settle")
}

/// Bricks, by all cores.
pub(crate) fn all_bricks(source: &(impl Bricks + Sync), ids: &[BrickId]) -> Vec<Option<Vec<u8>>> {
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let per_thread = ids.len().div_ceil(threads).max(1);
    std::thread::scope(|scope| {
        let parts = ids
            .chunks(per_thread)
            .map(|ids| scope.spawn(move || ids.iter().map(|id| source.brick(*id)).collect()));
        let parts: Vec<_> = parts.collect();
        let done = parts.into_iter().map(|part| match part.join() {
            Ok(bricks) => bricks,
            Err(panic) => std::panic::resume_unwind(panic),
        });
        done.collect::<Vec<Vec<_>>>().concat()
    })
}

/// What one frame takes, from asking for it until it is drawn \[ms\].
pub(crate) fn frame_ms(renderer: &mut Renderer, view: &View) -> f64 {
    let start = DrawClock::start(renderer.gpu());
    renderer.render(view);
    pollster::block_on(renderer.finish());
    start.ms()
}

/// Options with which all that arrived is in the octree before the next frame: for rows that measure what is there, not how it
/// gets there.
pub(crate) fn at_once() -> RendererOptions {
    RendererOptions {
        nodes_per_frame: u64::from(u32::MAX),
        ..RendererOptions::default()
    }
}
