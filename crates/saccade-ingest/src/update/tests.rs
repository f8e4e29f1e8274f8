use std::time::SystemTime;

use glam::{DVec2, DVec3, UVec2, UVec3};
use saccade_archive::acquisition::{Cursor, TileRecord};
use saccade_archive::catalog::{NewTile, Quarantined, Waiting};
use saccade_core::transform::SectionFromTile;
use saccade_core::volume::Volume;
use tempfile::TempDir;

use super::*;

const VOLUME: &str = "cortex";

/// A catalog whose tiles `s{section}_{n}` were told of in the first thousand bytes of records.
async fn catalog(folder: &TempDir, sections: u32, each: u32) -> Catalog {
    let catalog = Catalog::create(&folder.path().join("catalog.sqlite")).await;
    let catalog = catalog.unwrap();
    let volume = Volume::new(VOLUME, UVec3::new(500, 500, sections), DVec3::ONE).unwrap();
    catalog.create_volume(&volume).await.unwrap();
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    for n in 0..sections * each {
        let tile = tile(n / each, n % each, n.into());
        commit.tile(&tile, SystemTime::now()).await.unwrap();
    }
    let cursor = Cursor {
        offset: 1000,
        line: 9,
        seen: None,
    };
    commit.cursor(cursor).await.unwrap();
    commit.finish().await.unwrap();
    catalog
}

fn tile(section: u32, n: u32, position: u64) -> NewTile {
    NewTile {
        name: format!("s{section}_{n}"),
        section,
        channel: 0,
        size: UVec2::splat(64),
        transform: SectionFromTile::translation(DVec2::new(f64::from(n), 0.0)),
        pyramid: format!("{section}/{n}/{position}"),
        position,
    }
}

fn moved(tile: &str, x: f64) -> String {
    format!(r#"{{"record": "transform", "tile": "{tile}", "transform": [1, 0, 0, 1, {x}, 2]}}"#)
}

fn deleted(tile: &str) -> String {
    format!(r#"{{"record": "delete", "tile": "{tile}"}}"#)
}

fn lines(text: &[String]) -> Vec<Line> {
    read(text.join("\n").as_bytes(), "a file").unwrap()
}

async fn apply_all(catalog: &Catalog, text: &[String]) -> Summary {
    apply(catalog, VOLUME, &lines(text), &Cancel::new())
        .await
        .unwrap()
}

#[tokio::test]
async fn what_is_said_becomes_so_and_what_cannot_be_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let catalog = catalog(&folder, 2, 3).await;
    let changes = [
        moved("s0_0", 30.0),
        String::new(),
        moved("s0_1", 40.5),
        moved("typo", 3.0),
        moved("s0_2", 9000.0),
        deleted("s1_0"),
        deleted("s1_9"),
        moved("s1_0", 1.0),
    ];
    let summary = apply_all(&catalog, &changes).await;
    assert!(!summary.is_all());
    assert_eq!(
        (
            summary.moved,
            summary.unchanged,
            summary.deleted,
            summary.unknown,
            summary.refused
        ),
        (2, 0, 1, 3, 1)
    );
    // By their lines in the file.
    let told = summary.not_applied.join("\n");
    assert!(
        told.contains("line 4: the volume has no tile \"typo\""),
        "{told}"
    );
    assert!(
        told.contains("line 5: ") && told.contains("outside"),
        "{told}"
    );
    let place = |name: &'static str| {
        let catalog = catalog.clone();
        async move {
            let tile = catalog.tile(VOLUME, name).await.unwrap();
            tile.map(|tile| tile.transform.elements()[4])
        }
    };
    assert_eq!(place("s0_0").await, Some(30.0));
    assert_eq!(place("s0_1").await, Some(40.5));
    assert_eq!(place("s0_2").await, Some(2.0));
    assert_eq!(place("s1_0").await, None);

    // Again, nothing changes.
    let revision = catalog.revision(VOLUME).await.unwrap();
    let again = apply_all(&catalog, &changes[..3]).await;
    assert_eq!((again.moved, again.unchanged), (0, 2));
    assert!(again.is_all());
    assert_eq!(catalog.revision(VOLUME).await.unwrap(), revision);

    // The microscope's next image of a tile lies where its own record says, also of a deleted one.
    for (section, n) in [(0, 0), (1, 0)] {
        let tile = tile(section, n, 1000);
        let mut commit = catalog.begin(VOLUME).await.unwrap();
        commit.tile(&tile, SystemTime::now()).await.unwrap();
        commit.finish().await.unwrap();
    }
    assert_eq!(place("s0_0").await, Some(0.0));
    assert_eq!(place("s1_0").await, Some(0.0));
    // Who does not know whether a deletion took effect says it again.
    apply_all(&catalog, &[deleted("s1_2")]).await;
    let again = apply_all(&catalog, &[deleted("s1_2"), deleted("s1_7")]).await;
    assert_eq!((again.deleted, again.unchanged, again.unknown), (0, 1, 1));
    let twice = apply_all(&catalog, &[deleted("s0_1"), deleted("s0_1")]).await;
    assert_eq!((twice.deleted, twice.unchanged, twice.unknown), (1, 1, 0));
    // Also of one that was moved before, not of one that is to lie somewhere after its end.
    let moved_and_ended = [moved("s0_2", 7.0), deleted("s0_2")];
    let first = apply_all(&catalog, &moved_and_ended).await;
    assert_eq!((first.moved, first.deleted, first.unknown), (1, 1, 0));
    let again = apply_all(&catalog, &moved_and_ended).await;
    assert_eq!((again.unchanged, again.unknown), (2, 0));
    let after = apply_all(&catalog, &[deleted("s0_2"), moved("s0_2", 7.0)]).await;
    assert_eq!((after.unchanged, after.unknown), (1, 1));
    let told = &after.not_applied[0];
    assert!(
        told.contains("line 2") && told.contains("was deleted"),
        "{told}"
    );
    // What it said before does not bring one back.
    apply_all(&catalog, &[deleted("s1_1")]).await;
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    commit
        .tile(&tile(1, 1, 900), SystemTime::now())
        .await
        .unwrap();
    commit.finish().await.unwrap();
    assert_eq!(place("s1_1").await, None);
}

/// A newer image that was announced comes, whether its record was read before or after the deletion, also one that was set
/// aside since it did not come; an older one does not.
#[tokio::test]
async fn a_deletion_ends_no_image_that_is_still_to_come() {
    let folder = tempfile::tempdir().unwrap();
    let catalog = catalog(&folder, 1, 5).await;
    let announced = |n: u32, position: u64| {
        let tile = tile(0, n, position);
        Waiting {
            position,
            record: TileRecord {
                tile: tile.name,
                file: "again.tif".to_owned(),
                section: 0,
                size: tile.size,
                transform: tile.transform,
                channel: None,
            },
            reason: "not there".to_owned(),
        }
    };
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    for (n, position) in [(0, 500), (0, 700), (2, 2)] {
        commit.wait(&announced(n, position)).await.unwrap();
    }
    // What never came twice, and what is broken; the same of what came once more since.
    for (n, position, awaited) in [
        (3, 600, true),
        (3, 800, true),
        (3, 700, false),
        (4, 3, true),
        (4, 700, false),
    ] {
        let waiting = announced(n, position);
        let what = Quarantined {
            file: waiting.record.file,
            tile: Some(waiting.record.tile),
            reason: waiting.reason,
            bytes: None,
            at: SystemTime::now(),
            awaited: awaited.then_some(position),
        };
        commit.quarantine(&what).await.unwrap();
    }
    commit.finish().await.unwrap();
    let ended = [0, 1, 2, 3, 4].map(|n| deleted(&format!("s0_{n}")));
    let summary = apply_all(&catalog, &ended).await;
    assert_eq!((summary.deleted, summary.unknown), (5, 0));
    let awaited = async || {
        let set_aside = catalog.quarantined(VOLUME).await.unwrap();
        { set_aside.iter() }
            .map(|one| (one.tile.clone().unwrap(), one.awaited))
            .collect::<Vec<_>>()
    };
    let third = |position| ("s0_3".to_owned(), Some(position));
    assert_eq!(awaited().await, [third(600), third(800)]);
    // Where they lie afterwards.
    let comes = async |n: u32, position: u64| {
        let mut commit = catalog.begin(VOLUME).await.unwrap();
        let tile = tile(0, n, position);
        commit.tile(&tile, SystemTime::now()).await.unwrap();
        commit.finish().await.unwrap();
        catalog.tile(VOLUME, &tile.name).await.unwrap().is_some()
    };
    assert!(!comes(0, 0).await, "what was deleted stays so");
    assert!(comes(0, 500).await);
    assert!(!comes(1, 500).await, "what nobody has announced was read");
    assert!(comes(1, 1000).await);
    assert!(
        !comes(2, 2).await,
        "what is worked on again is the deleted one"
    );
    assert!(comes(0, 700).await);
    assert!(comes(3, 600).await);
    assert_eq!(awaited().await, [third(800)]);
    assert!(!comes(4, 700).await, "of what is broken nothing comes");
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    commit.take_up(&announced(3, 800)).await.unwrap();
    commit.finish().await.unwrap();
    assert_eq!(awaited().await, [], "it is in the queue");
    assert!(comes(3, 800).await);
}

#[test]
fn wrong_lines_are_named_with_their_file() {
    let refuse = |text: &str| match read(text.as_bytes(), "moves.jsonl") {
        Err(UpdateError::Lines { mistakes, name }) => {
            assert_eq!(name, "moves.jsonl");
            mistakes
        }
        other => panic!("{text}: {other:?}"),
    };
    let good = moved("a", 1.0);
    let tile = r#"{"record": "tile", "tile": "a", "file": "a.tif", "section": 0, "size": [1, 1], "transform": [1, 0, 0, 1, 0, 0]}"#;
    for (wrong, says) in [
        ("{", "line 3: "),
        (r#"{"record": "move", "tile": "a"}"#, "move"),
        (r#"{"record": "transform", "tile": "a"}"#, "transform"),
        (
            r#"{"record": "transform", "tile": "a", "transform": [0, 0, 0, 0, 0, 0]}"#,
            "line 3: ",
        ),
        (tile, "`saccade ingest`"),
    ] {
        let mistakes = refuse(&format!("{good}\n\n{wrong}\n{good}"));
        assert!(
            mistakes.contains("line 3: ") && mistakes.contains(says),
            "{mistakes}"
        );
    }
    let many = refuse(&"x\n".repeat(10));
    assert!(
        many.contains("line 3") && many.ends_with("and 7 more lines"),
        "{many}"
    );
    let long = refuse(&format!("{good}\n{}", " ".repeat(1 << 20)));
    assert!(long.contains("line 2 is no record"), "{long}");
    assert_eq!(read(&b""[..], "nothing").unwrap(), []);
    let null = refuse(&format!("{good}\n\nnull"));
    assert!(null.contains("line 3: it is no object"), "{null}");
    let marked = read(format!("\u{feff}{good}\n").as_bytes(), "marked");
    assert_eq!(marked.unwrap(), lines(&[good]));
}

/// Whoever looks sees all of a section's tiles where they were, or all where they are now.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_section_moves_at_once() {
    const SECTIONS: u32 = 6;
    const EACH: u32 = 200;
    let folder = tempfile::tempdir().unwrap();
    let catalog = catalog(&folder, SECTIONS, EACH).await;
    let before = catalog.revision(VOLUME).await.unwrap();
    let names = (0..SECTIONS * EACH).map(|n| format!("s{}_{}", n / EACH, n % EACH));
    let changes = lines(&names.map(|name| moved(&name, 300.0)).collect::<Vec<_>>());
    let looking = {
        let catalog = catalog.clone();
        tokio::spawn(async move {
            let mut between = 0;
            loop {
                let mut all = 0;
                for section in 0..SECTIONS {
                    let tiles = catalog.section_tiles(VOLUME, section).await.unwrap();
                    let there = |tile: &&saccade_archive::catalog::Tile| {
                        tile.transform.elements()[4] == 300.0
                    };
                    let moved = tiles.iter().filter(there).count();
                    assert!(
                        moved == 0 || moved == tiles.len(),
                        "{moved} of {}",
                        tiles.len()
                    );
                    all += usize::from(moved > 0);
                }
                between += u32::from(all > 0 && all < SECTIONS as usize);
                if all == SECTIONS as usize {
                    return between;
                }
            }
        })
    };
    let summary = apply(&catalog, VOLUME, &changes, &Cancel::new())
        .await
        .unwrap();
    assert_eq!(summary.moved, u64::from(SECTIONS * EACH));
    looking.await.unwrap();
    // Whoever has the volume open is told what to draw again.
    let changed = catalog.changes_after(VOLUME, before).await.unwrap();
    assert!(format!("{changed:?}").contains("Transform"), "{changed:?}");
}

#[test]
fn what_makes_no_sense_is_refused_as_by_ingest() {
    let line = |more: &str| {
        format!(
            r#"{{"record": "transform", "tile": "s0_0", "transform": [1, 0, 0, 1, 3, 2]{more}}}"#
        )
    };
    let refused = |text: &str| read(text.as_bytes(), "a file").unwrap_err().to_string();
    assert_eq!(lines(&[line("")]).len(), 1);
    let said = refused(&line(r#", "section": 3"#));
    assert!(
        said.contains("line 1: \"section\" means nothing here"),
        "{said}"
    );
    let said = refused(r#"{"record": "delete", "tile": "a", "file": "b"}"#);
    assert!(
        said.contains("\"file\"") && said.contains("nothing was changed"),
        "{said}"
    );
    let small = r#"{"record": "transform", "tile": "s0_0", "transform": [1e-9, 0, 0, 1, 0, 0]}"#;
    let said = refused(small);
    assert!(
        said.contains("smaller than a 512th") && said.contains("check the transform"),
        "{said}"
    );
}

#[test]
fn who_meets_a_full_disk_is_told_how_many_lines_took_effect() {
    let said = |done| {
        let source = CatalogError::UnknownVolume {
            name: VOLUME.to_owned(),
            known: Vec::new(),
        };
        UpdateError::Catalog {
            source,
            done,
            all: 9,
        }
        .to_string()
    };
    assert!(
        said(0).contains("none of the 9 lines took effect"),
        "{}",
        said(0)
    );
    assert!(
        said(4).contains("of 9 lines the first 4 took effect"),
        "{}",
        said(4)
    );
}

#[tokio::test]
async fn who_cancels_is_told_what_is_left() {
    let folder = tempfile::tempdir().unwrap();
    let catalog = catalog(&folder, 1, 2).await;
    let cancel = Cancel::new();
    cancel.cancel();
    let changes = lines(&[moved("s0_0", 30.0), moved("s0_1", 30.0)]);
    let summary = apply(&catalog, VOLUME, &changes, &cancel).await.unwrap();
    assert_eq!((summary.moved, summary.left), (0, 2));
    assert!(!summary.is_all());
}
