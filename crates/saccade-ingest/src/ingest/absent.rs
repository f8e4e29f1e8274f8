//! Records that were set aside since their image never came: should it come after all, they are taken up.

use std::collections::BTreeMap;
use std::ops::Bound::{Excluded, Unbounded};

use saccade_archive::catalog::Waiting;

use super::images::Images;
use super::prepare::look;

/// Most of them that are looked for. Of more, those that were set aside first.
const MOST: usize = 20_000;

/// Files that are looked for per poll, on whatever share they are.
const AT_ONCE: usize = 64;

/// The records, by position.
#[derive(Debug, Default)]
pub(super) struct Absent {
    records: BTreeMap<u64, Waiting>,
    /// The last one that was looked for.
    last: Option<u64>,
    /// Whether one has come that was not looked for.
    is_new: bool,
}

impl Absent {
    /// Looks for a record's image from now on.
    pub(super) fn add(&mut self, waiting: Waiting) {
        if self.records.len() < MOST {
            self.records.insert(waiting.position, waiting);
            self.is_new = true;
        }
    }

    /// Whether each was looked for.
    pub(super) fn are_all_looked_for(&self) -> bool {
        self.last.is_none() && !self.is_new
    }

    /// Those whose image has come, of the next few, taken out.
    pub(super) fn came(&mut self, images: Images<'_>) -> Vec<Waiting> {
        let from = self.last.map_or(Unbounded, Excluded);
        let next = { self.records.range((from, Unbounded)) }.take(AT_ONCE);
        let next: Vec<u64> = next.map(|(position, _)| *position).collect();
        // Once all were looked for, it begins anew.
        self.is_new &= self.last.is_some();
        self.last = next.last().copied().filter(|_| next.len() == AT_ONCE);
        let is_there = |waiting: &Waiting| {
            let path = images.path(&waiting.record.file);
            path.is_some_and(|path| look(&path).is_some())
        };
        let came = next.into_iter().filter_map(|position| {
            self.records
                .get(&position)
                .filter(|waiting| is_there(waiting))?;
            self.records.remove(&position)
        });
        came.collect()
    }
}

#[cfg(test)]
mod tests {
    use glam::UVec2;
    use saccade_archive::acquisition::TileRecord;
    use saccade_core::transform::SectionFromTile;

    use super::*;

    #[test]
    fn a_poll_looks_for_few_and_all_have_their_turn() {
        let folder = tempfile::tempdir().unwrap();
        let images = Images::new(folder.path(), None);
        let mut absent = Absent::default();
        let all = 3 * AT_ONCE as u64 + 7;
        for position in 0..all {
            let record = TileRecord {
                tile: position.to_string(),
                file: format!("{position}.tif"),
                section: 0,
                size: UVec2::ONE,
                transform: SectionFromTile::IDENTITY,
                channel: None,
            };
            absent.add(Waiting {
                position,
                record,
                reason: String::new(),
            });
        }
        assert!(absent.came(images).is_empty());
        for position in 0..all {
            std::fs::write(folder.path().join(format!("{position}.tif")), "").unwrap();
        }
        let mut seen = Vec::new();
        for _ in 0..5 {
            let came = absent.came(images);
            assert!(came.len() <= AT_ONCE);
            seen.extend(came.iter().map(|waiting| waiting.position));
        }
        seen.sort_unstable();
        assert_eq!(seen, (0..all).collect::<Vec<_>>());
        assert!(absent.came(images).is_empty(), "each once");
    }
}
