//! What files looked like when they were told of, kept beside the records, so that a later process knows which were
//! replaced meanwhile. It is of use and not needed: where it is missing, their times alone are asked.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufReader, Read as _, Write as _};
use std::path::{Path, PathBuf};

use super::stamp::Seen;

/// Name of the file: sixteen bytes for each time that a file was told of, of which the last counts.
const FILE: &str = "stamps";

/// Bytes of an entry.
const ENTRY: usize = 16;

#[derive(Debug)]
pub(super) struct Stamps {
    path: PathBuf,
    /// Whether it was said that they cannot be kept.
    warned: bool,
}

impl Stamps {
    pub(super) fn new(kept: &Path) -> Self {
        Self {
            path: kept.join(FILE),
            warned: false,
        }
    }

    /// Keeps what is the same of copies elsewhere, because the files were moved.
    pub(super) fn keep_content(&self) {
        self.rewrite(Seen::of_any_file);
    }

    /// Forgets what files looked like, because they were moved and may have other times, and not how often they were told of.
    pub(super) fn keep_count(&self) {
        self.rewrite(|_| Seen::UNKNOWN);
    }

    /// What cannot be kept is forgotten.
    fn rewrite(&self, as_now: impl Fn(Seen) -> Seen) {
        let mut all = Vec::new();
        self.each(|key, seen| all.push([as_now(seen).to_bits(), key].map(u64::to_le_bytes)));
        let part = self.path.with_extension("part");
        let bytes = all.as_flattened().as_flattened();
        if let Err(e) = fs::write(&part, bytes).and_then(|()| fs::rename(&part, &self.path)) {
            log::warn!("cannot write {}: {e}", self.path.display());
            self.forget();
        }
    }

    /// Forgets all.
    fn forget(&self) {
        match fs::remove_file(&self.path) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => {
                log::warn!("cannot remove {}: {e}", self.path.display());
            }
            Ok(()) | Err(_) => {}
        }
    }

    /// All entries, in order.
    pub(super) fn each(&self, mut take: impl FnMut(u64, Seen)) {
        let Ok(file) = File::open(&self.path) else {
            return;
        };
        let mut file = BufReader::new(file);
        let mut entry = [[0; ENTRY / 2]; 2];
        while file.read_exact(entry.as_flattened_mut()).is_ok() {
            let [seen, key] = entry.map(u64::from_le_bytes);
            take(key, Seen::from_bits(seen));
        }
    }

    /// Adds entries. Without them files may be told of once more, or not, which is no reason to stop.
    pub(super) fn add(&mut self, entries: &[(u64, Seen)]) {
        if entries.is_empty() {
            return;
        }
        let entry = |(key, seen): &(u64, Seen)| [seen.to_bits(), *key].map(u64::to_le_bytes);
        let bytes: Vec<u8> = entries.iter().flat_map(entry).flatten().collect();
        match self.append(&bytes) {
            Ok(()) => self.warned = false,
            Err(e) if !self.warned => {
                self.warned = true;
                log::warn!("cannot write {}: {e}", self.path.display());
            }
            Err(_) => {}
        }
    }

    fn append(&self, bytes: &[u8]) -> io::Result<()> {
        let mut options = OpenOptions::new();
        let mut file = options.append(true).create(true).open(&self.path)?;
        let len = file.metadata()?.len();
        // A writer that died may have left half an entry.
        let half = len % ENTRY as u64;
        if half > 0 {
            file.set_len(len - half)?;
        }
        file.write_all(bytes)
    }
}

/// What an earlier process, or anybody, left: whole entries are read, half a one is not, and what is added comes behind.
#[cfg(any(test, fuzzing))]
pub(crate) fn fuzz(bytes: &[u8]) {
    use crate::fuzz_targets::scratch::Scratch;

    let scratch = Scratch::new("stamps");
    scratch.write(FILE, bytes);
    let mut stamps = Stamps::new(scratch.path());
    let all = |stamps: &Stamps| {
        let mut all = Vec::new();
        stamps.each(|key, seen| all.push((key, seen)));
        all
    };
    let before = all(&stamps);
    assert_eq!(before.len(), bytes.len() / ENTRY);
    for ((key, seen), entry) in before.iter().zip(bytes.chunks(ENTRY)) {
        assert_eq!(
            [seen.to_bits(), *key].map(u64::to_le_bytes).as_flattened(),
            entry
        );
    }
    let added = [
        (7, Seen::from_bits(3)),
        (u64::MAX, Seen::from_bits(u64::MAX)),
    ];
    stamps.add(&added);
    let all_now = [before, added.to_vec()].concat();
    assert_eq!(all(&stamps), all_now);
    stamps.keep_content();
    let content = all_now.iter().map(|(key, seen)| (*key, seen.of_any_file()));
    assert_eq!(all(&stamps), content.collect::<Vec<_>>());
    stamps.keep_count();
    let count = all_now.iter().map(|(key, _)| (*key, Seen::UNKNOWN));
    assert_eq!(all(&stamps), count.collect::<Vec<_>>());
    stamps.forget();
    assert_eq!(all(&stamps), []);
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use super::super::Stamp;
    use super::*;

    #[test]
    fn entries_outlive_half_a_one() {
        let folder = tempfile::tempdir().unwrap();
        let mut stamps = Stamps::new(folder.path());
        let seen = |bytes| {
            Seen::of(&Stamp {
                bytes,
                modified: SystemTime::UNIX_EPOCH,
                changed: None,
                number: Some(bytes),
            })
        };
        let all = || {
            let mut all = Vec::new();
            Stamps::new(folder.path()).each(|key, seen| all.push((key, seen)));
            all
        };
        assert_eq!(all(), []);
        let entries = [(u64::MAX, seen(1)), (7, seen(2)), (7, seen(3))];
        stamps.add(&entries[..2]);
        let mut bytes = fs::read(&stamps.path).unwrap();
        bytes.extend([1, 2, 3]);
        fs::write(&stamps.path, bytes).unwrap();
        assert_eq!(all(), entries[..2]);
        stamps.add(&entries[2..]);
        assert_eq!(all(), entries);
        stamps.forget();
        assert_eq!(all(), []);
    }
}
