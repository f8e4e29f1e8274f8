//! The renderer against other ways to draw the same picture, all resident.

use std::sync::Arc;

use anyhow::{Result, ensure};
use glam::{DVec3, UVec2, UVec3};
use saccade_core::brick::{BRICK_BORDER, BRICK_EDGE, BRICK_STORED_EDGE, BrickId};
use saccade_core::camera::Camera;
use saccade_core::phantom::Phantom;
use saccade_core::space::Point;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_render::{Gpu, Renderer, RendererOptions, Traversal, View};
use serde_json::json;

use crate::bricks::{Arrays, Bricks, at_once, frame_ms, ramp, settle};
use crate::dense::{Dense, rays};
use crate::report::Row;
use crate::settings::Settings;
use crate::volumes::Scale;

pub(crate) const DENSE_IDS: &[&str] = &["render.vs_dense_texture"];
pub(crate) const SMALL_IDS: &[&str] = &["render.888pb_vs_8gb"];
pub(crate) const PAGE_TABLES_IDS: &[&str] = &[
    "render.kingsnake_1ch.vs_hiding_page_tables",
    "render.kingsnake_1ch.samples_vs_page_tables",
];

const RUNS: usize = 9;

/// The picture, and how many times as long the edges of volumes are as where a processor draws.
fn sizes(scale: Scale) -> (UVec2, u32) {
    match scale {
        Scale::Small => (UVec2::new(160, 120), 1),
        Scale::Medium => (UVec2::new(400, 300), 2),
        Scale::Paper => (UVec2::new(1024, 768), 4),
    }
}

/// Room for all voxels of so large a volume, its coarser levels and the octree.
fn room_for(extent: UVec3) -> RendererOptions {
    let options = at_once();
    let voxels = VoxelBox::of_size(extent).voxels();
    RendererOptions {
        memory_bytes: options.memory_bytes.max(3 * voxels),
        ..options
    }
}

/// Ratios of pairs that were measured one right after the other.
fn ratios(mut ours: impl FnMut() -> f64, mut theirs: impl FnMut() -> f64) -> [Vec<f64>; 3] {
    let pairs: Vec<_> = (0..RUNS).map(|_| (ours(), theirs())).collect();
    [
        pairs.iter().map(|(a, b)| a / b).collect(),
        pairs.iter().map(|(a, _)| *a).collect(),
        pairs.iter().map(|(_, b)| *b).collect(),
    ]
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn renderer(
    gpu: &Gpu,
    volume: &Arc<Volume>,
    options: RendererOptions,
    view: &View,
    bricks: &(impl Bricks + Sync),
    transfer: &saccade_core::transfer::TransferFunction,
) -> Result<(Renderer, saccade_render::Statistics)> {
    let mut renderer = Renderer::new(gpu, volume.clone(), options)?;
    renderer.set_transfer_function(transfer);
    let report = settle(&mut renderer, view, bricks)?;
    ensure!(report.is_complete(), "the view was not resident");
    Ok((renderer, report.statistics))
}

/// The price of virtual memory: dense tissue, nothing to skip, everything at level 0.
pub(crate) fn vs_dense_texture(settings: &Settings) -> Result<Vec<Row>> {
    let gpu = &pollster::block_on(Gpu::headless())?;
    let (size, edge) = sizes(settings.scale(gpu));
    let extent = UVec3::new(192, 192, 48) * edge;
    let voxel_nm = DVec3::new(4.0, 4.0, 16.0);
    let phantom = Phantom::new(1, voxel_nm)?;
    let mut sampler = phantom.sampler();
    let mut voxels = vec![0; extent.as_usizevec3().element_product()];
    for (row, values) in (0..).zip(voxels.chunks_exact_mut(extent.x as usize)) {
        sampler.row(0, row % extent.y, row / extent.y, values);
    }
    let at = |v: UVec3| voxels[((v.z * extent.y + v.y) * extent.x + v.x) as usize];
    let arrays = Arrays::new(extent, voxel_nm, at)?;
    let transfer = ramp(0.0, 1.0, 0.3, 100.0);
    let view = View {
        lod_bias: -20.0,
        ..View::new(Camera::around(&arrays.volume).zoomed(1.3), size)
    };
    let options = room_for(extent);
    let (mut ours, statistics) = renderer(gpu, &arrays.volume, options, &view, &arrays, &transfer)?;
    let tables = RendererOptions {
        traversal: Traversal::PageTables,
        ..options
    };
    let (mut tables, _) = renderer(gpu, &arrays.volume, tables, &view, &arrays, &transfer)?;
    let tables: Vec<f64> = (0..RUNS).map(|_| frame_ms(&mut tables, &view)).collect();
    let dense = Dense::new(gpu, &arrays, &transfer, &view);
    dense.frame_ms();
    let [ratios, ours, theirs] = ratios(|| frame_ms(&mut ours, &view), || dense.frame_ms());
    let ours = median(ours);
    let mut rays = rays(&arrays, &transfer, &view);
    rays["renderer"] = json!({ "samples": statistics.samples, "ms": ours });
    settings.json(&rays, "dense_texture.rays")?;
    let row = Row::new("render.vs_dense_texture", "ours over theirs", ratios)
        .setting("picture", format!("{}x{}", size.x, size.y))
        .setting(
            "volume",
            format!("{} x {} x {} voxels, tissue", extent.x, extent.y, extent.z),
        )
        .setting("transfer function", "a linear ramp: nothing is hidden")
        .setting("ours_ms", ours)
        .setting("theirs_ms", median(theirs))
        .setting("page_tables_alone_ms", median(tables))
        .setting("samples", statistics.samples)
        .setting("nodes", statistics.nodes);
    Ok(vec![row])
}

/// A box of waves somewhere in a volume of which nothing else was acquired.
struct Island {
    volume: Arc<Volume>,
    /// Middle of the box \[level-0 voxels\].
    middle: DVec3,
    /// Half its size.
    half: DVec3,
}

impl Bricks for Island {
    fn brick(&self, id: BrickId) -> Option<Vec<u8>> {
        let down = self.volume.levels[id.level() as usize].downsampling;
        let low = (id.brick() * BRICK_EDGE).as_dvec3() - f64::from(BRICK_BORDER);
        let nearest = (low * down).max(self.middle - self.half);
        let end = (low + f64::from(BRICK_STORED_EDGE)) * down;
        if nearest.cmpge(end.min(self.middle + self.half)).any() {
            return None;
        }
        let cells = VoxelBox::of_size(UVec3::splat(BRICK_STORED_EDGE)).iter();
        let voxels = cells.map(|cell| {
            let at = (low + cell.as_dvec3() + 0.5) * down - self.middle;
            let wave = (at.x / 9.0).sin() + (at.y / 7.0).cos() + (at.z / 2.0).sin();
            let inside = at.abs().cmplt(self.half).all();
            #[expect(clippy::cast_possible_truncation, reason = "between 8 and 248")]
            #[expect(clippy::cast_sign_loss, reason = "between 8 and 248")]
            let value = (128.0 + 40.0 * wave) as u8;
            if inside { value } else { 0 }
        });
        Some(voxels.collect())
    }
}

/// The same box and view in a volume of 888 PB and in one of 8 GB.
pub(crate) fn vs_small_volume(settings: &Settings) -> Result<Vec<Row>> {
    let gpu = &pollster::block_on(Gpu::headless())?;
    let (size, _) = sizes(settings.scale(gpu));
    let size = size / 2;
    let voxel_nm = DVec3::new(5.0, 5.0, 40.0);
    let transfer = ramp(0.3, 0.8, 0.7, 40.0);
    let places = [
        (
            UVec3::new(2_000_000, 2_000_000, 250_000),
            DVec3::new(1_573_888.0, 1_836_032.0, 197_632.0),
        ),
        (
            UVec3::new(4_096, 4_096, 512),
            DVec3::new(2048.0, 2048.0, 256.0),
        ),
    ];
    let prepared = places.map(|(extent, middle)| {
        let volume = Arc::new(Volume::new("bench", extent, voxel_nm)?);
        let island = Island {
            volume: volume.clone(),
            middle,
            half: DVec3::new(200.0, 200.0, 25.0),
        };
        let camera = Camera {
            target: Point::new(middle * voxel_nm),
            distance_nm: 1_000.0,
            ..Camera::around(&volume)
        };
        let view = View::new(camera, size);
        let options = at_once();
        let (renderer, _) = renderer(gpu, &volume, options, &view, &island, &transfer)?;
        anyhow::Ok((renderer, view))
    });
    let [large, small] = prepared;
    let ((mut large, view), (mut small, small_view)) = (large?, small?);
    let shape = large.memory();
    let [ratios, ours, theirs] = ratios(
        || frame_ms(&mut large, &view),
        || frame_ms(&mut small, &small_view),
    );
    let row = Row::new("render.888pb_vs_8gb", "large over small", ratios)
        .setting("picture", format!("{}x{}", size.x, size.y))
        .setting(
            "volumes",
            "2,000,000 x 2,000,000 x 250,000 and 4,096 x 4,096 x 512 voxels",
        )
        .setting(
            "data",
            "a box of 400 x 400 x 50 voxels in each, elsewhere nothing acquired",
        )
        .setting("ours_ms", median(ours))
        .setting("theirs_ms", median(theirs))
        .setting("octree blocks of the large one", shape.node_blocks_used);
    Ok(vec![row])
}

/// A thin, bright, coiled tube in matter that is dim and noisy, and nowhere zero: what the
/// scan of a snake in its egg is like.
fn snake(extent: UVec3) -> impl Fn(UVec3) -> u8 {
    let middle = extent.as_dvec3() / 2.0;
    let radius = middle.x * 0.6;
    let pitch = f64::from(extent.z) / 4.0;
    move |voxel| {
        let at = voxel.as_dvec3() + 0.5 - middle;
        let around = at.y.atan2(at.x) / std::f64::consts::TAU;
        let turn = ((at.z / pitch - around).fract() + 1.5).fract() - 0.5;
        let off = (at.truncate().length() - radius).hypot(turn * pitch);
        let vertebra = (around * 120.0).sin();
        let [x, y, z] = voxel.to_array();
        let hash =
            x.wrapping_mul(73_856_093) ^ y.wrapping_mul(19_349_663) ^ z.wrapping_mul(83_492_791);
        let noise = u8::try_from(hash.wrapping_mul(2_654_435_761) >> 28).unwrap_or(0);
        let inside = (at / middle).length() < 0.95;
        match off < 3.5 + vertebra {
            true => 190 + 3 * noise,
            false if inside => 40 + 2 * noise,
            false => 4 + noise,
        }
    }
}

pub(crate) fn vs_page_tables(settings: &Settings) -> Result<Vec<Row>> {
    let gpu = &pollster::block_on(Gpu::headless())?;
    let (size, edge) = sizes(settings.scale(gpu));
    let extent = UVec3::new(256, 256, 192) * edge;
    let arrays = Arrays::new(extent, DVec3::splat(1000.0), snake(extent))?;
    let transfer = ramp(0.55, 0.7, 0.9, 1000.0);
    let view = View {
        lod_bias: -20.0,
        ..View::new(Camera::around(&arrays.volume).zoomed(1.2), size)
    };
    let prepare = |traversal| {
        let options = RendererOptions {
            traversal,
            ..room_for(extent)
        };
        renderer(gpu, &arrays.volume, options, &view, &arrays, &transfer)
    };
    let (mut ours, with) = prepare(Traversal::ResidencyOctree)?;
    let (mut theirs, without) = prepare(Traversal::PageTables)?;
    let samples = without.samples as f64 / with.samples.max(1) as f64;
    let [ratios, theirs, ours] = ratios(
        || frame_ms(&mut theirs, &view),
        || frame_ms(&mut ours, &view),
    );
    let row = |id, runs| {
        Row::new(id, "theirs over ours", runs)
            .setting("picture", format!("{}x{}", size.x, size.y))
            .setting(
                "volume",
                format!(
                    "{} x {} x {} voxels: a thin coil in dim noise",
                    extent.x, extent.y, extent.z
                ),
            )
            .setting(
                "theirs",
                "page tables; whole bricks that the transfer function hides are skipped",
            )
    };
    Ok(vec![
        row(PAGE_TABLES_IDS[0], ratios)
            .setting("ours_ms", median(ours))
            .setting("theirs_ms", median(theirs)),
        row(PAGE_TABLES_IDS[1], vec![samples])
            .setting("samples", with.samples)
            .setting("nodes", with.nodes)
            .setting("lookups", with.lookups),
    ])
}
