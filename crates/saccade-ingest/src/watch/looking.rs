//! Looking, again and again: how everything without records is followed.

use std::error::Error;
use std::time::Duration;

use saccade_archive::clock::{Clock as _, SystemClock};

use super::Next;
use crate::held_up::{HeldUp, Part};
use crate::words::with_causes;
use crate::{Cancel, watch::WatchError};

/// What is followed by looks.
pub(super) trait Looks {
    type Error: Error + 'static;

    /// What is said once looks succeed again.
    const BACK: &'static str;

    /// One look; how many records were written, and what to do next.
    fn look(&mut self) -> Result<(u64, Next), Self::Error>;

    /// Pause between looks.
    fn poll(&self) -> Duration;

    /// Whether a later look may succeed.
    fn passes(&self, error: &Self::Error) -> Passes;

    /// What is waited for though looks succeed, in words.
    fn waits_for(&self) -> Option<String>;

    /// Who is told why nothing is found.
    fn held_up(&self) -> &HeldUp;
}

/// Whether a failure passes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Passes {
    /// Never.
    Never,
    /// Somebody may be about to mend it: who looks once waits for some looks.
    Soon,
    /// When somebody makes room, however long that takes.
    Some,
}

impl Passes {
    /// Of what befalls every kind of watch.
    pub(super) fn of(error: &WatchError) -> Self {
        match error {
            WatchError::Look { .. } => Self::Soon,
            full if full.is_full() => Self::Some,
            _ => Self::Never,
        }
    }
}

/// Looks until it is cancelled, or `known`, or, with `once`, until a look finds nothing more. Blocks.
pub(super) fn look_on<L: Looks>(
    watch: &mut L,
    once: bool,
    cancel: &Cancel,
    known: impl Fn(&L) -> bool,
) -> Result<u64, L::Error> {
    /// Looks at what stays as it is after which it is said again.
    const SAY_AGAIN: u32 = 240;
    /// Looks that fail, for those who wait for the end.
    const LOOKS_ONCE: u32 = 10;
    let mut told = 0;
    let (mut failures, mut said): (u32, _) = (0, String::new());
    while !cancel.is_cancelled() {
        match watch.look() {
            Ok((new, next)) => {
                if failures > 0 {
                    log::warn!("{}", L::BACK);
                    (failures, said) = (0, String::new());
                }
                told += new;
                watch
                    .held_up()
                    .tell(Part::Watch, watch.waits_for().as_deref(), SystemClock.now());
                match next {
                    _ if known(watch) => break,
                    Next::More => continue,
                    Next::Rest if once => break,
                    Next::Again | Next::Rest => {}
                }
            }
            Err(e) => {
                let goes_on = match watch.passes(&e) {
                    Passes::Never => false,
                    Passes::Soon => !once || failures < LOOKS_ONCE,
                    Passes::Some => true,
                };
                if !goes_on {
                    return Err(e);
                }
                let what = with_causes(&e);
                watch
                    .held_up()
                    .tell(Part::Watch, Some(&what), SystemClock.now());
                if what != said || failures.is_multiple_of(SAY_AGAIN) {
                    log::warn!("{what}; trying again");
                    said = what;
                }
                failures = failures.saturating_add(1);
            }
        }
        let mut left = watch.poll();
        while !left.is_zero() && !cancel.is_cancelled() {
            let nap = left.min(Duration::from_millis(50));
            SystemClock.block(nap);
            left -= nap;
        }
    }
    Ok(told)
}
