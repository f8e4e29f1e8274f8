//! Files that somebody may still be writing to: copying programs set a file's space aside and fill it, so that a half
//! of it looks like a whole.

use std::collections::{HashSet, VecDeque};
use std::time::{Duration, SystemTime};

use super::Found;
use super::stamp::{Seen, YOUNG};

/// Between looks at one of them.
const PAUSE: Duration = Duration::from_secs(1);

/// Most of them at a time. Of more that come within half a minute, the first are looked at.
const MOST: usize = 100_000;

/// The files, the one that is due next first.
#[derive(Debug)]
pub(super) struct Again<T = Found> {
    files: VecDeque<Fresh<T>>,
    keys: HashSet<u64>,
}

/// A file that was found not long ago.
#[derive(Debug)]
pub(super) struct Fresh<T = Found> {
    pub(super) key: u64,
    pub(super) found: T,
    due: SystemTime,
    until: SystemTime,
    /// What it looks like while it changes.
    changing: Option<Seen>,
}

impl<T> Default for Again<T> {
    fn default() -> Self {
        Self {
            files: VecDeque::new(),
            keys: HashSet::new(),
        }
    }
}

impl<T: Clone> Again<T> {
    /// Takes up a file that was found just now.
    pub(super) fn add(&mut self, key: u64, found: &T, now: SystemTime) {
        if self.files.len() < MOST && self.keys.insert(key) {
            self.files.push_back(Fresh {
                key,
                found: found.clone(),
                due: now + PAUSE,
                until: now + YOUNG,
                changing: None,
            });
        }
    }

    /// Whether it is one of them.
    pub(super) fn holds(&self, key: u64) -> bool {
        self.keys.contains(&key)
    }

    /// Whether one is changing.
    pub(super) fn waits(&self) -> bool {
        self.files.iter().any(|file| file.changing.is_some())
    }

    /// The next that is to be looked at, taken out.
    pub(super) fn due(&mut self, now: SystemTime) -> Option<Fresh<T>> {
        // A clock that was set back makes none wait for it.
        let due = |file: &mut Fresh<T>| file.due <= now || file.due > now + PAUSE;
        self.files.pop_front_if(due)
    }

    /// It was looked at; if it has rested for long enough, that was the last time.
    pub(super) fn put_back(&mut self, mut file: Fresh<T>, now: SystemTime) {
        if file.changing.is_none() && (now >= file.until || file.until > now + YOUNG) {
            self.keys.remove(&file.key);
        } else {
            file.due = now + PAUSE;
            self.files.push_back(file);
        }
    }
}

impl<T> Fresh<T> {
    /// Whether it is another than it was known as, and does not change any more.
    pub(super) fn is_whole_again(&mut self, known: Seen, seen: Seen, now: SystemTime) -> bool {
        if !known.is_replaced_by(seen) {
            self.changing = None;
            return false;
        }
        self.until = now + YOUNG;
        let rests = self.changing == Some(seen);
        self.changing = (!rests).then_some(seen);
        rests
    }
}
