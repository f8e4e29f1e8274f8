use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

use bytes::Bytes;
use futures::FutureExt as _;
use futures::future::{BoxFuture, ready};

use super::{Entry, Storage, StorageError, check_name};
use crate::clock::{Clock, SystemClock};

/// Objects in memory, for tests and for demonstrations that leave nothing behind.
#[derive(Debug)]
pub struct MemoryStorage {
    objects: Mutex<BTreeMap<String, (Bytes, SystemTime)>>,
    clock: Arc<dyn Clock>,
}

impl Default for MemoryStorage {
    fn default() -> Self {
        Self {
            objects: Mutex::default(),
            clock: Arc::new(SystemClock),
        }
    }
}

impl MemoryStorage {
    /// An empty storage.
    pub fn new() -> Self {
        Self::default()
    }

    /// Tells when objects were written by this clock instead of the machine's.
    #[must_use]
    pub fn with_clock(self, clock: Arc<dyn Clock>) -> Self {
        Self { clock, ..self }
    }

    fn objects(&self) -> MutexGuard<'_, BTreeMap<String, (Bytes, SystemTime)>> {
        // Every change below is a single insertion or removal: whole even after a panic.
        self.objects.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn get(&self, name: &str) -> Result<Bytes, StorageError> {
        check_name(name)?;
        let found = self.objects().get(name).map(|(bytes, _)| bytes.clone());
        found.ok_or_else(|| StorageError::NotFound {
            name: name.to_owned(),
        })
    }
}

/// The part of `0..len` that `range` asks for.
pub(super) fn cut(range: Option<Range<u64>>, len: u64) -> Range<u64> {
    let range = range.unwrap_or(0..len);
    let start = range.start.min(len);
    start..range.end.clamp(start, len)
}

impl Storage for MemoryStorage {
    fn read<'a>(
        &'a self,
        name: &'a str,
        range: Option<Range<u64>>,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        ready(self.get(name).map(|bytes| {
            let cut = cut(range, bytes.len() as u64);
            let index = |at| usize::try_from(at).expect("cut to the length, which is a usize");
            bytes.slice(index(cut.start)..index(cut.end))
        }))
        .boxed()
    }

    fn write_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<(), StorageError>> {
        ready(check_name(name).map(|()| {
            let object = (bytes, self.clock.now());
            self.objects().insert(name.to_owned(), object);
        }))
        .boxed()
    }

    fn create_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        ready(check_name(name).map(|()| {
            let object = (bytes, self.clock.now());
            let mut objects = self.objects();
            let (there, _) = objects.entry(name.to_owned()).or_insert(object);
            there.clone()
        }))
        .boxed()
    }

    fn entries<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<Vec<Entry>, StorageError>> {
        let entries = self
            .objects()
            .iter()
            .filter(|(name, _)| name.starts_with(prefix))
            .map(|(name, (bytes, modified))| Entry {
                name: name.clone(),
                size: bytes.len() as u64,
                modified: Some(*modified),
            })
            .collect();
        ready(Ok(entries)).boxed()
    }

    fn delete<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<(), StorageError>> {
        ready(check_name(name).map(|()| {
            self.objects().remove(name);
        }))
        .boxed()
    }

    fn size<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<u64, StorageError>> {
        ready(self.get(name).map(|bytes| bytes.len() as u64)).boxed()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn conforms() {
        super::super::conformance::check(Arc::new(MemoryStorage::new())).await;
    }
}
