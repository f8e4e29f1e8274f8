//! What time it is, where leases need it.

use std::fmt::Debug;
use std::time::SystemTime;

/// Tells the time. Tests have one that they turn themselves.
pub trait Clock: Debug + Send + Sync {
    /// Now.
    fn now(&self) -> SystemTime;
}

/// The machine's clock.
#[derive(Clone, Copy, Debug, Default)]
pub struct SystemClock;

impl Clock for SystemClock {
    fn now(&self) -> SystemTime {
        SystemTime::now()
    }
}
