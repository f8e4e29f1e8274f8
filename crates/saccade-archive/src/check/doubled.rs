//! Rows of one name, which there are only where somebody took the index away that keeps names apart.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use super::names::Name;
use super::{Check, CheckError, Finding, FindingKind, Repair};
use crate::acquisition::Record;
use crate::catalog::{NamedRow, VolumeEntry};

impl Check<'_> {
    /// Of rows that have one name keeps the one that its records speak of, and takes the others out of the catalog; a row of
    /// another tile, which the catalog lacks otherwise, is called as that one when it is looked at. Without records nothing tells.
    pub(super) async fn doubled(&mut self, entry: &VolumeEntry) -> Result<(), CheckError> {
        if !self.lacks_index || self.records.is_none() {
            return Ok(());
        }
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let mut by_name = BTreeMap::<String, Vec<NamedRow>>::new();
        for row in catalog.rows_of_one_name(volume).await? {
            by_name.entry(row.name.clone()).or_default().push(row);
        }
        for (name, rows) in by_name {
            let mut own = Vec::new();
            for row in rows {
                if !self.is_of_a_lost_one(entry, &row).await? {
                    own.push(row);
                }
            }
            let newest = self.records.as_ref().and_then(|r| r.position_of(&name));
            // Of rows that are the same in all this, the one that was there first.
            let is_its = |row: &NamedRow| {
                let own = Name::of(&row.pyramid).filter(|own| own.is_after(&name));
                own.is_some_and(|own| Some(own.position) == row.position)
            };
            let fits = |row: &NamedRow| {
                let is_newest = row.position.is_some() && row.position == newest;
                (is_newest, is_its(row), row.position, Reverse(row.id.0))
            };
            own.sort_by_key(|row| Reverse(fits(row)));
            for row in own.iter().skip(1) {
                self.take_out(entry, row).await?;
            }
        }
        Ok(())
    }

    /// Whether a row is of a tile that no row has the name of.
    async fn is_of_a_lost_one(
        &self,
        entry: &VolumeEntry,
        row: &NamedRow,
    ) -> Result<bool, CheckError> {
        let record = row
            .position
            .and_then(|at| Some(self.record_at(entry, at)?.1));
        let of = match record {
            Some(Record::Tile(record)) => record.tile,
            Some(Record::Delete(record)) => record.tile,
            Some(Record::Transform(_)) | None => return Ok(false),
        };
        let holder = self.archive.catalog().holder(&entry.volume.name, &of);
        Ok(of != row.name && holder.await?.is_none())
    }

    async fn take_out(&mut self, entry: &VolumeEntry, row: &NamedRow) -> Result<(), CheckError> {
        let mut reason = "another row has its name, and is the one of its newest record".to_owned();
        let mut repair = None;
        if self.options.repair {
            let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
            commit.take_out(row).await?;
            commit.finish().await?;
            repair = Some(Repair::TakenAway);
        } else {
            reason.push_str(": `saccade check --repair` takes this one away");
        }
        self.report.findings.push(Finding {
            kind: FindingKind::Spoilt,
            volume: Some(entry.volume.name.clone()),
            tile: Some(row.name.clone()),
            object: Some(row.pyramid.clone()),
            reason,
            repair,
        });
        Ok(())
    }
}
