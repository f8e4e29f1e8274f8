//! Tiles that lie where nothing can, and rows of which nothing can be understood.

use std::hash::BuildHasher as _;

use glam::UVec2;
use saccade_core::transform::SectionFromTile;

use super::repair::{Source, position_of};
use super::{Check, CheckError, Finding, FindingKind, Repair};
use crate::acquisition::Record;
use crate::catalog::{CatalogError, SpoiltTile, Tile, VolumeEntry, place};

impl Check<'_> {
    /// A tile lies where no voxel is.
    pub(super) async fn misplaced(
        &mut self,
        entry: &VolumeEntry,
        tile: &Tile,
    ) -> Result<(), CheckError> {
        let mut reason = format!(
            "it lies outside of the volume (section {}, transform {:?})",
            tile.section,
            tile.transform.elements()
        );
        let (name, pyramid) = (&tile.name, &tile.pyramid);
        let depth = entry.volume.extent().z;
        if tile.section >= depth {
            // No transform leads back from there.
            let source = self.source(entry, Some(name), self.position(entry, tile).await?);
            let mut repair = None;
            match source {
                Source::There(position, record)
                    if self.options.repair && record.section < depth =>
                {
                    let why = format!("the catalog said section {} of it", tile.section);
                    self.queue(entry, position, record, why).await?;
                    repair = Some(Repair::Queued);
                }
                Source::There(..) => {}
                source => reason.push_str(&format!(
                    "{}; or delete it with `saccade update`",
                    source.advice(false)
                )),
            }
            self.find(FindingKind::Misplaced, entry, Some(tile), reason)
                .repair = repair;
            return Ok(());
        }
        let repair = match self.options.repair {
            true => {
                let said = self.said(entry, name, pyramid, tile.section, tile.size);
                let said = said.await?;
                self.put(entry, name, said, &mut reason).await?
            }
            false => None,
        };
        self.find(FindingKind::Misplaced, entry, Some(tile), reason)
            .repair = repair;
        Ok(())
    }

    /// The catalog says of a tile what cannot be. Its pyramid is looked at when that is mended.
    pub(super) async fn spoilt(
        &mut self,
        entry: &VolumeEntry,
        tile: SpoiltTile,
    ) -> Result<(), CheckError> {
        let (Ok(pyramid) | Err(pyramid)) = &tile.pyramid;
        if self.is_undecided(tile.id, tile.name.as_deref().ok(), pyramid) {
            return Ok(());
        }
        if let Ok(name) = &tile.name
            && self.history.was_deleted(tile.id, 0)
            && tile.pyramid.as_ref().is_err_and(String::is_empty)
        {
            return self.end_again(entry, name, "").await;
        }
        let pyramid = tile.pyramid.as_ref().ok();
        let position = { tile.position }.or_else(|| position_of(pyramid?));
        if let Some(pyramid) = pyramid {
            self.named.insert(self.hasher.hash_one(pyramid));
        } else if let Some(position) = position {
            self.kept.insert((entry.volume.name.clone(), position));
        }
        let mut reason = format!("what the catalog says of it cannot be ({})", tile.reason);
        let name = tile.name.as_ref().ok().map(String::as_str);
        let shape = { tile.but_for_place.as_ref() }.map(|tile| (tile.section, tile.size));
        let repair = match (name, pyramid, shape) {
            // Only where it lies cannot be.
            (Some(name), Some(pyramid), Some((section, size))) => match self.options.repair {
                true => {
                    let said = self.said(entry, name, pyramid, section, size).await?;
                    self.put(entry, name, said, &mut reason).await?
                }
                false => None,
            },
            _ => self.enter_anew(entry, &tile, position, &mut reason).await?,
        };
        self.report.findings.push(Finding {
            kind: FindingKind::Spoilt,
            volume: Some(entry.volume.name.clone()),
            tile: Some(tile.name.unwrap_or_else(|legible| legible)),
            object: Some(tile.pyramid.unwrap_or_else(|legible| legible)),
            reason,
            repair,
        });
        Ok(())
    }

    /// Has ingest enter a tile anew whose row cannot be understood, or says what is to be done.
    async fn enter_anew(
        &mut self,
        entry: &VolumeEntry,
        tile: &SpoiltTile,
        position: Option<u64>,
        reason: &mut String,
    ) -> Result<Option<Repair>, CheckError> {
        let name = tile.name.as_ref().ok().map(String::as_str);
        let (position, record) = match self.source(entry, name, position) {
            Source::There(position, record) => (position, record),
            Source::NoRecords if name.is_none() => {
                reason.push_str("; with --acquisition FOLDER the records tell which tile it is");
                return Ok(None);
            }
            source => {
                reason.push_str(&source.advice(false));
                return Ok(None);
            }
        };
        if let Some(records) = &mut self.records {
            records.meet(&record.tile);
        }
        if !self.options.repair {
            return Ok(None);
        }
        if name.is_none() {
            let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
            commit.end_nameless(tile.id).await?;
            commit.finish().await?;
        }
        // Made anew, it stays where it is.
        if let Some(placed) = &tile.but_for_pyramid {
            self.settle(entry, placed).await?;
        }
        let why = format!("what the catalog said of it could not be ({})", tile.reason);
        self.queue(entry, position, record, why).await?;
        Ok(Some(Repair::Queued))
    }

    /// Nothing is known of a volume: neither its tiles nor its objects are looked at.
    pub(super) fn not_understood(&mut self, name: String, error: &CatalogError) {
        let reason = format!("{}; none of its tiles was looked at", error.without_place());
        self.report.findings.push(Finding {
            kind: FindingKind::Spoilt,
            volume: Some(name.clone()),
            tile: None,
            object: None,
            reason,
            repair: None,
        });
        self.unknown.insert(name);
    }

    /// Where the newest of a tile's records that leads anywhere says that it lies.
    async fn said(
        &self,
        entry: &VolumeEntry,
        tile: &str,
        pyramid: &str,
        section: u32,
        size: UVec2,
    ) -> Result<Option<SectionFromTile>, CheckError> {
        let (catalog, volume) = (self.archive.catalog(), &entry.volume.name);
        let origins = catalog.origins(volume, pyramid).await?;
        let origin = origins.into_iter().find(|origin| origin.tile == tile);
        Ok(origin.and_then(|origin| {
            let of = [origin.transform_position, origin.position];
            let said = |at| match self.record_at(entry, at)?.1 {
                Record::Tile(record) if record.tile == tile => Some(record.transform),
                Record::Transform(record) if record.tile == tile => Some(record.transform),
                _ => None,
            };
            let inside = |to: &_| place(entry.volume.extent(), section, size, *to).is_some();
            of.into_iter().filter_map(said).find(inside)
        }))
    }

    /// Moves a tile to where its records say, or says what is to be done.
    async fn put(
        &self,
        entry: &VolumeEntry,
        tile: &str,
        said: Option<SectionFromTile>,
        reason: &mut String,
    ) -> Result<Option<Repair>, CheckError> {
        if let Some(transform) = said {
            let catalog = self.archive.catalog();
            let moved = catalog.set_transform(&entry.volume.name, tile, transform);
            moved.await?;
            return Ok(Some(Repair::Moved));
        }
        reason.push_str(match self.folder_of(entry) {
            Some(_) => {
                ", and no record of the acquisition's folder says where else it lies: append one, or say with \
                 `saccade update` where it lies, or that it is no more"
            }
            None => {
                ", and no record is to be had that says where it lies: name the folder of the acquisition with \
                 --acquisition, or say with `saccade update` where it lies, or that it is no more"
            }
        });
        Ok(None)
    }
}
