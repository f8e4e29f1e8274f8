//! Looking, again and again.

use std::time::Duration;

use super::super::looking::{Looks, Passes, look_on};
use super::super::{Folders, Next};
use super::{ListError, ListWatch};
use crate::Cancel;
use crate::held_up::HeldUp;

/// Looks until it is cancelled or, with `once`, until a look finds nothing more; or only until it is known what the
/// volume is. Blocks.
///
/// # Errors
///
/// [`ListError`]: but a list or folder that cannot be read is waited for, with `once` for some looks, and a full disk is
/// waited out. A list that cannot be read from the beginning is an error, unless it may still be written.
pub fn follow<F: Folders>(
    watch: &mut ListWatch<F>,
    until: Until,
    once: bool,
    cancel: &Cancel,
) -> Result<u64, ListError> {
    watch.once = once;
    look_on(watch, once, cancel, |watch| {
        until == Until::Known && watch.is_known()
    })
}

impl<F: Folders> ListWatch<F> {
    /// Whether somebody may still be writing the list: it changed a moment ago, and is not said to be all there.
    pub(super) fn may_grow(&self) -> bool {
        !self.once && self.files.age(self.disk.now()) < self.config.drop_after
    }
}

/// Until when a list is followed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Until {
    /// Until it is settled what the volume is.
    Known,
    /// To the end.
    End,
}

impl<F: Folders> Looks for ListWatch<F> {
    type Error = ListError;

    const BACK: &'static str = "the list and its folder can be read again";

    fn look(&mut self) -> Result<(u64, Next), ListError> {
        Self::look(self)
    }

    fn poll(&self) -> Duration {
        self.config.poll
    }

    fn passes(&self, error: &ListError) -> Passes {
        match error {
            // Half of a first one may be about to become whole.
            ListError::List { .. } if !self.is_known() && self.may_grow() => Passes::Soon,
            ListError::List { .. } | ListError::Gone { .. } if !self.is_known() => Passes::Never,
            error => error.passes(),
        }
    }

    fn waits_for(&self) -> Option<String> {
        let unclear = self.unclear_said.as_ref().map(|(_, said)| said);
        let said = [
            self.unsure.as_ref(),
            self.missing_said.as_ref().or(unclear),
            self.unfit.as_ref().filter(|_| self.missing_said.is_none()),
        ];
        let said: Vec<&str> = said.into_iter().flatten().map(String::as_str).collect();
        (!said.is_empty()).then(|| said.join("; "))
    }

    fn held_up(&self) -> &HeldUp {
        &self.held_up
    }
}
