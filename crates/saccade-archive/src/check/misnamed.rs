//! Rows that name another tile's pyramid.

use std::hash::BuildHasher as _;

use super::names::Name;
use super::repair::Source;
use super::{Check, CheckError, FindingKind, Repair};
use crate::catalog::{Origin, Tile, VolumeEntry};
use crate::pyramid::{PyramidError, Verified};
use crate::storage::StorageError;

impl Check<'_> {
    /// A tile that names the pyramid of another tile, of another volume, or of an older image of its own; whether it does.
    pub(super) async fn misnamed(
        &mut self,
        entry: &VolumeEntry,
        tile: &Tile,
        looked: &Result<(Verified, u64), PyramidError>,
    ) -> Result<bool, CheckError> {
        let volume = &entry.volume.name;
        let Some(name) = Name::of(&tile.pyramid) else {
            return Ok(false);
        };
        let is_elsewhere = name.volume != *volume && self.known.contains(name.volume);
        let newest = { self.records.as_ref() }.and_then(|records| records.newest_of(&tile.name));
        let is_doubtful = is_elsewhere
            || !name.is_after(&tile.name)
            || newest.is_some_and(|newest| newest != name.position);
        // What is not there is missing.
        let is_gone = matches!(
            looked,
            Err(PyramidError::Storage {
                source: StorageError::NotFound { .. },
                ..
            })
        );
        if !is_doubtful || is_gone {
            return Ok(false);
        }
        let catalog = self.archive.catalog();
        // A newer image may still wait, and who gave the tile another name has kept the pyramid's.
        let is_of_its_record = !is_elsewhere && tile.position == name.position;
        let is_shared = catalog.origins(volume, &tile.pyramid).await?.len() > 1;
        if is_of_its_record || (is_shared && !self.renamed.contains(&tile.pyramid)) {
            return Ok(false);
        }
        let is_its = |at: u64| {
            let source = self.source(entry, Some(&tile.name), Some(at));
            matches!(source, Source::There(..) | Source::ImageGone(_))
        };
        let is_older = !is_elsewhere && is_its(name.position);
        if is_older && (!is_its(tile.position) || tile.position < name.position) {
            return Ok(false);
        }
        let reason = match () {
            () if is_elsewhere => format!("it names a pyramid of volume {:?}", name.volume),
            () if is_older => "it names the pyramid of an older image of it".to_owned(),
            () => format!(
                "it names the pyramid of another tile, of the record at byte {}",
                name.position
            ),
        };
        self.named.insert(self.hasher.hash_one(&tile.pyramid));
        if let Some(own) = self.own_pyramid(entry, tile).await? {
            let kind = FindingKind::Mistaken;
            self.rename_pyramid(kind, entry, tile, own, reason).await?;
            return Ok(true);
        }
        self.anew(entry, tile, reason).await?;
        Ok(true)
    }

    /// Has a tile made anew that names another's pyramid.
    async fn anew(
        &mut self,
        entry: &VolumeEntry,
        tile: &Tile,
        mut reason: String,
    ) -> Result<(), CheckError> {
        let position = self.position(entry, tile).await?.unwrap_or(tile.position);
        let known = (entry.volume.name.clone(), position);
        self.kept.insert(known);
        let source = self.source(entry, Some(&tile.name), Some(position));
        let mut repair = None;
        match source {
            Source::There(..) if self.options.repair => {
                let origin = Origin {
                    tile: tile.name.clone(),
                    position,
                    transform_position: position,
                };
                repair = self
                    .give_back(entry, &origin, &tile.pyramid, &reason)
                    .await?;
            }
            Source::There(..) => {}
            source => reason.push_str(&source.advice(false)),
        }
        self.find(FindingKind::Mistaken, entry, Some(tile), reason)
            .repair = repair;
        Ok(())
    }

    /// A tile that names a folder, which may hold the pyramids of others.
    pub(super) async fn names_folder(
        &mut self,
        entry: &VolumeEntry,
        tile: &Tile,
    ) -> Result<(), CheckError> {
        let mut reason = "the catalog names a folder as its pyramid".to_owned();
        if let Some(own) = self.own_pyramid(entry, tile).await? {
            let kind = FindingKind::Spoilt;
            return self.rename_pyramid(kind, entry, tile, own, reason).await;
        }
        reason.push_str(
            ": append the tile's record to its acquisition once more, and ingest makes it anew",
        );
        self.find(FindingKind::Spoilt, entry, Some(tile), reason);
        Ok(())
    }

    /// The pyramid of a tile's own record, if the tile names another and that one is whole.
    pub(super) async fn own_pyramid(
        &mut self,
        entry: &VolumeEntry,
        tile: &Tile,
    ) -> Result<Option<String>, CheckError> {
        for position in self.other_positions(entry, tile).await? {
            let source = self.source(entry, Some(&tile.name), Some(position));
            if matches!(source, Source::NoRecord) {
                continue;
            }
            // Of one that is on its way, ingest says what it is.
            let volume = &entry.volume.name;
            if self
                .archive
                .catalog()
                .is_to_be_done(volume, position)
                .await?
            {
                continue;
            }
            if let Some(own) = self.whole_pyramid(entry, tile, position).await {
                return Ok(Some(own));
            }
        }
        Ok(None)
    }

    /// The pyramid of a tile's record at a position, if there is one and it is whole.
    pub(super) async fn whole_pyramid(
        &mut self,
        entry: &VolumeEntry,
        tile: &Tile,
        position: u64,
    ) -> Option<String> {
        for own in self.objects_of(&entry.volume.name, position, &tile.name) {
            let named = Tile {
                pyramid: own.clone(),
                ..tile.clone()
            };
            let is_whole = self.look(&named).await.is_ok_and(|(verified, _)| {
                let level = verified.index.levels()[0];
                !verified.mistaken && [level.width, level.height] == tile.size.to_array()
            });
            if is_whole {
                return Some(own);
            }
        }
        None
    }

    /// Notes that a tile does not name its own pyramid, and has it do so if that is wanted.
    pub(super) async fn rename_pyramid(
        &mut self,
        kind: FindingKind,
        entry: &VolumeEntry,
        tile: &Tile,
        own: String,
        mut reason: String,
    ) -> Result<(), CheckError> {
        self.named.insert(self.hasher.hash_one(&own));
        reason.push_str(&format!("; its own is there ({own})"));
        let mut repair = None;
        if self.options.repair {
            let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
            commit.rename_pyramid(tile, &own).await?;
            commit.finish().await?;
            self.renamed.insert(own);
            repair = Some(Repair::Renamed);
        } else {
            reason.push_str(", and `saccade check --repair` has it name that again");
        }
        self.find(kind, entry, Some(tile), reason).repair = repair;
        Ok(())
    }
}
