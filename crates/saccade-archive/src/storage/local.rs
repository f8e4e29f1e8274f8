use std::fs::{self, File};
use std::io::{self, Read as _, Seek as _, SeekFrom, Write as _};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use futures::FutureExt as _;
use futures::future::BoxFuture;

use super::memory::cut;
use super::{Storage, StorageError, check_name};

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
#[derive(Clone, Debug)]
pub struct LocalStorage {
    root: Arc<Path>,
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
        let storage = Self {
            root: root.into().into(),
        };
        let incoming = storage.root.join(INCOMING);
        let sort = |e| StorageError::new(e, INCOMING, incoming.display().to_string());
        match create_dirs(&incoming).map_err(sort) {
            Err(StorageError::Denied { .. }) if fs::read_dir(&storage.root).is_ok() => {
                return Ok(storage);
            }
            created => created?,
        }
        for entry in fs::read_dir(&incoming).map_err(sort)? {
            remove_if_abandoned(&entry.map_err(sort)?.path());
        }
        Ok(storage)
    }

    /// The folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Runs `work` with the object's path where it may block.
    fn blocking<T: Send + 'static>(
        &self,
        name: &str,
        work: impl FnOnce(&Self, &Path) -> io::Result<T> + Send + 'static,
    ) -> BoxFuture<'static, Result<T, StorageError>> {
        let (storage, name) = (self.clone(), name.to_owned());
        async move {
            check_name(&name)?;
            let path = storage.root.join(&name);
            let task = tokio::task::spawn_blocking(move || {
                let result = work(&storage, &path);
                result.map_err(|e| StorageError::new(e, &name, path.display().to_string()))
            });
            task.await.unwrap_or_else(|e| {
                let (source, path) = (io::Error::other(e), String::new());
                Err(StorageError::Io { source, path })
            })
        }
        .boxed()
    }

    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let parent = path.parent().unwrap_or(&self.root);
        create_dirs(parent)?;
        for _ in 1..WRITE_ATTEMPTS {
            match self.write_once(path, bytes) {
                Ok(()) => return sync_dir(parent),
                // Another process cleaned up between this one's creating and locking the file, or
                // someone emptied the whole folder.
                Err(e) if e.kind() == io::ErrorKind::NotFound => {
                    create_dirs(&self.root.join(INCOMING))?;
                    create_dirs(parent)?;
                }
                // A process of the same number, on another machine or before this one.
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {}
                Err(e) => return Err(e),
            }
        }
        Err(io::Error::other("other writers keep interfering"))
    }

    fn write_once(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let temporary = self
            .root
            .join(INCOMING)
            .join(format!("{}-{number}", std::process::id()));
        let mut file = File::create_new(&temporary)?;
        // Tells a cleaner that the writer lives. Where locks do not exist, cleaners get none.
        let _ = file.try_lock();
        let mut write = || {
            file.write_all(bytes)?;
            file.sync_all()?;
            fs::rename(&temporary, path)
        };
        write().inspect_err(|_| {
            // Without this a full disk would stay full; a failure here changes nothing.
            let _ = fs::remove_file(&temporary);
        })
    }
}

/// Removes a temporary file unless its writer holds the lock.
fn remove_if_abandoned(path: &Path) {
    if let Ok(file) = File::open(path)
        && file.try_lock().is_ok()
        && let Err(e) = fs::remove_file(path)
    {
        log::warn!(
            "cannot remove an abandoned temporary file: {e}: {}",
            path.display()
        );
    }
}

/// Creates a folder and those above it, each entered durably in the one that holds it.
fn create_dirs(path: &Path) -> io::Result<()> {
    if path.as_os_str().is_empty() || path.is_dir() {
        return Ok(());
    }
    let parent = path
        .parent()
        .filter(|p| !p.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    create_dirs(parent)?;
    match fs::create_dir(path) {
        Err(e) if e.kind() == io::ErrorKind::AlreadyExists && path.is_dir() => Ok(()),
        Err(e) => Err(e),
        Ok(()) => sync_dir(parent),
    }
}

fn sync_dir(path: &Path) -> io::Result<()> {
    File::open(path)?.sync_all()
}

/// Adds the names of the files below `dir` to `names`; `at` is the folder's own name with a slash.
fn walk(dir: &Path, at: &str, prefix: &str, names: &mut Vec<String>) -> io::Result<()> {
    let entries = match fs::read_dir(dir) {
        // Removed since its parent was read.
        Err(e) if e.kind() == io::ErrorKind::NotFound && !at.is_empty() => return Ok(()),
        entries => entries?,
    };
    for entry in entries {
        let entry = entry?;
        let Ok(part) = entry.file_name().into_string() else {
            continue;
        };
        let name = format!("{at}{part}");
        if part.starts_with('.') {
            continue;
        }
        if entry.file_type()?.is_dir() {
            let below = name + "/";
            if below.starts_with(prefix) || prefix.starts_with(&below) {
                walk(&entry.path(), &below, prefix, names)?;
            }
        } else if name.starts_with(prefix) {
            names.push(name);
        }
    }
    Ok(())
}

impl Storage for LocalStorage {
    fn read<'a>(
        &'a self,
        name: &'a str,
        range: Option<Range<u64>>,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        self.blocking(name, |_, path| {
            let mut file = File::open(path)?;
            let cut = cut(range, file.metadata()?.len());
            let len = cut.end - cut.start;
            file.seek(SeekFrom::Start(cut.start))?;
            let mut bytes = Vec::new();
            bytes
                .try_reserve_exact(usize::try_from(len).unwrap_or(usize::MAX))
                .map_err(|_| io::ErrorKind::OutOfMemory)?;
            file.take(len).read_to_end(&mut bytes)?;
            Ok(bytes.into())
        })
    }

    fn write_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<(), StorageError>> {
        self.blocking(name, move |storage, path| storage.write(path, &bytes))
    }

    fn list<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<Vec<String>, StorageError>> {
        let (root, prefix) = (self.root.clone(), prefix.to_owned());
        async move {
            let task = tokio::task::spawn_blocking(move || {
                let mut names = Vec::new();
                let failed = |e| StorageError::new(e, &prefix, root.display().to_string());
                walk(&root, "", &prefix, &mut names).map_err(failed)?;
                names.sort_unstable();
                Ok(names)
            });
            task.await.unwrap_or_else(|e| {
                let (source, path) = (io::Error::other(e), String::new());
                Err(StorageError::Io { source, path })
            })
        }
        .boxed()
    }

    fn delete<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<(), StorageError>> {
        self.blocking(name, |storage, path| match fs::remove_file(path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
            Err(e) => Err(e),
            Ok(()) => sync_dir(path.parent().unwrap_or(&storage.root)),
        })
    }

    fn size<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<u64, StorageError>> {
        self.blocking(name, |_, path| Ok(fs::metadata(path)?.len()))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[tokio::test]
    async fn conforms() {
        let dir = tempfile::tempdir().unwrap();
        let storage = LocalStorage::new(dir.path().join("deep/root")).unwrap();
        super::super::conformance::check(Arc::new(storage)).await;
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
