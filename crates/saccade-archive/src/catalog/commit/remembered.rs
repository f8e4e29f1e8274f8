//! What a transaction remembers beside tiles: the queue, what is set aside, what is to be deleted, what came too early.

use std::time::SystemTime;

use saccade_core::transform::SectionFromTile;

use super::Commit;
use crate::acquisition::{Cursor, RecordReader};
use crate::catalog::database::{Statement, Value};
use crate::catalog::{CatalogError, NewTile, Quarantined, Waiting, Worker, place, rows};

impl Commit<'_> {
    /// What the record at `position` says of a tile ends what was set aside of it, but for an image that is awaited and was
    /// announced later.
    pub(super) async fn end_quarantine(
        &mut self,
        tile: &str,
        position: u64,
    ) -> Result<(), CatalogError> {
        let end = "DELETE FROM quarantine WHERE volume = $1 AND tile = $2 \
                   AND (awaited IS NULL OR awaited <= $3)";
        let values = [self.volume.into(), tile.into(), position.into()];
        self.run(end, &values).await?;
        Ok(())
    }

    /// A record that says where a tile lies ends what was set aside of earlier ones that could not be followed: entries
    /// of the records themselves, without a size. Those of images, and of lines that are no records, stay.
    pub(super) async fn end_misplacement(&mut self, tile: &str) -> Result<(), CatalogError> {
        let end = "DELETE FROM quarantine WHERE volume = $1 AND tile = $2 AND file = $3 AND bytes IS NULL";
        let values = [self.volume.into(), tile.into(), RecordReader::FILE.into()];
        self.run(end, &values).await?;
        Ok(())
    }

    pub(super) async fn retire(
        &mut self,
        pyramid: &str,
        now: SystemTime,
    ) -> Result<(), CatalogError> {
        // One that another volume's tile may name, which nobody looks for when it is deleted.
        let of = pyramid
            .strip_prefix("tiles/")
            .and_then(|rest| rest.split_once('/'));
        if let Some((of, _)) = of
            && of != self.name
            && self
                .one("SELECT id FROM volumes WHERE name = $1", &[of.into()])
                .await?
                .is_some()
        {
            return Ok(());
        }
        let retire = "INSERT INTO retired (pyramid, volume, at) VALUES ($1, $2, $3) \
                      ON CONFLICT (pyramid) DO UPDATE SET volume = excluded.volume, at = excluded.at";
        let values = [pyramid.into(), self.volume.into(), rows::millis(now).into()];
        self.run(retire, &values).await?;
        Ok(())
    }

    /// Whether a later record than that at `position` says what a tile's image is, or that there is none.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn has_newer(&mut self, tile: &str, position: u64) -> Result<bool, CatalogError> {
        let existing = self.existing(tile).await?;
        Ok(existing.is_some_and(|existing| existing.position > position))
    }

    /// Notes a file or record that could not become a tile.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn quarantine(&mut self, what: &Quarantined) -> Result<(), CatalogError> {
        let insert = "INSERT INTO quarantine (volume, file, tile, reason, bytes, at, awaited) \
                      VALUES ($1, $2, $3, $4, $5, $6, $7)";
        let bytes = what.bytes.map(|b| i64::try_from(b).unwrap_or(i64::MAX));
        let values = [
            self.volume.into(),
            (&what.file).into(),
            Value::MaybeText(what.tile.as_deref()),
            (&what.reason).into(),
            Value::MaybeInteger(bytes),
            rows::millis(what.at).into(),
            Value::MaybeInteger(what.awaited.map(u64::cast_signed)),
        ];
        self.run(insert, &values).await?;
        Ok(())
    }

    /// Forgets what was noted of a file or record that could not become a tile.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn no_longer_set_aside(&mut self, what: &Quarantined) -> Result<(), CatalogError> {
        let forget =
            "DELETE FROM quarantine WHERE volume = $1 AND tile = $2 AND file = $3 AND reason = $4";
        let values = [
            self.volume.into(),
            Value::MaybeText(what.tile.as_deref()),
            (&what.file).into(),
            (&what.reason).into(),
        ];
        self.run(forget, &values).await?;
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

    /// Puts a record in the queue whose image came after it was set aside: it is so no more.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn take_up(&mut self, waiting: &Waiting) -> Result<(), CatalogError> {
        let end = "DELETE FROM quarantine WHERE volume = $1 AND tile = $2 AND awaited = $3";
        let values = [
            self.volume.into(),
            (&waiting.record.tile).into(),
            waiting.position.into(),
        ];
        self.run(end, &values).await?;
        self.enqueue(waiting).await
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

    pub(super) async fn keep_early(
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
    pub(super) async fn early(
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
