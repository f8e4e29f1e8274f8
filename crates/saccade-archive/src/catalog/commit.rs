//! One transaction: everything in it happens, or nothing.

mod rectified;
mod remembered;
mod undeleted;

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::time::SystemTime;

use glam::UVec3;
use saccade_core::transform::SectionFromTile;
use saccade_core::voxel_box::VoxelBox;

use super::database::{Durability, Row, Statement, Transaction, Value};
use super::tiles::RECOUNT;
use super::{Catalog, CatalogError, ChangeReason, Mover, NewTile, TileId, place, postgres, rows};

/// What became of a tile.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TileOutcome {
    /// The volume has it now.
    New,
    /// It took the place of an older one of its name, whose pyramid is retired.
    Replaced,
    /// So it did, of one that was in another section.
    Elsewhere {
        /// The section that it was in.
        from: u32,
    },
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
    /// Tiles that the volume gains.
    tiles: i64,
    /// Whether tiles left sections that cannot be, so that nobody knows where they were counted.
    uncounted: bool,
}

/// What a commit needs to know of a tile that is there. What the catalog says may be what cannot be: whatever comes next
/// for the tile mends that.
struct Existing {
    id: TileId,
    deleted: bool,
    section: Option<u32>,
    /// `None` if it is outside, deleted, or nowhere; all of its section if it cannot be told.
    place: Option<VoxelBox>,
    transform: Option<SectionFromTile>,
    size: Option<glam::UVec2>,
    pyramid: Option<String>,
    /// 0 where it cannot be: any record is newer.
    position: u64,
    transform_position: u64,
    /// Who put it where it lies, if that is known.
    moved: Option<Mover>,
}

impl Existing {
    /// Its section and size, without which it cannot be moved.
    fn shape(&self) -> Option<(u32, glam::UVec2)> {
        self.section.zip(self.size)
    }
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
            tiles: 0,
            uncounted: false,
        })
    }

    /// Enters a tile, in place of an older one of its name. A record of the same tile in quarantine
    /// is forgotten, unless it is newer and its image awaited. The older one's pyramid, if it has another name, is retired as of
    /// `now`.
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
        let early = if existing.as_ref().is_none_or(|e| e.shape().is_none()) {
            self.early(tile, deleted).await?
        } else {
            None
        };
        // The newest record says where the tile lies, if any of it is inside then; if this one is done once more, whoever
        // moved the tile since.
        let newer = { existing.as_ref() }.filter(|e| e.transform_position >= tile.position);
        let newer = newer.and_then(|e| Some((e.transform?, e.transform_position, e.moved)));
        let inside = |at: &_| place(self.extent, tile.section, tile.size, *at).is_some();
        let newer = newer.filter(|(at, ..)| inside(at));
        let early = early.map(|(at, position)| {
            // Whether it counts depends on what came before, of which records alone do not tell.
            let by = Mover::somebody(at);
            (at, position.max(tile.position), Some(by))
        });
        let newest = newer.into_iter().chain(early).max_by_key(|said| said.1);
        let (transform, transform_position, moved) =
            newest.unwrap_or((tile.transform, tile.position, Some(Mover::Records)));
        let place = self.place(&tile.name, tile.section, tile.size, transform)?;
        let id = match known {
            Some(id) => id,
            None => self.insert_name(&tile.name).await?,
        };
        if let Some(existing) = &existing {
            self.leaves(existing);
        }
        *self.sections.entry(tile.section).or_default() += 1;
        self.tiles += 1;
        let old = existing.as_ref().and_then(|e| e.place);
        self.log_change(id, old, Some(place), ChangeReason::Tile)
            .await?;
        let update = "UPDATE tiles SET deleted = 0, section = $2, channel = $3, width = $4, \
                      height = $5, pyramid = $6, revision = $7, position = $8, \
                      transform_position = $9, a = $10, b = $11, c = $12, d = $13, tx = $14, \
                      ty = $15, moved = $16 WHERE id = $1";
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
        values.push(Value::MaybeInteger(moved.map(Mover::number)));
        self.run(update, &values).await?;
        self.end_quarantine(&tile.name, tile.position).await?;
        self.forget_retired(&tile.pyramid).await?;
        let Some(existing) = existing else {
            return Ok(TileOutcome::New);
        };
        if let Some(pyramid) = existing.pyramid.filter(|p| *p != tile.pyramid) {
            self.retire(&pyramid, now).await?;
        }
        let from = existing.section.filter(|from| *from != tile.section);
        Ok(
            from.map_or(TileOutcome::Replaced, |from| TileOutcome::Elsewhere {
                from,
            }),
        )
    }

    /// A tile is no more where it was.
    fn leaves(&mut self, tile: &Existing) {
        self.tiles -= 1;
        match tile.section {
            Some(section) => *self.sections.entry(section).or_default() -= 1,
            None => self.uncounted = true,
        }
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
        let existing = existing.filter(|e| !e.deleted);
        let Some((existing, (section, size))) = existing.and_then(|e| e.shape().map(|s| (e, s)))
        else {
            self.keep_early(tile, transform, position.unwrap_or(0))
                .await?;
            return Ok(TransformOutcome::Kept);
        };
        // One that is read once more says nothing new, and somebody may have moved the tile since.
        if position.is_some_and(|position| existing.transform_position >= position) {
            return Ok(TransformOutcome::Unchanged);
        }
        let by = match position {
            Some(_) => Mover::Records,
            None => Mover::somebody(transform),
        };
        let position = position.unwrap_or(existing.transform_position);
        let place = self.place(tile, section, size, transform)?;
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
        let update = "UPDATE tiles SET transform_position = $2, moved = $3 WHERE id = $1";
        let values = [existing.id.0.into(), position.into(), by.number().into()];
        self.run(update, &values).await?;
        Ok(if moved {
            TransformOutcome::Moved
        } else {
            TransformOutcome::Unchanged
        })
    }

    /// Takes a pyramid that is another's from a tile, if it names that one still: until its record is done anew, it has one that is not
    /// there. Whether it did.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn detach(&mut self, tile: &str, pyramid: &str) -> Result<bool, CatalogError> {
        let existing = self.existing(tile).await?.filter(|e| !e.deleted);
        let Some(existing) = existing.filter(|e| e.pyramid.as_deref() == Some(pyramid)) else {
            return Ok(false);
        };
        let (id, place) = (existing.id, existing.place);
        self.log_change(id, place, place, ChangeReason::Tile)
            .await?;
        // No record's, for those end with a position; and no other tile's.
        let none = format!("{pyramid}-none{}", id.0);
        let update = "UPDATE tiles SET pyramid = $2, revision = $3 WHERE id = $1";
        let values = [id.0.into(), (&none).into(), self.revision.into()];
        self.run(update, &values).await?;
        Ok(true)
    }

    /// Ends a row whose tile has no name by which a record could speak of it.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn end_nameless(&mut self, id: TileId) -> Result<(), CatalogError> {
        let end = "UPDATE tiles SET deleted = 1, pyramid = '' WHERE volume = $1 AND id = $2";
        self.run(end, &[self.volume.into(), id.0.into()]).await?;
        self.uncounted = true;
        Ok(())
    }

    /// Deletes a tile, and what waits or is in quarantine under its name, unless it is newer. Its pyramid is retired as of
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
        self.end_quarantine(tile, position).await?;
        let (id, outcome) = match existing {
            None => (self.insert_name(tile).await?, DeleteOutcome::Noted),
            Some(e) if e.deleted => (e.id, DeleteOutcome::Unchanged),
            Some(e) => {
                self.log_change(e.id, e.place, None, ChangeReason::Deleted)
                    .await?;
                self.leaves(&e);
                if let Some(pyramid) = &e.pyramid {
                    self.retire(pyramid, now).await?;
                }
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

    /// Deletes a tile for somebody who knows nothing of records, of which those before `read` have been read: all that they said of
    /// it is over, but not a newer image that they announced and that is still to come.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn delete_seen(
        &mut self,
        tile: &str,
        read: u64,
        now: SystemTime,
    ) -> Result<DeleteOutcome, CatalogError> {
        let existing = self.existing(tile).await?;
        let taken_in = existing.map_or(0, |existing| existing.position);
        let in_queue = "SELECT position FROM waiting \
                        WHERE volume = $1 AND tile = $2 AND position > $3 ORDER BY position LIMIT 1";
        let awaited = "SELECT awaited AS position FROM quarantine \
                       WHERE volume = $1 AND tile = $2 AND awaited > $3 ORDER BY awaited LIMIT 1";
        let mut end = read;
        for question in [in_queue, awaited] {
            let values = [self.volume.into(), tile.into(), taken_in.into()];
            let newer = self.one(question, &values).await?;
            let newer = newer.map(|row| rows::unsigned(&row, "position"));
            let newer = newer.transpose().map_err(|e| self.catalog.failed(e))?;
            end = newer.map_or(end, |newer| newer.min(end));
        }
        self.delete(tile, end.saturating_sub(1), now).await
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
        if changed || self.tiles != 0 {
            let update = "UPDATE volumes SET revision = $2, tiles = tiles + $3 WHERE id = $1";
            let values = [self.volume.into(), self.revision.into(), self.tiles.into()];
            self.run(update, &values).await?;
        }
        if self.uncounted {
            for count in RECOUNT {
                self.run(count, &[self.volume.into()]).await?;
            }
        }
        if changed {
            self.forget_changes().await?;
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
                // Whatever was counted: somebody may have moved tiles from one section to another.
                let forget = "DELETE FROM sections WHERE volume = $1 AND section = $2 \
                              AND NOT EXISTS (SELECT 1 FROM tiles t WHERE t.volume = $1 \
                              AND t.section = $2 AND t.deleted = 0)";
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
                        position, transform_position, moved FROM tiles WHERE volume = $1 AND name = $2";
        let row = self
            .one(question, &[self.volume.into(), name.into()])
            .await?;
        let Some(row) = row else {
            return Ok(None);
        };
        let extent = self.extent;
        let decode = || {
            let deleted = row.get::<i64>("deleted")? != 0;
            let (section, size) = (rows::section(&row).ok(), rows::size(&row).ok());
            let transform = rows::transform(&row).ok();
            // Where nobody knows how much it is, its section could not be read, and can be from now on.
            let (size_or_all, at) = match size.zip(transform) {
                Some(known) => known,
                None => (extent.truncate(), SectionFromTile::IDENTITY),
            };
            let section_if_there = section.filter(|_| !deleted);
            let place = section_if_there.and_then(|z| place(extent, z, size_or_all, at));
            Ok(Existing {
                id: TileId(row.get("id")?),
                deleted,
                section,
                place,
                transform,
                size,
                pyramid: rows::pyramid(&row).ok(),
                position: rows::unsigned(&row, "position").unwrap_or(0),
                transform_position: rows::unsigned(&row, "transform_position").unwrap_or(0),
                moved: Mover::of(&row),
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
}
