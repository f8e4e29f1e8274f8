use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;

use super::VisualizationArchive;
use crate::catalog::CatalogLocation;
use crate::storage::{
    BucketLocation, BucketLocationError, LocalStorage, ObjectStorage, Storage, StorageError,
};

/// Where pyramids lie: a folder, or `s3://bucket/prefix`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StorageLocation {
    /// A folder, local or on a shared file system.
    Folder(PathBuf),
    /// A bucket of an object store.
    Bucket(BucketLocation),
}

impl StorageLocation {
    /// Opens it; a folder is made if it is not there.
    ///
    /// # Errors
    ///
    /// As they occur: a folder that cannot be made, a bucket that does not exist or does not answer.
    pub async fn open(&self) -> Result<Arc<dyn Storage>, StorageError> {
        Ok(match self {
            Self::Folder(folder) => Arc::new(LocalStorage::new(folder)?),
            Self::Bucket(bucket) => {
                let storage = ObjectStorage::s3(bucket)?;
                storage.check().await?;
                Arc::new(storage)
            }
        })
    }
}

/// Where an archive is: its pyramids, and the catalog that names them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ArchiveLocation {
    storage: StorageLocation,
    catalog: CatalogLocation,
}

/// Why there can be nothing at a location.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum LocationError {
    /// It begins with `s3:`, but names no bucket.
    #[error(transparent)]
    Bucket(#[from] BucketLocationError),
    /// It is the address of something else.
    #[error("{text:?} is neither a folder nor a bucket; write a path or s3://bucket/prefix")]
    Scheme {
        /// As given.
        text: String,
    },
    /// A catalog cannot be there.
    #[error(
        "{text:?} is no place for a catalog; name a file on a local disk, or a database as \
         postgres://USER:PASSWORD@HOST/DATABASE"
    )]
    CatalogScheme {
        /// As given.
        text: String,
    },
    /// A bucket holds no catalog.
    #[error(
        "the catalog of {storage} cannot be in the bucket; name a local file with --catalog FILE, or a \
         database with --catalog postgres://USER:PASSWORD@HOST/DATABASE"
    )]
    NoCatalog {
        /// Where the pyramids are.
        storage: StorageLocation,
    },
}

impl FromStr for StorageLocation {
    type Err = LocationError;

    fn from_str(text: &str) -> Result<Self, LocationError> {
        if BucketLocation::is_meant_by(text) {
            Ok(Self::Bucket(text.parse()?))
        } else if text.contains("://") {
            let text = text.to_owned();
            Err(LocationError::Scheme { text })
        } else {
            Ok(Self::Folder(text.into()))
        }
    }
}

impl FromStr for CatalogLocation {
    type Err = LocationError;

    fn from_str(text: &str) -> Result<Self, LocationError> {
        match Self::parse(text) {
            Self::File(_) if text.contains("://") => {
                let text = text.to_owned();
                Err(LocationError::CatalogScheme { text })
            }
            location => Ok(location),
        }
    }
}

impl ArchiveLocation {
    /// Pyramids at `storage`; the catalog, unless it is given, beside them in the folder.
    ///
    /// # Errors
    ///
    /// [`LocationError::NoCatalog`] for a bucket without a catalog.
    pub fn new(
        storage: StorageLocation,
        catalog: Option<CatalogLocation>,
    ) -> Result<Self, LocationError> {
        let catalog = match (&storage, catalog) {
            (_, Some(catalog)) => catalog,
            (StorageLocation::Folder(folder), None) => {
                CatalogLocation::File(folder.join(VisualizationArchive::CATALOG))
            }
            (StorageLocation::Bucket(_), None) => return Err(LocationError::NoCatalog { storage }),
        };
        Ok(Self { storage, catalog })
    }

    /// Where the pyramids lie.
    pub fn storage(&self) -> &StorageLocation {
        &self.storage
    }

    /// Where the catalog is.
    pub fn catalog(&self) -> &CatalogLocation {
        &self.catalog
    }

    /// The folder, if the pyramids lie in one.
    pub fn folder(&self) -> Option<&Path> {
        match &self.storage {
            StorageLocation::Folder(folder) => Some(folder),
            StorageLocation::Bucket(_) => None,
        }
    }
}

impl<P: AsRef<Path> + ?Sized> From<&P> for ArchiveLocation {
    /// A folder with pyramids and catalog.
    fn from(folder: &P) -> Self {
        let folder = folder.as_ref();
        Self {
            storage: StorageLocation::Folder(folder.to_owned()),
            catalog: CatalogLocation::File(folder.join(VisualizationArchive::CATALOG)),
        }
    }
}

impl From<&Self> for ArchiveLocation {
    fn from(location: &Self) -> Self {
        location.clone()
    }
}

impl fmt::Display for StorageLocation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Folder(folder) => folder.display().fmt(f),
            Self::Bucket(bucket) => bucket.fmt(f),
        }
    }
}

impl fmt::Display for ArchiveLocation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.storage.fmt(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_read_or_refused() {
        let storage = |text: &str| text.parse::<StorageLocation>();
        assert_eq!(
            storage("a/b").unwrap(),
            StorageLocation::Folder("a/b".into())
        );
        assert_eq!(storage("s3://b/c/").unwrap().to_string(), "s3://b/c");
        for bad in ["s3:/b", "gs://b", "https://example.org"] {
            assert!(storage(bad).is_err(), "{bad}");
        }
        assert!("file:///c.sqlite".parse::<CatalogLocation>().is_err());
    }

    #[test]
    fn the_catalog_lies_in_the_folder_unless_it_is_elsewhere() {
        let file = |path: &str| CatalogLocation::File(path.into());
        let at = |storage: &str, catalog| ArchiveLocation::new(storage.parse().unwrap(), catalog);
        assert_eq!(*at("a", None).unwrap().catalog(), file("a/catalog.sqlite"));
        assert_eq!(at("a", None).unwrap(), ArchiveLocation::from("a"));
        let elsewhere = at("s3://b/a", Some(file("c.sqlite"))).unwrap();
        assert_eq!(*elsewhere.catalog(), file("c.sqlite"));
        assert_eq!(elsewhere.folder(), None);
        let error = at("s3://b/a", None).unwrap_err().to_string();
        assert!(
            error.contains("--catalog") && error.contains("s3://b/a"),
            "{error}"
        );
    }
}
