//! The visualization archive: pyramids, below `tiles/` of a storage, and the catalog that names them.

mod identity;
mod location;

use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use crate::catalog::{Catalog, CatalogError, CatalogLocation};
use crate::randomness::{Randomness, SystemRandomness};
use crate::storage::{LocalStorage, MemoryStorage, Storage, StorageError};

pub use identity::{IDENTITY, read_identity};
pub use location::{ArchiveLocation, LocationError, StorageLocation};

/// An open archive. Clones share it.
#[derive(Clone, Debug)]
pub struct VisualizationArchive {
    catalog: Catalog,
    storage: Arc<dyn Storage>,
    randomness: Arc<dyn Randomness>,
    /// Where it was opened.
    location: Option<Arc<ArchiveLocation>>,
}

/// Why a visualization archive could not be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ArchiveError {
    /// There is no catalog.
    #[error(
        "there is no visualization archive; `saccade ingest` or `saccade demo` makes one: {}",
        path.display()
    )]
    NotAnArchive {
        /// The catalog's file, which is not there.
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
    /// The catalog names pyramids of another archive.
    #[error(
        "the catalog {catalog} and the pyramids in {storage} are not of one archive; name the folder that \
         the catalog was made with, or the catalog that was made with the folder.{} If all pyramids of the \
         catalog were lost, ingest the acquisition again into a new archive",
        mount_hint(storage)
    )]
    Strangers {
        /// Where the pyramids lie.
        storage: StorageLocation,
        /// Where the catalog is.
        catalog: CatalogLocation,
    },
    /// The catalog names pyramids in a folder that is not there.
    #[error(
        "there is no such folder, but the catalog {catalog} names pyramids in it; mount its disk, or name the folder that the \
         catalog was made with: {}",
        path.display()
    )]
    NoFolder {
        /// The folder.
        path: PathBuf,
        /// Where the catalog is.
        catalog: CatalogLocation,
    },
    /// There are pyramids, but the catalog knows of nothing.
    #[error(
        "{storage} holds pyramids, and the catalog {catalog} is not there or empty: they are another catalog's, or \
         theirs was lost. Name that one, or another place for what is to be taken in. If it was lost, put a copy of it \
         back: `saccade ingest` goes on from what it knows. Without a copy, take the acquisition in again into \
         another place; then these pyramids can be deleted"
    )]
    Unnamed {
        /// Where the pyramids lie.
        storage: StorageLocation,
        /// Where the catalog is, or would be.
        catalog: CatalogLocation,
    },
    /// The storage's identity is damaged, and nothing else tells whose it is.
    #[error(
        "the object {IDENTITY:?} of {storage} is empty or damaged, and the catalog {catalog} names no pyramid by \
         which they could be known to belong together. If they do, delete the object: `saccade ingest` writes it \
         anew"
    )]
    Identity {
        /// Where the object lies.
        storage: StorageLocation,
        /// Where the catalog is.
        catalog: CatalogLocation,
    },
    /// The storage that was opened holds nothing of the archive any more.
    #[error(
        "the archive's pyramids are not where they were: the place came back empty, or another archive's has it, and nothing more \
         is written there. Put the right one back, as by mounting its disk, and this goes on; if they were lost, end this, and \
         ingest the acquisition again into a new archive: {storage}"
    )]
    Replaced {
        /// Where they lay.
        storage: StorageLocation,
    },
    /// The catalog could not be opened.
    #[error(transparent)]
    Catalog(#[from] CatalogError),
    /// The storage could not be opened.
    #[error(transparent)]
    Storage(#[from] StorageError),
}

impl ArchiveError {
    /// Whether it passes only when somebody does something, however long that takes.
    pub fn is_outage(&self) -> bool {
        match self {
            Self::Replaced { .. } => true,
            Self::Catalog(error) => error.is_outage(),
            Self::Storage(error) => error.is_outage(),
            _ => false,
        }
    }

    /// Whether the same request may succeed later.
    pub fn is_transient(&self) -> bool {
        match self {
            Self::Catalog(error) => error.is_transient(),
            Self::Storage(error) => error.is_transient(),
            other => other.is_outage(),
        }
    }
}

/// What a folder may lack that has not what it should have.
fn mount_hint(storage: &StorageLocation) -> &'static str {
    match storage {
        StorageLocation::Folder(_) => {
            " Is the disk mounted on which the pyramids lie? Until it is, its mount point is an empty folder."
        }
        StorageLocation::Bucket(_) => "",
    }
}

impl VisualizationArchive {
    /// The catalog's file in the folder.
    pub const CATALOG: &str = "catalog.sqlite";

    /// Opens an archive that exists.
    ///
    /// # Errors
    ///
    /// [`ArchiveError`].
    pub async fn open(location: impl Into<ArchiveLocation>) -> Result<Self, ArchiveError> {
        let location = location.into();
        // A bucket that is away, or somebody else's, is not to be asked on suspicion.
        if location.folder().is_some() {
            identity::refuse_without_catalog(&location).await?;
        }
        match location.catalog() {
            CatalogLocation::File(file) if !file.is_file() => Err(ArchiveError::NotAnArchive {
                path: file.to_owned(),
            }),
            _ => Self::open_parts(&location, false).await,
        }
    }

    /// Opens an archive, and makes it first if there is none. Its parts get an [`IDENTITY`] by which they are
    /// known to belong together, if they have none.
    ///
    /// # Errors
    ///
    /// [`ArchiveError`].
    pub async fn create(location: impl Into<ArchiveLocation>) -> Result<Self, ArchiveError> {
        let location = location.into();
        identity::refuse_without_catalog(&location).await?;
        if let CatalogLocation::File(file) = location.catalog()
            && let Some(folder) = file.parent()
        {
            std::fs::create_dir_all(folder).map_err(|source| ArchiveError::Folder {
                source,
                path: folder.to_owned(),
            })?;
        }
        Self::open_parts(&location, true).await
    }

    async fn open_parts(location: &ArchiveLocation, create: bool) -> Result<Self, ArchiveError> {
        let catalog = async || {
            if create {
                Catalog::create(location.catalog()).await
            } else {
                Catalog::open(location.catalog()).await
            }
        };
        let (catalog, storage) = match location.storage() {
            // After the catalog: where there is none, no folder is made.
            StorageLocation::Folder(folder) => {
                let catalog = catalog().await?;
                // Opening a folder makes it, which is not to be done where its disk is not mounted.
                let there: Arc<dyn Storage> = if folder.is_dir() {
                    Arc::new(LocalStorage::as_it_is(folder)?)
                } else {
                    Arc::new(MemoryStorage::new())
                };
                match identity::refuse_strangers(&catalog, &*there, location).await {
                    Err(ArchiveError::Strangers { .. }) if !folder.exists() => {
                        return Err(ArchiveError::NoFolder {
                            path: folder.clone(),
                            catalog: location.catalog().clone(),
                        });
                    }
                    met => met?,
                }
                let storage = location.storage().open().await?;
                (catalog, storage)
            }
            StorageLocation::Bucket(_) => {
                // Before a catalog is made: a wrong address should not leave one behind.
                let storage = location.storage().open().await?;
                let catalog = catalog().await?;
                (catalog, storage)
            }
        };
        let archive = Self {
            location: Some(Arc::new(location.clone())),
            ..Self::from_parts(catalog, storage)
        };
        if create {
            archive.identify(location).await?;
        } else {
            identity::check(&archive.catalog, &*archive.storage, location).await?;
        }
        Ok(archive)
    }

    /// An archive of these parts.
    pub fn from_parts(catalog: Catalog, storage: Arc<dyn Storage>) -> Self {
        let randomness = Arc::new(SystemRandomness);
        Self {
            catalog,
            storage,
            randomness,
            location: None,
        }
    }

    /// Draws from this instead of the machine's randomness.
    #[must_use]
    pub fn with_randomness(self, randomness: Arc<dyn Randomness>) -> Self {
        Self { randomness, ..self }
    }

    /// Gives the parts an [`IDENTITY`] by which they are known to belong together, if they have none. Messages call
    /// them by `location`.
    ///
    /// # Errors
    ///
    /// [`ArchiveError`], if they are known not to belong together, or not to be usable.
    pub async fn identify(&self, location: &ArchiveLocation) -> Result<(), ArchiveError> {
        let (catalog, storage) = (&self.catalog, &*self.storage);
        identity::make(catalog, storage, location, &*self.randomness).await
    }

    /// Looks whether the storage is still the archive's: a disk that is not mounted any more leaves an empty folder, and a store
    /// that was set up anew an empty bucket. Asks for one small object. Of an archive that was made of parts nothing is known.
    ///
    /// # Errors
    ///
    /// [`ArchiveError::Replaced`], or what storage and catalog say.
    pub async fn verify_storage(&self) -> Result<(), ArchiveError> {
        let Some(location) = &self.location else {
            return Ok(());
        };
        let (catalog, storage) = (&self.catalog, &*self.storage);
        match identity::still_belongs(catalog, storage, &*self.randomness).await? {
            true => Ok(()),
            false => Err(ArchiveError::Replaced {
                storage: location.storage().clone(),
            }),
        }
    }

    /// What tells the storage from every other: its [`IDENTITY`], which it gets if it has none, also from who only reads.
    /// `None` if it is damaged: then it tells nothing until `saccade ingest` writes it anew.
    ///
    /// # Errors
    ///
    /// [`ArchiveError`], as where nothing can be written.
    pub async fn own_identity(&self) -> Result<Option<String>, ArchiveError> {
        identity::own(&self.catalog, &*self.storage, &*self.randomness).await
    }

    /// Which tiles there are.
    pub fn catalog(&self) -> &Catalog {
        &self.catalog
    }

    /// What is drawn from, where nobody is to foresee it.
    pub(crate) fn randomness(&self) -> &dyn Randomness {
        &*self.randomness
    }

    /// Their pyramids.
    pub fn storage(&self) -> &Arc<dyn Storage> {
        &self.storage
    }
}
