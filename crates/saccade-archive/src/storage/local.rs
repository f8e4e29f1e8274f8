use std::collections::BTreeSet;
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use futures::FutureExt as _;
use futures::future::BoxFuture;

use super::disk::{Disk, SystemDisk};
use super::{Entry, Storage, StorageError, check_name};

/// Where unfinished writes live, below the root. No object's name begins with a dot.
const INCOMING: &str = ".incoming";

/// How often a write begins whose temporary file someone has, or removes.
const WRITE_ATTEMPTS: u32 = 100;

/// Number of this process's next temporary file.
static NEXT: AtomicU64 = AtomicU64::new(0);

/// Objects as files below a folder, local or on a shared file system.
///
/// A write goes to a temporary file, which is synced, renamed to its name, and made permanent by
/// syncing the folder: one sync of each per object. Runs on tokio's threads for blocking work.
///
/// A sync that fails may have lost what was written, and the next one says nothing of it. After such a
/// failure, unless the disk was merely full, nothing more is written here
/// ([`StorageError::NotKept`]): reading goes on.
#[derive(Clone, Debug)]
pub struct LocalStorage(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    disk: Arc<dyn Disk>,
    root: PathBuf,
    /// Folders whose names are durable, as this process has seen to. Others may have been made by
    /// a process that died before it synced them.
    kept: Mutex<BTreeSet<PathBuf>>,
    /// Whether a sync has failed.
    stopped: AtomicBool,
}

/// What went wrong with a step of a write.
enum WriteError {
    Io(io::Error),
    Sync(io::Error),
}

impl From<io::Error> for WriteError {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl LocalStorage {
    /// Opens the folder, which is created if need be, and removes what crashed writers left.
    ///
    /// Other processes may be writing to the same folder: theirs is left alone. A folder that may
    /// only be read is opened, too; writes are then denied.
    ///
    /// # Errors
    ///
    /// [`StorageError`] if the folder cannot be created or listed.
    pub fn new(root: impl Into<PathBuf>) -> Result<Self, StorageError> {
        Self::on(Arc::new(SystemDisk), root)
    }

    /// The same on another file system than the system's.
    ///
    /// # Errors
    ///
    /// As [`new`](Self::new).
    pub fn on(disk: Arc<dyn Disk>, root: impl Into<PathBuf>) -> Result<Self, StorageError> {
        let storage = Self(Arc::new(Inner {
            disk,
            root: root.into(),
            kept: Mutex::default(),
            stopped: AtomicBool::new(false),
        }));
        let inner = &*storage.0;
        let incoming = inner.root.join(INCOMING);
        let sort = |e| StorageError::new(e, INCOMING, incoming.display().to_string());
        match inner
            .prepare(&incoming)
            .map_err(|e| inner.sorted(e, INCOMING, &incoming))
        {
            Err(StorageError::Denied { .. }) if inner.disk.read_dir(&inner.root).is_ok() => {
                return Ok(storage);
            }
            prepared => prepared?,
        }
        for entry in inner.disk.read_dir(&incoming).map_err(sort)? {
            let path = incoming.join(entry.name);
            match inner.disk.remove_if_unlocked(&path) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => log::warn!(
                    "cannot remove an abandoned temporary file: {e}: {}",
                    path.display()
                ),
                Ok(()) | Err(_) => {}
            }
        }
        Ok(storage)
    }

    /// The folder.
    pub fn root(&self) -> &Path {
        &self.0.root
    }

    /// Runs `work` with the object's path where it may block.
    fn blocking<T: Send + 'static>(
        &self,
        name: &str,
        work: impl FnOnce(&Inner, &Path) -> Result<T, WriteError> + Send + 'static,
    ) -> BoxFuture<'static, Result<T, StorageError>> {
        let (inner, name) = (self.0.clone(), name.to_owned());
        async move {
            check_name(&name)?;
            let path = inner.root.join(&name);
            let task = tokio::task::spawn_blocking(move || {
                let result = work(&inner, &path);
                result.map_err(|e| inner.sorted(e, &name, &path))
            });
            task.await.unwrap_or_else(|e| {
                let (source, path) = (io::Error::other(e), String::new());
                Err(StorageError::Io { source, path })
            })
        }
        .boxed()
    }

    /// Objects whose names begin with `prefix`, at most so many, sorted by name.
    fn list_some(
        &self,
        prefix: &str,
        most: usize,
    ) -> BoxFuture<'static, Result<Vec<Entry>, StorageError>> {
        let (inner, prefix) = (self.0.clone(), prefix.to_owned());
        async move {
            let task = tokio::task::spawn_blocking(move || {
                let mut found: Vec<Entry> = Vec::new();
                let failed = |e| StorageError::new(e, &prefix, inner.root.display().to_string());
                inner
                    .walk(&inner.root, "", &prefix, most, &mut found)
                    .map_err(failed)?;
                found.sort_unstable_by(|a, b| a.name.cmp(&b.name));
                Ok(found)
            });
            task.await.unwrap_or_else(|e| {
                let (source, path) = (io::Error::other(e), String::new());
                Err(StorageError::Io { source, path })
            })
        }
        .boxed()
    }
}

impl Inner {
    fn sorted(&self, error: WriteError, name: &str, path: &Path) -> StorageError {
        let path = path.display().to_string();
        match error {
            WriteError::Io(e) => StorageError::new(e, name, path),
            WriteError::Sync(e) => match StorageError::new(e, name, path) {
                // Everything is written anew once there is space.
                full @ StorageError::Full { .. } => full,
                StorageError::Denied { source, path } | StorageError::Io { source, path } => {
                    self.stopped.store(true, Ordering::SeqCst);
                    StorageError::NotKept { source, path }
                }
                other => other,
            },
        }
    }

    fn write(&self, path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
        if self.stopped.load(Ordering::SeqCst) {
            let stopped = io::Error::other("an earlier sync failed, and nothing more is written");
            return Err(WriteError::Sync(stopped));
        }
        let parent = path.parent().unwrap_or(&self.root);
        let incoming = self.root.join(INCOMING);
        for _ in 1..WRITE_ATTEMPTS {
            let prepared = self.prepare(&incoming).and_then(|()| self.prepare(parent));
            match prepared.and_then(|()| self.write_once(path, bytes)) {
                Ok(()) => return self.disk.sync_dir(parent).map_err(WriteError::Sync),
                // Another process cleaned up between this one's creating and locking the file, or
                // someone emptied the whole folder.
                Err(WriteError::Io(e)) if e.kind() == io::ErrorKind::NotFound => {
                    self.kept().clear();
                }
                // A process of the same number, on another machine or before this one.
                Err(WriteError::Io(e)) if e.kind() == io::ErrorKind::AlreadyExists => {}
                Err(e) => return Err(e),
            }
        }
        Err(io::Error::other("other writers keep interfering").into())
    }

    fn write_once(&self, path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let temporary = self
            .root
            .join(INCOMING)
            .join(format!("{}-{number}", std::process::id()));
        let mut file = self.disk.create_new(&temporary)?;
        // Tells a cleaner that the writer lives. Where locks do not exist, cleaners get none.
        file.lock();
        let mut write = || {
            file.write_all(bytes)?;
            file.sync().map_err(WriteError::Sync)?;
            Ok(self.disk.rename(&temporary, path)?)
        };
        write().inspect_err(|_| {
            // Without this a full disk would stay full; a failure here changes nothing.
            let _ = self.disk.remove_file(&temporary);
        })
    }

    /// Sees to it that a folder is there, and those above it down from the root, each entered
    /// durably in the one that holds it. Whoever made it may have died, or still be about to.
    fn prepare(&self, path: &Path) -> Result<(), WriteError> {
        if path.as_os_str().is_empty() || self.kept().contains(path) {
            return Ok(());
        }
        let exists = self.disk.metadata(path).is_ok_and(|m| m.is_dir);
        let above_root = !path.starts_with(&self.root) || path == self.root;
        if exists && above_root {
            return Ok(());
        }
        let parent = path
            .parent()
            .filter(|p| !p.as_os_str().is_empty())
            .unwrap_or(Path::new("."));
        self.prepare(parent)?;
        if !exists {
            match self.disk.create_dir(path) {
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {}
                made => made?,
            }
            if !self.disk.metadata(path)?.is_dir {
                return Err(io::Error::from(io::ErrorKind::NotADirectory).into());
            }
        }
        self.disk.sync_dir(parent).map_err(WriteError::Sync)?;
        self.kept().insert(path.to_owned());
        Ok(())
    }

    fn kept(&self) -> std::sync::MutexGuard<'_, BTreeSet<PathBuf>> {
        // Every change is a single insertion or a clearing: whole even after a panic.
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds the files below `dir` to `found`, until there are so many; `at` is the folder's own name with a
    /// slash.
    fn walk(
        &self,
        dir: &Path,
        at: &str,
        prefix: &str,
        most: usize,
        found: &mut Vec<Entry>,
    ) -> io::Result<()> {
        let gone = |e: &io::Error| e.kind() == io::ErrorKind::NotFound;
        let entries = match self.disk.read_dir(dir) {
            // Removed since its parent was read.
            Err(e) if gone(&e) && !at.is_empty() => return Ok(()),
            entries => entries?,
        };
        for entry in entries {
            if found.len() >= most {
                break;
            }
            let path = dir.join(&entry.name);
            let Ok(part) = entry.name.into_string() else {
                continue;
            };
            let name = format!("{at}{part}");
            if part.starts_with('.') {
                continue;
            }
            if entry.is_dir {
                let below = name + "/";
                if below.starts_with(prefix) || prefix.starts_with(&below) {
                    self.walk(&path, &below, prefix, most, found)?;
                }
            } else if name.starts_with(prefix) {
                let metadata = match self.disk.metadata(&path) {
                    Err(e) if gone(&e) => continue,
                    metadata => metadata?,
                };
                found.push(Entry {
                    name,
                    size: metadata.len,
                    modified: metadata.modified,
                });
            }
        }
        Ok(())
    }
}

impl Storage for LocalStorage {
    fn read<'a>(
        &'a self,
        name: &'a str,
        range: Option<Range<u64>>,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        self.blocking(name, |inner, path| Ok(inner.disk.read(path, range)?))
    }

    fn write_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<(), StorageError>> {
        self.blocking(name, move |inner, path| inner.write(path, &bytes))
    }

    fn entries<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<Vec<Entry>, StorageError>> {
        self.list_some(prefix, usize::MAX)
    }

    fn holds_any<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<bool, StorageError>> {
        async move { Ok(!self.list_some(prefix, 1).await?.is_empty()) }.boxed()
    }

    fn delete<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<(), StorageError>> {
        self.blocking(name, |inner, path| match inner.disk.remove_file(path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
            Err(e) => Err(e.into()),
            Ok(()) => {
                let parent = path.parent().unwrap_or(&inner.root);
                inner.disk.sync_dir(parent).map_err(WriteError::Sync)
            }
        })
    }

    fn size<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<u64, StorageError>> {
        self.blocking(name, |inner, path| Ok(inner.disk.metadata(path)?.len))
    }
}

#[cfg(test)]
mod tests {
    use std::fs::{self, File};

    use super::super::SimulatedDisk;
    use super::*;

    #[tokio::test]
    async fn conforms() {
        let dir = tempfile::tempdir().unwrap();
        let storage = LocalStorage::new(dir.path().join("deep/root")).unwrap();
        super::super::conformance::check(Arc::new(storage)).await;
    }

    #[tokio::test]
    async fn a_folder_in_the_place_of_a_file_is_said_to_be_one() {
        let dir = tempfile::tempdir().unwrap();
        let storage = LocalStorage::new(dir.path()).unwrap();
        fs::create_dir_all(dir.path().join("tiles/a.tif/inside")).unwrap();
        let write = storage.write_durable("tiles/a.tif", Bytes::from_static(b"x"));
        let refused = write.await.unwrap_err();
        assert!(
            matches!(refused, StorageError::Occupied { .. }),
            "{refused}"
        );
        assert!(!refused.is_transient());
        assert!(refused.to_string().contains("tiles/a.tif"), "{refused}");
        assert_eq!(fs::read_dir(dir.path().join(INCOMING)).unwrap().count(), 0);
    }

    #[tokio::test]
    async fn conforms_on_a_simulated_disk() {
        let storage = LocalStorage::on(Arc::new(SimulatedDisk::new()), "deep/root").unwrap();
        super::super::conformance::check(Arc::new(storage)).await;
    }

    /// Whichever sync fails: nothing that was acknowledged is lost, and the storage says why it stops.
    #[tokio::test]
    async fn after_a_failed_sync_nothing_more_is_written() {
        let mut stopped = 0;
        for nth in 0..20 {
            let disk = SimulatedDisk::new();
            let storage = LocalStorage::on(Arc::new(disk.clone()), "root").unwrap();
            disk.fail_sync_at(nth);
            let mut acknowledged = Vec::new();
            let mut failed = None;
            for name in ["tiles/a", "tiles/b", "tiles/c/d", "tiles/a"] {
                match storage
                    .write_durable(name, Bytes::from_static(b"abc"))
                    .await
                {
                    Ok(()) => acknowledged.push(name),
                    Err(e) => failed = failed.or(Some(e)),
                }
            }
            let Some(error) = failed else {
                assert_eq!(acknowledged.len(), 4);
                continue;
            };
            stopped += 1;
            assert!(matches!(error, StorageError::NotKept { .. }), "{error:?}");
            assert!(!error.is_transient());
            let again = storage.write_durable("e", Bytes::new()).await;
            assert!(
                matches!(again, Err(StorageError::NotKept { .. })),
                "{again:?}"
            );
            for seed in 0..20 {
                let left = disk.after_crash(&mut super::super::Crash::new(seed));
                let left = LocalStorage::on(Arc::new(left), "root").unwrap();
                for name in &acknowledged {
                    let read = left.read(name, None).await.unwrap();
                    assert_eq!(read, b"abc"[..], "{name}, sync {nth}, seed {seed}");
                }
            }
        }
        assert!(stopped > 5, "only {stopped} syncs failed");
    }

    /// Its maker died before it was entered durably in the folder above.
    #[tokio::test]
    async fn folders_that_others_made_are_made_durable() {
        let disk = SimulatedDisk::new();
        let storage = LocalStorage::on(Arc::new(disk.clone()), "root").unwrap();
        disk.create_dir(Path::new("root/tiles")).unwrap();
        disk.create_dir(Path::new("root/tiles/v")).unwrap();
        storage
            .write_durable("tiles/v/a", Bytes::from_static(b"abc"))
            .await
            .unwrap();
        for seed in 0..50 {
            let left = disk.after_crash(&mut super::super::Crash::new(seed));
            let read = left.read(Path::new("root/tiles/v/a"), None).unwrap();
            assert_eq!(read, b"abc"[..]);
        }
    }

    #[tokio::test]
    async fn abandoned_temporaries_go_and_living_ones_stay() {
        let dir = tempfile::tempdir().unwrap();
        let incoming = dir.path().join(INCOMING);
        fs::create_dir_all(&incoming).unwrap();
        fs::write(incoming.join("1-0"), b"half a til").unwrap();
        let living = File::create(incoming.join("2-0")).unwrap();
        living.lock().unwrap();
        let storage = LocalStorage::new(dir.path()).unwrap();
        assert!(!incoming.join("1-0").exists());
        assert!(incoming.join("2-0").exists());
        assert!(storage.list("").await.unwrap().is_empty());
    }

    #[tokio::test]
    async fn a_failed_write_leaves_nothing_behind() {
        let dir = tempfile::tempdir().unwrap();
        let storage = LocalStorage::new(dir.path()).unwrap();
        // A folder stands where the object should go: the rename fails, after the data is written.
        fs::create_dir_all(dir.path().join("tiles/a.tif/x")).unwrap();
        assert!(
            storage
                .write_durable("tiles/a.tif", Bytes::from_static(b"abc"))
                .await
                .is_err()
        );
        assert_eq!(fs::read_dir(dir.path().join(INCOMING)).unwrap().count(), 0);
    }

    #[tokio::test]
    async fn temporaries_of_others_are_neither_touched_nor_in_the_way() {
        let dir = tempfile::tempdir().unwrap();
        let storage = LocalStorage::new(dir.path()).unwrap();
        let incoming = dir.path().join(INCOMING);
        // The same process number on another machine: the next names are all taken.
        let write = || storage.write_durable("a", Bytes::from_static(b"ours"));
        write().await.unwrap();
        let next = NEXT.load(Ordering::Relaxed);
        for number in next..next + 60 {
            fs::write(
                incoming.join(format!("{}-{number}", std::process::id())),
                b"theirs",
            )
            .unwrap();
        }
        write().await.unwrap();
        assert_eq!(storage.read("a", None).await.unwrap(), b"ours"[..]);
        for entry in fs::read_dir(&incoming).unwrap() {
            assert_eq!(fs::read(entry.unwrap().path()).unwrap(), b"theirs");
        }
    }

    #[tokio::test]
    async fn a_folder_emptied_by_someone_is_made_anew() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path().join("root");
        let storage = LocalStorage::new(&root).unwrap();
        fs::remove_dir_all(&root).unwrap();
        storage
            .write_durable("tiles/a", Bytes::from_static(b"abc"))
            .await
            .unwrap();
        assert_eq!(storage.list("").await.unwrap(), ["tiles/a"]);
    }

    #[tokio::test]
    async fn a_folder_that_is_a_file_cannot_be_opened() {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("file"), b"").unwrap();
        let error = LocalStorage::new(dir.path().join("file")).unwrap_err();
        assert!(error.to_string().contains("file/.incoming"), "{error}");
    }

    #[tokio::test]
    async fn what_is_forbidden_is_denied() {
        use std::os::unix::fs::PermissionsExt as _;
        let dir = tempfile::tempdir().unwrap();
        let storage = LocalStorage::new(dir.path()).unwrap();
        storage
            .write_durable("closed/a", Bytes::from_static(b"abc"))
            .await
            .unwrap();
        let closed = dir.path().join("closed");
        fs::set_permissions(&closed, fs::Permissions::from_mode(0o000)).unwrap();
        let read = storage.read("closed/a", None).await;
        let allowed = fs::read_dir(&closed).is_ok();
        fs::set_permissions(&closed, fs::Permissions::from_mode(0o755)).unwrap();
        // The superuser may read everything.
        assert!(
            allowed || matches!(read, Err(StorageError::Denied { .. })),
            "{read:?}"
        );
    }

    #[test]
    fn what_the_system_says_is_sorted() {
        let sorted = |kind: io::ErrorKind| StorageError::new(kind.into(), "n", "p".to_owned());
        assert!(matches!(
            sorted(io::ErrorKind::NotFound),
            StorageError::NotFound { .. }
        ));
        assert!(matches!(
            sorted(io::ErrorKind::StorageFull),
            StorageError::Full { .. }
        ));
        assert!(matches!(
            sorted(io::ErrorKind::QuotaExceeded),
            StorageError::Full { .. }
        ));
        assert!(matches!(
            sorted(io::ErrorKind::PermissionDenied),
            StorageError::Denied { .. }
        ));
        assert!(matches!(
            sorted(io::ErrorKind::ReadOnlyFilesystem),
            StorageError::Denied { .. }
        ));
        assert!(matches!(
            sorted(io::ErrorKind::TimedOut),
            StorageError::Io { .. }
        ));
        // Error number 28 is what a full disk answers.
        let full = StorageError::new(io::Error::from_raw_os_error(28), "n", "p".to_owned());
        assert!(matches!(full, StorageError::Full { .. }) && full.is_transient());
    }

    #[tokio::test]
    async fn names_do_not_leave_the_folder() {
        let dir = tempfile::tempdir().unwrap();
        let storage = LocalStorage::new(dir.path()).unwrap();
        for name in ["../outside", "/etc/hostname", "a/../../outside"] {
            let read = storage.read(name, None).await;
            assert!(
                matches!(read, Err(StorageError::Name { .. })),
                "{name}: {read:?}"
            );
            let write = storage.write_durable(name, Bytes::new()).await;
            assert!(matches!(write, Err(StorageError::Name { .. })), "{name}");
        }
        assert!(!dir.path().parent().unwrap().join("outside").exists());
    }
}
