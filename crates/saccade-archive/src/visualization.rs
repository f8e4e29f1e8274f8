//! The visualization archive: pyramids and the catalog that names them, in one folder.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::catalog::{Catalog, CatalogError};
use crate::storage::{LocalStorage, Storage, StorageError};

/// A folder with `catalog.sqlite` and the pyramids below `tiles/`. Clones share it.
#[derive(Clone, Debug)]
pub struct VisualizationArchive {
    catalog: Catalog,
    storage: Arc<dyn Storage>,
}

/// Why a visualization archive could not be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ArchiveError {
    /// The folder holds no catalog.
    #[error(
        "this folder is no visualization archive; `saccade ingest` or `saccade demo` makes one: {}",
        path.display()
    )]
    NotAnArchive {
        /// The folder.
        path: PathBuf,
    },
    /// The folder could not be made.
    #[error("cannot make the folder; check its parent's permissions: {}", path.display())]
    Folder {
        /// What the system says.
        source: io::Error,
        /// The folder.
        path: PathBuf,
    },
    /// The catalog could not be opened.
    #[error(transparent)]
    Catalog(#[from] CatalogError),
    /// The storage could not be opened.
    #[error(transparent)]
    Storage(#[from] StorageError),
}

impl VisualizationArchive {
    /// The catalog's file in the folder.
    pub const CATALOG: &str = "catalog.sqlite";

    /// Opens an archive that exists.
    ///
    /// # Errors
    ///
    /// [`ArchiveError`].
    pub async fn open(folder: &Path) -> Result<Self, ArchiveError> {
        if !folder.join(Self::CATALOG).is_file() {
            return Err(ArchiveError::NotAnArchive {
                path: folder.to_owned(),
            });
        }
        Self::create(folder).await
    }

    /// Opens an archive, and makes it first if there is none.
    ///
    /// # Errors
    ///
    /// [`ArchiveError`].
    pub async fn create(folder: &Path) -> Result<Self, ArchiveError> {
        std::fs::create_dir_all(folder).map_err(|source| ArchiveError::Folder {
            source,
            path: folder.to_owned(),
        })?;
        let catalog = Catalog::create(&folder.join(Self::CATALOG)).await?;
        let storage = Arc::new(LocalStorage::new(folder)?);
        Ok(Self { catalog, storage })
    }

    /// An archive of these parts.
    pub fn from_parts(catalog: Catalog, storage: Arc<dyn Storage>) -> Self {
        Self { catalog, storage }
    }

    /// Which tiles there are.
    pub fn catalog(&self) -> &Catalog {
        &self.catalog
    }

    /// Their pyramids.
    pub fn storage(&self) -> &Arc<dyn Storage> {
        &self.storage
    }
}
