use std::path::{Path, PathBuf};

use glam::{DVec3, UVec3};
use saccade_core::volume::VolumeError;

/// Why the catalog could not do what was asked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CatalogError {
    /// There is no such file.
    #[error("there is no catalog; `saccade ingest` makes one: {}", path.display())]
    NotFound {
        /// Where it was looked for.
        path: PathBuf,
    },
    /// The file is something else.
    #[error(
        "this file is not a Saccade catalog and is left as it is; give another folder: {}",
        path.display()
    )]
    NotACatalog {
        /// The file.
        path: PathBuf,
    },
    /// A newer Saccade wrote it.
    #[error(
        "the catalog was written by a newer Saccade (schema {found}, this one knows up to {known}); \
         use that version: {}",
        path.display()
    )]
    NewerSchema {
        /// Schema of the file.
        found: i64,
        /// Newest schema of this program.
        known: i64,
        /// The file.
        path: PathBuf,
    },
    /// An older Saccade wrote it, and it may only be read.
    #[error(
        "the catalog was written by an older Saccade (schema {found}, this one needs {known}) and may \
         only be read here; open it once where it may be written: {}",
        path.display()
    )]
    OlderSchema {
        /// Schema of the file.
        found: i64,
        /// Schema of this program.
        known: i64,
        /// The file.
        path: PathBuf,
    },
    /// The file may only be read.
    #[error(
        "the catalog may only be read: check the permissions of its folder, or whether the file \
         system is mounted read-only: {}",
        path.display()
    )]
    ReadOnly {
        /// The file.
        path: PathBuf,
    },
    /// SQLite's write-ahead log needs memory that processes share, which network file systems lack.
    #[error(
        "the catalog cannot live on a network file system ({kind}), where SQLite may lose data; put \
         the visualization archive on a local disk: {}",
        path.display()
    )]
    NetworkFilesystem {
        /// What the system calls it.
        kind: &'static str,
        /// The file.
        path: PathBuf,
    },
    /// There is no such volume.
    #[error("there is no volume {name:?}; the volumes are: {}", list(known))]
    UnknownVolume {
        /// As asked for.
        name: String,
        /// What there is.
        known: Vec<String>,
    },
    /// The name cannot be used in addresses and file names.
    #[error(transparent)]
    VolumeName(#[from] VolumeError),
    /// A volume of that name has another size.
    #[error(
        "wrong extent: volume {name:?} has {existing} voxels in the catalog, but {asked} now; give \
         the new volume another name, or use another archive folder"
    )]
    WrongExtent {
        /// The volume.
        name: String,
        /// In the catalog \[voxels\].
        existing: UVec3,
        /// As asked for \[voxels\].
        asked: UVec3,
    },
    /// A volume of that name has other voxels.
    #[error(
        "wrong voxel size: volume {name:?} has {existing} nm in the catalog, but {asked} nm now; give \
         the new volume another name, or use another archive folder"
    )]
    WrongVoxelSize {
        /// The volume.
        name: String,
        /// In the catalog \[nm\].
        existing: DVec3,
        /// As asked for \[nm\].
        asked: DVec3,
    },
    /// A tile would lie where no voxel is.
    #[error(
        "tile {tile:?} would lie wholly outside the volume of {extent} voxels (section {section}, \
         transform {transform:?}); check its section, transform and the volume's extent"
    )]
    OutsideVolume {
        /// The tile.
        tile: String,
        /// Its section.
        section: u32,
        /// `[a, b, c, d, tx, ty]`.
        transform: [f64; 6],
        /// The volume's size \[voxels\].
        extent: UVec3,
    },
    /// No space left. The catalog is as it was before.
    #[error("no space is left for the catalog; free some, then try again: {}", path.display())]
    Full {
        /// What SQLite says.
        source: sqlx::Error,
        /// The file.
        path: PathBuf,
    },
    /// Anything else; see the source.
    #[error("the catalog could not be read or written: {}", path.display())]
    Database {
        /// What SQLite says.
        source: sqlx::Error,
        /// The file.
        path: PathBuf,
    },
}

impl CatalogError {
    /// Sorts what SQLite says into the caller's cases.
    pub(super) fn from_sqlite(source: sqlx::Error, path: &Path) -> Self {
        let code = primary_code(&source);
        let path = path.to_owned();
        match code {
            Some(13) => Self::Full { source, path },
            Some(26) => Self::NotACatalog { path },
            _ => Self::Database { source, path },
        }
    }

    /// Whether the same request may succeed later: space may be freed, another writer may finish.
    pub fn is_transient(&self) -> bool {
        match self {
            Self::Full { .. } => true,
            // SQLITE_IOERR.
            Self::Database { source, .. } => {
                self.is_busy()
                    || primary_code(source) == Some(10)
                    || matches!(source, sqlx::Error::PoolTimedOut)
            }
            _ => false,
        }
    }

    /// Whether another connection was in the way.
    pub(super) fn is_busy(&self) -> bool {
        // SQLITE_BUSY, SQLITE_LOCKED.
        matches!(self, Self::Database { source, .. } if matches!(primary_code(source), Some(5 | 6)))
    }
}

/// SQLite's result code without its extension.
fn primary_code(error: &sqlx::Error) -> Option<u32> {
    let code = error.as_database_error()?.code()?.parse::<u32>().ok()?;
    Some(code & 0xff)
}

fn list(names: &[String]) -> String {
    if names.is_empty() {
        "none yet".to_owned()
    } else {
        names.join(", ")
    }
}
