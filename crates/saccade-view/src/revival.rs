//! How often a lost device is replaced.

use std::time::Duration;

/// The devices that were lost and replaced.
#[derive(Clone, Debug, Default)]
pub(crate) struct Revivals {
    /// When, since the start.
    at: Vec<Duration>,
}

impl Revivals {
    /// Devices lost within [`Self::WITHIN`] that are replaced.
    const MOST: usize = 3;
    /// A driver that loses each device as soon as it draws does so in less.
    const WITHIN: Duration = Duration::from_secs(120);

    /// Whether the device that is lost now is to be replaced.
    pub(crate) fn may_revive(&mut self, now: Duration) -> bool {
        self.at.retain(|at| now.saturating_sub(*at) < Self::WITHIN);
        let may = self.at.len() < Self::MOST;
        self.at.push(now);
        may
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_that_are_lost_one_after_another_are_given_up() {
        let mut revivals = Revivals::default();
        let mut at = |seconds| revivals.may_revive(Duration::from_secs(seconds));
        assert!(
            at(1000) && at(1001) && at(1002),
            "a card may come back slowly"
        );
        assert!(!at(1003), "this one does not");
        assert!(!at(1100));
        assert!(at(1300), "later losses are others");
    }

    #[test]
    fn now_and_then_is_no_trouble() {
        let mut revivals = Revivals::default();
        for minutes in 1..100 {
            assert!(revivals.may_revive(Duration::from_secs(60 * minutes)));
        }
    }
}
