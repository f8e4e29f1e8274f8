use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::{Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use futures::FutureExt as _;
use futures::future::{BoxFuture, ready};

use super::{Storage, StorageError, check_name};

/// Objects in memory, for tests and for demonstrations that leave nothing behind.
#[derive(Debug, Default)]
pub struct MemoryStorage {
    objects: Mutex<BTreeMap<String, Bytes>>,
}

impl MemoryStorage {
    /// An empty storage.
    pub fn new() -> Self {
        Self::default()
    }

    fn objects(&self) -> MutexGuard<'_, BTreeMap<String, Bytes>> {
        // Every change below is a single insertion or removal: whole even after a panic.
        self.objects.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn get(&self, name: &str) -> Result<Bytes, StorageError> {
        check_name(name)?;
        let found = self.objects().get(name).cloned();
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
            self.objects().insert(name.to_owned(), bytes);
        }))
        .boxed()
    }

    fn list<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<Vec<String>, StorageError>> {
        let names = self
            .objects()
            .keys()
            .filter(|n| n.starts_with(prefix))
            .cloned()
            .collect();
        ready(Ok(names)).boxed()
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
    use std::sync::Arc;

    use super::*;

    #[tokio::test]
    async fn conforms() {
        super::super::conformance::check(Arc::new(MemoryStorage::new())).await;
    }
}
