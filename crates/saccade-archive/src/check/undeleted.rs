//! Tiles that are called deleted, of which no deletion is known, and such as were deleted and are there.

use super::repair::{Source, position_of};
use super::{Check, CheckError, Finding, FindingKind, Repair};
use crate::catalog::{Tile, VolumeEntry, place};

impl Check<'_> {
    /// Finds rows that are called deleted and have the position of a record of their tiles: deletions leave that of the record
    /// that ends it, or of the end of those that were read.
    pub(super) async fn undeleted(&mut self, entry: &VolumeEntry) -> Result<(), CheckError> {
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let mut after = i64::MIN;
        while let Some((last, rows)) = catalog.deleted_after(volume, after).await? {
            after = last;
            for (mut tile, position) in rows {
                if self.is_undecided(tile.id, Some(&tile.name), &tile.pyramid) {
                    continue;
                }
                if let Some(name) = self.called.get(&tile.id) {
                    tile.name.clone_from(name);
                }
                if self.ended_as_another(entry, &tile, position).await? {
                    continue;
                }
                let records = self.records.as_ref();
                let is_recorded = records.is_some_and(|records| records.is_deleted(&tile.name));
                if is_recorded || self.history.was_deleted(tile.id, 0) {
                    continue;
                }
                let is_of = records.and_then(|records| records.newest_of(&tile.name));
                if is_of == Some(position)
                    || !self.objects_of(volume, position, &tile.name).is_empty()
                {
                    self.not_deleted(entry, tile, position).await?;
                }
            }
        }
        Ok(())
    }

    async fn not_deleted(
        &mut self,
        entry: &VolumeEntry,
        tile: Tile,
        position: u64,
    ) -> Result<(), CheckError> {
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        self.report.tiles += 1;
        self.kept.insert((volume.clone(), position));
        let said = self.records.as_mut().and_then(|records| {
            records.meet(&tile.name);
            records.said(&tile.name)
        });
        let mut reason =
            "the catalog calls it deleted, and neither a record nor a change tells of a deletion"
                .to_owned();
        let pyramid = self.whole_pyramid(entry, &tile, position).await;
        let tile = match pyramid.clone() {
            Some(pyramid) => {
                let named = Tile { pyramid, ..tile };
                self.in_its_place(entry, &named, &mut reason).await?
            }
            None => tile,
        };
        let mut repair = None;
        let extent = entry.volume.extent();
        let is_placed = place(extent, tile.section, tile.size, tile.transform).is_some();
        // What is no longer kept may have been a deletion.
        if self.history.last(tile.id).is_none() {
            reason.push_str(
                " that is still kept: nobody knows whether it was deleted, and its pyramid is kept. Append its record to the \
                 acquisition once more, or one that it is deleted",
            );
        } else if pyramid.is_some() && is_placed {
            if self.options.repair {
                let mut commit = catalog.begin(volume).await?;
                commit.undelete(&tile).await?;
                commit.finish().await?;
                repair = Some(Repair::Restored);
            } else {
                reason.push_str(": `saccade check --repair` brings it back, and what should be gone `saccade update` deletes then");
            }
        } else {
            reason.push_str("; its pyramid is not whole");
            match self.source(entry, Some(&tile.name), Some(position)) {
                Source::There(position, record) if self.options.repair => {
                    self.queue(entry, position, record, reason.clone()).await?;
                    self.keep_place(
                        entry,
                        &tile.name,
                        said.filter(|said| said.record > position),
                    )
                    .await?;
                    repair = Some(Repair::Queued);
                }
                Source::There(..) => {}
                source => reason.push_str(&source.advice(true)),
            }
        }
        self.report.findings.push(Finding {
            kind: FindingKind::Spoilt,
            volume: Some(volume.clone()),
            tile: Some(tile.name),
            object: pyramid,
            reason,
            repair,
        });
        Ok(())
    }

    /// A tile that was deleted when it last changed is there: it is deleted again.
    pub(super) async fn end_again(
        &mut self,
        entry: &VolumeEntry,
        tile: &str,
        pyramid: &str,
    ) -> Result<(), CheckError> {
        // Nobody counts it.
        self.report.tiles -= 1;
        if let Some(records) = &mut self.records {
            records.meet(tile);
        }
        let mut reason =
            "it was deleted when it last changed, as the catalog's changes tell, and is called there".to_owned();
        let mut repair = None;
        if self.options.repair {
            let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
            commit.take_away(tile).await?;
            commit.finish().await?;
            repair = Some(Repair::TakenAway);
        } else {
            let of = position_of(pyramid);
            self.kept
                .extend(of.map(|of| (entry.volume.name.clone(), of)));
            reason.push_str(
                ": `saccade check --repair` takes it away; should it be there, append its record to the acquisition once more",
            );
        }
        self.report.findings.push(Finding {
            kind: FindingKind::Spoilt,
            volume: Some(entry.volume.name.clone()),
            tile: Some(tile.to_owned()),
            object: (!pyramid.is_empty()).then(|| pyramid.to_owned()),
            reason,
            repair,
        });
        Ok(())
    }
}
