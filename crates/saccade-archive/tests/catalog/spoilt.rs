//! Rows that no program of ours writes.

use std::time::SystemTime;

use saccade_archive::catalog::{
    CatalogError, DeleteOutcome, TileOutcome, TransformOutcome, Waiting, place as lies,
};
use std::time::Duration;

use crate::place::Place;
use crate::suite::{EXTENT, all_changes, at, tile, waiting};

const SPOILT: [&str; 4] = [
    "width = -5",
    "section = -1",
    "pyramid = ''",
    "position = -3, transform_position = -3",
];

pub(crate) async fn a_spoilt_tile_is_told_and_goes_with_its_next_record(place: &Place) {
    for how in SPOILT {
        let catalog = place.catalog().await;
        for (name, section) in [("a", 0), ("b", 0)] {
            let new = tile(name, section, at(0.0, 0.0), 1);
            catalog.commit_tile("v", &new).await.unwrap();
        }
        let spoil = format!("UPDATE tiles SET {how} WHERE name = 'b'");
        place.meddle(&spoil).await;
        // It is told, beside the one that is whole.
        let mut rows = catalog.section_rows("v", 0).await.unwrap();
        rows.extend(
            catalog
                .rows_without_section("v")
                .await
                .unwrap()
                .into_iter()
                .map(Err),
        );
        let names: Vec<_> = { rows.iter() }
            .map(|row| {
                row.as_ref()
                    .map(|tile| &*tile.name)
                    .map_err(|s| s.name.as_deref())
            })
            .collect();
        assert_eq!(names, [Ok("a"), Err(Ok("b"))], "{how}");
        let entry = catalog.entry("v").await.unwrap();
        assert_eq!(entry.tiles, 2);
        // So it is by the table alone.
        let namings = catalog.namings_after(i64::MIN).await.unwrap();
        let named: Vec<_> = { namings.iter() }
            .map(|naming| (&*naming.tile, naming.has_volume))
            .collect();
        assert_eq!(named, [("a", true), ("b", true)], "{how}");
        assert_eq!(catalog.namings_after(namings[1].row).await.unwrap(), []);
        // Its next record takes its place, and its last one ends it.
        let new = tile("b", 1, at(5.0, 0.0), 2);
        let outcome = catalog.commit_tile("v", &new).await.unwrap();
        // Where it was is not known if that is what cannot be.
        let replaced = match how.starts_with("section") {
            true => TileOutcome::Replaced,
            false => TileOutcome::Elsewhere { from: 0 },
        };
        assert_eq!(outcome, replaced, "{how}");
        let now = catalog.tile("v", "b").await.unwrap().unwrap();
        assert_eq!((now.section, now.transform), (1, at(5.0, 0.0)));
        assert_eq!(catalog.sections("v").await.unwrap(), [0, 1]);
        place.meddle(&spoil).await;
        let deleted = catalog.delete_tile("v", "b", 3).await.unwrap();
        assert_eq!(deleted, DeleteOutcome::Deleted, "{how}");
        assert_eq!(catalog.sections("v").await.unwrap(), [0], "{how}");
        assert_eq!(catalog.entry("v").await.unwrap().tiles, 1, "{how}");
        assert!(catalog.knows("v", "b").await.unwrap());
        assert!(!catalog.knows("v", "c").await.unwrap());
        catalog.delete_tile("v", "a", 3).await.unwrap();
        catalog.close().await;
        place.meddle("DELETE FROM changes").await;
        place.meddle("DELETE FROM retired").await;
        place.meddle("DELETE FROM sections").await;
        place.meddle("DELETE FROM tiles").await;
        place.meddle("DELETE FROM volumes").await;
    }
}

pub(crate) async fn where_a_tile_of_no_size_lies_is_kept_until_it_has_one(place: &Place) {
    let catalog = place.catalog().await;
    let new = tile("a", 0, at(0.0, 0.0), 1);
    catalog.commit_tile("v", &new).await.unwrap();
    place.meddle("UPDATE tiles SET width = -1").await;
    let told = catalog.section_tiles("v", 0).await.unwrap_err();
    assert!(matches!(told, CatalogError::SpoiltTile { .. }), "{told}");
    let mut commit = catalog.begin("v").await.unwrap();
    let moved = commit.transform("a", at(7.0, 1.0), Some(2)).await.unwrap();
    assert_eq!(moved, TransformOutcome::Kept);
    commit.finish().await.unwrap();
    let before = all_changes(&catalog).await.len();
    // The same record as before, worked on once more.
    catalog.commit_tile("v", &new).await.unwrap();
    let now = catalog.tile("v", "a").await.unwrap().unwrap();
    assert_eq!(now.transform, at(7.0, 1.0));
    // Its section could not be read, and can be: who has kept an error learns of it.
    let whole = lies(EXTENT, 0, EXTENT.truncate(), at(0.0, 0.0)).unwrap();
    let changes = all_changes(&catalog).await;
    assert_eq!(changes.len(), before + 1);
    assert_eq!(changes[before].voxels, whole);
}

/// Repairs have records done anew, and a cursor that was lost all of them: what moved the tiles since still counts.
pub(crate) async fn a_record_that_is_done_once_more_moves_nothing_back(place: &Place) {
    let catalog = place.catalog().await;
    let new = tile("a", 0, at(0.0, 0.0), 1);
    let where_it_is = || async { catalog.tile("v", "a").await.unwrap().unwrap().transform };
    let told = async |transform, position| {
        let mut commit = catalog.begin("v").await.unwrap();
        let outcome = commit.transform("a", transform, position).await.unwrap();
        commit.finish().await.unwrap();
        outcome
    };
    catalog.commit_tile("v", &new).await.unwrap();
    // By somebody who writes no records.
    assert_eq!(told(at(7.0, 1.0), None).await, TransformOutcome::Moved);
    catalog.commit_tile("v", &new).await.unwrap();
    assert_eq!(where_it_is().await, at(7.0, 1.0));
    // By a record, and then by somebody.
    assert_eq!(told(at(2.0, 2.0), Some(5)).await, TransformOutcome::Moved);
    assert_eq!(told(at(9.0, 3.0), None).await, TransformOutcome::Moved);
    catalog.commit_tile("v", &new).await.unwrap();
    let again = told(at(2.0, 2.0), Some(5)).await;
    assert_eq!(again, TransformOutcome::Unchanged);
    assert_eq!(where_it_is().await, at(9.0, 3.0));
    // What is new counts, be it a transform or an image.
    assert_eq!(told(at(4.0, 4.0), Some(6)).await, TransformOutcome::Moved);
    let image = tile("a", 0, at(1.0, 1.0), 8);
    catalog.commit_tile("v", &image).await.unwrap();
    assert_eq!(where_it_is().await, at(1.0, 1.0));
}

pub(crate) async fn chunks_that_no_memory_holds_make_no_volume(place: &Place) {
    let catalog = place.catalog().await;
    assert!(catalog.entry("v").await.is_ok());
    let huge = "UPDATE volumes SET description = replace(description, '[64,64,32]', '[65536,65536,65536]')";
    place.meddle(huge).await;
    let told = catalog.entry("v").await.unwrap_err();
    assert!(matches!(told, CatalogError::SpoiltVolume { .. }), "{told}");
    assert!(told.to_string().contains("chunks"), "{told}");
}

pub(crate) async fn what_is_queued_and_cannot_be_understood_is_set_aside(place: &Place) {
    let catalog = place.catalog().await;
    let mut commit = catalog.begin("v").await.unwrap();
    for (at_byte, name) in [(1, "a"), (2, "b"), (3, "c")] {
        let one: Waiting = waiting(name, 0, at(0.0, 0.0), at_byte);
        commit.enqueue(&one).await.unwrap();
    }
    commit.finish().await.unwrap();
    place
        .meddle("UPDATE waiting SET record = '{' WHERE tile = 'b'")
        .await;
    let spoilt = catalog.spoilt_waiting("v").await.unwrap();
    let spoilt: Vec<_> = spoilt.iter().map(|(at, tile, _)| (*at, &**tile)).collect();
    assert_eq!(spoilt, [(2, "b")]);
    let worker = catalog
        .register("w", Duration::from_secs(60))
        .await
        .unwrap();
    let claims = catalog.claim("v", &worker, 9).await.unwrap();
    let claims: Vec<_> = { claims.iter() }
        .map(|claim| &*claim.waiting.record.tile)
        .collect();
    assert_eq!(claims, ["a", "c"]);
    let set_aside = catalog.quarantined("v").await.unwrap();
    assert_eq!(set_aside.len(), 1);
    assert_eq!(set_aside[0].tile.as_deref(), Some("b"));
    assert!(set_aside[0].at <= SystemTime::now());
    assert_eq!(catalog.queued("v").await.unwrap(), (2, 0));
}

pub(crate) async fn what_a_tile_names_is_not_on_the_list_of_what_is_to_be_deleted(place: &Place) {
    let catalog = place.catalog().await;
    let mut new = tile("a", 0, at(0.0, 0.0), 1);
    for (section, name) in [(0, "tiles/v/000000/a-1.tif"), (1, "tiles/v/000001/a-2.tif")] {
        (new.section, new.pyramid, new.position) = (section, name.to_owned(), section.into());
        catalog.commit_tile("v", &new).await.unwrap();
    }
    let named = async |name: &str| catalog.is_named("v", name).await.unwrap();
    assert!(!named("tiles/v/000000/a-1.tif").await);
    assert!(named("tiles/v/000001/a-2.tif").await);
    // A row that somebody has moved elsewhere is found by the tile's name, and any by a name of another kind.
    place.meddle("UPDATE tiles SET section = 5").await;
    assert!(named("tiles/v/000001/a-2.tif").await);
    place
        .meddle("UPDATE tiles SET pyramid = 'elsewhere.tif'")
        .await;
    assert!(named("elsewhere.tif").await);
    let later = SystemTime::now() + Duration::from_secs(600);
    assert_eq!(catalog.retired("v", later, 9).await.unwrap().len(), 1);
    new.position = 9;
    new.pyramid = "tiles/v/000000/a-1.tif".to_owned();
    catalog.commit_tile("v", &new).await.unwrap();
    let retired = catalog.retired("v", later, 9).await.unwrap();
    let retired: Vec<_> = retired.into_iter().map(|r| r.pyramid).collect();
    assert_eq!(retired, ["elsewhere.tif"]);
}

/// Whoever deletes by hand, and whoever moves by hand.
pub(crate) async fn what_no_program_of_ours_does_to_a_tile_is_found(place: &Place) {
    let catalog = place.catalog().await;
    for (n, name) in (0..).zip(["a", "b", "c"]) {
        let new = tile(name, 0, at(3.0, 2.0), n);
        catalog.commit_tile("v", &new).await.unwrap();
    }
    catalog.refuse_impossible("v").await.unwrap();
    catalog.delete_tile("v", "a", 7).await.unwrap();
    assert_eq!(catalog.half_deleted("v").await.unwrap(), []);
    catalog.refuse_impossible("v").await.unwrap();
    place
        .meddle("UPDATE tiles SET deleted = 1 WHERE name = 'b'")
        .await;
    let refused = catalog.refuse_impossible("v").await.unwrap_err();
    assert!(
        matches!(&refused, CatalogError::SpoiltTile { tile, .. } if tile == "b"),
        "{refused}"
    );
    let found = catalog.half_deleted("v").await.unwrap();
    let [Ok(b)] = &found[..] else {
        panic!("{found:?}");
    };
    let mut commit = catalog.begin("v").await.unwrap();
    commit.undelete(b).await.unwrap();
    let revision = commit.finish().await.unwrap();
    assert_eq!(catalog.half_deleted("v").await.unwrap(), []);
    assert_eq!(catalog.entry("v").await.unwrap().tiles, 2);
    assert_eq!(
        catalog.tile("v", "b").await.unwrap().unwrap().revision,
        revision
    );

    catalog.set_transform("v", "c", at(9.0, 8.0)).await.unwrap();
    let placings = catalog.placings("v", 0).await.unwrap();
    let c = catalog.tile("v", "c").await.unwrap().unwrap();
    let [of_b, of_c] = [b.id, c.id].map(|id| {
        let mut of = placings.iter().filter(|placing| placing.tile == id);
        of.next().unwrap()
    });
    assert_eq!((of_b.transform_position, of_c.transform_position), (1, 2));
    assert_eq!((of_b.revision, of_c.revision), (revision, c.revision));
    let lies = |at| lies(EXTENT, 0, c.size, at).unwrap();
    assert_eq!(of_b.change, Some(lies(at(3.0, 2.0))));
    let both = lies(at(3.0, 2.0)).union(lies(at(9.0, 8.0)));
    assert_eq!(of_c.change, Some(both));
    let newest = catalog.newest_records("v", 1).await.unwrap();
    assert_eq!(newest, [("c".to_owned(), 2)]);
    assert!(!catalog.is_set_aside("v", "c").await.unwrap());
    place.meddle("DELETE FROM changes").await;
    let placings = catalog.placings("v", 0).await.unwrap();
    assert!(placings.iter().all(|placing| placing.change.is_none()));
}
