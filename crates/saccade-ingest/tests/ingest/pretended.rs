//! What takes hours, on a clock that the test turns.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use glam::UVec2;
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{Cursor, Record, RecordReader};
use saccade_archive::catalog::{Catalog, Waiting};
use saccade_archive::clock::{Clock as _, PretendClock};
use saccade_archive::storage::MemoryStorage;
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{IngestOptions, Summary, run};

use crate::scope::{EXTENT, Scope, VOLUME, info, quick, tile_record};

const SIZE: UVec2 = UVec2::new(40, 30);
const MINUTE: Duration = Duration::from_secs(60);
const HOUR: Duration = Duration::from_secs(3600);

/// An archive whose time is the test's.
async fn timed(folder: &Path) -> (VisualizationArchive, Arc<PretendClock>) {
    let clock = Arc::new(PretendClock::default());
    let catalog = Catalog::create(folder.join("catalog.sqlite").as_path()).await;
    let catalog = catalog.unwrap().with_clock(clock.clone());
    let storage = Arc::new(MemoryStorage::new());
    (VisualizationArchive::from_parts(catalog, storage), clock)
}

/// Every pause takes a minute, and everything else hours.
fn patient() -> IngestOptions {
    IngestOptions {
        poll: MINUTE,
        lease: 24 * HOUR,
        keep_retired: 24 * HOUR,
        ..quick()
    }
}

/// An ingest that goes on beside the test.
fn started(
    scope: &Scope,
    archive: &VisualizationArchive,
    options: IngestOptions,
    cancel: &Cancel,
) -> tokio::task::JoinHandle<Summary> {
    let (path, archive, cancel) = (scope.path().to_owned(), archive.clone(), cancel.clone());
    tokio::spawn(async move {
        let done = run(&path, &archive, &options, &(), &cancel).await;
        done.unwrap()
    })
}

/// Turns the clock, minute by minute, until something is so.
async fn until<T>(clock: &PretendClock, mut is_so: impl AsyncFnMut() -> Option<T>) -> T {
    let wait = async {
        loop {
            if let Some(so) = is_so().await {
                return so;
            }
            clock.turn(MINUTE);
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(120), wait)
        .await
        .expect("the clock was turned for long enough")
}

/// Turns the clock to a moment, and gives work time to see it.
async fn turn_to(clock: &PretendClock, end: SystemTime) {
    while let Ok(left) = end.duration_since(clock.now())
        && !left.is_zero()
    {
        clock.turn(left.min(HOUR));
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

#[tokio::test]
async fn a_replaced_pyramid_is_kept_for_a_day_and_then_deleted() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let (archive, clock) = timed(folder.path()).await;
    let options = IngestOptions {
        once: false,
        ..patient()
    };
    let keep = options.keep_retired;
    scope.tile("a", 0, SIZE, 1);
    let cancel = Cancel::new();
    let ingest = started(&scope, &archive, options, &cancel);
    let catalog = archive.catalog();
    let position = async || {
        let tile = catalog.tile(VOLUME, "a").await.ok().flatten();
        tile.map(|tile| tile.pyramid)
    };
    let first = until(&clock, position).await;
    scope.tile("a", 0, SIZE, 2);
    let again = async || position().await.filter(|pyramid| *pyramid != first);
    until(&clock, again).await;
    let retired = catalog
        .retired(VOLUME, clock.now() + HOUR, 9)
        .await
        .unwrap();
    assert_eq!(retired.len(), 1);
    let at = retired[0].at;
    assert!(at <= clock.now() && at > clock.now() - HOUR, "{at:?}");
    let pyramids = async || archive.storage().list("tiles/").await.unwrap().len();
    turn_to(&clock, at + keep - MINUTE).await;
    assert_eq!(pyramids().await, 2, "for those who still have its name");
    until(&clock, async || (pyramids().await == 1).then_some(())).await;
    cancel.cancel();
    assert_eq!(ingest.await.unwrap().tiles, 2);
}

#[tokio::test]
async fn what_a_dead_worker_had_claimed_is_taken_up_when_its_lease_of_a_day_is_over() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let (archive, clock) = timed(folder.path()).await;
    scope.tile("a", 0, SIZE, 1);
    scope.tile("b", 1, SIZE, 2);
    let catalog = archive.catalog();
    catalog
        .create_volume(&info(EXTENT).volume().unwrap())
        .await
        .unwrap();
    let lines = RecordReader::new(scope.path(), Cursor::default())
        .read(9)
        .unwrap();
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    for line in &lines {
        let Ok(Record::Tile(record)) = line.record.clone() else {
            panic!("tiles")
        };
        let waiting = Waiting {
            position: line.offset,
            record,
            reason: String::new(),
        };
        commit.enqueue(&waiting).await.unwrap();
    }
    assert!(
        commit
            .advance(Cursor::default(), lines[1].next)
            .await
            .unwrap()
    );
    commit.finish().await.unwrap();
    let dead = catalog.register("dead", 24 * HOUR).await.unwrap();
    assert_eq!(catalog.claim(VOLUME, &dead, 9).await.unwrap().len(), 2);
    let end = clock.now() + dead.lease();

    let options = IngestOptions {
        poll: HOUR,
        ..patient()
    };
    let ingest = started(&scope, &archive, options, &Cancel::new());
    turn_to(&clock, end - MINUTE).await;
    assert_eq!(catalog.entry(VOLUME).await.unwrap().tiles, 0, "it may live");
    assert!(!ingest.is_finished());
    until(&clock, async || ingest.is_finished().then_some(())).await;
    assert_eq!(ingest.await.unwrap().tiles, 2);
    assert!(clock.now() > end);
}

#[tokio::test]
async fn a_file_that_does_not_become_whole_is_waited_for_as_long_as_is_said() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let (archive, clock) = timed(folder.path()).await;
    let whole = scope.image("a", SIZE, 1);
    std::fs::write(scope.file("a"), &whole[..whole.len() / 2]).unwrap();
    scope.say(&tile_record("a", 0, SIZE));
    let options = IngestOptions {
        patience: 120,
        ..patient()
    };
    let begin = clock.now();
    let ingest = started(&scope, &archive, options, &Cancel::new());
    until(&clock, async || ingest.is_finished().then_some(())).await;
    assert_eq!(ingest.await.unwrap().quarantined, 1);
    let set_aside = archive.catalog().quarantined(VOLUME).await.unwrap();
    assert!(set_aside[0].at >= begin + 2 * HOUR, "{set_aside:?}");
    assert!(set_aside[0].at <= clock.now());
    let reason = &set_aside[0].reason;
    assert!(reason.contains("has not changed for 7200.0 s"), "{reason}");
}
