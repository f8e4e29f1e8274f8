//! Whether a catalog and a storage are parts of one archive.
//!
//! Both get the same random identity when the archive is made: the storage in an object, and then the catalog in a
//! table. An object that is not there yet is written only if it still is not: also who reads an archive of an earlier
//! version may give it one, and of several all take the one that is kept. Where one of them has none, made by an earlier version or lost, or the object is damaged, it counts
//! whether any of the pyramids that the catalog names are there.
//!
//! A catalog that knows of nothing does not belong to a storage that holds pyramids: they are another's, or their
//! own catalog was lost. To take everything in again over them would change them under who still reads them.

use bytes::Bytes;

use super::{ArchiveError, ArchiveLocation};
use crate::catalog::{Catalog, CatalogLocation};
use crate::randomness::Randomness;
use crate::storage::{Storage, StorageError};

/// Name of the storage's object that holds the identity.
pub const IDENTITY: &str = "identity";

/// What the names of all pyramids begin with.
pub(super) const PYRAMIDS: &str = "tiles/";

/// Hexadecimal digits of an identity.
const DIGITS: usize = 32;

/// Another one than any before.
fn random(randomness: &dyn Randomness) -> String {
    format!("{:016x}{:016x}", randomness.next(), randomness.next())
}

/// The identity that the bytes of [`IDENTITY`] say; `None` if they are cut short or otherwise damaged.
pub fn read_identity(bytes: &[u8]) -> Option<String> {
    let text = std::str::from_utf8(bytes).ok()?.trim();
    let whole = text.len() == DIGITS && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    whole.then(|| text.to_owned())
}

/// What a storage has as its identity.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Mark {
    /// Nothing.
    None,
    /// One.
    Whole(String),
    /// What was one, or was about to become one.
    Damaged,
}

impl Mark {
    async fn read(storage: &dyn Storage) -> Result<Self, StorageError> {
        match storage.read(IDENTITY, None).await {
            Ok(bytes) => Ok(Self::of(&bytes)),
            Err(StorageError::NotFound { .. }) => Ok(Self::None),
            Err(error) => Err(error),
        }
    }

    /// What an object says.
    fn of(bytes: &[u8]) -> Self {
        read_identity(bytes).map_or(Self::Damaged, Self::Whole)
    }
}

/// What both parts say of themselves.
struct Parts {
    catalog: Option<String>,
    storage: Mark,
}

impl Parts {
    async fn read(catalog: &Catalog, storage: &dyn Storage) -> Result<Self, ArchiveError> {
        let mark = Mark::read(storage).await?;
        Ok(Self {
            catalog: catalog.identity().await?,
            storage: mark,
        })
    }

    /// Has the catalog know another archive's that takes its place.
    fn remember(&self, catalog: &Catalog) {
        match (&self.catalog, &self.storage) {
            (Some(identity), _) | (None, Mark::Whole(identity)) => catalog.belongs_to(identity),
            (None, Mark::None | Mark::Damaged) => {}
        }
    }

    /// Whether they belong together; `None` if they do not say.
    fn agree(&self) -> Option<bool> {
        match (&self.catalog, &self.storage) {
            (Some(one), Mark::Whole(other)) => Some(one == other),
            _ => None,
        }
    }
}

/// Refuses parts of different archives; what those of one say of themselves.
async fn meet(
    catalog: &Catalog,
    storage: &dyn Storage,
    location: &ArchiveLocation,
) -> Result<Parts, ArchiveError> {
    let parts = Parts::read(catalog, storage).await?;
    match parts.agree() {
        Some(true) => return Ok(parts),
        Some(false) => return Err(strangers(location)),
        None => {}
    }
    let named = catalog.some_pyramids().await?;
    if named.is_empty() {
        if parts.storage == Mark::Damaged {
            return Err(ArchiveError::Identity {
                storage: location.storage().clone(),
                catalog: location.catalog().clone(),
            });
        }
        let unused = catalog.volumes().await?.is_empty();
        if unused && storage.holds_any(PYRAMIDS).await? {
            // Unless another process has made the archive meanwhile.
            let now = Parts::read(catalog, storage).await?;
            return match now.agree() {
                Some(true) => Ok(now),
                _ => Err(unnamed(location)),
            };
        }
        return Ok(parts);
    }
    match holds_one(storage, &named).await? {
        true => Ok(parts),
        false => Err(strangers(location)),
    }
}

/// Refuses parts of different archives, and changes nothing.
pub(super) async fn refuse_strangers(
    catalog: &Catalog,
    storage: &dyn Storage,
    location: &ArchiveLocation,
) -> Result<(), ArchiveError> {
    meet(catalog, storage, location).await.map(|_| ())
}

/// Refuses parts of different archives.
pub(super) async fn check(
    catalog: &Catalog,
    storage: &dyn Storage,
    location: &ArchiveLocation,
) -> Result<(), ArchiveError> {
    let parts = meet(catalog, storage, location).await?;
    parts.remember(catalog);
    if parts.storage == Mark::Damaged {
        log::warn!(
            "the object {IDENTITY:?} of {} is damaged; the next `saccade ingest` into it writes it anew",
            location.storage()
        );
    }
    Ok(())
}

/// Refuses parts of different archives, and gives those of one archive its identity if they have none yet.
pub(super) async fn make(
    catalog: &Catalog,
    storage: &dyn Storage,
    location: &ArchiveLocation,
    randomness: &dyn Randomness,
) -> Result<(), ArchiveError> {
    let parts = meet(catalog, storage, location).await?;
    if parts.agree().is_some() {
        parts.remember(catalog);
        return Ok(());
    }
    let there = match parts.storage {
        Mark::None => created(parts.catalog.clone(), storage, randomness).await?,
        there => there,
    };
    let identity = match &there {
        Mark::Whole(there) => catalog.give_identity(there).await?,
        Mark::None | Mark::Damaged => {
            log::warn!(
                "the object {IDENTITY:?} of {} was damaged, and is written anew: pyramids that its catalog names \
                 are there",
                location.storage()
            );
            // The catalog decides, where several processes do this at once.
            let proposed = parts.catalog.unwrap_or_else(|| random(randomness));
            let identity = catalog.give_identity(&proposed).await?;
            storage.write_durable(IDENTITY, line(&identity)).await?;
            identity
        }
    };
    catalog.belongs_to(&identity);
    match there {
        Mark::Whole(there) if there != identity => Err(strangers(location)),
        _ => Ok(()),
    }
}

/// What a storage has as its identity, which it gets if it has none: its catalog's, or one that is drawn. The catalog is left
/// as it is.
pub(super) async fn own(
    catalog: &Catalog,
    storage: &dyn Storage,
    randomness: &dyn Randomness,
) -> Result<Option<String>, ArchiveError> {
    let parts = Parts::read(catalog, storage).await?;
    let mark = match parts.storage {
        Mark::None => created(parts.catalog, storage, randomness).await?,
        mark => mark,
    };
    Ok(match mark {
        Mark::Whole(identity) => Some(identity),
        Mark::None | Mark::Damaged => None,
    })
}

/// Whether the storage is still that of the archive that was opened. One that was emptied before its catalog named any pyramid is
/// given the identity again, as is one that has lost nothing else.
pub(super) async fn still_belongs(
    catalog: &Catalog,
    storage: &dyn Storage,
    randomness: &dyn Randomness,
) -> Result<bool, ArchiveError> {
    let Some(own) = catalog.owner() else {
        return Ok(true);
    };
    let mark = match Mark::read(storage).await {
        // It was there when the archive was opened.
        Err(error) if error.lacks_bucket() => return Ok(false),
        mark => mark?,
    };
    match mark {
        Mark::Whole(there) => return Ok(there == own),
        // The next `saccade ingest` writes it anew.
        Mark::Damaged => return Ok(true),
        Mark::None => {}
    }
    let named = catalog.some_pyramids().await?;
    if !named.is_empty() && !holds_one(storage, &named).await? {
        return Ok(false);
    }
    let there = created(Some(own.to_owned()), storage, randomness).await?;
    Ok(there == Mark::Whole(own.to_owned()))
}

/// Whether one at least of these pyramids is there.
async fn holds_one(storage: &dyn Storage, named: &[String]) -> Result<bool, StorageError> {
    for name in named {
        match storage.size(name).await {
            Ok(_) => return Ok(true),
            Err(StorageError::NotFound { .. }) => {}
            Err(error) => return Err(error),
        }
    }
    Ok(false)
}

/// Gives an identity to a storage that has none; what it has then may be another's who did so at the same time.
async fn created(
    proposed: Option<String>,
    storage: &dyn Storage,
    randomness: &dyn Randomness,
) -> Result<Mark, StorageError> {
    let proposed = proposed.unwrap_or_else(|| random(randomness));
    let there = storage.create_durable(IDENTITY, line(&proposed)).await?;
    Ok(Mark::of(&there))
}

/// What [`IDENTITY`] holds.
fn line(identity: &str) -> Bytes {
    Bytes::from(format!("{identity}\n"))
}

/// Refuses a place that holds pyramids, but whose catalog is a file that is not there: before one is made, or what
/// is wrong is said in other words.
pub(super) async fn refuse_without_catalog(location: &ArchiveLocation) -> Result<(), ArchiveError> {
    let CatalogLocation::File(file) = location.catalog() else {
        return Ok(());
    };
    // Opening a folder makes it.
    let folder = location.folder().map(|folder| folder.join(PYRAMIDS));
    if file.exists() || folder.is_some_and(|folder| !folder.is_dir()) {
        return Ok(());
    }
    let storage = location.storage().open().await?;
    // Another process makes its catalog first, and then pyramids.
    if storage.holds_any(PYRAMIDS).await? && !file.exists() {
        return Err(unnamed(location));
    }
    Ok(())
}

fn strangers(location: &ArchiveLocation) -> ArchiveError {
    ArchiveError::Strangers {
        storage: location.storage().clone(),
        catalog: location.catalog().clone(),
    }
}

fn unnamed(location: &ArchiveLocation) -> ArchiveError {
    ArchiveError::Unnamed {
        storage: location.storage().clone(),
        catalog: location.catalog().clone(),
    }
}

#[cfg(test)]
mod tests {
    use std::ops::Range;
    use std::path::Path;
    use std::sync::Arc;

    use futures::FutureExt as _;
    use futures::future::BoxFuture;
    use glam::{DVec2, DVec3, UVec2, UVec3};
    use saccade_core::transform::SectionFromTile;
    use saccade_core::volume::Volume;

    use super::*;
    use crate::VisualizationArchive;
    use crate::catalog::NewTile;
    use crate::randomness::SystemRandomness;
    use crate::storage::{Entry, LocalStorage, MemoryStorage};

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

    async fn mark(storage: &dyn Storage) -> Mark {
        match storage.read(IDENTITY, None).await {
            Ok(bytes) => Mark::of(&bytes),
            Err(_) => Mark::None,
        }
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
            // Who writes leaves them alone.
            assert!(is_refused(VisualizationArchive::open(&mixed).await));
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

    /// As where the disk is not mounted on which the pyramids lie.
    #[tokio::test]
    async fn a_folder_that_is_not_there_is_not_made_for_a_catalog_that_knows_pyramids() {
        let folder = tempfile::tempdir().unwrap();
        let (one, mount) = (folder.path().join("one"), folder.path().join("mount"));
        made(&one, false).await;
        std::fs::create_dir(&mount).unwrap();
        let places = [
            (mount.clone(), "Is the disk mounted"),
            (mount.join("archive"), "mount its disk"),
        ];
        for (place, advice) in places {
            let location = crossed(&one, &place);
            for opened in [
                VisualizationArchive::open(&location).await,
                VisualizationArchive::create(&location).await,
            ] {
                let told = opened.map(drop).unwrap_err().to_string();
                assert!(told.contains(advice), "{told}");
                let left: Vec<_> = std::fs::read_dir(&mount).unwrap().collect();
                assert!(left.is_empty(), "{left:?}");
            }
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
        assert_eq!(mark(&**storage).await, Mark::Whole(identity.clone()));
        // The other way round: one that the cache on disk made, of an archive that had none.
        catalog.forget_identity().await.unwrap();
        assert!(!is_refused(
            VisualizationArchive::create(folder.path()).await
        ));
        assert_eq!(catalog.identity().await.unwrap(), Some(identity));
    }

    /// Both ways to open it, with the catalog's file before and after.
    async fn both_refuse(location: &ArchiveLocation, refused: impl Fn(&ArchiveError) -> bool) {
        let CatalogLocation::File(file) = location.catalog() else {
            panic!("a file")
        };
        let there = file.exists();
        for opened in [
            VisualizationArchive::open(location).await,
            VisualizationArchive::create(location).await,
        ] {
            let error = opened.map(drop).unwrap_err();
            assert!(refused(&error), "{error}");
            let told = error.to_string();
            for part in [location.storage().to_string(), file.display().to_string()] {
                assert!(told.contains(&part), "{part:?} is not in: {told}");
            }
            assert_eq!(file.exists(), there, "nothing is left behind");
        }
    }

    #[tokio::test]
    async fn a_catalog_that_names_nothing_is_not_that_of_pyramids() {
        for old in [false, true] {
            let folder = tempfile::tempdir().unwrap();
            let one = folder.path().join("one");
            made(&one, old).await;
            let unnamed = |error: &ArchiveError| matches!(error, ArchiveError::Unnamed { .. });
            // Not there yet, made and empty, and lost.
            both_refuse(&crossed(&folder.path().join("fresh"), &one), unnamed).await;
            let empty = folder.path().join("empty");
            let file = empty.join(VisualizationArchive::CATALOG);
            std::fs::create_dir(&empty).unwrap();
            Catalog::create(&file).await.unwrap().close().await;
            both_refuse(&crossed(&empty, &one), unnamed).await;
            let own = one.join(VisualizationArchive::CATALOG);
            let kept = folder.path().join("kept");
            std::fs::rename(&own, &kept).unwrap();
            both_refuse(&ArchiveLocation::from(&one), unnamed).await;
            // Its copy is as good as it was; and where there are no pyramids, anything may begin.
            std::fs::rename(&kept, &own).unwrap();
            assert!(!is_refused(VisualizationArchive::create(&one).await));
            let storage = LocalStorage::new(&one).unwrap();
            storage.delete("tiles/one").await.unwrap();
            let begun = VisualizationArchive::create(&crossed(&empty, &one)).await;
            assert!(!is_refused(begun));
        }
    }

    #[tokio::test]
    async fn another_catalog_with_a_volume_and_no_tiles_is_not_empty() {
        let folder = tempfile::tempdir().unwrap();
        let archive = VisualizationArchive::create(folder.path()).await.unwrap();
        let volume = Volume::new("v", UVec3::ONE, DVec3::ONE).unwrap();
        archive.catalog().create_volume(&volume).await.unwrap();
        // As of an earlier version, which was killed before it entered its first pyramid.
        let (catalog, storage) = (archive.catalog(), archive.storage());
        storage
            .write_durable("tiles/v/a", Bytes::from_static(b"x"))
            .await
            .unwrap();
        storage.delete(IDENTITY).await.unwrap();
        catalog.forget_identity().await.unwrap();
        assert!(!is_refused(VisualizationArchive::open(folder.path()).await));
        assert!(!is_refused(
            VisualizationArchive::create(folder.path()).await
        ));
    }

    #[tokio::test]
    async fn a_damaged_identity_is_mended_where_pyramids_are_known() {
        let whole = format!("{}\n", random(&SystemRandomness));
        for damaged in [
            "",
            "\n",
            &whole[..20],
            "not one of ours at all, but long",
            "\0\0",
        ] {
            let folder = tempfile::tempdir().unwrap();
            let (one, other) = (folder.path().join("one"), folder.path().join("other"));
            made(&one, false).await;
            made(&other, false).await;
            let identity = |of: &Path| std::fs::read_to_string(of.join(IDENTITY)).unwrap();
            let before = identity(&one);
            std::fs::write(one.join(IDENTITY), damaged).unwrap();
            // Who only reads changes nothing.
            assert!(!is_refused(VisualizationArchive::open(&one).await));
            assert_eq!(identity(&one), damaged);
            // It is still no other's.
            for opened in [
                VisualizationArchive::open(&crossed(&other, &one)).await,
                VisualizationArchive::create(&crossed(&other, &one)).await,
            ] {
                assert!(is_refused(opened));
                assert_eq!(identity(&one), damaged);
            }
            assert!(!is_refused(VisualizationArchive::create(&one).await));
            assert_eq!(identity(&one), before);
            // Where nothing tells whose it is, it is told as what it is, and left alone.
            let empty = folder.path().join("empty");
            VisualizationArchive::create(&empty).await.unwrap();
            std::fs::write(empty.join(IDENTITY), damaged).unwrap();
            let told = |error: &ArchiveError| {
                matches!(error, ArchiveError::Identity { .. })
                    && error.to_string().contains("damaged")
            };
            both_refuse(&ArchiveLocation::from(&empty), told).await;
            assert_eq!(identity(&empty), damaged);
            std::fs::remove_file(empty.join(IDENTITY)).unwrap();
            assert!(!is_refused(VisualizationArchive::create(&empty).await));
        }
    }

    /// Another process is always a little quicker to give it an identity.
    #[derive(Debug)]
    struct Contested(MemoryStorage, String);

    impl Contested {
        fn new() -> Self {
            Self(MemoryStorage::new(), random(&SystemRandomness))
        }

        async fn lose(&self, name: &str) {
            if name == IDENTITY {
                let theirs = self.0.create_durable(IDENTITY, line(&self.1));
                theirs.await.unwrap();
            }
        }
    }

    impl Storage for Contested {
        fn read<'a>(
            &'a self,
            name: &'a str,
            range: Option<Range<u64>>,
        ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
            self.0.read(name, range)
        }

        fn write_durable<'a>(
            &'a self,
            name: &'a str,
            bytes: Bytes,
        ) -> BoxFuture<'a, Result<(), StorageError>> {
            async move {
                self.lose(name).await;
                self.0.write_durable(name, bytes).await
            }
            .boxed()
        }

        fn create_durable<'a>(
            &'a self,
            name: &'a str,
            bytes: Bytes,
        ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
            async move {
                self.lose(name).await;
                self.0.create_durable(name, bytes).await
            }
            .boxed()
        }

        fn entries<'a>(
            &'a self,
            prefix: &'a str,
        ) -> BoxFuture<'a, Result<Vec<Entry>, StorageError>> {
            self.0.entries(prefix)
        }

        fn delete<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<(), StorageError>> {
            self.0.delete(name)
        }

        fn size<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<u64, StorageError>> {
            self.0.size(name)
        }
    }

    /// Who only reads an archive of an earlier version gives it one as well.
    #[tokio::test]
    async fn of_two_that_give_an_identity_one_counts_for_both() {
        for writes in [true, false] {
            let folder = tempfile::tempdir().unwrap();
            let location = ArchiveLocation::from(folder.path());
            let catalog = Catalog::create(location.catalog()).await.unwrap();
            let storage = Arc::new(Contested::new());
            let archive = VisualizationArchive::from_parts(catalog, storage.clone());
            let theirs = Some(storage.1.clone());
            if writes {
                archive.identify(&location).await.unwrap();
                assert_eq!(archive.catalog().identity().await.unwrap(), theirs);
            }
            assert_eq!(archive.own_identity().await.unwrap(), theirs);
            assert_eq!(mark(&*storage).await, Mark::Whole(storage.1.clone()));
            archive.identify(&location).await.unwrap();
        }
    }

    /// An earlier version gave it to the catalog first, and may have been killed in between.
    #[tokio::test]
    async fn a_storage_without_identity_gets_its_catalogs() {
        let folder = tempfile::tempdir().unwrap();
        let one = folder.path().join("one");
        made(&one, false).await;
        let archive = VisualizationArchive::open(&one).await.unwrap();
        let (catalog, storage) = (archive.catalog(), archive.storage());
        let identity = catalog.identity().await.unwrap();
        storage.delete(IDENTITY).await.unwrap();
        assert_eq!(archive.own_identity().await.unwrap(), identity);
        assert!(!is_refused(VisualizationArchive::create(&one).await));
        // A damaged one tells nothing, and is left as it is.
        let damaged = Bytes::from_static(b"half of o");
        storage
            .write_durable(IDENTITY, damaged.clone())
            .await
            .unwrap();
        assert_eq!(archive.own_identity().await.unwrap(), None);
        assert_eq!(storage.read(IDENTITY, None).await.unwrap(), damaged);
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
