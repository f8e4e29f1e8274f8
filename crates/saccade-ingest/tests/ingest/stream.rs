//! Tiles that arrive as they should, whatever their order and whoever watches.

use std::fs;
use std::io::Write;
use std::time::Duration;

use glam::{UVec2, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{AcquisitionError, RecordReader};
use saccade_archive::catalog::{CatalogError, ChangeReason};
use saccade_archive::pyramid::Encoding;
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{IngestError, IngestOptions, Summary, run};

use crate::scope::{
    Diary, EXTENT, Scope, VOLUME, archive, at, info, move_record, orphans, pixels, quick, seen,
    texture, tile_record,
};

const SIZE: UVec2 = UVec2::new(300, 260);

#[tokio::test]
async fn pixels_arrive_as_they_left() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    let sizes = [
        SIZE,
        UVec2::new(1, 1),
        UVec2::new(128, 129),
        UVec2::new(257, 3),
    ];
    for (n, size) in (0..).zip(sizes) {
        scope.tile(&format!("t{n}"), u32::from(n), size, n);
    }
    let diary = Diary::default();
    let summary = run(scope.path(), &archive, &quick(), &diary, &Cancel::new())
        .await
        .unwrap();
    let count = sizes
        .iter()
        .map(|s| u64::from(s.x) * u64::from(s.y))
        .sum::<u64>();
    assert_eq!(
        summary,
        Summary {
            tiles: 4,
            elsewhere: 0,
            pixels: count,
            moved: 0,
            deleted: 0,
            quarantined: 0,
            early: 0,
        }
    );
    let tiles = seen(&archive).await;
    for (n, size) in (0..).zip(sizes) {
        let tile = &tiles[&format!("t{n}")];
        assert_eq!((tile.section, tile.size), (u32::from(n), size));
        assert_eq!(tile.transform, at(10.0, 20.0).elements());
        let values = pixels(tile).await;
        assert!(values == texture(size, n), "tile {n}");
        assert!(
            size == UVec2::ONE || values != texture(size, n + 1),
            "another image differs"
        );
    }
    let last = *diary.states().last().unwrap();
    assert_eq!((last.tiles, last.pixels, last.queued), (4, count, 0));
    assert!(diary.notices().is_empty());
    assert!(orphans(&archive).await.is_empty());

    // Once more is nothing more.
    let revision = archive.catalog().revision(VOLUME).await.unwrap();
    assert_eq!(scope.ingest(&archive).await, Summary::default());
    assert_eq!(archive.catalog().revision(VOLUME).await.unwrap(), revision);
}

#[tokio::test]
async fn jpeg_is_close_and_lossless_is_not_jpeg() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    scope.tile("a", 0, SIZE, 1);
    let options = IngestOptions {
        encoding: Encoding::Jpeg { quality: 95 },
        ..quick()
    };
    run(scope.path(), &archive, &options, &(), &Cancel::new())
        .await
        .unwrap();
    let tile = &seen(&archive).await["a"];
    let (got, want) = (pixels(tile).await, texture(SIZE, 1));
    assert_ne!(got, want);
    let error: u64 = got
        .iter()
        .zip(&want)
        .map(|(a, b)| u64::from(a.abs_diff(*b)))
        .sum();
    assert!(
        error < 8 * want.len() as u64,
        "mean error {}",
        error as f64 / want.len() as f64
    );
}

#[tokio::test]
async fn a_tile_imaged_again_takes_its_own_place() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    scope.tile("a", 3, SIZE, 1);
    scope.ingest(&archive).await;
    let first = seen(&archive).await["a"].clone();

    let smaller = UVec2::new(200, 100);
    scope.tile("a", 3, smaller, 2);
    scope.ingest(&archive).await;
    let tiles = seen(&archive).await;
    assert_eq!(tiles.len(), 1);
    assert_eq!(tiles["a"].size, smaller);
    assert_eq!(pixels(&tiles["a"]).await, texture(smaller, 2));
    // Whoever still reads the old one can, for a while.
    assert_ne!(tiles["a"].pyramid, first.pyramid);
    assert_eq!(
        archive.storage().read(&first.pyramid, None).await.unwrap(),
        first.bytes
    );

    tokio::time::sleep(Duration::from_millis(5)).await;
    let options = IngestOptions {
        keep_retired: Duration::ZERO,
        ..quick()
    };
    run(scope.path(), &archive, &options, &(), &Cancel::new())
        .await
        .unwrap();
    assert_eq!(
        archive.storage().list("tiles/").await.unwrap(),
        [tiles["a"].pyramid.clone()]
    );
}

#[tokio::test]
async fn transforms_come_early_and_late() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    scope.say(&move_record("early", at(100.0, 100.0)));
    scope.tile("early", 0, SIZE, 1);
    scope.tile("late", 0, SIZE, 2);
    scope.say(&move_record("never", at(1.0, 1.0)));
    assert_eq!(scope.ingest(&archive).await.early, 1);
    scope.say(&move_record("late", at(200.0, 200.0)));
    let summary = scope.ingest(&archive).await;
    assert_eq!((summary.tiles, summary.moved, summary.early), (0, 1, 1));
    let tiles = seen(&archive).await;
    assert_eq!(tiles["early"].transform, at(100.0, 100.0).elements());
    assert_eq!(tiles["late"].transform, at(200.0, 200.0).elements());
    let changes = archive.catalog().changes_after(VOLUME, 2).await.unwrap();
    assert_eq!(changes.len(), 1, "old and new place meet");
    assert_eq!(changes[0].reason, ChangeReason::Transform);
    assert_eq!(changes[0].voxels.min, UVec3::new(10, 20, 0));
    assert_eq!(changes[0].voxels.max, UVec3::new(500, 460, 1));
}

/// The whole way while it is watched: records before their files, files that grow, half lines.
/// Waits until so many tiles wait.
async fn still_waiting(archive: &VisualizationArchive, tiles: u64) {
    let reached = async {
        while archive.catalog().statistics(VOLUME).await.unwrap().waiting != tiles {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    let reached = tokio::time::timeout(Duration::from_secs(30), reached).await;
    reached.unwrap_or_else(|_| panic!("there are never {tiles} that wait"));
}

#[tokio::test]
async fn a_stream_is_followed_until_cancelled() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    archive
        .catalog()
        .create_volume(&info(EXTENT).volume().unwrap())
        .await
        .unwrap();
    let mut revision = archive.catalog().subscribe(VOLUME).await.unwrap();
    let cancel = Cancel::new();
    let options = IngestOptions {
        once: false,
        patience: 1_000_000,
        ..quick()
    };
    let ingest = {
        let (archive, cancel) = (archive.clone(), cancel.clone());
        let path = scope.path().to_owned();
        tokio::spawn(async move { run(&path, &archive, &options, &(), &cancel).await })
    };
    let wait = |wanted: u64, revision: &tokio::sync::watch::Receiver<u64>| {
        let mut revision = revision.clone();
        async move {
            let reached = revision.wait_for(|r| *r >= wanted);
            tokio::time::timeout(Duration::from_secs(30), reached)
                .await
                .expect("in time")
                .unwrap();
        }
    };

    scope.tile("a", 0, SIZE, 1);
    wait(1, &revision).await;

    // The record before its file, the file in two pieces; the next tile does not wait for it.
    scope.say(&tile_record("b", 0, SIZE));
    let whole = {
        let other = Scope::new();
        other.image("b", SIZE, 2)
    };
    fs::write(scope.file("b"), &whole[..whole.len() / 2]).unwrap();
    scope.tile("c", 0, SIZE, 3);
    wait(2, &revision).await;
    let names: Vec<_> = seen(&archive).await.into_keys().collect();
    assert_eq!(names, ["a", "c"]);
    // That it has to wait may be found out after the next tile is in.
    still_waiting(&archive, 1).await;
    fs::write(scope.file("b"), &whole).unwrap();
    wait(3, &revision).await;
    still_waiting(&archive, 0).await;

    // A line in two pieces.
    scope.image("d", SIZE, 4);
    let line = serde_json::to_string(&tile_record("d", 0, SIZE)).unwrap();
    let mut list = fs::OpenOptions::new()
        .append(true)
        .open(scope.path().join(RecordReader::FILE))
        .unwrap();
    list.write_all(&line.as_bytes()[..20]).unwrap();
    tokio::time::sleep(Duration::from_millis(20)).await;
    list.write_all(&line.as_bytes()[20..]).unwrap();
    list.write_all(b"\n").unwrap();
    wait(4, &revision).await;
    assert_eq!(*revision.borrow_and_update(), 4);

    cancel.cancel();
    let summary = ingest.await.unwrap().unwrap();
    assert_eq!((summary.tiles, summary.quarantined), (4, 0));
    let tiles = seen(&archive).await;
    for (n, tile) in (1..).zip(tiles.values()) {
        assert_eq!(pixels(tile).await, texture(SIZE, n));
    }
}

#[tokio::test]
async fn a_record_that_waits_survives_the_process() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    scope.say(&tile_record("a", 0, SIZE));
    let cancel = Cancel::new();
    let options = IngestOptions {
        once: false,
        patience: 1_000_000,
        ..quick()
    };
    let (ended, ()) = tokio::join!(run(scope.path(), &archive, &options, &(), &cancel), async {
        while archive
            .catalog()
            .waiting(VOLUME)
            .await
            .map_or(0, |w| w.len())
            == 0
        {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        cancel.cancel();
    });
    ended.unwrap();
    assert!(seen(&archive).await.is_empty());
    // Its line was read, and is not read again; but the tile comes.
    scope.image("a", SIZE, 9);
    assert_eq!(scope.ingest(&archive).await.tiles, 1);
    assert_eq!(pixels(&seen(&archive).await["a"]).await, texture(SIZE, 9));
}

#[tokio::test]
async fn wrong_archives_are_refused() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    scope.ingest(&archive).await;
    let fails = async |path: &std::path::Path, options: &IngestOptions| {
        run(path, &archive, options, &(), &Cancel::new())
            .await
            .unwrap_err()
    };

    let nowhere = fails(&scope.path().join("nowhere"), &quick()).await;
    assert!(nowhere.to_string().contains("nowhere"), "{nowhere}");
    let empty = tempfile::tempdir().unwrap();
    let empty = fails(empty.path(), &quick()).await;
    assert!(empty.to_string().contains("volume.json"), "{empty}");

    info(EXTENT + UVec3::X).write(scope.path()).unwrap();
    let other = fails(scope.path(), &quick()).await;
    assert!(
        matches!(
            other,
            IngestError::Catalog(CatalogError::WrongVolume { what: "extent", .. })
        ),
        "{other}"
    );
    // As the message advises.
    let renamed = IngestOptions {
        volume: Some("other".to_owned()),
        ..quick()
    };
    run(scope.path(), &archive, &renamed, &(), &Cancel::new())
        .await
        .unwrap();

    info(UVec3::new(10, 0, 10)).write(scope.path()).unwrap();
    let flat = fails(scope.path(), &quick()).await;
    assert!(
        matches!(
            flat,
            IngestError::Acquisition(AcquisitionError::Volume { .. })
        ),
        "{flat}"
    );
}
