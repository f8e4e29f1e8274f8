//! Places to read from that stall, or send a byte now and then.

use super::*;
use crate::objects::{Patience, chain};
use crate::test_server::{Fault, TestServer};
use crate::zarr::ZarrSource;

/// The object that has all voxels of level 0.
const SHARD: &str = "0/c/0/0/0/0";

/// An image behind a server.
async fn served() -> (Arc<TestServer>, MemoryStorage) {
    let (source, storage) = (array(UVec3::splat(40)), MemoryStorage::new());
    let source: Arc<dyn VolumeSource> = Arc::new(source);
    let options = ExportOptions::default();
    { export(&source, &storage, &options, &|_| {}) }
        .await
        .unwrap();
    let mut objects = Vec::new();
    for name in storage.list("").await.unwrap() {
        let bytes = storage.read(&name, None).await.unwrap();
        objects.push((name, bytes));
    }
    (TestServer::start(objects).await, storage)
}

fn patience() -> Patience {
    Patience {
        attempts: 2,
        first_wait: Duration::from_millis(5),
        longest_wait: Duration::from_millis(50),
        idle: Duration::from_millis(300),
        slowest: 10_000,
    }
}

/// Of HTTP and of S3: a retried success, or a message with the chunk in it, in time.
#[test]
fn what_stalls_or_drips_is_asked_for_again_and_then_named() {
    let (whole, copies) = run(async {
        let (server, whole) = served().await;
        let mut copies = Vec::new();
        for way in 0..2 {
            for fault in [Fault::Stall, Fault::Drip, Fault::SlowHead] {
                let open = async || {
                    let store = server.stores(patience())[way].clone();
                    let source = ZarrSource::open(store, "em").await.unwrap();
                    Arc::new(source) as Arc<dyn VolumeSource>
                };
                let (once, always) = (open().await, open().await);
                let options = ExportOptions {
                    retry: Duration::from_millis(1),
                    patience: Duration::ZERO,
                    ..ExportOptions::default()
                };
                let within = Duration::from_secs(20);
                let (storage, none) = (MemoryStorage::new(), |_| {});
                server.fail_next([fault]);
                let done = tokio::time::timeout(within, export(&once, &storage, &options, &none));
                let done = done.await.expect("it ends").unwrap();
                assert_eq!(done.done, done.shards, "{fault:?}");
                copies.push((fault, storage));

                server.fail_always(SHARD, fault);
                let storage = MemoryStorage::new();
                let failed =
                    tokio::time::timeout(within, export(&always, &storage, &options, &none));
                let failed = failed.await.expect("it ends").unwrap_err();
                server.always.lock().unwrap().clear();
                let ExportError::Read { source, .. } = &failed else {
                    panic!("{fault:?}: {failed:?}")
                };
                let named = chain(source);
                assert!(
                    named.contains("channel 0 level 0 chunk") && named.contains(SHARD),
                    "{fault:?}: {named}"
                );
            }
        }
        (whole, copies)
    });
    let whole = image(&whole).1;
    for (fault, copy) in &copies {
        let copy = image(copy).1;
        for (level, (copy, whole)) in copy.iter().zip(&whole).enumerate() {
            let at = copy
                .iter()
                .zip(whole)
                .position(|(copy, whole)| copy != whole);
            assert_eq!(
                (copy.len(), at),
                (whole.len(), None),
                "{fault:?}, level {level}"
            );
        }
        assert!(!copy.is_empty(), "{fault:?}");
    }
}

/// However many attempts there could be.
#[test]
fn a_chunk_is_not_asked_for_for_ever() {
    let options = ExportOptions {
        retry: Duration::from_millis(30),
        patience: Duration::from_millis(50),
        ..ExportOptions::default()
    };
    let formula = Formula::new(1_000_000, true);
    let source: Arc<dyn VolumeSource> = formula.clone();
    let failed = run(export(&source, &MemoryStorage::new(), &options, &|_| {}));
    assert!(
        matches!(failed, Err(ExportError::Read { .. })),
        "{failed:?}"
    );
    // Two shards of eight chunks at a time: two or three attempts each instead of ten.
    let attempts = 1_000_000 - formula.failures.load(Ordering::SeqCst);
    assert!((1..=16 * 4).contains(&attempts), "{attempts} attempts");
    let told = failed.unwrap_err().to_string();
    assert!(
        [2, 3]
            .iter()
            .any(|n| told.ends_with(&format!(", though asked for {n} times"))),
        "{told}"
    );
}
