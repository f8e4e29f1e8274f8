//! The catalog: which volumes and tiles there are, where they lie, and what changed.
//!
//! One SQLite file (write-ahead log, `synchronous=FULL`), or a PostgreSQL database
//! (`synchronous_commit=on`): when a commit returns, it survives a power cut. Several processes may
//! have it open, with PostgreSQL on several machines; commits to one volume take turns.
//!
//! # Revisions
//!
//! Each volume has a revision, from 0. Each change of voxels makes it one larger and is logged with
//! the box of level-0 voxels it touches. A tile that moves far makes two changes, its old and its
//! new place, in one transaction. [`Catalog::subscribe`] tells of new revisions, also of those that
//! other processes commit; [`Catalog::changes_after`] tells what they were. The newest are kept, see
//! [`CHANGES_KEPT`]; who was away for longer is told that anything may have changed.
//!
//! # Order
//!
//! What a tile is follows from its records' positions, not from when they were worked on: the image
//! comes from the tile record with the largest position, the transform from the tile or transform
//! record with the largest. A transform that comes before the tile's first record is kept and
//! applied to it. A deletion ends what came before it: a tile record with a larger position brings
//! the tile back, as if it were new.
//!
//! # Workers
//!
//! Records whose image is still to be worked on wait in the catalog. Any number of workers claim them,
//! each record by one of them, and tell from time to time that they live. What a dead one had claimed
//! is free again when its lease is over. See [`Catalog::claim`].

mod anew;
mod commit;
mod database;
mod entries;
mod error;
mod history;
mod holders;
mod identity;
mod location;
mod lost_volumes;
mod mover;
mod origins;
mod postgres;
mod remembered;
mod revision;
mod room;
mod rows;
mod soundness;
mod spoilt;
mod sqlite;
mod tiles;
mod watcher;
mod workers;

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

use saccade_core::transform::SectionFromTile;
use saccade_core::volume::{Volume, check_name};
use tokio::sync::watch;

use crate::clock::{Clock, SystemClock};
use database::{Database, Durability, Row, Statement, Transaction, Value};

pub use commit::{Commit, DeleteOutcome, TileOutcome, TransformOutcome};
pub(crate) use entries::differences;
pub use entries::{
    CatalogChange, ChangeReason, NewTile, Quarantined, Retired, Statistics, Tile, TileId,
    VolumeEntry, Waiting, place,
};
pub use error::CatalogError;
pub use history::{History, LastChange};
pub use location::CatalogLocation;
pub use lost_volumes::LostVolume;
pub use mover::Mover;
pub use origins::{Ahead, Holder, NamedRow, Naming, Origin, Placing};
pub use revision::WrongRevision;
pub use spoilt::{Listed, SpoiltTile};
pub use workers::{Claim, HeldUp, Worker};

/// Most changes that [`Catalog::changes_after`] returns at once.
pub const CHANGES_AT_ONCE: usize = 4096;

/// Changes that are kept of each volume, at least: the newest.
pub const CHANGES_KEPT: u64 = 1 << 16;

/// The tables that a catalog has.
const TABLES: [&str; 12] = [
    "volumes",
    "tiles",
    "early_transforms",
    "quarantine",
    "cursors",
    "waiting",
    "retired",
    "sections",
    "changes",
    "workers",
    "archive",
    "held_up",
];

/// An open catalog. Clones share it.
#[derive(Clone, Debug)]
pub struct Catalog {
    inner: Arc<Inner>,
}

#[derive(Debug)]
struct Inner {
    location: CatalogLocation,
    database: Database,
    watcher: watcher::Watcher,
    clock: OnceLock<Arc<dyn Clock>>,
    changes_kept: AtomicU64,
    owner: identity::Owner,
}

impl Inner {
    /// Why nothing can be read, if the file was taken away.
    fn away(&self) -> Option<CatalogError> {
        if self.owner.is_another() {
            let location = self.location.clone();
            return Some(CatalogError::Another { location });
        }
        match &self.database {
            Database::Sqlite(opened) => opened.away().map(|away| CatalogError::Away {
                why: away.why,
                location: self.location.clone(),
            }),
            Database::Postgres(_) => None,
        }
    }

    /// The same before anybody has noticed.
    fn away_now(&self) -> Option<CatalogError> {
        match &self.database {
            Database::Sqlite(opened) if opened.is_away() => Some(CatalogError::Away {
                why: None,
                location: self.location.clone(),
            }),
            Database::Sqlite(_) | Database::Postgres(_) => None,
        }
    }
}

impl Catalog {
    /// Opens a catalog that exists.
    ///
    /// A file that may not be written, for its permissions or on a read-only file system, is opened
    /// for reading: commits are then refused with [`CatalogError::ReadOnly`]. Changes are followed
    /// only if somebody is writing when it is opened; else it is taken for finished.
    ///
    /// # Errors
    ///
    /// [`CatalogError::NotFound`], [`CatalogError::NotACatalog`], [`CatalogError::NewerSchema`],
    /// [`CatalogError::OlderSchema`], [`CatalogError::NetworkFilesystem`], [`CatalogError::Address`],
    /// [`CatalogError::Unreachable`], [`CatalogError::NotDurable`], or what the database says.
    pub async fn open(location: impl Into<CatalogLocation>) -> Result<Self, CatalogError> {
        let location = location.into();
        match &location {
            CatalogLocation::File(path) if !path.is_file() => {
                Err(CatalogError::NotFound { location })
            }
            _ => Self::connect(location, false).await,
        }
    }

    /// Opens a catalog, and makes it first if there is none: a file, or the tables in an empty
    /// database that the server has.
    ///
    /// # Errors
    ///
    /// As [`Self::open`].
    pub async fn create(location: impl Into<CatalogLocation>) -> Result<Self, CatalogError> {
        Self::connect(location.into(), true).await
    }

    async fn connect(location: CatalogLocation, create: bool) -> Result<Self, CatalogError> {
        let database = match &location {
            CatalogLocation::File(path) => Database::Sqlite(sqlite::open(path).await?),
            CatalogLocation::Postgres(url) => {
                Database::Postgres(postgres::open(url, create).await?)
            }
        };
        Ok(Self::of(location, database))
    }

    fn of(location: CatalogLocation, database: Database) -> Self {
        let inner = Inner {
            location,
            database,
            watcher: watcher::Watcher::default(),
            clock: OnceLock::new(),
            changes_kept: AtomicU64::new(CHANGES_KEPT),
            owner: identity::Owner::default(),
        };
        Self {
            inner: Arc::new(inner),
        }
    }

    /// Where it is.
    pub fn location(&self) -> &CatalogLocation {
        &self.inner.location
    }

    /// Measures time by this clock instead of the machine's and leases, with a server, the server's. Has
    /// an effect once.
    #[must_use]
    pub fn with_clock(self, clock: Arc<dyn Clock>) -> Self {
        drop(self.inner.clock.set(clock));
        self
    }

    /// The clock by which times are noted; those who work with the catalog wait and measure by it, too.
    pub fn clock(&self) -> &dyn Clock {
        match self.inner.clock.get() {
            Some(clock) => &**clock,
            None => &SystemClock,
        }
    }

    /// Keeps at least so many changes of each volume, instead of [`CHANGES_KEPT`].
    #[must_use]
    pub fn with_changes_kept(self, count: u64) -> Self {
        self.inner.changes_kept.store(count, Ordering::Relaxed);
        self
    }

    /// Enters a volume. It is fine if it is there already and is the same: in size, voxels and
    /// channels.
    ///
    /// # Errors
    ///
    /// [`CatalogError::VolumeName`], [`CatalogError::WrongVolume`], or what the database says.
    pub async fn create_volume(&self, volume: &Volume) -> Result<(), CatalogError> {
        check_name(&volume.name)?;
        let there = match self.volume(&volume.name).await {
            Err(CatalogError::UnknownVolume { .. }) => {
                let description = serde_json::to_string(volume).expect("a volume becomes JSON");
                self.insert_volume(&volume.name, &description).await?;
                self.volume(&volume.name).await?
            }
            there => there?,
        };
        match differences(&there, volume).into_iter().next() {
            None => Ok(()),
            Some((what, existing, asked)) => Err(CatalogError::WrongVolume {
                name: volume.name.clone(),
                what,
                existing,
                asked,
            }),
        }
    }

    /// A volume.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn volume(&self, name: &str) -> Result<Volume, CatalogError> {
        Ok(self.entry(name).await?.volume)
    }

    /// A volume and how far it is.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], [`CatalogError::SpoiltVolume`], or what the database says.
    pub async fn entry(&self, name: &str) -> Result<VolumeEntry, CatalogError> {
        let question = "SELECT name, description, revision, tiles FROM volumes WHERE name = $1";
        let described = |row: &Row| Ok(self.described(name, row));
        let found = self.ask(question, &[name.into()], described).await?;
        match found.into_iter().next() {
            Some(entry) => entry,
            None => Err(self.unknown_volume(name).await),
        }
    }

    /// All volumes, by name, also those of which nothing else can be understood.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn volumes(&self) -> Result<Vec<Listed>, CatalogError> {
        let question = "SELECT name, description, revision, tiles FROM volumes ORDER BY name";
        let listed = |row: &Row| {
            let name = rows::legible(row, "name");
            let entry = self.described(&name, row);
            Ok(Listed { name, entry })
        };
        self.ask(question, &[], listed).await
    }

    /// A volume's newest revision; 0 while it is empty.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn revision(&self, volume: &str) -> Result<u64, CatalogError> {
        Ok(self.entry(volume).await?.revision)
    }

    /// The changes after a revision, oldest first, without gaps, at most [`CHANGES_AT_ONCE`]: ask
    /// again from the last one's revision until there are none.
    ///
    /// # Errors
    ///
    /// [`CatalogError::Missed`] where some of them are no longer kept: anything may have changed.
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn changes_after(
        &self,
        volume: &str,
        revision: u64,
    ) -> Result<Vec<CatalogChange>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT revision, tile, section, x0, y0, x1, y1, reason FROM changes \
                        WHERE volume = $1 AND revision > $2 ORDER BY revision LIMIT $3";
        let values = [id.into(), revision.into(), (CHANGES_AT_ONCE as u64).into()];
        let changes = self.ask(question, &values, rows::change).await?;
        match changes.first() {
            // Each change has a revision of its own, so that a gap shows.
            Some(oldest) if oldest.revision > revision + 1 => Err(CatalogError::Missed {
                name: volume.to_owned(),
                after: revision,
                kept_after: oldest.revision - 1,
                revision: self.revision(volume).await?,
            }),
            _ => Ok(changes),
        }
    }

    /// Follows a volume's revision: the receiver wakes after each commit of this process, and within
    /// a fifth of a second after those of others. A server that is away is waited for.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn subscribe(&self, volume: &str) -> Result<watch::Receiver<u64>, CatalogError> {
        // The receiver exists before the revision is read, so that no commit falls in between.
        let receiver = self.inner.watcher.subscribe(&self.inner, volume);
        let revision = self.revision(volume).await?;
        self.inner.watcher.announce(volume, revision);
        Ok(receiver)
    }

    /// Looks from now on whether the file is still the one of its name, see [`Self::times_replaced`].
    ///
    /// # Panics
    ///
    /// Outside of a Tokio runtime.
    pub fn follow(&self) {
        self.inner.watcher.follow(&self.inner);
    }

    /// How often another file has taken the place of the one that was open, or the right catalog that of another archive's,
    /// see [`Self::belongs_to`]. From then on that is read, whose revisions count
    /// anew, and anything may be another; to another file nothing can be written any more. Looked for several times a second from
    /// [`Self::follow`] or the first [`Self::subscribe`] on, whose receivers wake then.
    pub fn times_replaced(&self) -> u64 {
        let back = self.inner.owner.times_back();
        match &self.inner.database {
            Database::Sqlite(opened) => opened.times_replaced() + back,
            Database::Postgres(_) => back,
        }
    }

    /// Begins a transaction on a volume. Nothing is changed until [`Commit::finish`].
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], [`CatalogError::ReadOnly`], or what the database says.
    pub async fn begin(&self, volume: &str) -> Result<Commit<'_>, CatalogError> {
        Commit::begin(self, volume).await
    }

    /// Enters one tile in a transaction of its own. See [`Commit::tile`].
    ///
    /// # Errors
    ///
    /// As [`Commit::tile`].
    pub async fn commit_tile(
        &self,
        volume: &str,
        tile: &NewTile,
    ) -> Result<TileOutcome, CatalogError> {
        let mut commit = self.begin(volume).await?;
        let outcome = commit.tile(tile, self.clock().now()).await?;
        commit.finish().await?;
        Ok(outcome)
    }

    /// Moves one tile in a transaction of its own. See [`Commit::transform`].
    ///
    /// # Errors
    ///
    /// As [`Commit::transform`].
    pub async fn set_transform(
        &self,
        volume: &str,
        tile: &str,
        transform: SectionFromTile,
    ) -> Result<TransformOutcome, CatalogError> {
        let mut commit = self.begin(volume).await?;
        let outcome = commit.transform(tile, transform, None).await?;
        commit.finish().await?;
        Ok(outcome)
    }

    /// Deletes one tile in a transaction of its own. See [`Commit::delete`].
    ///
    /// # Errors
    ///
    /// As [`Commit::delete`].
    pub async fn delete_tile(
        &self,
        volume: &str,
        tile: &str,
        position: u64,
    ) -> Result<DeleteOutcome, CatalogError> {
        let mut commit = self.begin(volume).await?;
        let outcome = commit.delete(tile, position, self.clock().now()).await?;
        commit.finish().await?;
        Ok(outcome)
    }

    /// Notes a file that could not become a tile.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn quarantine(&self, volume: &str, what: &Quarantined) -> Result<(), CatalogError> {
        let mut commit = self.begin(volume).await?;
        commit.quarantine(what).await?;
        commit.finish().await?;
        Ok(())
    }

    /// Ends all connections. Without it they end when the last clone is dropped, in their own time.
    pub async fn close(&self) {
        self.inner.database.close().await;
    }

    /// Asks, and understands each row of the answer.
    async fn ask<T>(
        &self,
        question: impl Into<Statement>,
        values: &[Value<'_>],
        understand: impl Fn(&Row) -> Result<T, sqlx::Error>,
    ) -> Result<Vec<T>, CatalogError> {
        if let Some(away) = self.inner.away() {
            return Err(away);
        }
        let rows = self.inner.database.all(question, values).await;
        let rows = rows.and_then(|rows| rows.iter().map(understand).collect());
        rows.map_err(|e| {
            let away = self.inner.away().or_else(|| self.inner.away_now());
            away.unwrap_or_else(|| self.failed(e))
        })
    }

    async fn transaction(&self, durability: Durability) -> Result<Transaction, CatalogError> {
        if let Database::Sqlite(opened) = &self.inner.database
            && let Some(reason) = opened.stopped()
        {
            return Err(CatalogError::NotSynced {
                reason: reason.to_owned(),
                location: self.location().clone(),
            });
        }
        self.look_for_file()?;
        self.refuse_copied_over().await?;
        let begun = Transaction::begin(&self.inner.database, durability).await;
        let begun = begun.map_err(|e| self.failed(e))?;
        let mut transaction = begun.ok_or_else(|| CatalogError::ReadOnly {
            location: self.location().clone(),
        })?;
        self.refuse_another(&mut transaction).await?;
        Ok(transaction)
    }

    /// Whether the open file is still the one of its name: SQLite goes on with one that was moved or deleted, and what it
    /// acknowledges is lost with it.
    fn look_for_file(&self) -> Result<(), CatalogError> {
        match &self.inner.database {
            Database::Sqlite(opened) if opened.is_elsewhere() || opened.times_replaced() > 0 => {
                Err(CatalogError::Moved {
                    location: self.location().clone(),
                })
            }
            Database::Sqlite(_) | Database::Postgres(_) => Ok(()),
        }
    }

    async fn volume_id(&self, name: &str) -> Result<i64, CatalogError> {
        let question = "SELECT id FROM volumes WHERE name = $1";
        let found = self
            .ask(question, &[name.into()], |row| row.get("id"))
            .await?;
        match found.into_iter().next() {
            Some(id) => Ok(id),
            None => Err(self.unknown_volume(name).await),
        }
    }

    async fn unknown_volume(&self, name: &str) -> CatalogError {
        if let Err(another) = self.verify().await {
            return another;
        }
        let question = "SELECT name FROM volumes ORDER BY name";
        let legible = |row: &Row| Ok(rows::legible(row, "name"));
        match self.ask(question, &[], legible).await {
            Ok(known) => CatalogError::UnknownVolume {
                name: name.to_owned(),
                known,
            },
            Err(e) => e,
        }
    }

    fn failed(&self, source: sqlx::Error) -> CatalogError {
        let error = CatalogError::sort(source, &self.inner.location);
        if let (CatalogError::NotSynced { reason, .. }, Database::Sqlite(opened)) =
            (&error, &self.inner.database)
        {
            opened.stop(reason);
        }
        error
    }
}
