//! Workers share the records of a volume: claims, leases, signs of life.

use std::time::{Duration, SystemTime};

use super::database::{Database, Durability, Row, Statement, Transaction};
use super::{Catalog, CatalogError, Waiting, rows};
use crate::acquisition::RecordReader;

/// One that claims records, as the catalog knows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Worker {
    pub(super) id: i64,
    name: String,
    process: String,
    lease: Duration,
}

impl Worker {
    /// What people call it.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// How long its claims last after its last sign of life.
    pub fn lease(&self) -> Duration {
        self.lease
    }
}

/// A record that is one worker's for now.
#[derive(Clone, Debug, PartialEq)]
pub struct Claim {
    /// The record.
    pub waiting: Waiting,
    /// Workers that ended while they worked on it, since it was last known not to harm who does. What only
    /// waited in a dead worker's claim did not end it.
    pub deaths: u32,
    /// Whether its file was not whole when it was looked at last.
    pub parked: bool,
}

/// What holds up a worker.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HeldUp {
    /// What people call the worker.
    pub worker: String,
    /// What it waits for, in words.
    pub why: String,
    /// Since when.
    pub since: SystemTime,
}

/// Number of the lock under which records of volume 0 are claimed; other programs use others.
const CLAIMING: i64 = 0x5361_6363_0000_0000;

impl Catalog {
    /// A new worker. It has to give a sign of life, by [`Self::claim`] or [`Self::keep_alive`], before
    /// `lease` is over, else what it claimed is free again.
    ///
    /// # Errors
    ///
    /// [`CatalogError::ReadOnly`], or what the database says.
    pub async fn register(&self, name: &str, lease: Duration) -> Result<Worker, CatalogError> {
        self.register_process(name, "", lease).await
    }

    /// The same of a worker whose `process` can be told from all others, on this machine and elsewhere, so that
    /// who finds it dead can say so: see [`Self::processes`].
    ///
    /// # Errors
    ///
    /// [`CatalogError::ReadOnly`], or what the database says.
    pub async fn register_process(
        &self,
        name: &str,
        process: &str,
        lease: Duration,
    ) -> Result<Worker, CatalogError> {
        let mut transaction = self.transaction(Durability::Soon).await?;
        let now = self.now(&mut transaction).await?;
        // Those that have been gone for a day are forgotten.
        let day = Duration::from_secs(24 * 3600);
        let ago = rows::millis(now.checked_sub(day).unwrap_or(SystemTime::UNIX_EPOCH));
        let forget = "DELETE FROM workers WHERE lease < $1";
        let forgotten = transaction.run(forget, &[ago.into()]).await;
        forgotten.map_err(|e| self.failed(e))?;
        let forget = "DELETE FROM held_up WHERE NOT EXISTS \
                      (SELECT 1 FROM workers k WHERE k.id = held_up.worker)";
        let forgotten = transaction.run(forget, &[]).await;
        forgotten.map_err(|e| self.failed(e))?;
        let insert = "INSERT INTO workers (name, process, lease) VALUES ($1, $2, $3) RETURNING id";
        let until = rows::millis(now + lease);
        let values = [name.into(), process.into(), until.into()];
        let row = transaction.one(insert, &values).await;
        let id = row.and_then(|row| row.ok_or(sqlx::Error::RowNotFound)?.get("id"));
        let id = id.map_err(|e| self.failed(e))?;
        transaction.commit().await.map_err(|e| self.failed(e))?;
        Ok(Worker {
            id,
            name: name.to_owned(),
            process: process.to_owned(),
            lease,
        })
    }

    /// The processes of workers whose leases are not over, as far as they are known.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn processes(&self) -> Result<Vec<String>, CatalogError> {
        let mut transaction = self.transaction(Durability::Soon).await?;
        let now = rows::millis(self.now(&mut transaction).await?);
        let question = "SELECT DISTINCT process FROM workers WHERE process <> '' AND lease >= $1";
        let rows = transaction.all(question, &[now.into()]).await;
        let processes = rows.and_then(|rows| rows.iter().map(|row| row.get("process")).collect());
        processes.map_err(|e| self.failed(e))
    }

    /// Ends the leases of a process's workers: it is dead, and what it has claimed is free. Who only looked
    /// dead finds its claims with others.
    ///
    /// # Errors
    ///
    /// [`CatalogError::ReadOnly`], or what the database says.
    pub async fn bury(&self, process: &str) -> Result<(), CatalogError> {
        let mut transaction = self.transaction(Durability::Soon).await?;
        let bury = "UPDATE workers SET lease = 0 WHERE process = $1";
        let buried = transaction.run(bury, &[process.into()]).await;
        buried.map_err(|e| self.failed(e))?;
        transaction.commit().await.map_err(|e| self.failed(e))
    }

    /// Notes that a worker begins to work on a record that it has claimed: should it end meanwhile, that
    /// counts as one of [`Claim::deaths`].
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], [`CatalogError::ReadOnly`], or what the database says.
    pub async fn begin_record(
        &self,
        volume: &str,
        worker: &Worker,
        position: u64,
    ) -> Result<(), CatalogError> {
        let volume = self.volume_id(volume).await?;
        let mut transaction = self.transaction(Durability::Soon).await?;
        let begin = "UPDATE waiting SET begun = 1 \
                     WHERE volume = $1 AND position = $2 AND worker = $3";
        let values = [volume.into(), position.into(), worker.id.into()];
        let begun = transaction.run(begin, &values).await;
        begun.map_err(|e| self.failed(e))?;
        transaction.commit().await.map_err(|e| self.failed(e))
    }

    /// A sign of life.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn keep_alive(&self, worker: &Worker) -> Result<(), CatalogError> {
        let mut transaction = self.transaction(Durability::Soon).await?;
        self.renew(&mut transaction, worker).await?;
        transaction.commit().await.map_err(|e| self.failed(e))
    }

    /// Claims the first records of a volume that nobody has, at most `max`, by position: no other
    /// worker gets them until this one is done with them or its lease is over. Also a sign of life.
    ///
    /// A record is left alone while an older one of the same tile is being worked on, so that what
    /// becomes of a tile does not depend on who is faster.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], [`CatalogError::ReadOnly`], or what the database says.
    pub async fn claim(
        &self,
        volume: &str,
        worker: &Worker,
        max: u32,
    ) -> Result<Vec<Claim>, CatalogError> {
        let volume = self.volume_id(volume).await?;
        let mut transaction = self.transaction(Durability::Soon).await?;
        // One at a time, and each with a view of what those before it did. Without that, a record that another
        // claims during the statement is looked at again beside workers as they were when it began:
        // one that registered since counts as dead.
        let take_turns = Statement {
            sqlite: "SELECT $1",
            postgres: "SELECT pg_advisory_xact_lock($1)",
        };
        let turn = [(CLAIMING + volume).into()];
        let taken = transaction.run(take_turns, &turn).await;
        taken.map_err(|e| self.failed(e))?;
        let now = self.renew(&mut transaction, worker).await?;
        let claim = Statement {
            sqlite: "WITH free AS MATERIALIZED ( \
                       SELECT w.position FROM waiting w WHERE w.volume = $1 \
                         AND NOT EXISTS (SELECT 1 FROM workers k WHERE k.id = w.worker AND k.lease >= $3) \
                         AND NOT EXISTS (SELECT 1 FROM waiting o WHERE o.volume = w.volume \
                           AND o.tile = w.tile AND o.position < w.position AND o.parked = 0) \
                       ORDER BY w.position LIMIT $4) \
                     UPDATE waiting SET worker = $2, \
                       attempts = attempts + begun, begun = 0 \
                     WHERE volume = $1 AND position IN (SELECT position FROM free) \
                     RETURNING position, tile, record, reason, attempts, parked",
            // A record that is being given back or done right now is passed over rather than waited for.
            postgres: "WITH free AS MATERIALIZED ( \
                         SELECT w.position FROM waiting w WHERE w.volume = $1 \
                           AND NOT EXISTS (SELECT 1 FROM workers k WHERE k.id = w.worker AND k.lease >= $3) \
                           AND NOT EXISTS (SELECT 1 FROM waiting o WHERE o.volume = w.volume \
                             AND o.tile = w.tile AND o.position < w.position AND o.parked = 0) \
                         ORDER BY w.position LIMIT $4 FOR UPDATE OF w SKIP LOCKED) \
                       UPDATE waiting SET worker = $2, \
                       attempts = attempts + begun, begun = 0 \
                       WHERE volume = $1 AND position IN (SELECT position FROM free) \
                       RETURNING position, tile, record, reason, attempts, parked",
        };
        let values = [
            volume.into(),
            worker.id.into(),
            rows::millis(now).into(),
            max.into(),
        ];
        let claimed = transaction.all(claim, &values).await;
        let mut claims = Vec::new();
        for row in claimed.map_err(|e| self.failed(e))? {
            match rows::claim(&row) {
                Ok(claim) => claims.push(claim),
                Err(error) => {
                    let now = self.clock().now();
                    let done = set_aside(&mut transaction, volume, &row, error, now).await;
                    done.map_err(|e| self.failed(e))?;
                }
            }
        }
        transaction.commit().await.map_err(|e| self.failed(e))?;
        claims.sort_by_key(|claim: &Claim| claim.waiting.position);
        Ok(claims)
    }

    /// Gives back all that the worker has claimed, as if it had never been claimed.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn release(&self, worker: &Worker) -> Result<(), CatalogError> {
        let mut transaction = self.transaction(Durability::Soon).await?;
        for release in [
            "UPDATE waiting SET worker = NULL, begun = 0 WHERE worker = $1",
            "DELETE FROM held_up WHERE worker = $1",
            "DELETE FROM workers WHERE id = $1",
        ] {
            let done = transaction.run(release, &[worker.id.into()]).await;
            done.map_err(|e| self.failed(e))?;
        }
        transaction.commit().await.map_err(|e| self.failed(e))
    }

    /// Notes what holds up a worker on a volume, each with since when, in place of what was noted before.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], [`CatalogError::ReadOnly`], or what the database says.
    pub async fn tell_held_up(
        &self,
        volume: &str,
        worker: &Worker,
        reasons: &[(String, SystemTime)],
    ) -> Result<(), CatalogError> {
        let volume = self.volume_id(volume).await?;
        let mut transaction = self.transaction(Durability::Soon).await?;
        let forget = "DELETE FROM held_up WHERE volume = $1 AND worker = $2";
        let forgotten = transaction
            .run(forget, &[volume.into(), worker.id.into()])
            .await;
        forgotten.map_err(|e| self.failed(e))?;
        for (number, (why, since)) in (0_u32..).zip(reasons) {
            let note = "INSERT INTO held_up (volume, worker, number, why, since) \
                        VALUES ($1, $2, $3, $4, $5)";
            let values = [
                volume.into(),
                worker.id.into(),
                number.into(),
                why.into(),
                rows::millis(*since).into(),
            ];
            let noted = transaction.run(note, &values).await;
            noted.map_err(|e| self.failed(e))?;
        }
        transaction.commit().await.map_err(|e| self.failed(e))
    }

    /// What holds up the workers of a volume, the longest first. Those that have given no sign of life are not
    /// waiting: they are dead.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn held_up(&self, volume: &str) -> Result<Vec<HeldUp>, CatalogError> {
        let volume = self.volume_id(volume).await?;
        let question = Statement {
            sqlite: "SELECT k.name, h.why, h.since FROM held_up h JOIN workers k ON k.id = h.worker \
                     WHERE h.volume = $1 AND k.lease >= $2 ORDER BY h.since, h.worker, h.number",
            // Leases are measured by the server's clock, unless there is another.
            postgres: "SELECT k.name, h.why, h.since FROM held_up h JOIN workers k ON k.id = h.worker \
                       WHERE h.volume = $1 AND k.lease >= CASE WHEN $2 < 0 \
                       THEN (extract(epoch FROM clock_timestamp()) * 1000)::bigint ELSE $2 END \
                       ORDER BY h.since, h.worker, h.number",
        };
        let now = match (self.inner.clock.get(), &self.inner.database) {
            (None, Database::Postgres(_)) => -1,
            (_, _) => rows::millis(self.clock().now()),
        };
        self.ask(question, &[volume.into(), now.into()], rows::held_up)
            .await
    }

    /// Records of a volume that are to be worked on, claimed or not, and those whose file is not
    /// whole.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn queued(&self, volume: &str) -> Result<(u64, u64), CatalogError> {
        let volume = self.volume_id(volume).await?;
        let question = "SELECT parked, count(*) AS records FROM waiting WHERE volume = $1 \
                        GROUP BY parked";
        let understand = |row: &Row| {
            let parked: i64 = row.get("parked")?;
            Ok((parked != 0, rows::unsigned(row, "records")?))
        };
        let counts = self.ask(question, &[volume.into()], understand).await?;
        let of = |parked| counts.iter().find(|c| c.0 == parked).map_or(0, |c| c.1);
        Ok((of(false), of(true)))
    }

    async fn renew(
        &self,
        transaction: &mut Transaction,
        worker: &Worker,
    ) -> Result<SystemTime, CatalogError> {
        let now = self.now(transaction).await?;
        let renew = "INSERT INTO workers (id, name, process, lease) VALUES ($1, $2, $3, $4) \
                     ON CONFLICT (id) DO UPDATE SET lease = excluded.lease";
        let until = rows::millis(now + worker.lease).into();
        let (name, process) = (&worker.name, &worker.process);
        let values = [worker.id.into(), name.into(), process.into(), until];
        let renewed = transaction.run(renew, &values).await;
        renewed.map_err(|e| self.failed(e))?;
        Ok(now)
    }

    /// Where several machines share a catalog, their clocks differ: the server's counts.
    async fn now(&self, transaction: &mut Transaction) -> Result<SystemTime, CatalogError> {
        match (self.inner.clock.get(), &self.inner.database) {
            (Some(_), _) | (_, Database::Sqlite(_)) => Ok(self.clock().now()),
            (None, Database::Postgres(_)) => {
                let ask = "SELECT (extract(epoch FROM clock_timestamp()) * 1000)::bigint AS now";
                let row = transaction.one(ask, &[]).await;
                let now =
                    row.and_then(|row| rows::time(&row.ok_or(sqlx::Error::RowNotFound)?, "now"));
                now.map_err(|e| self.failed(e))
            }
        }
    }
}

/// Puts into quarantine what is in the queue and cannot be understood: nobody could work on it.
async fn set_aside(
    transaction: &mut Transaction,
    volume: i64,
    row: &Row,
    error: sqlx::Error,
    now: SystemTime,
) -> Result<(), sqlx::Error> {
    let (tile, reason) = (rows::legible(row, "tile"), rows::reason_of(error));
    let reason = format!(
        "what the catalog keeps of its record cannot be understood ({reason}); append the record once more"
    );
    let insert = "INSERT INTO quarantine (volume, file, tile, reason, bytes, at) \
                  VALUES ($1, $2, $3, $4, 0, $5)";
    let values = [
        volume.into(),
        RecordReader::FILE.into(),
        (&tile).into(),
        (&reason).into(),
        rows::millis(now).into(),
    ];
    transaction.run(insert, &values).await?;
    let position = row.get::<i64>("position")?;
    let forget = "DELETE FROM waiting WHERE volume = $1 AND position = $2";
    transaction
        .run(forget, &[volume.into(), position.into()])
        .await?;
    Ok(())
}
