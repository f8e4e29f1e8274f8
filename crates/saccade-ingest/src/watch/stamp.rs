//! What tells whether a file was replaced or written to.

use std::fs::Metadata;
use std::hash::{BuildHasher, BuildHasherDefault, DefaultHasher};
use std::io;
use std::time::{Duration, SystemTime};

/// What changes when a file does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Stamp {
    /// Length \[bytes\].
    pub bytes: u64,
    /// Last modification, as who wrote it says: copying programs say when the original was modified.
    pub modified: SystemTime,
    /// When the system last noted a change of the file or of what is said of it, if it does.
    pub changed: Option<SystemTime>,
    /// The file's number on its disk, if it has one.
    pub number: Option<u64>,
}

impl Stamp {
    /// As the system says.
    ///
    /// # Errors
    ///
    /// If it keeps no times.
    pub(crate) fn of(metadata: &Metadata) -> io::Result<Self> {
        let (changed, number) = of_inode(metadata);
        Ok(Self {
            bytes: metadata.len(),
            modified: metadata.modified()?,
            changed,
            number,
        })
    }

    /// When it changed last.
    pub(super) fn last(&self) -> SystemTime {
        self.changed
            .map_or(self.modified, |at| at.max(self.modified))
    }

    /// Whether it changed so recently that somebody may still be at it. What is to come is as young.
    pub(super) fn is_young(&self, now: SystemTime) -> bool {
        let last = self.last();
        now.duration_since(last).is_ok_and(|age| age < YOUNG) || last > now
    }
}

/// For how long somebody may be at a file that does not change.
pub(super) const YOUNG: Duration = Duration::from_secs(30);

/// When it changed, and its number.
#[cfg(unix)]
fn of_inode(metadata: &Metadata) -> (Option<SystemTime>, Option<u64>) {
    use std::os::unix::fs::MetadataExt as _;
    let whole = u64::try_from(metadata.ctime()).map(Duration::from_secs);
    let rest = u64::try_from(metadata.ctime_nsec()).map(Duration::from_nanos);
    let since = whole.ok().zip(rest.ok()).map(|(whole, rest)| whole + rest);
    let changed = since.and_then(|since| SystemTime::UNIX_EPOCH.checked_add(since));
    (changed, Some(metadata.ino()))
}

/// This system says nothing of the kind.
#[cfg(not(unix))]
fn of_inode(_: &Metadata) -> (Option<SystemTime>, Option<u64>) {
    (None, None)
}

/// A stamp as it is kept for every file: in eight bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Seen {
    /// Of length and modification.
    content: u32,
    changed: u16,
    number: u16,
}

impl Seen {
    pub(super) fn of(stamp: &Stamp) -> Self {
        let hasher = BuildHasherDefault::<DefaultHasher>::default();
        let short = |hash: u64| (hash >> 48) as u16;
        Self {
            content: (hasher.hash_one((stamp.bytes, stamp.modified)) >> 32) as u32,
            changed: short(hasher.hash_one(stamp.changed)),
            number: short(hasher.hash_one(stamp.number)),
        }
    }

    /// Whether a file that looks so now is another than it was, or has another content. One that was put in its
    /// place, of the same length and time, has another number and was changed. Neither alone says anything: links and
    /// permissions change a file, and some shares number files as they go.
    pub(super) fn is_replaced_by(self, now: Self) -> bool {
        let is_known = self.number != 0 || self.changed != 0;
        let moved_in = is_known && self.number != now.number && self.changed != now.changed;
        !self.has_content_of(now) || moved_in
    }

    /// Whether a file of one stamp has the length and time of that of another.
    pub(super) fn has_content_of(self, other: Self) -> bool {
        self.content == other.content
    }

    /// What is kept of a file that was told of and of which nothing is known.
    pub(super) const UNKNOWN: Self = Self {
        content: 0,
        changed: 0,
        number: 0,
    };

    /// What is known, if anything is.
    pub(super) fn known(self) -> Option<Self> {
        (self != Self::UNKNOWN).then_some(self)
    }

    /// Whether it is what [`Self::of_any_file`] says: another file of the same content is not told from that one.
    pub(super) fn is_of_any_file(self) -> bool {
        self.changed == 0 && self.number == 0
    }

    /// Without what another file of the same content has otherwise.
    pub(super) fn of_any_file(self) -> Self {
        Self {
            changed: 0,
            number: 0,
            ..self
        }
    }

    pub(super) fn to_bits(self) -> u64 {
        u64::from(self.content) << 32 | u64::from(self.changed) << 16 | u64::from(self.number)
    }

    pub(super) fn from_bits(bits: u64) -> Self {
        Self {
            content: (bits >> 32) as u32,
            changed: (bits >> 16 & 0xffff) as u16,
            number: (bits & 0xffff) as u16,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_put_in_the_place_of_a_file_is_told_from_the_same_file() {
        let at = |seconds| SystemTime::UNIX_EPOCH + Duration::from_secs(seconds);
        let stamp = |bytes, modified, changed, number| Stamp {
            bytes,
            modified: at(modified),
            changed: Some(at(changed)),
            number: Some(number),
        };
        let first = stamp(9, 5, 5, 1);
        for (then, replaced) in [
            (first, false),
            (stamp(8, 5, 6, 1), true),
            (stamp(9, 6, 6, 1), true),
            // Renamed over, with the length and time of the old one.
            (stamp(9, 5, 6, 2), true),
            // Linked, or of other permissions; numbered anew.
            (stamp(9, 5, 6, 1), false),
            (stamp(9, 5, 5, 2), false),
        ] {
            let [before, now] = [first, then].map(|stamp| Seen::of(&stamp));
            assert_eq!(before.is_replaced_by(now), replaced, "{then:?}");
            assert_eq!(Seen::from_bits(now.to_bits()), now);
        }
        // On another disk, where it was copied to, and what comes into its place there.
        let known = Seen::of(&first).of_any_file();
        assert!(!known.is_replaced_by(Seen::of(&stamp(9, 5, 7, 3))));
        assert!(known.is_replaced_by(Seen::of(&stamp(9, 6, 7, 3))));
        for (age, young) in [(0, true), (29, true), (31, false)] {
            assert_eq!(first.is_young(at(5 + age)), young, "{age}");
            assert_eq!(stamp(9, 1, 5, 1).is_young(at(5 + age)), young, "{age}");
        }
    }
}
