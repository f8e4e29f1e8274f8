//! Rows that have another tile's name, or that of none.

use std::hash::BuildHasher as _;

use super::names::Name;
use super::{Check, CheckError, FindingKind, Repair};
use crate::acquisition::Record;
use crate::catalog::{Holder, Tile, VolumeEntry};

impl Check<'_> {
    /// A tile that is not called as its record is, by its row as well as by its pyramid, or as none of the records at hand; whether it
    /// is so.
    pub(super) async fn called_otherwise(
        &mut self,
        entry: &VolumeEntry,
        tile: &Tile,
    ) -> Result<bool, CheckError> {
        let Some((records, read)) = self.records.as_ref().zip(self.read) else {
            return Ok(false);
        };
        let is_known = records.know(&tile.name);
        if is_known && records.newest_of(&tile.name) == Some(tile.position) {
            return self.got_its_name(entry, tile);
        }
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let row = catalog.origin(volume, tile.id).await?;
        // Another may have read on meanwhile.
        let Some(row) = row.filter(|row| row.position < read.offset) else {
            return Ok(false);
        };
        let of = self.recorded(entry, row.position).filter(|of| {
            Name::of(&tile.pyramid).is_some_and(|name| {
                name.volume == *volume && name.position == row.position && name.is_after(of)
            })
        });
        match of {
            Some(of) if is_known && of == tile.name => self.got_its_name(entry, tile),
            Some(of) => self.called_as_another(entry, tile, &of, is_known).await,
            None if is_known => Ok(false),
            None => self.called_as_none(entry, tile),
        }
    }

    /// A tile that is called as it should be, now; whether that is only so since another got its own name again.
    fn got_its_name(&mut self, entry: &VolumeEntry, tile: &Tile) -> Result<bool, CheckError> {
        if !self.called.contains_key(&tile.id) {
            return Ok(false);
        }
        if let Some(records) = &mut self.records {
            records.meet(&tile.name);
        }
        let known = (entry.volume.name.clone(), tile.position);
        self.kept.insert(known);
        let reason = "its row had another tile's name".to_owned();
        self.find(FindingKind::Spoilt, entry, Some(tile), reason)
            .repair = Some(Repair::Renamed);
        Ok(true)
    }

    /// A tile that is called otherwise than `of`, as its record and its pyramid have it; whether that is its row's fault.
    async fn called_as_another(
        &mut self,
        entry: &VolumeEntry,
        tile: &Tile,
        of: &str,
        is_known: bool,
    ) -> Result<bool, CheckError> {
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let holder = catalog.holder(volume, of).await?;
        let is_right = |row: Holder| match row.deleted {
            true => !is_known || self.records.as_ref().is_some_and(|r| r.is_deleted(of)),
            false => { row.position }
                .is_some_and(|at| self.recorded(entry, at).is_some_and(|its| its == of)),
        };
        let is_there = holder.is_some_and(is_right);
        // Then it names that one's pyramid.
        if is_known && is_there {
            return Ok(false);
        }
        // Of another that names it as well, it is that one's.
        let known = (volume.clone(), tile.position);
        self.kept.insert(known);
        let mut reason = match is_known {
            true => "its record is of another tile".to_owned(),
            false => "no record of the acquisition is of a tile of this name".to_owned(),
        };
        let mut repair = None;
        let mut commit = match self.options.repair {
            true => Some(catalog.begin(volume).await?),
            false => None,
        };
        if is_there {
            reason.push_str(&format!(
                ", and its pyramid is that of tile {of}, which is there as well"
            ));
            match &mut commit {
                Some(commit) => {
                    commit.take_away(&tile.name).await?;
                    repair = Some(Repair::TakenAway);
                }
                None => reason.push_str(": `saccade check --repair` takes it away"),
            }
        } else {
            if let Some(records) = &mut self.records {
                records.meet(of);
            }
            reason.push_str(&format!(", and its pyramid is that of tile {of}"));
            match holder {
                Some(_) => reason.push_str(", whose name another row has"),
                None => reason.push_str(", which the catalog lacks"),
            }
            match &mut commit {
                Some(commit) => {
                    commit.rename(tile, of).await?;
                    repair = Some(Repair::Renamed);
                    // It is looked at later, or was, and could not be understood.
                    let other = holder.map(|row| (row.tile, tile.name.clone()));
                    self.called.extend(other);
                }
                None => reason.push_str(": `saccade check --repair` calls it so again"),
            }
        }
        if let Some(commit) = commit {
            commit.finish().await?;
        }
        self.find(FindingKind::Spoilt, entry, Some(tile), reason)
            .repair = repair;
        Ok(true)
    }

    /// A tile of whose name the records at hand have none, with a pyramid of which they do not tell whose it is.
    fn called_as_none(&mut self, entry: &VolumeEntry, tile: &Tile) -> Result<bool, CheckError> {
        self.named.insert(self.hasher.hash_one(&tile.pyramid));
        let mut reason = "no record of the acquisition is of a tile of this name".to_owned();
        let name = Name::of(&tile.pyramid);
        if let Some(name) = name.filter(|name| name.volume != entry.volume.name) {
            reason.push_str(&format!(
                ", and its pyramid is one of volume {:?}: with --acquisition FOLDER of that one, --repair has ingest make \
                 what is lost there anew",
                name.volume
            ));
        }
        reason.push_str("; a delete of it in `saccade update` takes it away");
        self.find(FindingKind::Spoilt, entry, Some(tile), reason);
        Ok(true)
    }

    /// The tile of whose image the record at a position is.
    fn recorded(&self, entry: &VolumeEntry, at: u64) -> Option<String> {
        match self.record_at(entry, at)?.1 {
            Record::Tile(record) => Some(record.tile),
            Record::Transform(_) | Record::Delete(_) => None,
        }
    }
}
