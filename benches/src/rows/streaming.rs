//! Stalls while data arrive, and memory in a long flight.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use glam::{DVec3, UVec2};
use saccade_core::camera::Camera;
use saccade_core::space::Point;
use saccade_core::volume::Volume;
use saccade_render::{Gpu, View};
use saccade_source::VolumeSource as _;
use saccade_source::memory::ArraySource;
use saccade_stream::policy::Limits;
use saccade_stream::{Session, SessionOptions};

use super::{render, runtime, table_9_1};
use crate::clock::Stopwatch;
use crate::report::Row;
use crate::scene::Random;
use crate::settings::Settings;
use crate::volumes::Scale;
use crate::{cpu, memory};

pub(crate) const STREAMING_IDS: &[&str] = &[
    "render.streaming_worst_over_median",
    "render.streaming_thread_worst_ms",
    "render.streaming_worst_over_resident",
];
pub(crate) const FLIGHT_IDS: &[&str] = &[
    "render.flight.gpu_share",
    "render.flight.device_share",
    "render.flight.growth_mb",
];

/// Degrees that the camera turns in a second.
const DEGREES_PER_S: f64 = 30.0;

/// Frames of a camera that turns.
#[derive(Debug, Default)]
struct Turn {
    frames: Vec<Frame>,
    /// Processor time of the drawing thread for a frame, with what arrived before it \[ms\].
    thread: Vec<f64>,
    /// Bricks handed over in the meantime.
    bricks: u64,
}

/// One that is known to be finished.
#[derive(Clone, Copy, Debug)]
struct Frame {
    /// Where the camera was when it was asked for \[degrees\].
    turned: f64,
    /// From asking for it until it is known to be finished \[ms\].
    drawing: f64,
    /// Since the one before \[ms\].
    apart: f64,
    /// The same where a GPU draws; where processors do, what all threads had of them, which others disturb less; a part of it for each frame that
    /// was finished \[ms\].
    work: f64,
    /// Processor time of the drawing thread in the meantime \[ms\].
    thread: f64,
    /// Bricks handed over in the meantime.
    bricks: u64,
    samples: u64,
}

impl Turn {
    async fn around(
        session: &mut Session,
        camera: Camera,
        size: UVec2,
        length: Duration,
    ) -> Result<Self> {
        let mut turn = Self::default();
        let by_processors = table_9_1::is_cpu(session.renderer().gpu());
        let mut finished = (0, None);
        let mut threads_before = cpu::of_threads()?;
        let mut spent = Duration::ZERO;
        // Of the drawing thread and of bricks, since a frame was finished.
        let (mut thread_since, mut bricks_since) = (Duration::ZERO, 0);
        let start = Stopwatch::start();
        let before = session.frame(&view_of(camera, size)).delivered;
        while start.elapsed() < length {
            let turned = DEGREES_PER_S * start.elapsed().as_secs_f64();
            let thread = cpu::of_thread()?;
            let status = session.frame(&view_of(camera.orbited(turned, 0.0), size));
            let took = cpu::of_thread()?.saturating_sub(thread);
            (spent, thread_since) = (spent + took, thread_since + took);
            if status.drew {
                turn.thread.push(milliseconds(spent));
                spent = Duration::ZERO;
            }
            bricks_since += status.delivered - before - turn.bricks;
            turn.bricks = status.delivered - before;
            let now = start.elapsed();
            let known = status.frame_known;
            if let Some(time) = status.frame_time.filter(|_| known > finished.0) {
                // Frames that are seen to be finished at once share the time.
                let frames = (known - finished.0) as f64;
                let threads = cpu::of_threads()?;
                let of_threads = threads.saturating_sub(threads_before);
                threads_before = threads;
                if let Some(last) = finished.1.replace(now) {
                    let apart = now.saturating_sub(last);
                    let work = milliseconds(if by_processors { of_threads } else { apart });
                    turn.frames.push(Frame {
                        turned: DEGREES_PER_S * now.saturating_sub(time).as_secs_f64(),
                        drawing: milliseconds(time),
                        apart: milliseconds(apart),
                        work: work / frames,
                        thread: milliseconds(thread_since),
                        bricks: bricks_since,
                        samples: status.statistics.samples,
                    });
                }
                finished.0 = known;
                (thread_since, bricks_since) = (Duration::ZERO, 0);
            }
            tokio::time::sleep(Duration::from_micros(500)).await;
        }
        Ok(turn)
    }

    fn each(&self, value: impl Fn(&Frame) -> f64) -> Vec<f64> {
        self.frames.iter().map(value).collect()
    }

    /// Median work and samples of a frame of this part of a turn.
    fn around_there(&self, turned: f64) -> [f64; 2] {
        const WITHIN: f64 = 5.0;
        let near = |frame: &&Frame| (frame.turned - turned).abs() <= WITHIN;
        let near: Vec<_> = self.frames.iter().filter(near).collect();
        let median = |value: fn(&Frame) -> f64| {
            let values: Vec<f64> = near.iter().map(|frame| value(frame)).collect();
            spread(&values)[0]
        };
        [median(|frame| frame.work), median(|f| f.samples as f64)]
    }

    /// The frame that took longest, beside those of another turn at the same place.
    fn longest_beside(&self, other: &Self) -> Option<(f64, String)> {
        let beside = self.frames.iter().map(|frame| {
            let [work, samples] = other.around_there(frame.turned);
            (frame.work / work, frame, work, samples)
        });
        // Where the other turn drew nothing, there is nothing to compare with.
        let (ratio, frame, work, samples) = beside
            .filter(|(ratio, ..)| ratio.is_finite())
            .max_by(|a, b| a.0.total_cmp(&b.0))?;
        let text = format!(
            "{:.1} ms of work, {:.1} ms apart, at {:.0} degrees, of which the drawing thread {:.1}, {} bricks, {:.2} million samples; \
             there with everything {work:.1} ms, {:.2} million",
            frame.work,
            frame.apart,
            frame.turned,
            frame.thread,
            frame.bricks,
            frame.samples as f64 / 1e6,
            samples / 1e6
        );
        Some((ratio, text))
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
    let source = Arc::new(render::ball()?);
    let volume = Volume::clone(source.volume());
    let camera = Camera::around(&volume);
    let mut runs = [const { Vec::new() }; 3];
    // What is said of each run, of the first row and of the third.
    let mut told_of = [const { Vec::new() }; 2];
    let mut picture = UVec2::ZERO;
    for run in 1..=RUNS {
        let (turns, size) = runtime.block_on(async {
            let gpu = Gpu::headless().await?;
            let (size, length) = match settings.scale(&gpu) {
                Scale::Small => (UVec2::new(160, 120), 12),
                Scale::Medium => (UVec2::new(400, 300), 24),
                Scale::Paper => (UVec2::new(1024, 768), 12),
            };
            let length = Duration::from_secs(length);
            let mut session = Session::new(&gpu, source.clone(), SessionOptions::default())?;
            // Pipelines are compiled, the histogram is known.
            let first = view_of(camera, size);
            session.settle(&first, Duration::from_secs(600)).await?;
            // The other sides arrive while they are turned to, and are there the second time.
            let streaming = Turn::around(&mut session, camera, size, length).await?;
            session.settle(&first, Duration::from_secs(600)).await?;
            let resident = Turn::around(&mut session, camera, size, length).await?;
            anyhow::Ok(([streaming, resident], size))
        })?;
        for (turn, name) in turns.iter().zip(["streaming", "all resident"]) {
            ensure!(turn.frames.len() > 10, "hardly a frame was drawn");
            let apart = turn.each(|frame| frame.apart);
            let text = format!(
                "{} frames, {} bricks arrived; ms, median / 99 % / worst: of processors {}, apart {}, drawing {}, drawing thread {}",
                turn.frames.len(),
                turn.bricks,
                told(&turn.each(|frame| frame.work)),
                told(&apart),
                told(&turn.each(|frame| frame.drawing)),
                told(&turn.thread),
            );
            eprintln!("  {name}: {text}");
            told_of[0].push((format!("run {run}, {name}"), text));
        }
        picture = size;
        let [streaming, resident] = &turns;
        ensure!(streaming.bricks > 50, "hardly a brick arrived");
        let [median, _, worst] = spread(&streaming.each(|frame| frame.work));
        runs[0].push(worst / median);
        let [median, _, worst] = spread(&resident.each(|frame| frame.work));
        eprintln!(
            "  everything there: slowest {:.2} times the median",
            worst / median
        );
        runs[1].push(spread(&streaming.thread)[2]);
        let (ratio, text) = { streaming.longest_beside(resident) }.context("nothing to compare")?;
        eprintln!("  longest, {ratio:.2} times: {text}");
        runs[2].push(ratio);
        told_of[1].push((format!("run {run}"), text));
        // What the same comparison says of nothing but the machine.
        if let Some((ratio, text)) = resident.longest_beside(resident) {
            let name = format!("run {run}, everything there");
            told_of[1].push((name, format!("{ratio:.2} times: {text}")));
        }
    }
    let [ratios, threads, beside] = runs;
    let [of_turns, of_latest] = told_of;
    let with = |row: Row, told: Vec<(String, String)>| {
        { told.into_iter() }.fold(row, |row, (name, text)| row.setting(&name, text))
    };
    let time = "between frames; of all threads' processors where these draw";
    let unit = "slowest frame over the median one";
    let ratio = Row::new(STREAMING_IDS[0], unit, ratios)
        .setting("picture", format!("{}x{}", picture.x, picture.y))
        .setting("data", "a ball of tissue, 280 voxels wide, of the finest level, a camera that turns 30 degrees a second and has not been there")
        .setting("time", time);
    let unit = "ms of the drawing thread for a frame and what arrived, longest";
    let thread = Row::new(STREAMING_IDS[1], unit, threads);
    let unit = "longest over frames of the same part of the turn with everything there";
    let beside = Row::new(STREAMING_IDS[2], unit, beside).setting("time", time);
    Ok(vec![with(ratio, of_turns), thread, with(beside, of_latest)])
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
