//! How the picture and the pull of a session are.

use std::time::Duration;

use glam::UVec2;
use saccade_render::{Fidelity, FrameReport, MemoryUse, Statistics};

use super::Session;
use crate::pull::Progress;

/// When to call [`Session::frame`] again, if nobody wakes the caller before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Again {
    /// With the next frame of the display.
    Now,
    /// After this time.
    After(Duration),
    /// Only when woken, or when the view changes.
    WhenWoken,
}

/// How the picture and the pull are.
#[derive(Clone, Debug, PartialEq)]
pub struct Status {
    /// Frames drawn so far.
    pub frame: u64,
    /// Whether this call drew one.
    pub drew: bool,
    /// Number of the newest frame known about, as `frame` counts; 0 before the first.
    pub frame_known: u64,
    /// Whether the last frame drawn is known to hold everything it wanted, up to date.
    pub complete: bool,
    /// Whether nothing will change by itself: no data on the way, no frame being drawn. An
    /// incomplete picture that is settled misses bricks that failed for good.
    pub settled: bool,
    /// Of the newest frame known about.
    pub fidelity: Fidelity,
    /// Level-of-detail bias in force in it.
    pub lod_bias: f32,
    /// The part of it that lack of GPU memory added.
    pub memory_bias: f32,
    /// Work of the newest frame known about.
    pub statistics: Statistics,
    /// GPU memory.
    pub memory: MemoryUse,
    /// Memory that chunks take \[bytes\].
    pub host_bytes: u64,
    /// Requests and failures.
    pub progress: Progress,
    /// Bricks handed to the renderer so far.
    pub delivered: u64,
    /// The volume's revision after the newest change seen: the picture is to show it.
    pub revision: u64,
    /// From submission of the newest frame known about until it was known.
    pub frame_time: Option<Duration>,
    /// Size of that frame \[pixels\].
    pub frame_size: UVec2,
    /// Whether the GPU is gone: [`Session::set_gpu`] goes on with another.
    pub lost: bool,
    /// When to call again.
    pub again: Again,
}

/// How long until it is worth looking whether the GPU has finished a frame, when the last one took
/// `frame_time`.
fn poll_after(frame_time: Option<Duration>) -> Duration {
    let quarter = frame_time.unwrap_or_default() / 4;
    quarter.clamp(Duration::from_millis(4), Duration::from_millis(50))
}

impl Session {
    pub(super) fn status(
        &self,
        now: Duration,
        drew: bool,
        cut: bool,
        draws_at: Option<Duration>,
    ) -> Status {
        let mut progress = self.pull.progress();
        if let Some(too_large) = self.too_large {
            progress.failure = Some(too_large.to_string());
        }
        if let Some(too_much) = self.too_much() {
            progress.failure = Some(too_much.to_string());
        }
        let report = self.report.as_ref();
        let known = self.pending.is_empty() && !self.dirty;
        let searching = self.requests.is_sampling() || self.requests.is_finding();
        let idle = progress.wanted == 0 && !searching;
        // While frames are being drawn, their end is awaited before the next.
        let draws_at = draws_at.filter(|_| self.pending.is_empty());
        let due = [progress.retry_at, self.refresh.due(), draws_at];
        let due = due
            .into_iter()
            .flatten()
            .min()
            .map(|at| at.saturating_sub(now));
        let poll = (!self.pending.is_empty()).then(|| poll_after(self.frame_time));
        let next = due.into_iter().chain(poll).min();
        let again = match next {
            _ if cut => Again::Now,
            Some(Duration::ZERO) => Again::Now,
            Some(time) => Again::After(time),
            None => Again::WhenWoken,
        };
        Status {
            frame: self.drawn,
            drew,
            frame_known: report.map_or(0, |report| report.frame),
            complete: known && report.is_some_and(FrameReport::is_complete),
            settled: (known && idle && self.refresh.due().is_none()) || self.too_large.is_some(),
            fidelity: report.map(|r| r.fidelity).unwrap_or_default(),
            lod_bias: report.map_or(0.0, |r| r.lod_bias),
            memory_bias: report.map_or(0.0, |r| r.memory_bias),
            statistics: report.map(|r| r.statistics).unwrap_or_default(),
            memory: self.renderer.memory(),
            host_bytes: self.pull.host_bytes(),
            progress,
            delivered: self.delivered,
            revision: self.revision,
            frame_time: self.frame_time,
            frame_size: self.frame_size,
            lost: self.renderer.gpu().is_lost(),
            again,
        }
    }
}
