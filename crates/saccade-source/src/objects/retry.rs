//! Asking again, a bounded number of times.

use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use futures::future::{Either, select};
use web_time::Instant;

use super::error::Failure;
use super::{ObjectError, Objects};
use crate::maybe_send::sleep;

/// How often and how long a store is asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Patience {
    /// Attempts for one object.
    pub attempts: u32,
    /// Wait before the second attempt; it doubles with each.
    pub first_wait: Duration,
    /// Longest wait between attempts, whatever the store asks for.
    pub longest_wait: Duration,
    /// An answer of which nothing more came for so long has failed.
    pub idle: Duration,
    /// An answer must come faster than this, counted from its beginning on, after `idle` has passed
    /// \[bytes/s\].
    pub slowest: u32,
}

impl Default for Patience {
    fn default() -> Self {
        Self {
            attempts: 5,
            first_wait: Duration::from_millis(200),
            longest_wait: Duration::from_secs(10),
            idle: Duration::from_secs(20),
            slowest: 4096,
        }
    }
}

impl Patience {
    /// Makes attempts until one succeeds, fails for good, or was the last.
    pub(super) async fn attempts<T, F: Future<Output = Result<T, Failure>>>(
        self,
        objects: &dyn Objects,
        key: &str,
        mut attempt: impl FnMut() -> F,
    ) -> Result<T, ObjectError> {
        let mut wait = self.first_wait;
        let mut attempts = 0;
        loop {
            attempts += 1;
            let (reason, asked) = match attempt().await {
                Ok(done) => return Ok(done),
                Err(Failure::Final(error)) => return Err(error),
                Err(Failure::Again { reason, wait }) => (reason, wait),
            };
            let location = objects.location(key);
            if attempts >= self.attempts {
                return Err(ObjectError::Unavailable {
                    attempts,
                    reason,
                    location,
                });
            }
            match is_to_be_told() {
                true => log::warn!("trying again: {reason}: {location}"),
                false => log::debug!("attempt {attempts} failed: {reason}: {location}"),
            }
            // Readers that were refused together do not come back together.
            let spread = 1.0 + f64::from(scatter(key, attempts)) / f64::from(u32::MAX) / 2.0;
            let spread = wait.mul_f64(spread);
            sleep(asked.unwrap_or(spread).max(spread).min(self.longest_wait)).await;
            wait = (wait * 2).min(self.longest_wait);
        }
    }

    /// What `future` returns, unless nothing comes for too long.
    pub(super) async fn idle<T>(self, future: impl Future<Output = T>) -> Result<T, Failure> {
        let (future, timer) = (std::pin::pin!(future), std::pin::pin!(sleep(self.idle)));
        match select(future, timer).await {
            Either::Left((done, _)) => Ok(done),
            Either::Right(_) => {
                let seconds = self.idle.as_secs_f32();
                Err(Failure::again(format!("nothing came for {seconds} s")))
            }
        }
    }
}

/// Whether an answer that has begun comes fast enough: one that sends a byte now and then is never silent, and never ends.
pub(crate) struct Pace {
    idle: Duration,
    slowest: u32,
    begun: Instant,
}

impl Pace {
    /// It may take `idle` to get going, and then has to come by `slowest` bytes/s, counted from there on.
    pub(crate) fn new(idle: Duration, slowest: u32) -> Self {
        #[expect(clippy::disallowed_methods, reason = "web_time's, which browsers have")]
        let begun = Instant::now();
        Self {
            idle,
            slowest,
            begun,
        }
    }

    /// Whether it is too little that so many bytes have come by now.
    pub(crate) fn is_too_slow(&self, come: u64) -> bool {
        let seconds = self.begun.elapsed().saturating_sub(self.idle);
        (come as f64) < seconds.as_secs_f64() * f64::from(self.slowest)
    }

    /// Of which so many bytes have come by now.
    pub(super) fn check(&self, come: u64) -> Result<(), Failure> {
        match self.is_too_slow(come) {
            true => Err(Failure::again(format!(
                "no more than {come} bytes came in time"
            ))),
            false => Ok(()),
        }
    }
}

/// Whether it is time to say that a store makes us wait: where one object does, many do.
pub(crate) fn is_to_be_told() -> bool {
    const TELL_AGAIN: Duration = Duration::from_secs(30);
    static TOLD: Mutex<Option<Instant>> = Mutex::new(None);
    let mut told = TOLD.lock().unwrap_or_else(PoisonError::into_inner);
    let is_due = told.is_none_or(|told| told.elapsed() >= TELL_AGAIN);
    if is_due {
        #[expect(clippy::disallowed_methods, reason = "web_time's, which browsers have")]
        let now = Instant::now();
        *told = Some(now);
    }
    is_due
}

/// FNV-1a of a key and a number: the same everywhere, different for each.
fn scatter(key: &str, number: u32) -> u32 {
    let bytes = key.bytes().chain(number.to_le_bytes());
    bytes.fold(0x811c_9dc5, |hash, byte| {
        (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193)
    })
}
