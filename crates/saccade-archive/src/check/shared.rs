//! Tiles that name one pyramid.

use super::repair::{WRONG, position_of};
use super::{Check, CheckError, Finding, FindingKind, Repair};
use crate::catalog::{Origin, Quarantined, Tile, VolumeEntry, Waiting};

impl Check<'_> {
    /// A tile names a pyramid that one before it names, too. It was made of one record: the tiles of others are found.
    pub(super) async fn shared(
        &mut self,
        entry: &VolumeEntry,
        tile: &Tile,
    ) -> Result<(), CheckError> {
        if !self.shared.insert(tile.pyramid.clone()) {
            return Ok(());
        }
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let origins = catalog.origins(volume, &tile.pyramid).await?;
        let made_of = position_of(&tile.pyramid);
        let owner = |origin: &&Origin| Some(origin.position) == made_of;
        let mut owners = origins.iter().filter(owner);
        let owner = owners.next().filter(|_| owners.next().is_none());
        // All of them at once. Where only one is left, somebody has mended it since it was listed.
        let others = origins.iter().filter(|origin| owner != Some(*origin));
        for origin in others.filter(|_| origins.len() > 1) {
            let reason = match owner {
                Some(owner) => format!("it names the pyramid of tile {}", owner.tile),
                None => "it names a pyramid that others name, too, and that is nobody's".to_owned(),
            };
            let mut repair = None;
            if self.options.repair {
                repair = self
                    .give_back(entry, origin, &tile.pyramid, &reason)
                    .await?;
                let given_back = (volume.clone(), origin.tile.clone());
                self.given_back.insert(given_back);
            }
            self.report.findings.push(Finding {
                kind: FindingKind::Shared,
                volume: Some(volume.clone()),
                tile: Some(origin.tile.clone()),
                object: Some(tile.pyramid.clone()),
                reason,
                repair,
            });
        }
        Ok(())
    }

    /// Takes a pyramid that is not its own from a tile, and has it made anew; nothing, if it names another one meanwhile.
    pub(super) async fn give_back(
        &self,
        entry: &VolumeEntry,
        origin: &Origin,
        pyramid: &str,
        reason: &str,
    ) -> Result<Option<Repair>, CheckError> {
        let catalog = self.archive.catalog();
        let record = self.tile_record(entry, Some(&origin.tile), origin.position);
        let mut commit = catalog.begin(&entry.volume.name).await?;
        if !commit.detach(&origin.tile, pyramid).await? {
            return Ok(None);
        }
        let repair = match record {
            Some(record) => {
                let waiting = Waiting {
                    position: origin.position,
                    record,
                    reason: reason.to_owned(),
                };
                commit.wait(&waiting).await?;
                Repair::Queued
            }
            None => {
                let what = Quarantined {
                    file: pyramid.to_owned(),
                    tile: Some(origin.tile.clone()),
                    reason: format!(
                        "{WRONG}: {reason}; append the tile's record to its acquisition once more, with the transform that it is to \
                         have, and ingest makes its own"
                    ),
                    bytes: None,
                    at: self.archive.catalog().clock().now(),
                    awaited: None,
                };
                commit.quarantine(&what).await?;
                Repair::Quarantined
            }
        };
        commit.finish().await?;
        Ok(Some(repair))
    }
}
