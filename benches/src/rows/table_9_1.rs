//! \[001 table 9.1\] and \[001 fig. 9.2 and 9.3\]: the residency octree against page tables alone and against an octree,
//! for data sets like those of the thesis.

use std::sync::Arc;

use anyhow::{Result, ensure};
use glam::{UVec2, UVec3};
use saccade_core::camera::Camera;
use saccade_core::volume::Volume;
use saccade_render::{ChannelView, Gpu, Renderer, RendererOptions, Statistics, View, wgpu};

use crate::baselines::{Baseline, Method, Work};
use crate::bricks::{Bricks, at_once, settle};
use crate::clock::Stopwatch;
use crate::cpu;
use crate::plot::{Axis, Plot};
use crate::report::Row;
use crate::settings::Settings;
use crate::volumes::{Case, DataSet, Formula, Scale};

pub(crate) const IDS: &[&str] = &[
    "render.aneurism_1ch.vs_page_tables",
    "render.aneurism_1ch.vs_octree",
    "render.aneurism_1ch.vs_sampled_page_tables",
    "render.aneurism_1ch.vs_sampled_octree",
    "render.aneurism_4ch.vs_page_tables",
    "render.aneurism_4ch.vs_octree",
    "render.aneurism_4ch.vs_sampled_page_tables",
    "render.aneurism_4ch.vs_sampled_octree",
    "render.bonsai_1ch.vs_page_tables",
    "render.bonsai_1ch.vs_octree",
    "render.bonsai_1ch.vs_sampled_page_tables",
    "render.bonsai_1ch.vs_sampled_octree",
    "render.bonsai_4ch.vs_page_tables",
    "render.bonsai_4ch.vs_octree",
    "render.bonsai_4ch.vs_sampled_page_tables",
    "render.bonsai_4ch.vs_sampled_octree",
    "render.kingsnake_1ch.vs_page_tables",
    "render.kingsnake_1ch.vs_octree",
    "render.kingsnake_1ch.vs_sampled_page_tables",
    "render.kingsnake_1ch.vs_sampled_octree",
    "render.kingsnake_4ch.vs_page_tables",
    "render.kingsnake_4ch.vs_octree",
    "render.kingsnake_4ch.vs_sampled_page_tables",
    "render.kingsnake_4ch.vs_sampled_octree",
    "render.cycif_16ch.vs_page_tables",
    "render.cycif_16ch.vs_octree",
    "render.cycif_16ch.vs_sampled_page_tables",
    "render.cycif_16ch.vs_sampled_octree",
    "render.cycif_medium_15ch.vs_page_tables",
    "render.cycif_medium_15ch.vs_octree",
    "render.cycif_medium_15ch.vs_sampled_page_tables",
    "render.cycif_medium_15ch.vs_sampled_octree",
    "render.cycif_large_4ch.vs_page_tables",
    "render.cycif_large_4ch.vs_octree",
    "render.cycif_large_4ch.vs_sampled_page_tables",
    "render.cycif_large_4ch.vs_sampled_octree",
];

pub(crate) const LEAF_IDS: &[&str] = &[
    "render.cycif_small.leaf_sizes",
    "render.cycif_medium.leaf_sizes",
];

/// A row of the table: data set, channels, published milliseconds of page tables, octree and residency octree.
type Cells = (DataSet, u32, [f64; 3]);

const TABLE: [Cells; 9] = [
    (DataSet::Aneurism, 1, [5.1, 4.8, 4.8]),
    (DataSet::Aneurism, 4, [15.0, 15.8, 12.3]),
    (DataSet::Bonsai, 1, [4.7, 4.5, 4.6]),
    (DataSet::Bonsai, 4, [11.9, 6.7, 6.5]),
    (DataSet::Kingsnake, 1, [15.0, 11.6, 5.1]),
    (DataSet::Kingsnake, 4, [42.5, 60.7, 19.8]),
    (DataSet::CycifSmall, 16, [34.0, 122.8, 25.7]),
    (DataSet::CycifMedium, 15, [40.4, 155.1, 37.8]),
    (DataSet::CycifLarge, 4, [24.4, 123.5, 22.4]),
];

/// Bytes for bricks, of ours and of each baseline.
pub(crate) fn cache_bytes(scale: Scale) -> u64 {
    match scale {
        Scale::Small => 256 << 20,
        Scale::Medium => 1 << 30,
        Scale::Paper => 12 << 30,
    }
}

/// Frames that are asked for at once, so that about this time is measured \[ms\].
const BATCH_MS: f64 = 40.0;

/// Something that draws, everything resident.
pub(crate) enum Drawn {
    Ours(Box<Renderer>),
    Baseline(Box<Baseline>),
}

/// Time of what a closure does; of all threads' processors where these draw, which others on the machine disturb less.
fn spent(is_cpu: bool, draw: impl FnOnce() -> Result<()>) -> Result<f64> {
    let (start, before) = (Stopwatch::start(), cpu::of_threads()?);
    draw()?;
    let spent = match is_cpu {
        true => cpu::of_threads()?.saturating_sub(before),
        false => start.elapsed(),
    };
    Ok(spent.as_secs_f64() * 1e3)
}

/// Which time frames took.
pub(crate) fn time_of(gpu: &Gpu) -> &'static str {
    match is_cpu(gpu) {
        true => "of all threads' processors",
        false => "from asking for frames until they are drawn",
    }
}

/// Whether a device draws on the CPU.
pub(crate) fn is_cpu(gpu: &Gpu) -> bool {
    gpu.adapter().device_type == wgpu::DeviceType::Cpu
}

impl Drawn {
    /// Mean time of a frame, of several asked for at once \[ms\].
    pub(crate) fn frame_ms(&mut self, view: &View) -> Result<f64> {
        let once = self.frames_ms(view, 1)?;
        let frames = (BATCH_MS / once.max(1e-3)).round().clamp(1.0, 64.0);
        if frames < 2.0 {
            return Ok(once);
        }
        #[expect(clippy::cast_possible_truncation, reason = "1 to 64")]
        #[expect(clippy::cast_sign_loss, reason = "1 to 64")]
        self.frames_ms(view, frames as u32)
    }

    fn frames_ms(&mut self, view: &View, frames: u32) -> Result<f64> {
        let ms = match self {
            Self::Ours(renderer) => spent(is_cpu(renderer.gpu()), || {
                for _ in 0..frames {
                    renderer.render(view);
                }
                pollster::block_on(renderer.finish());
                Ok(())
            })?,
            Self::Baseline(baseline) => {
                spent(is_cpu(baseline.gpu()), || baseline.frames(view, frames))?
            }
        };
        Ok(ms / f64::from(frames))
    }
}

/// What is drawn by each.
pub(crate) struct Subject<'a, B> {
    pub(crate) volume: &'a Arc<Volume>,
    pub(crate) bricks: &'a B,
    pub(crate) channels: &'a [ChannelView],
}

impl<'a> From<&'a Case> for Subject<'a, Formula> {
    fn from(case: &'a Case) -> Self {
        Self {
            volume: &case.formula.volume,
            bricks: &case.formula,
            channels: &case.views,
        }
    }
}

/// Ours, everything that the views need resident, and what its rays do in the first of them.
fn ours(
    gpu: &Gpu,
    subject: &Subject<'_, impl Bricks + Sync>,
    views: &[View],
    scale: Scale,
    leaf: Option<UVec3>,
) -> Result<(Drawn, Statistics)> {
    let options = RendererOptions {
        memory_bytes: cache_bytes(scale),
        octree_cell: leaf,
        ..at_once()
    };
    let mut renderer = Renderer::new(gpu, subject.volume.clone(), options)?;
    renderer.set_channels(subject.channels)?;
    for view in views {
        settle(&mut renderer, view, subject.bricks)?;
    }
    let first = settle(&mut renderer, &views[0], subject.bricks)?;
    ensure!(first.memory_bias == 0.0, "the bricks did not fit");
    Ok((Drawn::Ours(Box::new(renderer)), first.statistics))
}

fn baseline(
    gpu: &Gpu,
    subject: &Subject<'_, impl Bricks + Sync>,
    views: &[View],
    scale: Scale,
    method: Method,
) -> Result<(Drawn, Work)> {
    let volume = subject.volume;
    // As published: entered at the third level from the top.
    let top = u32::try_from(volume.levels.len().saturating_sub(3))?;
    let bytes = cache_bytes(scale);
    let mut baseline = Baseline::new(gpu, volume, subject.channels, method, top, bytes)?;
    for view in views {
        baseline.settle(view, subject.bricks)?;
    }
    let work = baseline.settle(&views[0], subject.bricks)?;
    Ok((Drawn::Baseline(Box::new(baseline)), work))
}

/// Views from around a volume.
pub(crate) fn views(volume: &Volume, scale: Scale) -> Vec<View> {
    let (count, size) = match scale {
        Scale::Small => (1, UVec2::new(80, 60)),
        Scale::Medium => (2, UVec2::new(160, 120)),
        Scale::Paper => (8, UVec2::new(1024, 768)),
    };
    let camera = Camera::around(volume).zoomed(1.3);
    let turned = (0..count).map(|n| View {
        lod_bias: -20.0,
        ..View::new(
            camera.orbited(360.0 * f64::from(n) / f64::from(count), 0.0),
            size,
        )
    });
    turned.collect()
}

/// Times of each \[ms\], one per view and run, measured in turn.
fn times(drawn: &mut [Drawn], views: &[View]) -> Result<Vec<Vec<f64>>> {
    const RUNS: usize = 5;
    let mut times = vec![Vec::new(); drawn.len()];
    for _ in 0..RUNS {
        for view in views {
            for (drawn, times) in drawn.iter_mut().zip(&mut times) {
                times.push(drawn.frame_ms(view)?);
            }
        }
    }
    Ok(times)
}

pub(crate) fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// Theirs over ours, per run and view.
fn ratios(theirs: &[f64], ours: &[f64]) -> Vec<f64> {
    theirs.iter().zip(ours).map(|(a, b)| a / b).collect()
}

/// Every cell of the table.
pub(crate) fn measure(settings: &Settings) -> Result<Vec<Row>> {
    let gpu = &pollster::block_on(Gpu::headless())?;
    let scale = settings.scale(gpu);
    let mut rows = Vec::new();
    for ((set, channels, published), ids) in TABLE.into_iter().zip(IDS.chunks(4)) {
        if !ids.iter().any(|id| settings.wants(id)) {
            continue;
        }
        eprintln!("  {set:?}, {channels} channels ...");
        let case = set.case(scale, channels)?;
        let [pt, octree, residency] = published;
        let published = [pt / residency, octree / residency];
        let cells = beside_baselines(gpu, &Subject::from(&case), scale, ids)?;
        rows.extend(cells.into_iter().zip([0, 1, 0, 1]).map(|(row, against)| {
            let peer = "Herzberger 2023, table 9.1, GTX 1080";
            row.peer(published[against], peer)
        }));
    }
    Ok(rows)
}

/// Four rows: against page tables and an octree, both strong, and both as published.
pub(crate) fn beside_baselines(
    gpu: &Gpu,
    subject: &Subject<'_, impl Bricks + Sync>,
    scale: Scale,
    ids: &[&'static str],
) -> Result<Vec<Row>> {
    let views = views(subject.volume, scale);
    let (ours, statistics) = ours(gpu, subject, &views, scale, None)?;
    let mut drawn = vec![ours];
    let mut works = Vec::new();
    for method in Method::ALL {
        let (baseline, work) = baseline(gpu, subject, &views, scale, method)?;
        drawn.push(baseline);
        works.push(work);
    }
    let times = times(&mut drawn, &views)?;
    let [
        ours,
        tables,
        hiding,
        restart,
        stack,
        sampled_tables,
        sampled_octree,
    ] = &times[..]
    else {
        unreachable!("ours and six baselines");
    };
    let extent = subject.volume.extent();
    let row = |id, theirs: &[f64], work: &Work| {
        Row::new(id, "theirs over ours", ratios(theirs, ours))
            .setting(
                "picture",
                format!("{}x{}", views[0].size.x, views[0].size.y),
            )
            .setting(
                "volume",
                format!("{} x {} x {} voxels", extent.x, extent.y, extent.z),
            )
            .setting("channels", subject.channels.len())
            .setting("time", time_of(gpu))
            .setting("views", views.len())
            .setting("ours_ms", mean(ours))
            .setting("theirs_ms", mean(theirs))
            .setting("ours samples", statistics.samples)
            .setting("ours bricks", statistics.bricks_used)
            .setting("theirs samples", work.samples)
            .setting("theirs bricks", work.bricks)
    };
    Ok(vec![
        row(ids[0], tables, &works[0])
            .setting("theirs", "page tables that skip bricks of zeros")
            .setting(
                "skipping what is hidden too, over ours",
                mean(hiding) / mean(ours),
            ),
        row(ids[1], stack, &works[3])
            .setting("theirs", "an octree of bricks, four nodes remembered")
            .setting(
                "entered at the top each time, over ours",
                mean(restart) / mean(ours),
            ),
        row(ids[2], sampled_tables, &works[4]).setting(
            "theirs",
            "page tables that skip bricks of zeros, looked up at every sample, as published",
        ),
        row(ids[3], sampled_octree, &works[5]).setting(
            "theirs",
            "an octree of bricks, searched at every sample of every channel, as published",
        ),
    ])
}

/// What leaf sizes are drawn beside.
const BESIDE: [(&str, Method); 4] = [
    ("page tables", Method::PageTables),
    ("octree", Method::ShortStack),
    ("page tables, published", Method::SampledPageTables),
    ("octree, published", Method::SampledOctree),
];

/// Leaf sizes and channels \[001 fig. 9.2, 9.3\]: times by channel, as plots; the row is the gain of the smallest
/// leaves with the most channels.
pub(crate) fn leaf_sizes(settings: &Settings) -> Result<Vec<Row>> {
    let gpu = &pollster::block_on(Gpu::headless())?;
    let scale = settings.scale(gpu);
    let leaves = [
        ("32³", UVec3::splat(32)),
        ("16³", UVec3::splat(16)),
        ("8³", UVec3::splat(8)),
        ("8 × 8 × 4", UVec3::new(8, 8, 4)),
    ];
    let mut rows = Vec::new();
    for (id, set, most, figure) in [
        (LEAF_IDS[0], DataSet::CycifSmall, 16, "9_2"),
        (LEAF_IDS[1], DataSet::CycifMedium, 15, "9_3"),
    ] {
        if !settings.wants(id) {
            continue;
        }
        let counts: &[u32] = match scale {
            Scale::Small => &[1, 4],
            Scale::Medium => &[1, 2, 4, 8, most],
            Scale::Paper => &[1, 2, 3, 4, 6, 8, 10, 12, most],
        };
        let names: Vec<_> = leaves
            .iter()
            .map(|(name, _)| format!("leaves {name}"))
            .chain(BESIDE.map(|(name, _)| name.to_owned()))
            .collect();
        let mut lines = vec![Vec::new(); names.len()];
        let mut gain = Vec::new();
        for &channels in counts {
            eprintln!("  {set:?}, {channels} channels ...");
            let case = set.case(scale, channels)?;
            let subject = Subject::from(&case);
            let views = views(subject.volume, scale);
            let views = &views[..views.len().min(2)];
            let mut drawn = Vec::new();
            for (_, leaf) in leaves {
                drawn.push(ours(gpu, &subject, views, scale, Some(leaf))?.0);
            }
            for (_, method) in BESIDE {
                drawn.push(baseline(gpu, &subject, views, scale, method)?.0);
            }
            let times = times(&mut drawn, views)?;
            for (line, times) in lines.iter_mut().zip(&times) {
                line.push([f64::from(channels), mean(times)]);
            }
            gain = ratios(&times[0], &times[3]);
        }
        let title = format!(
            "{set:?}: leaf sizes and channels, after fig. {}",
            figure.replace('_', ".")
        );
        let mut plot = Plot::new(&title, "visible channels", "ms a frame", Axis::Linear);
        for (index, (name, line)) in names.iter().zip(&lines).enumerate() {
            plot = if index < leaves.len() {
                plot.line(name, line.iter().copied())
            } else {
                plot.dashed(name, line.iter().copied())
            };
        }
        settings.plot(&plot, &format!("fig_{figure}"))?;
        let mut row = Row::new(id, "32³ leaves over 8 × 8 × 4", gain)
            .setting("channels", counts.last().copied());
        for (name, line) in names.iter().zip(&lines) {
            row = row.setting(name, serde_json::to_value(line)?);
        }
        rows.push(row);
    }
    Ok(rows)
}
