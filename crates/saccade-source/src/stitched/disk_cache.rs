//! Finished blocks and tiles' thumbnails on a local disk, for the next time.
//!
//! # Nothing stale
//!
//! A block is a function of its plan: of which tiles lie where in the sections it looks at, at which
//! revision, and of how they are stitched. The plan's whole description is kept with the block and
//! compared with the present one before the block is used, so a tile that came, moved, was imaged
//! again or deleted since makes it another block. What nobody asks for any more is written over in
//! time, oldest first. A thumbnail is a function of its pyramid, which never changes.
//!
//! # Failure
//!
//! Everything is checked by a sum when it is read. What is damaged, cannot be read or does not fit is
//! built again: it costs time, and nothing else.

use std::fmt;
use std::fs::File;
use std::hash::{BuildHasher, Hasher, RandomState};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard};

use bytes::{BufMut, Bytes, BytesMut};
use foyer::{
    BlockEngineConfig, DeviceBuilder, FsDeviceBuilder, HybridCache, HybridCacheBuilder, Load,
    PsyncIoEngineConfig, RecoverMode,
};
use saccade_archive::IDENTITY;
use saccade_archive::storage::{Storage, StorageError};

/// Unit in which the cache is written over \[bytes\]: several blocks of voxels.
const UNIT: u64 = 64 << 20;
/// Units that are always there: one being written, one being freed, two to be read.
const LEAST: u64 = 4;
/// How its files are named, as far as their number.
const FILES: &str = "foyer-storage-direct-fs-";
/// The file that one process has locked.
const LOCK: &str = "lock";
/// The file that says what the folder is.
const MARKER: &str = "saccade-disk-cache";
/// What else an empty folder may hold: the root of a file system has this.
const LOST_AND_FOUND: &str = "lost+found";

/// Why a folder cannot be used as a cache.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DiskCacheError {
    /// Another process has it.
    #[error("another process uses the cache folder; give each its own: {}", folder.display())]
    Taken {
        /// The folder.
        folder: PathBuf,
    },
    /// It holds something else.
    #[error(
        "the folder holds other things than a cache and is left as it is; name an empty or new one for the \
         cache on disk: {}",
        folder.display()
    )]
    Foreign {
        /// The folder.
        folder: PathBuf,
    },
    /// It cannot be made or written.
    #[error("the cache folder cannot be used: {}", folder.display())]
    Open {
        /// What went wrong.
        source: Box<dyn std::error::Error + Send + Sync>,
        /// The folder.
        folder: PathBuf,
    },
}

/// A folder that keeps finished blocks over restarts, bounded in bytes. For all volumes of a process.
#[derive(Clone)]
pub struct DiskCache(Arc<Inner>);

struct Inner {
    blocks: HybridCache<u64, Bytes>,
    /// Locked while the folder is in use; `None` once closed.
    lock: RwLock<Option<File>>,
}

impl fmt::Debug for DiskCache {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("DiskCache").finish_non_exhaustive()
    }
}

impl PartialEq for DiskCache {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}

impl DiskCache {
    /// Least that a cache takes \[bytes\].
    pub const LEAST_BYTES: u64 = LEAST * UNIT;

    /// Opens a folder, made if it is not there, that takes at most `bytes` (and at least
    /// [`Self::LEAST_BYTES`]).
    ///
    /// # Errors
    ///
    /// [`DiskCacheError`].
    pub async fn open(folder: &Path, bytes: u64) -> Result<Self, DiskCacheError> {
        let failed = |source: Box<dyn std::error::Error + Send + Sync>| DiskCacheError::Open {
            source,
            folder: folder.to_owned(),
        };
        let units = (bytes / UNIT).max(LEAST);
        let lock = {
            let folder = folder.to_owned();
            let prepared = tokio::task::spawn_blocking(move || prepare(&folder, units)).await;
            let prepared = prepared.unwrap_or_else(|e| Err(io::Error::other(e)));
            prepared.map_err(|e| failed(e.into()))?
        };
        let named = || folder.to_owned();
        let lock = match lock {
            Prepared::Ours(lock) => lock,
            Prepared::Taken => return Err(DiskCacheError::Taken { folder: named() }),
            Prepared::Foreign => return Err(DiskCacheError::Foreign { folder: named() }),
        };
        let size = |bytes: u64| usize::try_from(bytes).unwrap_or(usize::MAX);
        let device = FsDeviceBuilder::new(folder).with_capacity(size(units * UNIT));
        let device = device.build().map_err(|e| failed(e.into()))?;
        let engine = BlockEngineConfig::new(device)
            .with_block_size(size(UNIT))
            .with_buffer_pool_size(size(UNIT))
            .with_submit_queue_size_threshold(size(2 * UNIT));
        // Blocks in memory are kept elsewhere.
        let blocks = HybridCacheBuilder::new()
            .memory(1)
            .with_shards(1)
            .with_weighter(|_: &u64, block: &Bytes| block.len())
            .storage()
            .with_io_engine_config(PsyncIoEngineConfig::new())
            .with_engine_config(engine)
            .with_recover_mode(RecoverMode::Quiet)
            .build()
            .await
            .map_err(|e| failed(e.into()))?;
        Ok(Self(Arc::new(Inner {
            blocks,
            lock: RwLock::new(Some(lock)),
        })))
    }

    /// Writes what waits to be written, and leaves the folder to others. Clones that are still held, by
    /// work that nobody waits for any more, find and keep nothing from here on.
    pub async fn close(&self) {
        let lock = { self.0.lock.write() }
            .unwrap_or_else(PoisonError::into_inner)
            .take();
        let Some(lock) = lock else { return };
        if let Err(error) = self.0.blocks.close().await {
            log::warn!("the cache on disk was not closed: {error}");
        }
        // Not only dropped: a child process that is being started has a copy for a moment.
        if let Err(error) = lock.unlock() {
            log::warn!("the folder of the cache on disk was not freed: {error}");
        }
    }

    /// Whether the folder is still this cache's.
    fn open_still(&self) -> RwLockReadGuard<'_, Option<File>> {
        self.0.lock.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// What was made of what this description describes.
    pub(super) async fn get(&self, description: &[u8]) -> Option<Bytes> {
        if self.open_still().is_none() {
            return None;
        }
        let loaded = self.0.blocks.storage().load(&key(description)).await;
        let kept = match loaded {
            Ok(Load::Entry { value, .. }) => value,
            Ok(Load::Piece { piece, .. }) => piece.value().clone(),
            Ok(Load::Throttled | Load::Miss) => return None,
            Err(error) => {
                log::debug!("a block could not be read from the cache on disk: {error}");
                return None;
            }
        };
        let length = u64::from_le_bytes(*kept.first_chunk()?);
        let length = usize::try_from(length).ok()?.checked_add(8)?;
        let same = kept.get(8..length)? == description;
        same.then(|| kept.slice(length..))
    }

    /// Keeps what was made of what this description describes.
    pub(super) fn put(&self, description: &[u8], bytes: &[u8]) {
        let mut kept = BytesMut::with_capacity(8 + description.len() + bytes.len());
        kept.put_u64_le(description.len() as u64);
        kept.put_slice(description);
        kept.put_slice(bytes);
        // Held over the insertion, so that closing begins before it or waits for what it wrote.
        let open = self.open_still();
        if open.is_some() {
            let writer = self.0.blocks.storage_writer(key(description)).force();
            writer.insert(kept.freeze());
        }
    }
}

/// Two whose descriptions have the same key take each other's place.
fn key(description: &[u8]) -> u64 {
    // FNV-1a: the same in every build of the program.
    description
        .iter()
        .fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
            (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3)
        })
}

/// What a folder is.
enum Prepared {
    /// This process's.
    Ours(File),
    /// Another process's.
    Taken,
    /// No cache's.
    Foreign,
}

/// Whether a folder may become a cache, or is one: also one of an earlier version, which had no marker.
fn is_cache(folder: &Path) -> io::Result<bool> {
    if folder.join(MARKER).is_file() {
        return Ok(true);
    }
    for entry in std::fs::read_dir(folder)? {
        let name = entry?.file_name();
        let known = |name: &str| [LOCK, LOST_AND_FOUND].contains(&name) || name.starts_with(FILES);
        if !name.to_str().is_some_and(known) {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Makes the folder, takes it if nobody has it, and removes files of a larger cache.
fn prepare(folder: &Path, units: u64) -> io::Result<Prepared> {
    std::fs::create_dir_all(folder)?;
    if !is_cache(folder)? {
        return Ok(Prepared::Foreign);
    }
    let lock = File::create(folder.join(LOCK))?;
    match lock.try_lock() {
        Ok(()) => {}
        Err(std::fs::TryLockError::WouldBlock) => return Ok(Prepared::Taken),
        Err(std::fs::TryLockError::Error(error)) => return Err(error),
    }
    std::fs::write(
        folder.join(MARKER),
        "blocks of voxels that Saccade has stitched\n",
    )?;
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let number = { name.to_str() }.and_then(|name| name.strip_prefix(FILES));
        if { number.and_then(|n| n.parse::<u64>().ok()) }.is_some_and(|n| n >= units) {
            std::fs::remove_file(entry.path())?;
        }
    }
    Ok(Prepared::Ours(lock))
}

/// What tells an archive from every other, made if it has none; `None` where it cannot be written.
pub(super) async fn identity(storage: &dyn Storage) -> Option<Bytes> {
    match storage.read(IDENTITY, None).await {
        Ok(identity) => return Some(identity),
        Err(StorageError::NotFound { .. }) => {}
        Err(error) => {
            log::warn!("the cache on disk is not used: {error}");
            return None;
        }
    }
    let random = || RandomState::new().build_hasher().finish();
    let identity = Bytes::from(format!("{:016x}{:016x}\n", random(), random()));
    let written = storage.write_durable(IDENTITY, identity).await;
    if let Err(error) = written {
        log::warn!("the cache on disk is not used for an archive that cannot be written: {error}");
        return None;
    }
    // Another process may have done the same at the same time.
    storage.read(IDENTITY, None).await.ok()
}
