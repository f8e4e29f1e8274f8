//! Rows of the catalog that no program of ours writes.

use std::fs;

use glam::{DVec2, DVec3, UVec2, UVec3};
use saccade_core::transform::SectionFromTile;
use saccade_core::volume::Volume;
use sqlx::{ConnectOptions as _, Connection as _};

use super::audit::move_it;
use super::*;
use crate::acquisition::AcquisitionInfo;

#[tokio::test]
async fn tiles_outside_of_the_volume_are_moved_to_where_their_records_say() {
    let fixture = Fixture::new().await;
    let moved = SectionFromTile::translation(DVec2::new(40.0, 7.0));
    let position = fixture.append(&move_it("t2", moved)).await;
    let catalog = fixture.archive.catalog();
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    commit.transform("t2", moved, Some(position)).await.unwrap();
    commit.finish().await.unwrap();
    fixture
        .meddle(&["UPDATE tiles SET tx = 1e6 WHERE name IN ('t2', 't3')"])
        .await;
    let of = |n: u32| (FindingKind::Misplaced, format!("t{n}"));
    // Without the records nothing is known, and what to do is told.
    let mut options = CheckOptions {
        repair: true,
        ..CheckOptions::default()
    };
    let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
    let found: Vec<_> = { report.findings.iter() }
        .map(|f| ((f.kind, f.tile.clone().unwrap()), f.repair))
        .collect();
    assert_eq!(found, [(of(2), None), (of(3), None)]);
    let reason = &report.findings[0].reason;
    assert!(
        reason.contains("--acquisition") && reason.contains("saccade update"),
        "{reason}"
    );
    assert_eq!(report.damage(), 2);

    options.acquisition = Some(fixture.acquisition.path().to_owned());
    let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
    let repairs: Vec<_> = report.findings.iter().map(|f| f.repair).collect();
    assert_eq!(
        (repairs, report.damage()),
        (vec![Some(Repair::Moved); 2], 0)
    );
    let of = async |name: &str| catalog.tile(VOLUME, name).await.unwrap().unwrap().transform;
    assert_eq!(of("t2").await, moved);
    assert_eq!(of("t3").await, of("t4").await);
    assert_eq!(fixture.check(false).await.findings, []);
}

/// Rows that only a damaged file, or somebody's hand, can make so.
#[tokio::test]
async fn tiles_that_lie_nowhere_are_found_beside_others_and_moved_to_where_their_records_say() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    fixture
        .meddle(&[
            "UPDATE tiles SET a = 0, b = 0 WHERE name = 't2'",
            "UPDATE tiles SET revision = -1 WHERE name = 't4'",
        ])
        .await;
    let told = catalog.tile(VOLUME, "t2").await.unwrap_err();
    let told = told.to_string();
    for word in ["\"t2\"", "cannot be inverted", "saccade check --repair"] {
        assert!(told.contains(word), "{told}");
    }
    fs::remove_file(fixture.path(3)).unwrap();
    let of = |kind, n: u32| (kind, format!("t{n}"));
    let mut options = CheckOptions {
        repair: true,
        safe_age: Duration::ZERO,
        ..CheckOptions::default()
    };
    // Of t3 it is said that it is missing, for it was looked at, too.
    for (acquisition, repaired) in [
        (None, [None, Some(Repair::Quarantined), None]),
        (
            Some(fixture.acquisition.path().to_owned()),
            [
                Some(Repair::Moved),
                Some(Repair::Queued),
                Some(Repair::Queued),
            ],
        ),
    ] {
        options.acquisition = acquisition;
        let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
        let found: Vec<_> = { report.findings.iter() }
            .map(|f| {
                of(
                    f.kind,
                    f.tile.as_ref().map_or(9, |t| t[1..].parse().unwrap()),
                )
            })
            .collect();
        let want = [
            of(FindingKind::Spoilt, 2),
            of(FindingKind::Missing, 3),
            of(FindingKind::Spoilt, 4),
        ];
        assert_eq!(found, want);
        assert_eq!(report.tiles, u64::from(TILES));
        let repairs: Vec<_> = report.findings.iter().map(|f| f.repair).collect();
        assert_eq!(repairs, repaired);
        let then = match options.acquisition {
            None => "once more",
            Some(_) => "revision",
        };
        for (n, word) in [(0, "cannot be inverted"), (2, then)] {
            let reason = &report.findings[n].reason;
            assert!(reason.contains(word), "{reason}");
        }
    }
    let moved = catalog.tile(VOLUME, "t2").await.unwrap().unwrap();
    assert_eq!(
        moved.transform,
        SectionFromTile::translation(DVec2::splat(3.0))
    );
    // What the other needs: its record once more.
    let tile = NewTile {
        name: "t4".to_owned(),
        section: 2,
        channel: 0,
        size: UVec2::new(200, 150),
        transform: moved.transform,
        pyramid: fixture.names[4].clone(),
        position: 1 << 20,
    };
    catalog.commit_tile(VOLUME, &tile).await.unwrap();
    let found = fixture.check(false).await.findings;
    assert_eq!(found.len(), 1, "{found:?}");
    assert_eq!(found[0].kind, FindingKind::Missing);
}

#[tokio::test]
async fn volumes_that_cannot_be_understood_are_told_and_nothing_of_theirs_is_deleted() {
    let other = Volume::new("w", UVec3::splat(64), DVec3::ONE).unwrap();
    for spoilt in [
        "'?' || description",
        "replace(description, '\"v\"', '\"u\"')",
        "json_set(description, '$.levels', json('[]'))",
        "json_set(description, '$.channels', json('[]'))",
        "json_set(description, '$.chunk', json('[64,0,64]'))",
    ] {
        let fixture = Fixture::new().await;
        let catalog = fixture.archive.catalog();
        catalog.create_volume(&other).await.unwrap();
        let statement = format!("UPDATE volumes SET description = {spoilt} WHERE name = 'v'");
        fixture.meddle(&[&statement]).await;
        let listed = catalog.volumes().await.unwrap();
        let listed: Vec<_> = { listed.into_iter() }
            .map(|listed| (listed.name, listed.entry.ok().map(|entry| entry.volume)))
            .collect();
        let want = [
            ("v".to_owned(), None),
            ("w".to_owned(), Some(other.clone())),
        ];
        assert_eq!(listed, want, "{spoilt}");
        let entry = catalog.entry(VOLUME).await.unwrap_err();
        let begun = catalog.begin(VOLUME).await.unwrap_err();
        for error in [entry, begun] {
            assert!(
                matches!(&error, CatalogError::SpoiltVolume { name, .. } if name == "v"),
                "{error}"
            );
        }
        let options = CheckOptions {
            repair: true,
            safe_age: Duration::ZERO,
            ..CheckOptions::default()
        };
        let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
        let [found] = &report.findings[..] else {
            panic!("{spoilt}: {:?}", report.findings);
        };
        assert_eq!(
            (found.kind, found.volume.as_deref(), found.repair),
            (FindingKind::Spoilt, Some("v"), None)
        );
        assert_eq!(report.damage(), 1);
        assert!((0..6).all(|n| fixture.path(n).is_file()), "{spoilt}");
    }
}

#[tokio::test]
async fn a_volume_without_a_name_keeps_nobody_from_the_others() {
    let other = Volume::new("w", UVec3::splat(64), DVec3::ONE).unwrap();
    let third = Volume::new("x", UVec3::splat(64), DVec3::ONE).unwrap();
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    catalog.create_volume(&other).await.unwrap();
    fixture
        .meddle(&["UPDATE volumes SET name = CAST(x'fffe' AS TEXT) WHERE name = 'v'"])
        .await;
    let listed = catalog.volumes().await.unwrap();
    let listed: Vec<_> = { listed.into_iter() }
        .map(|listed| (listed.name, listed.entry.is_ok()))
        .collect();
    assert_eq!(
        listed,
        [
            ("w".to_owned(), true),
            ("\u{fffd}\u{fffd}".to_owned(), false)
        ]
    );
    catalog.create_volume(&third).await.unwrap();
    let options = CheckOptions {
        repair: true,
        safe_age: Duration::ZERO,
        ..CheckOptions::default()
    };
    let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
    let found: Vec<_> = report.findings.iter().map(|f| (f.kind, f.repair)).collect();
    assert_eq!(found, [(FindingKind::Spoilt, None)]);
    assert!((0..6).all(|n| fixture.path(n).is_file()));
}

#[tokio::test]
async fn a_volume_that_is_larger_than_its_acquisition_says_is_found() {
    let fixture = Fixture::new().await;
    let info = AcquisitionInfo::new(VOLUME, UVec3::new(900, 900, 8), DVec3::ONE);
    info.write(fixture.acquisition.path()).unwrap();
    let options = CheckOptions {
        acquisition: Some(fixture.acquisition.path().to_owned()),
        ..CheckOptions::default()
    };
    let found = async || {
        let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
        let findings = report.findings.into_iter();
        let found: Vec<_> = findings.map(|f| (f.kind, f.tile)).collect();
        found
    };
    assert_eq!(found().await, []);
    for extent in [[901, 900, 8], [u32::MAX; 3]] {
        let extent = format!(
            "UPDATE volumes SET description = json_set(description, '$.levels[0].extent', json('{extent:?}'))"
        );
        fixture.meddle(&[&extent]).await;
        assert_eq!(found().await, [(FindingKind::Spoilt, None)], "{extent}");
    }
}

#[tokio::test]
async fn who_names_anothers_pyramid_gets_one_of_its_own() {
    // Of those that share it, the owner is the first or the last that is met; or it is nobody's.
    for (owner, others) in [(0, [3, 5]), (4, [1, 2])] {
        let fixture = Fixture::new().await;
        let share = |n: u32| {
            format!(
                "UPDATE tiles SET pyramid = '{}' WHERE name = 't{n}'",
                fixture.names[owner]
            )
        };
        fixture
            .meddle(&others.map(share).each_ref().map(String::as_str))
            .await;
        let report = fixture.check(false).await;
        let want = others.map(|n| (FindingKind::Shared, format!("t{n}")));
        let found: Vec<_> = { report.findings.iter() }
            .filter(|f| f.kind != FindingKind::Orphan)
            .map(|f| (f.kind, f.tile.clone().unwrap()))
            .collect();
        assert_eq!(found, want);
        assert!(
            report.findings[0]
                .reason
                .contains(&format!("of tile t{owner}"))
        );
        let options = CheckOptions {
            repair: true,
            acquisition: Some(fixture.acquisition.path().to_owned()),
            ..CheckOptions::default()
        };
        let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
        let repairs: Vec<_> = report.findings.iter().map(|f| f.repair).collect();
        assert_eq!(
            (repairs, report.damage()),
            (vec![Some(Repair::Queued); 2], 0)
        );
        let catalog = fixture.archive.catalog();
        let waiting = catalog.waiting(VOLUME).await.unwrap().into_iter();
        let waiting: Vec<_> = waiting.map(|w| w.record.tile).collect();
        assert_eq!(waiting, others.map(|n| format!("t{n}")));
        // Who looks before they are made anew finds them missing, and on their way.
        let again = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
        let again: Vec<_> = again.findings.iter().map(|f| (f.kind, f.repair)).collect();
        assert_eq!(again, [(FindingKind::Missing, Some(Repair::Queued)); 2]);
        assert_eq!(catalog.waiting(VOLUME).await.unwrap().len(), 2);
        // What was the owner's is so still, and nobody else's.
        let origins = catalog
            .origins(VOLUME, &fixture.names[owner])
            .await
            .unwrap();
        assert_eq!(origins.len(), 1);
        assert_eq!(origins[0].tile, format!("t{owner}"));
    }
}

#[tokio::test]
async fn wrong_counts_are_made_right() {
    let fixture = Fixture::new().await;
    fixture
        .meddle(&[
            "UPDATE volumes SET tiles = 99",
            "DELETE FROM sections WHERE section = 1",
        ])
        .await;
    let mut options = CheckOptions::default();
    let catalog = fixture.archive.catalog();
    for (repair, expected) in [(false, None), (true, Some(Repair::Recounted))] {
        options.repair = repair;
        let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
        let found: Vec<_> = report.findings.iter().map(|f| (f.kind, f.repair)).collect();
        assert_eq!(found, [(FindingKind::Miscounted, expected)]);
        assert_eq!(report.damage(), usize::from(!repair));
    }
    assert_eq!(catalog.entry(VOLUME).await.unwrap().tiles, u64::from(TILES));
    assert_eq!(catalog.sections(VOLUME).await.unwrap(), [0, 1, 2]);
    let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
    assert_eq!(report.findings, []);
}

/// Nothing looks for tiles of a volume that is not there.
#[tokio::test]
async fn what_a_row_of_no_volume_names_is_told_and_not_deleted() {
    let statements = [
        "PRAGMA foreign_keys = OFF",
        "UPDATE tiles SET volume = 2",
        "UPDATE volumes SET tiles = 0",
        "DELETE FROM sections",
    ];
    let fixture = Fixture::new().await;
    let file = fixture.folder.path().join("catalog.sqlite");
    let options = sqlx::sqlite::SqliteConnectOptions::new().filename(file);
    let mut meddle = options.foreign_keys(false).connect().await.unwrap();
    for statement in statements {
        sqlx::query(statement).execute(&mut meddle).await.unwrap();
    }
    meddle.close().await.unwrap();
    let stray = fixture.folder.path().join("tiles/v/000000/stray-7.tif");
    fs::write(&stray, "stray").unwrap();
    let options = CheckOptions {
        repair: true,
        safe_age: Duration::ZERO,
        ..CheckOptions::default()
    };
    for gone in [true, false] {
        let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
        let [lost, findings @ ..] = &report.findings[..] else {
            panic!("nothing is found");
        };
        for word in ["number 2", "6 of its tiles", "--acquisition"] {
            assert!(lost.reason.contains(word), "{}", lost.reason);
        }
        let (strays, others): (Vec<_>, Vec<_>) =
            { findings.iter() }.partition(|f| f.kind == FindingKind::Spoilt);
        let told: Vec<_> = { strays.iter() }
            .map(|f| (f.tile.clone().unwrap(), f.repair))
            .collect();
        let want: Vec<_> = (0..TILES).map(|n| (format!("t{n}"), None)).collect();
        assert_eq!((told, report.damage()), (want, 7));
        for word in [
            "no volume of its number 2",
            "never deleted",
            "--acquisition",
        ] {
            assert!(strays[0].reason.contains(word), "{}", strays[0].reason);
        }
        // What is nobody's is still deleted.
        let others: Vec<_> = others.iter().map(|f| (f.kind, f.repair)).collect();
        let want = (FindingKind::Orphan, Some(Repair::Deleted));
        assert_eq!(others, vec![want; usize::from(gone)]);
        assert!((0..6).all(|n| fixture.path(n).is_file()) && !stray.exists());
    }
}

/// Without foreign keys, which a file has only for who asks for them.
async fn lose_volume(fixture: &Fixture) {
    let lose = "PRAGMA foreign_keys = OFF; DELETE FROM volumes; PRAGMA foreign_keys = ON";
    fixture.meddle(&[lose]).await;
}

#[tokio::test]
async fn a_volume_that_was_lost_is_told_and_gets_its_tiles_again() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    let before = catalog.entry(VOLUME).await.unwrap();
    lose_volume(&fixture).await;
    // However young its pyramids are.
    for safe_age in [Duration::ZERO, Duration::from_secs(3600)] {
        for (quick, repair) in [(false, false), (true, false), (false, true)] {
            let options = CheckOptions {
                quick,
                repair,
                acquisition: repair.then(|| fixture.acquisition.path().to_owned()),
                safe_age,
                ..CheckOptions::default()
            };
            let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
            let [found] = &report.findings[..] else {
                panic!("{:?}", report.findings);
            };
            assert_eq!(found.volume.as_deref(), Some(VOLUME));
            assert!(found.reason.contains("saccade ingest"), "{}", found.reason);
            assert_eq!((report.damage(), report.young), (1, 0));
        }
    }
    assert!(fixture.has_all());
    // Another takes neither its number nor its tiles.
    let other = Volume {
        name: "other".to_owned(),
        ..before.volume.clone()
    };
    catalog.create_volume(&other).await.unwrap();
    assert_eq!(catalog.entry("other").await.unwrap().tiles, 0);
    assert_eq!(catalog.tile("other", "t0").await.unwrap(), None);
    assert_eq!(catalog.cursor("other").await.unwrap(), Cursor::default());
    // It does.
    catalog.create_volume(&before.volume).await.unwrap();
    assert_eq!(catalog.entry(VOLUME).await.unwrap(), before);
    assert_eq!(fixture.look(false).await.findings, []);
}

#[tokio::test]
async fn no_volume_gets_a_number_whose_records_were_read() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    let volume = catalog.entry(VOLUME).await.unwrap().volume;
    lose_volume(&fixture).await;
    fixture.meddle(&["DELETE FROM tiles"]).await;
    catalog.create_volume(&volume).await.unwrap();
    // Its records are read from the first on.
    assert_eq!(catalog.cursor(VOLUME).await.unwrap(), Cursor::default());
}

/// A section that a row's pyramid was not made for.
#[tokio::test]
async fn a_tile_in_another_section_than_its_pyramid_is_told_without_records() {
    let fixture = Fixture::new().await;
    fixture
        .meddle(&["UPDATE tiles SET section = section + 1 WHERE name = 't5'"])
        .await;
    let told = fixture.check(false).await;
    let reasons: Vec<_> = { told.findings.iter() }.map(|f| &f.reason).collect();
    assert!(
        { reasons.iter() }
            .any(|reason| reason.contains("section 3, its pyramid was made for section 2")),
        "{reasons:?}"
    );
    assert_eq!(fixture.look(true).await.damage(), 0);
    fixture.ingest().await;
    assert_eq!(fixture.look(false).await.damage(), 0);
    let sound = fixture.archive.catalog().tile(VOLUME, "t5").await.unwrap();
    assert_eq!(sound.unwrap().section, 2);
}

#[tokio::test]
async fn rows_of_no_volume_whose_tiles_came_again_are_taken_out() {
    let fixture = Fixture::new().await;
    let lose = "PRAGMA foreign_keys = OFF; UPDATE tiles SET volume = 3 WHERE name = 't2'; PRAGMA foreign_keys = ON";
    fixture.meddle(&[lose]).await;
    assert!(fixture.look(true).await.damage() > 0);
    let catalog = fixture.archive.catalog();
    assert_eq!(catalog.lost_volumes().await.unwrap().len(), 1);
    fixture.ingest().await;
    assert_eq!(fixture.look(true).await.damage(), 0);
    assert_eq!(catalog.lost_volumes().await.unwrap(), []);
    assert!(catalog.tile(VOLUME, "t2").await.unwrap().is_some());
    assert_eq!(fixture.look(false).await.findings, []);
}

#[tokio::test]
async fn a_count_that_cannot_be_keeps_nobody_from_a_volume() {
    let fixture = Fixture::new().await;
    fixture.meddle(&["UPDATE volumes SET tiles = -1"]).await;
    let catalog = fixture.archive.catalog();
    assert!(catalog.tile(VOLUME, "t2").await.unwrap().is_some());
    let counted = [(FindingKind::Miscounted, Some(Repair::Recounted))];
    let report = fixture.look(true).await;
    let found: Vec<_> = { report.findings.iter() }
        .map(|f| (f.kind, f.repair))
        .collect();
    assert_eq!(found, counted);
    assert_eq!(catalog.entry(VOLUME).await.unwrap().tiles, u64::from(TILES));
}
