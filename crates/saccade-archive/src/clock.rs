//! Time: the machine's, or one that tests turn.

pub mod conformance;

use std::fmt::Debug;
use std::sync::LazyLock;
use std::time::{Duration, Instant, SystemTime};

use futures::FutureExt as _;
use futures::future::BoxFuture;
use tokio::sync::watch;

/// Time that can be read and waited for. Whoever notes times, lets something pass or rests takes it from here, so that
/// tests say how late it is.
///
/// What waits for other programs asks the machine itself: a file's lock, a server's answer and commits of other processes come
/// when they come.
pub trait Clock: Debug + Send + Sync {
    /// The time of day.
    fn now(&self) -> SystemTime;

    /// Time since some fixed moment. It never goes back, whatever the time of day does.
    fn monotonic(&self) -> Duration;

    /// Returns once `duration` has passed.
    fn sleep(&self, duration: Duration) -> BoxFuture<'_, ()>;

    /// The same, of a thread that may block.
    fn block(&self, duration: Duration);
}

/// The machine's clocks.
#[derive(Clone, Copy, Debug, Default)]
pub struct SystemClock;

#[expect(
    clippy::disallowed_methods,
    reason = "the one place that asks the machine"
)]
impl Clock for SystemClock {
    fn now(&self) -> SystemTime {
        SystemTime::now()
    }

    fn monotonic(&self) -> Duration {
        static BEGIN: LazyLock<Instant> = LazyLock::new(Instant::now);
        BEGIN.elapsed()
    }

    fn sleep(&self, duration: Duration) -> BoxFuture<'_, ()> {
        tokio::time::sleep(duration).boxed()
    }

    fn block(&self, duration: Duration) {
        std::thread::sleep(duration);
    }
}

/// A clock that moves when it is turned, for tests. A thread that blocks turns it itself: an hour passes at once.
#[derive(Debug)]
pub struct PretendClock {
    begin: SystemTime,
    passed: watch::Sender<Duration>,
}

impl PretendClock {
    /// Stands still at a time of day.
    pub fn at(begin: SystemTime) -> Self {
        let passed = watch::Sender::new(Duration::ZERO);
        Self { begin, passed }
    }

    /// Lets time pass. Who sleeps until then, or until an earlier moment, wakes.
    pub fn turn(&self, by: Duration) {
        self.passed.send_modify(|passed| *passed += by);
    }
}

/// In the year 2001.
impl Default for PretendClock {
    fn default() -> Self {
        Self::at(SystemTime::UNIX_EPOCH + Duration::from_secs(1_000_000_000))
    }
}

impl Clock for PretendClock {
    fn now(&self) -> SystemTime {
        self.begin + self.monotonic()
    }

    fn monotonic(&self) -> Duration {
        *self.passed.borrow()
    }

    fn sleep(&self, duration: Duration) -> BoxFuture<'_, ()> {
        let end = self.monotonic() + duration;
        let mut passed = self.passed.subscribe();
        async move {
            // The sender lives as long as this does.
            let _ = passed.wait_for(|passed| *passed >= end).await;
        }
        .boxed()
    }

    fn block(&self, duration: Duration) {
        self.turn(duration);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn who_sleeps_wakes_when_the_clock_is_turned_so_far() {
        let clock = PretendClock::default();
        let begin = clock.now();
        let mut asleep = clock.sleep(Duration::from_secs(3600));
        assert!((&mut asleep).now_or_never().is_none());
        clock.turn(Duration::from_secs(3599));
        assert!((&mut asleep).now_or_never().is_none());
        clock.turn(Duration::from_secs(1));
        asleep.await;
        clock.block(Duration::from_secs(5));
        let passed = Duration::from_secs(3605);
        assert_eq!(clock.monotonic(), passed);
        assert_eq!(clock.now(), begin + passed);
        assert!(clock.sleep(Duration::ZERO).now_or_never().is_some());
    }

    #[tokio::test]
    async fn the_machines_time_passes() {
        let clock = SystemClock;
        let (begin, pause) = (clock.monotonic(), Duration::from_millis(2));
        clock.sleep(pause).await;
        clock.block(pause);
        assert!(clock.monotonic() - begin >= 2 * pause);
    }
}
