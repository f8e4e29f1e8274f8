//! Rows of one name, which there are only where somebody took the index away that keeps names apart.
//!
//! Most of what is wrong with the one that is kept is found when it is looked at. Two things no record tells: where somebody has moved
//! a tile, and that somebody has deleted it. The catalog's changes tell them, of the row that was there first.

use std::collections::BTreeMap;
use std::hash::BuildHasher as _;

use saccade_core::voxel_box::VoxelBox;

use super::names::Name;
use super::{Check, CheckError, Finding, FindingKind, Repair};
use crate::acquisition::Record;
use crate::catalog::{ChangeReason, NamedRow, TileId, VolumeEntry, place};

/// What tells that a row is the one of a name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Known {
    /// The catalog's changes led to what it says, and to that of no other.
    ByChanges,
    /// It is nearest to the records of its tile.
    ByRecords,
    /// The others say the same.
    Same,
}

impl Check<'_> {
    /// Of rows that have one name keeps the one that the catalog's changes or its records speak of, and takes the others out of the
    /// catalog; a row of another tile, which the catalog lacks otherwise, is called as that one. Without records they are left.
    pub(super) async fn doubled(&mut self, entry: &VolumeEntry) -> Result<(), CheckError> {
        self.undecided.clear();
        if !self.lacks_index {
            return Ok(());
        }
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let rows = catalog.rows_of_one_name(volume).await?;
        let mut by_name = BTreeMap::<String, Vec<NamedRow>>::new();
        for row in rows {
            by_name.entry(row.name.clone()).or_default().push(row);
        }
        if self.records.is_none() {
            for (name, rows) in by_name {
                self.undecided.extend(rows.iter().map(|row| row.id));
                self.not_told_without_records(entry, &name, &rows);
            }
            return Ok(());
        }
        for (name, rows) in by_name {
            let mut own = Vec::new();
            for row in rows {
                match self.lost_one(entry, &row).await? {
                    Some(of) => self.call_as_lost(entry, &row, &of).await?,
                    None => own.push(row),
                }
            }
            let Some((kept, known)) = self.row_of(entry, &name, &own).await? else {
                self.undecided.extend(own.iter().map(|row| row.id));
                self.nobody_knows(entry, &name, &own);
                continue;
            };
            for row in own.iter().filter(|row| row.id != kept.id) {
                self.take_out(entry, row, known).await?;
            }
        }
        Ok(())
    }

    /// Whether a row is one of several of its name of which nothing tells which is the tile's: it is left as it is, for a change of it
    /// would tell something else.
    pub(super) fn is_undecided(&mut self, id: TileId, name: Option<&str>, pyramid: &str) -> bool {
        if !self.undecided.contains(&id) {
            return false;
        }
        self.named.insert(self.hasher.hash_one(pyramid));
        if let Some((records, name)) = self.records.as_mut().zip(name) {
            records.meet(name);
        }
        true
    }

    /// The row that is the one of a tile's name, and what tells that; `None` where rows differ and nothing does.
    async fn row_of<'r>(
        &self,
        entry: &VolumeEntry,
        name: &str,
        rows: &'r [NamedRow],
    ) -> Result<Option<(&'r NamedRow, Known)>, CheckError> {
        let explained = { rows.iter() }.filter(|row| self.is_explained(entry, row));
        let explained: Vec<_> = explained.collect();
        if let [row] = explained[..] {
            return Ok(Some((row, Known::ByChanges)));
        }
        let among: Vec<_> = match explained.is_empty() {
            true => rows.iter().collect(),
            false => explained,
        };
        let best = among.iter().map(|row| self.fits(entry, name, row)).max();
        let among = among.into_iter();
        let among = among.filter(|row| Some(self.fits(entry, name, row)) == best);
        let mut left = Vec::new();
        let mut wrong = Vec::new();
        for row in among {
            let lies_wrongly = match &row.tile {
                Some(tile) if !row.deleted => self.lies_wrongly(entry, tile).await?,
                _ => false,
            };
            match lies_wrongly {
                true => wrong.push(row),
                false => left.push(row),
            }
        }
        let Some(first) = left.first().copied() else {
            // They are put where they belong, whichever is kept.
            let first = wrong.first().map(|row| (*row, Known::ByRecords));
            return Ok(first);
        };
        let is_one = left.iter().all(|row| says_the_same(first, row));
        let known = match left.len() == rows.len() {
            true => Known::Same,
            false => Known::ByRecords,
        };
        Ok(is_one.then_some((first, known)))
    }

    /// Whether the last change of a row's tile led to what the row says.
    fn is_explained(&self, entry: &VolumeEntry, row: &NamedRow) -> bool {
        let Some((last, tile)) = self.history.last(row.id).zip(row.tile.as_ref()) else {
            return false;
        };
        let change = last.change;
        if change.revision != tile.revision {
            return false;
        }
        match change.reason {
            ChangeReason::Deleted => row.deleted && row.pyramid.is_empty(),
            ChangeReason::Tile | ChangeReason::Transform => {
                let extent = entry.volume.extent();
                let lies = place(extent, tile.section, tile.size, tile.transform);
                // A move led away from where the tile was before.
                let led_to = |lies: VoxelBox| match last.before {
                    Some(before) if change.reason == ChangeReason::Transform => {
                        before.intersection(change.voxels).union(lies) == change.voxels
                    }
                    _ => change.voxels.intersection(lies) == lies,
                };
                !row.deleted && lies.is_some_and(led_to)
            }
        }
    }

    /// How near a row is to the records of a tile.
    fn fits(
        &self,
        entry: &VolumeEntry,
        name: &str,
        row: &NamedRow,
    ) -> (bool, bool, bool, Option<u64>) {
        let records = self.records.as_ref();
        let newest = records.and_then(|records| records.position_of(name));
        let is_ended = records.is_some_and(|records| records.is_deleted(name));
        let read = self.read.map_or(0, |read| read.offset);
        let is_newest = match (is_ended, row.deleted) {
            (true, deleted) => deleted && row.position == newest,
            (false, false) => row.position.is_some() && row.position == newest,
            // Somebody else has ended it, which leaves a place after that of its record.
            (false, true) => row.position > newest && row.position.is_some_and(|at| at < read),
        };
        let own = Name::of(&row.pyramid)
            .filter(|own| own.volume == entry.volume.name && own.is_after(name));
        let is_its = match row.deleted {
            true => row.pyramid.is_empty(),
            false => own.is_some_and(|own| Some(own.position) == row.position),
        };
        let has_shape = { row.tile.as_ref() }
            .is_some_and(|tile| records.is_some_and(|records| records.has_shape(tile)));
        (is_newest, is_its, has_shape, row.position)
    }

    /// The tile whose record a row's position is, if no row has the name of that one.
    async fn lost_one(
        &self,
        entry: &VolumeEntry,
        row: &NamedRow,
    ) -> Result<Option<String>, CheckError> {
        let record = row
            .position
            .and_then(|at| Some(self.record_at(entry, at)?.1));
        let of = match record {
            Some(Record::Tile(record)) => record.tile,
            Some(Record::Delete(record)) => record.tile,
            Some(Record::Transform(_)) | None => return Ok(None),
        };
        let holder = { self.archive.catalog() }.holder(&entry.volume.name, &of);
        let holder = holder.await?;
        let is_lost = of != row.name && holder.is_none();
        Ok(is_lost.then_some(of))
    }

    /// Calls a row as the tile whose record its position is. One that names that one's pyramid is called so when it is looked at.
    async fn call_as_lost(
        &mut self,
        entry: &VolumeEntry,
        row: &NamedRow,
        of: &str,
    ) -> Result<(), CheckError> {
        let names_its = Name::of(&row.pyramid).is_some_and(|own| own.is_after(of));
        if let Some(tile) = row.tile.as_ref().filter(|_| !names_its && !row.deleted) {
            self.call(entry, tile, tile, of, None).await?;
        }
        Ok(())
    }

    async fn take_out(
        &mut self,
        entry: &VolumeEntry,
        row: &NamedRow,
        known: Known,
    ) -> Result<(), CheckError> {
        let of = match known {
            Known::ByChanges => "is the one of which the catalog's changes tell",
            Known::ByRecords => "is the one that its records speak of",
            Known::Same => "says the same",
        };
        let mut reason = format!("another row has its name, and {of}");
        let mut repair = None;
        if self.options.repair {
            let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
            commit.take_out(row).await?;
            commit.finish().await?;
            repair = Some(Repair::TakenAway);
        } else {
            reason.push_str(": `saccade check --repair` takes this one away");
        }
        self.tell(entry, row, reason, repair);
        Ok(())
    }

    /// Rows of one name that say otherwise whether the tile is there or where it lies, and nothing tells which is right.
    fn nobody_knows(&mut self, entry: &VolumeEntry, name: &str, rows: &[NamedRow]) {
        let Some(first) = rows.first() else {
            return;
        };
        let told = rows.iter().map(|row| {
            let what = match &row.tile {
                _ if row.deleted => "that it is deleted".to_owned(),
                Some(tile) => format!(
                    "section {} and transform {:?}",
                    tile.section,
                    tile.transform.elements()
                ),
                None => "what cannot be".to_owned(),
            };
            format!("the one of id {} says {what}", row.id.0)
        });
        let told: Vec<_> = told.collect();
        let reason = format!(
            "{} rows of the catalog's table \"tiles\" have the name {name:?}, and neither its records nor the catalog's changes tell \
             which is the tile's: {}; take the others out, then `saccade check --repair` does the rest",
            rows.len(),
            told.join(", ")
        );
        self.tell(entry, first, reason, None);
    }

    /// Rows of one name, where the records are not at hand, which may tell.
    fn not_told_without_records(&mut self, entry: &VolumeEntry, name: &str, rows: &[NamedRow]) {
        let Some(first) = rows.first() else {
            return;
        };
        let reason = format!(
            "{} rows of the catalog's table \"tiles\" have the name {name:?}: `saccade check --repair --acquisition FOLDER` finds out \
             which is the tile's, and until then they stay as they are",
            rows.len()
        );
        self.tell(entry, first, reason, None);
    }

    fn tell(
        &mut self,
        entry: &VolumeEntry,
        row: &NamedRow,
        reason: String,
        repair: Option<Repair>,
    ) {
        self.report.findings.push(Finding {
            kind: FindingKind::Spoilt,
            volume: Some(entry.volume.name.clone()),
            tile: Some(row.name.clone()),
            object: Some(row.pyramid.clone()),
            reason,
            repair,
        });
    }
}

/// Whether two rows of one name say the same of their tile: whether it is there, and where.
fn says_the_same(a: &NamedRow, b: &NamedRow) -> bool {
    let said = |row: &NamedRow| {
        let tile = row.tile.as_ref();
        tile.map(|tile| {
            (
                tile.section,
                tile.channel,
                tile.size,
                tile.transform.elements(),
            )
        })
    };
    (a.deleted, &a.pyramid, said(a)) == (b.deleted, &b.pyramid, said(b))
}
