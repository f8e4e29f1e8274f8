use std::collections::BTreeMap;
use std::io;
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use futures::FutureExt as _;
use futures::future::BoxFuture;

use super::{Entry, Storage, StorageError};

/// What befalls a write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WriteFault {
    /// It fails and changes nothing.
    Fail,
    /// It fails for want of space and changes nothing.
    Full,
    /// The process dies before the object has its name.
    CrashBefore,
    /// The process dies after the object is whole, before anyone hears of it.
    CrashAfter,
    /// The process dies, and a storage that breaks its contract kept only the first bytes: what
    /// readers must notice.
    CutShort {
        /// Bytes kept.
        kept: usize,
    },
}

/// What befalls a read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReadFault {
    /// It fails; the next may succeed.
    Fail,
    /// It yields only the first bytes of what was asked for.
    CutShort {
        /// Bytes kept.
        kept: usize,
    },
}

/// A storage that fails as told, for tests.
///
/// Writes and reads are counted from 0, each for itself, failed ones included. After a crash every
/// call fails until [`restart`](Self::restart).
#[derive(Clone, Debug)]
pub struct FaultyStorage {
    inner: Arc<dyn Storage>,
    state: Arc<Mutex<State>>,
}

#[derive(Debug, Default)]
struct State {
    writes: u64,
    reads: u64,
    write_faults: BTreeMap<u64, WriteFault>,
    read_faults: BTreeMap<u64, ReadFault>,
    /// Bytes that may still be written; `None`: any number.
    space: Option<u64>,
    crashed: bool,
}

impl FaultyStorage {
    /// Wraps `inner`; without further orders nothing fails.
    pub fn new(inner: Arc<dyn Storage>) -> Self {
        Self {
            inner,
            state: Arc::default(),
        }
    }

    /// Orders `fault` for the `nth` write from now, 0 being the next.
    pub fn fail_write(&self, nth: u64, fault: WriteFault) {
        let mut state = self.state();
        let at = state.writes + nth;
        state.write_faults.insert(at, fault);
    }

    /// Orders `fault` for the `nth` read from now, 0 being the next.
    pub fn fail_read(&self, nth: u64, fault: ReadFault) {
        let mut state = self.state();
        let at = state.reads + nth;
        state.read_faults.insert(at, fault);
    }

    /// The disk holds only so many more bytes; `None`: any number.
    pub fn set_space(&self, bytes: Option<u64>) {
        self.state().space = bytes;
    }

    /// Whether a crash has happened since the last restart.
    pub fn has_crashed(&self) -> bool {
        self.state().crashed
    }

    /// The process starts again: calls succeed again, later orders stand.
    pub fn restart(&self) {
        self.state().crashed = false;
    }

    /// Writes begun so far.
    pub fn writes(&self) -> u64 {
        self.state().writes
    }

    /// Reads begun so far.
    pub fn reads(&self) -> u64 {
        self.state().reads
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn alive(&self, name: &str) -> Result<(), StorageError> {
        if self.state().crashed {
            Err(failure("the storage has crashed", name))
        } else {
            Ok(())
        }
    }

    fn next_write(&self, bytes: usize) -> Option<WriteFault> {
        let mut state = self.state();
        let number = state.writes;
        state.writes += 1;
        if let Some(fault) = state.write_faults.remove(&number) {
            return Some(fault);
        }
        match state.space {
            Some(space) if space < bytes as u64 => return Some(WriteFault::Full),
            Some(space) => state.space = Some(space - bytes as u64),
            None => {}
        }
        None
    }

    fn next_read(&self) -> Option<ReadFault> {
        let mut state = self.state();
        let number = state.reads;
        state.reads += 1;
        state.read_faults.remove(&number)
    }

    fn crash(&self) {
        self.state().crashed = true;
    }

    /// Does a write, and what is ordered for it.
    async fn faulty_write<'a, T>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
        write: impl FnOnce(Bytes) -> BoxFuture<'a, Result<T, StorageError>>,
    ) -> Result<T, StorageError> {
        self.alive(name)?;
        match self.next_write(bytes.len()) {
            None => write(bytes).await,
            Some(WriteFault::Fail) => Err(failure("this write was ordered to fail", name)),
            Some(WriteFault::Full) => Err(StorageError::Full {
                source: io::ErrorKind::StorageFull.into(),
                path: name.to_owned(),
            }),
            Some(WriteFault::CrashBefore) => {
                self.crash();
                Err(failure("the storage crashed before this write", name))
            }
            Some(WriteFault::CrashAfter) => {
                write(bytes).await?;
                self.crash();
                Err(failure("the storage crashed after this write", name))
            }
            Some(WriteFault::CutShort { kept }) => {
                write(bytes.slice(..kept.min(bytes.len()))).await?;
                self.crash();
                Err(failure(
                    "the storage crashed in the middle of this write",
                    name,
                ))
            }
        }
    }
}

fn failure(what: &'static str, name: &str) -> StorageError {
    StorageError::Io {
        source: io::Error::other(what),
        path: name.to_owned(),
    }
}

impl Storage for FaultyStorage {
    fn read<'a>(
        &'a self,
        name: &'a str,
        range: Option<Range<u64>>,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        async move {
            self.alive(name)?;
            match self.next_read() {
                None => self.inner.read(name, range).await,
                Some(ReadFault::Fail) => Err(failure("this read was ordered to fail", name)),
                Some(ReadFault::CutShort { kept }) => {
                    let mut bytes = self.inner.read(name, range).await?;
                    bytes.truncate(kept);
                    Ok(bytes)
                }
            }
        }
        .boxed()
    }

    fn write_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<(), StorageError>> {
        let write = move |bytes| self.inner.write_durable(name, bytes);
        self.faulty_write(name, bytes, write).boxed()
    }

    fn create_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        let create = move |bytes| self.inner.create_durable(name, bytes);
        self.faulty_write(name, bytes, create).boxed()
    }

    fn entries<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<Vec<Entry>, StorageError>> {
        async move {
            self.alive(prefix)?;
            self.inner.entries(prefix).await
        }
        .boxed()
    }

    fn delete<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<(), StorageError>> {
        async move {
            self.alive(name)?;
            self.inner.delete(name).await
        }
        .boxed()
    }

    fn size<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<u64, StorageError>> {
        async move {
            self.alive(name)?;
            self.inner.size(name).await
        }
        .boxed()
    }

    fn settled(&self) -> BoxFuture<'_, ()> {
        self.inner.settled()
    }

    fn read_cost(&self) -> u64 {
        self.inner.read_cost()
    }
}

#[cfg(test)]
mod tests {
    use super::super::{MemoryStorage, conformance};
    use super::*;

    const OBJECT: Bytes = Bytes::from_static(b"0123456789");

    fn storage() -> FaultyStorage {
        FaultyStorage::new(Arc::new(MemoryStorage::new()))
    }

    #[tokio::test]
    async fn conforms_while_nothing_is_ordered() {
        conformance::check(Arc::new(storage())).await;
    }

    /// A suite that cannot fail proves nothing.
    #[tokio::test]
    #[should_panic(expected = "Some(0..10)")]
    async fn the_suite_notices_a_read_cut_short() {
        let storage = storage();
        storage.fail_read(2, ReadFault::CutShort { kept: 3 });
        conformance::check(Arc::new(storage)).await;
    }

    #[tokio::test]
    #[should_panic(expected = "write")]
    async fn the_suite_notices_a_write_that_fails() {
        let storage = storage();
        storage.fail_write(3, WriteFault::Fail);
        conformance::check(Arc::new(storage)).await;
    }

    #[tokio::test]
    async fn writes_fail_as_ordered() {
        for (fault, after) in [
            (WriteFault::Fail, None),
            (WriteFault::Full, None),
            (WriteFault::CrashBefore, None),
            (WriteFault::CrashAfter, Some(&b"0123456789"[..])),
            (WriteFault::CutShort { kept: 3 }, Some(&b"012"[..])),
        ] {
            let storage = storage();
            storage.fail_write(1, fault);
            storage.write_durable("first", OBJECT).await.unwrap();
            let error = storage.write_durable("second", OBJECT).await.unwrap_err();
            assert_eq!(
                matches!(error, StorageError::Full { .. }),
                fault == WriteFault::Full
            );
            let crashed = !matches!(fault, WriteFault::Fail | WriteFault::Full);
            assert_eq!(storage.has_crashed(), crashed, "{fault:?}");
            assert_eq!(
                storage.read("first", None).await.is_err(),
                crashed,
                "{fault:?}"
            );
            storage.restart();
            assert_eq!(storage.read("first", None).await.unwrap(), OBJECT);
            let found = storage.read("second", None).await.ok();
            assert_eq!(found.as_deref(), after, "{fault:?}");
            storage.write_durable("second", OBJECT).await.unwrap();
            assert_eq!(storage.writes(), 3);
        }
    }

    #[tokio::test]
    async fn the_disk_fills_and_empties() {
        let storage = storage();
        storage.set_space(Some(15));
        storage.write_durable("a", OBJECT).await.unwrap();
        let full = storage.write_durable("b", OBJECT).await;
        assert!(matches!(full, Err(StorageError::Full { .. })), "{full:?}");
        storage.set_space(None);
        storage.write_durable("b", OBJECT).await.unwrap();
    }

    #[tokio::test]
    async fn reads_fail_as_ordered() {
        let storage = storage();
        storage.write_durable("a", OBJECT).await.unwrap();
        storage.fail_read(0, ReadFault::Fail);
        storage.fail_read(1, ReadFault::CutShort { kept: 2 });
        assert!(storage.read("a", None).await.unwrap_err().is_transient());
        assert_eq!(storage.read("a", Some(4..9)).await.unwrap(), b"45"[..]);
        assert_eq!(storage.read("a", None).await.unwrap(), OBJECT);
        assert_eq!(storage.reads(), 3);
    }
}
