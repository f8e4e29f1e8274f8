//! Tiles that lie where nothing can, and rows of which nothing can be understood.

use std::hash::BuildHasher as _;

use glam::UVec2;
use saccade_core::transform::SectionFromTile;

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
        self.named.insert(self.hasher.hash_one(&tile.pyramid));
        let mut reason = format!("what the catalog says of it cannot be ({})", tile.reason);
        let repair = match tile.size {
            Some(size) if self.options.repair => {
                let said = self.said(entry, &tile.name, &tile.pyramid, tile.section, size);
                let said = said.await?;
                self.put(entry, &tile.name, said, &mut reason).await?
            }
            Some(_) => None,
            None => {
                reason.push_str(
                    "; append the tile's record to its acquisition once more, and ingest enters it anew",
                );
                None
            }
        };
        self.report.findings.push(Finding {
            kind: FindingKind::Spoilt,
            volume: Some(entry.volume.name.clone()),
            tile: Some(tile.name),
            object: Some(tile.pyramid),
            reason,
            repair,
        });
        Ok(())
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
        let read = catalog.cursor(volume).await?;
        let origins = catalog.origins(volume, pyramid).await?;
        let origin = origins.into_iter().find(|origin| origin.tile == tile);
        Ok(origin.and_then(|origin| {
            let of = [origin.transform_position, origin.position];
            let said = |at| match self.record_at(entry, at, read)?.1 {
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
        reason.push_str(
            ", and no record is to be had that says where it lies: name the folder of the acquisition with \
             --acquisition, or say with `saccade update` where it lies, or that it is no more",
        );
        Ok(None)
    }
}
