//! Time, real or pretended, and a pace to keep.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use crate::Cancel;

/// Time that can be read and waited for.
pub trait Clock: Send + Sync {
    /// Time since some fixed moment.
    fn now(&self) -> Duration;
    /// Returns after `duration`.
    fn sleep(&self, duration: Duration);
}

/// The computer's monotonic clock.
#[derive(Debug)]
pub struct SystemClock {
    start: Instant,
}

impl Default for SystemClock {
    fn default() -> Self {
        #[expect(
            clippy::disallowed_methods,
            reason = "simulators and archives are native only"
        )]
        let start = Instant::now();
        Self { start }
    }
}

impl Clock for SystemClock {
    fn now(&self) -> Duration {
        self.start.elapsed()
    }
    fn sleep(&self, duration: Duration) {
        std::thread::sleep(duration);
    }
}

/// A clock that only moves when somebody sleeps: an hour passes at once.
#[derive(Debug, Default)]
pub struct PretendClock {
    now: Mutex<Duration>,
}

impl Clock for PretendClock {
    fn now(&self) -> Duration {
        *self
            .now
            .lock()
            .expect("nothing panics while holding the time")
    }
    fn sleep(&self, duration: Duration) {
        *self
            .now
            .lock()
            .expect("nothing panics while holding the time") += duration;
    }
}

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
        let due = self.due.unwrap_or_else(|| clock.now()) + duration;
        loop {
            if cancel.is_cancelled() {
                return false;
            }
            let now = clock.now();
            if now >= due {
                self.due = Some(now.max(due));
                return true;
            }
            clock.sleep(SLICE.min(due - now));
        }
    }
}
