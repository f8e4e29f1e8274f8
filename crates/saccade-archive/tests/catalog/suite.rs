//! Order, revisions, boxes, all or nothing, several processes.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, SystemTime};

use glam::{DVec2, DVec3, UVec2, UVec3};
use proptest::prelude::*;
use saccade_archive::acquisition::{Cursor, TileRecord};
use saccade_archive::catalog::{
    CHANGES_AT_ONCE, Catalog, CatalogChange, CatalogError, ChangeReason, Commit, DeleteOutcome,
    NewTile, Quarantined, Statistics, TileId, TileOutcome, TransformOutcome, Waiting,
    place as cover,
};
use saccade_core::transform::SectionFromTile;
use saccade_core::volume::{Dtype, Volume, VoxelKind};

use crate::place::Place;

pub(crate) const EXTENT: UVec3 = UVec3::new(100, 80, 6);
pub(crate) const SIZE: UVec2 = UVec2::new(20, 10);

pub(crate) fn volume(name: &str) -> Volume {
    Volume::new(name, EXTENT, DVec3::new(4.0, 4.0, 40.0)).unwrap()
}

pub(crate) fn at(x: f64, y: f64) -> SectionFromTile {
    SectionFromTile::translation(DVec2::new(x, y))
}

pub(crate) fn tile(name: &str, section: u32, transform: SectionFromTile, position: u64) -> NewTile {
    NewTile {
        name: name.to_owned(),
        section,
        channel: 0,
        size: SIZE,
        transform,
        pyramid: format!("tiles/{name}.{position}.tif"),
        position,
    }
}

pub(crate) async fn all_changes(catalog: &Catalog) -> Vec<CatalogChange> {
    let mut all = Vec::new();
    loop {
        let after = all.last().map_or(0, |c: &CatalogChange| c.revision);
        let next = catalog.changes_after("v", after).await.unwrap();
        if next.is_empty() {
            return all;
        }
        all.extend(next);
    }
}

/// Section, transform and pyramid of each tile, by name.
pub(crate) type Tiles = BTreeMap<String, (u32, [f64; 6], String)>;

/// Everything a reader sees of the tiles, without what depends on the way they came.
pub(crate) async fn tiles(catalog: &Catalog) -> Tiles {
    let mut all = Tiles::new();
    for z in catalog.sections("v").await.unwrap() {
        for t in catalog.section_tiles("v", z).await.unwrap() {
            assert_eq!((t.section, t.size), (z, SIZE));
            all.insert(t.name, (t.section, t.transform.elements(), t.pyramid));
        }
    }
    all
}

pub(crate) async fn a_tile_is_what_was_entered(place: &Place) {
    let catalog = place.catalog().await;
    let turned = SectionFromTile::rotated(SIZE.as_dvec2(), 0.1, DVec2::new(3.0, 4.5));
    assert_eq!(
        catalog
            .commit_tile("v", &tile("a", 2, turned, 0))
            .await
            .unwrap(),
        TileOutcome::New
    );
    let seen = catalog.section_tiles("v", 2).await.unwrap();
    assert_eq!(seen.len(), 1);
    assert_eq!(
        (seen[0].name.as_str(), seen[0].size, seen[0].transform),
        ("a", SIZE, turned)
    );
    assert_eq!(
        (seen[0].pyramid.as_str(), seen[0].revision),
        ("tiles/a.0.tif", 1)
    );
    assert_eq!(
        catalog.tile("v", "a").await.unwrap().as_ref(),
        Some(&seen[0])
    );
    assert_eq!(catalog.tile("v", "b").await.unwrap(), None);
    assert_eq!(catalog.section_tiles("v", 1).await.unwrap(), []);
    assert_eq!(catalog.volume("v").await.unwrap(), volume("v"));
    let changes = all_changes(&catalog).await;
    assert_eq!(changes.len(), 1);
    assert_eq!(changes[0].voxels, cover(EXTENT, 2, SIZE, turned).unwrap());
    assert_eq!(
        (changes[0].reason, changes[0].tile),
        (ChangeReason::Tile, seen[0].id)
    );
}

pub(crate) async fn a_moved_tile_changes_its_old_and_its_new_place(place: &Place) {
    let catalog = place.catalog().await;
    catalog
        .commit_tile("v", &tile("a", 2, at(0.0, 0.0), 0))
        .await
        .unwrap();
    let box_at = |z, x, y| cover(EXTENT, z, SIZE, at(x, y)).unwrap();

    // A little: one change around both. Far: one each, and nothing in between.
    catalog.set_transform("v", "a", at(5.0, 0.0)).await.unwrap();
    catalog
        .set_transform("v", "a", at(70.0, 60.0))
        .await
        .unwrap();
    // Imaged again in another section.
    let again = tile("a", 4, at(70.0, 60.0), 7);
    let outcome = catalog.commit_tile("v", &again).await.unwrap();
    assert_eq!(outcome, TileOutcome::Elsewhere { from: 2 });
    let boxes: Vec<_> = all_changes(&catalog)
        .await
        .iter()
        .map(|c| c.voxels)
        .collect();
    let want = [
        box_at(2, 0.0, 0.0),
        box_at(2, 0.0, 0.0).union(box_at(2, 5.0, 0.0)),
        box_at(2, 5.0, 0.0),
        box_at(2, 70.0, 60.0),
        box_at(2, 70.0, 60.0),
        box_at(4, 70.0, 60.0),
    ];
    assert_eq!(boxes, want);
    assert_eq!(catalog.revision("v").await.unwrap(), 6);
    assert_eq!(catalog.changes_after("v", 4).await.unwrap().len(), 2);

    // The same again is no change.
    let same = catalog
        .set_transform("v", "a", at(70.0, 60.0))
        .await
        .unwrap();
    assert_eq!(same, TransformOutcome::Unchanged);
    assert_eq!(catalog.revision("v").await.unwrap(), 6);
}

pub(crate) async fn nothing_leaves_the_volume(place: &Place) {
    let catalog = place.catalog().await;
    for outside in [
        tile("a", 6, at(0.0, 0.0), 0),
        tile("a", 0, at(100.0, 0.0), 0),
        tile("a", 0, at(-20.0, 0.0), 0),
        tile("a", 0, at(0.0, 1e30), 0),
    ] {
        let refused = catalog.commit_tile("v", &outside).await;
        assert!(
            matches!(refused, Err(CatalogError::OutsideVolume { .. })),
            "{outside:?}"
        );
    }
    // One voxel inside is inside.
    catalog
        .commit_tile("v", &tile("a", 5, at(99.0, 79.0), 0))
        .await
        .unwrap();
    let refused = catalog.set_transform("v", "a", at(300.0, 0.0)).await;
    assert!(matches!(refused, Err(CatalogError::OutsideVolume { .. })));
    let stayed = catalog.tile("v", "a").await.unwrap().unwrap();
    assert_eq!((stayed.transform, stayed.revision), (at(99.0, 79.0), 1));
}

pub(crate) async fn an_early_transform_waits_for_its_tile(place: &Place) {
    let catalog = place.catalog().await;
    let kept = catalog.set_transform("v", "a", at(7.0, 7.0)).await.unwrap();
    assert_eq!(kept, TransformOutcome::Kept);
    assert_eq!(catalog.revision("v").await.unwrap(), 0);
    catalog
        .commit_tile("v", &tile("a", 0, at(1.0, 1.0), 10))
        .await
        .unwrap();
    assert_eq!(
        catalog.tile("v", "a").await.unwrap().unwrap().transform,
        at(7.0, 7.0)
    );
    // It counted once: the next image brings its own.
    catalog
        .commit_tile("v", &tile("a", 0, at(2.0, 2.0), 20))
        .await
        .unwrap();
    assert_eq!(
        catalog.tile("v", "a").await.unwrap().unwrap().transform,
        at(2.0, 2.0)
    );
}

pub(crate) async fn a_deleted_tile_is_gone_until_a_later_record_brings_it_back(place: &Place) {
    let catalog = place.catalog().await;
    let begin = SystemTime::now() - Duration::from_secs(1);
    let a = tile("a", 2, at(5.0, 6.0), 10);
    catalog.commit_tile("v", &a).await.unwrap();
    let id = catalog.tile("v", "a").await.unwrap().unwrap().id;
    catalog
        .commit_tile("v", &tile("b", 3, at(0.0, 0.0), 11))
        .await
        .unwrap();
    catalog.quarantine("v", &broken("a")).await.unwrap();

    let older = catalog.delete_tile("v", "a", 9).await.unwrap();
    assert_eq!(older, DeleteOutcome::Unchanged);
    let gone = catalog.delete_tile("v", "a", 20).await.unwrap();
    assert_eq!(gone, DeleteOutcome::Deleted);
    let again = catalog.delete_tile("v", "a", 21).await.unwrap();
    assert_eq!(again, DeleteOutcome::Unchanged);
    assert_eq!(catalog.tile("v", "a").await.unwrap(), None);
    assert_eq!(catalog.tiles("v", &[id]).await.unwrap(), []);
    assert_eq!(catalog.section_tiles("v", 2).await.unwrap(), []);
    assert_eq!(catalog.sections("v").await.unwrap(), [3]);
    assert_eq!(catalog.entry("v").await.unwrap().tiles, 1);
    assert_eq!(catalog.quarantined("v").await.unwrap(), []);
    let retired = catalog
        .retired("v", SystemTime::now() + Duration::from_secs(9), 9)
        .await
        .unwrap();
    assert_eq!(retired.len(), 1);
    assert_eq!(retired[0].pyramid, a.pyramid);
    assert!(retired[0].at > begin);
    let changes = all_changes(&catalog).await;
    let last = changes.last().unwrap();
    let want = (3, id, 2, ChangeReason::Deleted);
    assert_eq!((last.revision, last.tile, last.section, last.reason), want);
    assert_eq!(last.voxels, cover(EXTENT, 2, SIZE, at(5.0, 6.0)).unwrap());

    // What was said before stays without effect, whenever it comes.
    let late = catalog
        .commit_tile("v", &tile("a", 2, at(0.0, 0.0), 15))
        .await
        .unwrap();
    assert_eq!(late, TileOutcome::Superseded);
    let mut commit = catalog.begin("v").await.unwrap();
    let late = commit.transform("a", at(1.0, 1.0), Some(16)).await.unwrap();
    assert_eq!(late, TransformOutcome::Unchanged);
    // What is said later is of a new tile, with its old id.
    let kept = commit.transform("a", at(2.0, 2.0), Some(25)).await.unwrap();
    assert_eq!(kept, TransformOutcome::Kept);
    commit.finish().await.unwrap();
    let back = catalog
        .commit_tile("v", &tile("a", 4, at(9.0, 9.0), 30))
        .await
        .unwrap();
    assert_eq!(back, TileOutcome::New);
    let back = catalog.tile("v", "a").await.unwrap().unwrap();
    assert_eq!(
        (back.id, back.section, back.transform),
        (id, 4, at(2.0, 2.0))
    );
    assert_eq!(catalog.sections("v").await.unwrap(), [3, 4]);

    // A tile that never came can be deleted as well; its id is nobody else's.
    let noted = catalog.delete_tile("v", "never", 40).await.unwrap();
    assert_eq!(noted, DeleteOutcome::Noted);
    let late = catalog
        .commit_tile("v", &tile("never", 0, at(0.0, 0.0), 39))
        .await
        .unwrap();
    assert_eq!(late, TileOutcome::Superseded);
    assert_eq!(catalog.entry("v").await.unwrap().tiles, 2);
}

fn broken(tile: &str) -> Quarantined {
    Quarantined {
        file: format!("{tile}.tif"),
        tile: Some(tile.to_owned()),
        reason: "it is damaged".to_owned(),
        bytes: Some(12),
        at: SystemTime::UNIX_EPOCH + Duration::from_millis(1_234_567),
        awaited: None,
    }
}

pub(crate) async fn channels_stay_apart(place: &Place) {
    let catalog = place.catalog().await;
    for channel in [0, 3] {
        let tile = NewTile {
            channel,
            ..tile(&format!("c{channel}"), 1, at(0.0, 0.0), 1)
        };
        catalog.commit_tile("v", &tile).await.unwrap();
    }
    let tiles = catalog.section_tiles("v", 1).await.unwrap();
    let channels: Vec<_> = tiles.iter().map(|t| (&*t.name, t.channel)).collect();
    assert_eq!(channels, [("c0", 0), ("c3", 3)]);
}

pub(crate) async fn a_replaced_pyramid_is_retired_not_forgotten(place: &Place) {
    let catalog = place.catalog().await;
    let begin = SystemTime::now() - Duration::from_secs(1);
    let later = SystemTime::now() + Duration::from_secs(600);
    catalog
        .commit_tile("v", &tile("a", 0, at(0.0, 0.0), 1))
        .await
        .unwrap();
    let again = catalog
        .commit_tile("v", &tile("a", 0, at(0.0, 0.0), 2))
        .await
        .unwrap();
    assert_eq!(again, TileOutcome::Replaced);
    let older = catalog
        .commit_tile("v", &tile("a", 0, at(0.0, 0.0), 1))
        .await
        .unwrap();
    assert_eq!(older, TileOutcome::Superseded);
    assert_eq!(
        catalog.tile("v", "a").await.unwrap().unwrap().pyramid,
        "tiles/a.2.tif"
    );
    assert_eq!(catalog.entry("v").await.unwrap().tiles, 1);

    assert_eq!(catalog.retired("v", begin, 9).await.unwrap(), []);
    let retired = catalog.retired("v", later, 9).await.unwrap();
    assert_eq!(retired.len(), 1);
    assert_eq!(retired[0].pyramid, "tiles/a.1.tif");
    let mut commit = catalog.begin("v").await.unwrap();
    commit.forget_retired("tiles/a.1.tif").await.unwrap();
    commit.finish().await.unwrap();
    assert_eq!(catalog.retired("v", later, 9).await.unwrap(), []);
}

pub(crate) async fn a_commit_happens_whole_or_not_at_all(place: &Place) {
    let catalog = place.catalog().await;
    let unfinished = waiting("w", 1, at(0.0, 0.0), 5);
    let unreadable = broken("b");
    let cursor = Cursor {
        offset: 700,
        line: 9,
        // The highest bit as well.
        seen: Some(u64::MAX - 5),
    };
    let fill = async || {
        let mut commit = catalog.begin("v").await.unwrap();
        commit
            .tile(&tile("a", 0, at(0.0, 0.0), 1), SystemTime::now())
            .await
            .unwrap();
        commit.cursor(cursor).await.unwrap();
        commit.wait(&unfinished).await.unwrap();
        commit.quarantine(&unreadable).await.unwrap();
        let kept = commit.transform("later", at(1.0, 1.0), Some(3)).await;
        assert_eq!(kept.unwrap(), TransformOutcome::Kept);
        commit
    };
    drop(fill().await);
    assert_eq!(
        catalog.statistics("v").await.unwrap(),
        Statistics::default()
    );
    assert_eq!(catalog.cursor("v").await.unwrap(), Cursor::default());
    assert_eq!(fill().await.finish().await.unwrap(), 1);
    catalog.close().await;

    // Another process, later.
    let catalog = Catalog::open(catalog.location()).await.unwrap();
    let want = Statistics {
        revision: 1,
        tiles: 1,
        sections: 1,
        quarantined: 1,
        waiting: 1,
        queued: 0,
        early: 1,
    };
    assert_eq!(catalog.statistics("v").await.unwrap(), want);
    assert_eq!(catalog.cursor("v").await.unwrap(), cursor);
    assert_eq!(catalog.waiting("v").await.unwrap(), [unfinished]);
    assert_eq!(catalog.quarantined("v").await.unwrap(), [unreadable]);

    let awaited = |position| Quarantined {
        awaited: Some(position),
        ..broken("b")
    };
    for position in [2, 3, 40, 90] {
        catalog.quarantine("v", &awaited(position)).await.unwrap();
    }
    // A good record ends the quarantine of its tile, and only of that, and of no image that was announced later.
    catalog
        .commit_tile("v", &tile("c", 0, at(0.0, 0.0), 2))
        .await
        .unwrap();
    assert_eq!(catalog.quarantined("v").await.unwrap().len(), 5);
    catalog
        .commit_tile("v", &tile("b", 0, at(0.0, 0.0), 3))
        .await
        .unwrap();
    let late = [40, 90].map(awaited);
    assert_eq!(catalog.quarantined("v").await.unwrap(), late);
    assert_eq!(catalog.first_quarantined("v", 1).await.unwrap(), late[..1]);
    // One that somebody deletes who knows of no records goes before the first of them.
    let mut commit = catalog.begin("v").await.unwrap();
    let deleted = commit.delete_seen("b", 700, SystemTime::now()).await;
    assert_eq!(deleted.unwrap(), DeleteOutcome::Deleted);
    commit
        .take_up(&waiting("b", 0, at(0.0, 0.0), 40))
        .await
        .unwrap();
    commit.finish().await.unwrap();
    assert_eq!(catalog.quarantined("v").await.unwrap(), [awaited(90)]);
    for (position, outcome) in [(3, TileOutcome::Superseded), (40, TileOutcome::New)] {
        let tile = tile("b", 0, at(0.0, 0.0), position);
        let entered = catalog.commit_tile("v", &tile).await;
        assert_eq!(entered.unwrap(), outcome);
    }
}

pub(crate) fn waiting(
    tile: &str,
    section: u32,
    transform: SectionFromTile,
    position: u64,
) -> Waiting {
    let (tile, file) = (tile.to_owned(), format!("{tile}.tif"));
    let record = TileRecord {
        tile,
        file,
        section,
        size: SIZE,
        transform,
        channel: None,
    };
    Waiting {
        position,
        record,
        reason: "it ends early".to_owned(),
    }
}

pub(crate) async fn tiles_are_found_by_id(place: &Place) {
    let catalog = place.catalog().await;
    for (n, name) in (0..).zip(["a", "b", "c", "d"]) {
        let tile = tile(name, 2, at(0.0, 0.0), n);
        catalog.commit_tile("v", &tile).await.unwrap();
    }
    let all = catalog.section_tiles("v", 2).await.unwrap();
    let ids = [
        all[3].id,
        TileId(-4),
        all[1].id,
        TileId(i64::MAX),
        all[1].id,
    ];
    let found = catalog.tiles("v", &ids).await.unwrap();
    assert_eq!(found, [all[1].clone(), all[3].clone()]);
    assert_eq!(catalog.tiles("v", &[]).await.unwrap(), []);
    assert!(catalog.tiles("w", &ids).await.is_err());
}

pub(crate) async fn sections_are_those_with_tiles(place: &Place) {
    let catalog = place.catalog().await;
    assert!(catalog.sections("v").await.unwrap().is_empty());
    let mut commit = catalog.begin("v").await.unwrap();
    for (n, z) in (0..).zip([5, 0, 3, 3, 0, 5, 5]) {
        let new = tile(&n.to_string(), z, at(0.0, 0.0), n);
        commit.tile(&new, SystemTime::now()).await.unwrap();
    }
    commit.finish().await.unwrap();
    assert_eq!(catalog.sections("v").await.unwrap(), [0, 3, 5]);
    assert_eq!(catalog.section_tiles("v", 5).await.unwrap().len(), 3);
}

pub(crate) async fn channels_have_the_sections_of_their_tiles(place: &Place) {
    let catalog = place.catalog().await;
    let of = async |channels, within| {
        let sections = catalog.sections_of_channels("v", channels, within);
        sections.await.unwrap()
    };
    let all = || 0..u32::MAX;
    let none: Vec<u32> = Vec::new();
    assert_eq!(of(2, all()).await, [none.clone(), none.clone()]);
    for (n, (section, channel)) in (0..).zip([(5, 0), (0, 0), (3, 1), (3, 1), (0, 1), (5, 2)]) {
        let new = NewTile {
            channel,
            ..tile(&format!("t{n}"), section, at(0.0, 0.0), 1)
        };
        catalog.commit_tile("v", &new).await.unwrap();
    }
    assert_eq!(of(3, all()).await, [vec![0, 5], vec![0, 3], vec![5]]);
    assert_eq!(of(4, 1..5).await, [vec![], vec![3], vec![], vec![]]);
    assert_eq!(of(1, 1..6).await, [[3, 5]], "of one, each section counts");
    let (start, end) = (5, 3);
    assert_eq!(of(2, start..end).await, [none.clone(), none.clone()]);
    // One that is left in a section counts; one that has another channel now, or is gone, does not.
    catalog.delete_tile("v", "t2", 2).await.unwrap();
    catalog.delete_tile("v", "t0", 2).await.unwrap();
    let again = NewTile {
        channel: 2,
        ..tile("t4", 0, at(0.0, 0.0), 2)
    };
    catalog.commit_tile("v", &again).await.unwrap();
    assert_eq!(of(3, all()).await, [vec![0], vec![3], vec![0, 5]]);
    assert!(catalog.sections_of_channels("w", 2, all()).await.is_err());
}

pub(crate) async fn long_histories_come_in_pieces_without_gaps(place: &Place) {
    let catalog = place.catalog().await;
    let mut commit = catalog.begin("v").await.unwrap();
    commit
        .tile(&tile("a", 0, at(0.0, 0.0), 0), SystemTime::now())
        .await
        .unwrap();
    let moves = CHANGES_AT_ONCE as u64 + 10;
    for n in 0..moves {
        commit
            .transform("a", at(1.0 + (n % 2) as f64, 0.0), None)
            .await
            .unwrap();
    }
    assert_eq!(commit.finish().await.unwrap(), moves + 1);
    assert_eq!(
        catalog.changes_after("v", 0).await.unwrap().len(),
        CHANGES_AT_ONCE
    );
    let revisions: Vec<_> = all_changes(&catalog)
        .await
        .iter()
        .map(|c| c.revision)
        .collect();
    assert_eq!(revisions, (1..=moves + 1).collect::<Vec<_>>());
}

pub(crate) async fn other_processes_commits_are_heard(place: &Place) {
    let here = place.catalog().await;
    here.create_volume(&volume("other")).await.unwrap();
    // A second handle shares nothing with the first but the file, like another process.
    let there = Catalog::open(here.location()).await.unwrap();
    let mut heard = here.subscribe("v").await.unwrap();
    let mut own = there.subscribe("v").await.unwrap();
    let mut other = here.subscribe("other").await.unwrap();
    assert_eq!(*heard.borrow_and_update(), 0);
    other.borrow_and_update();

    there
        .commit_tile("v", &tile("a", 0, at(0.0, 0.0), 0))
        .await
        .unwrap();
    assert_eq!(
        *own.borrow_and_update(),
        1,
        "in its own process, before commit returns"
    );
    let hear = heard.wait_for(|revision| *revision == 1);
    tokio::time::timeout(Duration::from_secs(20), hear)
        .await
        .expect("heard in time")
        .unwrap();
    assert_eq!(here.section_tiles("v", 0).await.unwrap().len(), 1);

    here.set_transform("v", "a", at(3.0, 0.0)).await.unwrap();
    let hear = own.wait_for(|revision| *revision == 2);
    tokio::time::timeout(Duration::from_secs(20), hear)
        .await
        .expect("heard in time")
        .unwrap();
    assert!(
        !other.has_changed().unwrap(),
        "nothing happened to the other volume"
    );

    let unknown = here.subscribe("none").await;
    assert!(matches!(unknown, Err(CatalogError::UnknownVolume { .. })));
}

pub(crate) async fn several_writers_take_turns(place: &Place) {
    // Both make it at once.
    let create = || Catalog::create(place.location());
    let (a, b) = tokio::join!(create(), create());
    let (a, b) = (a.unwrap(), b.unwrap());
    let v = volume("v");
    let (one, two) = tokio::join!(a.create_volume(&v), b.create_volume(&v));
    one.and(two).unwrap();
    let write = |catalog: Catalog, who: &'static str| {
        tokio::spawn(async move {
            for n in 0..12 {
                let new = tile(&format!("{who}{n}"), n % 6, at(1.0, 1.0), u64::from(n));
                catalog.commit_tile("v", &new).await.unwrap();
            }
        })
    };
    let (one, two) = tokio::join!(write(a.clone(), "a"), write(b, "b"));
    one.and(two).unwrap();
    assert_eq!(a.entry("v").await.unwrap().tiles, 24);
    let revisions: Vec<_> = all_changes(&a).await.iter().map(|c| c.revision).collect();
    assert_eq!(revisions, (1..=24).collect::<Vec<_>>());
}

pub(crate) async fn other_sizes_and_unknown_names_are_refused(place: &Place) {
    let catalog = place.catalog().await;
    catalog.create_volume(&volume("v")).await.unwrap();
    let nm = DVec3::new(4.0, 4.0, 40.0);
    let with = |change: fn(&mut Volume)| {
        let mut volume = volume("v");
        change(&mut volume);
        volume
    };
    for (what, other) in [
        ("extent", Volume::new("v", EXTENT + 1, nm).unwrap()),
        ("voxel size", Volume::new("v", EXTENT, nm * 2.0).unwrap()),
        ("voxel type", with(|v| v.dtype = Dtype::Uint16)),
        ("kind", with(|v| v.kind = VoxelKind::Labels)),
        ("channels", with(|v| v.channels.push("actin".to_owned()))),
    ] {
        let refused = catalog.create_volume(&other).await.unwrap_err();
        let named = matches!(&refused, CatalogError::WrongVolume { what: w, .. } if *w == what);
        assert!(named, "{what}: {refused}");
        assert!(
            refused.to_string().starts_with(&format!("wrong {what}")),
            "{refused}"
        );
    }
    assert_eq!(
        catalog.volume("v").await.unwrap(),
        volume("v"),
        "left as it was"
    );

    let unknown = catalog.section_tiles("w", 0).await.unwrap_err();
    assert!(
        unknown.to_string().contains("the volumes are: v"),
        "{unknown}"
    );
    let unknown = catalog.set_transform("w", "a", at(0.0, 0.0)).await;
    assert!(matches!(unknown, Err(CatalogError::UnknownVolume { .. })));
    for name in ["", ".", "../v", "a/b", "a b", "ä", &"n".repeat(101)] {
        let refused = catalog.create_volume(&volume(name)).await;
        assert!(
            matches!(refused, Err(CatalogError::VolumeName(_))),
            "{name:?}"
        );
    }
    let volumes = catalog.volumes().await.unwrap();
    let names: Vec<_> = volumes.into_iter().map(|listed| listed.name).collect();
    assert_eq!(names, ["v"]);
}

/// One record of a stream; a tile's file is whole so many records later.
#[derive(Clone, Debug)]
pub(crate) enum Said {
    Tile {
        name: usize,
        section: u32,
        x: i32,
        y: i32,
        late: usize,
    },
    Move {
        name: usize,
        x: i32,
        y: i32,
    },
    Delete {
        name: usize,
    },
}

pub(crate) fn said() -> impl Strategy<Value = Said> {
    let place = || (0..80i32, 0..70i32);
    prop_oneof![
        5 => (
            0..3usize,
            0..6u32,
            place(),
            prop_oneof![Just(0usize), 1..9usize]
        )
            .prop_map(|(name, section, (x, y), late)| Said::Tile {
                name,
                section,
                x,
                y,
                late
            }),
        4 => (0..3usize, place()).prop_map(|(name, (x, y))| Said::Move { name, x, y }),
        2 => (0..3usize).prop_map(|name| Said::Delete { name }),
    ]
}

/// Commits one record; a tile that is late is returned instead, after it was told to wait.
pub(crate) async fn commit_one(
    commit: &mut Commit<'_>,
    said: &Said,
    position: usize,
    in_time: bool,
) -> Option<(usize, NewTile)> {
    let record = position as u64;
    match *said {
        Said::Tile {
            name,
            section,
            x,
            y,
            late,
        } => {
            let (name, transform) = (format!("t{name}"), at(x.into(), y.into()));
            let new = tile(&name, section, transform, record);
            if !in_time && late > 0 {
                commit
                    .wait(&waiting(&name, section, transform, record))
                    .await
                    .unwrap();
                return Some((position + late, new));
            }
            commit.tile(&new, SystemTime::now()).await.unwrap();
        }
        Said::Move { name, x, y } => {
            let transform = at(x.into(), y.into());
            commit
                .transform(&format!("t{name}"), transform, Some(record))
                .await
                .unwrap();
        }
        Said::Delete { name } => {
            commit
                .delete(&format!("t{name}"), record, SystemTime::now())
                .await
                .unwrap();
        }
    }
    None
}

/// Commits a stream, tiles as late as they say or all in time, in one transaction.
pub(crate) async fn commit_stream(catalog: &Catalog, stream: &[Said], in_time: bool) -> u64 {
    let mut commit = catalog.begin("v").await.unwrap();
    let mut late = Vec::new();
    for (position, said) in stream.iter().enumerate() {
        late.extend(commit_one(&mut commit, said, position, in_time).await);
        let last = position + 1 == stream.len();
        for (_, new) in late.extract_if(.., |(due, _)| last || *due <= position) {
            commit.tile(&new, SystemTime::now()).await.unwrap();
            commit.wait_no_more(new.position).await.unwrap();
        }
    }
    commit.finish().await.unwrap()
}

/// What the documentation of the catalog says, in the plainest way.
pub(crate) fn model(stream: &[Said]) -> Tiles {
    let mut tiles = Tiles::new();
    let mut early = BTreeMap::new();
    for (position, said) in stream.iter().enumerate() {
        match *said {
            Said::Tile {
                name,
                section,
                x,
                y,
                ..
            } => {
                let name = format!("t{name}");
                let pyramid = format!("tiles/{name}.{position}.tif");
                let first = !tiles.contains_key(&name);
                let kept = early.remove(&name).filter(|_| first);
                let transform = kept.unwrap_or([1.0, 0.0, 0.0, 1.0, x.into(), y.into()]);
                tiles.insert(name, (section, transform, pyramid));
            }
            Said::Move { name, x, y } => {
                let name = format!("t{name}");
                let transform = [1.0, 0.0, 0.0, 1.0, x.into(), y.into()];
                match tiles.get_mut(&name) {
                    Some((_, t, _)) => *t = transform,
                    None => {
                        early.insert(name, transform);
                    }
                }
            }
            Said::Delete { name } => {
                tiles.remove(&format!("t{name}"));
                early.remove(&format!("t{name}"));
            }
        }
    }
    tiles
}

/// Which image covers which voxel; coordinates are whole, so this needs no rounding.
pub(crate) fn covered(tiles: &Tiles) -> BTreeSet<([u32; 3], String)> {
    let mut voxels = BTreeSet::new();
    for (section, t, pyramid) in tiles.values() {
        for y in 0..SIZE.y {
            for x in 0..SIZE.x {
                let voxel = [t[4] as u32 + x, t[5] as u32 + y, *section];
                if voxel[0] < EXTENT.x && voxel[1] < EXTENT.y {
                    voxels.insert((voxel, format!("{pyramid} at {t:?}")));
                }
            }
        }
    }
    voxels
}
