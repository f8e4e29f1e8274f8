//! Why work does not go on, for those who look at a volume from elsewhere.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

use saccade_archive::clock::Clock;

use crate::progress::{Progress, State};

/// Who is held up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Part {
    /// Whoever finds out what lies where.
    Watch,
    /// Whoever takes it in.
    Ingest,
    /// Records of which the image is not there, or not whole; the others are taken in meanwhile.
    Images,
}

/// A reason, and since when.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Reason {
    /// In words.
    pub why: String,
    /// Since when that part does not go on, for whatever reason.
    pub since: SystemTime,
}

/// What holds up the parts of an ingest, now. Clones share it: each part tells it what it waits for, and ingest tells
/// the catalog.
#[derive(Clone, Debug, Default)]
pub struct HeldUp(Arc<Mutex<BTreeMap<Part, Reason>>>);

impl HeldUp {
    /// A part waits, or goes on, as of `now`.
    pub fn tell(&self, part: Part, why: Option<&str>, now: SystemTime) {
        let mut reasons = self.lock();
        match (why, reasons.get_mut(&part)) {
            (None, _) => _ = reasons.remove(&part),
            (Some(why), Some(reason)) => why.clone_into(&mut reason.why),
            (Some(why), None) => {
                let (why, since) = (why.to_owned(), now);
                reasons.insert(part, Reason { why, since });
            }
        }
    }

    /// What holds up which part.
    pub fn now(&self) -> Vec<Reason> {
        self.lock().values().cloned().collect()
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<Part, Reason>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The same reasons.
impl PartialEq for HeldUp {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}

/// Hears what ingest is held up by, and passes everything on.
pub(crate) struct Heard<'a> {
    pub(crate) inner: &'a dyn Progress,
    pub(crate) reasons: HeldUp,
    pub(crate) clock: &'a dyn Clock,
}

impl Progress for Heard<'_> {
    fn update(&self, state: &State) {
        self.inner.update(state);
    }

    fn notice(&self, text: &str) {
        self.inner.notice(text);
    }

    fn held_up(&self, why: Option<&str>) {
        self.reasons.tell(Part::Ingest, why, self.clock.now());
        self.inner.held_up(why);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use saccade_archive::clock::PretendClock;

    use super::*;

    #[test]
    fn a_part_waits_since_it_stopped_whatever_it_waits_for() {
        let held = HeldUp::default();
        let whys = |held: &HeldUp| held.now().into_iter().map(|r| r.why).collect::<Vec<_>>();
        let clock = PretendClock::default();
        let since = clock.now();
        held.tell(Part::Ingest, Some("full"), since);
        clock.turn(Duration::from_secs(2));
        held.clone()
            .tell(Part::Ingest, Some("full, still"), clock.now());
        assert_eq!(
            (whys(&held), held.now()[0].since),
            (vec!["full, still".to_owned()], since)
        );
        held.tell(Part::Watch, Some("away"), clock.now());
        assert_eq!(whys(&held), ["away", "full, still"]);
        held.tell(Part::Ingest, None, clock.now());
        assert_eq!(whys(&held), ["away"]);
        held.tell(Part::Ingest, Some("full"), clock.now());
        assert_eq!(held.now()[1].since, clock.now());
    }
}
