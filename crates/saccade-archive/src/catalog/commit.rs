//! One transaction: everything in it happens, or nothing.

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
    new_tiles: i64,
}

/// What a commit needs to know of a tile that is there.
struct Existing {
    id: TileId,
    section: u32,
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
            new_tiles: 0,
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
        let early = if existing.is_none() {
            self.early(tile).await?
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
        let id = match &existing {
            Some(existing) => existing.id,
            None => self.insert_name(tile).await?,
        };
        let old = existing.as_ref().and_then(|e| e.place);
        self.log_change(id, old, Some(place), ChangeReason::Tile)
            .await?;
        let query = "UPDATE tiles SET section = ?, width = ?, height = ?, \
                     a = ?, b = ?, c = ?, d = ?, tx = ?, ty = ?, \
                     pyramid = ?, revision = ?, position = ?, transform_position = ? WHERE id = ?";
        let mut query = sqlx::query(query)
            .bind(tile.section)
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
        let query = sqlx::query("DELETE FROM quarantine WHERE volume = ? AND tile = ?");
        let query = query.bind(self.volume).bind(&tile.name);
        query
            .execute(&mut *self.transaction)
            .await
            .map_err(|e| self.catalog.failed(e))?;
        let Some(existing) = existing else {
            return Ok(TileOutcome::New);
        };
        if existing.pyramid != tile.pyramid {
            let query = "INSERT OR REPLACE INTO retired (pyramid, volume, at) VALUES (?, ?, ?)";
            let query = sqlx::query(query).bind(existing.pyramid).bind(self.volume);
            let query = query.bind(rows::millis(now));
            query
                .execute(&mut *self.transaction)
                .await
                .map_err(|e| self.catalog.failed(e))?;
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
        let Some(existing) = self.existing(tile).await? else {
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
        let changed = self.revision != self.before;
        if changed {
            let query = "UPDATE volumes SET revision = ?, tiles = tiles + ? WHERE id = ?";
            let query = sqlx::query(query)
                .bind(rows::signed(self.revision))
                .bind(self.new_tiles)
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
        let query = "SELECT id, section, width, height, a, b, c, d, tx, ty, pyramid, position, \
                     transform_position FROM tiles WHERE volume = ? AND name = ?";
        let query = sqlx::query(query).bind(self.volume).bind(name);
        let row = query.fetch_optional(&mut *self.transaction).await;
        let Some(row) = row.map_err(|e| self.catalog.failed(e))? else {
            return Ok(None);
        };
        let extent = self.extent;
        let decode = || {
            let (section, size, transform) = (
                rows::section(&row)?,
                rows::size(&row)?,
                rows::transform(&row)?,
            );
            Ok(Existing {
                id: TileId(row.try_get("id")?),
                section,
                place: place(extent, section, size, transform),
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
    async fn insert_name(&mut self, tile: &NewTile) -> Result<TileId, CatalogError> {
        let query = "INSERT INTO tiles (volume, name, section, width, height, a, b, c, d, tx, ty, \
                     pyramid, revision, position, transform_position) \
                     VALUES (?, ?, 0, 0, 0, 1, 0, 0, 1, 0, 0, '', 0, 0, 0)";
        let query = sqlx::query(query).bind(self.volume).bind(&tile.name);
        let done = query.execute(&mut *self.transaction).await;
        self.new_tiles += 1;
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

    /// Takes out the transform that came before a tile's first image, if it still counts.
    async fn early(
        &mut self,
        tile: &NewTile,
    ) -> Result<Option<(SectionFromTile, u64)>, CatalogError> {
        let query = "DELETE FROM early_transforms WHERE volume = ?1 AND tile = ?2 \
                     RETURNING a, b, c, d, tx, ty, position, EXISTS (SELECT 1 FROM waiting \
                       WHERE waiting.volume = ?1 AND waiting.tile = ?2 \
                         AND waiting.position < ?3) AS older_waits";
        let query = sqlx::query(query).bind(self.volume).bind(&tile.name);
        let query = query.bind(rows::signed(tile.position));
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
