//! Finished blocks and tiles' thumbnails on a local disk, for the next time.
//!
//! # Nothing stale
//!
//! A block is a function of its plan: of which tiles lie where in the sections it looks at, at which
//! revision, and of how they are stitched. The plan's whole description is kept with the block and
//! compared with the present one before the block is used, so a tile that came, moved, was imaged
//! again or deleted since makes it another block. What nobody asks for any more is written over in
//! time, oldest first: each time the folder is opened and written to, another unit is begun. A thumbnail is a function of its pyramid, which never changes.
//!
//! # Failure
//!
//! Everything is checked by a sum when it is read. What is damaged, cannot be read or does not fit is
//! built again: it costs time, and nothing else.

use std::collections::BTreeSet;
use std::error::Error;
use std::fmt;
use std::fs::File;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::{BufMut, Bytes, BytesMut};
use foyer::{
    BlockEngineConfig, DeviceBuilder, FsDeviceBuilder, HybridCache, HybridCacheBuilder, Load,
    PsyncIoEngineConfig, RecoverMode,
};
use saccade_archive::{IDENTITY, VisualizationArchive};

/// Least unit in which the cache is written over \[bytes\]: several blocks of voxels. Each is a file.
const UNIT: u64 = 64 << 20;
/// Largest unit \[bytes\]: places in it are kept in 32 bits.
const UNIT_MOST: u64 = 1 << 32;
/// Units above which they grow, as long as they may: all are open at once, and a process may often have no more
/// than 1024 files open.
const MANY: u64 = 320;
/// Units that there are at most.
const MOST: u64 = 512;
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
        source: Box<dyn Error + Send + Sync>,
        /// The folder.
        folder: PathBuf,
    },
}

/// How a cache is cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Units {
    /// Bytes of each.
    bytes: u64,
    /// How many.
    count: u64,
}

impl Units {
    /// Of a cache of so many bytes. They double as it grows, so that about as large a one finds its blocks again.
    fn of(bytes: u64) -> Self {
        let mut unit = UNIT;
        while unit < UNIT_MOST && bytes / unit > MANY {
            unit *= 2;
        }
        Self {
            bytes: unit,
            count: (bytes / unit).clamp(LEAST, MOST),
        }
    }
}

/// A folder that keeps finished blocks over restarts, bounded in bytes. For all volumes of a process.
#[derive(Clone)]
pub struct DiskCache(Arc<Inner>);

struct Inner {
    blocks: HybridCache<u64, Bytes>,
    /// Locked while the folder is in use; `None` once closed. Held by whoever writes, one at a time.
    lock: Mutex<Option<File>>,
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
    /// Most that a cache takes \[bytes\].
    pub const MOST_BYTES: u64 = MOST * UNIT_MOST;

    /// Opens a folder, made if it is not there, that takes at most `bytes` (and at least
    /// [`Self::LEAST_BYTES`], and never more than [`Self::MOST_BYTES`]). Where that fails, nothing new is left
    /// in it.
    ///
    /// # Errors
    ///
    /// [`DiskCacheError`].
    pub async fn open(folder: &Path, bytes: u64) -> Result<Self, DiskCacheError> {
        let units = Units::of(bytes);
        let named = || folder.to_owned();
        let failed = |source| DiskCacheError::Open {
            source,
            folder: named(),
        };
        let in_folder = named();
        // Hundreds of files are opened, and what is in them is listed: not where others wait for their turn.
        let opened =
            tokio::task::spawn_blocking(move || -> Result<_, Box<dyn Error + Send + Sync>> {
                let (lock, made) = match prepare(&in_folder, units)? {
                    Prepared::Ours(lock, made) => (lock, made),
                    Prepared::Taken(folder) => return Ok(Err(DiskCacheError::Taken { folder })),
                    Prepared::Foreign(folder) => {
                        return Ok(Err(DiskCacheError::Foreign { folder }));
                    }
                };
                match tokio::runtime::Handle::current().block_on(blocks(&in_folder, units)) {
                    Ok(blocks) => Ok(Ok((blocks, lock))),
                    Err(error) => {
                        made.remove(&in_folder);
                        Err(cause(error))
                    }
                }
            });
        let opened = opened.await.map_err(|e| failed(e.into()))?;
        let (blocks, lock) = opened.map_err(failed)??;
        Ok(Self(Arc::new(Inner {
            blocks,
            lock: Mutex::new(Some(lock)),
        })))
    }

    /// Writes what waits to be written, and leaves the folder to others. Clones that are still held, by
    /// work that nobody waits for any more, find and keep nothing from here on.
    pub async fn close(&self) {
        let lock = self.folder().take();
        let Some(lock) = lock else { return };
        if let Err(error) = self.0.blocks.close().await {
            log::warn!("the cache on disk was not closed: {error}");
        }
        // Not only dropped: a child process that is being started has a copy for a moment.
        if let Err(error) = lock.unlock() {
            log::warn!("the folder of the cache on disk was not freed: {error}");
        }
    }

    /// The folder, as long as it is this cache's.
    fn folder(&self) -> MutexGuard<'_, Option<File>> {
        self.0.lock.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What was made of what this description describes.
    pub(super) async fn get(&self, description: &[u8]) -> Option<Bytes> {
        if self.folder().is_none() {
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
        // Held over the insertion, so that closing begins before it or waits for what it wrote; and by one at a
        // time: the library numbers what is inserted before it lines it up, and what lies on disk behind a
        // higher number is not found again when the folder is opened next.
        let folder = self.folder();
        if folder.is_some() {
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

/// Opens the files of a folder, and lists what is in them.
async fn blocks(folder: &Path, units: Units) -> foyer::Result<HybridCache<u64, Bytes>> {
    let size = |bytes: u64| usize::try_from(bytes).unwrap_or(usize::MAX);
    let device = FsDeviceBuilder::new(folder).with_capacity(size(units.count * units.bytes));
    let engine = BlockEngineConfig::new(device.build()?)
        .with_block_size(size(units.bytes))
        .with_buffer_pool_size(size(UNIT))
        .with_submit_queue_size_threshold(size(2 * UNIT));
    // Blocks in memory are kept elsewhere.
    HybridCacheBuilder::new()
        .memory(1)
        .with_shards(1)
        .with_weighter(|_: &u64, block: &Bytes| block.len())
        .storage()
        .with_io_engine_config(PsyncIoEngineConfig::new())
        .with_engine_config(engine)
        .with_recover_mode(RecoverMode::Quiet)
        .build()
        .await
}

/// What the system said, where it did: the error around it says that again, and much of the library's own.
fn cause(error: foyer::Error) -> Box<dyn Error + Send + Sync> {
    let mut inner: Option<&(dyn Error + 'static)> = Some(&error);
    while let Some(at) = inner {
        let system = at.downcast_ref::<io::Error>();
        if let Some(code) = system.and_then(io::Error::raw_os_error) {
            return io::Error::from_raw_os_error(code).into();
        }
        inner = at.source();
    }
    error.into()
}

/// What a folder is.
enum Prepared {
    /// This process's.
    Ours(File, Made),
    /// Another process's.
    Taken(PathBuf),
    /// No cache's.
    Foreign(PathBuf),
}

/// What is new in a folder.
struct Made {
    /// The folder itself.
    folder: bool,
    /// The mark of a cache, and the file that is locked.
    mark: bool,
    /// Units that are not: they were there before.
    kept: BTreeSet<u64>,
}

impl Made {
    /// Takes it away again, as far as that can be done.
    fn remove(&self, folder: &Path) {
        let remove = || -> io::Result<()> {
            for entry in std::fs::read_dir(folder)? {
                let entry = entry?;
                let new = number_of(&entry).is_some_and(|n| !self.kept.contains(&n));
                if new && entry.file_type()?.is_file() {
                    std::fs::remove_file(entry.path())?;
                }
            }
            if self.mark {
                std::fs::remove_file(folder.join(MARKER))?;
                std::fs::remove_file(folder.join(LOCK))?;
            }
            if self.folder {
                std::fs::remove_dir(folder)?;
            }
            Ok(())
        };
        if let Err(error) = remove() {
            log::warn!("what was made of the cache on disk could not be removed: {error}");
        }
    }
}

/// Which unit a file is.
fn number_of(entry: &std::fs::DirEntry) -> Option<u64> {
    let name = entry.file_name();
    name.to_str()?.strip_prefix(FILES)?.parse().ok()
}

/// Whether a unit has been written to: a free one begins with a page of zeros, or is a hole.
fn is_written(unit: &Path) -> io::Result<bool> {
    let mut page = [0; 4096];
    File::open(unit)?.read_exact(&mut page)?;
    Ok(page.iter().any(|byte| *byte != 0))
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

/// Makes the folder, takes it if nobody has it, and removes files of a cache of another size: units that are too
/// many, and those of other units.
fn prepare(folder: &Path, units: Units) -> io::Result<Prepared> {
    let there = folder.exists();
    std::fs::create_dir_all(folder)?;
    if !is_cache(folder)? {
        return Ok(Prepared::Foreign(folder.to_owned()));
    }
    let marked = folder.join(MARKER).exists();
    let lock = File::create(folder.join(LOCK))?;
    match lock.try_lock() {
        Ok(()) => {}
        Err(std::fs::TryLockError::WouldBlock) => return Ok(Prepared::Taken(folder.to_owned())),
        Err(std::fs::TryLockError::Error(error)) => return Err(error),
    }
    std::fs::write(
        folder.join(MARKER),
        "blocks of voxels that Saccade has stitched\n",
    )?;
    let mut kept = BTreeSet::new();
    let mut written = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        let metadata = entry.metadata()?;
        if let Some(number) = number_of(&entry).filter(|_| metadata.is_file()) {
            if number < units.count && metadata.len() == units.bytes {
                kept.insert(number);
                if is_written(&entry.path())? {
                    written.push((metadata.modified()?, number, entry.path()));
                }
            } else {
                std::fs::remove_file(entry.path())?;
            }
        }
    }
    // A process that is killed while it frees a unit leaves none that is free, and the library frees one only when
    // it has taken another: it would wait for ever, and so would whoever closes the cache.
    if written.len() as u64 == units.count
        && let Some((_, number, oldest)) = written.into_iter().min()
    {
        std::fs::remove_file(oldest)?;
        kept.remove(&number);
    }
    let made = Made {
        folder: !there,
        mark: !marked && kept.is_empty(),
        kept,
    };
    Ok(Prepared::Ours(lock, made))
}

/// What tells an archive from every other, made if it has none; `None` where it cannot be written.
pub(super) async fn identity(archive: &VisualizationArchive) -> Option<String> {
    match archive.own_identity().await {
        Ok(Some(identity)) => Some(identity + "\n"),
        Ok(None) => {
            log::warn!(
                "the cache on disk is not used: the archive's object {IDENTITY:?} is damaged; `saccade ingest` \
                 writes it anew"
            );
            None
        }
        Err(error) => {
            log::warn!(
                "the cache on disk is not used, as the archive cannot be told from others: {error}"
            );
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_are_never_many_files() {
        let of = |bytes: u64| {
            let units = Units::of(bytes);
            (units.bytes >> 20, units.count)
        };
        assert_eq!(of(0), (64, LEAST));
        assert_eq!(of(1 << 30), (64, 16));
        // The default stays as it was.
        assert_eq!(of(20_000_000_000), (64, 298));
        assert_eq!(of(100_000_000_000), (512, 186));
        assert_eq!(of(1_500_000_000_000), (4096, 349));
        assert_eq!(of(u64::MAX), (4096, MOST));
        for bits in 28..63 {
            for bytes in [1_u64 << bits, (1 << bits) + (1 << (bits - 1)) + 12345] {
                let units = Units::of(bytes);
                assert!(units.bytes.is_multiple_of(UNIT) && units.bytes <= UNIT_MOST);
                assert!((LEAST..=MOST).contains(&units.count));
                let taken = units.bytes * units.count;
                assert!(taken <= bytes, "{taken} of {bytes}");
                // Nearly all of it is made use of, up to the most.
                let wanted = bytes.min(DiskCache::MOST_BYTES);
                assert!(taken >= wanted - wanted / 100 || units.bytes == UNIT);
            }
        }
    }
}
