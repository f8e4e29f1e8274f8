//! Named objects that are written once, whole, and survive a crash.

use std::fmt;
use std::ops::Range;
use std::time::SystemTime;

use bytes::Bytes;
use futures::FutureExt as _;
use futures::future::BoxFuture;

pub mod conformance;
mod disk;
mod error;
mod faulty;
mod local;
mod memory;
mod name;
mod object;

pub use disk::conformance as disk_conformance;
pub use disk::{
    Crash, DirEntry, Disk, FolderId, Metadata, OpenFile, SimulatedDisk, SystemDisk, write_whole,
};
pub(crate) use disk::{open_regular, read_regular};
pub use error::StorageError;
pub use faulty::{FaultyStorage, ReadFault, WriteFault};
pub use local::LocalStorage;
pub use memory::MemoryStorage;
pub use name::check_name;
pub use object::{BucketLocation, BucketLocationError, ObjectStorage};

/// An object that a storage lists.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Its name.
    pub name: String,
    /// Its size \[bytes\].
    pub size: u64,
    /// When it was written, if the storage knows.
    pub modified: Option<SystemTime>,
}

/// Where a visualization archive keeps its objects: a folder, memory, an object store.
///
/// Names are relative paths such as `tiles/a.tif`, see [`check_name`]. An object is written whole
/// or not at all: at any instant, and after a crash at any instant, a name holds what the last
/// finished write put there, or nothing. Implementations pass
/// [`conformance`].
///
/// Dropping a future gives up waiting; a write that had begun may still take place, whole.
pub trait Storage: Send + Sync + fmt::Debug {
    /// The object's bytes, or those of `range` that exist: a range that reaches past the end is
    /// cut there, one that begins past it is empty.
    ///
    /// # Errors
    ///
    /// [`StorageError::NotFound`] where there is no such object, others as they occur.
    fn read<'a>(
        &'a self,
        name: &'a str,
        range: Option<Range<u64>>,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>>;

    /// Writes an object, in place of an older one of that name. When it returns, the object is
    /// there even if the machine loses power in the next instant.
    ///
    /// # Errors
    ///
    /// [`StorageError::Full`], [`StorageError::Denied`], others as they occur. What was there
    /// before is still there then.
    fn write_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<(), StorageError>>;

    /// Writes an object unless there is one of that name, and returns what is there then: these bytes, or another's. Of
    /// several that do so at once one is kept, and all of them get its bytes. They are there even if the
    /// machine loses power in the next instant, whoever wrote them.
    ///
    /// # Errors
    ///
    /// As [`write_durable`](Self::write_durable).
    fn create_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>>;

    /// The objects whose names begin with `prefix`, sorted by name. Unfinished writes are not
    /// listed.
    ///
    /// # Errors
    ///
    /// As they occur.
    fn entries<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<Vec<Entry>, StorageError>>;

    /// Whether there is any, which takes less than to list them.
    ///
    /// # Errors
    ///
    /// As they occur.
    fn holds_any<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<bool, StorageError>> {
        async move { Ok(!self.entries(prefix).await?.is_empty()) }.boxed()
    }

    /// Their names.
    ///
    /// # Errors
    ///
    /// As they occur.
    fn list<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<Vec<String>, StorageError>> {
        async move {
            let entries = self.entries(prefix).await?;
            Ok(entries.into_iter().map(|entry| entry.name).collect())
        }
        .boxed()
    }

    /// Removes an object. It is no error if there is none.
    ///
    /// # Errors
    ///
    /// As they occur.
    fn delete<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<(), StorageError>>;

    /// An object's size \[bytes\].
    ///
    /// # Errors
    ///
    /// [`StorageError::NotFound`] where there is no such object, others as they occur.
    fn size<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<u64, StorageError>>;

    /// Returns once nothing is left to do for writes that were given up, see above: for who is about to end.
    fn settled(&self) -> BoxFuture<'_, ()> {
        std::future::ready(()).boxed()
    }

    /// What beginning another read takes, as bytes that could have been read meanwhile: parts of an
    /// object that lie closer together are better read as one.
    fn read_cost(&self) -> u64 {
        16 << 10
    }
}
