use std::collections::BTreeSet;
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use bytes::Bytes;
use futures::FutureExt as _;
use futures::future::BoxFuture;

use super::disk::{Disk, SystemDisk};
use super::{Entry, Storage, StorageError, check_name};
use crate::randomness::{Randomness, SystemRandomness};

mod root;

use root::Root;

/// Where unfinished writes live, below the root. No object's name begins with a dot.
const INCOMING: &str = ".incoming";

/// How often a write begins whose temporary file someone has, or removes.
const WRITE_ATTEMPTS: u32 = 100;

/// Objects as files below a folder, local or on a shared file system.
///
/// A write goes to a temporary file, which is synced, renamed to its name, and made permanent by
/// syncing the folder: one sync of each per object. Runs on tokio's threads for blocking work.
///
/// A sync that fails may have lost what was written, and the next one says nothing of it. After such a
/// failure, unless the disk was merely full, nothing more is written here
/// ([`StorageError::NotKept`]): reading goes on.
///
/// The folder is known again, see [`Disk::folder_id`]. Where another takes its place, because its disk was
/// unmounted, nothing is written there, and nothing is said to be missing: that is [`StorageError::Away`], until it
/// is back. It is made when it is opened, and never again.
#[derive(Clone, Debug)]
pub struct LocalStorage(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    disk: Arc<dyn Disk>,
    root: PathBuf,
    /// By what the root is known again, once it is open.
    known: Root,
    /// Folders whose names are durable, as this process has seen to. Others may have been made by
    /// a process that died before it synced them.
    kept: Mutex<BTreeSet<PathBuf>>,
    /// Whether a sync has failed.
    stopped: AtomicBool,
    /// Where the names of temporary files come from; empty: the machine's.
    randomness: OnceLock<Arc<dyn Randomness>>,
}

/// How a finished file gets its name.
#[derive(Clone, Copy)]
enum Naming {
    /// In place of what has it.
    Replacing,
    /// Only if nothing has it.
    New,
}

/// What went wrong with a step of a write.
enum WriteError {
    Io(io::Error),
    Sync(io::Error),
    /// The root is not there, or another folder is in its place.
    Away,
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
        let storage = Self::unopened(disk, root.into());
        let inner = &*storage.0;
        let incoming = inner.root.join(INCOMING);
        let sort = |e| StorageError::new(e, INCOMING, incoming.display().to_string());
        match inner
            .prepare(&incoming)
            .map_err(|e| inner.sorted(e, INCOMING, &incoming))
        {
            Err(StorageError::Denied { .. }) if inner.disk.read_dir(&inner.root).is_ok() => {
                inner.remember_root()?;
                return Ok(storage);
            }
            prepared => prepared?,
        }
        inner.remember_root()?;
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

    /// Opens a folder that is there, to look at it: nothing in it changes, and nothing is made.
    ///
    /// # Errors
    ///
    /// [`StorageError`] if it is not there, or cannot be asked.
    pub(crate) fn as_it_is(root: impl Into<PathBuf>) -> Result<Self, StorageError> {
        let storage = Self::unopened(Arc::new(SystemDisk), root.into());
        storage.0.remember_root()?;
        Ok(storage)
    }

    fn unopened(disk: Arc<dyn Disk>, root: PathBuf) -> Self {
        Self(Arc::new(Inner {
            disk,
            root,
            known: Root::default(),
            kept: Mutex::default(),
            stopped: AtomicBool::new(false),
            randomness: OnceLock::new(),
        }))
    }

    /// Draws the names of temporary files from this instead of the machine's randomness. Has an effect once.
    #[must_use]
    pub fn with_randomness(self, randomness: Arc<dyn Randomness>) -> Self {
        drop(self.0.randomness.set(randomness));
        self
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
                let walked = inner.walk(&inner.root, "", &prefix, most, &mut found);
                // Of what lies in the folder's place, nothing follows.
                if !inner.is_there() {
                    return Err(inner.away());
                }
                let failed = |e| StorageError::new(e, &prefix, inner.root.display().to_string());
                walked.map_err(failed)?;
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
    fn away(&self) -> StorageError {
        StorageError::Away {
            path: self.root.display().to_string(),
        }
    }

    /// Notes by what the root is known again.
    fn remember_root(&self) -> Result<(), StorageError> {
        let failed = |e| StorageError::new(e, "", self.root.display().to_string());
        self.known.remember(&*self.disk, &self.root).map_err(failed)
    }

    /// Whether the root is still the folder that was opened.
    fn is_there(&self) -> bool {
        self.known.is_there(&*self.disk, &self.root)
    }

    fn check_root(&self) -> Result<(), WriteError> {
        if self.is_there() {
            Ok(())
        } else {
            Err(WriteError::Away)
        }
    }

    fn sorted(&self, error: WriteError, name: &str, path: &Path) -> StorageError {
        let path = path.display().to_string();
        match error {
            WriteError::Away => self.away(),
            WriteError::Io(_) if !self.is_there() => self.away(),
            // Its folder went away before it could be synced, as any folder's parts do with it.
            WriteError::Sync(e) if e.kind() == io::ErrorKind::NotFound && !self.is_there() => {
                self.away()
            }
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

    fn write(&self, path: &Path, bytes: &[u8], naming: Naming) -> Result<(), WriteError> {
        if self.stopped.load(Ordering::SeqCst) {
            let stopped = io::Error::other("an earlier sync failed, and nothing more is written");
            return Err(WriteError::Sync(stopped));
        }
        let parent = path.parent().unwrap_or(&self.root);
        let incoming = self.root.join(INCOMING);
        for _ in 1..WRITE_ATTEMPTS {
            self.check_root()?;
            let prepared = self.prepare(&incoming).and_then(|()| self.prepare(parent));
            match prepared.and_then(|()| self.write_once(path, bytes, naming)) {
                Ok(()) => {
                    // Also for another's, who may have died before.
                    self.disk.sync_dir(parent).map_err(WriteError::Sync)?;
                    // What was written to another folder meanwhile is not acknowledged.
                    return self.check_root();
                }
                // Another process cleaned up between this one's creating and locking the file, or
                // someone emptied the whole folder.
                Err(WriteError::Io(e)) if e.kind() == io::ErrorKind::NotFound => {
                    self.kept().clear();
                }
                // Another draws from the same seed.
                Err(WriteError::Io(e)) if e.kind() == io::ErrorKind::AlreadyExists => {}
                Err(e) => return Err(e),
            }
        }
        Err(io::Error::other("other writers keep interfering").into())
    }

    /// Writes an object unless there is one; what is there then.
    fn create(&self, path: &Path, bytes: &[u8]) -> Result<Bytes, WriteError> {
        for _ in 1..WRITE_ATTEMPTS {
            self.write(path, bytes, Naming::New)?;
            match self.disk.read(path, None) {
                // It was another's, and is deleted.
                Err(e) if e.kind() == io::ErrorKind::NotFound => {}
                there => return Ok(there?),
            }
        }
        Err(io::Error::other("others keep making and deleting it").into())
    }

    fn write_once(&self, path: &Path, bytes: &[u8], naming: Naming) -> Result<(), WriteError> {
        let number = match self.randomness.get() {
            Some(randomness) => randomness.next(),
            None => SystemRandomness.next(),
        };
        let temporary = self.root.join(INCOMING).join(format!("{number:016x}"));
        let mut file = self.disk.create_new(&temporary)?;
        // Tells a cleaner that the writer lives. Where locks do not exist, cleaners get none.
        file.lock();
        let mut write = || {
            file.write_all(bytes)?;
            file.sync().map_err(WriteError::Sync)?;
            match naming {
                Naming::Replacing => self.disk.rename(&temporary, path)?,
                Naming::New => match self.disk.rename_new(&temporary, path) {
                    Err(e) if e.kind() == io::ErrorKind::AlreadyExists => return Ok(false),
                    named => named?,
                },
            }
            Ok(true)
        };
        let written = write();
        if !matches!(written, Ok(true)) {
            // Without this a full disk would stay full; a failure here changes nothing.
            let _ = self.disk.remove_file(&temporary);
        }
        written.map(|_| ())
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
        if above_root && self.known.is_known() {
            return Err(WriteError::Away);
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
        self.blocking(name, move |inner, path| {
            inner.write(path, &bytes, Naming::Replacing)
        })
    }

    fn create_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        self.blocking(name, move |inner, path| inner.create(path, &bytes))
    }

    fn entries<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<Vec<Entry>, StorageError>> {
        self.list_some(prefix, usize::MAX)
    }

    fn holds_any<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<bool, StorageError>> {
        async move { Ok(!self.list_some(prefix, 1).await?.is_empty()) }.boxed()
    }

    fn delete<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<(), StorageError>> {
        self.blocking(name, |inner, path| match inner.disk.remove_file(path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => inner.check_root(),
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
mod tests;
