//! Waiting for a finished picture, where there is no window to come back to.

use std::time::Duration;

use saccade_render::View;
use tokio::time::{Instant, timeout_at};

use crate::session::{Again, Session, Status, TooLarge, TooMuch};

/// The picture is not what it should be.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SettleError {
    /// Data did not arrive in time. The picture shows what did.
    #[error("after {waited:?}, {} bricks are still missing{}", status.fidelity.missing, so_far(status))]
    Timeout {
        /// As allowed.
        waited: Duration,
        /// As far as it came.
        status: Box<Status>,
    },
    /// Some data will not come. The picture shows the rest.
    #[error("{} bricks cannot be shown: {}", status.fidelity.missing, failure(status))]
    Failed {
        /// As far as it came.
        status: Box<Status>,
    },
    /// The picture takes too much memory. None was drawn.
    #[error("nothing was drawn")]
    TooLarge {
        /// How much it takes.
        #[from]
        source: TooLarge,
    },
    /// What is in view takes too much memory. The picture shows a part.
    #[error("{} bricks find no room", status.fidelity.missing)]
    TooMuch {
        /// What would do.
        source: TooMuch,
        /// As far as it came.
        status: Box<Status>,
    },
    /// The device is gone.
    #[error("the GPU was lost while drawing")]
    Lost,
}

fn failure(status: &Status) -> &str {
    status
        .progress
        .failure
        .as_deref()
        .unwrap_or("no reason was given")
}

fn so_far(status: &Status) -> String {
    let failure = status.progress.failure.as_deref();
    failure.map_or_else(String::new, |failure| {
        format!("; the last failure: {failure}")
    })
}

/// Longest wait for news, in case a wake-up was lost.
const LONGEST_NAP: Duration = Duration::from_millis(20);

impl Session {
    /// Draws until the picture is complete and nothing is on the way, then returns. Blocks the
    /// thread while the GPU works.
    ///
    /// # Errors
    ///
    /// [`SettleError`] when that did not happen; the picture is still there to be read.
    pub async fn settle(&mut self, view: &View, timeout: Duration) -> Result<Status, SettleError> {
        let deadline = Instant::now() + timeout;
        let mut reports = Vec::new();
        loop {
            let status = self.advance(view, std::mem::take(&mut reports), true);
            if status.lost {
                return Err(SettleError::Lost);
            }
            if let Some(source) = self.too_large() {
                return Err(SettleError::TooLarge { source });
            }
            if status.settled {
                if status.complete {
                    return Ok(status);
                }
                if let Some(source) = self.too_much() {
                    let status = Box::new(status);
                    return Err(SettleError::TooMuch { source, status });
                }
                return Err(SettleError::Failed {
                    status: Box::new(status),
                });
            }
            if Instant::now() >= deadline {
                self.draw_now(view);
                return Err(SettleError::Timeout {
                    waited: timeout,
                    status: Box::new(status),
                });
            }
            reports = self.finish().await;
            if reports.is_empty() && !status.drew {
                let nap = match status.again {
                    Again::Now => Duration::ZERO,
                    Again::After(time) => time.min(LONGEST_NAP),
                    Again::WhenWoken => LONGEST_NAP,
                };
                let nap = deadline.min(Instant::now() + nap);
                drop(timeout_at(nap, self.woken()).await);
            }
        }
    }
}
