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

mod clock;
mod commit;
mod database;
mod error;
mod holders;
mod identity;
mod location;
mod origins;
mod postgres;
mod rows;
mod spoilt;
mod sqlite;
mod watcher;
mod workers;

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::SystemTime;

use glam::{DVec3, UVec2, UVec3};
use saccade_core::transform::SectionFromTile;
use saccade_core::volume::{Volume, check_name};
use saccade_core::voxel_box::VoxelBox;
use serde::{Deserialize, Serialize};
use tokio::sync::watch;

use crate::acquisition::{Cursor, TileRecord};

use database::{Database, Durability, Row, Statement, Transaction, Value};

pub use clock::{Clock, SystemClock};
pub use commit::{Commit, DeleteOutcome, TileOutcome, TransformOutcome};
pub use error::CatalogError;
pub use location::CatalogLocation;
pub use origins::Origin;
pub use spoilt::{Listed, SpoiltTile};
pub use workers::{Claim, HeldUp, Worker};

/// Most changes that [`Catalog::changes_after`] returns at once.
pub const CHANGES_AT_ONCE: usize = 4096;

/// Changes that are kept of each volume, at least: the newest.
pub const CHANGES_KEPT: u64 = 1 << 16;

/// Names a tile within its catalog, for good.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(transparent)]
pub struct TileId(pub i64);

/// A tile whose pyramid is in the visualization archive.
#[derive(Clone, Debug, PartialEq)]
pub struct Tile {
    /// Its id; stays when it is imaged again.
    pub id: TileId,
    /// Its name, unique in the volume.
    pub name: String,
    /// Section: z index of the volume.
    pub section: u32,
    /// Channel: index in the volume's channels.
    pub channel: u32,
    /// Width and height \[pixels\].
    pub size: UVec2,
    /// Where it lies: to level-0 voxels from pixels.
    pub transform: SectionFromTile,
    /// Name of its pyramid in the storage. Another image gets another name.
    pub pyramid: String,
    /// The volume's revision when the tile last changed.
    pub revision: u64,
}

/// A tile to be entered.
#[derive(Clone, Debug, PartialEq)]
pub struct NewTile {
    /// Its name. If the volume has a tile of that name, the newer position wins.
    pub name: String,
    /// Section: z index of the volume.
    pub section: u32,
    /// Channel: index in the volume's channels.
    pub channel: u32,
    /// Width and height \[pixels\].
    pub size: UVec2,
    /// To level-0 voxels from pixels.
    pub transform: SectionFromTile,
    /// Name of its pyramid, already durable in the storage.
    pub pyramid: String,
    /// Position of its record: a larger one is newer, the same one is the same record.
    pub position: u64,
}

/// Why voxels changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ChangeReason {
    /// A tile arrived, or arrived again.
    Tile,
    /// A tile moved.
    Transform,
    /// A tile was deleted.
    Deleted,
}

/// Voxels that are no longer what they were.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CatalogChange {
    /// The volume's revision after it.
    pub revision: u64,
    /// The tile.
    pub tile: TileId,
    /// Its section.
    pub section: u32,
    /// Where, inside the volume \[level-0 voxels\].
    pub voxels: VoxelBox,
    /// Why.
    pub reason: ChangeReason,
}

/// A file or record that could not become a tile.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Quarantined {
    /// The file, relative to the acquisition archive.
    pub file: String,
    /// The tile it was to become, if known. A good record of that tile ends its quarantine.
    pub tile: Option<String>,
    /// What is wrong and how to mend it.
    pub reason: String,
    /// The file's size \[bytes\], if it exists.
    pub bytes: Option<u64>,
    /// When.
    pub at: SystemTime,
}

/// A record whose file is not whole yet.
#[derive(Clone, Debug, PartialEq)]
pub struct Waiting {
    /// Position of the record.
    pub position: u64,
    /// The record.
    pub record: TileRecord,
    /// What it waits for.
    pub reason: String,
}

/// A pyramid that no tile names any more.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Retired {
    /// Its name in the storage.
    pub pyramid: String,
    /// Since when.
    pub at: SystemTime,
}

/// A volume and how far it is.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeEntry {
    /// What it is.
    pub volume: Volume,
    /// Its newest revision; 0 while empty.
    pub revision: u64,
    /// Tiles it has.
    pub tiles: u64,
}

/// Counts of a volume.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Statistics {
    /// Newest revision.
    pub revision: u64,
    /// Tiles.
    pub tiles: u64,
    /// Sections that have a tile.
    pub sections: u64,
    /// Files in quarantine.
    pub quarantined: u64,
    /// Tiles whose file is not whole yet.
    pub waiting: u64,
    /// Tiles that were announced and are still to be worked on, or are being worked on.
    pub queued: u64,
    /// Transforms whose tile has not come yet.
    pub early: u64,
}

/// Where a tile lies in a volume of `extent` \[level-0 voxels\], cut at the volume's faces; `None`
/// if it is wholly outside.
pub fn place(
    extent: UVec3,
    section: u32,
    size: UVec2,
    transform: SectionFromTile,
) -> Option<VoxelBox> {
    let (min, max) = transform.bounds(size.as_dvec2());
    let z = f64::from(section);
    let tile = VoxelBox::around(
        DVec3::new(min.0.x, min.0.y, z),
        DVec3::new(max.0.x, max.0.y, z + 1.0),
    );
    let inside = tile.intersection(VoxelBox::of_size(extent));
    (!inside.is_empty()).then_some(inside)
}

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
}

impl Inner {
    /// Why nothing can be read, if the file was taken away.
    fn away(&self) -> Option<CatalogError> {
        match &self.database {
            Database::Sqlite(opened) => opened.away().map(|away| CatalogError::Away {
                why: away.why,
                location: self.location.clone(),
            }),
            Database::Postgres(_) => None,
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
        };
        Self {
            inner: Arc::new(inner),
        }
    }

    /// Where it is.
    pub fn location(&self) -> &CatalogLocation {
        &self.inner.location
    }

    /// Measures leases with this clock instead of the machine's or, with a server, the server's. Has
    /// an effect once.
    #[must_use]
    pub fn with_clock(self, clock: Arc<dyn Clock>) -> Self {
        drop(self.inner.clock.set(clock));
        self
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
                self.insert_volume(volume).await?;
                self.volume(&volume.name).await?
            }
            there => there?,
        };
        let differs = |what, existing: String, asked: String| {
            let same = existing == asked;
            let name = volume.name.clone();
            (!same).then_some(CatalogError::WrongVolume {
                name,
                what,
                existing,
                asked,
            })
        };
        let of = |v: &Volume| {
            [
                ("extent", format!("{} voxels", v.extent())),
                ("voxel size", format!("{} nm", v.voxel_nm)),
                ("voxel type", format!("{:?}", v.dtype).to_lowercase()),
                ("kind", format!("{:?}", v.kind).to_lowercase()),
                ("channels", v.channels.join(", ")),
            ]
        };
        let pairs = of(&there).into_iter().zip(of(volume));
        let wrong = pairs.map(|((what, existing), (_, asked))| differs(what, existing, asked));
        wrong.flatten().next().map_or(Ok(()), Err)
    }

    async fn insert_volume(&self, volume: &Volume) -> Result<(), CatalogError> {
        let description = serde_json::to_string(volume).expect("a volume becomes JSON");
        let insert =
            "INSERT INTO volumes (name, description) VALUES ($1, $2) ON CONFLICT DO NOTHING";
        let mut transaction = self.transaction(Durability::Durable).await?;
        let values = [(&volume.name).into(), (&description).into()];
        let done = transaction.run(insert, &values).await;
        done.map_err(|e| self.failed(e))?;
        transaction.commit().await.map_err(|e| self.failed(e))
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
            let name: String = row.get("name")?;
            let entry = self.described(&name, row);
            Ok(Listed { name, entry })
        };
        self.ask(question, &[], listed).await
    }

    /// The tiles of a section, by id.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], [`CatalogError::SpoiltTile`] where [`Self::section_rows`] has one, or what the
    /// database says.
    pub async fn section_tiles(&self, volume: &str, z: u32) -> Result<Vec<Tile>, CatalogError> {
        let rows = self.section_rows(volume, z).await?;
        self.whole(volume, rows)
    }

    /// The tile of that name, if the volume has it.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], [`CatalogError::SpoiltTile`], or what the database says.
    pub async fn tile(&self, volume: &str, name: &str) -> Result<Option<Tile>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, \
                        pyramid, revision FROM tiles \
                        WHERE volume = $1 AND name = $2 AND deleted = 0";
        let values = [id.into(), name.into()];
        let rows = self.ask(question, &values, rows::tile_or_spoilt).await?;
        Ok(self.whole(volume, rows)?.pop())
    }

    /// The tiles of these ids, by id; those that the volume has not are left out.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], [`CatalogError::SpoiltTile`], or what the database says.
    pub async fn tiles(&self, volume: &str, ids: &[TileId]) -> Result<Vec<Tile>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = Statement {
            sqlite: "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, \
                     pyramid, revision FROM tiles \
                     WHERE id IN (SELECT value FROM json_each($1)) AND volume = $2 \
                     AND deleted = 0 ORDER BY id",
            postgres: "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, \
                       pyramid, revision FROM tiles \
                       WHERE id IN (SELECT value::bigint FROM json_array_elements_text($1::text::json)) \
                       AND volume = $2 AND deleted = 0 ORDER BY id",
        };
        let ids = serde_json::to_string(ids).expect("numbers become JSON");
        let values = [(&ids).into(), id.into()];
        let rows = self.ask(question, &values, rows::tile_or_spoilt).await?;
        self.whole(volume, rows)
    }

    /// The sections that have a tile, ascending.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn sections(&self, volume: &str) -> Result<Vec<u32>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT section FROM sections WHERE volume = $1 ORDER BY section";
        self.ask(question, &[id.into()], rows::section).await
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

    /// How often another file has taken the place of the one that was open. From then on that is read, whose revisions count
    /// anew, and anything may be another; nothing can be written any more. Looked for several times a second from
    /// [`Self::follow`] or the first [`Self::subscribe`] on, whose receivers wake then.
    pub fn times_replaced(&self) -> u64 {
        match &self.inner.database {
            Database::Sqlite(opened) => opened.times_replaced(),
            Database::Postgres(_) => 0,
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
        let outcome = commit.tile(tile, SystemTime::now()).await?;
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
        let outcome = commit.delete(tile, position, SystemTime::now()).await?;
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

    /// The files in quarantine, oldest first.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn quarantined(&self, volume: &str) -> Result<Vec<Quarantined>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question =
            "SELECT file, tile, reason, bytes, at FROM quarantine WHERE volume = $1 ORDER BY id";
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
        let question = "SELECT file, tile, reason, bytes, at FROM quarantine WHERE volume = $1 \
                        ORDER BY id LIMIT $2";
        let values = [id.into(), most.into()];
        self.ask(question, &values, rows::quarantined).await
    }

    /// How far the records were read.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn cursor(&self, volume: &str) -> Result<Cursor, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT byte, line, seen FROM cursors WHERE volume = $1";
        let found = self.ask(question, &[id.into()], rows::cursor).await?;
        Ok(found.into_iter().next().unwrap_or_default())
    }

    /// The records whose file is not whole yet, by position.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn waiting(&self, volume: &str) -> Result<Vec<Waiting>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT position, record, reason FROM waiting \
                        WHERE volume = $1 AND parked = 1 ORDER BY position";
        self.ask(question, &[id.into()], rows::waiting).await
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

    /// Counts. Cheap at any number of tiles.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn statistics(&self, volume: &str) -> Result<Statistics, CatalogError> {
        let question = "SELECT v.revision, v.tiles, \
                        (SELECT count(*) FROM sections WHERE volume = v.id) AS sections, \
                        (SELECT count(*) FROM quarantine WHERE volume = v.id) AS quarantined, \
                        (SELECT count(*) FROM waiting WHERE volume = v.id AND parked = 1) AS waiting, \
                        (SELECT count(*) FROM waiting WHERE volume = v.id AND parked = 0) AS queued, \
                        (SELECT count(*) FROM early_transforms WHERE volume = v.id) AS early \
                        FROM volumes v WHERE v.name = $1";
        let found = self
            .ask(question, &[volume.into()], rows::statistics)
            .await?;
        match found.into_iter().next() {
            Some(statistics) => Ok(statistics),
            None => Err(self.unknown_volume(volume).await),
        }
    }

    /// The sections that have a tile, by looking at the tiles themselves: what [`Self::sections`] should say.
    ///
    /// # Errors
    ///
    /// As [`Self::sections`].
    pub async fn sections_of_tiles(&self, volume: &str) -> Result<Vec<u32>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT DISTINCT section FROM tiles WHERE volume = $1 AND deleted = 0 \
                        ORDER BY section";
        self.ask(question, &[id.into()], rows::section).await
    }

    /// Counts a volume's tiles anew, in all and by section.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn recount(&self, volume: &str) -> Result<(), CatalogError> {
        let id = self.volume_id(volume).await?;
        let mut transaction = self.transaction(Durability::Durable).await?;
        for statement in [
            "UPDATE volumes SET tiles = \
             (SELECT count(*) FROM tiles WHERE volume = $1 AND deleted = 0) WHERE id = $1",
            "DELETE FROM sections WHERE volume = $1",
            "INSERT INTO sections (volume, section, tiles) SELECT volume, section, count(*) \
             FROM tiles WHERE volume = $1 AND deleted = 0 GROUP BY volume, section",
        ] {
            let done = transaction.run(statement, &[id.into()]).await;
            done.map_err(|e| self.failed(e))?;
        }
        let done = transaction.commit().await;
        done.map_err(|e| self.failed(e))
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
        rows.map_err(|e| self.inner.away().unwrap_or_else(|| self.failed(e)))
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
        let begun = Transaction::begin(&self.inner.database, durability).await;
        begun
            .map_err(|e| self.failed(e))?
            .ok_or_else(|| CatalogError::ReadOnly {
                location: self.location().clone(),
            })
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
        let question = "SELECT name FROM volumes ORDER BY name";
        match self.ask(question, &[], |row| row.get("name")).await {
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
