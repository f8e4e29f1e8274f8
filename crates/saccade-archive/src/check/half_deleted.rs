//! Tiles that are said to be deleted, of which no deletion is known.

use std::borrow::Cow;
use std::hash::BuildHasher as _;

use super::repair::Source;
use super::{Check, CheckError, Finding, FindingKind, Repair};
use crate::acquisition::Record;
use crate::catalog::{SpoiltTile, Tile, VolumeEntry, place};

impl Check<'_> {
    /// Finds rows that are said to be deleted and name their pyramid still, as no deletion leaves them. Those whose records say so,
    /// too, are deleted.
    pub(super) async fn half_deleted(&mut self, entry: &VolumeEntry) -> Result<(), CheckError> {
        let volume = &entry.volume.name;
        for row in self.archive.catalog().half_deleted(volume).await? {
            // Before it is called otherwise.
            let (id, name, pyramid) = match &row {
                Ok(tile) => (tile.id, Some(&*tile.name), &tile.pyramid),
                Err(spoilt) => {
                    let (Ok(pyramid) | Err(pyramid)) = &spoilt.pyramid;
                    (spoilt.id, spoilt.name.as_deref().ok(), pyramid)
                }
            };
            if self.is_undecided(id, name, pyramid) {
                continue;
            }
            let row = match row {
                // The record that ended the tile of that name says nothing of another's row.
                Ok(tile) if self.is_told_deleted(&tile.name) => {
                    let called = self.rightly_called(entry, &tile).await?;
                    Ok(called.map_or_else(|| tile.clone(), Cow::into_owned))
                }
                row => row,
            };
            let (name, pyramid) = match &row {
                Ok(tile) => (Some(&tile.name), Some(&tile.pyramid)),
                Err(spoilt) => (spoilt.name.as_ref().ok(), spoilt.pyramid.as_ref().ok()),
            };
            if let Some(pyramid) = pyramid {
                self.named.insert(self.hasher.hash_one(pyramid));
            }
            let id = row.as_ref().map_or_else(|spoilt| spoilt.id, |tile| tile.id);
            let is_told = name.is_some_and(|name| self.is_told_deleted(name));
            let is_known = !is_told && self.history.was_deleted(id, 0);
            if is_told || is_known {
                let (tile, object) = (name.cloned(), pyramid.cloned());
                let mut repair = None;
                if self.options.repair {
                    let mut commit = self.archive.catalog().begin(volume).await?;
                    commit.end_nameless(id).await?;
                    commit.finish().await?;
                    repair = Some(Repair::TakenAway);
                }
                // Records that say so are enough; whoever only looks is told what is left of others.
                if is_known {
                    let reason = "it was deleted, as the catalog's changes tell, and its row names a pyramid still".to_owned();
                    self.report.findings.push(Finding {
                        kind: FindingKind::Spoilt,
                        volume: Some(volume.clone()),
                        tile,
                        object,
                        reason,
                        repair,
                    });
                }
                continue;
            }
            self.report.tiles += 1;
            if let Some((name, records)) = name.zip(self.records.as_mut()) {
                records.meet(name);
            }
            match row {
                Ok(tile) => self.bring_back(entry, &tile).await?,
                Err(spoilt) => match self.placed_again(entry, &spoilt) {
                    Some(tile) => self.bring_back(entry, &tile).await?,
                    None => self.spoilt(entry, spoilt).await?,
                },
            }
        }
        Ok(())
    }

    /// Whether the newest of a tile's records is its end.
    fn is_told_deleted(&self, tile: &str) -> bool {
        { self.records.as_ref() }.is_some_and(|records| records.is_deleted(tile))
    }

    /// A tile of which only the place cannot be, where its newest record says that it lies.
    fn placed_again(&self, entry: &VolumeEntry, spoilt: &SpoiltTile) -> Option<Tile> {
        let tile = spoilt.but_for_place.as_deref()?;
        let said = self.records.as_ref()?.said(&tile.name)?;
        let transform = match self.record_at(entry, said.record)?.1 {
            Record::Tile(record) if record.tile == tile.name => record.transform,
            Record::Transform(record) if record.tile == tile.name => record.transform,
            _ => return None,
        };
        Some(Tile {
            transform,
            ..tile.clone()
        })
    }

    async fn bring_back(&mut self, entry: &VolumeEntry, tile: &Tile) -> Result<(), CheckError> {
        let mut reason =
            "the catalog calls it deleted, but names its pyramid still, as no deletion leaves it"
                .to_owned();
        let looked = self.look(tile).await;
        let tile = &self.in_its_place(entry, tile, &mut reason).await?;
        let is_placed = place(
            entry.volume.extent(),
            tile.section,
            tile.size,
            tile.transform,
        )
        .is_some();
        let is_whole = is_placed && looked.is_ok_and(|(verified, _)| !verified.mistaken);
        let contradicted = self.contradicted(entry, tile);
        let mut repair = None;
        if is_whole && contradicted.is_none() {
            if self.options.repair {
                let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
                commit.undelete(tile).await?;
                commit.finish().await?;
                repair = Some(Repair::Restored);
            } else {
                reason.push_str(
                    ": `saccade check --repair` brings it back, and what should be gone `saccade update` deletes then",
                );
            }
        } else {
            match contradicted {
                Some(contradicted) => reason.push_str(&format!("; {contradicted}")),
                None => reason.push_str("; its pyramid is not whole"),
            }
            match self.source(entry, Some(&tile.name), self.position(entry, tile).await?) {
                Source::There(position, record) if self.options.repair => {
                    if is_placed {
                        // Made anew, it stays where it is.
                        let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
                        commit.undelete(tile).await?;
                        commit.finish().await?;
                    }
                    let why = format!("{reason}, and no record says that it is deleted");
                    self.queue(entry, position, record, why).await?;
                    repair = Some(Repair::Queued);
                }
                Source::There(..) => {}
                source => reason.push_str(&source.advice(true)),
            }
        }
        self.report.findings.push(Finding {
            kind: FindingKind::Spoilt,
            volume: Some(entry.volume.name.clone()),
            tile: Some(tile.name.clone()),
            object: Some(tile.pyramid.clone()),
            reason,
            repair,
        });
        Ok(())
    }
}
