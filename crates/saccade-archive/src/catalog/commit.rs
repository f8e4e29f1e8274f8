//! One transaction: everything in it happens, or nothing.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::time::SystemTime;

use glam::UVec3;
use saccade_core::transform::SectionFromTile;
use saccade_core::voxel_box::VoxelBox;

use super::database::{Durability, Row, Statement, Transaction, Value};
use super::{
    Catalog, CatalogError, ChangeReason, NewTile, Quarantined, TileId, Waiting, Worker, place,
    postgres, rows,
};
use crate::acquisition::{Cursor, RecordReader};

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
    transaction: Transaction,
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
    /// `None` if it is outside, deleted, or nowhere.
    place: Option<VoxelBox>,
    /// `None` if what the catalog says is none: the next record that says where it lies mends that.
    transform: Option<SectionFromTile>,
    size: glam::UVec2,
    pyramid: String,
    position: u64,
    transform_position: u64,
}

impl<'c> Commit<'c> {
    pub(super) async fn begin(catalog: &'c Catalog, volume: &str) -> Result<Self, CatalogError> {
        let mut transaction = catalog.transaction(Durability::Durable).await?;
        // Whoever comes later waits here, so that revisions follow one another.
        let question = Statement {
            sqlite: "SELECT id, name, description, revision, tiles FROM volumes WHERE name = $1",
            postgres: "SELECT id, name, description, revision, tiles FROM volumes WHERE name = $1 \
                       FOR NO KEY UPDATE",
        };
        let row = transaction.one(question, &[volume.into()]).await;
        let Some(row) = row.map_err(|e| catalog.failed(e))? else {
            drop(transaction);
            return Err(catalog.unknown_volume(volume).await);
        };
        let entry = catalog.described(volume, &row)?;
        Ok(Self {
            catalog,
            transaction,
            volume: row.get("id").map_err(|e| catalog.failed(e))?,
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
    /// [`CatalogError::OutsideVolume`] if no voxel is under it; what the database says.
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
        let newer = { existing.as_ref() }.filter(|e| e.transform_position > tile.position);
        let newer = newer.and_then(|e| Some((e.transform?, e.transform_position)));
        let (transform, transform_position) = match (newer, early) {
            (Some(newer), _) => newer,
            (None, Some((transform, position))) => (transform, position.max(tile.position)),
            (None, None) => (tile.transform, tile.position),
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
        let update = "UPDATE tiles SET deleted = 0, section = $2, channel = $3, width = $4, \
                      height = $5, pyramid = $6, revision = $7, position = $8, \
                      transform_position = $9, a = $10, b = $11, c = $12, d = $13, tx = $14, \
                      ty = $15 WHERE id = $1";
        let mut values = vec![
            id.0.into(),
            tile.section.into(),
            tile.channel.into(),
            tile.size.x.into(),
            tile.size.y.into(),
            (&tile.pyramid).into(),
            self.revision.into(),
            tile.position.into(),
            transform_position.into(),
        ];
        values.extend(transform.elements().map(Value::from));
        self.run(update, &values).await?;
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
    /// until a newer image of the tile comes. What was set aside of transforms that lead out of the volume is forgotten.
    ///
    /// # Errors
    ///
    /// [`CatalogError::OutsideVolume`] if no voxel would be under the tile, which then stays where
    /// it is; what the database says.
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
        self.end_misplacement(tile).await?;
        let moved = existing.transform != Some(transform);
        if moved {
            let reason = ChangeReason::Transform;
            self.log_change(existing.id, existing.place, Some(place), reason)
                .await?;
            let update = "UPDATE tiles SET revision = $2, a = $3, b = $4, c = $5, d = $6, tx = $7, \
                          ty = $8 WHERE id = $1";
            let mut values = vec![existing.id.0.into(), self.revision.into()];
            values.extend(transform.elements().map(Value::from));
            self.run(update, &values).await?;
        }
        let update = "UPDATE tiles SET transform_position = $2 WHERE id = $1";
        self.run(update, &[existing.id.0.into(), position.into()])
            .await?;
        Ok(if moved {
            TransformOutcome::Moved
        } else {
            TransformOutcome::Unchanged
        })
    }

    /// Takes a pyramid that is another's from a tile: until its record is done anew, it has one that is not there.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn detach(&mut self, tile: &str) -> Result<(), CatalogError> {
        let Some(existing) = self.existing(tile).await?.filter(|e| !e.deleted) else {
            return Ok(());
        };
        let (id, place) = (existing.id, existing.place);
        self.log_change(id, place, place, ChangeReason::Tile)
            .await?;
        // No record's, for those end with a position; and no other tile's.
        let none = format!("{}-none{}", existing.pyramid, id.0);
        let update = "UPDATE tiles SET pyramid = $2, revision = $3 WHERE id = $1";
        let values = [id.0.into(), (&none).into(), self.revision.into()];
        self.run(update, &values).await?;
        Ok(())
    }

    /// Deletes a tile, and what waits or is in quarantine under its name. Its pyramid is retired as of
    /// `now`. A tile record that comes later but lies before `position` brings nothing back.
    ///
    /// # Errors
    ///
    /// What the database says.
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
        let ended = "DELETE FROM early_transforms \
                     WHERE volume = $1 AND tile = $2 AND position <= $3";
        let values = [self.volume.into(), tile.into(), position.into()];
        self.run(ended, &values).await?;
        self.end_quarantine(tile).await?;
        let (id, outcome) = match existing {
            None => (self.insert_name(tile).await?, DeleteOutcome::Noted),
            Some(e) if e.deleted => (e.id, DeleteOutcome::Unchanged),
            Some(e) => {
                self.log_change(e.id, e.place, None, ChangeReason::Deleted)
                    .await?;
                *self.sections.entry(e.section).or_default() -= 1;
                self.retire(&e.pyramid, now).await?;
                if let Some(transform) = e.transform
                    && e.transform_position > position
                {
                    self.keep_early(tile, transform, e.transform_position)
                        .await?;
                }
                (e.id, DeleteOutcome::Deleted)
            }
        };
        let update = "UPDATE tiles SET deleted = 1, pyramid = '', position = $2, revision = $3 \
                      WHERE id = $1";
        let values = [id.0.into(), position.into(), self.revision.into()];
        self.run(update, &values).await?;
        Ok(outcome)
    }

    async fn end_quarantine(&mut self, tile: &str) -> Result<(), CatalogError> {
        let end = "DELETE FROM quarantine WHERE volume = $1 AND tile = $2";
        self.run(end, &[self.volume.into(), tile.into()]).await?;
        Ok(())
    }

    /// A record that says where a tile lies ends what was set aside of earlier ones that could not be followed: entries
    /// of the records themselves, without a size. Those of images, and of lines that are no records, stay.
    async fn end_misplacement(&mut self, tile: &str) -> Result<(), CatalogError> {
        let end = "DELETE FROM quarantine WHERE volume = $1 AND tile = $2 AND file = $3 AND bytes IS NULL";
        let values = [self.volume.into(), tile.into(), RecordReader::FILE.into()];
        self.run(end, &values).await?;
        Ok(())
    }

    async fn retire(&mut self, pyramid: &str, now: SystemTime) -> Result<(), CatalogError> {
        let retire = "INSERT INTO retired (pyramid, volume, at) VALUES ($1, $2, $3) \
                      ON CONFLICT (pyramid) DO UPDATE SET volume = excluded.volume, at = excluded.at";
        let values = [pyramid.into(), self.volume.into(), rows::millis(now).into()];
        self.run(retire, &values).await?;
        Ok(())
    }

    /// Notes a file or record that could not become a tile.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn quarantine(&mut self, what: &Quarantined) -> Result<(), CatalogError> {
        let insert = "INSERT INTO quarantine (volume, file, tile, reason, bytes, at) \
                      VALUES ($1, $2, $3, $4, $5, $6)";
        let bytes = what.bytes.map(|b| i64::try_from(b).unwrap_or(i64::MAX));
        let values = [
            self.volume.into(),
            (&what.file).into(),
            Value::MaybeText(what.tile.as_deref()),
            (&what.reason).into(),
            Value::MaybeInteger(bytes),
            rows::millis(what.at).into(),
        ];
        self.run(insert, &values).await?;
        Ok(())
    }

    /// Remembers how far the records were read.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn cursor(&mut self, cursor: Cursor) -> Result<(), CatalogError> {
        let insert = "INSERT INTO cursors (volume, byte, line, seen) VALUES ($1, $2, $3, $4) \
                      ON CONFLICT (volume) DO UPDATE SET \
                      byte = excluded.byte, line = excluded.line, seen = excluded.seen";
        let values = [
            self.volume.into(),
            cursor.offset.into(),
            cursor.line.into(),
            Value::MaybeInteger(cursor.seen.map(u64::cast_signed)),
        ];
        self.run(insert, &values).await?;
        Ok(())
    }

    /// Remembers that the records from one cursor to another were read, unless another worker did
    /// so: then it is `false`, and nothing changed.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn advance(&mut self, from: Cursor, to: Cursor) -> Result<bool, CatalogError> {
        let question = "SELECT byte, line, seen FROM cursors WHERE volume = $1";
        let row = self.one(question, &[self.volume.into()]).await?;
        let now = row.as_ref().map(rows::cursor).transpose();
        let now = now.map_err(|e| self.catalog.failed(e))?;
        if now.unwrap_or_default() != from {
            return Ok(false);
        }
        self.cursor(to).await?;
        Ok(true)
    }

    /// Puts a record in the queue, for a worker to claim.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn enqueue(&mut self, waiting: &Waiting) -> Result<(), CatalogError> {
        self.keep(waiting, 0).await
    }

    /// Remembers a record whose file is not whole yet. Whoever has claimed it keeps it.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn wait(&mut self, waiting: &Waiting) -> Result<(), CatalogError> {
        self.keep(waiting, 1).await
    }

    async fn keep(&mut self, waiting: &Waiting, parked: u32) -> Result<(), CatalogError> {
        let record = serde_json::to_string(&waiting.record).expect("a record becomes JSON");
        let keep = "INSERT INTO waiting (volume, position, tile, record, reason, parked) \
                    VALUES ($1, $2, $3, $4, $5, $6) ON CONFLICT (volume, position) DO UPDATE SET \
                    tile = excluded.tile, record = excluded.record, reason = excluded.reason, \
                    parked = excluded.parked, attempts = 0, begun = 0";
        let values = [
            self.volume.into(),
            waiting.position.into(),
            (&waiting.record.tile).into(),
            (&record).into(),
            (&waiting.reason).into(),
            parked.into(),
        ];
        self.run(keep, &values).await?;
        Ok(())
    }

    /// Whether a record of that tile is still to be worked on; one whose file is not whole does not count.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn is_queued(&mut self, tile: &str) -> Result<bool, CatalogError> {
        let question = "SELECT position FROM waiting \
                        WHERE volume = $1 AND tile = $2 AND parked = 0 LIMIT 1";
        let values = [self.volume.into(), tile.into()];
        Ok(self.one(question, &values).await?.is_some())
    }

    /// Whether a claimed record is still the worker's: if its lease was over for a while, another may
    /// have it, or be done with it. What it became is then another's to say.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn holds(&mut self, worker: &Worker, position: u64) -> Result<bool, CatalogError> {
        let question = Statement {
            sqlite: "SELECT worker FROM waiting \
                     WHERE volume = $1 AND position = $2 AND worker = $3",
            // Until this transaction ends, nobody claims it.
            postgres: "SELECT worker FROM waiting \
                       WHERE volume = $1 AND position = $2 AND worker = $3 FOR UPDATE",
        };
        let values = [self.volume.into(), position.into(), worker.id.into()];
        Ok(self.one(question, &values).await?.is_some())
    }

    /// Forgets a record that waited. It is no error if there is none.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn wait_no_more(&mut self, position: u64) -> Result<(), CatalogError> {
        let forget = "DELETE FROM waiting WHERE volume = $1 AND position = $2";
        self.run(forget, &[self.volume.into(), position.into()])
            .await?;
        Ok(())
    }

    /// Forgets a retired pyramid, once it is deleted.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn forget_retired(&mut self, pyramid: &str) -> Result<(), CatalogError> {
        self.run("DELETE FROM retired WHERE pyramid = $1", &[pyramid.into()])
            .await?;
        Ok(())
    }

    /// Makes it so: when this returns, it survives a power cut. Returns the volume's revision.
    ///
    /// # Errors
    ///
    /// What the database says; nothing has changed then, except where a server was lost while it said
    /// so: then look. [`CatalogError::Moved`] where the file was taken away meanwhile.
    pub async fn finish(mut self) -> Result<u64, CatalogError> {
        self.count_sections().await?;
        let changed = self.revision != self.before;
        if changed {
            self.forget_changes().await?;
            let update = "UPDATE volumes SET revision = $2, tiles = tiles + $3 WHERE id = $1";
            let more: i64 = self.sections.values().sum();
            let values = [self.volume.into(), self.revision.into(), more.into()];
            self.run(update, &values).await?;
            if let Transaction::Postgres(_) = &self.transaction {
                let told = format!("{} {}", self.revision, self.name);
                let tell = "SELECT pg_notify($1, $2)";
                self.run(tell, &[postgres::CHANNEL.into(), (&told).into()])
                    .await?;
            }
        }
        let done = self.transaction.commit().await;
        done.map_err(|e| self.catalog.failed(e))?;
        // One that was taken away meanwhile has taken this with it.
        self.catalog.look_for_file()?;
        if changed {
            self.catalog
                .inner
                .watcher
                .announce(&self.name, self.revision);
        }
        Ok(self.revision)
    }

    /// Forgets old changes, some at a time.
    async fn forget_changes(&mut self) -> Result<(), CatalogError> {
        let kept = self.catalog.inner.changes_kept.load(Ordering::Relaxed);
        let step = (kept / 16).max(1);
        if self.before / step == self.revision / step || self.revision <= kept {
            return Ok(());
        }
        let forget = "DELETE FROM changes WHERE volume = $1 AND revision <= $2";
        let values = [self.volume.into(), (self.revision - kept).into()];
        self.run(forget, &values).await?;
        Ok(())
    }

    async fn count_sections(&mut self) -> Result<(), CatalogError> {
        let sections = std::mem::take(&mut self.sections);
        for (section, more) in &sections {
            let count = match more.signum() {
                0 => continue,
                1 => {
                    "INSERT INTO sections (volume, section, tiles) VALUES ($1, $2, $3) \
                     ON CONFLICT (volume, section) DO UPDATE SET tiles = sections.tiles + $3"
                }
                _ => "UPDATE sections SET tiles = tiles + $3 WHERE volume = $1 AND section = $2",
            };
            let values = [self.volume.into(), (*section).into(), (*more).into()];
            self.run(count, &values).await?;
            if *more < 0 {
                let forget = "DELETE FROM sections \
                              WHERE volume = $1 AND section = $2 AND tiles = 0";
                self.run(forget, &[self.volume.into(), (*section).into()])
                    .await?;
            }
        }
        self.sections = sections;
        Ok(())
    }

    async fn run(
        &mut self,
        statement: &'static str,
        values: &[Value<'_>],
    ) -> Result<u64, CatalogError> {
        let done = self.transaction.run(statement, values).await;
        done.map_err(|e| self.catalog.failed(e))
    }

    async fn one(
        &mut self,
        question: impl Into<Statement>,
        values: &[Value<'_>],
    ) -> Result<Option<Row>, CatalogError> {
        let row = self.transaction.one(question, values).await;
        row.map_err(|e| self.catalog.failed(e))
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
        let question = "SELECT id, deleted, section, width, height, a, b, c, d, tx, ty, pyramid, \
                        position, transform_position FROM tiles WHERE volume = $1 AND name = $2";
        let row = self
            .one(question, &[self.volume.into(), name.into()])
            .await?;
        let Some(row) = row else {
            return Ok(None);
        };
        let extent = self.extent;
        let decode = || {
            let deleted = row.get::<i64>("deleted")? != 0;
            let (section, size) = (rows::section(&row)?, rows::size(&row)?);
            let transform = rows::transform(&row).ok();
            let at = transform.filter(|_| !deleted);
            Ok(Existing {
                id: TileId(row.get("id")?),
                deleted,
                section,
                place: at.and_then(|at| place(extent, section, size, at)),
                transform,
                size,
                pyramid: row.get("pyramid")?,
                position: rows::unsigned(&row, "position")?,
                transform_position: rows::unsigned(&row, "transform_position")?,
            })
        };
        decode().map(Some).map_err(|e| self.catalog.failed(e))
    }

    /// A row for a new tile; the caller fills in the rest.
    async fn insert_name(&mut self, tile: &str) -> Result<TileId, CatalogError> {
        let insert = "INSERT INTO tiles (volume, name, section, width, height, a, b, c, d, tx, ty, \
                      pyramid, revision, position, transform_position) \
                      VALUES ($1, $2, 0, 0, 0, 1, 0, 0, 1, 0, 0, '', 0, 0, 0) RETURNING id";
        let row = self.one(insert, &[self.volume.into(), tile.into()]).await?;
        let id = row.ok_or(sqlx::Error::RowNotFound);
        let id = id.and_then(|row| row.get("id"));
        Ok(TileId(id.map_err(|e| self.catalog.failed(e))?))
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
            let log = "INSERT INTO changes (volume, revision, tile, section, x0, y0, x1, y1, reason) \
                       VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9)";
            let values = [
                self.volume.into(),
                self.revision.into(),
                tile.0.into(),
                place.min.z.into(),
                place.min.x.into(),
                place.min.y.into(),
                place.max.x.into(),
                place.max.y.into(),
                rows::reason(reason).into(),
            ];
            self.run(log, &values).await?;
        }
        Ok(())
    }

    async fn keep_early(
        &mut self,
        tile: &str,
        transform: SectionFromTile,
        position: u64,
    ) -> Result<(), CatalogError> {
        let keep = "INSERT INTO early_transforms \
                    (volume, tile, position, a, b, c, d, tx, ty) \
                    VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9) \
                    ON CONFLICT (volume, tile) DO UPDATE SET \
                    a = excluded.a, b = excluded.b, c = excluded.c, d = excluded.d, \
                    tx = excluded.tx, ty = excluded.ty, position = excluded.position \
                    WHERE excluded.position >= early_transforms.position";
        let mut values = vec![self.volume.into(), tile.into(), position.into()];
        values.extend(transform.elements().map(Value::from));
        self.run(keep, &values).await?;
        Ok(())
    }

    /// Takes out the transform that came before a tile's first image, or the first since it was
    /// `deleted`, if it still counts.
    async fn early(
        &mut self,
        tile: &NewTile,
        deleted: Option<u64>,
    ) -> Result<Option<(SectionFromTile, u64)>, CatalogError> {
        let take = "DELETE FROM early_transforms WHERE volume = $1 AND tile = $2 \
                    RETURNING a, b, c, d, tx, ty, position, \
                    (SELECT count(*) FROM waiting \
                       WHERE waiting.volume = $1 AND waiting.tile = $2 \
                         AND waiting.position < $3 AND waiting.position > $4) AS older_waiting";
        let deleted = deleted.map_or(-1, |p| i64::try_from(p).unwrap_or(i64::MAX));
        let values = [
            self.volume.into(),
            (&tile.name).into(),
            tile.position.into(),
            deleted.into(),
        ];
        let Some(row) = self.one(take, &values).await? else {
            return Ok(None);
        };
        let decode = || {
            Ok((
                rows::transform(&row)?,
                rows::unsigned(&row, "position")?,
                row.get::<i64>("older_waiting")? > 0,
            ))
        };
        let (transform, position, older_waits) = decode().map_err(|e| self.catalog.failed(e))?;
        // It counts for the first image, which may still be waiting and then never comes.
        let counts = position > tile.position || !older_waits;
        let inside = place(self.extent, tile.section, tile.size, transform).is_some();
        Ok((counts && inside).then_some((transform, position)))
    }
}
