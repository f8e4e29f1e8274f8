//! Time, and a pace to keep.

use std::time::Duration;

pub use saccade_archive::clock::{Clock, PretendClock, SystemClock};

use crate::Cancel;

/// Keeps to a rate. Time lost is not caught up with, as a microscope would not.
#[derive(Debug)]
pub(crate) struct Pace {
    mpixel_s: Option<f64>,
    due: Option<Duration>,
}

/// Longest sleep between two looks at the cancel flag.
const SLICE: Duration = Duration::from_millis(50);

impl Pace {
    /// As fast as possible if `None`.
    pub(crate) fn new(mpixel_s: Option<f64>) -> Self {
        Self {
            mpixel_s,
            due: None,
        }
    }

    /// Waits until `pixels` more may appear; `false` if cancelled meanwhile.
    pub(crate) fn wait(&mut self, clock: &dyn Clock, pixels: u64, cancel: &Cancel) -> bool {
        let seconds = self
            .mpixel_s
            .map_or(0.0, |rate| pixels as f64 / (rate * 1e6));
        self.pause(clock, Duration::from_secs_f64(seconds), cancel)
    }

    /// Waits until `duration` after the end of the last wait; `false` if cancelled meanwhile.
    pub(crate) fn pause(&mut self, clock: &dyn Clock, duration: Duration, cancel: &Cancel) -> bool {
        let due = self.due.unwrap_or_else(|| clock.monotonic()) + duration;
        loop {
            if cancel.is_cancelled() {
                return false;
            }
            let now = clock.monotonic();
            if now >= due {
                self.due = Some(now.max(due));
                return true;
            }
            clock.block(SLICE.min(due - now));
        }
    }
}
