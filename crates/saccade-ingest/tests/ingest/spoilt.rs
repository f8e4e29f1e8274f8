//! Rows of the catalog that no program of ours writes stop nothing, and go with the next record of their tile.

use std::time::Duration;

use glam::UVec2;
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{DeleteRecord, Record};
use saccade_archive::check::{CheckOptions, FindingKind, Repair, check};
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{IngestOptions, run};

use crate::scope::{Scope, VOLUME, archive, at, move_record, pixels, quick, seen, texture};

const SIZE: UVec2 = UVec2::new(140, 130);

/// What a damaged file, or somebody's hand, makes of a tile's row.
const SPOILT: [&str; 9] = [
    "width = -5",
    "height = 9223372036854775807",
    "section = -1",
    "channel = -2",
    "pyramid = '../../etc/passwd'",
    "pyramid = ''",
    "pyramid = CAST(x'fffe' AS TEXT)",
    "position = -7, transform_position = -7",
    "a = 0, d = 0, section = -1",
];

/// Does what no program should to the catalog.
async fn meddle(archive: &VisualizationArchive, statement: String) {
    let file = archive.catalog().location().to_string();
    let meddle = sqlx::SqlitePool::connect(&file).await.unwrap();
    let statement = sqlx::AssertSqlSafe(statement);
    sqlx::query(statement).execute(&meddle).await.unwrap();
    meddle.close().await;
}

async fn spoil(archive: &VisualizationArchive, tile: &str, how: &str) {
    let statement = format!("UPDATE tiles SET {how} WHERE name = '{tile}'");
    meddle(archive, statement).await;
}

/// An archive with three tiles in two sections.
async fn three() -> (Scope, tempfile::TempDir, VisualizationArchive) {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    for n in 0..3u8 {
        scope.tile(&format!("t{n}"), u32::from(n / 2), SIZE, n);
    }
    let archive = archive(folder.path()).await;
    scope.ingest(&archive).await;
    (scope, folder, archive)
}

async fn assert_whole(archive: &VisualizationArchive, tiles: &[(&str, u8)], what: &str) {
    let now = seen(archive).await;
    let names: Vec<_> = now.keys().map(String::as_str).collect();
    let want: Vec<_> = tiles.iter().map(|(name, _)| *name).collect();
    assert_eq!(names, want, "{what}");
    for (name, seed) in tiles {
        assert_eq!(pixels(&now[*name]).await, texture(SIZE, *seed), "{what}");
    }
    let options = CheckOptions {
        safe_age: Duration::from_secs(3600),
        ..CheckOptions::default()
    };
    let report = check(archive, &options, &|_, _| {}).await.unwrap();
    assert_eq!(report.findings, [], "{what}");
}

#[tokio::test]
async fn a_tiles_next_record_takes_the_place_of_a_spoilt_row() {
    for how in SPOILT {
        let (scope, _folder, archive) = three().await;
        spoil(&archive, "t1", how).await;
        // What moves it cannot be followed before its next image, and is kept until then.
        scope.say(&move_record("t1", at(30.0, 40.0)));
        scope.tile("t1", 0, SIZE, 7);
        scope.tile("t3", 1, SIZE, 3);
        assert_eq!(scope.ingest(&archive).await.tiles, 2, "{how}");
        assert_whole(&archive, &[("t0", 0), ("t1", 7), ("t2", 2), ("t3", 3)], how).await;
    }
}

#[tokio::test]
async fn a_deletion_ends_a_spoilt_row() {
    for how in SPOILT {
        let (scope, _folder, archive) = three().await;
        spoil(&archive, "t1", how).await;
        scope.say(&Record::Delete(DeleteRecord { tile: "t1".into() }));
        scope.tile("t3", 1, SIZE, 3);
        let done = scope.ingest(&archive).await;
        assert_eq!((done.tiles, done.deleted), (1, 1), "{how}");
        assert_whole(&archive, &[("t0", 0), ("t2", 2), ("t3", 3)], how).await;
    }
}

#[tokio::test]
async fn a_check_mends_what_is_not_as_the_records_say() {
    let more = [
        "name = CAST(x'ff00fe' AS TEXT)",
        "channel = 9",
        "section = 1",
        "section = 99",
        "width = 141",
    ];
    for how in SPOILT.into_iter().chain(more) {
        let (scope, _folder, archive) = three().await;
        spoil(&archive, "t1", how).await;
        let mut options = CheckOptions {
            acquisition: Some(scope.path().to_owned()),
            safe_age: Duration::ZERO,
            ..CheckOptions::default()
        };
        let found = check(&archive, &options, &|_, _| {}).await.unwrap();
        assert_eq!(found.damage(), 1, "{how}: {:?}", found.findings);
        options.repair = true;
        let report = check(&archive, &options, &|_, _| {}).await.unwrap();
        let damage = { report.findings.iter() }.filter(|f| f.kind.is_damage());
        let repairs: Vec<_> = damage.map(|f| f.repair).collect();
        assert_eq!(repairs, [Some(Repair::Queued)], "{how}");
        assert_eq!(scope.ingest(&archive).await.tiles, 1, "{how}");
        assert_whole(&archive, &[("t0", 0), ("t1", 1), ("t2", 2)], how).await;
    }
}

#[tokio::test]
async fn a_tile_that_the_catalog_lacks_is_found_in_the_records_and_made_anew() {
    let (scope, folder, archive) = three().await;
    // What was deleted, or set aside, is not lost.
    scope.tile("gone", 0, SIZE, 4);
    let gone = DeleteRecord {
        tile: "gone".into(),
    };
    scope.say(&Record::Delete(gone));
    scope.tile("outside", 99, SIZE, 5);
    scope.ingest(&archive).await;
    let whole = seen(&archive).await;
    meddle(&archive, "DELETE FROM tiles WHERE name = 't1'".into()).await;
    let pyramid = folder.path().join(&whole["t1"].pyramid);
    let mut options = CheckOptions {
        repair: true,
        safe_age: Duration::ZERO,
        ..CheckOptions::default()
    };
    // Who does not have the records learns that something is lost, as often as he looks; what may be its pyramid stays.
    for _ in 0..2 {
        let report = check(&archive, &options, &|_, _| {}).await.unwrap();
        assert_eq!(report.damage(), 1, "{:?}", report.findings);
        assert!(pyramid.is_file());
    }
    options.acquisition = Some(scope.path().to_owned());
    let report = check(&archive, &options, &|_, _| {}).await.unwrap();
    let lost: Vec<_> = { report.findings.iter() }
        .filter(|f| f.kind == FindingKind::Lost)
        .map(|f| (f.tile.as_deref(), f.repair))
        .collect();
    assert_eq!(lost, [(Some("t1"), Some(Repair::Queued))]);
    assert_eq!(report.damage(), 0);
    assert_eq!(scope.ingest(&archive).await.tiles, 1);
    assert_whole(&archive, &[("t0", 0), ("t1", 1), ("t2", 2)], "lost").await;
    let report = check(&archive, &options, &|_, _| {}).await.unwrap();
    assert_eq!(report.findings, []);
}

#[tokio::test]
async fn a_pyramid_that_a_tile_names_is_not_swept_away() {
    let (scope, folder, archive) = three().await;
    let whole = seen(&archive).await;
    meddle(
        &archive,
        "INSERT INTO retired SELECT pyramid, volume, 0 FROM tiles WHERE name = 't1'".into(),
    )
    .await;
    let options = CheckOptions::default();
    let report = check(&archive, &options, &|_, _| {}).await.unwrap();
    let found: Vec<_> = { report.findings.iter() }
        .map(|f| (f.kind, f.tile.as_deref()))
        .collect();
    assert_eq!(found, [(FindingKind::Spoilt, Some("t1"))]);
    let sweep = IngestOptions {
        keep_retired: Duration::ZERO,
        ..quick()
    };
    run(scope.path(), &archive, &sweep, &(), &Cancel::new())
        .await
        .unwrap();
    assert!(folder.path().join(&whole["t1"].pyramid).is_file());
    assert_whole(&archive, &[("t0", 0), ("t1", 1), ("t2", 2)], "swept").await;
    let later = std::time::SystemTime::now() + Duration::from_secs(60);
    let retired = archive.catalog().retired(VOLUME, later, 9).await.unwrap();
    assert_eq!(retired, []);
}

#[tokio::test]
async fn how_far_records_were_read_is_found_out_from_them() {
    let (scope, _folder, archive) = three().await;
    let read = archive.catalog().cursor(VOLUME).await.unwrap();
    meddle(&archive, "UPDATE cursors SET byte = -5".into()).await;
    scope.tile("t3", 1, SIZE, 3);
    let refused = run(scope.path(), &archive, &quick(), &(), &Cancel::new()).await;
    let told = refused.unwrap_err().to_string();
    assert!(told.contains("saccade check --repair"), "{told}");
    let mut options = CheckOptions::default();
    for (acquisition, repair, repaired) in [
        (false, false, None),
        (false, true, None),
        (true, true, Some(Repair::Reread)),
    ] {
        options.acquisition = acquisition.then(|| scope.path().to_owned());
        options.repair = repair;
        let report = check(&archive, &options, &|_, _| {}).await.unwrap();
        let found: Vec<_> = report.findings.iter().map(|f| (f.kind, f.repair)).collect();
        assert_eq!(found, [(FindingKind::Spoilt, repaired)]);
    }
    assert_eq!(archive.catalog().cursor(VOLUME).await.unwrap(), read);
    assert_eq!(scope.ingest(&archive).await.tiles, 1);
    assert_whole(
        &archive,
        &[("t0", 0), ("t1", 1), ("t2", 2), ("t3", 3)],
        "cursor",
    )
    .await;
}

#[tokio::test]
async fn what_waits_and_cannot_be_understood_is_set_aside() {
    for repair in [false, true] {
        let (scope, _folder, archive) = three().await;
        let spoilt = "INSERT INTO waiting (volume, position, tile, record, reason) \
                      SELECT volume, position, name, '{garbage', 'x' FROM tiles WHERE name = 't1'";
        meddle(&archive, spoilt.into()).await;
        let options = CheckOptions {
            repair,
            acquisition: Some(scope.path().to_owned()),
            ..CheckOptions::default()
        };
        let report = check(&archive, &options, &|_, _| {}).await.unwrap();
        let found: Vec<_> = { report.findings.iter() }
            .map(|f| (f.kind, f.tile.as_deref(), f.repair))
            .collect();
        let queued = repair.then_some(Repair::Queued);
        assert_eq!(found, [(FindingKind::Spoilt, Some("t1"), queued)]);
        scope.tile("t3", 1, SIZE, 3);
        assert_eq!(scope.ingest(&archive).await.tiles, 1 + u64::from(repair));
        let set_aside = archive.catalog().quarantined(VOLUME).await.unwrap();
        let set_aside: Vec<_> = set_aside.into_iter().map(|q| q.tile.unwrap()).collect();
        assert_eq!(set_aside, if repair { vec![] } else { vec!["t1"] });
        assert_whole(
            &archive,
            &[("t0", 0), ("t1", 1), ("t2", 2), ("t3", 3)],
            "queue",
        )
        .await;
    }
}

/// What is told of files in quarantine is for people: what can be read of it is told.
#[tokio::test]
async fn what_can_be_read_of_the_quarantine_is_told() {
    let (scope, _folder, archive) = three().await;
    let spoilt = "INSERT INTO quarantine (id, volume, file, tile, reason, bytes, at) VALUES \
                  (1, 1, CAST(x'61ff' AS TEXT), 't0', CAST(x'fe62' AS TEXT), -4, -9)";
    meddle(&archive, spoilt.into()).await;
    let told = archive
        .catalog()
        .first_quarantined(VOLUME, 9)
        .await
        .unwrap();
    assert_eq!(
        (told[0].file.as_str(), told[0].reason.as_str()),
        ("a\u{fffd}", "\u{fffd}b")
    );
    scope.tile("t0", 0, SIZE, 9);
    scope.ingest(&archive).await;
    assert_eq!(archive.catalog().quarantined(VOLUME).await.unwrap(), []);
}
