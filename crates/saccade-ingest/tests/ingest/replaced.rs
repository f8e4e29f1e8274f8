//! Another acquisition in the place of the one that was read: refused before anything of it is mixed in, or of the
//! first one lost.

use std::fs;
use std::path::Path;
use std::time::Duration;

use glam::UVec2;
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{AcquisitionError, Cursor, Record, RecordReader};
use saccade_archive::catalog::{Catalog, Waiting};
use saccade_ingest::ingest::{IngestError, IngestOptions, run};
use saccade_ingest::{Cancel, HeldUp};

use crate::scope::{Diary, Scope, VOLUME, archive, quick, seen, tile_record};

const SIZE: UVec2 = UVec2::new(140, 130);

/// An acquisition of so many tiles; those of another microscope have other names, as long.
fn acquired(prefix: &str, tiles: u32) -> Scope {
    let scope = Scope::new();
    for n in 0..tiles {
        scope.tile(
            &format!("{prefix}{n}"),
            n,
            SIZE,
            7 + u8::try_from(n).unwrap(),
        );
    }
    scope
}

/// More of them.
fn many(prefix: &str, tiles: u64) -> Scope {
    let scope = Scope::new();
    for n in 0..tiles {
        let size = UVec2::new(9, 8);
        let (section, seed) = (u32::try_from(n % 20).unwrap(), u8::try_from(n).unwrap());
        scope.tile(&format!("{prefix}{n}"), section, size, seed);
    }
    scope
}

async fn refused(scope: &Path, archive: &VisualizationArchive) -> AcquisitionError {
    match run(scope, archive, &quick(), &(), &Cancel::new()).await {
        Err(IngestError::Acquisition(error)) => error,
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn a_second_acquisition_is_refused_and_welcome_under_another_name() {
    for first in [1, 3] {
        let folder = tempfile::tempdir().unwrap();
        let archive = archive(folder.path()).await;
        acquired("a", first).ingest(&archive).await;
        let before = (
            seen(&archive).await,
            archive.catalog().statistics(VOLUME).await.unwrap(),
        );
        for second in [first, first + 4] {
            let scope = acquired("b", second);
            let error = refused(scope.path(), &archive).await;
            let told = error.to_string();
            for part in [
                "--volume NAME",
                "another archive",
                "tiles.jsonl",
                &format!("{first} lines"),
            ] {
                assert!(told.contains(part), "{part:?} is not in: {told}");
            }
            assert!(
                matches!(error, AcquisitionError::RecordsReplaced { .. }),
                "{error:?}"
            );
            let after = (
                seen(&archive).await,
                archive.catalog().statistics(VOLUME).await.unwrap(),
            );
            assert!(after == before, "nothing happened");
            let options = IngestOptions {
                volume: Some(format!("of{second}")),
                ..quick()
            };
            let done = run(scope.path(), &archive, &options, &(), &Cancel::new())
                .await
                .unwrap();
            assert_eq!(done.tiles, u64::from(second));
        }
        let shorter = Scope::new();
        assert!(matches!(
            refused_or_cut(&shorter, &archive).await,
            AcquisitionError::RecordsCut { len: 1, .. }
        ));
    }
}

/// With records of one byte.
async fn refused_or_cut(scope: &Scope, archive: &VisualizationArchive) -> AcquisitionError {
    fs::write(scope.path().join(RecordReader::FILE), "\n").unwrap();
    refused(scope.path(), archive).await
}

/// What an ended ingest has left in the queue has names that another acquisition's images may have as well.
#[tokio::test]
async fn what_is_queued_is_not_looked_for_in_others_images() {
    let (scope, folder) = (acquired("a", 2), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    scope.ingest(&archive).await;
    // The next record was read, and then it ended.
    let Record::Tile(record) = tile_record("b2", 2, SIZE) else {
        panic!("a tile")
    };
    scope.say(&Record::Tile(record.clone()));
    let catalog = archive.catalog();
    let read = catalog.cursor(VOLUME).await.unwrap();
    let mut reader = RecordReader::new(scope.path(), read);
    reader.read(9).unwrap();
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    let reason = String::new();
    let position = read.offset;
    commit
        .enqueue(&Waiting {
            position,
            record,
            reason,
        })
        .await
        .unwrap();
    assert!(commit.advance(read, reader.cursor()).await.unwrap());
    commit.finish().await.unwrap();

    refused(acquired("b", 7).path(), &archive).await;
    assert_eq!(catalog.tile(VOLUME, "b2").await.unwrap(), None);
    // The queue is as it was.
    scope.image("b2", SIZE, 1);
    assert_eq!(scope.ingest(&archive).await.tiles, 1);
}

/// Two begin at once, on a volume of which nothing was read: whoever reads first says whose it is.
#[tokio::test]
async fn what_another_acquisition_s_ingest_reads_first_is_left_to_it() {
    let (ours, other) = (acquired("a", 3), acquired("b", 5));
    // Images that the other's records would find as well.
    for n in 0..3 {
        other.image(&format!("a{n}"), SIZE, 200);
    }
    let text = fs::read(other.path().join(RecordReader::FILE)).unwrap();
    fs::remove_file(other.path().join(RecordReader::FILE)).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path()).await;
    let options = IngestOptions {
        once: false,
        batch: 1,
        ..quick()
    };
    let (diary, cancel) = (Diary::default(), Cancel::new());
    let work = run(other.path(), &archive, &options, &diary, &cancel);
    let begin = async {
        while diary.states().is_empty() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        // Read, and not worked on yet.
        let catalog = archive.catalog();
        let mut reader = RecordReader::new(ours.path(), Cursor::default());
        let mut commit = catalog.begin(VOLUME).await.unwrap();
        for line in reader.read(9).unwrap() {
            let Ok(Record::Tile(record)) = line.record else {
                panic!("a tile")
            };
            let (position, reason) = (line.offset, String::new());
            let waiting = Waiting {
                position,
                record,
                reason,
            };
            commit.enqueue(&waiting).await.unwrap();
        }
        let read = reader.cursor();
        assert!(commit.advance(Cursor::default(), read).await.unwrap());
        commit.finish().await.unwrap();
        tokio::time::sleep(Duration::from_millis(100)).await;
        assert_eq!(catalog.entry(VOLUME).await.unwrap().tiles, 0);
        fs::write(other.path().join(RecordReader::FILE), text).unwrap();
    };
    let (done, ()) = tokio::join!(work, begin);
    let Err(IngestError::Acquisition(error)) = done else {
        panic!("{done:?}")
    };
    assert!(
        matches!(error, AcquisitionError::RecordsReplaced { .. }),
        "{error:?}"
    );
    // All of it is there for the first.
    assert_eq!(ours.ingest(&archive).await.tiles, 3);
    let alone = {
        let folder = tempfile::tempdir().unwrap();
        let archive = crate::scope::archive(folder.path()).await;
        ours.ingest(&archive).await;
        seen(&archive).await
    };
    assert!(seen(&archive).await == alone);
}

#[tokio::test]
async fn records_replaced_while_they_are_followed_end_it() {
    for (count, in_place) in [(3, false), (9, false), (3, true), (9, true)] {
        let (scope, folder) = (acquired("a", 3), tempfile::tempdir().unwrap());
        let archive = archive(folder.path()).await;
        let options = IngestOptions {
            once: false,
            ..quick()
        };
        let (diary, cancel) = (Diary::default(), Cancel::new());
        let work = run(scope.path(), &archive, &options, &diary, &cancel);
        let replace = async {
            while diary.states().last().is_none_or(|s| s.tiles < 3) {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
            let other = acquired("b", count);
            let records = scope.path().join(RecordReader::FILE);
            let text = fs::read(other.path().join(RecordReader::FILE)).unwrap();
            if in_place {
                fs::write(&records, text).unwrap();
            } else {
                let part = records.with_extension("part");
                fs::write(&part, text).unwrap();
                fs::rename(part, records).unwrap();
            }
        };
        let both = async { tokio::join!(work, replace) };
        let both = tokio::time::timeout(Duration::from_secs(60), both).await;
        let ended = both.expect("it is noticed").0;
        let noticed = match &ended {
            Err(IngestError::Acquisition(AcquisitionError::RecordsReplaced { line, .. })) => {
                *line == 3
            }
            // Caught while they were shorter.
            Err(IngestError::Acquisition(AcquisitionError::RecordsCut { .. })) => in_place,
            _ => false,
        };
        assert!(noticed, "{count} in place {in_place}: {ended:?}");
        assert_eq!(seen(&archive).await.len(), 3);
    }
}

/// As a copying program or an editor does it: cut to nothing, grown again, whole, and then longer.
#[tokio::test]
async fn records_that_are_written_anew_are_waited_for() {
    // So many that they are known before they are whole, and so few that they are not.
    for count in [3, 40] {
        let (scope, folder) = (many("a", count), tempfile::tempdir().unwrap());
        let archive = archive(folder.path()).await;
        let options = IngestOptions {
            once: false,
            patience: 100_000,
            ..quick()
        };
        let (diary, cancel) = (Diary::default(), Cancel::new());
        let work = run(scope.path(), &archive, &options, &diary, &cancel);
        let until = async |there: &dyn Fn() -> bool| {
            while !there() {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        let taken_in = |tiles| diary.states().last().is_some_and(|s| s.tiles >= tiles);
        let told = |what: &str| diary.notices().iter().filter(|n| n.contains(what)).count();
        let rewrite = async {
            until(&|| taken_in(count)).await;
            let records = scope.path().join(RecordReader::FILE);
            let text = fs::read(&records).unwrap();
            for turn in 1..=2 {
                fs::write(&records, "").unwrap();
                until(&|| told("waited for") == turn).await;
                assert!(diary.held_up().is_some(), "people see why it waits");
                for len in [1, text.len() / 2, text.len() - 1] {
                    fs::write(&records, &text[..len]).unwrap();
                    tokio::time::sleep(Duration::from_millis(10)).await;
                }
                fs::write(&records, &text).unwrap();
                until(&|| told("whole again") == turn).await;
                assert_eq!(diary.held_up(), None);
            }
            scope.tile("later", 3, SIZE, 99);
            until(&|| taken_in(count + 1)).await;
            cancel.cancel();
        };
        let both = async { tokio::join!(work, rewrite) };
        let both = tokio::time::timeout(Duration::from_secs(60), both).await;
        assert_eq!(both.expect("it goes on").0.unwrap().tiles, count + 1);
    }
}

/// Not for ever; and what comes in their place is looked at once there is enough of it.
#[tokio::test]
async fn records_that_stay_cut_or_become_others_are_refused() {
    for others in [false, true] {
        let (scope, folder) = (many("a", 40), tempfile::tempdir().unwrap());
        let archive = archive(folder.path()).await;
        scope.ingest(&archive).await;
        let records = scope.path().join(RecordReader::FILE);
        let text = if others {
            fs::read(many("b", 39).path().join(RecordReader::FILE)).unwrap()
        } else {
            fs::read(&records).unwrap()
        };
        fs::write(&records, &text[..text.len() - 200]).unwrap();
        let options = IngestOptions {
            once: false,
            // Others are known at once.
            patience: if others { 100_000_000 } else { 5 },
            ..quick()
        };
        let (diary, cancel) = (Diary::default(), Cancel::new());
        let work = run(scope.path(), &archive, &options, &diary, &cancel);
        let ended = tokio::time::timeout(Duration::from_secs(60), work).await;
        match ended.expect("it ends") {
            Err(IngestError::Acquisition(AcquisitionError::RecordsReplaced {
                line: 40, ..
            })) => {
                assert!(others);
            }
            Err(IngestError::Acquisition(AcquisitionError::RecordsCut { .. })) => {
                assert!(!others);
                assert_eq!(diary.notices().len(), 1, "{:?}", diary.notices());
            }
            other => panic!("{other:?}"),
        }
        assert_eq!(seen(&archive).await.len(), 40);
    }
}

#[tokio::test]
async fn catalogs_of_earlier_versions_learn_what_was_read() {
    let (scope, folder) = (acquired("a", 3), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    scope.ingest(&archive).await;
    let read = archive.catalog().cursor(VOLUME).await.unwrap();
    let mut commit = archive.catalog().begin(VOLUME).await.unwrap();
    commit.cursor(Cursor { seen: None, ..read }).await.unwrap();
    commit.finish().await.unwrap();
    assert_eq!(scope.ingest(&archive).await.tiles, 0);
    assert_eq!(archive.catalog().cursor(VOLUME).await.unwrap(), read);
    refused(acquired("b", 7).path(), &archive).await;
}

/// As where a backup of another archive's catalog was restored over it.
#[tokio::test]
async fn nothing_is_entered_in_another_archives_catalog_and_work_goes_on_in_the_right_one() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path()).await;
    let scope = acquired("a", 1);
    let (cancel, held_up) = (Cancel::new(), HeldUp::default());
    let options = IngestOptions {
        once: false,
        held_up: Some(held_up.clone()),
        ..quick()
    };
    let ingest = run(scope.path(), &archive, &options, &(), &cancel);
    let catalog = archive.catalog();
    let look = async {
        let wait = Duration::from_millis(5);
        let tiles = async |of: &Catalog| of.entry(VOLUME).await.map_or(0, |entry| entry.tiles);
        while tiles(catalog).await < 1 {
            tokio::time::sleep(wait).await;
        }
        let ours = catalog.identity().await.unwrap().unwrap();
        let path = folder.path().join(VisualizationArchive::CATALOG);
        let becomes = async |identity: &str| {
            let pool = sqlx::SqlitePool::connect(path.to_str().unwrap()).await;
            let pool = pool.unwrap();
            let query = sqlx::query("UPDATE archive SET identity = ?").bind(identity);
            query.execute(&pool).await.unwrap();
            pool.close().await;
        };
        becomes(&"f".repeat(32)).await;
        scope.tile("late", 2, SIZE, 99);
        let is_told = || {
            let reasons = held_up.now();
            { reasons.iter() }.any(|reason| {
                reason.why.contains("catalog of another archive")
                    && reason.why.contains("put the right one back")
            })
        };
        while !is_told() {
            tokio::time::sleep(wait).await;
        }
        let theirs = Catalog::open(path.as_path()).await.unwrap();
        tokio::time::sleep(40 * wait).await;
        assert_eq!(tiles(&theirs).await, 1);
        theirs.close().await;
        becomes(&ours).await;
        while tiles(catalog).await < 2 {
            tokio::time::sleep(wait).await;
        }
        while is_told() {
            tokio::time::sleep(wait).await;
        }
        cancel.cancel();
    };
    let both = async { futures::join!(ingest, look).0 };
    let done = tokio::time::timeout(Duration::from_secs(120), both).await;
    assert_eq!(done.expect("it goes on").unwrap().tiles, 2);
}
