//! What tells the archive of a catalog from every other.

use std::sync::OnceLock;
use std::sync::atomic::Ordering::{AcqRel, Acquire};
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::time::Duration;

use sqlx::{ConnectOptions as _, Connection as _};

use super::database::{Database, Durability, Row, Transaction};
use super::{Catalog, CatalogError, Inner, sqlite};

/// Asks whose a catalog is.
const WHOSE: &str = "SELECT identity FROM archive WHERE part = 1";

/// Whose the catalog must be, and whether what has its place is.
#[derive(Debug, Default)]
pub(super) struct Owner {
    /// The archive's identity, once it is known.
    identity: OnceLock<String>,
    another: AtomicBool,
    /// Times that the right one came back.
    times_back: AtomicU64,
}

impl Owner {
    /// Whether another archive's catalog was seen in its place, and not the right one since.
    pub(super) fn is_another(&self) -> bool {
        self.another.load(Acquire)
    }

    pub(super) fn times_back(&self) -> u64 {
        self.times_back.load(Acquire)
    }

    /// Whether an identity is the right one. One of an earlier version has none.
    fn is(&self, found: Option<&str>) -> bool {
        match (self.identity.get(), found) {
            (Some(right), Some(found)) => right == found,
            _ => true,
        }
    }
}

/// What is known of the file that has the open one's name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum File {
    /// It looks as it did when it was last known to be the right one, or nobody asks.
    Unchanged,
    /// It is the archive's.
    Right,
    /// It is another archive's.
    Another,
    /// It is the archive's, and lacks what was in it before.
    Older,
}

impl Inner {
    /// Looks whose the catalog is that is there now, and tells those who wait if that is news. Whether it is the right one.
    pub(super) async fn look_whose(&self) -> Result<bool, sqlx::Error> {
        if self.owner.identity.get().is_none() {
            return Ok(true);
        }
        let rows = self.database.all(WHOSE, &[]).await?;
        self.note_whose(&rows)
    }

    /// A file can be copied over the open one. Connections that are open do not notice.
    pub(super) async fn look_at_file(&self) -> Result<File, sqlx::Error> {
        let (Database::Sqlite(file), Some(_)) = (&self.database, self.owner.identity.get()) else {
            return Ok(File::Unchanged);
        };
        let Some(stamp) = file.new_stamp() else {
            return Ok(File::Unchanged);
        };
        let alone = file.alone(stamp).await;
        if let Some(alone) = &alone
            && file.is_older(alone)
            // What was read while the log was moved to the file may be half of this and half of that.
            && file.alone(stamp).await.as_ref() == Some(alone)
        {
            return Ok(File::Older);
        }
        let found = match &alone {
            Some(alone) if alone.identity.is_some() => alone.identity.clone(),
            _ => self.whose_afresh(file).await?,
        };
        if self.owner.is(found.as_deref()) {
            file.keep(stamp, alone);
            Ok(File::Right)
        } else {
            self.note_right(false);
            Ok(File::Another)
        }
    }

    /// By a new connection, which sees what those that are open do not.
    async fn whose_afresh(&self, file: &sqlite::Opened) -> Result<Option<String>, sqlx::Error> {
        let access = match file.reading() {
            sqlite::Access::Write => sqlite::Access::Read,
            reading => reading,
        };
        let options = sqlite::options(&file.path, access);
        let mut connection = options.connect().await?;
        let found = sqlx::query_scalar(WHOSE).fetch_optional(&mut connection);
        let found = found.await?;
        connection.close().await?;
        Ok(found)
    }

    /// By the answer to [`WHOSE`].
    fn note_whose(&self, rows: &[Row]) -> Result<bool, sqlx::Error> {
        let found = rows.first().map(|row| row.get::<String>("identity"));
        let right = self.owner.is(found.transpose()?.as_deref());
        self.note_right(right);
        Ok(right)
    }

    fn note_right(&self, right: bool) {
        if self.owner.another.swap(!right, AcqRel) != right {
            return;
        }
        if right {
            self.owner.times_back.fetch_add(1, AcqRel);
            log::warn!("the right catalog is there again: {}", self.location);
        } else {
            let location = self.location.clone();
            log::warn!("{}", CatalogError::Another { location });
        }
        self.watcher.begin_anew();
    }
}

/// Pyramids that are looked for, where it is to be found out whether they are there.
const SAMPLE: u32 = 16;

impl Catalog {
    /// The archive's identity, as far as the catalog has one. Those of earlier versions have none.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn identity(&self) -> Result<Option<String>, CatalogError> {
        let question = "SELECT identity FROM archive WHERE part = 1";
        let found = self.ask(question, &[], |row| row.get("identity")).await?;
        Ok(found.into_iter().next())
    }

    /// Gives the archive an identity, unless it has one; returns the one it has now. Of several processes
    /// that do this at once, all get the same answer.
    ///
    /// # Errors
    ///
    /// [`CatalogError::ReadOnly`], or what the database says.
    pub async fn give_identity(&self, identity: &str) -> Result<String, CatalogError> {
        let mut transaction = self.transaction(Durability::Durable).await?;
        let give =
            "INSERT INTO archive (part, identity) VALUES (1, $1) ON CONFLICT (part) DO NOTHING";
        let given = transaction.run(give, &[identity.into()]).await;
        given.map_err(|e| self.failed(e))?;
        transaction.commit().await.map_err(|e| self.failed(e))?;
        let now = self.identity().await?;
        Ok(now.unwrap_or_else(|| identity.to_owned()))
    }

    /// Says whose the catalog is. Should another archive's take its place while it is open, nothing of that is read or
    /// written: all fails with [`CatalogError::Another`] until the right one is back. Has an effect once.
    pub fn belongs_to(&self, identity: &str) {
        let _the_first_counts = self.inner.owner.identity.set(identity.to_owned());
    }

    /// Whose it is, if that was said.
    pub(crate) fn owner(&self) -> Option<&str> {
        self.inner.owner.identity.get().map(String::as_str)
    }

    /// Looks whether the catalog is still the archive's, see [`Self::belongs_to`].
    ///
    /// # Errors
    ///
    /// [`CatalogError::Another`], or what the database says.
    pub async fn verify(&self) -> Result<(), CatalogError> {
        let right = self.inner.look_whose().await;
        self.or_another(right)
    }

    /// The same within a transaction, which cannot lose its place any more.
    pub(super) async fn refuse_another(
        &self,
        transaction: &mut Transaction,
    ) -> Result<(), CatalogError> {
        if self.inner.owner.identity.get().is_none() {
            return Ok(());
        }
        let rows = transaction.all(WHOSE, &[]).await;
        self.or_another(rows.and_then(|rows| self.inner.note_whose(&rows)))
    }

    /// A file that was copied over the open one is refused.
    pub(super) async fn refuse_copied_over(&self) -> Result<(), CatalogError> {
        match self.inner.look_at_file().await {
            Ok(File::Older) => Err(CatalogError::Older {
                location: self.location().clone(),
            }),
            Ok(found) => self.or_another(Ok(found != File::Another)),
            // It may have gone just now.
            Err(e) => self.look_for_file().and(Err(self.failed(e))),
        }
    }

    /// What went wrong, once it was looked what the file is now: who reads one while another is copied over it, or right after,
    /// finds half of each, or nothing yet, and takes it for damaged, or for something else.
    pub async fn look_again(&self, error: CatalogError) -> CatalogError {
        /// Looks, and the pause after each: a copy may be under way.
        const LOOKS: u32 = 10;
        const PAUSE: Duration = Duration::from_millis(50);
        if !matches!(
            error,
            CatalogError::Damaged { .. }
                | CatalogError::NotACatalog { .. }
                | CatalogError::NoTable { .. }
        ) {
            return error;
        }
        for _ in 0..LOOKS {
            match self.refuse_copied_over().await {
                Err(copied @ (CatalogError::Older { .. } | CatalogError::Another { .. })) => {
                    return copied;
                }
                Ok(()) | Err(_) => self.clock().sleep(PAUSE).await,
            }
        }
        error
    }

    fn or_another(&self, right: Result<bool, sqlx::Error>) -> Result<(), CatalogError> {
        match right {
            Ok(true) => Ok(()),
            Ok(false) => Err(CatalogError::Another {
                location: self.location().clone(),
            }),
            Err(e) => Err(self.failed(e)),
        }
    }

    /// As an earlier version left it.
    #[cfg(test)]
    pub(crate) async fn forget_identity(&self) -> Result<(), CatalogError> {
        let mut transaction = self.transaction(Durability::Durable).await?;
        let forgotten = transaction.run("DELETE FROM archive", &[]).await;
        forgotten.map_err(|e| self.failed(e))?;
        transaction.commit().await.map_err(|e| self.failed(e))
    }

    /// Name of a pyramid of a volume; none while it has no tiles.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn pyramid_of(&self, volume: &str) -> Result<Option<String>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT pyramid FROM tiles WHERE volume = $1 AND deleted = 0 LIMIT 1";
        let values = [id.into()];
        let found = self.ask(question, &values, |row| row.get("pyramid"));
        Ok(found.await?.into_iter().next())
    }

    /// Names of some pyramids of any volume; none while there are no tiles.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn some_pyramids(&self) -> Result<Vec<String>, CatalogError> {
        let question = "SELECT pyramid FROM tiles WHERE deleted = 0 LIMIT $1";
        let sample = [SAMPLE.into()];
        self.ask(question, &sample, |row| row.get("pyramid")).await
    }
}
