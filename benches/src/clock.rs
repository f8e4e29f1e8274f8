//! Elapsed time.

use std::time::{Duration, Instant};

use saccade_render::{Gpu, wgpu};

use crate::cpu;

/// What drawing takes: elapsed time where a GPU draws, processor time of all threads where a processor does, whose cores
/// others may use meanwhile.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DrawClock {
    elapsed: Stopwatch,
    spent: Option<Duration>,
}

impl DrawClock {
    pub(crate) fn start(gpu: &Gpu) -> Self {
        let by_processor = gpu.adapter().device_type == wgpu::DeviceType::Cpu;
        Self {
            spent: by_processor.then(cpu::of_threads).and_then(Result::ok),
            elapsed: Stopwatch::start(),
        }
    }

    pub(crate) fn ms(self) -> f64 {
        let spent = self
            .spent
            .and_then(|before| Some(cpu::of_threads().ok()?.saturating_sub(before)));
        spent
            .unwrap_or_else(|| self.elapsed.elapsed())
            .as_secs_f64()
            * 1e3
    }
}

/// Runs from its start.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stopwatch(Instant);

impl Stopwatch {
    #[expect(
        clippy::disallowed_methods,
        reason = "benchmarks never run in browsers"
    )]
    pub(crate) fn start() -> Self {
        Self(Instant::now())
    }

    pub(crate) fn elapsed(self) -> Duration {
        self.0.elapsed()
    }
}
