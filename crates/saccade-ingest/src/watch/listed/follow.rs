//! Looking, again and again.

use std::fmt::Write as _;
use std::time::Duration;

use super::super::{Folders, Next};
use super::{ListError, ListWatch};
use crate::Cancel;

/// Looks until it is cancelled or, with `once`, until a look finds nothing more; or only until it is known what the
/// volume is. Blocks.
///
/// # Errors
///
/// [`ListError`]: but a list or folder that cannot be read is waited for, with `once` for some looks, and a full disk is
/// waited out. A list that cannot be read from the beginning is an error.
pub fn follow<F: Folders>(
    watch: &mut ListWatch<F>,
    until: Until,
    once: bool,
    cancel: &Cancel,
) -> Result<u64, ListError> {
    /// Looks at what stays as it is after which it is said again.
    const SAY_AGAIN: u32 = 240;
    /// Looks at what cannot be read, for those who wait for the end.
    const LOOKS_ONCE: u32 = 10;
    let mut told = 0;
    let (mut failures, mut said): (u32, _) = (0, String::new());
    while !cancel.is_cancelled() {
        match watch.look() {
            Ok((new, next)) => {
                if failures > 0 {
                    log::warn!("the list and its folder can be read again");
                    (failures, said) = (0, String::new());
                }
                told += new;
                match (until, next) {
                    (Until::Known, _) if watch.is_known() => break,
                    (_, Next::More) => continue,
                    (Until::End, Next::Rest) if once => break,
                    (_, Next::Again | Next::Rest) => {}
                }
            }
            Err(e) => {
                let unknown = matches!(e, ListError::List { .. } | ListError::Gone { .. })
                    && !watch.is_known();
                let passes = e.may_pass() && !unknown && (!once || failures < LOOKS_ONCE);
                if !passes && !e.is_full() {
                    return Err(e);
                }
                let what = error_words(&e);
                if what != said || failures.is_multiple_of(SAY_AGAIN) {
                    log::warn!("{what}; trying again");
                    said = what;
                }
                failures = failures.saturating_add(1);
            }
        }
        let mut left = watch.config.poll;
        while !left.is_zero() && !cancel.is_cancelled() {
            let nap = left.min(Duration::from_millis(50));
            std::thread::sleep(nap);
            left -= nap;
        }
    }
    Ok(told)
}

/// Until when a list is followed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Until {
    /// Until it is settled what the volume is.
    Known,
    /// To the end.
    End,
}

/// An error and what is behind it, in one line.
fn error_words(error: &dyn std::error::Error) -> String {
    let mut words = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        _ = write!(words, ": {error}");
        source = error.source();
    }
    words
}
