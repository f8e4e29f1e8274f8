//! Files that are not whole yet: when to look again, when to give up.

use std::collections::BTreeMap;
use std::time::Duration;

use saccade_archive::catalog::Waiting;

use super::absent::Absent;
use super::images::Images;
use super::prepare::{Look, Outcome, Unfit, WaitKind, look, unfit};

/// Longest pause between two looks at a file \[polls\].
const LONGEST_PAUSE: u64 = 16;

/// What is said of a record that was given up since there was no file.
pub(super) const NOT_COME: &str = "It did not come within";

/// The same of one whose file was there before.
pub(super) const NOT_COME_BACK: &str = "The file did not come back within";

/// The records that wait, and what their files looked like.
#[derive(Debug)]
pub(super) struct WaitingRoom {
    records: BTreeMap<u64, Guest>,
    /// Those that were given up since there was no file.
    absent: Absent,
    poll: u64,
    patience: u64,
    interval: Duration,
}

#[derive(Debug)]
struct Guest {
    waiting: Waiting,
    /// At the last attempt to decode it; the outer `None`: not in this process.
    look: Option<Option<Look>>,
    kind: WaitKind,
    /// Of the last change that was seen.
    since: u64,
    pause: u64,
    next: u64,
    /// Whether people know that it waits.
    told: bool,
}

/// What to do for a record that waits.
#[derive(Debug)]
pub(super) enum Due {
    /// Its file changed: try again.
    Retry(Waiting),
    /// Its file has not changed for too long.
    GiveUp { position: u64, outcome: Outcome },
}

impl WaitingRoom {
    /// With the records that waited when an earlier process ended.
    pub(super) fn new(patience: u32, interval: Duration, waiting: Vec<Waiting>) -> Self {
        let records = waiting.into_iter().map(|waiting| {
            let kind = WaitKind::Incomplete;
            let guest = Guest {
                waiting,
                look: None,
                kind,
                since: 0,
                pause: 1,
                next: 0,
                told: false,
            };
            (guest.waiting.position, guest)
        });
        let records = records.collect();
        Self {
            records,
            absent: Absent::default(),
            poll: 0,
            patience: u64::from(patience),
            interval,
        }
    }

    pub(super) fn len(&self) -> u64 {
        self.records.len() as u64
    }

    /// A record has to wait, for the first time or again.
    pub(super) fn admit(&mut self, waiting: Waiting, look: Option<Look>, kind: WaitKind) {
        let poll = self.poll;
        let position = waiting.position;
        let guest = Guest {
            waiting,
            look: Some(look),
            kind,
            since: poll,
            pause: 1,
            next: poll + 1,
            told: self.records.get(&position).is_some_and(|guest| guest.told),
        };
        self.records.insert(position, guest);
    }

    /// What to say of files that do not change, each once, and of many at once the first ones.
    pub(super) fn news(&mut self, images: Images<'_>) -> Vec<String> {
        const AT_ONCE: usize = 3;
        // Most are whole a moment after their record.
        let patience = (self.patience / 15).max(2);
        let poll = self.poll;
        let mut told = Vec::new();
        let mut more = 0;
        for guest in self.records.values_mut() {
            let waits = guest.kind == WaitKind::Incomplete && poll - guest.since >= patience;
            if guest.told || !waits {
                continue;
            }
            guest.told = true;
            if told.len() == AT_ONCE {
                more += 1;
                continue;
            }
            let Waiting { record, reason, .. } = &guest.waiting;
            told.push(format!(
                "{} (tile {}) is waited for: {reason}",
                images.name(&record.file),
                record.tile
            ));
        }
        if more > 0 {
            told.push(format!("{more} more files are waited for"));
        }
        told
    }

    /// Which images people know to be waited for, in words.
    pub(super) fn waits_for(&self, images: Images<'_>) -> Option<String> {
        let mut told = self.records.values().filter(|guest| guest.told);
        let Waiting { record, reason, .. } = &told.next()?.waiting;
        let first = format!(
            "{} (tile {}): {reason}",
            images.name(&record.file),
            record.tile
        );
        Some(match 1 + told.count() {
            1 => format!("an image is waited for: {first}"),
            all => format!("{all} images are waited for, such as {first}"),
        })
    }

    /// Records that were given up since there was no file, of which there is one now.
    pub(super) fn came(&mut self, images: Images<'_>) -> Vec<Waiting> {
        self.absent.came(images)
    }

    /// Looks for the image of a record that an earlier process gave up.
    pub(super) fn look_for(&mut self, waiting: Waiting) {
        self.absent.add(waiting);
    }

    /// Whether each of those was looked for.
    pub(super) fn has_looked_for_all(&self) -> bool {
        self.absent.are_all_looked_for()
    }

    /// A record is done with, whatever became of it.
    pub(super) fn leave(&mut self, position: u64) {
        self.records.remove(&position);
    }

    /// One more poll: the records to do something for, at most `max`.
    pub(super) fn due(&mut self, images: Images<'_>, max: usize) -> Vec<Due> {
        self.poll += 1;
        let poll = self.poll;
        let mut due = Vec::new();
        for guest in self.records.values_mut().filter(|g| g.next <= poll) {
            if due.len() == max {
                break;
            }
            let now = images.path(&guest.waiting.record.file);
            let now = now.and_then(|path| look(&path));
            if guest.look != Some(now) {
                // Not again before this attempt is over, which readmits it or lets it leave.
                guest.next = u64::MAX;
                due.push(Due::Retry(guest.waiting.clone()));
                continue;
            }
            let patience = match guest.kind {
                WaitKind::Incomplete => self.patience,
                WaitKind::Broken => 1,
            };
            let unchanged = poll - guest.since;
            if unchanged < patience {
                guest.next = poll + guest.pause.min(patience - unchanged);
                guest.pause = (guest.pause * 2).min(LONGEST_PAUSE);
                continue;
            }
            guest.next = u64::MAX;
            let Waiting {
                position,
                record,
                reason,
            } = &guest.waiting;
            let polls = u32::try_from(unchanged).unwrap_or(u32::MAX);
            let seconds = self.interval.saturating_mul(polls).as_secs_f64();
            let again = images.again();
            let is_absent = guest.kind == WaitKind::Incomplete && now.is_none();
            let reason = match guest.kind {
                _ if is_absent => {
                    self.absent.add(guest.waiting.clone());
                    let not_come = match images.are_watched() {
                        true => NOT_COME_BACK,
                        false => NOT_COME,
                    };
                    format!(
                        "{reason}. {not_come} {seconds:.1} s; once it is there, `saccade ingest` takes it in, also when it is \
                         started again: you need not {again}"
                    )
                }
                WaitKind::Incomplete => format!(
                    "{reason}. The file has not changed for {seconds:.1} s; once it is mended, {again}"
                ),
                WaitKind::Broken => format!("{reason}. Once the file is mended, {again}"),
            };
            let what = Unfit {
                awaited: is_absent.then_some(*position),
                ..unfit(images, record, reason, now.map(|l| l.bytes))
            };
            let outcome = Outcome::Quarantine {
                what,
                pyramid: None,
            };
            due.push(Due::GiveUp {
                position: *position,
                outcome,
            });
        }
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::UVec2;
    use saccade_archive::acquisition::TileRecord;
    use saccade_core::transform::SectionFromTile;

    fn waiting(position: u64, file: &str) -> Waiting {
        let record = TileRecord {
            tile: file.to_owned(),
            file: file.to_owned(),
            section: 0,
            size: UVec2::ONE,
            transform: SectionFromTile::IDENTITY,
            channel: None,
        };
        Waiting {
            position,
            record,
            reason: "it ends early".to_owned(),
        }
    }

    fn images(folder: &tempfile::TempDir) -> Images<'_> {
        Images::new(folder.path(), None)
    }

    fn room(patience: u32) -> WaitingRoom {
        WaitingRoom::new(patience, Duration::from_secs(1), Vec::new())
    }

    #[test]
    fn patience_ends_exactly_when_it_should() {
        let folder = tempfile::tempdir().unwrap();
        for patience in [1, 2, 7, 100] {
            let mut room = room(patience);
            room.admit(waiting(5, "missing.tif"), None, WaitKind::Incomplete);
            for _ in 1..patience {
                assert!(room.due(images(&folder), 9).is_empty());
            }
            let due = room.due(images(&folder), 9);
            assert!(
                matches!(due[..], [Due::GiveUp { position: 5, .. }]),
                "{due:?}"
            );
            room.leave(5);
            assert_eq!(room.len(), 0);
        }
    }

    #[test]
    fn a_growing_file_is_never_given_up() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.tif");
        let mut room = room(3);
        let mut retries = 0;
        room.admit(waiting(5, "a.tif"), None, WaitKind::Incomplete);
        for poll in 0..60 {
            if poll % 2 == 0 {
                std::fs::write(&path, vec![0; poll + 1]).unwrap();
            }
            for due in room.due(images(&folder), 9) {
                let Due::Retry(waiting) = due else {
                    panic!("gave up at poll {poll}")
                };
                retries += 1;
                room.admit(waiting, look(&path), WaitKind::Incomplete);
            }
        }
        assert!(retries >= 20, "only {retries} attempts");
    }

    #[test]
    fn who_waits_is_told_once_and_not_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let mut room = room(120);
        for n in 0..5 {
            room.admit(waiting(n, &format!("{n}.tif")), None, WaitKind::Incomplete);
        }
        room.admit(waiting(9, "broken.tif"), None, WaitKind::Broken);
        let mut told = Vec::new();
        for poll in 1..=40 {
            assert!(room.due(images(&folder), 0).is_empty());
            let now = room.news(images(&folder));
            assert!(now.is_empty() || poll == 8, "poll {poll}: {now:?}");
            assert_eq!(room.waits_for(images(&folder)).is_some(), poll >= 8);
            told.extend(now);
        }
        assert_eq!(told.len(), 4, "{told:?}");
        assert_eq!(told[1], "1.tif (tile 1.tif) is waited for: it ends early");
        assert_eq!(told[3], "2 more files are waited for");
        // Not again when it was tried again in vain.
        room.admit(waiting(1, "1.tif"), None, WaitKind::Incomplete);
        for _ in 0..40 {
            room.due(images(&folder), 0);
            assert!(room.news(images(&folder)).is_empty());
        }
        let why = room.waits_for(images(&folder)).unwrap();
        assert_eq!(
            why,
            "5 images are waited for, such as 0.tif (tile 0.tif): it ends early"
        );
        for n in 0..4 {
            room.leave(n);
        }
        let why = room.waits_for(images(&folder)).unwrap();
        assert_eq!(
            why,
            "an image is waited for: 4.tif (tile 4.tif): it ends early"
        );
        room.leave(4);
        assert_eq!(room.waits_for(images(&folder)), None);
    }

    #[test]
    fn a_broken_file_gets_one_more_look() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.tif");
        std::fs::write(&path, "x").unwrap();
        let mut room = room(100);
        room.admit(waiting(5, "a.tif"), look(&path), WaitKind::Broken);
        assert!(matches!(
            room.due(images(&folder), 9)[..],
            [Due::GiveUp { .. }]
        ));
    }

    #[test]
    fn records_of_an_earlier_process_are_tried_first() {
        let folder = tempfile::tempdir().unwrap();
        let guests = vec![waiting(1, "a.tif"), waiting(2, "b.tif")];
        let mut room = WaitingRoom::new(9, Duration::from_secs(1), guests);
        assert!(matches!(room.due(images(&folder), 1)[..], [Due::Retry(_)]));
        assert!(
            matches!(room.due(images(&folder), 9)[..], [Due::Retry(_)]),
            "the other one"
        );
        assert!(
            room.due(images(&folder), 9).is_empty(),
            "both are being tried"
        );
    }
}
