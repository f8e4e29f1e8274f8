use std::time::Duration;

use web_time::Instant;

/// Time since it was started; runs in browsers, too.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Clock(Instant);

impl Clock {
    #[cfg_attr(
        not(target_family = "wasm"),
        expect(
            clippy::disallowed_methods,
            reason = "natively this is the ban's own replacement"
        )
    )]
    pub(crate) fn start() -> Self {
        Self(Instant::now())
    }

    pub(crate) fn now(&self) -> Duration {
        self.0.elapsed()
    }
}
