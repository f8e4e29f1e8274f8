//! A file that loses its place while it is open: those who read go on with what comes to its place.

use std::fs::Metadata;
use std::path::Path;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::{Acquire, Release};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

use sqlx::SqlitePool;

use super::{Access, FileId, Opened, open_again};
use crate::catalog::CatalogError;

/// Looks at a file in the place of the open one that must find it unchanged, before it is opened: it may still be copied.
const AT_REST: u32 = 3;

/// A file of SQLite's is not less \[bytes\].
const SMALLEST: u64 = 512;

/// What took the place of an open file.
#[derive(Debug, Default)]
pub(in crate::catalog) struct Replaced {
    newer: Mutex<Option<Box<Opened>>>,
    /// Times that another file was opened.
    times: AtomicU64,
    away: Mutex<Option<Away>>,
    coming: Mutex<Coming>,
}

/// There is nothing to read.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(in crate::catalog) struct Away {
    /// Why what has the place cannot be read, if there is something.
    pub(in crate::catalog) why: Option<String>,
}

/// A file that has come to the place of the open one, and for how many looks it has been as it is.
#[derive(Debug, Default)]
struct Coming {
    look: Option<(FileId, u64, SystemTime)>,
    looks: u32,
}

/// Which file has the name of the open one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::catalog) enum Place {
    /// The open one.
    Same,
    /// None, or one that is still being written.
    Nobody,
    /// Another.
    Another,
}

impl Opened {
    /// Connections to the file that is to be read.
    pub(in crate::catalog) fn readers(&self) -> SqlitePool {
        let newer = lock(&self.replaced.newer);
        newer
            .as_ref()
            .map_or(&self.readers, |newer| &newer.readers)
            .clone()
    }

    /// What may be done with the file that is to be read.
    pub(in crate::catalog) fn reading(&self) -> Access {
        let newer = lock(&self.replaced.newer);
        newer.as_ref().map_or(self.access, |newer| newer.access)
    }

    /// Times that another file took the place of the open one, and is read since.
    pub(in crate::catalog) fn times_replaced(&self) -> u64 {
        self.replaced.times.load(Acquire)
    }

    /// Whether nothing can be read.
    pub(in crate::catalog) fn away(&self) -> Option<Away> {
        lock(&self.replaced.away).clone()
    }

    /// Lets nothing be read, or all again. Whether that is news.
    pub(in crate::catalog) fn set_away(&self, away: Option<Away>) -> bool {
        let mut known = lock(&self.replaced.away);
        let is_news = *known != away;
        *known = away;
        is_news
    }

    /// The file that is read.
    fn read_id(&self) -> Option<FileId> {
        let newer = lock(&self.replaced.newer);
        newer.as_ref().map_or(self.id, |newer| newer.id)
    }

    /// Whether nothing, or something else, has the name of the file that is read: also before that is said to be away.
    pub(in crate::catalog) fn is_away(&self) -> bool {
        let found = FileId::of(&self.path);
        match (self.read_id(), found) {
            (Some(read), Ok(found)) => read != found,
            (Some(_), Err(e)) => e.kind() == std::io::ErrorKind::NotFound,
            (None, _) => false,
        }
    }

    /// Looks which file has its name.
    pub(in crate::catalog) fn place(&self) -> Place {
        let (Some(open), found) = (self.read_id(), look(&self.path)) else {
            return Place::Same;
        };
        let found = match found {
            Ok(found) => found,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => None,
            // A disk that cannot be asked tells by itself.
            Err(_) => return Place::Same,
        };
        let mut coming = lock(&self.replaced.coming);
        if found.is_some_and(|(id, ..)| id == open) {
            *coming = Coming::default();
            return Place::Same;
        }
        if coming.look != found {
            *coming = Coming {
                look: found,
                looks: 0,
            };
        }
        coming.looks = coming.looks.saturating_add(1);
        match found {
            Some((_, bytes, _)) if bytes >= SMALLEST && coming.looks > AT_REST => Place::Another,
            _ => Place::Nobody,
        }
    }

    /// Opens what has its name now, for reading. Nothing can be written by this one from then on.
    pub(in crate::catalog) async fn open_again(&self) -> Result<(), CatalogError> {
        // First all are closed: SQLite takes what lies beside a file for that of any of its name.
        self.close_connections().await;
        let newer = open_again(&self.path).await?;
        if self.is_closed() {
            newer.readers.close().await;
        }
        *lock(&self.replaced.newer) = Some(Box::new(newer));
        self.forget();
        self.replaced.times.fetch_add(1, Release);
        Ok(())
    }
}

/// What a file looks like; `None` if the system does not tell files from one another.
fn look(path: &Path) -> std::io::Result<Option<(FileId, u64, SystemTime)>> {
    let id = FileId::of(path)?;
    let meta: Metadata = std::fs::metadata(path)?;
    Ok(Some((id, meta.len(), meta.modified()?)))
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;
    use std::time::Duration;

    use glam::{DVec3, UVec2, UVec3};
    use saccade_core::transform::SectionFromTile;
    use saccade_core::volume::Volume;
    use sqlx::ConnectOptions as _;

    use super::super::options;
    use super::*;
    use crate::catalog::database::Database;
    use crate::catalog::{Catalog, NewTile};

    const SOON: Duration = Duration::from_secs(20);

    /// A catalog with so many tiles.
    async fn with_tiles(path: &Path, count: u32) -> Catalog {
        let catalog = Catalog::create(path).await.unwrap();
        let volume = Volume::new("v", UVec3::new(64, 64, 4), DVec3::ONE).unwrap();
        catalog.create_volume(&volume).await.unwrap();
        for n in 0..count {
            let name = n.to_string();
            let tile = NewTile {
                pyramid: format!("{name}.tif"),
                name,
                section: 0,
                channel: 0,
                size: UVec2::splat(8),
                transform: SectionFromTile::IDENTITY,
                position: n.into(),
            };
            catalog.commit_tile("v", &tile).await.unwrap();
        }
        catalog
    }

    fn files(path: &Path) -> [PathBuf; 3] {
        let of = |end: &str| PathBuf::from(format!("{}{end}", path.display()));
        [path.to_owned(), of("-wal"), of("-shm")]
    }

    /// Nobody who opens it meanwhile finds the file without its log.
    fn rename(from: &Path, to: &Path) {
        let aside = to.with_extension("on-its-way");
        std::fs::rename(from, &aside).unwrap();
        for file in files(to) {
            let _what_there_is_of_them = std::fs::remove_file(file);
        }
        for (from, to) in files(from).iter().zip(files(to)).skip(1) {
            if from.exists() {
                std::fs::rename(from, to).unwrap();
            }
        }
        std::fs::rename(aside, to).unwrap();
    }

    async fn until<T>(mut is_so: impl AsyncFnMut() -> Option<T>) -> T {
        let wait = async {
            loop {
                if let Some(so) = is_so().await {
                    return so;
                }
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        tokio::time::timeout(SOON, wait).await.expect("in time")
    }

    async fn away(catalog: &Catalog) -> CatalogError {
        until(async || catalog.entry("v").await.err()).await
    }

    #[tokio::test]
    async fn who_reads_is_told_that_the_file_is_away_and_goes_on_with_what_comes_to_its_place() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("catalog.sqlite");
        let [aside, other] = ["aside", "other"].map(|name| folder.path().join(name));
        let catalog = with_tiles(&path, 3).await;
        with_tiles(&other, 1).await.close().await;
        let mut heard = catalog.subscribe("v").await.unwrap();
        heard.borrow_and_update();

        rename(&path, &aside);
        let error = away(&catalog).await;
        let said = error.to_string();
        assert!(
            matches!(error, CatalogError::Away { .. }) && error.is_transient(),
            "{said}"
        );
        assert!(
            said.contains("moved, deleted or replaced") && said.contains("put it back"),
            "{said}"
        );
        rename(&aside, &path);
        let tiles = async || catalog.entry("v").await.ok().map(|entry| entry.tiles);
        assert_eq!(until(tiles).await, 3);
        assert_eq!(catalog.times_replaced(), 0, "it is the same");
        catalog.delete_tile("v", "2", 9).await.unwrap();

        // Something else, and a file that is only beginning to be copied.
        rename(&path, &aside);
        std::fs::write(&path, vec![7; 4096]).unwrap();
        let error = until(async || {
            let error = catalog.entry("v").await.err()?;
            error
                .to_string()
                .contains("cannot be read")
                .then_some(error)
        });
        assert!(matches!(
            error.await,
            CatalogError::Away { why: Some(_), .. }
        ));
        std::fs::write(&path, "").unwrap();
        tokio::time::sleep(Duration::from_secs(1)).await;
        assert!(catalog.entry("v").await.is_err());
        assert_eq!(
            std::fs::metadata(&path).unwrap().len(),
            0,
            "nobody made a catalog of it"
        );

        heard.borrow_and_update();
        std::fs::copy(&other, &path).unwrap();
        assert_eq!(until(tiles).await, 1);
        assert_eq!(catalog.times_replaced(), 1);
        tokio::time::timeout(SOON, heard.wait_for(|revision| *revision == 1))
            .await
            .expect("subscribers wake, though the revision is less than it was")
            .unwrap();
        let refused = catalog.delete_tile("v", "0", 9).await.unwrap_err();
        assert!(matches!(refused, CatalogError::Moved { .. }), "{refused}");

        // Who writes there is followed.
        let writing = Catalog::open(path.as_path()).await.unwrap();
        writing.delete_tile("v", "0", 9).await.unwrap();
        tokio::time::timeout(SOON, heard.wait_for(|revision| *revision == 2))
            .await
            .expect("it is followed")
            .unwrap();
        assert_eq!(tiles().await, Some(0));
        // The first one comes back, in the place of the second.
        writing.close().await;
        rename(&aside, &path);
        until(async || tiles().await.filter(|&tiles| tiles == 2)).await;
    }

    /// Whoever needs a connection more finds no file, before anybody has looked for it.
    #[tokio::test]
    async fn who_asks_before_it_is_noticed_is_told_as_well() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("catalog.sqlite");
        let catalog = with_tiles(&path, 1).await;
        catalog.entry("v").await.unwrap();
        let Database::Sqlite(opened) = &catalog.inner.database else {
            unreachable!("a file");
        };
        // Others have all that are open.
        let readers = opened.readers();
        let mut held = Vec::new();
        while readers.num_idle() > 0 || held.is_empty() {
            held.push(readers.acquire().await.unwrap());
        }
        rename(&path, &folder.path().join("aside"));
        let error = catalog.entry("v").await.unwrap_err();
        assert!(
            matches!(error, CatalogError::Away { why: None, .. }),
            "{error:?}"
        );
    }

    /// Two catalogs of other archives.
    async fn of_two_archives(path: &Path, other: &Path) -> Catalog {
        let identities = ["a", "b"].map(|digit| digit.repeat(32));
        for ((path, count), identity) in [(path, 3), (other, 1)].into_iter().zip(&identities) {
            let catalog = with_tiles(path, count).await;
            catalog.give_identity(identity).await.unwrap();
            // Nothing is left in its log.
            catalog.close().await;
        }
        let catalog = Catalog::open(path).await.unwrap();
        catalog.belongs_to(&identities[0]);
        catalog.follow();
        catalog
    }

    async fn until_another(catalog: &Catalog) {
        let another = async || match catalog.entry("v").await {
            Ok(entry) => {
                assert_eq!(entry.tiles, 3, "the other's");
                None
            }
            Err(CatalogError::Another { .. }) => Some(()),
            Err(error) => {
                assert!(matches!(error, CatalogError::Away { .. }), "{error}");
                None
            }
        };
        until(another).await;
    }

    #[tokio::test]
    async fn another_archives_file_is_not_read_and_the_right_one_is_again() {
        let folder = tempfile::tempdir().unwrap();
        let [path, aside, other] =
            ["catalog.sqlite", "aside", "other"].map(|name| folder.path().join(name));
        let catalog = of_two_archives(&path, &other).await;
        rename(&path, &aside);
        std::fs::copy(&other, &path).unwrap();
        until_another(&catalog).await;
        let refused = catalog.delete_tile("v", "0", 9).await.unwrap_err();
        assert!(matches!(refused, CatalogError::Moved { .. }), "{refused}");
        for file in files(&path) {
            let _what_there_is_of_them = std::fs::remove_file(file);
        }
        rename(&aside, &path);
        let tiles = until(async || catalog.entry("v").await.ok().map(|entry| entry.tiles));
        assert_eq!(tiles.await, 3);
        assert!(catalog.times_replaced() > 0, "anything may be another");
    }

    #[tokio::test]
    async fn what_is_in_the_log_does_not_hide_whose_file_was_copied_over_the_open_one() {
        let folder = tempfile::tempdir().unwrap();
        let [path, other] = ["catalog.sqlite", "other"].map(|name| folder.path().join(name));
        of_two_archives(&path, &other).await.close().await;
        let identity = "c".repeat(32);
        let catalog = Catalog::open(path.as_path()).await.unwrap();
        let mut connection = options(&path, Access::Write).connect().await.unwrap();
        sqlx::query("UPDATE archive SET identity = $1")
            .bind(&identity)
            .execute(&mut connection)
            .await
            .unwrap();
        catalog.belongs_to(&identity);
        catalog.verify().await.unwrap();
        std::fs::copy(&other, &path).unwrap();
        let refused = catalog.delete_tile("v", "0", 9).await.unwrap_err();
        assert!(matches!(refused, CatalogError::Another { .. }), "{refused}");
    }

    /// A catalog that is followed, of which there is a copy, after which three tiles were deleted.
    async fn with_older_copy(path: &Path, copy: &Path) -> Catalog {
        let (first, other) = (copy.with_extension("first"), copy.with_extension("other"));
        of_two_archives(&first, &other).await.close().await;
        std::fs::copy(&first, path).unwrap();
        std::fs::copy(&first, copy).unwrap();
        let catalog = Catalog::open(path).await.unwrap();
        catalog.belongs_to(&"a".repeat(32));
        for tile in ["0", "1"] {
            catalog.delete_tile("v", tile, 9).await.unwrap();
        }
        // What others write, and move to the file, is the right one's.
        let another = Catalog::open(path).await.unwrap();
        another.delete_tile("v", "2", 9).await.unwrap();
        let mut connection = options(path, Access::Write).connect().await.unwrap();
        sqlx::query("PRAGMA wal_checkpoint(FULL)")
            .execute(&mut connection)
            .await
            .unwrap();
        let none = catalog.delete_tile("v", "2", 9).await;
        none.expect("nobody copied anything");
        catalog
    }

    #[tokio::test]
    async fn nothing_is_written_once_an_older_copy_is_over_the_open_file() {
        let folder = tempfile::tempdir().unwrap();
        let [path, copy] = ["catalog.sqlite", "copy"].map(|name| folder.path().join(name));
        let catalog = with_older_copy(&path, &copy).await;
        std::fs::copy(&copy, &path).unwrap();
        for _ in 0..2 {
            let refused = catalog.delete_tile("v", "0", 9).await.unwrap_err();
            assert!(matches!(refused, CatalogError::Older { .. }), "{refused}");
            assert!(!refused.is_transient() && !refused.is_outage());
        }
    }

    #[tokio::test]
    async fn who_reads_goes_on_with_an_older_copy() {
        let folder = tempfile::tempdir().unwrap();
        let [path, copy] = ["catalog.sqlite", "copy"].map(|name| folder.path().join(name));
        let catalog = with_older_copy(&path, &copy).await;
        let mut connection = options(&path, Access::Write).connect().await.unwrap();
        sqlx::query("PRAGMA wal_checkpoint(TRUNCATE)")
            .execute(&mut connection)
            .await
            .unwrap();
        catalog.follow();
        std::fs::copy(&copy, &path).unwrap();
        until(async || (catalog.times_replaced() == 1).then_some(())).await;
        let tiles = until(async || catalog.entry("v").await.ok().map(|entry| entry.tiles));
        assert_eq!(tiles.await, 3);
        let refused = catalog.delete_tile("v", "0", 9).await.unwrap_err();
        assert!(matches!(refused, CatalogError::Moved { .. }), "{refused}");
    }

    #[tokio::test]
    async fn a_file_that_is_copied_over_the_open_one_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let [path, copy, other] =
            ["catalog.sqlite", "copy", "other"].map(|name| folder.path().join(name));
        let catalog = of_two_archives(&path, &other).await;
        std::fs::copy(&path, &copy).unwrap();
        std::fs::copy(&other, &path).unwrap();
        let refused = catalog.delete_tile("v", "0", 9).await.unwrap_err();
        assert!(matches!(refused, CatalogError::Another { .. }), "{refused}");
        until_another(&catalog).await;
        std::fs::copy(&copy, &path).unwrap();
        let tiles = until(async || catalog.entry("v").await.ok().map(|entry| entry.tiles));
        assert_eq!(tiles.await, 3);
    }
}
