//! Folders that lie elsewhere than they did, told from others of the same name.
//!
//! A backlog of folders that are all called alike, one after the other in one place, would be taken for one that moves: what the first
//! showed would stay where the others have images of the same names.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use saccade_archive::acquisition::{Cursor, Record, RecordReader};

use super::scan::Folders;
use super::stamp::Seen;
use super::stamps::Stamps;
use super::{LINK, WatchError, file_name, link};

/// Images that are compared.
const COMPARED: usize = 256;

/// Has the link lead to `folder`, if that is the one that it led to: also to one that has moved, unless none of its images looks as it
/// did. Those that do are not told again; with `moved`, times alone say which do.
///
/// # Errors
///
/// [`WatchError::Another`]; what the system says.
pub(super) fn go_on(
    disk: &impl Folders,
    folder: &Path,
    kept: &Path,
    moved: bool,
    key: impl Fn(&str) -> u64,
) -> Result<Stamps, WatchError> {
    let stamps = Stamps::new(kept);
    let gone = fs::read_link(kept.join(LINK)).ok();
    if let Some(was) = gone.filter(|was| was != folder && !moved)
        && let Some(compared) = is_another(disk, folder, kept, &stamps, key)?
    {
        return Err(WatchError::Another {
            was,
            folder: folder.to_owned(),
            compared,
        });
    }
    if link(folder, kept)? {
        // Copies are other files.
        match moved {
            true => stamps.forget(),
            false => stamps.keep_content(),
        }
    }
    Ok(stamps)
}

/// How many images were compared with what they looked like when they were told of, if none of them looks so.
fn is_another(
    disk: &impl Folders,
    folder: &Path,
    kept: &Path,
    stamps: &Stamps,
    key: impl Fn(&str) -> u64,
) -> Result<Option<usize>, WatchError> {
    let mut known: HashMap<u64, Seen> = HashMap::new();
    stamps.each(|key, seen| _ = known.insert(key, seen));
    let mut reader = RecordReader::new(kept, Cursor::default());
    let mut compared = 0;
    while compared < COMPARED {
        let lines = reader.read(4096)?;
        if lines.is_empty() {
            break;
        }
        for line in lines {
            let Ok(Record::Tile(tile)) = line.record else {
                continue;
            };
            let file = file_name(&tile.file);
            let Some(seen) = known.remove(&key(file)) else {
                continue;
            };
            if let Ok(now) = disk.stamp(&folder.join(PathBuf::from(file))) {
                if seen.has_content_of(Seen::of(&now)) {
                    return Ok(None);
                }
                compared += 1;
            }
        }
    }
    Ok((compared > 0).then_some(compared))
}
