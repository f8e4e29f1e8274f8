//! What ingest remembers: how far it has read, what waits, what is set aside, what is to be deleted.

use std::time::SystemTime;

use super::database::Row;
use super::{Catalog, CatalogError, Quarantined, Retired, Waiting, rows};
use crate::acquisition::Cursor;

impl Catalog {
    /// The files in quarantine, oldest first.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn quarantined(&self, volume: &str) -> Result<Vec<Quarantined>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT file, tile, reason, bytes, at, awaited FROM quarantine \
                        WHERE volume = $1 ORDER BY id";
        self.ask(question, &[id.into()], rows::quarantined).await
    }

    /// The first `most` of them.
    ///
    /// # Errors
    ///
    /// As [`Self::quarantined`].
    pub async fn first_quarantined(
        &self,
        volume: &str,
        most: u32,
    ) -> Result<Vec<Quarantined>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT file, tile, reason, bytes, at, awaited FROM quarantine \
                        WHERE volume = $1 ORDER BY id LIMIT $2";
        let values = [id.into(), most.into()];
        self.ask(question, &values, rows::quarantined).await
    }

    /// Whether anything of a tile is in quarantine.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn is_set_aside(&self, volume: &str, tile: &str) -> Result<bool, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT id FROM quarantine WHERE volume = $1 AND tile = $2 LIMIT 1";
        let values = [id.into(), tile.into()];
        let found = self.ask(question, &values, |row| row.get::<i64>("id"));
        Ok(!found.await?.is_empty())
    }

    /// How far the records were read.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], [`CatalogError::SpoiltCursor`], or what the database says.
    pub async fn cursor(&self, volume: &str) -> Result<Cursor, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT byte, line, seen FROM cursors WHERE volume = $1";
        let cursor = |row: &Row| Ok(rows::cursor(row));
        let found = self.ask(question, &[id.into()], cursor).await?;
        let cursor = found.into_iter().next().unwrap_or(Ok(Cursor::default()));
        cursor.map_err(|error| CatalogError::SpoiltCursor {
            volume: volume.to_owned(),
            reason: rows::reason_of(error),
            location: self.location().clone(),
        })
    }

    /// The largest position that anything of a volume has: all records up to it were read.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn last_position(&self, volume: &str) -> Result<Option<u64>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT max(position) AS position FROM \
                        (SELECT position FROM tiles WHERE volume = $1 \
                         UNION ALL SELECT transform_position FROM tiles WHERE volume = $1 \
                         UNION ALL SELECT position FROM early_transforms WHERE volume = $1 \
                         UNION ALL SELECT position FROM waiting WHERE volume = $1) positions";
        let largest = |row: &Row| row.get::<Option<i64>>("position");
        let found = self.ask(question, &[id.into()], largest).await?;
        let largest = found.into_iter().flatten().next();
        Ok(largest.and_then(|position| u64::try_from(position).ok()))
    }

    /// Whether the record at a position is in the queue, or waits.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn is_to_be_done(&self, volume: &str, position: u64) -> Result<bool, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT position FROM waiting WHERE volume = $1 AND position = $2";
        let there = |row: &Row| row.get::<i64>("position");
        let values = [id.into(), position.into()];
        let found = self.ask(question, &values, there);
        Ok(!found.await?.is_empty())
    }

    /// The records whose file is not whole yet, by position; without what cannot be understood.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn waiting(&self, volume: &str) -> Result<Vec<Waiting>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT position, record, reason FROM waiting \
                        WHERE volume = $1 AND parked = 1 ORDER BY position";
        let waiting = |row: &Row| Ok(rows::waiting(row).ok());
        let waiting = self.ask(question, &[id.into()], waiting).await?;
        Ok(waiting.into_iter().flatten().collect())
    }

    /// What is in the queue, or waits, and cannot be understood: positions, names of tiles, and what is wrong.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn spoilt_waiting(
        &self,
        volume: &str,
    ) -> Result<Vec<(i64, String, String)>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT position, tile, record, reason FROM waiting \
                        WHERE volume = $1 AND position > $2 ORDER BY position LIMIT 4096";
        let spoilt = |row: &Row| {
            let wrong = rows::waiting(row).err().map(rows::reason_of);
            Ok((
                row.get::<i64>("position")?,
                rows::legible(row, "tile"),
                wrong,
            ))
        };
        let (mut found, mut after) = (Vec::new(), i64::MIN);
        loop {
            let some = self
                .ask(question, &[id.into(), after.into()], spoilt)
                .await?;
            let Some((last, ..)) = some.last() else {
                return Ok(found);
            };
            after = *last;
            let spoilt =
                { some.into_iter() }.filter_map(|(at, tile, wrong)| Some((at, tile, wrong?)));
            found.extend(spoilt);
        }
    }

    /// Pyramids that no tile has named since `before`, at most `max`.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn retired(
        &self,
        volume: &str,
        before: SystemTime,
        max: u32,
    ) -> Result<Vec<Retired>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question =
            "SELECT pyramid, at FROM retired WHERE volume = $1 AND at < $2 ORDER BY at LIMIT $3";
        let values = [id.into(), rows::millis(before).into(), max.into()];
        self.ask(question, &values, rows::retired).await
    }
}
