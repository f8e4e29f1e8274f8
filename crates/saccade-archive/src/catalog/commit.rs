//! One transaction: everything in it happens, or nothing.

use std::collections::BTreeMap;
use std::time::SystemTime;

use glam::UVec3;
use saccade_core::transform::SectionFromTile;
use saccade_core::voxel_box::VoxelBox;
use sqlx::{Row, Sqlite, Transaction};

use super::{
    Catalog, CatalogError, ChangeReason, NewTile, Quarantined, TileId, Waiting, place, rows,
};
use crate::acquisition::Cursor;

/// What became of a tile.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TileOutcome {
    /// The volume has it now.
    New,
    /// It took the place of an older one of its name, whose pyramid is retired.
    Replaced,
    /// The volume has a newer one of its name: nothing changed.
    Superseded,
}

/// What became of a transform.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TransformOutcome {
    /// The tile moved.
    Moved,
    /// The tile lies there already, or a newer record said otherwise: nothing changed.
    Unchanged,
    /// There is no such tile yet; the transform waits for it.
    Kept,
}

/// What became of a deletion.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DeleteOutcome {
    /// The volume has the tile no more, and its pyramid is retired.
    Deleted,
    /// There is a newer tile of that name, or it is deleted already: nothing changed.
    Unchanged,
    /// There is no such tile. Should one come whose record lies before, it stays out.
    Noted,
}

/// A transaction on one volume. Dropped without [`finish`](Self::finish), it changes nothing.
///
/// While it lives, other writers wait: keep it short.
#[derive(Debug)]
pub struct Commit<'c> {
    catalog: &'c Catalog,
    transaction: Transaction<'static, Sqlite>,
    volume: i64,
    name: String,
    extent: UVec3,
    before: u64,
    revision: u64,
    /// Tiles that sections gain and lose.
    sections: BTreeMap<u32, i64>,
}

/// What a commit needs to know of a tile that is there.
struct Existing {
    id: TileId,
    deleted: bool,
    section: u32,
    /// `None` if it is outside, or deleted.
    place: Option<VoxelBox>,
    transform: SectionFromTile,
    size: glam::UVec2,
    pyramid: String,
    position: u64,
    transform_position: u64,
}

impl<'c> Commit<'c> {
    pub(super) async fn begin(catalog: &'c Catalog, volume: &str) -> Result<Self, CatalogError> {
        // IMMEDIATE: a transaction that begins by reading could not always go on to write.
        let begun = catalog.writer()?.begin_with("BEGIN IMMEDIATE").await;
        let mut transaction = begun.map_err(|e| catalog.failed(e))?;
        let query = "SELECT id, description, revision, tiles FROM volumes WHERE name = ?";
        let row = sqlx::query(query)
            .bind(volume)
            .fetch_optional(&mut *transaction)
            .await;
        let Some(row) = row.map_err(|e| catalog.failed(e))? else {
            return Err(catalog.unknown_volume(volume).await);
        };
        let entry = rows::volume_entry(&row).map_err(|e| catalog.failed(e))?;
        Ok(Self {
            catalog,
            transaction,
            volume: row.try_get("id").map_err(|e| catalog.failed(e))?,
            name: volume.to_owned(),
            extent: entry.volume.extent(),
            before: entry.revision,
            revision: entry.revision,
            sections: BTreeMap::new(),
        })
    }

    /// Enters a tile, in place of an older one of its name. A record of the same tile in quarantine
    /// is forgotten. The older one's pyramid, if it has another name, is retired as of `now`.
    ///
    /// # Errors
    ///
    /// [`CatalogError::OutsideVolume`] if no voxel is under it; what SQLite says.
    pub async fn tile(
        &mut self,
        tile: &NewTile,
        now: SystemTime,
    ) -> Result<TileOutcome, CatalogError> {
        let existing = self.existing(&tile.name).await?;
        if existing
            .as_ref()
            .is_some_and(|e| e.position > tile.position)
        {
            return Ok(TileOutcome::Superseded);
        }
        let (known, deleted) = match existing {
            Some(ref e) if e.deleted => (Some(e.id), Some(e.position)),
            Some(ref e) => (Some(e.id), None),
            None => (None, None),
        };
        let existing = existing.filter(|e| !e.deleted);
        let early = if existing.is_none() {
            self.early(tile, deleted).await?
        } else {
            None
        };
        // The newest record says where the tile lies.
        let (transform, transform_position) = match (&existing, early) {
            (Some(e), _) if e.transform_position > tile.position => {
                (e.transform, e.transform_position)
            }
            (None, Some((transform, position))) => (transform, position.max(tile.position)),
            _ => (tile.transform, tile.position),
        };
        let place = self.place(&tile.name, tile.section, tile.size, transform)?;
        let id = match known {
            Some(id) => id,
            None => self.insert_name(&tile.name).await?,
        };
        if let Some(existing) = &existing {
            *self.sections.entry(existing.section).or_default() -= 1;
        }
        *self.sections.entry(tile.section).or_default() += 1;
        let old = existing.as_ref().and_then(|e| e.place);
        self.log_change(id, old, Some(place), ChangeReason::Tile)
            .await?;
        let query = "UPDATE tiles SET deleted = 0, section = ?, channel = ?, \
                     width = ?, height = ?, a = ?, b = ?, c = ?, d = ?, tx = ?, ty = ?, \
                     pyramid = ?, revision = ?, position = ?, transform_position = ? WHERE id = ?";
        let mut query = sqlx::query(query)
            .bind(tile.section)
            .bind(tile.channel)
            .bind(tile.size.x)
            .bind(tile.size.y);
        for element in transform.elements() {
            query = query.bind(element);
        }
        let query = query
            .bind(&tile.pyramid)
            .bind(rows::signed(self.revision))
            .bind(rows::signed(tile.position))
            .bind(rows::signed(transform_position))
            .bind(id.0);
        query
            .execute(&mut *self.transaction)
            .await
            .map_err(|e| self.catalog.failed(e))?;
        self.end_quarantine(&tile.name).await?;
        let Some(existing) = existing else {
            return Ok(TileOutcome::New);
        };
        if existing.pyramid != tile.pyramid {
            self.retire(&existing.pyramid, now).await?;
        }
        Ok(TileOutcome::Replaced)
    }

    /// Moves a tile, or keeps the transform until the tile comes.
    ///
    /// `position` is that of the record that says so; `None` for anyone else, whose word counts
    /// until a newer image of the tile comes.
    ///
    /// # Errors
    ///
    /// [`CatalogError::OutsideVolume`] if no voxel would be under the tile, which then stays where
    /// it is; what SQLite says.
    pub async fn transform(
        &mut self,
        tile: &str,
        transform: SectionFromTile,
        position: Option<u64>,
    ) -> Result<TransformOutcome, CatalogError> {
        let existing = self.existing(tile).await?;
        let older = |e: &Existing| position.is_some_and(|p| p < e.position);
        if existing.as_ref().is_some_and(|e| e.deleted && older(e)) {
            return Ok(TransformOutcome::Unchanged);
        }
        let Some(existing) = existing.filter(|e| !e.deleted) else {
            self.keep_early(tile, transform, position.unwrap_or(0))
                .await?;
            return Ok(TransformOutcome::Kept);
        };
        let position = position.unwrap_or(existing.transform_position);
        if existing.transform_position > position {
            return Ok(TransformOutcome::Unchanged);
        }
        let place = self.place(tile, existing.section, existing.size, transform)?;
        let moved = existing.transform != transform;
        if moved {
            let reason = ChangeReason::Transform;
            self.log_change(existing.id, existing.place, Some(place), reason)
                .await?;
            let query = "UPDATE tiles SET a = ?, b = ?, c = ?, d = ?, tx = ?, ty = ?, revision = ? \
                         WHERE id = ?";
            let mut query = sqlx::query(query);
            for element in transform.elements() {
                query = query.bind(element);
            }
            let query = query.bind(rows::signed(self.revision)).bind(existing.id.0);
            query
                .execute(&mut *self.transaction)
                .await
                .map_err(|e| self.catalog.failed(e))?;
        }
        let query = sqlx::query("UPDATE tiles SET transform_position = ? WHERE id = ?");
        let query = query.bind(rows::signed(position)).bind(existing.id.0);
        query
            .execute(&mut *self.transaction)
            .await
            .map_err(|e| self.catalog.failed(e))?;
        Ok(if moved {
            TransformOutcome::Moved
        } else {
            TransformOutcome::Unchanged
        })
    }

    /// Deletes a tile, and what waits or is in quarantine under its name. Its pyramid is retired as of
    /// `now`. A tile record that comes later but lies before `position` brings nothing back.
    ///
    /// # Errors
    ///
    /// What SQLite says.
    pub async fn delete(
        &mut self,
        tile: &str,
        position: u64,
        now: SystemTime,
    ) -> Result<DeleteOutcome, CatalogError> {
        let existing = self.existing(tile).await?;
        if existing.as_ref().is_some_and(|e| e.position > position) {
            return Ok(DeleteOutcome::Unchanged);
        }
        let query = "DELETE FROM early_transforms WHERE volume = ? AND tile = ? AND position <= ?";
        let query = sqlx::query(query).bind(self.volume).bind(tile);
        query
            .bind(rows::signed(position))
            .execute(&mut *self.transaction)
            .await
            .map_err(|e| self.catalog.failed(e))?;
        self.end_quarantine(tile).await?;
        let (id, outcome) = match existing {
            None => (self.insert_name(tile).await?, DeleteOutcome::Noted),
            Some(e) if e.deleted => (e.id, DeleteOutcome::Unchanged),
            Some(e) => {
                self.log_change(e.id, e.place, None, ChangeReason::Deleted)
                    .await?;
                *self.sections.entry(e.section).or_default() -= 1;
                self.retire(&e.pyramid, now).await?;
                if e.transform_position > position {
                    self.keep_early(tile, e.transform, e.transform_position)
                        .await?;
                }
                (e.id, DeleteOutcome::Deleted)
            }
        };
        let query = "UPDATE tiles SET deleted = 1, pyramid = '', position = ?, revision = ? \
                     WHERE id = ?";
        let query = sqlx::query(query)
            .bind(rows::signed(position))
            .bind(rows::signed(self.revision))
            .bind(id.0);
        query
            .execute(&mut *self.transaction)
            .await
            .map_err(|e| self.catalog.failed(e))?;
        Ok(outcome)
    }

    async fn end_quarantine(&mut self, tile: &str) -> Result<(), CatalogError> {
        let query = sqlx::query("DELETE FROM quarantine WHERE volume = ? AND tile = ?");
        let query = query.bind(self.volume).bind(tile);
        query
            .execute(&mut *self.transaction)
            .await
            .map_err(|e| self.catalog.failed(e))?;
        Ok(())
    }

    async fn retire(&mut self, pyramid: &str, now: SystemTime) -> Result<(), CatalogError> {
        let query = "INSERT OR REPLACE INTO retired (pyramid, volume, at) VALUES (?, ?, ?)";
        let query = sqlx::query(query).bind(pyramid).bind(self.volume);
        let query = query.bind(rows::millis(now));
        query
            .execute(&mut *self.transaction)
            .await
            .map_err(|e| self.catalog.failed(e))?;
        Ok(())
    }

    /// Notes a file or record that could not become a tile.
    ///
    /// # Errors
    ///
    /// What SQLite says.
    pub async fn quarantine(&mut self, what: &Quarantined) -> Result<(), CatalogError> {
        let query = "INSERT INTO quarantine (volume, file, tile, reason, bytes, at) \
                     VALUES (?, ?, ?, ?, ?, ?)";
        let query = sqlx::query(query)
            .bind(self.volume)
            .bind(&what.file)
            .bind(&what.tile)
            .bind(&what.reason)
            .bind(what.bytes.map(rows::signed))
            .bind(rows::millis(what.at));
        query
            .execute(&mut *self.transaction)
            .await
            .map_err(|e| self.catalog.failed(e))?;
        Ok(())
    }

    /// Remembers how far the records were read.
    ///
    /// # Errors
    ///
    /// What SQLite says.
    pub async fn cursor(&mut self, cursor: Cursor) -> Result<(), CatalogError> {
        let query = "INSERT OR REPLACE INTO cursors (volume, byte, line) VALUES (?, ?, ?)";
        let query = sqlx::query(query)
            .bind(self.volume)
            .bind(rows::signed(cursor.offset))
            .bind(rows::signed(cursor.line));
        query
            .execute(&mut *self.transaction)
            .await
            .map_err(|e| self.catalog.failed(e))?;
        Ok(())
    }

    /// Remembers a record whose file is not whole yet.
    ///
    /// # Errors
    ///
    /// What SQLite says.
    pub async fn wait(&mut self, waiting: &Waiting) -> Result<(), CatalogError> {
        let record = serde_json::to_string(&waiting.record).expect("a record becomes JSON");
        let query = "INSERT OR REPLACE INTO waiting (volume, position, tile, record, reason) \
                     VALUES (?, ?, ?, ?, ?)";
        let query = sqlx::query(query)
            .bind(self.volume)
            .bind(rows::signed(waiting.position))
            .bind(&waiting.record.tile)
            .bind(record)
            .bind(&waiting.reason);
        query
            .execute(&mut *self.transaction)
            .await
            .map_err(|e| self.catalog.failed(e))?;
        Ok(())
    }

    /// Forgets a record that waited. It is no error if there is none.
    ///
    /// # Errors
    ///
    /// What SQLite says.
    pub async fn wait_no_more(&mut self, position: u64) -> Result<(), CatalogError> {
        let query = sqlx::query("DELETE FROM waiting WHERE volume = ? AND position = ?");
        let query = query.bind(self.volume).bind(rows::signed(position));
        query
            .execute(&mut *self.transaction)
            .await
            .map_err(|e| self.catalog.failed(e))?;
        Ok(())
    }

    /// Forgets a retired pyramid, once it is deleted.
    ///
    /// # Errors
    ///
    /// What SQLite says.
    pub async fn forget_retired(&mut self, pyramid: &str) -> Result<(), CatalogError> {
        let query = sqlx::query("DELETE FROM retired WHERE pyramid = ?").bind(pyramid);
        query
            .execute(&mut *self.transaction)
            .await
            .map_err(|e| self.catalog.failed(e))?;
        Ok(())
    }

    /// Makes it so: when this returns, it survives a power cut. Returns the volume's revision.
    ///
    /// # Errors
    ///
    /// What SQLite says; nothing has changed then.
    pub async fn finish(mut self) -> Result<u64, CatalogError> {
        self.count_sections().await?;
        let changed = self.revision != self.before;
        if changed {
            let query = "UPDATE volumes SET revision = ?, tiles = tiles + ? WHERE id = ?";
            let query = sqlx::query(query)
                .bind(rows::signed(self.revision))
                .bind(self.sections.values().sum::<i64>())
                .bind(self.volume);
            query
                .execute(&mut *self.transaction)
                .await
                .map_err(|e| self.catalog.failed(e))?;
        }
        self.transaction
            .commit()
            .await
            .map_err(|e| self.catalog.failed(e))?;
        if changed {
            self.catalog
                .inner
                .watcher
                .announce(&self.name, self.revision);
        }
        Ok(self.revision)
    }

    async fn count_sections(&mut self) -> Result<(), CatalogError> {
        for (section, more) in &self.sections {
            let query = match more.signum() {
                0 => continue,
                1 => {
                    "INSERT INTO sections (volume, section, tiles) VALUES (?1, ?2, ?3) \
                     ON CONFLICT (volume, section) DO UPDATE SET tiles = sections.tiles + ?3"
                }
                _ => "UPDATE sections SET tiles = tiles + ?3 WHERE volume = ?1 AND section = ?2",
            };
            let query = sqlx::query(query)
                .bind(self.volume)
                .bind(section)
                .bind(more);
            query
                .execute(&mut *self.transaction)
                .await
                .map_err(|e| self.catalog.failed(e))?;
        }
        if self.sections.values().any(|more| *more < 0) {
            let query = "DELETE FROM sections WHERE volume = ? AND tiles = 0";
            let query = sqlx::query(query).bind(self.volume);
            query
                .execute(&mut *self.transaction)
                .await
                .map_err(|e| self.catalog.failed(e))?;
        }
        Ok(())
    }

    fn place(
        &self,
        tile: &str,
        section: u32,
        size: glam::UVec2,
        transform: SectionFromTile,
    ) -> Result<VoxelBox, CatalogError> {
        place(self.extent, section, size, transform).ok_or_else(|| CatalogError::OutsideVolume {
            tile: tile.to_owned(),
            section,
            transform: transform.elements(),
            extent: self.extent,
        })
    }

    async fn existing(&mut self, name: &str) -> Result<Option<Existing>, CatalogError> {
        let query = "SELECT id, deleted, section, width, height, a, b, c, d, tx, ty, pyramid, position, \
                     transform_position FROM tiles WHERE volume = ? AND name = ?";
        let query = sqlx::query(query).bind(self.volume).bind(name);
        let row = query.fetch_optional(&mut *self.transaction).await;
        let Some(row) = row.map_err(|e| self.catalog.failed(e))? else {
            return Ok(None);
        };
        let extent = self.extent;
        let decode = || {
            let deleted: bool = row.try_get("deleted")?;
            let (section, size, transform) = (
                rows::section(&row)?,
                rows::size(&row)?,
                rows::transform(&row)?,
            );
            Ok(Existing {
                id: TileId(row.try_get("id")?),
                deleted,
                section,
                place: place(extent, section, size, transform).filter(|_| !deleted),
                transform,
                size,
                pyramid: row.try_get("pyramid")?,
                position: rows::unsigned(&row, "position")?,
                transform_position: rows::unsigned(&row, "transform_position")?,
            })
        };
        decode().map(Some).map_err(|e| self.catalog.failed(e))
    }

    /// A row for a new tile; the caller fills in the rest.
    async fn insert_name(&mut self, tile: &str) -> Result<TileId, CatalogError> {
        let query = "INSERT INTO tiles (volume, name, section, width, height, a, b, c, d, tx, ty, \
                     pyramid, revision, position, transform_position) \
                     VALUES (?, ?, 0, 0, 0, 1, 0, 0, 1, 0, 0, '', 0, 0, 0)";
        let query = sqlx::query(query).bind(self.volume).bind(tile);
        let done = query.execute(&mut *self.transaction).await;
        Ok(TileId(
            done.map_err(|e| self.catalog.failed(e))?
                .last_insert_rowid(),
        ))
    }

    /// Logs the places at which voxels changed, each with a revision of its own: two where the old
    /// and the new place are apart, so that nothing in between is drawn anew.
    async fn log_change(
        &mut self,
        tile: TileId,
        old: Option<VoxelBox>,
        new: Option<VoxelBox>,
        reason: ChangeReason,
    ) -> Result<(), CatalogError> {
        let places = match (old, new) {
            (Some(old), Some(new)) if old.intersects(new) => vec![old.union(new)],
            (old, new) => old.into_iter().chain(new).collect(),
        };
        for place in places {
            self.revision += 1;
            let query = "INSERT INTO changes (volume, revision, tile, section, x0, y0, x1, y1, reason) \
                         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)";
            let query = sqlx::query(query)
                .bind(self.volume)
                .bind(rows::signed(self.revision))
                .bind(tile.0)
                .bind(place.min.z)
                .bind(place.min.x)
                .bind(place.min.y)
                .bind(place.max.x)
                .bind(place.max.y)
                .bind(rows::reason(reason));
            query
                .execute(&mut *self.transaction)
                .await
                .map_err(|e| self.catalog.failed(e))?;
        }
        Ok(())
    }

    async fn keep_early(
        &mut self,
        tile: &str,
        transform: SectionFromTile,
        position: u64,
    ) -> Result<(), CatalogError> {
        let query = "INSERT INTO early_transforms (volume, tile, a, b, c, d, tx, ty, position) \
                     VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT (volume, tile) DO UPDATE SET \
                     a = excluded.a, b = excluded.b, c = excluded.c, d = excluded.d, \
                     tx = excluded.tx, ty = excluded.ty, position = excluded.position \
                     WHERE excluded.position >= position";
        let mut query = sqlx::query(query).bind(self.volume).bind(tile);
        for element in transform.elements() {
            query = query.bind(element);
        }
        let query = query.bind(rows::signed(position));
        query
            .execute(&mut *self.transaction)
            .await
            .map_err(|e| self.catalog.failed(e))?;
        Ok(())
    }

    /// Takes out the transform that came before a tile's first image, or the first since it was
    /// `deleted`, if it still counts.
    async fn early(
        &mut self,
        tile: &NewTile,
        deleted: Option<u64>,
    ) -> Result<Option<(SectionFromTile, u64)>, CatalogError> {
        let query = "DELETE FROM early_transforms WHERE volume = ?1 AND tile = ?2 \
                     RETURNING a, b, c, d, tx, ty, position, EXISTS (SELECT 1 FROM waiting \
                       WHERE waiting.volume = ?1 AND waiting.tile = ?2 \
                         AND waiting.position < ?3 AND waiting.position > ?4) AS older_waits";
        let query = sqlx::query(query).bind(self.volume).bind(&tile.name);
        let query = query
            .bind(rows::signed(tile.position))
            .bind(deleted.map_or(-1, rows::signed));
        let row = query.fetch_optional(&mut *self.transaction).await;
        let Some(row) = row.map_err(|e| self.catalog.failed(e))? else {
            return Ok(None);
        };
        let decode = || {
            let older_waits: bool = row.try_get("older_waits")?;
            Ok((
                rows::transform(&row)?,
                rows::unsigned(&row, "position")?,
                older_waits,
            ))
        };
        let (transform, position, older_waits) = decode().map_err(|e| self.catalog.failed(e))?;
        // It counts for the first image, which may still be waiting and then never comes.
        let counts = position > tile.position || !older_waits;
        let inside = place(self.extent, tile.section, tile.size, transform).is_some();
        Ok((counts && inside).then_some((transform, position)))
    }
}
