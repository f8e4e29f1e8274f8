//! Rows that are made to say what they should: what changes, what is told of it, and whom nothing is done to.

use std::time::SystemTime;

use glam::UVec3;
use saccade_archive::acquisition::Cursor;
use saccade_archive::catalog::{Catalog, ChangeReason, Commit, Tile, TransformOutcome};
use saccade_core::voxel_box::VoxelBox;

use crate::place::Place;
use crate::suite::{EXTENT, all_changes, at, tile, tiles};

/// A catalog with tiles a and b in section 2 and c in section 3.
async fn with_three(place: &Place) -> Catalog {
    let catalog = place.catalog().await;
    for (name, z, position) in [("a", 2, 10_u32), ("b", 2, 20), ("c", 3, 30)] {
        let tile = tile(name, z, at(position.into(), 3.0), u64::from(position));
        catalog.commit_tile("v", &tile).await.unwrap();
    }
    catalog
}

async fn of(catalog: &Catalog, name: &str) -> Tile {
    catalog.tile("v", name).await.unwrap().unwrap()
}

async fn commit(catalog: &Catalog, change: impl AsyncFnOnce(&mut Commit<'_>)) {
    let mut commit = catalog.begin("v").await.unwrap();
    change(&mut commit).await;
    commit.finish().await.unwrap();
}

pub(crate) async fn names_go_where_they_belong_and_nobody_hears_of_it(place: &Place) {
    let catalog = with_three(place).await;
    let (a, b) = (of(&catalog, "a").await, of(&catalog, "b").await);
    let revision = catalog.revision("v").await.unwrap();
    commit(&catalog, async |commit| {
        commit.rename(&a, "b").await.unwrap();
    })
    .await;
    let called = |tile: &Tile, name: &str| Tile {
        name: name.to_owned(),
        ..tile.clone()
    };
    assert_eq!(of(&catalog, "b").await, called(&a, "b"));
    assert_eq!(of(&catalog, "a").await, called(&b, "a"));
    commit(&catalog, async |commit| {
        // That one is called otherwise meanwhile.
        commit.rename(&a, "c").await.unwrap();
        commit.rename(&called(&a, "b"), "free").await.unwrap();
    })
    .await;
    assert_eq!(of(&catalog, "free").await, called(&a, "free"));
    assert_eq!(of(&catalog, "c").await.section, 3);
    assert_eq!(catalog.tile("v", "b").await.unwrap(), None);
    assert_eq!(catalog.revision("v").await.unwrap(), revision);
}

pub(crate) async fn rows_are_rectified_as_they_were_found_or_not_at_all(place: &Place) {
    let catalog = with_three(place).await;
    let found = of(&catalog, "a").await;
    commit(&catalog, async |commit| {
        commit
            .rename_pyramid(&found, "tiles/own.tif")
            .await
            .unwrap();
    })
    .await;
    let named = of(&catalog, "a").await;
    assert_eq!(named.pyramid, "tiles/own.tif");
    // What is not as it was found stays.
    commit(&catalog, async |commit| {
        commit.rename_pyramid(&found, "tiles/x.tif").await.unwrap();
        commit.number(&found, 5).await.unwrap();
        commit.lay(&found, at(50.0, 50.0)).await.unwrap();
        commit.confirm(&found).await.unwrap();
        assert!(!commit.detach("a", &found.pyramid).await.unwrap());
    })
    .await;
    assert_eq!(of(&catalog, "a").await, named);
    commit(&catalog, async |commit| {
        commit.number(&named, 5).await.unwrap();
    })
    .await;
    let numbered = of(&catalog, "a").await;
    assert_eq!(numbered.position, 5);
    commit(&catalog, async |commit| {
        commit.lay(&numbered, at(50.0, 50.0)).await.unwrap();
    })
    .await;
    let laid = of(&catalog, "a").await;
    assert_eq!(laid.transform, at(50.0, 50.0));
    let last = all_changes(&catalog).await.pop().unwrap();
    assert_eq!((last.tile, last.reason), (laid.id, ChangeReason::Transform));
    assert_eq!(last.revision, laid.revision);
    commit(&catalog, async |commit| {
        commit.confirm(&laid).await.unwrap();
    })
    .await;
    let confirmed = of(&catalog, "a").await;
    assert!(confirmed.revision > laid.revision);
    assert_eq!(confirmed.transform, laid.transform);
    let untouched = [
        of(&catalog, "b").await.revision,
        of(&catalog, "c").await.revision,
    ];
    assert_eq!(untouched, [2, 3]);
    commit(&catalog, async |commit| {
        assert!(commit.detach("a", "tiles/own.tif").await.unwrap());
    })
    .await;
    assert!(
        of(&catalog, "a")
            .await
            .pyramid
            .starts_with("tiles/own.tif-none")
    );
}

pub(crate) async fn who_follows_hears_what_is_shown_again_and_taken_away(place: &Place) {
    let catalog = with_three(place).await;
    let before = catalog.revision("v").await.unwrap();
    commit(&catalog, async |commit| {
        commit.show_again(3).await.unwrap();
        commit.take_away("b").await.unwrap();
        commit.take_away("b").await.unwrap();
        commit.take_away("nobody").await.unwrap();
    })
    .await;
    let told = catalog.changes_after("v", before).await.unwrap();
    let corner = UVec3::new(0, 0, 3);
    let whole = VoxelBox::new(corner, EXTENT.with_z(4));
    assert_eq!(told[0].voxels, whole);
    let reasons: Vec<_> = told.iter().map(|change| change.reason).collect();
    assert_eq!(reasons, [ChangeReason::Tile, ChangeReason::Deleted]);
    assert_eq!(catalog.tile("v", "b").await.unwrap(), None);
    let left: Vec<_> = tiles(&catalog).await.into_keys().collect();
    assert_eq!(left, ["a", "c"]);
    // Its pyramid is others' to keep.
    let later = SystemTime::now() + std::time::Duration::from_secs(1 << 20);
    assert_eq!(catalog.retired("v", later, 9).await.unwrap(), []);
    catalog.recount("v").await.unwrap();
    assert_eq!(catalog.entry("v").await.unwrap().tiles, 2);
}

pub(crate) async fn who_is_ahead_of_what_was_read_is_found_and_follows_again(place: &Place) {
    let catalog = with_three(place).await;
    let read = Cursor {
        offset: 1000,
        ..Cursor::default()
    };
    commit(&catalog, async |commit| {
        commit.cursor(read).await.unwrap();
        commit.delete("b", 999, SystemTime::now()).await.unwrap();
    })
    .await;
    assert_eq!(catalog.ahead("v").await.unwrap(), []);
    commit(&catalog, async |commit| {
        let moved = commit.transform("a", at(40.0, 3.0), Some(1000)).await;
        assert_eq!(moved.unwrap(), TransformOutcome::Moved);
        commit.delete("b", 5000, SystemTime::now()).await.unwrap();
        commit.delete("c", 999, SystemTime::now()).await.unwrap();
    })
    .await;
    let ahead = catalog.ahead("v").await.unwrap();
    let said: Vec<_> = { ahead.iter() }
        .map(|row| {
            (
                row.tile.as_str(),
                row.position,
                row.transform_position,
                row.deleted,
                row.read,
            )
        })
        .collect();
    assert_eq!(
        said,
        [("a", 10, 1000, false, 1000), ("b", 5000, 20, true, 1000)]
    );
    let revision = catalog.revision("v").await.unwrap();
    commit(&catalog, async |commit| {
        for row in &ahead {
            commit.follow_from(row, 999).await.unwrap();
        }
    })
    .await;
    assert_eq!(catalog.ahead("v").await.unwrap(), []);
    assert_eq!(catalog.revision("v").await.unwrap(), revision);
    commit(&catalog, async |commit| {
        // Found as it is no more.
        commit.follow_from(&ahead[0], 1).await.unwrap();
        let old = commit.transform("a", at(60.0, 3.0), Some(999)).await;
        assert_eq!(old.unwrap(), TransformOutcome::Unchanged);
        let new = commit.transform("a", at(60.0, 3.0), Some(1000)).await;
        assert_eq!(new.unwrap(), TransformOutcome::Moved);
    })
    .await;
}
