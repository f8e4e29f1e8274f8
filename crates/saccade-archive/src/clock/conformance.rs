//! What every [`Clock`] must do.

use std::time::Duration;

use futures::FutureExt as _;

use super::Clock;

/// Checks a clock. `pass` lets time pass; where it passes by itself, it does nothing.
///
/// # Panics
///
/// If the clock breaks its contract: this is a test.
pub async fn check(clock: &dyn Clock, pass: impl Fn(Duration)) {
    let step = Duration::from_millis(4);
    let begin = (clock.monotonic(), clock.now());
    assert!(clock.monotonic() >= begin.0, "it went back");

    clock.sleep(Duration::ZERO).await;
    let mut long = clock.sleep(Duration::from_secs(3600));
    assert!((&mut long).now_or_never().is_none(), "an hour passed");

    // Counted from when it was asked for, not from when somebody looks.
    let before = clock.monotonic();
    let asleep = clock.sleep(step);
    pass(step / 2);
    pass(step - step / 2);
    asleep.await;
    let woken = clock.monotonic();
    assert!(woken - before >= step, "it woke early");

    clock.block(step);
    assert!(clock.monotonic() - woken >= step, "it blocked for less");
    assert!((&mut long).now_or_never().is_none(), "an hour passed");

    // Who sleeps for less wakes first, however they are asked.
    let (late, soon) = (clock.sleep(Duration::from_secs(60)), clock.sleep(step));
    pass(step);
    soon.await;
    assert!(late.now_or_never().is_none(), "both woke");
    assert!(clock.now() >= begin.1 && clock.monotonic() >= begin.0 + step * 3);
}

#[cfg(test)]
mod tests {
    use std::panic::AssertUnwindSafe;
    use std::time::SystemTime;

    use futures::future::BoxFuture;

    use super::super::{PretendClock, SystemClock};
    use super::*;

    #[tokio::test]
    async fn clocks_conform() {
        check(&SystemClock, |_| ()).await;
        let clock = PretendClock::default();
        check(&clock, |by| clock.turn(by)).await;
    }

    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    enum Fault {
        SleepsNot,
        SleepsTwice,
        BlocksNot,
        GoesBack,
    }

    #[derive(Debug)]
    struct Wrong(PretendClock, Fault);

    impl Clock for Wrong {
        fn now(&self) -> SystemTime {
            match self.1 {
                Fault::GoesBack => {
                    SystemTime::UNIX_EPOCH + (Duration::MAX / 8 - self.0.monotonic()) / 64
                }
                _ => self.0.now(),
            }
        }

        fn monotonic(&self) -> Duration {
            self.0.monotonic()
        }

        fn sleep(&self, duration: Duration) -> BoxFuture<'_, ()> {
            match self.1 {
                Fault::SleepsNot => std::future::ready(()).boxed(),
                Fault::SleepsTwice => self.0.sleep(duration * 2),
                _ => self.0.sleep(duration),
            }
        }

        fn block(&self, duration: Duration) {
            if self.1 != Fault::BlocksNot {
                self.0.block(duration);
            }
        }
    }

    #[tokio::test]
    async fn clocks_that_are_wrong_are_noticed() {
        use Fault::{BlocksNot, GoesBack, SleepsNot, SleepsTwice};
        for fault in [SleepsNot, SleepsTwice, BlocksNot, GoesBack] {
            let clock = Wrong(PretendClock::default(), fault);
            let checked = check(&clock, |by| clock.0.turn(by));
            // One that sleeps for too long never wakes.
            let checked = AssertUnwindSafe(checked).catch_unwind().now_or_never();
            assert!(!matches!(checked, Some(Ok(()))), "{fault:?} is not noticed");
        }
    }
}
