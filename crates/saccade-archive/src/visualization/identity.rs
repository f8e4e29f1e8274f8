//! Whether a catalog and a storage are parts of one archive.
//!
//! Both get the same random identity when the archive is made: the catalog in a table, the storage in an
//! object. Where one of them has none, made by an earlier version or lost, it counts whether any of the
//! pyramids that the catalog names are there.

use std::hash::{BuildHasher, Hasher, RandomState};

use bytes::Bytes;

use super::{ArchiveError, ArchiveLocation};
use crate::catalog::Catalog;
use crate::storage::{Storage, StorageError};

/// Name of the storage's object that holds the identity.
pub const IDENTITY: &str = "identity";

/// Another one than any before.
fn random() -> String {
    let random = || RandomState::new().build_hasher().finish();
    format!("{:016x}{:016x}", random(), random())
}

async fn of_storage(storage: &dyn Storage) -> Result<Option<String>, StorageError> {
    match storage.read(IDENTITY, None).await {
        Ok(bytes) => Ok(Some(String::from_utf8_lossy(&bytes).trim().to_owned())),
        Err(StorageError::NotFound { .. }) => Ok(None),
        Err(error) => Err(error),
    }
}

/// Refuses parts of different archives.
pub(super) async fn check(
    catalog: &Catalog,
    storage: &dyn Storage,
    location: &ArchiveLocation,
) -> Result<(), ArchiveError> {
    match (catalog.identity().await?, of_storage(storage).await?) {
        // Of an earlier version: nothing speaks against it.
        (None, None) => Ok(()),
        (Some(one), Some(other)) if one == other => Ok(()),
        (Some(_), Some(_)) => Err(strangers(location)),
        _ => look_for_pyramids(catalog, storage, location).await,
    }
}

/// Refuses parts of different archives, and gives those of one archive its identity if they have none yet.
pub(super) async fn make(
    catalog: &Catalog,
    storage: &dyn Storage,
    location: &ArchiveLocation,
) -> Result<(), ArchiveError> {
    let (known, there) = (catalog.identity().await?, of_storage(storage).await?);
    if known.is_some() && there.is_some() {
        return match known == there {
            true => Ok(()),
            false => Err(strangers(location)),
        };
    }
    look_for_pyramids(catalog, storage, location).await?;
    // The catalog decides, where several processes do this at once.
    let proposed = there.clone().or(known).unwrap_or_else(random);
    let identity = catalog.give_identity(&proposed).await?;
    match there {
        Some(there) if there == identity => {}
        Some(_) => return Err(strangers(location)),
        None => {
            let line = Bytes::from(format!("{identity}\n"));
            storage.write_durable(IDENTITY, line).await?;
        }
    }
    Ok(())
}

/// Of several pyramids that the catalog names, one at least must be there.
async fn look_for_pyramids(
    catalog: &Catalog,
    storage: &dyn Storage,
    location: &ArchiveLocation,
) -> Result<(), ArchiveError> {
    let named = catalog.some_pyramids().await?;
    for name in &named {
        match storage.size(name).await {
            Ok(_) => return Ok(()),
            Err(StorageError::NotFound { .. }) => {}
            Err(error) => return Err(error.into()),
        }
    }
    match named.is_empty() {
        true => Ok(()),
        false => Err(strangers(location)),
    }
}

fn strangers(location: &ArchiveLocation) -> ArchiveError {
    ArchiveError::Strangers {
        storage: location.storage().clone(),
        catalog: location.catalog().clone(),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use glam::{DVec2, DVec3, UVec2, UVec3};
    use saccade_core::transform::SectionFromTile;
    use saccade_core::volume::Volume;

    use super::*;
    use crate::VisualizationArchive;
    use crate::catalog::{CatalogLocation, NewTile};

    /// An archive of one tile, as an earlier version made it if it is to have no identity.
    async fn made(folder: &Path, old: bool) {
        let archive = VisualizationArchive::create(folder).await.unwrap();
        let volume = Volume::new("v", UVec3::new(64, 64, 4), DVec3::ONE).unwrap();
        let catalog = archive.catalog();
        catalog.create_volume(&volume).await.unwrap();
        let pyramid = format!("tiles/{}", folder.file_name().unwrap().display());
        let tile = NewTile {
            name: "t".to_owned(),
            section: 0,
            channel: 0,
            size: UVec2::splat(8),
            transform: SectionFromTile::translation(DVec2::ZERO),
            pyramid: pyramid.clone(),
            position: 0,
        };
        let bytes = Bytes::from_static(b"a pyramid");
        let storage = archive.storage();
        storage.write_durable(&pyramid, bytes).await.unwrap();
        catalog.commit_tile("v", &tile).await.unwrap();
        if old {
            storage.delete(IDENTITY).await.unwrap();
            catalog.forget_identity().await.unwrap();
        }
        catalog.close().await;
    }

    /// The catalog of one folder with the pyramids of another.
    fn crossed(catalog: &Path, storage: &Path) -> ArchiveLocation {
        let file = catalog.join(VisualizationArchive::CATALOG);
        let storage = storage.to_str().unwrap().parse().unwrap();
        ArchiveLocation::new(storage, Some(CatalogLocation::File(file))).unwrap()
    }

    fn is_refused(opened: Result<VisualizationArchive, ArchiveError>) -> bool {
        match opened {
            Ok(_) => false,
            Err(ArchiveError::Strangers { .. }) => true,
            Err(error) => panic!("{error}"),
        }
    }

    #[tokio::test]
    async fn parts_of_two_archives_are_told_from_parts_of_one() {
        for (old, other_old) in [(false, false), (true, false), (false, true), (true, true)] {
            let folder = tempfile::tempdir().unwrap();
            let (one, other) = (folder.path().join("one"), folder.path().join("other"));
            made(&one, old).await;
            made(&other, other_old).await;
            for own in [&one, &other] {
                assert!(!is_refused(VisualizationArchive::open(own).await));
            }
            let mixed = crossed(&one, &other);
            // Who only reads knows nothing of two old ones; who writes looks closer, and leaves them alone.
            let refused = is_refused(VisualizationArchive::open(&mixed).await);
            assert_eq!(refused, !(old && other_old), "{old} {other_old}");
            assert!(is_refused(VisualizationArchive::create(&mixed).await));
            for own in [&one, &other] {
                for _ in 0..2 {
                    assert!(!is_refused(VisualizationArchive::create(own).await));
                }
            }
            // Who wrote has given both an identity.
            assert!(is_refused(VisualizationArchive::open(&mixed).await));
        }
    }

    #[tokio::test]
    async fn a_creation_that_was_broken_off_goes_on() {
        let folder = tempfile::tempdir().unwrap();
        let archive = VisualizationArchive::create(folder.path()).await.unwrap();
        let (catalog, storage) = (archive.catalog(), archive.storage());
        let identity = catalog.identity().await.unwrap().unwrap();
        storage.delete(IDENTITY).await.unwrap();
        assert!(!is_refused(
            VisualizationArchive::create(folder.path()).await
        ));
        let again = of_storage(&**storage).await.unwrap();
        assert_eq!(again, Some(identity.clone()));
        // The other way round: one that the cache on disk made, of an archive that had none.
        catalog.forget_identity().await.unwrap();
        assert!(!is_refused(
            VisualizationArchive::create(folder.path()).await
        ));
        assert_eq!(catalog.identity().await.unwrap(), Some(identity));
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn who_begin_at_once_agree() {
        for _ in 0..10 {
            let folder = tempfile::tempdir().unwrap();
            let begin = || {
                let folder = folder.path().to_owned();
                tokio::spawn(async move { VisualizationArchive::create(&folder).await })
            };
            for opening in [begin(), begin(), begin()] {
                assert!(!is_refused(opening.await.unwrap()));
            }
            assert!(!is_refused(VisualizationArchive::open(folder.path()).await));
        }
    }
}
