//! Stalls while data arrive, and memory in a long flight.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Result, ensure};
use glam::{DVec3, UVec2};
use saccade_core::camera::Camera;
use saccade_core::space::Point;
use saccade_core::volume::Volume;
use saccade_render::{Gpu, View};
use saccade_source::VolumeSource as _;
use saccade_source::memory::ArraySource;
use saccade_stream::policy::Limits;
use saccade_stream::{Session, SessionOptions};

use super::{render, runtime};
use crate::clock::Stopwatch;
use crate::report::Row;
use crate::scene::Random;
use crate::settings::Settings;
use crate::volumes::Scale;
use crate::{cpu, memory};

pub(crate) const STREAMING_IDS: &[&str] = &[
    "render.streaming_worst_over_median",
    "render.streaming_thread_worst_ms",
];
pub(crate) const FLIGHT_IDS: &[&str] = &[
    "render.flight.gpu_share",
    "render.flight.device_share",
    "render.flight.growth_mb",
];

/// Frames of a camera that turns.
#[derive(Debug, Default)]
struct Turn {
    /// From asking for a frame until it is known to be finished \[ms\].
    drawing: Vec<f64>,
    /// From one finished frame to the next \[ms\].
    apart: Vec<f64>,
    /// Processor time of the drawing thread for a frame, with what arrived before it \[ms\].
    thread: Vec<f64>,
    /// Bricks handed over in the meantime.
    bricks: u64,
}

impl Turn {
    async fn around(
        session: &mut Session,
        camera: Camera,
        size: UVec2,
        length: Duration,
    ) -> Result<Self> {
        let mut turn = Self::default();
        let mut finished = (None, None);
        let mut spent = Duration::ZERO;
        let start = Stopwatch::start();
        let before = session.frame(&view_of(camera, size)).delivered;
        while start.elapsed() < length {
            let turned = 30.0 * start.elapsed().as_secs_f64();
            let thread = cpu::of_thread()?;
            let status = session.frame(&view_of(camera.orbited(turned, 0.0), size));
            spent += cpu::of_thread()?.saturating_sub(thread);
            if status.drew {
                turn.thread.push(milliseconds(spent));
                spent = Duration::ZERO;
            }
            let now = start.elapsed();
            // Two frames hardly take as long to the nanosecond.
            if let Some(time) = status
                .frame_time
                .filter(|_| status.frame_time != finished.0)
            {
                if let Some(last) = finished.1.replace(now) {
                    turn.apart.push(milliseconds(now.saturating_sub(last)));
                    turn.drawing.push(milliseconds(time));
                }
                finished.0 = status.frame_time;
            }
            turn.bricks = status.delivered - before;
            tokio::time::sleep(Duration::from_micros(500)).await;
        }
        Ok(turn)
    }
}

/// Of the finest level, so that bricks are many however small the picture.
fn view_of(camera: Camera, size: UVec2) -> View {
    View {
        lod_bias: -3.0,
        ..View::new(camera, size)
    }
}

fn milliseconds(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

/// Median, 99th percentile and largest.
fn spread(values: &[f64]) -> [f64; 3] {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let at = |of: usize| sorted.get(of).copied().unwrap_or(f64::NAN);
    let last = sorted.len().saturating_sub(1);
    [at(sorted.len() / 2), at(last * 99 / 100), at(last)]
}

fn told(values: &[f64]) -> String {
    let [median, most, worst] = spread(values);
    format!("{median:.2} / {most:.2} / {worst:.2}")
}

/// The slowest frame over the median one while bricks arrive all the time; beside the same turn of the camera with everything
/// there, which says what part of it is the machine's.
pub(crate) fn streaming(settings: &Settings) -> Result<Vec<Row>> {
    const RUNS: usize = 3;
    let runtime = runtime()?;
    let source = Arc::new(render::source()?);
    let volume = Volume::clone(source.volume());
    let camera = Camera::around(&volume).zoomed(2.5);
    let mut runs = [Vec::new(), Vec::new()];
    let mut ratio = Row::new(
        STREAMING_IDS[0],
        "slowest over the median, of the time between frames",
        Vec::new(),
    );
    for run in 1..=RUNS {
        // So little memory that what was seen is gone when it is seen again; and so much that all stays.
        for (name, gpu_bytes) in [("streaming", 12 << 20), ("all resident", 512 << 20)] {
            let (turn, size) = runtime.block_on(async {
                let gpu = Gpu::headless().await?;
                let (size, length) = match settings.scale(&gpu) {
                    Scale::Small => (UVec2::new(160, 120), 12),
                    Scale::Medium => (UVec2::new(400, 300), 24),
                    Scale::Paper => (UVec2::new(1024, 768), 12),
                };
                let length = Duration::from_secs(length);
                let options = SessionOptions {
                    gpu_bytes,
                    ..SessionOptions::default()
                };
                let mut session = Session::new(&gpu, source.clone(), options)?;
                // Pipelines are compiled, the histogram is known; and once around, so is what can be.
                session
                    .settle(&view_of(camera, size), Duration::from_secs(600))
                    .await?;
                Turn::around(&mut session, camera, size, length).await?;
                let turn = Turn::around(&mut session, camera, size, length).await?;
                anyhow::Ok((turn, size))
            })?;
            ensure!(turn.apart.len() > 10, "hardly a frame was drawn");
            let [median, _, worst] = spread(&turn.apart);
            let text = format!(
                "{} frames, {} bricks arrived; ms, median / 99 % / worst: apart {}, drawing {}, drawing thread {}",
                turn.apart.len(),
                turn.bricks,
                told(&turn.apart),
                told(&turn.drawing),
                told(&turn.thread),
            );
            eprintln!("  {name}: {text}");
            if name == "streaming" {
                runs[0].push(worst / median);
                runs[1].push(spread(&turn.thread)[2]);
            }
            let name = format!("run {run}, {name}");
            ratio = ratio
                .setting("picture", format!("{}x{}", size.x, size.y))
                .setting(&name, text);
        }
    }
    let [ratios, threads] = runs;
    let ratio = ratio
        .with_runs(ratios)
        .setting("data", "512 x 512 x 48 voxels of tissue in 12 MB of GPU memory, of the finest level, a camera that turns 30 degrees a second");
    let unit = "ms of the drawing thread for a frame and what arrived, longest";
    Ok(vec![ratio, Row::new(STREAMING_IDS[1], unit, threads)])
}

/// Frames drawn at each place of a flight.
const FRAMES_A_PLACE: u32 = 10;

/// A random flight under a user's ceilings: as many frames as an hour of looking around.
pub(crate) fn flight(settings: &Settings) -> Result<Vec<Row>> {
    const GPU_BYTES: u64 = 24 << 20;
    const HOST_BYTES: u64 = 12 << 20;
    let runtime = runtime()?;
    let source: Arc<ArraySource> = Arc::new(render::source()?);
    let volume = Volume::clone(source.volume());
    let flown = runtime.block_on(async {
        let gpu = Gpu::headless().await?;
        let calls: u32 = match settings.scale(&gpu) {
            Scale::Small => 6_000,
            // An hour of 30 and of 60 frames a second.
            Scale::Medium => 108_000,
            Scale::Paper => 216_000,
        };
        let places = calls / FRAMES_A_PLACE;
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
        let mut flown = Flown::default();
        let mut settled = None;
        for place in 0..places {
            let camera = Camera {
                target: Point::new(volume.size_nm() * DVec3::new(next(), next(), next())),
                ..Camera::around(&volume).orbited(360.0 * next(), 180.0 * next() - 90.0)
            };
            let camera = camera.zoomed(0.5 + 10.0 * next());
            let view = View::new(camera, UVec2::new(64, 48));
            for _ in 0..FRAMES_A_PLACE {
                let status = session.frame(&view);
                flown.gpu = flown.gpu.max(status.memory.total());
                flown.host = flown.host.max(status.host_bytes);
                flown.coarsest = flown.coarsest.max(status.memory_bias);
                (flown.frames, flown.bricks) = (status.frame, status.delivered);
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
            if let Some(report) = gpu.device().generate_allocator_report() {
                flown.device = flown.device.max(report.total_allocated_bytes);
            }
            if place == places / 5 {
                settled = Some(memory::reset_peak()?);
            }
            if let Some(settled) = settled {
                flown.growth = memory::peak()?.saturating_sub(settled);
            }
            if (place + 1) % (places / 20).max(1) == 0 {
                eprintln!("  place {} of {places}: {flown:?}", place + 1);
            }
        }
        anyhow::Ok(flown)
    })?;
    let share = |most: u64, ceiling: u64| most as f64 / ceiling as f64;
    let row = |id, unit, value| {
        Row::new(id, unit, vec![value])
            .setting("frames", flown.frames)
            .setting("bricks handed over", flown.bricks)
            .setting(
                "ceilings",
                "24 MB of GPU memory, 12 MB of main memory for chunks",
            )
            .setting("largest level-of-detail bias", flown.coarsest)
            .setting(
                "most host bytes of their ceiling",
                share(flown.host, HOST_BYTES),
            )
    };
    Ok(vec![
        row(
            FLIGHT_IDS[0],
            "most GPU bytes of their ceiling, as the renderer counts",
            share(flown.gpu, GPU_BYTES),
        ),
        row(
            FLIGHT_IDS[1],
            "most GPU bytes of their ceiling, as the device's allocator counts",
            share(flown.device, GPU_BYTES),
        ),
        row(
            FLIGHT_IDS[2],
            "MB of resident memory after the first fifth",
            flown.growth as f64 / 1e6,
        ),
    ])
}

/// The most of a flight.
#[derive(Clone, Copy, Debug, Default)]
struct Flown {
    frames: u64,
    bricks: u64,
    /// Bytes, as the renderer counts them.
    gpu: u64,
    /// Bytes, as the device's allocator counts them.
    device: u64,
    host: u64,
    growth: u64,
    coarsest: f32,
}
