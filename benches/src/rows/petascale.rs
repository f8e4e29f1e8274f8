//! The tables and figures of \[000 §8\]: how page tables grow, how rays walk them, what a moving view loads, and how fast tissue
//! is drawn.

use std::collections::HashSet;

use anyhow::{Result, ensure};
use glam::{DVec2, DVec3, UVec2, UVec3};
use saccade_core::brick::BrickId;
use saccade_core::camera::Camera;
use saccade_core::levels::halving_levels;
use saccade_core::page_table::{PageTableShape, PageTables};
use saccade_core::space::Point;
use saccade_core::transfer::TransferFunction;
use saccade_core::volume::{Dtype, Volume};
use saccade_render::{ChannelView, FrameReport, Gpu, Renderer, RendererOptions, View};

use super::table_9_1::{Drawn, mean, time_of};
use crate::baselines::{Baseline, Method, Work};
use crate::bricks::{Bricks, at_once, ramp, settle_loading};
use crate::plot::{Axis, Plot};
use crate::report::Row;
use crate::settings::Settings;
use crate::volumes::{Formula, Scale, Tissue, plant};

pub(crate) const TABLE_1_IDS: &[&str] = &["page_tables.table_1_cells"];
pub(crate) const TABLE_2_IDS: &[&str] = &[
    "render.d1.linear_ramp_fps",
    "render.d1.semi_transparent_fps",
    "render.d2.linear_ramp_fps",
    "render.d2.semi_transparent_fps",
    "render.d3.linear_ramp_fps",
    "render.d3.semi_transparent_fps",
    "render.d4.linear_ramp_fps",
    "render.d4.semi_transparent_fps",
];
pub(crate) const FIGURE_6_IDS: &[&str] = &[
    "render.fig_6.entries_mean",
    "render.fig_6.entries_most",
    "render.fig_6.bricks_of_octree",
];
pub(crate) const FIGURE_7_IDS: &[&str] = &[
    "render.fig_7.entries_mean",
    "render.fig_7.bricks_of_octree",
    "render.fig_7.blocks_of_octree",
    "render.fig_7.nodes_over_tables",
];

/// D1, mouse cortex.
const CORTEX: UVec3 = UVec3::new(21_494, 25_790, 1_850);
/// What volume construction builds at once, in bricks: 512 x 512 x 32 voxels.
const CONSTRUCTED: UVec3 = UVec3::new(16, 16, 1);

/// \[000 table 1\]: how many of its cells come out as published.
pub(crate) fn table_1(_: &Settings) -> Result<Vec<Row>> {
    const PUBLISHED: [([u32; 2], usize, [u32; 4]); 4] = [
        ([32_768, 4_096], 11, [64, 32, 4, 1]),
        ([120_000, 15_000], 13, [235, 118, 15, 4]),
        ([512_000, 64_000], 15, [1_000, 500, 63, 16]),
        ([2_000_000, 250_000], 17, [3_907, 1_954, 245, 62]),
    ];
    let shapes = [(2, 16), (2, 32), (3, 16), (3, 32)];
    let mut same = 0_u32;
    let mut row = Row::new(TABLE_1_IDS[0], "cells as published", vec![0.0]);
    for ([xy, z], levels, directories) in PUBLISHED {
        let extent = UVec3::new(xy, xy, z);
        let ours = halving_levels(extent, DVec3::new(5.0, 5.0, 40.0));
        same += u32::from(ours.len() == levels);
        let mut text = format!("{} levels; directory", ours.len());
        for ((depth, block_edge), published) in shapes.into_iter().zip(directories) {
            let shape = PageTableShape { depth, block_edge };
            // What the product's tables have, where they can be made at all.
            let edge = match PageTables::new(&ours, 1, shape) {
                Ok(tables) => tables.levels()[0].directory.x,
                Err(_) => shape.directory(&ours[0]).x,
            };
            same += u32::from(edge == published);
            text += &format!(" {edge}");
        }
        row = row.setting(&format!("{xy} x {xy} x {z}"), text);
    }
    let row = row.with_runs(vec![f64::from(same)]);
    Ok(vec![row.peer(
        20.0,
        "Hadwiger et al. 2012, table 1: four volumes, levels and four directories each",
    )])
}

/// Of tissue: structures seen through each other; or a linear ramp, so opaque that rays meet two bricks on average, as those of
/// fig. 6 do where an octree of eleven levels is entered 21.9 / 11 times.
fn transfer(semi_transparent: bool) -> TransferFunction {
    if semi_transparent {
        ramp(0.35, 1.0, 0.25, 400.0)
    } else {
        ramp(0.0, 1.0, 0.9, 16.0)
    }
}

fn channel(transfer: TransferFunction) -> Vec<ChannelView> {
    vec![ChannelView::new(0, transfer)]
}

/// A view that wants level `level`, a voxel a pixel, of a face of a volume.
fn face(volume: &Volume, size: UVec2, level: u32) -> View {
    face_at(
        volume,
        size,
        volume.voxel_nm.min_element() * f64::from(level).exp2(),
    )
}

/// The same, with pixels as large as that level's voxels look from there, which are flat: each such view is drawn from another
/// level.
fn face_of(volume: &Volume, size: UVec2, level: u32) -> View {
    let forward = face(volume, size, 0).camera.physical_from_eye_axes().z_axis;
    let DVec3 { x, y, z } = volume.voxel_nm * volume.levels[level as usize].downsampling;
    let shadow = forward.abs().dot(DVec3::new(y * z, z * x, x * y));
    face_at(volume, size, shadow.sqrt())
}

/// A view of a face of a volume whose pixels are `nm` large.
fn face_at(volume: &Volume, size: UVec2, nm: f64) -> View {
    let tangent = (Camera::FOV / 2.0).to_radians().tan();
    let extent = volume.size_nm();
    let camera = Camera {
        target: Point::new(extent * DVec3::new(0.503, 0.497, 0.0)),
        distance_nm: nm * f64::from(size.y) / (2.0 * tangent),
        yaw: 20.0,
        pitch: 15.0,
        fov: Camera::FOV,
    };
    View::new(camera, size)
}

fn picture(scale: Scale) -> UVec2 {
    match scale {
        Scale::Small => UVec2::new(96, 72),
        Scale::Medium => UVec2::new(256, 192),
        Scale::Paper => UVec2::new(1024, 768),
    }
}

/// As in the paper: 1 GB of bricks.
fn cache_bytes(scale: Scale) -> u64 {
    match scale {
        Scale::Small => 320 << 20,
        Scale::Medium | Scale::Paper => 1 << 30,
    }
}

fn renderer(gpu: &Gpu, volume: &std::sync::Arc<Volume>, scale: Scale) -> Result<Renderer> {
    let options = RendererOptions {
        memory_bytes: cache_bytes(scale),
        page_table_shape: Some(PageTableShape {
            depth: 2,
            block_edge: 32,
        }),
        ..at_once()
    };
    Ok(Renderer::new(gpu, volume.clone(), options)?)
}

/// \[000 table 2\]: frames per second of level 0, and those of an octree entered at the top.
pub(crate) fn table_2(settings: &Settings) -> Result<Vec<Row>> {
    let gpu = &pollster::block_on(Gpu::headless())?;
    let scale = settings.scale(gpu);
    let published: [[[f64; 2]; 2]; 4] = [
        [[75.0, 61.0], [12.0, 9.0]],
        [[77.0, 63.0], [19.0, 15.0]],
        [[72.0, 58.0], [22.0, 13.0]],
        [[55.0, 44.0], [30.0, 25.0]],
    ];
    let mut rows = Vec::new();
    for ((set, published), ids) in (0..4).zip(published).zip(TABLE_2_IDS.chunks(2)) {
        if !ids.iter().any(|id| settings.wants(id)) {
            continue;
        }
        let extent = match set {
            0 => CORTEX,
            1 => UVec3::new(18_000, 18_000, 304),
            _ => UVec3::new(14_176, 10_592, 308),
        };
        for (semi_transparent, (published, id)) in [false, true]
            .into_iter()
            .zip(published.into_iter().zip(ids))
        {
            let views = channel(transfer(semi_transparent));
            let (ours, tree, rays, extent) = if set < 3 {
                let tissue = Tissue::new(extent)?;
                let view = face(&tissue.volume, picture(scale), 0);
                let ([ours, tree], rays) =
                    both(gpu, &tissue.volume, &tissue, &views, &view, scale)?;
                (ours, tree, rays, extent)
            } else {
                let extent = UVec3::splat(match scale {
                    Scale::Small => 256,
                    Scale::Medium => 512,
                    Scale::Paper => 2048,
                });
                let size = extent.as_dvec3();
                let value = move |_, at: DVec3| plant(at / size, at);
                let sensor = Formula::new(extent, DVec3::splat(1000.0), Dtype::Uint8, 1, value)?;
                let transfer = match semi_transparent {
                    false => ramp(0.0, 1.0, 0.9, 25_000.0),
                    true => ramp(0.3, 1.0, 0.25, 25_000.0),
                };
                let views = channel(transfer);
                let camera = Camera::around(&sensor.volume).zoomed(1.3);
                let view = View {
                    lod_bias: -20.0,
                    ..View::new(camera, picture(scale))
                };
                let ([ours, tree], rays) =
                    both(gpu, &sensor.volume, &sensor, &views, &view, scale)?;
                (ours, tree, rays, extent)
            };
            let row = Row::new(
                id,
                "frames per second",
                ours.iter().map(|ms| 1e3 / ms).collect(),
            )
            .peer(published[0], "Hadwiger et al. 2012, table 2, Quadro 6000")
            .setting(
                "picture",
                format!("{}x{}", picture(scale).x, picture(scale).y),
            )
            .setting(
                "volume",
                format!("{} x {} x {} voxels", extent.x, extent.y, extent.z),
            )
            .setting("a ray", rays)
            .setting("octree_fps", 1e3 / mean(&tree))
            .setting("time", time_of(gpu))
            .setting("ours over the octree's", mean(&tree) / mean(&ours))
            .setting("published octree_fps", published[1])
            .setting(
                "published ours over the octree's",
                published[0] / published[1],
            );
            eprintln!(
                "  {id}: {:.1} frames per second, octree {:.1}",
                1e3 / mean(&ours),
                1e3 / mean(&tree)
            );
            rows.push(row);
        }
    }
    Ok(rows)
}

/// Times of ours and of an octree entered at the top \[ms\], and what the rays of each do, in words.
fn both(
    gpu: &Gpu,
    volume: &std::sync::Arc<Volume>,
    source: &(impl Bricks + Sync),
    views: &[ChannelView],
    view: &View,
    scale: Scale,
) -> Result<([Vec<f64>; 2], String)> {
    const RUNS: usize = 5;
    // One volume here is dense at 2048 voxels an axis.
    let bytes = if scale == Scale::Paper {
        14 << 30
    } else {
        cache_bytes(scale)
    };
    let options = RendererOptions {
        memory_bytes: bytes,
        ..at_once()
    };
    let mut renderer = Renderer::new(gpu, volume.clone(), options)?;
    renderer.set_channels(views)?;
    let (report, _) = settle_loading(&mut renderer, view, source)?;
    ensure!(report.memory_bias == 0.0, "the bricks did not fit");
    let mut tree = Baseline::new(gpu, volume, views, Method::KdRestart, u32::MAX, bytes)?;
    let work = tree.settle(view, source)?;
    let statistics = report.statistics;
    let rays = f64::from(statistics.rays.max(1));
    let told = format!(
        "ours {:.0} samples, {:.1} nodes, {:.1} entries; octree {:.0} samples, {:.1} nodes",
        statistics.samples as f64 / rays,
        f64::from(statistics.nodes) / rays,
        f64::from(statistics.lookups) / rays,
        work.samples as f64 / work.rays.max(1) as f64,
        work.mean(),
    );
    let mut drawn = [
        Drawn::Ours(Box::new(renderer)),
        Drawn::Baseline(Box::new(tree)),
    ];
    let mut times = [Vec::new(), Vec::new()];
    for _ in 0..RUNS {
        for (drawn, times) in drawn.iter_mut().zip(&mut times) {
            times.push(drawn.frame_ms(view)?);
        }
    }
    Ok((times, told))
}

/// Entries read per ray of a frame: fewest, mean, most.
fn entries(report: &FrameReport) -> [f64; 3] {
    let statistics = report.statistics;
    let [fewest, most] = statistics.lookups_per_ray.map(f64::from);
    let mean = f64::from(statistics.lookups) / f64::from(statistics.rays.max(1));
    [fewest, mean, most]
}

fn nodes(work: &Work) -> [f64; 3] {
    let [fewest, most] = work.per_ray.map(f64::from);
    [fewest, work.mean(), most]
}

fn told([fewest, mean, most]: [f64; 3]) -> String {
    format!("{fewest} / {mean:.1} / {most}")
}

/// What volume construction is asked for, for these bricks.
fn constructed(bricks: &[BrickId]) -> usize {
    let blocks = bricks
        .iter()
        .map(|id| (id.level(), id.brick() / CONSTRUCTED));
    blocks.collect::<HashSet<_>>().len()
}

/// \[000 fig. 6\]: how rays walk in a view of level 0.
pub(crate) fn figure_6(settings: &Settings) -> Result<Vec<Row>> {
    let gpu = &pollster::block_on(Gpu::headless())?;
    let scale = settings.scale(gpu);
    let tissue = Tissue::new(CORTEX)?;
    let views = channel(transfer(false));
    let view = face(&tissue.volume, picture(scale), 0);
    let mut ours = renderer(gpu, &tissue.volume, scale)?;
    ours.set_channels(&views)?;
    let (report, loaded) = settle_loading(&mut ours, &view, &tissue)?;
    let ours = entries(&report);
    let mut baselines = Vec::new();
    for method in Method::BY_BRICK {
        let bytes = cache_bytes(scale);
        let mut baseline = Baseline::new(gpu, &tissue.volume, &views, method, u32::MAX, bytes)?;
        let work = baseline.settle(&view, &tissue)?;
        baselines.push((work, baseline));
    }
    let [(tables, _), _, (restart, octree), (stack, _)] = &baselines[..] else {
        unreachable!("four baselines");
    };
    let row = |id, unit, value: f64| {
        Row::new(id, unit, vec![value])
            .setting("picture", format!("{}x{}", view.size.x, view.size.y))
            .setting(
                "volume",
                format!("{} x {} x {} voxels, tissue", CORTEX.x, CORTEX.y, CORTEX.z),
            )
            .setting("ours: fewest / mean / most entries a ray", told(ours))
            .setting("page tables alone", told(nodes(tables)))
            .setting("kd-restart, nodes", told(nodes(restart)))
            .setting("kd-shortstack, nodes", told(nodes(stack)))
            .setting(
                "ours, nodes a ray",
                f64::from(report.statistics.nodes) / f64::from(report.statistics.rays.max(1)),
            )
            .setting(
                "bricks: ours in use / loaded, octree's",
                format!(
                    "{} / {}, {}",
                    report.statistics.bricks_used,
                    loaded.len(),
                    octree.loaded().len()
                ),
            )
            .setting(
                "512 x 512 x 32 blocks: ours, octree's",
                format!("{}, {}", constructed(&loaded), constructed(octree.loaded())),
            )
            .setting(
                "page table blocks, octree's nodes",
                format!("{}, {}", report.memory.tables_resident, octree.parts()),
            )
    };
    Ok(vec![
        row(FIGURE_6_IDS[0], "entries a ray, mean", ours[1]).peer(
            2.9,
            "Hadwiger et al. 2012, fig. 6; kd-restart 21.9, kd-shortstack 11.9 nodes",
        ),
        row(FIGURE_6_IDS[1], "entries a ray, most", ours[2]).peer(
            8.0,
            "Hadwiger et al. 2012, fig. 6; kd-restart 77, kd-shortstack 25 nodes",
        ),
        row(
            FIGURE_6_IDS[2],
            "octree's bricks over ours",
            octree.loaded().len() as f64 / loaded.len().max(1) as f64,
        )
        .peer(
            2768.0 / 2146.0,
            "Hadwiger et al. 2012, section 8.1.3: 2768 over 2146",
        ),
    ])
}

/// What a frame loaded and how its rays walked.
#[derive(Clone, Debug, Default)]
struct Frame {
    entries: [f64; 3],
    nodes: [f64; 3],
    restart: [f64; 3],
    /// Bricks, page tables, blocks to construct; loaded for this frame.
    ours: [usize; 3],
    /// The same of an octree: bricks, nodes, blocks.
    octree: [usize; 3],
}

/// Whether views are drawn with what was loaded before still there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Caches {
    Kept,
    /// Each view finds nothing, so that what is loaded is all that it uses.
    Emptied,
}

/// Draws views one after another.
fn sequence(
    gpu: &Gpu,
    tissue: &Tissue,
    scale: Scale,
    views: &[(View, bool)],
    caches: Caches,
) -> Result<Vec<Frame>> {
    let bytes = cache_bytes(scale);
    let new = |method| -> Result<Baseline> {
        let views = channel(transfer(false));
        Baseline::new(gpu, &tissue.volume, &views, method, u32::MAX, bytes)
    };
    let mut ours = renderer(gpu, &tissue.volume, scale)?;
    let mut octree = new(Method::ShortStack)?;
    let mut restart = new(Method::KdRestart)?;
    let mut frames = Vec::new();
    let mut semi_transparent_before = None;
    for ((view, semi_transparent), number) in views.iter().zip(1..) {
        if caches == Caches::Emptied {
            ours = renderer(gpu, &tissue.volume, scale)?;
            (octree, restart) = (new(Method::ShortStack)?, new(Method::KdRestart)?);
            semi_transparent_before = None;
        }
        if semi_transparent_before != Some(*semi_transparent) {
            let channels = channel(transfer(*semi_transparent));
            ours.set_channels(&channels)?;
            octree.set_views(&channels);
            restart.set_views(&channels);
            semi_transparent_before = Some(*semi_transparent);
        }
        let tables = ours.memory().tables_resident;
        let (report, loaded) = settle_loading(&mut ours, view, tissue)?;
        ensure!(report.memory_bias == 0.0, "the bricks did not fit");
        let (had, parts) = (octree.loaded().len(), octree.parts());
        let work = octree.settle(view, tissue)?;
        let of_restart = restart.settle(view, tissue)?;
        let theirs = &octree.loaded()[had..];
        let tables = report.memory.tables_resident.saturating_sub(tables);
        eprintln!(
            "  view {number} of {}: {} bricks, octree {}",
            views.len(),
            loaded.len(),
            theirs.len()
        );
        frames.push(Frame {
            entries: entries(&report),
            nodes: nodes(&work),
            restart: nodes(&of_restart),
            ours: [loaded.len(), tables as usize, constructed(&loaded)],
            octree: [
                theirs.len(),
                octree.parts().saturating_sub(parts),
                constructed(theirs),
            ],
        });
    }
    Ok(frames)
}

/// \[000 fig. 7\]: zooming in, level by level; then thirty frames that zoom in and pan, the last of them with a more
/// transparent transfer function.
pub(crate) fn figure_7(settings: &Settings) -> Result<Vec<Row>> {
    let gpu = &pollster::block_on(Gpu::headless())?;
    let scale = settings.scale(gpu);
    let tissue = Tissue::new(CORTEX)?;
    let size = picture(scale);
    let coarsest = u32::try_from(tissue.volume.levels.len() - 1)?;
    let zoom: Vec<_> = (0..=coarsest)
        .rev()
        .map(|level| (face_of(&tissue.volume, size, level), false))
        .collect();
    let levels = sequence(gpu, &tissue, scale, &zoom, Caches::Emptied)?;
    let mut pan = Vec::new();
    let near = zoom[zoom.len() - 1].0;
    for frame in 12..=30_u32 {
        let by = f64::from(frame.min(27) - 11) * f64::from(size.x) / 16.0;
        let camera = near
            .camera
            .panned(DVec2::new(-by, 0.3 * by), f64::from(size.y));
        pan.push((View { camera, ..near }, frame >= 18));
    }
    let animation = [&zoom[..], &pan].concat();
    let frames = sequence(gpu, &tissue, scale, &animation, Caches::Kept)?;
    let mut whole = levels.clone();
    whole.extend(sequence(gpu, &tissue, scale, &pan, Caches::Emptied)?);
    plots(settings, coarsest, &levels, &frames, &whole)?;
    let finest = levels.last().cloned().unwrap_or_default();
    let row = |id, unit, value: f64| {
        let mut row = Row::new(id, unit, vec![value])
            .setting("picture", format!("{}x{}", size.x, size.y))
            .setting(
                "volume",
                format!("{} x {} x {} voxels, tissue", CORTEX.x, CORTEX.y, CORTEX.z),
            );
        for ((frame, whole), number) in frames.iter().zip(&whole).zip(1..) {
            let Frame { ours, octree, .. } = frame;
            let text = format!(
                "entries {}, kd-restart {}, kd-shortstack {}; new bricks {} of {} and {} of {}, tables {} of {} and nodes {} of {}, blocks {} of {} and {} of {}",
                told(frame.entries),
                told(frame.restart),
                told(frame.nodes),
                ours[0],
                whole.ours[0],
                octree[0],
                whole.octree[0],
                ours[1],
                whole.ours[1],
                octree[1],
                whole.octree[1],
                ours[2],
                whole.ours[2],
                octree[2],
                whole.octree[2],
            );
            row = row.setting(&format!("frame {number:02}"), text);
        }
        row
    };
    let over = |id, unit, of: fn(&Frame) -> [usize; 2]| {
        let [ours, theirs] = of(&finest);
        Row::new(
            id,
            unit,
            vec![total_of(&frames, of)[1] / total_of(&frames, of)[0].max(1.0)],
        )
        .setting(
            "of the view of level 0 alone",
            format!("{theirs} over {ours}"),
        )
    };
    Ok(vec![
        row(FIGURE_7_IDS[0], "entries a ray at level 0, mean", finest.entries[1])
            .peer(2.9, "Hadwiger et al. 2012, fig. 6 and 7 a"),
        over(FIGURE_7_IDS[1], "octree's bricks over ours, thirty frames", |f| {
            [f.ours[0], f.octree[0]]
        })
        .peer(2768.0 / 2146.0, "Hadwiger et al. 2012, section 8.1.3: the view of level 0 alone"),
        over(FIGURE_7_IDS[2], "octree's 3D blocks over ours, thirty frames", |f| {
            [f.ours[2], f.octree[2]]
        })
        .peer(36.0 / 18.0, "Hadwiger et al. 2012, section 8.1.3: the view of level 0 alone"),
        over(
            FIGURE_7_IDS[3],
            "octree's nodes over our page table blocks, thirty frames",
            |f| [f.ours[1], f.octree[1]],
        )
        .peer(1250.0, "Hadwiger et al. 2012, section 8.1.3: 5,000 nodes over 1 to 4 blocks, the view of level 0 alone"),
    ])
}

/// Sums over frames, of ours and of theirs.
fn total_of(frames: &[Frame], of: fn(&Frame) -> [usize; 2]) -> [f64; 2] {
    let pairs = frames.iter().map(of);
    let sums = pairs.fold([0, 0], |[a, b], [c, d]| [a + c, b + d]);
    sums.map(|sum| sum as f64)
}

/// A number of a frame.
type Of<'a> = &'a dyn Fn(&Frame) -> f64;

fn plots(
    settings: &Settings,
    coarsest: u32,
    levels: &[Frame],
    frames: &[Frame],
    whole: &[Frame],
) -> Result<()> {
    let by_level = |of: Of<'_>| -> Vec<[f64; 2]> {
        let levels = levels.iter().zip((0..=coarsest).rev());
        levels
            .map(|(frame, level)| [f64::from(level), of(frame)])
            .collect()
    };
    let mut plot = Plot::new(
        "Walks of rays by level, after fig. 7 a",
        "level of the view",
        "a ray, log",
        Axis::Logarithmic,
    );
    for (k, name) in ["fewest", "mean", "most"].into_iter().enumerate() {
        plot = plot
            .line(&format!("entries, {name}"), by_level(&|f| f.entries[k]))
            .dashed(&format!("kd-restart, {name}"), by_level(&|f| f.restart[k]));
    }
    settings.plot(&plot, "fig_7a")?;
    let mut plot = Plot::new(
        "Loaded for a view, by level, after fig. 7 b",
        "level of the view",
        "loaded, log",
        Axis::Logarithmic,
    );
    let names = [
        ("bricks", "bricks"),
        ("page tables", "nodes"),
        ("3D blocks", "3D blocks"),
    ];
    for (k, (ours, theirs)) in names.into_iter().enumerate() {
        plot = plot.line(ours, by_level(&|f| f.ours[k] as f64)).dashed(
            &format!("octree: {theirs}"),
            by_level(&|f| f.octree[k] as f64),
        );
    }
    settings.plot(&plot, "fig_7b")?;
    let by_frame = |frames: &[Frame], of: Of<'_>| -> Vec<[f64; 2]> {
        let frames = frames.iter().zip(1..);
        frames
            .map(|(frame, number)| [f64::from(number), of(frame)])
            .collect()
    };
    let x = "frame: zoom to 11, pan to 27, transparent from 18";
    let ours = |frames: &[Frame], k: usize| by_frame(frames, &|f| f.ours[k] as f64);
    let theirs = |frames: &[Frame], k: usize| by_frame(frames, &|f| f.octree[k] as f64);
    let title = "3D blocks, after fig. 7 c";
    let plot = Plot::new(title, x, "3D blocks", Axis::Linear)
        .line("new", ours(frames, 2))
        .line("in use", ours(whole, 2))
        .dashed("octree: new", theirs(frames, 2))
        .dashed("octree: in use", theirs(whole, 2));
    settings.plot(&plot, "fig_7c")?;
    let title = "Bricks, page tables, nodes, after fig. 7 d";
    let plot = Plot::new(title, x, "log", Axis::Logarithmic)
        .line("bricks, new", ours(frames, 0))
        .line("bricks, in use", ours(whole, 0))
        .line("page tables, new", ours(frames, 1))
        .line("page tables, in use", ours(whole, 1))
        .dashed("octree: nodes, new", theirs(frames, 1))
        .dashed("octree: nodes, in use", theirs(whole, 1));
    settings.plot(&plot, "fig_7d")
}
