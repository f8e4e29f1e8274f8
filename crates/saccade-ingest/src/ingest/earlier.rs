//! Records that earlier processes set aside since their image never came: the catalog keeps why, and the records are read
//! again to find them.

use std::collections::{HashMap, HashSet};
use std::path::Path;

use saccade_archive::acquisition::{Cursor, Record, RecordReader};
use saccade_archive::catalog::{Quarantined, Waiting};

use super::images::Images;
use super::waiting::{NOT_COME, NOT_COME_BACK};

/// Lines that are read per poll.
const AT_ONCE: usize = 4096;

/// Reads the records that were read before, for those that wait for an image.
#[derive(Debug)]
pub(super) struct Earlier {
    reader: RecordReader,
    /// Where those begin that are read by everybody.
    end: Cursor,
    /// Positions of those that are wanted, and reasons.
    wanted: HashMap<u64, String>,
    /// Tiles, and files as people know them, of those that an earlier version set aside.
    unplaced: HashSet<(String, String)>,
    read: bool,
}

/// Whether it was set aside since its image did not come, before the catalog kept where such records are.
fn is_unplaced(set_aside: &Quarantined) -> bool {
    let says = |what| set_aside.reason.contains(what);
    set_aside.bytes.is_none() && (says(NOT_COME) || says(NOT_COME_BACK))
}

impl Earlier {
    /// `None` if there is nothing to look for.
    pub(super) fn new(acquisition: &Path, end: Cursor, set_aside: &[Quarantined]) -> Option<Self> {
        let (mut wanted, mut unplaced) = (HashMap::new(), HashSet::new());
        for one in set_aside {
            match (one.awaited, &one.tile) {
                (Some(position), _) => _ = wanted.insert(position, one.reason.clone()),
                (None, Some(tile)) if is_unplaced(one) => {
                    unplaced.insert((tile.clone(), one.file.clone()));
                }
                (None, _) => {}
            }
        }
        let is_needed = !wanted.is_empty() || !unplaced.is_empty();
        is_needed.then(|| Self {
            reader: RecordReader::new(acquisition, Cursor::default()),
            end,
            wanted,
            unplaced,
            read: false,
        })
    }

    /// Whether all were read.
    pub(super) fn is_read(&self) -> bool {
        self.read
    }

    /// The next few lines' records that wait for an image. What cannot be read is told by who reads on.
    pub(super) fn read(&mut self, images: Images<'_>) -> Vec<Waiting> {
        let lines = self.reader.read(AT_ONCE).unwrap_or_default();
        self.read = lines.is_empty() || self.reader.cursor().offset >= self.end.offset;
        let before = { lines.into_iter() }.filter(|line| line.offset < self.end.offset);
        let waiting = before.filter_map(|line| {
            let Ok(Record::Tile(record)) = line.record else {
                return None;
            };
            let reason = self.wanted.get(&line.offset).cloned();
            let reason = reason.or_else(|| {
                let name = (record.tile.clone(), images.name(&record.file));
                let is_it = !self.unplaced.is_empty() && self.unplaced.contains(&name);
                is_it.then(|| "its image did not come before".to_owned())
            })?;
            Some(Waiting {
                position: line.offset,
                record,
                reason,
            })
        });
        waiting.collect()
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::time::SystemTime;

    use super::*;

    #[test]
    fn a_poll_reads_few_lines_and_finds_those_that_were_given_up() {
        let folder = tempfile::tempdir().unwrap();
        let line = |n: usize| {
            format!(
                "{{\"record\":\"tile\",\"tile\":\"{n}\",\"file\":\"{n}.tif\",\"section\":0,\"size\":[1,1],\
                 \"transform\":[1,0,0,1,0,0]}}\n"
            )
        };
        let all = AT_ONCE + 9;
        let text: String = (0..all).map(line).collect();
        fs::write(folder.path().join(RecordReader::FILE), &text).unwrap();
        let at = |n: usize| (0..n).map(|n| line(n).len() as u64).sum::<u64>();
        let unplaced = |n: usize, file: &str, reason: &str| Quarantined {
            file: file.to_owned(),
            tile: Some(n.to_string()),
            reason: format!("It is not there. {reason} 30.0 s"),
            bytes: None,
            at: SystemTime::UNIX_EPOCH,
            awaited: None,
        };
        let awaited = |n: usize| Quarantined {
            awaited: Some(at(n)),
            ..unplaced(n, "whatever", "Whatever")
        };
        let end = Cursor {
            offset: at(all - 2),
            ..Cursor::default()
        };
        let rows = [
            unplaced(3, "3.tif", "It did not come within"),
            unplaced(4, "other.tif", "It did not come within"),
            unplaced(5, "5.tif", "It leads elsewhere within"),
            unplaced(
                all - 3,
                &format!("{}.tif", all - 3),
                "The file did not come back within",
            ),
            awaited(7),
            awaited(all - 4),
            // Those are read by everybody.
            unplaced(
                all - 1,
                &format!("{}.tif", all - 1),
                "It did not come within",
            ),
            awaited(all - 2),
        ];
        let images = Images::new(folder.path(), None);
        assert!(Earlier::new(folder.path(), end, &rows[2..3]).is_none());
        let mut earlier = Earlier::new(folder.path(), end, &rows).unwrap();
        let found = |earlier: &mut Earlier| {
            let found = earlier.read(images).into_iter();
            found.map(|waiting| waiting.position).collect::<Vec<_>>()
        };
        assert_eq!(
            (found(&mut earlier), earlier.is_read()),
            (vec![at(3), at(7)], false)
        );
        assert_eq!(
            (found(&mut earlier), earlier.is_read()),
            (vec![at(all - 4), at(all - 3)], true)
        );
    }
}
