//! When to ask, when to give up, when to ask again: plain functions of plain numbers.

use std::time::Duration;

/// How much the pull may take at once.
#[derive(Clone, Debug, PartialEq)]
pub struct Limits {
    /// Memory for chunks: half for those of bricks being loaded, half for those already used
    /// \[bytes\].
    pub host_bytes: u64,
    /// Chunk requests in flight at once.
    pub in_flight: usize,
    /// Reports that a request survives without anybody wanting its chunk.
    pub grace: u64,
    /// Bytes of bricks handed to the renderer per frame.
    pub delivery_bytes: usize,
    /// Time for assembling and handing over bricks per frame.
    pub delivery_time: Duration,
    /// When failed requests are repeated.
    pub retry: Retry,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            host_bytes: 512 << 20,
            in_flight: 16,
            grace: 3,
            delivery_bytes: 8 << 20,
            delivery_time: Duration::from_millis(4),
            retry: Retry::default(),
        }
    }
}

/// Delays between repetitions of a request that failed for a passing reason.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Retry {
    /// Before the first repetition.
    pub first: Duration,
    /// No delay is longer.
    pub longest: Duration,
}

impl Default for Retry {
    fn default() -> Self {
        Self {
            first: Duration::from_millis(250),
            longest: Duration::from_secs(15),
        }
    }
}

impl Retry {
    /// Delay after the `attempt`th failure in a row, counting from 1: doubles from
    /// [`Self::first`] to [`Self::longest`]. What the source asks for is honoured when it is
    /// longer, up to the same bound.
    pub fn delay(&self, attempt: u32, asked: Option<Duration>) -> Duration {
        let doublings = attempt.saturating_sub(1).min(30);
        let own = self.first.saturating_mul(1 << doublings);
        own.max(asked.unwrap_or_default()).min(self.longest)
    }
}

/// What one frame may still hand to the renderer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Budget {
    bytes: usize,
    until: Duration,
    spent: usize,
}

impl Budget {
    pub(crate) fn new(limits: &Limits, now: Duration) -> Self {
        Self {
            bytes: limits.delivery_bytes,
            until: now + limits.delivery_time,
            spent: 0,
        }
    }

    /// Whether another brick fits. The first always does: a slow machine must get on, too.
    pub(crate) fn allows(&self, bytes: usize, now: Duration) -> bool {
        self.spent == 0 || (self.spent + bytes <= self.bytes && now < self.until)
    }

    pub(crate) fn spend(&mut self, bytes: usize) {
        self.spent += bytes;
    }
}

/// What speaks for and against drawing now.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Pace {
    /// The view is not the one last drawn: somebody waits for it.
    pub(crate) view_changed: bool,
    /// Bricks arrived, or changed, since the last picture.
    pub(crate) data_changed: bool,
    /// Bricks are still on their way.
    pub(crate) more_to_come: bool,
    /// Nobody watches: only the finished picture counts.
    pub(crate) unwatched: bool,
    /// When the last picture was known to be finished, and how long it took.
    pub(crate) last: Option<(Duration, Duration)>,
}

impl Pace {
    const LONGEST: Duration = Duration::from_secs(1);
    /// Unwatched, so many times the last picture's time is worth saving a picture.
    const PATIENCE: u32 = 4;

    /// From when on to draw; `None` for no need to.
    ///
    /// A picture that a few more bricks will outdate at once is put off for as long as the last
    /// one took: so at least half of a slow GPU is left to others, the user interface first.
    pub(crate) fn draws_at(self) -> Option<Duration> {
        if self.view_changed || (self.data_changed && !self.more_to_come) {
            return Some(Duration::ZERO);
        }
        let (end, took) = self.last.unwrap_or_default();
        let rest = if self.unwatched {
            took * Self::PATIENCE
        } else {
            took.min(Self::LONGEST)
        };
        self.data_changed.then_some(end + rest)
    }
}

/// When a histogram is computed anew while data arrive.
///
/// The first one at once, later ones at growing distances; the last change is always followed by
/// one, so that the picture of finished data does not depend on how they arrived.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Refresh {
    wanted: bool,
    next: Duration,
    distance: Duration,
}

impl Refresh {
    const FIRST: Duration = Duration::from_millis(500);
    const LONGEST: Duration = Duration::from_secs(8);

    pub(crate) fn new() -> Self {
        Self {
            wanted: true,
            next: Duration::ZERO,
            distance: Self::FIRST,
        }
    }

    /// Voxels changed.
    pub(crate) fn changed(&mut self) {
        self.wanted = true;
    }

    /// Whether to start now; says yes once per need.
    pub(crate) fn starts(&mut self, now: Duration) -> bool {
        let starts = self.wanted && now >= self.next;
        if starts {
            self.wanted = false;
            self.next = now + self.distance;
            self.distance = self.distance.saturating_mul(3) / 2;
            self.distance = self.distance.min(Self::LONGEST);
        }
        starts
    }

    /// When [`Self::starts`] will say yes, if nothing else happens.
    pub(crate) fn due(&self) -> Option<Duration> {
        self.wanted.then_some(self.next)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn retries_double_up_to_a_bound() {
        let retry = Retry {
            first: ms(100),
            longest: ms(1000),
        };
        for (attempt, asked, delay) in [
            (0, None, 100),
            (1, None, 100),
            (2, None, 200),
            (3, None, 400),
            (5, None, 1000),
            (u32::MAX, None, 1000),
            (1, Some(ms(50)), 100),
            (1, Some(ms(700)), 700),
            (1, Some(ms(60_000)), 1000),
        ] {
            assert_eq!(
                retry.delay(attempt, asked),
                ms(delay),
                "attempt {attempt}, {asked:?}"
            );
        }
    }

    #[test]
    fn a_budget_allows_one_brick_whatever_happens() {
        let limits = Limits {
            delivery_bytes: 100,
            delivery_time: ms(4),
            ..Limits::default()
        };
        for (spent, bytes, now, allows) in [
            (0, 1000, 0, true),
            (0, 1000, 99, true),
            (60, 40, 0, true),
            (60, 41, 0, false),
            (60, 1, 3, true),
            (60, 1, 4, false),
        ] {
            let mut budget = Budget::new(&limits, ms(0));
            budget.spend(spent);
            assert_eq!(
                budget.allows(bytes, ms(now)),
                allows,
                "{spent} + {bytes} at {now}"
            );
        }
    }

    #[test]
    fn pictures_are_drawn_when_they_are_worth_it() {
        let none = Pace {
            last: Some((ms(500), ms(80))),
            ..Pace::default()
        };
        let new_view = Pace {
            view_changed: true,
            ..none
        };
        let all_here = Pace {
            data_changed: true,
            ..none
        };
        let some_here = Pace {
            more_to_come: true,
            ..all_here
        };
        for (pace, draws_at) in [
            (none, None),
            (
                Pace {
                    more_to_come: true,
                    ..none
                },
                None,
            ),
            (new_view, Some(ms(0))),
            (
                Pace {
                    more_to_come: true,
                    unwatched: true,
                    ..new_view
                },
                Some(ms(0)),
            ),
            (all_here, Some(ms(0))),
            (
                Pace {
                    unwatched: true,
                    ..all_here
                },
                Some(ms(0)),
            ),
            (some_here, Some(ms(580))),
            (
                Pace {
                    unwatched: true,
                    ..some_here
                },
                Some(ms(820)),
            ),
            (
                Pace {
                    last: Some((ms(500), ms(9_000))),
                    ..some_here
                },
                Some(ms(1_500)),
            ),
            (
                Pace {
                    last: None,
                    ..some_here
                },
                Some(ms(0)),
            ),
        ] {
            assert_eq!(pace.draws_at(), draws_at, "{pace:?}");
        }
    }

    #[test]
    fn the_last_change_is_always_followed_by_a_histogram() {
        let mut refresh = Refresh::new();
        assert!(refresh.starts(ms(0)), "the first at once");
        assert!(!refresh.starts(ms(10_000)), "nothing changed since");
        let mut starts = 0;
        for now in 10_000..60_000 {
            refresh.changed();
            starts += u32::from(refresh.starts(ms(now)));
        }
        assert!(
            (5..20).contains(&starts),
            "{starts} in 50 s of steady change"
        );
        refresh.changed();
        let due = refresh.due().unwrap();
        assert!(refresh.starts(due) && refresh.due().is_none());
    }
}
