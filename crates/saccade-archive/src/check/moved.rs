//! Tiles that lie where nothing says that they do.
//!
//! `saccade update` moves tiles as well, and nobody records that but the catalog: where the newest record was followed, another
//! place is taken for that, unless the catalog's own list of changes says otherwise.

use std::collections::HashMap;

use saccade_core::voxel_box::VoxelBox;

use super::{Check, CheckError, FindingKind, Repair, records::Said};
use crate::acquisition::Record;
use crate::catalog::{ChangeReason, Placing, Tile, VolumeEntry, place};

impl Check<'_> {
    /// Notes a tile that does not lie where its newest record says.
    pub(super) fn compare_place(&mut self, tile: &Tile) {
        let said = self
            .records
            .as_ref()
            .and_then(|records| records.elsewhere(tile));
        self.elsewhere.extend(said.map(|said| (tile.clone(), said)));
    }

    /// Finds those of a section of which neither a record nor the catalog's changes say that they lie where they do.
    pub(super) async fn moved(&mut self, entry: &VolumeEntry, z: u32) -> Result<(), CheckError> {
        let elsewhere = std::mem::take(&mut self.elsewhere);
        if elsewhere.is_empty() {
            return Ok(());
        }
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let placings = catalog.placings(volume, z).await?;
        let placings: HashMap<_, _> = placings
            .iter()
            .map(|placing| (placing.tile, placing))
            .collect();
        for (tile, said) in elsewhere {
            let placing = placings
                .get(&tile.id)
                .filter(|now| now.revision == tile.revision);
            let Some(why) = placing.and_then(|now| self.unexplained(entry, &tile, said, now))
            else {
                continue;
            };
            let record = self.record_at(entry, said.record).map(|(_, record)| record);
            let (name, to) = match record {
                Some(Record::Tile(record)) => (record.tile, record.transform),
                Some(Record::Transform(record)) => (record.tile, record.transform),
                _ => continue,
            };
            if name != tile.name || to == tile.transform {
                continue;
            }
            // One that ingest could not follow is told with what is set aside.
            if catalog.is_set_aside(volume, &name).await? {
                continue;
            }
            let reason = format!(
                "it lies at {:?}, its newest record (byte {}) says {:?}, and {why}",
                tile.transform.elements(),
                said.record,
                to.elements()
            );
            let mut repair = None;
            if self.options.repair {
                catalog.set_transform(volume, &tile.name, to).await?;
                repair = Some(Repair::Moved);
            }
            self.find(FindingKind::Spoilt, entry, Some(&tile), reason)
                .repair = repair;
        }
        Ok(())
    }

    /// Why nothing explains that a tile lies elsewhere than a record said; `None` if somebody may have moved it.
    fn unexplained(
        &self,
        entry: &VolumeEntry,
        tile: &Tile,
        said: Said,
        now: &Placing,
    ) -> Option<&'static str> {
        // Another may have read on meanwhile.
        if now.transform_position >= self.read?.offset {
            return None;
        }
        if now.transform_position != said.position {
            return Some("that one was not followed");
        }
        let lies = place(
            entry.volume.extent(),
            tile.section,
            tile.size,
            tile.transform,
        )?;
        let came = now.change?;
        let elsewhere = "it came elsewhere when it last changed, as the catalog's changes tell";
        if came.intersection(lies) != lies {
            return Some(elsewhere);
        }
        let last = self.history.last(tile.id);
        let last = last.filter(|last| last.change.revision == now.revision)?;
        let is_explained = match last.change.reason {
            ChangeReason::Transform => may_have_come(came, lies, last.before),
            // One that is made anew stays where somebody has moved it.
            ChangeReason::Tile => {
                let (_, record) = self.record_at(entry, said.record)?;
                let to = match record {
                    Record::Tile(record) => record.transform,
                    Record::Transform(record) => record.transform,
                    Record::Delete(_) => return None,
                };
                let there = place(entry.volume.extent(), tile.section, tile.size, to);
                let may_have_moved = last.was_moved || !self.history.is_whole();
                there != Some(came) || (lies == came && may_have_moved)
            }
            ChangeReason::Deleted => true,
        };
        (!is_explained).then_some(elsewhere)
    }
}

/// Whether a tile that moved may have come to a place, where the box around its old and its new place is `came`; `before` is
/// the box of the change before, which brought it to the old one.
fn may_have_come(came: VoxelBox, lies: VoxelBox, before: Option<VoxelBox>) -> bool {
    let (at, all) = (lies.min.cmpeq(came.min), lies.max.cmpeq(came.max));
    // Of two boxes of one size each touches a side of every axis.
    if (at | all).all() {
        return true;
    }
    before.is_none_or(|before| before.intersection(came).union(lies) == came)
}

#[cfg(test)]
mod tests {
    use glam::UVec3;

    use super::*;

    fn at(x: u32, y: u32, size: u32) -> VoxelBox {
        let min = UVec3::new(x, y, 3);
        VoxelBox::new(min, min + UVec3::new(size, size, 1))
    }

    #[test]
    fn a_move_leads_from_one_corner_to_another_unless_its_tile_was_turned() {
        let (old, new) = (at(10, 20, 64), at(31, 5, 64));
        let came = old.union(new);
        for before in [None, Some(old), Some(old.union(at(0, 0, 64)))] {
            assert!(may_have_come(came, new, before));
        }
        assert!(!may_have_come(came, at(20, 12, 64), Some(old)));
        assert!(may_have_come(came, at(20, 12, 64), None));
        // From one that was turned, and is larger for that, to the midst of it.
        let turned = at(3, 3, 91);
        assert!(may_have_come(turned, at(20, 12, 64), Some(turned)));
        // From far away: then its own place is all that changed.
        assert!(!may_have_come(
            at(300, 300, 64),
            at(301, 301, 60),
            Some(old)
        ));
    }
}
