//! The catalog: which volumes and tiles there are, where they lie, and what changed.
//!
//! One SQLite file (write-ahead log, `synchronous=FULL`): when a commit returns, it survives a
//! power cut. Several processes may have it open; one writes at a time and the others wait.
//!
//! # Revisions
//!
//! Each volume has a revision, from 0. Each change of voxels makes it one larger and is logged with
//! the box of level-0 voxels it touches. A tile that moves far makes two changes, its old and its
//! new place, in one transaction. [`Catalog::subscribe`] tells of new revisions, also of those that
//! other processes commit; [`Catalog::changes_after`] tells what they were.
//!
//! # Order
//!
//! What a tile is follows from its records' positions, not from when they were worked on: the image
//! comes from the tile record with the largest position, the transform from the tile or transform
//! record with the largest. A transform that comes before the tile's first record is kept and
//! applied to it. A deletion ends what came before it: a tile record with a larger position brings
//! the tile back, as if it were new.

mod commit;
mod error;
mod open;
mod rows;
mod watcher;

use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

use glam::{DVec3, UVec2, UVec3};
use saccade_core::transform::SectionFromTile;
use saccade_core::volume::{Volume, check_name};
use saccade_core::voxel_box::VoxelBox;
use serde::{Deserialize, Serialize};
use sqlx::SqlitePool;
use tokio::sync::watch;

use crate::acquisition::{Cursor, TileRecord};

pub use commit::{Commit, DeleteOutcome, TileOutcome, TransformOutcome};
pub use error::CatalogError;

/// Most changes that [`Catalog::changes_after`] returns at once.
pub const CHANGES_AT_ONCE: usize = 4096;

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
    path: Box<Path>,
    access: open::Access,
    /// One connection: SQLite lets one write at a time, and waiting here costs no time-out.
    writer: Option<SqlitePool>,
    readers: SqlitePool,
    watcher: watcher::Watcher,
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
    /// [`CatalogError::OlderSchema`], [`CatalogError::NetworkFilesystem`], or what SQLite says.
    pub async fn open(path: &Path) -> Result<Self, CatalogError> {
        if !path.is_file() {
            return Err(CatalogError::NotFound {
                path: path.to_owned(),
            });
        }
        Self::create(path).await
    }

    /// Opens a catalog, and makes it first if there is none.
    ///
    /// # Errors
    ///
    /// As [`Self::open`].
    pub async fn create(path: &Path) -> Result<Self, CatalogError> {
        Ok(Self::of(path, open::open(path).await?))
    }

    fn of(path: &Path, opened: open::Opened) -> Self {
        let inner = Inner {
            path: path.into(),
            access: opened.access,
            writer: opened.writer,
            readers: opened.readers,
            watcher: watcher::Watcher::default(),
        };
        Self {
            inner: Arc::new(inner),
        }
    }

    /// The connection that writes.
    fn writer(&self) -> Result<&SqlitePool, CatalogError> {
        self.inner
            .writer
            .as_ref()
            .ok_or_else(|| CatalogError::ReadOnly {
                path: self.path().to_owned(),
            })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.inner.path
    }

    /// Enters a volume. It is fine if it is there already and has the same size.
    ///
    /// # Errors
    ///
    /// [`CatalogError::VolumeName`], [`CatalogError::WrongExtent`],
    /// [`CatalogError::WrongVoxelSize`], or what SQLite says.
    pub async fn create_volume(&self, volume: &Volume) -> Result<(), CatalogError> {
        check_name(&volume.name)?;
        let description = serde_json::to_string(volume).expect("a volume becomes JSON");
        sqlx::query("INSERT INTO volumes (name, description) VALUES (?, ?) ON CONFLICT DO NOTHING")
            .bind(&volume.name)
            .bind(description)
            .execute(self.writer()?)
            .await
            .map_err(|e| self.failed(e))?;
        let there = self.volume(&volume.name).await?;
        let name = volume.name.clone();
        if there.extent() != volume.extent() {
            let (existing, asked) = (there.extent(), volume.extent());
            return Err(CatalogError::WrongExtent {
                name,
                existing,
                asked,
            });
        }
        if there.voxel_nm != volume.voxel_nm {
            let (existing, asked) = (there.voxel_nm, volume.voxel_nm);
            return Err(CatalogError::WrongVoxelSize {
                name,
                existing,
                asked,
            });
        }
        Ok(())
    }

    /// A volume.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
    pub async fn volume(&self, name: &str) -> Result<Volume, CatalogError> {
        Ok(self.entry(name).await?.volume)
    }

    /// A volume and how far it is.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
    pub async fn entry(&self, name: &str) -> Result<VolumeEntry, CatalogError> {
        let row = sqlx::query("SELECT description, revision, tiles FROM volumes WHERE name = ?")
            .bind(name)
            .fetch_optional(&self.inner.readers)
            .await
            .map_err(|e| self.failed(e))?;
        match row {
            Some(row) => rows::volume_entry(&row).map_err(|e| self.failed(e)),
            None => Err(self.unknown_volume(name).await),
        }
    }

    /// All volumes, by name.
    ///
    /// # Errors
    ///
    /// What SQLite says.
    pub async fn volumes(&self) -> Result<Vec<VolumeEntry>, CatalogError> {
        let query = "SELECT description, revision, tiles FROM volumes ORDER BY name";
        let rows = sqlx::query(query).fetch_all(&self.inner.readers).await;
        let rows = rows.map_err(|e| self.failed(e))?;
        let volumes: Result<_, _> = rows.iter().map(rows::volume_entry).collect();
        volumes.map_err(|e| self.failed(e))
    }

    /// The tiles of a section, by id.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
    pub async fn section_tiles(&self, volume: &str, z: u32) -> Result<Vec<Tile>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let query = "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, pyramid, revision \
                     FROM tiles WHERE volume = ? AND section = ? AND deleted = 0 ORDER BY id";
        let rows = sqlx::query(query)
            .bind(id)
            .bind(z)
            .fetch_all(&self.inner.readers)
            .await;
        let rows = rows.map_err(|e| self.failed(e))?;
        let tiles: Result<_, _> = rows.iter().map(rows::tile).collect();
        tiles.map_err(|e| self.failed(e))
    }

    /// The tile of that name, if the volume has it.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
    pub async fn tile(&self, volume: &str, name: &str) -> Result<Option<Tile>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let query = "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, pyramid, revision \
                     FROM tiles WHERE volume = ? AND name = ? AND deleted = 0";
        let row = sqlx::query(query)
            .bind(id)
            .bind(name)
            .fetch_optional(&self.inner.readers)
            .await;
        let row = row.map_err(|e| self.failed(e))?;
        row.as_ref()
            .map(rows::tile)
            .transpose()
            .map_err(|e| self.failed(e))
    }

    /// The tiles of these ids, by id; those that the volume has not are left out.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
    pub async fn tiles(&self, volume: &str, ids: &[TileId]) -> Result<Vec<Tile>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let query = "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, pyramid, revision \
                     FROM tiles WHERE id IN (SELECT value FROM json_each(?)) AND volume = ? \
                     AND deleted = 0 ORDER BY id";
        let ids = serde_json::to_string(ids).expect("numbers become JSON");
        let rows = sqlx::query(query)
            .bind(ids)
            .bind(id)
            .fetch_all(&self.inner.readers)
            .await;
        let rows = rows.map_err(|e| self.failed(e))?;
        let tiles: Result<_, _> = rows.iter().map(rows::tile).collect();
        tiles.map_err(|e| self.failed(e))
    }

    /// The sections that have a tile, ascending.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
    pub async fn sections(&self, volume: &str) -> Result<Vec<u32>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let query = "SELECT section FROM sections WHERE volume = ? ORDER BY section";
        let sections = sqlx::query_scalar(query)
            .bind(id)
            .fetch_all(&self.inner.readers)
            .await;
        sections.map_err(|e| self.failed(e))
    }

    /// A volume's newest revision; 0 while it is empty.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
    pub async fn revision(&self, volume: &str) -> Result<u64, CatalogError> {
        Ok(self.entry(volume).await?.revision)
    }

    /// The changes after a revision, oldest first, without gaps, at most [`CHANGES_AT_ONCE`]: ask
    /// again from the last one's revision until there are none.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
    pub async fn changes_after(
        &self,
        volume: &str,
        revision: u64,
    ) -> Result<Vec<CatalogChange>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let query = "SELECT revision, tile, section, x0, y0, x1, y1, reason FROM changes \
                     WHERE volume = ? AND revision > ? ORDER BY revision LIMIT ?";
        let query = sqlx::query(query).bind(id).bind(rows::signed(revision));
        let rows = query
            .bind(CHANGES_AT_ONCE as i64)
            .fetch_all(&self.inner.readers)
            .await;
        let rows = rows.map_err(|e| self.failed(e))?;
        let changes: Result<_, _> = rows.iter().map(rows::change).collect();
        changes.map_err(|e| self.failed(e))
    }

    /// Follows a volume's revision: the receiver wakes after each commit of this process, and
    /// within a fifth of a second after those of others.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
    pub async fn subscribe(&self, volume: &str) -> Result<watch::Receiver<u64>, CatalogError> {
        // The receiver exists before the revision is read, so that no commit falls in between.
        let receiver = self.inner.watcher.subscribe(&self.inner, volume);
        let revision = self.revision(volume).await?;
        self.inner.watcher.announce(volume, revision);
        Ok(receiver)
    }

    /// Begins a transaction on a volume. Nothing is changed until [`Commit::finish`].
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
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
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
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
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
    pub async fn quarantined(&self, volume: &str) -> Result<Vec<Quarantined>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let query =
            "SELECT file, tile, reason, bytes, at FROM quarantine WHERE volume = ? ORDER BY id";
        let rows = sqlx::query(query)
            .bind(id)
            .fetch_all(&self.inner.readers)
            .await;
        let rows = rows.map_err(|e| self.failed(e))?;
        let files: Result<_, _> = rows.iter().map(rows::quarantined).collect();
        files.map_err(|e| self.failed(e))
    }

    /// How far the records were read.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
    pub async fn cursor(&self, volume: &str) -> Result<Cursor, CatalogError> {
        let id = self.volume_id(volume).await?;
        let query = "SELECT byte, line FROM cursors WHERE volume = ?";
        let row = sqlx::query(query)
            .bind(id)
            .fetch_optional(&self.inner.readers)
            .await;
        let row = row.map_err(|e| self.failed(e))?;
        row.map_or_else(|| Ok(Cursor::default()), |r| rows::cursor(&r))
            .map_err(|e| self.failed(e))
    }

    /// The records whose file is not whole yet, by position.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
    pub async fn waiting(&self, volume: &str) -> Result<Vec<Waiting>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let query =
            "SELECT position, record, reason FROM waiting WHERE volume = ? ORDER BY position";
        let rows = sqlx::query(query)
            .bind(id)
            .fetch_all(&self.inner.readers)
            .await;
        let rows = rows.map_err(|e| self.failed(e))?;
        let waiting: Result<_, _> = rows.iter().map(rows::waiting).collect();
        waiting.map_err(|e| self.failed(e))
    }

    /// Pyramids that no tile has named since `before`, at most `max`.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
    pub async fn retired(
        &self,
        volume: &str,
        before: SystemTime,
        max: u32,
    ) -> Result<Vec<Retired>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let query =
            "SELECT pyramid, at FROM retired WHERE volume = ? AND at < ? ORDER BY at LIMIT ?";
        let query = sqlx::query(query)
            .bind(id)
            .bind(rows::millis(before))
            .bind(max);
        let rows = query
            .fetch_all(&self.inner.readers)
            .await
            .map_err(|e| self.failed(e))?;
        let retired: Result<_, _> = rows.iter().map(rows::retired).collect();
        retired.map_err(|e| self.failed(e))
    }

    /// Counts. Cheap at any number of tiles.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what SQLite says.
    pub async fn statistics(&self, volume: &str) -> Result<Statistics, CatalogError> {
        let entry = self.entry(volume).await?;
        let id = self.volume_id(volume).await?;
        let count = "SELECT (SELECT count(*) FROM quarantine WHERE volume = ?1), \
                     (SELECT count(*) FROM waiting WHERE volume = ?1), \
                     (SELECT count(*) FROM early_transforms WHERE volume = ?1), \
                     (SELECT count(*) FROM sections WHERE volume = ?1)";
        let counts = sqlx::query_as::<_, (i64, i64, i64, i64)>(count).bind(id);
        let counts = counts
            .fetch_one(&self.inner.readers)
            .await
            .map_err(|e| self.failed(e))?;
        Ok(Statistics {
            revision: entry.revision,
            tiles: entry.tiles,
            sections: counts.3.unsigned_abs(),
            quarantined: counts.0.unsigned_abs(),
            waiting: counts.1.unsigned_abs(),
            early: counts.2.unsigned_abs(),
        })
    }

    /// Ends all connections. Without it they end when the last clone is dropped, in their own time.
    pub async fn close(&self) {
        self.inner.readers.close().await;
        if let Some(writer) = &self.inner.writer {
            writer.close().await;
        }
    }

    async fn volume_id(&self, name: &str) -> Result<i64, CatalogError> {
        let query = sqlx::query_scalar("SELECT id FROM volumes WHERE name = ?").bind(name);
        let id = query
            .fetch_optional(&self.inner.readers)
            .await
            .map_err(|e| self.failed(e))?;
        match id {
            Some(id) => Ok(id),
            None => Err(self.unknown_volume(name).await),
        }
    }

    async fn unknown_volume(&self, name: &str) -> CatalogError {
        let query = sqlx::query_scalar("SELECT name FROM volumes ORDER BY name");
        match query.fetch_all(&self.inner.readers).await {
            Ok(known) => CatalogError::UnknownVolume {
                name: name.to_owned(),
                known,
            },
            Err(e) => self.failed(e),
        }
    }

    fn failed(&self, source: sqlx::Error) -> CatalogError {
        CatalogError::from_sqlite(source, &self.inner.path)
    }
}
