//! What the records say, and giving tiles back to ingest.

use std::path::PathBuf;

use super::{Check, CheckError, FindingKind, Repair};
use crate::acquisition::{Cursor, Record, RecordReader, TileRecord, image_path};
use crate::catalog::{Quarantined, Tile, VolumeEntry, Waiting};

impl Check<'_> {
    /// Gives a tile back to ingest, or puts it into quarantine.
    pub(super) async fn repair(
        &self,
        entry: &VolumeEntry,
        tile: &Tile,
        kind: FindingKind,
        reason: &str,
    ) -> Result<Repair, CheckError> {
        let position = match position_of(&tile.pyramid) {
            // One that had another's, and was given back.
            None => {
                let catalog = self.archive.catalog();
                let origins = catalog.origins(&entry.volume.name, &tile.pyramid).await?;
                let own = origins.iter().find(|origin| origin.tile == tile.name);
                own.map(|origin| origin.position)
            }
            position => position,
        };
        let record = position.and_then(|at| self.tile_record(entry, Some(&tile.name), at));
        let what = match kind {
            FindingKind::Spoilt => "what the catalog says of it was found wrong",
            _ => "its pyramid was found damaged",
        };
        if let Some((position, record)) = position.zip(record) {
            let reason = format!("{what}: {reason}");
            self.queue(entry, position, record, reason).await?;
            return Ok(Repair::Queued);
        }
        let what = Quarantined {
            file: tile.pyramid.clone(),
            tile: Some(tile.name.clone()),
            reason: format!(
                "{what} ({reason}); append the tile's record to its acquisition once more, and ingest makes it anew"
            ),
            bytes: None,
            at: self.archive.catalog().clock().now(),
        };
        let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
        commit.quarantine(&what).await?;
        commit.finish().await?;
        Ok(Repair::Quarantined)
    }

    /// Has ingest work on a record again.
    pub(super) async fn queue(
        &self,
        entry: &VolumeEntry,
        position: u64,
        record: TileRecord,
        reason: String,
    ) -> Result<(), CheckError> {
        let waiting = Waiting {
            position,
            record,
            reason,
        };
        let mut commit = self.archive.catalog().begin(&entry.volume.name).await?;
        commit.wait(&waiting).await?;
        commit.finish().await?;
        Ok(())
    }

    /// The folder of a volume's records, if there is one.
    pub(super) fn folder_of(&self, entry: &VolumeEntry) -> Option<PathBuf> {
        let kept = { self.options.watched.iter() }.map(|all| all.join(&entry.volume.name));
        let mut kept = kept.filter(|folder| folder.join(RecordReader::FILE).is_file());
        kept.next().or_else(|| self.options.acquisition.clone())
    }

    /// The record at a position, and the folder of its acquisition, if the records are those that were read.
    pub(super) fn record_at(&self, entry: &VolumeEntry, at: u64) -> Option<(PathBuf, Record)> {
        let folder = self.folder_of(entry)?;
        RecordReader::new(&folder, self.read?).recognize().ok()?;
        let cursor = Cursor {
            offset: at,
            ..Cursor::default()
        };
        let mut reader = RecordReader::new(&folder, cursor);
        let line = reader.read(1).ok()?.into_iter().next()?;
        let record = line.record.ok().filter(|_| line.offset == at)?;
        Some((folder, record))
    }

    /// The record of a tile, of this one if that is said, at a position, if its image is still there.
    pub(super) fn tile_record(
        &self,
        entry: &VolumeEntry,
        tile: Option<&str>,
        at: u64,
    ) -> Option<TileRecord> {
        match self.record_at(entry, at)? {
            (folder, Record::Tile(record)) if tile.is_none_or(|tile| record.tile == tile) => {
                let image = image_path(&folder, &record.file)?;
                image.is_file().then_some(record)
            }
            _ => None,
        }
    }
}

/// The position of the record that a pyramid was made of: ingest ends names with it.
pub(super) fn position_of(pyramid: &str) -> Option<u64> {
    let stem = pyramid.strip_suffix(".tif")?;
    u64::from_str_radix(stem.rsplit_once('-')?.1, 16).ok()
}
