//! Folders that lie elsewhere than they did, told from others of the same name.
//!
//! A backlog of folders that are all called alike, one after the other in one place, would be taken for one that moves: what the first
//! showed would stay where the others have images of the same names.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::thread;

use saccade_archive::acquisition::{Cursor, Record, RecordReader};

use super::list::List;
use super::scan::Folders;
use super::stamp::Seen;
use super::stamps::Stamps;
use super::{LINK, WatchError, file_name, link};

/// Images that are compared.
const COMPARED: usize = 256;

/// Images that are looked for.
const LOOKED_FOR: usize = 16 * COMPARED;

/// The folder that the link leads to, if that is there and another than `folder`.
pub(super) fn still_there(folder: &Path, kept: &Path) -> Option<PathBuf> {
    let there = fs::read_link(kept.join(LINK)).ok()?;
    // One that has moved may have left a link to where it is.
    let is_another = there.canonicalize().is_ok_and(|there| there != folder);
    is_another.then_some(there)
}

/// Has the link lead to `folder`, if that is the one that it led to: also to one that has moved, unless less than half of the images that
/// are compared look as they did. Those that do are not told again; with `moved`, times alone say which do.
///
/// # Errors
///
/// [`WatchError::Another`], [`WatchError::Led`]; what the system says.
pub(super) fn go_on(
    disk: &impl Folders,
    folder: &Path,
    kept: &Path,
    moved: bool,
    key: impl Fn(&str) -> u64,
) -> Result<Stamps, WatchError> {
    let stamps = Stamps::new(kept);
    let gone = fs::read_link(kept.join(LINK)).ok();
    let Some(was) = gone.filter(|was| was != folder) else {
        link(folder, kept)?;
        return Ok(stamps);
    };
    if is_led(kept)? {
        let folder = folder.to_owned();
        return Err(WatchError::Led { was, folder });
    }
    let likeness = compare(disk, folder, kept, &stamps, key)?;
    if !moved && !likeness.is_the_same() {
        return Err(WatchError::Another {
            was,
            folder: folder.to_owned(),
            looked_for: likeness.looked_for,
            found: likeness.found,
            same: likeness.same,
        });
    }
    log::warn!(
        "the folder that is followed has moved from {} to here: of {} images that were compared {} look as they did, and others are taken in \
         anew: {}",
        was.display(),
        likeness.found,
        likeness.same,
        folder.display()
    );
    if link(folder, kept)? {
        match () {
            () if moved => stamps.keep_count(),
            // Renamed with all that is in it.
            () if likeness.untouched * 2 > likeness.found => {}
            // Copies are other files.
            () => stamps.keep_content(),
        }
    }
    Ok(stamps)
}

/// Whether another process writes the records.
fn is_led(kept: &Path) -> Result<bool, WatchError> {
    // Somebody else may be looking just now, or begin another program, for some milliseconds.
    for _ in 0..1000 {
        if List::open(kept)?.is_some() {
            return Ok(false);
        }
        thread::yield_now();
    }
    Ok(true)
}

/// What of the images that were told of is in a folder now.
#[derive(Debug, Default)]
struct Likeness {
    looked_for: usize,
    found: usize,
    /// With the size and time that they had.
    same: usize,
    /// Nothing of them has changed at all.
    untouched: usize,
}

impl Likeness {
    /// Of what nothing is known, it may be that.
    fn is_the_same(&self) -> bool {
        self.looked_for == 0 || (self.found > 0 && self.same * 2 >= self.found)
    }
}

fn compare(
    disk: &impl Folders,
    folder: &Path,
    kept: &Path,
    stamps: &Stamps,
    key: impl Fn(&str) -> u64,
) -> Result<Likeness, WatchError> {
    let mut known: HashMap<u64, Seen> = HashMap::new();
    stamps.each(|key, seen| {
        _ = match seen.known() {
            Some(seen) => known.insert(key, seen),
            None => known.remove(&key),
        }
    });
    let mut reader = RecordReader::new(kept, Cursor::default());
    let mut likeness = Likeness::default();
    loop {
        let lines = reader.read(4096)?;
        if lines.is_empty() {
            return Ok(likeness);
        }
        for line in lines {
            let Ok(Record::Tile(tile)) = line.record else {
                continue;
            };
            let file = file_name(&tile.file);
            let Some(seen) = known.remove(&key(file)) else {
                continue;
            };
            likeness.looked_for += 1;
            if let Ok(now) = disk.stamp(&folder.join(file)) {
                let now = Seen::of(&now);
                likeness.found += 1;
                likeness.same += usize::from(seen.has_content_of(now));
                likeness.untouched += usize::from(seen == now);
            }
            if likeness.found == COMPARED || likeness.looked_for == LOOKED_FOR {
                return Ok(likeness);
            }
        }
    }
}
