//! What a frame costs besides drawing: processor time, the octree's upkeep, stalls while data arrive, and memory in a long flight.

use std::sync::Arc;
use std::time::Duration;

use anyhow::Result;
use glam::{DVec3, UVec2, UVec3};
use saccade_core::camera::Camera;
use saccade_core::space::Point;
use saccade_core::volume::Volume;
use saccade_render::{BrickVoxels, Gpu, Renderer, RendererOptions, View};
use saccade_source::VolumeSource as _;
use saccade_source::memory::ArraySource;
use saccade_stream::policy::Limits;
use saccade_stream::{Session, SessionOptions};

use super::{render, runtime};
use crate::bricks::{all_bricks, ramp, settle};
use crate::clock::Stopwatch;
use crate::report::Row;
use crate::scene::Random;
use crate::settings::Settings;
use crate::volumes::{DataSet, Scale, Tissue};
use crate::{cpu, memory};

pub(crate) const CPU_IDS: &[&str] = &["render.cpu_ms_16ch"];
pub(crate) const OCTREE_IDS: &[&str] = &["render.octree_us_per_brick"];
pub(crate) const STREAMING_IDS: &[&str] = &["render.streaming_worst_over_median"];
pub(crate) const FLIGHT_IDS: &[&str] = &["render.flight.gpu_share", "render.flight.growth_mb"];

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

/// What a brick that arrives costs the octree: in volumes of 8 GB and of 888 PB.
pub(crate) fn octree(settings: &Settings) -> Result<Vec<Row>> {
    let gpu = &pollster::block_on(Gpu::headless())?;
    let size = match settings.scale(gpu) {
        Scale::Small => UVec2::new(96, 72),
        Scale::Paper => UVec2::new(640, 480),
    };
    let mut costs = Vec::new();
    for extent in [
        UVec3::new(4_096, 4_096, 512),
        UVec3::new(2_000_000, 2_000_000, 250_000),
    ] {
        let tissue = Tissue::new(extent)?;
        let mut renderer = Renderer::new(gpu, tissue.volume.clone(), RendererOptions::default())?;
        renderer.set_transfer_function(&ramp(0.0, 1.0, 0.9, 200.0));
        let camera = Camera {
            target: Point::new(tissue.volume.size_nm() * DVec3::new(0.5, 0.5, 0.0)),
            distance_nm: 4.0 * f64::from(size.y) / (2.0 * (Camera::FOV / 2.0).to_radians().tan()),
            ..Camera::around(&tissue.volume)
        };
        let mut cost = Cost::default();
        // Fresh bricks in every view, whatever the volume's size.
        for step in 0..6 {
            let by = glam::DVec2::new(f64::from(size.x * step), 0.0);
            let view = View::new(camera.panned(by, f64::from(size.y)), size);
            cost.settle(&mut renderer, &view, &tissue)?;
        }
        costs.push(cost);
    }
    let [small, large] = &costs[..] else {
        unreachable!("two volumes");
    };
    let row = Row::new(
        OCTREE_IDS[0],
        "µs of the drawing thread a brick",
        vec![large.per_brick()],
    )
    .setting("volume", "2,000,000 x 2,000,000 x 250,000 voxels")
    .setting("in 4,096 x 4,096 x 512 voxels", small.per_brick())
    .setting(
        "of it before the next frame",
        large.upkeep_us / large.bricks.max(1.0),
    )
    .setting("bricks", large.bricks)
    .setting("most in a frame", large.most)
    .setting(
        "longest frame's processor time without the GPU, ms",
        large.worst_ms,
    );
    Ok(vec![row])
}

/// Processor time that arriving bricks take.
#[derive(Debug, Default)]
struct Cost {
    bricks: f64,
    /// Most in a frame.
    most: usize,
    /// Handing bricks over: their bounds, and what is sent \[µs\].
    delivery_us: f64,
    /// Before the next frame: entries and nodes, and the frame itself \[µs\].
    upkeep_us: f64,
    worst_ms: f64,
}

impl Cost {
    fn per_brick(&self) -> f64 {
        (self.delivery_us + self.upkeep_us) / self.bricks.max(1.0)
    }

    fn settle(&mut self, renderer: &mut Renderer, view: &View, tissue: &Tissue) -> Result<()> {
        for _ in 0..200 {
            let start = Stopwatch::start();
            renderer.render(view);
            let upkeep = start.elapsed().as_secs_f64();
            self.upkeep_us += upkeep * 1e6;
            self.worst_ms = self.worst_ms.max(upkeep * 1e3);
            let Some(report) = pollster::block_on(renderer.finish()).pop() else {
                continue;
            };
            if report.is_complete() && !report.redraw {
                return Ok(());
            }
            let bricks = all_bricks(tissue, &report.misses);
            let start = Stopwatch::start();
            for (&id, voxels) in report.misses.iter().zip(&bricks) {
                let voxels = voxels.as_deref();
                renderer.deliver(id, voxels.map_or(BrickVoxels::Empty, BrickVoxels::Voxels))?;
            }
            self.delivery_us += start.elapsed().as_secs_f64() * 1e6;
            self.bricks += bricks.len() as f64;
            self.most = self.most.max(bricks.len());
        }
        anyhow::bail!("the view does not settle")
    }
}

/// The slowest frame over the median one while bricks arrive all the time.
pub(crate) fn streaming(settings: &Settings) -> Result<Vec<Row>> {
    const RUNS: usize = 3;
    let runtime = runtime()?;
    let source = Arc::new(render::source()?);
    let volume = Volume::clone(source.volume());
    let mut median_ms = Vec::new();
    let mut runs = Vec::new();
    let mut frames = 0;
    for _ in 0..RUNS {
        let times = runtime.block_on(async {
            let gpu = Gpu::headless().await?;
            let (size, length) = match settings.scale(&gpu) {
                Scale::Small => (UVec2::new(80, 60), Duration::from_secs(6)),
                Scale::Paper => (UVec2::new(1024, 768), Duration::from_secs(10)),
            };
            // So little memory that what was seen is gone when it is seen again.
            let options = SessionOptions {
                gpu_bytes: 24 << 20,
                ..SessionOptions::default()
            };
            let mut session = Session::new(&gpu, source.clone(), options)?;
            let camera = Camera::around(&volume).zoomed(2.5);
            // Pipelines are compiled, and the histogram is known.
            session
                .settle(&View::new(camera, size), Duration::from_secs(600))
                .await?;
            let mut times = Vec::new();
            let start = Stopwatch::start();
            let mut known = None;
            while start.elapsed() < length {
                let turned = 30.0 * start.elapsed().as_secs_f64();
                let status = session.frame(&View::new(camera.orbited(turned, 0.0), size));
                if status.frame_time != known {
                    known = status.frame_time;
                    times.extend(known.map(|time| time.as_secs_f64() * 1e3));
                }
                tokio::time::sleep(Duration::from_micros(500)).await;
            }
            anyhow::Ok(times)
        })?;
        let mut sorted = times;
        sorted.sort_by(f64::total_cmp);
        frames += sorted.len();
        let (Some(worst), Some(median)) = (sorted.last(), sorted.get(sorted.len() / 2)) else {
            anyhow::bail!("no frame was drawn");
        };
        runs.push(worst / median);
        median_ms.push(*median);
    }
    let row = Row::new(STREAMING_IDS[0], "slowest frame over the median one", runs)
        .setting("frames", frames)
        .setting("medians, ms", serde_json::to_value(median_ms)?)
        .setting("data", "512 x 512 x 48 voxels of tissue in 24 MB of GPU memory, a camera that turns 30 degrees a second");
    Ok(vec![row])
}

/// A random flight under a user's ceilings: thousands of frames, as many as an hour of looking around.
pub(crate) fn flight(settings: &Settings) -> Result<Vec<Row>> {
    const GPU_BYTES: u64 = 24 << 20;
    const HOST_BYTES: u64 = 12 << 20;
    let runtime = runtime()?;
    let source: Arc<ArraySource> = Arc::new(render::source()?);
    let volume = Volume::clone(source.volume());
    let (most_gpu, most_host, growth, frames, coarsest) = runtime.block_on(async {
        let gpu = Gpu::headless().await?;
        let places: u32 = match settings.scale(&gpu) {
            Scale::Small => 300,
            Scale::Paper => 36_000,
        };
        let options = SessionOptions {
            gpu_bytes: GPU_BYTES,
            limits: Limits {
                host_bytes: HOST_BYTES,
                ..Limits::default()
            },
            ..SessionOptions::default()
        };
        let mut session = Session::new(&gpu, source, options)?;
        let mut random = Random(0x1234_5678_9abc_def1);
        let mut next = move || f64::from(random.below(1 << 20)) / f64::from(1 << 20);
        let (mut most_gpu, mut most_host, mut settled_rss, mut drawn) = (0, 0, 0, 0_u64);
        let mut coarsest: f32 = 0.0;
        for place in 0..places {
            let camera = Camera {
                target: Point::new(volume.size_nm() * DVec3::new(next(), next(), next())),
                ..Camera::around(&volume).orbited(360.0 * next(), 180.0 * next() - 90.0)
            };
            let camera = camera.zoomed(0.5 + 10.0 * next());
            let view = View::new(camera, UVec2::new(64, 48));
            for _ in 0..10 {
                let status = session.frame(&view);
                most_gpu = most_gpu.max(status.memory.total());
                most_host = most_host.max(status.host_bytes);
                coarsest = coarsest.max(status.memory_bias);
                drawn = status.frame;
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
            if place == places / 5 {
                settled_rss = memory::reset_peak()?;
            }
        }
        let growth = memory::peak()?.saturating_sub(settled_rss);
        anyhow::Ok((most_gpu, most_host, growth, drawn, coarsest))
    })?;
    let share = |most: u64, ceiling: u64| most as f64 / ceiling as f64;
    let row = |id, unit, value| {
        Row::new(id, unit, vec![value])
            .setting("frames", frames)
            .setting(
                "ceilings",
                "24 MB of GPU memory, 12 MB of main memory for chunks",
            )
            .setting("largest level-of-detail bias", coarsest)
            .setting(
                "most host bytes of their ceiling",
                share(most_host, HOST_BYTES),
            )
    };
    Ok(vec![
        row(
            FLIGHT_IDS[0],
            "most GPU bytes of their ceiling",
            share(most_gpu, GPU_BYTES),
        ),
        row(
            FLIGHT_IDS[1],
            "MB of resident memory after the first fifth",
            growth as f64 / 1e6,
        ),
    ])
}
