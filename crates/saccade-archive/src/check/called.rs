//! Rows that have another tile's name, or that of none, or the number of another record.

use std::borrow::Cow;
use std::hash::BuildHasher as _;

use super::names::Name;
use super::repair::position_of;
use super::{Check, CheckError, FindingKind, Repair};
use crate::acquisition::Record;
use crate::catalog::{Holder, Tile, VolumeEntry};

impl Check<'_> {
    /// A tile as its record and its pyramid call it, where its row has another tile's name or that of none; that is told. `None` where it
    /// is none of the records' tiles, or is there once more.
    pub(super) async fn rightly_called<'t>(
        &mut self,
        entry: &VolumeEntry,
        listed: &'t Tile,
    ) -> Result<Option<Cow<'t, Tile>>, CheckError> {
        let Some((records, read)) = self.records.as_ref().zip(self.read) else {
            return Ok(Some(Cow::Borrowed(listed)));
        };
        let tile = match self.called.get(&listed.id) {
            Some(name) => Cow::Owned(Tile {
                name: name.clone(),
                ..listed.clone()
            }),
            None => Cow::Borrowed(listed),
        };
        let is_known = records.know(&tile.name);
        if is_known && records.newest_of(&tile.name) == Some(tile.position) {
            return Ok(Some(self.got_its_name(entry, listed, tile)));
        }
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        // Another may have read on meanwhile.
        if tile.position >= read.offset {
            return Ok(Some(tile));
        }
        let by_row = self.recorded(entry, tile.position);
        let by_pyramid = Name::of(&tile.pyramid)
            .filter(|name| name.volume == *volume && name.position < read.offset)
            .and_then(|name| {
                let of = self.recorded(entry, name.position)?;
                name.is_after(&of).then_some(of)
            });
        match by_pyramid {
            Some(of) if of == tile.name => Ok(Some(self.got_its_name(entry, listed, tile))),
            // It names another's pyramid.
            Some(_) if by_row.as_ref() == Some(&tile.name) => Ok(Some(tile)),
            Some(of) => {
                let is_sure = by_row.as_ref() == Some(&of);
                let holder = catalog.holder(volume, &of).await?;
                let is_there =
                    holder.is_some_and(|row| self.is_right(entry, row, &tile, &of, is_known));
                match (is_known, is_there) {
                    (true, true) => {
                        return self.called_as_row(entry, listed, tile, by_row, &of).await;
                    }
                    (true, false) if !is_sure && holder.is_none() => return Ok(Some(tile)),
                    (false, true) => self.is_there_as_well(entry, listed, &tile, &of).await?,
                    (_, false) => {
                        let named = self.call(entry, listed, &tile, &of, holder).await?;
                        return Ok(Some(Cow::Owned(named)));
                    }
                }
                Ok(None)
            }
            None if is_known => Ok(Some(tile)),
            None => {
                self.called_as_none(entry, listed);
                Ok(None)
            }
        }
    }

    /// A tile that names the pyramid of one that is there: if its row has the number of a record of neither, and the row that has the
    /// name of that one is not that one's, it is that one.
    async fn called_as_row<'t>(
        &mut self,
        entry: &VolumeEntry,
        listed: &'t Tile,
        tile: Cow<'t, Tile>,
        by_row: Option<String>,
        by_pyramid: &str,
    ) -> Result<Option<Cow<'t, Tile>>, CheckError> {
        let records = self.records.as_ref();
        let newest = |of: &str| records.and_then(|records| records.newest_of(of));
        let by_row = by_row
            .filter(|of| *of != tile.name && of != by_pyramid && newest(of) == Some(tile.position));
        let Some(own) = by_row else {
            return Ok(Some(tile));
        };
        let holder = { self.archive.catalog() }.holder(&entry.volume.name, &own);
        let holder = holder.await?;
        if holder.is_some_and(|row| self.is_right(entry, row, &tile, &own, true)) {
            return Ok(Some(tile));
        }
        let named = self.call(entry, listed, &tile, &own, holder).await?;
        Ok(Some(Cow::Owned(named)))
    }

    /// Whether the row that has the name `of` is that tile's, where another has its pyramid.
    fn is_right(
        &self,
        entry: &VolumeEntry,
        row: Holder,
        other: &Tile,
        of: &str,
        is_known: bool,
    ) -> bool {
        let record = { row.position }.and_then(|at| Some(self.record_at(entry, at)?.1));
        match (row.deleted, record) {
            (false, Some(Record::Tile(record))) => record.tile == of,
            (false, _) => false,
            (true, Some(Record::Delete(record))) => record.tile == of,
            (true, _) if is_known => self.records.as_ref().is_some_and(|r| r.is_deleted(of)),
            // Somebody has deleted it, or the row of another that was deleted has its name: of what never was, nothing changed.
            (true, _) => self.history.is_whole() && self.history.last(other.id).is_none(),
        }
    }

    /// A tile that is called as it should be, now; that is told where it is only so since another got its own name again.
    fn got_its_name<'t>(
        &mut self,
        entry: &VolumeEntry,
        listed: &Tile,
        tile: Cow<'t, Tile>,
    ) -> Cow<'t, Tile> {
        if self.called.contains_key(&tile.id) {
            let reason = format!("what its row says is of tile {}", tile.name);
            self.find(FindingKind::Spoilt, entry, Some(listed), reason)
                .repair = Some(Repair::Renamed);
        }
        tile
    }

    /// Calls a tile as its pyramid has it, or tells that; the tile so.
    pub(super) async fn call(
        &mut self,
        entry: &VolumeEntry,
        listed: &Tile,
        tile: &Tile,
        of: &str,
        holder: Option<Holder>,
    ) -> Result<Tile, CheckError> {
        let mut reason = format!("what its row says is of tile {of}");
        reason.push_str(match holder {
            Some(_) => ", whose name another row has",
            None => ", which the catalog lacks",
        });
        let mut repair = None;
        if self.options.repair {
            let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
            commit.rename(tile, of).await?;
            commit.finish().await?;
            repair = Some(Repair::Renamed);
            // It is looked at later, or was, and could not be understood.
            let other = holder.map(|row| (row.tile, tile.name.clone()));
            self.called.extend(other);
        } else {
            reason.push_str(": `saccade check --repair` calls it so again");
        }
        self.find(FindingKind::Spoilt, entry, Some(listed), reason)
            .repair = repair;
        Ok(Tile {
            name: of.to_owned(),
            ..tile.clone()
        })
    }

    /// A tile of whose name the records have none, with the pyramid of one that is there.
    async fn is_there_as_well(
        &mut self,
        entry: &VolumeEntry,
        listed: &Tile,
        tile: &Tile,
        of: &str,
    ) -> Result<(), CheckError> {
        // It is the other's.
        let known = position_of(&tile.pyramid).map(|at| (entry.volume.name.clone(), at));
        self.kept.extend(known);
        let mut reason = format!(
            "no record of the acquisition is of a tile of this name, and its pyramid is that of tile {of}, which is there as well"
        );
        let mut repair = None;
        if self.options.repair {
            let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
            commit.take_away(&tile.name).await?;
            commit.finish().await?;
            repair = Some(Repair::TakenAway);
        } else {
            reason.push_str(": `saccade check --repair` takes it away");
        }
        self.find(FindingKind::Spoilt, entry, Some(listed), reason)
            .repair = repair;
        Ok(())
    }

    /// A tile of whose name the records at hand have none, with a pyramid of which they do not tell whose it is.
    fn called_as_none(&mut self, entry: &VolumeEntry, tile: &Tile) {
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
    }

    /// A tile that is deleted, and called otherwise than the record that ended it has it; whether it is so.
    pub(super) async fn ended_as_another(
        &mut self,
        entry: &VolumeEntry,
        tile: &Tile,
        position: u64,
    ) -> Result<bool, CheckError> {
        let records = self.records.as_ref();
        if records.is_none_or(|records| records.position_of(&tile.name) == Some(position)) {
            return Ok(false);
        }
        let of = match self.record_at(entry, position) {
            Some((_, Record::Delete(record))) if record.tile != tile.name => record.tile,
            _ => return Ok(false),
        };
        let holder = { self.archive.catalog() }.holder(&entry.volume.name, &of);
        let holder = holder.await?;
        // One that is there was entered again.
        if holder.is_some_and(|row| {
            !row.deleted || row.position.and_then(|at| self.ended(entry, at)).as_ref() == Some(&of)
        }) {
            return Ok(false);
        }
        self.call(entry, tile, tile, &of, holder).await?;
        Ok(true)
    }

    /// The tile of whose image the record at a position is.
    fn recorded(&self, entry: &VolumeEntry, at: u64) -> Option<String> {
        match self.record_at(entry, at)?.1 {
            Record::Tile(record) => Some(record.tile),
            Record::Transform(_) | Record::Delete(_) => None,
        }
    }

    /// The tile that the record at a position ends.
    fn ended(&self, entry: &VolumeEntry, at: u64) -> Option<String> {
        match self.record_at(entry, at)?.1 {
            Record::Delete(record) => Some(record.tile),
            Record::Transform(_) | Record::Tile(_) => None,
        }
    }

    /// A tile whose row says that its image is of another record than the pyramid has it, and its newest record is; of two that are
    /// equally near, that decides which one is seen.
    pub(super) async fn misnumbered(
        &mut self,
        entry: &VolumeEntry,
        tile: &Tile,
    ) -> Result<(), CheckError> {
        let newest = { self.records.as_ref() }.and_then(|records| records.newest_of(&tile.name));
        let its = Name::of(&tile.pyramid).filter(|name| {
            let is_its = name.volume == entry.volume.name && name.is_after(&tile.name);
            is_its && Some(name.position) == newest && name.position != tile.position
        });
        let Some(Name { position, .. }) = its else {
            return Ok(());
        };
        let reason = format!(
            "the catalog says that its image is of the record at byte {}, and it is of the one at byte {position}",
            tile.position
        );
        let mut repair = None;
        if self.options.repair {
            let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
            commit.number(tile, position).await?;
            commit.finish().await?;
            repair = Some(Repair::Renumbered);
        }
        self.find(FindingKind::Spoilt, entry, Some(tile), reason)
            .repair = repair;
        Ok(())
    }
}
