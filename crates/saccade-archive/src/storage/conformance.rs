//! What every [`Storage`] must do. All implementations run it, also those of other crates.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;

use super::object::WHOLE;
use super::{Storage, StorageError};
use crate::clock::{Clock as _, SystemClock};

/// Checks an empty storage, and leaves it empty. Runs on a tokio runtime.
///
/// # Panics
///
/// If the storage breaks its contract: this is a test.
pub async fn check(storage: Arc<dyn Storage>) {
    let storage = storage.as_ref();
    assert_eq!(
        names(storage, "").await,
        [""; 0],
        "begin with an empty storage"
    );
    absent_objects_are_not_found(storage).await;
    objects_come_back_whole_and_in_parts(storage).await;
    later_writes_win(storage).await;
    lists_are_sorted_and_cut_by_prefix(storage).await;
    names_are_listed_as_written(storage).await;
    bad_names_are_refused(storage).await;
    readers_see_whole_objects(storage).await;
    long_objects_are_whole(storage).await;
    an_object_is_created_once(storage).await;
    for name in names(storage, "").await {
        storage.delete(&name).await.expect("delete");
    }
    assert_eq!(names(storage, "").await, [""; 0], "all were deleted");
}

async fn names(storage: &dyn Storage, prefix: &str) -> Vec<String> {
    storage.list(prefix).await.expect("list")
}

async fn write(storage: &dyn Storage, name: &str, bytes: &'static [u8]) {
    storage
        .write_durable(name, Bytes::from_static(bytes))
        .await
        .expect("write");
}

async fn absent_objects_are_not_found(storage: &dyn Storage) {
    let read = storage.read("tiles/none.tif", None).await;
    assert!(
        matches!(read, Err(StorageError::NotFound { .. })),
        "{read:?}"
    );
    let size = storage.size("tiles/none.tif").await;
    assert!(
        matches!(size, Err(StorageError::NotFound { .. })),
        "{size:?}"
    );
    storage
        .delete("tiles/none.tif")
        .await
        .expect("deleting what is absent is no error");
}

async fn objects_come_back_whole_and_in_parts(storage: &dyn Storage) {
    write(storage, "tiles/a/b.tif", b"0123456789").await;
    write(storage, "empty", b"").await;
    for (range, want) in [
        (None, &b"0123456789"[..]),
        (Some(0..10), b"0123456789"),
        (Some(3..5), b"34"),
        (Some(5..5), b""),
        (Some(8..100), b"89"),
        (Some(10..20), b""),
        (Some(u64::MAX - 1..u64::MAX), b""),
    ] {
        let got = storage
            .read("tiles/a/b.tif", range.clone())
            .await
            .expect("read");
        assert_eq!(got, want, "{range:?}");
    }
    assert_eq!(storage.size("tiles/a/b.tif").await.expect("size"), 10);
    assert_eq!(storage.read("empty", None).await.expect("read"), b""[..]);
    assert_eq!(storage.size("empty").await.expect("size"), 0);
}

async fn later_writes_win(storage: &dyn Storage) {
    write(storage, "again", b"a long first version").await;
    write(storage, "again", b"second").await;
    assert_eq!(
        storage.read("again", None).await.expect("read"),
        b"second"[..]
    );
    storage.delete("again").await.expect("delete");
    let read = storage.read("again", None).await;
    assert!(
        matches!(read, Err(StorageError::NotFound { .. })),
        "{read:?}"
    );
}

async fn lists_are_sorted_and_cut_by_prefix(storage: &dyn Storage) {
    for name in ["l/b", "l/a/z", "l/a", "lone", "l/c"]
        .into_iter()
        .filter(|n| *n != "l/a")
    {
        write(storage, name, b"x").await;
    }
    assert_eq!(names(storage, "l").await, ["l/a/z", "l/b", "l/c", "lone"]);
    assert_eq!(names(storage, "l/").await, ["l/a/z", "l/b", "l/c"]);
    assert_eq!(names(storage, "l/a").await, ["l/a/z"]);
    assert_eq!(names(storage, "l/a/z").await, ["l/a/z"]);
    assert_eq!(names(storage, "nothing/like/it").await, [""; 0]);
    for (prefix, any) in [
        ("l", true),
        ("l/a/", true),
        ("lone", true),
        ("l/d", false),
        ("no", false),
    ] {
        let held = storage.holds_any(prefix).await.expect("list");
        assert_eq!(held, any, "{prefix}");
    }
    let entries = storage.entries("l/a").await.expect("entries");
    assert_eq!(entries.len(), 1);
    assert_eq!((entries[0].name.as_str(), entries[0].size), ("l/a/z", 1));
    let age = entries[0]
        .modified
        .map(|at| SystemClock.now().duration_since(at).unwrap_or_default());
    assert!(
        age.is_none_or(|age| age < Duration::from_secs(3600)),
        "{age:?}"
    );
}

/// Some stores must encode them.
async fn names_are_listed_as_written(storage: &dyn Storage) {
    let odd = "odd/a b~c%7Ed#e?f[1]/Zellkörper*.tif";
    write(storage, odd, b"odd").await;
    assert_eq!(names(storage, "odd/").await, [odd]);
    assert_eq!(names(storage, "odd/a b~c%7E").await, [odd]);
    assert_eq!(storage.read(odd, None).await.expect("read"), b"odd"[..]);
    storage.delete(odd).await.expect("delete");
}

async fn bad_names_are_refused(storage: &dyn Storage) {
    for name in [
        "",
        "/absolute",
        "..",
        "a/../../b",
        "a//b",
        "a/",
        ".hidden",
        "a\\b",
        "a\0b",
    ] {
        let refused = |error: Option<StorageError>, what: &str| {
            assert!(
                matches!(error, Some(StorageError::Name { .. })),
                "{what} {name:?}: {error:?}"
            );
        };
        refused(storage.read(name, None).await.err(), "read");
        refused(
            storage.write_durable(name, Bytes::new()).await.err(),
            "write",
        );
        let created = storage.create_durable(name, Bytes::new()).await;
        refused(created.err(), "create");
        refused(storage.delete(name).await.err(), "delete");
        refused(storage.size(name).await.err(), "size");
    }
}

/// Two versions are written in turn while they are read: no reader sees anything else.
async fn readers_see_whole_objects(storage: &dyn Storage) {
    let versions = [vec![1; 100_000], vec![2; 70_000]].map(Bytes::from);
    storage
        .write_durable("busy", versions[0].clone())
        .await
        .expect("write");
    let writer = async {
        for turn in 0..8 {
            storage
                .write_durable("busy", versions[turn % 2].clone())
                .await
                .expect("write");
        }
    };
    let reader = async {
        for _ in 0..16 {
            let seen = storage.read("busy", None).await.expect("read");
            assert!(
                versions.contains(&seen),
                "a mixture of {} bytes was read",
                seen.len()
            );
        }
    };
    futures::join!(writer, reader);
}

/// So long that object stores take them in parts.
async fn long_objects_are_whole(storage: &dyn Storage) {
    // Of a prime length, so that parts of an object differ.
    let long = |length: usize, first: u8| {
        let some: Vec<u8> = (0..251).map(|n| n ^ first).collect();
        let mut bytes = some.repeat(length / some.len() + 1);
        bytes.truncate(length);
        Bytes::from(bytes)
    };
    let versions = [long(WHOLE + WHOLE / 2 + 3, 0), long(WHOLE + 1, 0xff)];
    let write = async |version: usize| {
        let written = storage.write_durable("long/a", versions[version].clone());
        written.await.expect("write");
    };
    for (version, bytes) in versions.iter().enumerate() {
        write(version).await;
        let size = storage.size("long/a").await.expect("size");
        assert_eq!(size, bytes.len() as u64);
        let read = storage.read("long/a", None).await.expect("read");
        assert!(read == *bytes, "a long object is not what was written");
        let middle = WHOLE / 2 - 100..WHOLE / 2 + 100;
        let range = Some(middle.start as u64..middle.end as u64);
        let read = storage.read("long/a", range).await.expect("read");
        assert_eq!(read, bytes[middle], "around its middle");
    }
    assert_eq!(names(storage, "long/").await, ["long/a"]);
    let reader = async {
        for _ in 0..4 {
            let seen = storage.read("long/a", None).await.expect("read");
            let whole = versions.contains(&seen);
            assert!(whole, "a mixture of {} bytes was read", seen.len());
        }
    };
    futures::join!(write(0), reader);
    storage.delete("long/a").await.expect("delete");
    assert_eq!(names(storage, "long/").await, [""; 0]);
}

async fn an_object_is_created_once(storage: &dyn Storage) {
    let create = async |name: &str, bytes: &[u8]| {
        let bytes = Bytes::copy_from_slice(bytes);
        storage.create_durable(name, bytes).await.expect("create")
    };
    assert_eq!(create("made/a", b"first").await, b"first"[..]);
    assert_eq!(create("made/a", b"second").await, b"first"[..]);
    assert_eq!(names(storage, "made/").await, ["made/a"]);
    write(storage, "made/a", b"in its place").await;
    assert_eq!(create("made/a", b"third").await, b"in its place"[..]);
    storage.delete("made/a").await.expect("delete");
    assert_eq!(create("made/a", b"fourth").await, b"fourth"[..]);
    for round in 0..8 {
        let name = &format!("made/{round}");
        let creators = (1..=6_u8).map(|own| create_one(storage, name, own));
        let seen = futures::future::join_all(creators).await;
        let there = storage.read(name, None).await.expect("read");
        let kept = (1..=6).any(|own| there == vec![own; 100 * usize::from(own)]);
        assert!(kept, "what is kept is nobody's: {there:?}");
        for seen in seen {
            assert!(
                seen == there,
                "of several that create one object, not all get what is kept"
            );
        }
    }
}

async fn create_one(storage: &dyn Storage, name: &str, own: u8) -> Bytes {
    let bytes = vec![own; 100 * usize::from(own)];
    let created = storage.create_durable(name, bytes.into());
    created.await.expect("create")
}

#[cfg(test)]
mod tests {
    use std::ops::Range;

    use futures::FutureExt as _;
    use futures::future::BoxFuture;

    use super::super::{Entry, MemoryStorage};
    use super::*;

    /// Looks first, and then writes.
    #[derive(Debug, Default)]
    struct Careless(MemoryStorage);

    impl Storage for Careless {
        fn read<'a>(
            &'a self,
            name: &'a str,
            range: Option<Range<u64>>,
        ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
            self.0.read(name, range)
        }

        fn write_durable<'a>(
            &'a self,
            name: &'a str,
            bytes: Bytes,
        ) -> BoxFuture<'a, Result<(), StorageError>> {
            self.0.write_durable(name, bytes)
        }

        fn create_durable<'a>(
            &'a self,
            name: &'a str,
            bytes: Bytes,
        ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
            async move {
                match self.read(name, None).await {
                    Err(StorageError::NotFound { .. }) => {}
                    there => return there,
                }
                tokio::task::yield_now().await;
                self.write_durable(name, bytes.clone()).await?;
                Ok(bytes)
            }
            .boxed()
        }

        fn entries<'a>(
            &'a self,
            prefix: &'a str,
        ) -> BoxFuture<'a, Result<Vec<Entry>, StorageError>> {
            self.0.entries(prefix)
        }

        fn delete<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<(), StorageError>> {
            self.0.delete(name)
        }

        fn size<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<u64, StorageError>> {
            self.0.size(name)
        }
    }

    #[tokio::test]
    #[should_panic(expected = "not all get what is kept")]
    async fn the_suite_notices_who_looks_and_then_writes() {
        check(Arc::new(Careless::default())).await;
    }
}
