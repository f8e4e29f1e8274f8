//! Tiles that lie where nothing says that they do.
//!
//! `saccade update` moves tiles as well, and nobody records that but the catalog, which notes it with the tile. Where an earlier
//! version has not, and the newest record was followed, another place is taken for that, unless the catalog's own list of changes says
//! otherwise.

use saccade_core::transform::SectionFromTile;
use saccade_core::voxel_box::VoxelBox;

use super::{Check, CheckError, FindingKind, Repair, records::Said};
use crate::acquisition::Record;
use crate::catalog::{ChangeReason, Mover, Placing, Tile, VolumeEntry, place};

impl Check<'_> {
    /// Finds out whether a tile lies where neither a record nor the catalog's changes say that it does, whatever else is wrong with it:
    /// one that is made anew stays where it is. As it is once that is mended; nothing, if it is not or need not be.
    pub(super) async fn settle(
        &mut self,
        entry: &VolumeEntry,
        tile: &Tile,
    ) -> Result<Option<Tile>, CheckError> {
        let Some((records, said)) =
            { self.records.as_ref() }.and_then(|records| Some((records, records.elsewhere(tile)?)))
        else {
            return Ok(None);
        };
        let shaped = records.shaped(tile);
        let extent = entry.volume.extent();
        // One that lies where no voxel is is told as that.
        if place(extent, shaped.section, shaped.size, shaped.transform).is_none() {
            return Ok(None);
        }
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let z = tile.section;
        if self.placings.as_ref().is_none_or(|(of, _)| *of != z) {
            let placings = catalog.placings(volume, z).await?.into_iter();
            self.placings = Some((z, placings.map(|placing| (placing.tile, placing)).collect()));
        }
        let placing = { self.placings.as_ref() }
            .and_then(|(_, placings)| placings.get(&tile.id))
            .filter(|now| now.revision == tile.revision);
        let Some(placing) = placing.copied() else {
            return Ok(None);
        };
        let is_noted = placing.moved.is_some() || placing.change.is_some();
        if !is_noted && self.lacks_change(entry, &placing).await? {
            return self.untold(entry, tile, said).await;
        }
        let Some((to, reason)) = self.its_place(entry, &shaped, said, &placing) else {
            return Ok(None);
        };
        // One that ingest could not follow is told with what is set aside.
        if catalog.is_set_aside(volume, &tile.name).await? {
            return Ok(None);
        }
        let mut settled = None;
        if self.options.repair {
            let mut commit = catalog.begin(volume).await?;
            commit.lay(tile, to).await?;
            commit.finish().await?;
            settled = Some(Tile {
                transform: to,
                ..tile.clone()
            });
        }
        self.find(FindingKind::Spoilt, entry, Some(tile), reason)
            .repair = settled.as_ref().map(|_| Repair::Moved);
        Ok(settled)
    }

    /// Whether the change is not there that brought a tile to its place, though as old ones are kept.
    async fn lacks_change(
        &mut self,
        entry: &VolumeEntry,
        placing: &Placing,
    ) -> Result<bool, CheckError> {
        if self.history.is_kept(placing.revision) && !self.is_history_sure {
            // Old ones may have been forgotten since they were read.
            self.history = self.archive.catalog().history(&entry.volume.name).await?;
            self.is_history_sure = true;
        }
        Ok(self.history.is_kept(placing.revision))
    }

    /// A tile that lies elsewhere than its record says, where the change is lost that would tell whether somebody has moved it: it
    /// stays.
    async fn untold(
        &mut self,
        entry: &VolumeEntry,
        tile: &Tile,
        said: Said,
    ) -> Result<Option<Tile>, CheckError> {
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        if catalog.is_set_aside(volume, &tile.name).await? {
            return Ok(None);
        }
        let reason = format!(
            "it lies at {:?}, its newest record (byte {}) says otherwise, and the catalog's changes lack the one that would tell \
             whether somebody has moved it; say with `saccade update` where it lies, or `--repair` has it stay there",
            tile.transform.elements(),
            said.record
        );
        let mut repair = None;
        if self.options.repair {
            let mut commit = catalog.begin(volume).await?;
            commit.confirm(tile).await?;
            commit.finish().await?;
            repair = Some(Repair::Confirmed);
        }
        self.find(FindingKind::Spoilt, entry, Some(tile), reason)
            .repair = repair;
        Ok(None)
    }

    /// A tile that is called deleted and is about to be brought back, where it belongs: as its row says, or, where nothing explains
    /// that, as its newest record does. The latter is added to the reason.
    pub(super) async fn in_its_place(
        &self,
        entry: &VolumeEntry,
        tile: &Tile,
        reason: &mut String,
    ) -> Result<Tile, CheckError> {
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let records = self.records.as_ref();
        let mut tile = tile.clone();
        let Some(said) = records.and_then(|records| records.elsewhere(&tile)) else {
            return Ok(tile);
        };
        let placing = catalog.placing(volume, tile.id).await?;
        let shaped = records.map_or_else(|| tile.clone(), |records| records.shaped(&tile));
        let its = placing.and_then(|now| self.its_place(entry, &shaped, said, &now));
        if let Some((to, why)) = its
            && !catalog.is_set_aside(volume, &tile.name).await?
        {
            tile.transform = to;
            *reason = format!("{reason}; {why}");
        }
        Ok(tile)
    }

    /// Whether nothing explains that a row's tile lies elsewhere than its newest record says.
    pub(super) async fn lies_wrongly(
        &self,
        entry: &VolumeEntry,
        tile: &Tile,
    ) -> Result<bool, CheckError> {
        let records = self.records.as_ref();
        let Some((records, said)) =
            records.and_then(|records| Some((records, records.elsewhere(tile)?)))
        else {
            return Ok(false);
        };
        let placing = { self.archive.catalog() }.placing(&entry.volume.name, tile.id);
        let placing = placing.await?;
        let shaped = records.shaped(tile);
        Ok(placing.is_some_and(|now| self.its_place(entry, &shaped, said, &now).is_some()))
    }

    /// Where a tile belongs that lies elsewhere than a record said, and why, if nothing explains that.
    fn its_place(
        &self,
        entry: &VolumeEntry,
        tile: &Tile,
        said: Said,
        now: &Placing,
    ) -> Option<(SectionFromTile, String)> {
        let extent = entry.volume.extent();
        let why = match place(extent, tile.section, tile.size, tile.transform) {
            None => "no voxel is there",
            Some(_) => self.unexplained(entry, tile, said, now)?,
        };
        let (name, to) = match self.record_at(entry, said.record)?.1 {
            Record::Tile(record) => (record.tile, record.transform),
            Record::Transform(record) => (record.tile, record.transform),
            Record::Delete(_) => return None,
        };
        let reason = format!(
            "it lies at {:?}, its newest record (byte {}) says {:?}, and {why}",
            tile.transform.elements(),
            said.record,
            to.elements()
        );
        (name == tile.name && to != tile.transform).then_some((to, reason))
    }

    /// Where a record has a tile.
    fn said_place(&self, entry: &VolumeEntry, said: Said) -> Option<SectionFromTile> {
        match self.record_at(entry, said.record)?.1 {
            Record::Tile(record) => Some(record.transform),
            Record::Transform(record) => Some(record.transform),
            Record::Delete(_) => None,
        }
    }

    /// Whether a row has it that a tile's newest record was followed. A position of nothing that is said of the tile says nothing.
    fn is_followed(&self, entry: &VolumeEntry, tile: &Tile, said: Said, now: &Placing) -> bool {
        let is_of = |at: u64| match self.record_at(entry, at)?.1 {
            Record::Tile(record) => Some(record.tile == tile.name),
            Record::Transform(record) => Some(record.tile == tile.name),
            Record::Delete(_) => None,
        };
        now.transform_position == said.position || is_of(now.transform_position) != Some(true)
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
        if !self.is_followed(entry, tile, said, now) {
            return Some("that one was not followed");
        }
        match now.moved {
            Some(Mover::Records) if now.transform_position == said.position => {
                return Some("nobody else has moved it, as the catalog tells");
            }
            Some(by @ Mover::Somebody(_)) if by.is_to(tile.transform) => return None,
            Some(by @ Mover::Somebody(_)) => {
                let is_to = { self.said_place(entry, said) }.is_some_and(|to| by.is_to(to));
                return Some(match is_to {
                    true => "it was put there",
                    false => {
                        "somebody else has moved it, but not to where it lies: to where is lost, and is to be said with \
                         `saccade update` once more"
                    }
                });
            }
            _ => {}
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
                let to = self.said_place(entry, said)?;
                let there = place(entry.volume.extent(), tile.section, tile.size, to);
                let may_have_moved = last.was_moved || !self.history.is_whole();
                may_have_moved && (there != Some(came) || lies == came)
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
