//! Rows that have another tile's name, or that of none.

use std::collections::BTreeMap;
use std::time::SystemTime;

use saccade_core::voxel_box::VoxelBox;

use super::audit::{at, move_it, repairs};
use super::*;
use crate::acquisition::DeleteRecord;
use crate::catalog::{TileId, TileOutcome};

const NAMED: (FindingKind, Option<Repair>) = (FindingKind::Spoilt, Some(Repair::Renamed));

impl Fixture {
    /// What each tile shows, where, and of which record: all but revisions.
    async fn shown(&self) -> Vec<(String, String, SectionFromTile, u32, u64)> {
        let catalog = self.archive.catalog();
        let mut shown = Vec::new();
        for z in catalog.sections_of_tiles(VOLUME).await.unwrap() {
            let tiles = catalog.section_tiles(VOLUME, z).await.unwrap();
            let tiles = tiles.into_iter();
            shown.extend(tiles.map(|t| (t.name, t.pyramid, t.transform, t.section, t.position)));
        }
        shown.sort_by(|a, b| a.0.cmp(&b.0));
        shown
    }

    /// What each row is called.
    async fn called(&self) -> BTreeMap<TileId, String> {
        let catalog = self.archive.catalog();
        let mut called = BTreeMap::new();
        for z in catalog.sections_of_tiles(VOLUME).await.unwrap() {
            let tiles = catalog.section_tiles(VOLUME, z).await.unwrap();
            called.extend(tiles.into_iter().map(|tile| (tile.id, tile.name)));
        }
        called
    }

    /// Gives rows each other's names.
    async fn call(&self, names: &[(&str, &str)]) {
        let between: Vec<_> = { names.iter() }
            .map(|(of, _)| format!("UPDATE tiles SET name = '{of} between' WHERE name = '{of}'"))
            .collect();
        let after: Vec<_> = { names.iter() }
            .map(|(of, to)| format!("UPDATE tiles SET name = '{to}' WHERE name = '{of} between'"))
            .collect();
        let all: Vec<_> = between.iter().chain(&after).map(String::as_str).collect();
        self.meddle(&all).await;
    }
}

#[tokio::test]
async fn tiles_of_names_that_no_record_has_get_their_own_again_or_are_taken_away() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    catalog.set_transform(VOLUME, "t2", at(44.0)).await.unwrap();
    let bogus = "UPDATE tiles SET name = 'bogus' WHERE name = 't2'";
    fixture.meddle(&[bogus]).await;
    let report = fixture.look(false).await;
    assert_eq!(found(&report), [(FindingKind::Spoilt, "bogus")]);
    let reason = &report.findings[0].reason;
    assert!(
        reason.contains("tile t2") && reason.contains("--repair"),
        "{reason}"
    );
    let named = [(FindingKind::Spoilt, Some(Repair::Renamed))];
    assert_eq!(repairs(&fixture.look(true).await), named);
    assert_eq!(fixture.transform("t2").await, at(44.0));
    assert!(fixture.path(2).is_file());

    // One beside it is none.
    let columns = "volume, section, width, height, a, b, c, d, tx, ty, pyramid, revision, position, transform_position";
    let beside = format!(
        "INSERT INTO tiles (name, {columns}) SELECT 'bogus', {columns} FROM tiles WHERE name = 't2'"
    );
    fixture
        .meddle(&[&beside, "UPDATE volumes SET tiles = tiles + 1"])
        .await;
    let report = fixture.look(true).await;
    let away = [(FindingKind::Spoilt, Some(Repair::TakenAway))];
    assert_eq!(repairs(&report), away);
    assert!(fixture.path(2).is_file());
    assert!(catalog.tile(VOLUME, "bogus").await.unwrap().is_none());
    assert_eq!(fixture.look(false).await.findings, []);

    // Of one that has nothing of anybody's it is told what helps.
    let nobodys = "UPDATE tiles SET name = 'nobodys', pyramid = 'tiles/v/000001/bogus-7.tif' WHERE name = 't2'";
    fixture.meddle(&[nobodys]).await;
    let report = fixture.look(true).await;
    let told = report
        .findings
        .iter()
        .find(|f| f.tile.as_deref() == Some("nobodys"))
        .unwrap();
    assert_eq!((told.kind, told.repair), (FindingKind::Spoilt, None));
    assert!(told.reason.contains("`saccade update`"), "{}", told.reason);
    assert!(!told.reason.contains("append"), "{}", told.reason);
    assert!(fixture.path(2).is_file());
}

/// Within a section and across them, of two and in a ring, with names that are nobody's.
#[tokio::test]
async fn rows_that_have_each_others_names_get_their_own_again() {
    let cases: [&[(&str, &str)]; 6] = [
        &[("t2", "t3"), ("t3", "t2")],
        &[("t0", "t5"), ("t5", "t0")],
        &[("t0", "t2"), ("t2", "t4"), ("t4", "t0")],
        &[("t4", "t2"), ("t2", "t0"), ("t0", "t4")],
        &[("t2", "bogus"), ("t3", "t2")],
        &[("t3", "bogus"), ("t2", "t3")],
    ];
    for names in cases {
        let fixture = Fixture::new().await;
        let catalog = fixture.archive.catalog();
        // Somebody has moved one; that stays.
        catalog.set_transform(VOLUME, "t2", at(44.0)).await.unwrap();
        let before = fixture.shown().await;
        fixture.call(names).await;
        let spoilt = fixture.shown().await;
        assert!(spoilt != before);
        let report = fixture.look(false).await;
        let mut told: Vec<_> = found(&report).into_iter().map(|(_, tile)| tile).collect();
        told.sort_unstable();
        let mut wrong: Vec<_> = names.iter().map(|(_, to)| *to).collect();
        wrong.sort_unstable();
        assert_eq!(told, wrong);
        assert!(fixture.shown().await == spoilt);
        let report = fixture.look(true).await;
        assert_eq!(repairs(&report), vec![NAMED; names.len()], "{names:?}");
        assert!(fixture.shown().await == before, "{names:?}");
        assert_eq!(fixture.look(false).await.findings, [], "{names:?}");
        catalog.refuse_impossible(VOLUME).await.unwrap();
    }
}

/// One of the two is deleted: its row has the other's name, and is deleted as well then.
#[tokio::test]
async fn a_name_that_the_row_of_a_deleted_tile_has_goes_back() {
    for (gone, named) in [("t2", "t3"), ("t3", "t2")] {
        let fixture = Fixture::new().await;
        fixture.delete(gone).await;
        let before = fixture.shown().await;
        fixture.call(&[(gone, named), (named, gone)]).await;
        assert!(fixture.look(false).await.damage() > 0);
        let report = fixture.look(true).await;
        assert_eq!(repairs(&report)[..1], [NAMED], "{:?}", report.findings);
        assert!(fixture.shown().await == before);
        assert_eq!(fixture.look(false).await.findings, []);
    }
}

/// What is wrong beside its name is found as well, and mended with it.
#[tokio::test]
async fn a_row_with_anothers_name_is_held_against_its_own_record() {
    for spoilt in [
        "tx = tx + 17",
        "ty = ty - 1",
        "a = 0.9, b = 0.1",
        "position = position + 1",
        "tx = tx + 17, position = position + 1",
    ] {
        for (one, other) in [("t2", "t3"), ("t0", "t5"), ("t2", "bogus")] {
            let fixture = Fixture::new().await;
            let before = fixture.shown().await;
            let row = format!("UPDATE tiles SET {spoilt} WHERE name = '{one}'");
            fixture.meddle(&[&row]).await;
            fixture.call(&[(one, other), (other, one)]).await;
            let report = fixture.look(true).await;
            assert!(report.findings.iter().all(|f| f.repair.is_some()));
            assert!(fixture.shown().await == before, "{spoilt}: {one}, {other}");
            assert_eq!(fixture.look(false).await.findings, [], "{spoilt}");
        }
    }
    // Of another section or size, it is given back to ingest at once.
    for spoilt in ["section = 3", "width = 100", "channel = 4"] {
        let fixture = Fixture::new().await;
        let row = format!("UPDATE tiles SET {spoilt} WHERE name = 't2'");
        fixture.meddle(&[&row]).await;
        fixture.call(&[("t2", "t3"), ("t3", "t2")]).await;
        let repairs = repairs(&fixture.look(true).await);
        let anew = (FindingKind::Spoilt, Some(Repair::Queued));
        assert!(
            repairs.contains(&NAMED) && repairs.contains(&anew),
            "{repairs:?}"
        );
        let catalog = fixture.archive.catalog();
        let waits = catalog.waiting(VOLUME).await.unwrap();
        assert_eq!(waits.len(), 1, "{spoilt}");
        assert_eq!(waits[0].record.tile, "t2");
    }
}

/// The row of a tile that is deleted has the name of one that is there, whose own row has that of none.
#[tokio::test]
async fn a_tile_that_is_there_is_not_taken_for_one_too_many() {
    for by_record in [true, false] {
        let fixture = Fixture::new().await;
        let catalog = fixture.archive.catalog();
        if by_record {
            let gone = DeleteRecord { tile: "t5".into() };
            let position = fixture.append(&Record::Delete(gone)).await;
            catalog.delete_tile(VOLUME, "t5", position).await.unwrap();
        } else {
            fixture.delete("t5").await;
        }
        let before = fixture.shown().await;
        fixture.call(&[("t0", "nobody"), ("t5", "t0")]).await;
        let report = fixture.look(true).await;
        assert_eq!(repairs(&report)[0], NAMED, "{:?}", report.findings);
        assert!(fixture.shown().await == before);
        let there = catalog.holder(VOLUME, "t5").await.unwrap();
        assert_eq!(there.is_some_and(|row| row.deleted), by_record);
        if by_record {
            assert_eq!(fixture.look(false).await.findings, []);
        }
    }
}

/// A row that is called deleted by hand, and after one that a record has deleted, is its own pyramid's.
#[tokio::test]
async fn a_tile_that_is_called_as_one_that_is_deleted_is_not_ended() {
    for half in ["deleted = 1", "deleted = 1, tx = tx + 17"] {
        let fixture = Fixture::new().await;
        let catalog = fixture.archive.catalog();
        let gone = DeleteRecord { tile: "t5".into() };
        let position = fixture.append(&Record::Delete(gone)).await;
        catalog.delete_tile(VOLUME, "t5", position).await.unwrap();
        let (before, held) = (fixture.shown().await, catalog.holder(VOLUME, "t5").await);
        let row = format!("UPDATE tiles SET {half} WHERE name = 't2'");
        fixture.meddle(&[&row]).await;
        fixture.call(&[("t2", "t5"), ("t5", "t2")]).await;
        assert!(fixture.look(false).await.damage() > 0);
        let report = fixture.look(true).await;
        assert!(repairs(&report).contains(&NAMED), "{:?}", report.findings);
        assert!(
            fixture.shown().await == before,
            "{half}: {:?}",
            report.findings
        );
        let now = catalog.holder(VOLUME, "t5").await.unwrap();
        assert_eq!(now, held.unwrap());
        assert_eq!(fixture.look(false).await.findings, []);
    }
    // One that only kept its pyramid when it was deleted is ended.
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    let gone = DeleteRecord { tile: "t5".into() };
    let position = fixture.append(&Record::Delete(gone)).await;
    catalog.delete_tile(VOLUME, "t5", position).await.unwrap();
    let before = fixture.shown().await;
    let names = format!(
        "UPDATE tiles SET pyramid = '{}' WHERE name = 't5'",
        fixture.names[5]
    );
    fixture.meddle(&[&names]).await;
    fixture.look(true).await;
    assert!(fixture.shown().await == before);
    assert_eq!(fixture.look(false).await.findings, []);
}

/// Two tiles have each other's names, pyramids and numbers: so each lies where the other did, and nothing ever moved.
#[tokio::test]
async fn places_that_were_exchanged_are_nobodys_moves() {
    for was_moved in [false, true] {
        let fixture = Fixture::new().await;
        let catalog = fixture.archive.catalog();
        fixture.image_again("t4", at(300.0)).await;
        if was_moved {
            catalog.set_transform(VOLUME, "t5", at(90.0)).await.unwrap();
        }
        let before = fixture.shown().await;
        let mut exchange = Vec::new();
        for (of, to) in [("t4", "t5"), ("t5", "t4")] {
            let its = catalog.tile(VOLUME, of).await.unwrap().unwrap();
            exchange.push(format!(
                "UPDATE tiles SET width = {}, pyramid = '{}', position = {at}, transform_position = {at} WHERE name = '{to}'",
                its.size.x,
                its.pyramid,
                at = its.position
            ));
        }
        let exchange: Vec<_> = exchange.iter().map(String::as_str).collect();
        fixture.meddle(&exchange).await;
        fixture.call(&[("t4", "t5"), ("t5", "t4")]).await;
        let report = fixture.look(false).await;
        assert!(report.damage() > 0, "{was_moved}");
        let report = fixture.look(true).await;
        assert!(
            report
                .findings
                .iter()
                .all(|f| f.repair == Some(Repair::Moved))
        );
        // Where one was moved to, nobody knows any more.
        let recorded = { fixture.shown().await.into_iter() }.zip(before);
        let is_back = |(now, before): (_, _)| now == before;
        assert!(recorded.filter(|_| !was_moved).all(is_back));
        assert_eq!(fixture.look(false).await.findings, []);
    }
}

/// Rows that are ahead of what was read follow what is recorded next.
#[tokio::test]
async fn what_is_recorded_next_is_followed() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    fixture.delete("t5").await;
    let gone = DeleteRecord { tile: "t3".into() };
    let end = fixture.append(&Record::Delete(gone)).await;
    catalog.delete_tile(VOLUME, "t3", end).await.unwrap();
    let ahead = [
        "UPDATE tiles SET transform_position = transform_position + 100000 WHERE name IN ('t2', 't3')",
        "UPDATE tiles SET position = position + 100000 WHERE name IN ('t3', 't5')",
    ];
    fixture.meddle(&ahead).await;
    let told = { ["t2", "t3", "t5"] }.map(|tile| (FindingKind::Spoilt, tile));
    let without = fixture.check(false).await;
    assert_eq!(without.findings, []);
    assert_eq!(found(&fixture.look(false).await), told);
    let mended = [(FindingKind::Spoilt, Some(Repair::Renumbered)); 3];
    assert_eq!(repairs(&fixture.look(true).await), mended);
    assert_eq!(fixture.look(false).await.findings, []);
    let held = catalog.holder(VOLUME, "t3").await.unwrap().unwrap();
    assert_eq!(held.position, Some(end));

    let position = fixture.append(&move_it("t2", at(44.0))).await;
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    commit
        .transform("t2", at(44.0), Some(position))
        .await
        .unwrap();
    commit.finish().await.unwrap();
    assert_eq!(fixture.transform("t2").await, at(44.0));
    // What was said before is not followed now.
    let old = NewTile {
        position: 1,
        ..fixture.image_again("t2", at(50.0)).await
    };
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    let outcome = commit
        .tile(
            &NewTile {
                name: "t5".into(),
                ..old
            },
            SystemTime::now(),
        )
        .await;
    assert_eq!(outcome.unwrap(), TileOutcome::Superseded);
}

/// Of two that are deleted no voxel tells, but what is recorded of them later.
#[tokio::test]
async fn deleted_tiles_are_called_as_the_records_that_ended_them() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    let mut held = Vec::new();
    for tile in ["t0", "t5", "t3"] {
        let gone = DeleteRecord { tile: tile.into() };
        let position = fixture.append(&Record::Delete(gone)).await;
        catalog.delete_tile(VOLUME, tile, position).await.unwrap();
        held.push(catalog.holder(VOLUME, tile).await.unwrap());
    }
    fixture
        .call(&[("t0", "t5"), ("t5", "t3"), ("t3", "t0")])
        .await;
    assert_eq!(
        repairs(&fixture.look(false).await),
        [(FindingKind::Spoilt, None); 3]
    );
    let named = repairs(&fixture.look(true).await);
    assert!(
        !named.is_empty() && named.iter().all(|found| *found == NAMED),
        "{named:?}"
    );
    for (tile, row) in ["t0", "t5", "t3"].into_iter().zip(held) {
        assert_eq!(catalog.holder(VOLUME, tile).await.unwrap(), row);
    }
    assert_eq!(fixture.look(false).await.findings, []);
}

/// It decides which of two that are equally near is seen.
#[tokio::test]
async fn a_tile_is_of_the_record_of_which_its_pyramid_is() {
    let fixture = Fixture::new().await;
    let before = fixture.shown().await;
    let spoil = "UPDATE tiles SET position = position + 1 WHERE name = 't3'";
    fixture.meddle(&[spoil]).await;
    assert_eq!(
        found(&fixture.look(false).await),
        [(FindingKind::Spoilt, "t3")]
    );
    let mended = [(FindingKind::Spoilt, Some(Repair::Renumbered))];
    assert_eq!(repairs(&fixture.look(true).await), mended);
    assert!(fixture.shown().await == before);
    assert_eq!(fixture.look(false).await.findings, []);
}

/// Where the change is lost that would tell, a tile stays, and that is told.
#[tokio::test]
async fn what_the_lost_changes_would_tell_is_not_guessed() {
    for lost in [
        "DELETE FROM changes WHERE revision = (SELECT revision FROM tiles WHERE name = 't2')",
        "DELETE FROM changes",
    ] {
        let fixture = Fixture::new().await;
        fixture.meddle(&[lost]).await;
        // Where all lies as recorded, nothing is in doubt.
        assert_eq!(fixture.look(false).await.findings, []);
        // Nobody else has moved it.
        let elsewhere = "UPDATE tiles SET tx = 100 WHERE name = 't2'";
        fixture.meddle(&[elsewhere]).await;
        let moved = [(FindingKind::Spoilt, Some(Repair::Moved))];
        assert_eq!(repairs(&fixture.look(true).await), moved);
        assert_eq!(fixture.transform("t2").await.elements()[4], 3.0);
        // Of tiles of earlier versions, nothing else tells.
        let earlier = "UPDATE tiles SET moved = NULL";
        fixture.meddle(&[lost, elsewhere, earlier]).await;
        let report = fixture.look(false).await;
        assert_eq!(found(&report), [(FindingKind::Spoilt, "t2")]);
        let reason = &report.findings[0].reason;
        assert!(reason.contains("the catalog's changes lack"), "{reason}");
        let stays = [(FindingKind::Spoilt, Some(Repair::Confirmed))];
        assert_eq!(repairs(&fixture.look(true).await), stays);
        assert_eq!(fixture.transform("t2").await.elements()[4], 100.0);
        assert_eq!(fixture.look(false).await.findings, []);
    }
}

/// Who follows the volume took them for sections without tiles.
#[tokio::test]
async fn sections_that_are_counted_again_are_shown_again() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    fixture
        .meddle(&["DELETE FROM sections WHERE section = 1"])
        .await;
    let before = catalog.revision(VOLUME).await.unwrap();
    let counted = [(FindingKind::Miscounted, Some(Repair::Recounted))];
    assert_eq!(repairs(&fixture.look(true).await), counted);
    let changes = catalog.changes_after(VOLUME, before).await.unwrap();
    let told: Vec<_> = changes.iter().map(|change| change.voxels).collect();
    let whole = VoxelBox::new(UVec3::new(0, 0, 1), UVec3::new(900, 900, 2));
    assert_eq!(told, [whole]);
    assert_eq!(fixture.look(true).await.findings, []);
    // Nothing of that explains where a tile lies.
    fixture
        .meddle(&["UPDATE tiles SET tx = 100 WHERE section = 1"])
        .await;
    let moved = [(FindingKind::Spoilt, Some(Repair::Moved)); 2];
    assert_eq!(repairs(&fixture.look(true).await), moved);
}

/// What was renamed before a newer image came is not what its record says alone: then nothing is renamed.
#[tokio::test]
async fn a_tile_whose_newer_image_waits_keeps_its_name() {
    let fixture = Fixture::new().await;
    let before = fixture.shown().await;
    let mut reader = RecordReader::new(fixture.acquisition.path(), Cursor::default());
    let records = reader.read(9).unwrap();
    let again = records[2].record.as_ref().unwrap().clone();
    fixture.append(&again).await;
    let report = fixture.look(true).await;
    let renamed = |f: &&Finding| f.repair == Some(Repair::Renamed);
    assert_eq!(report.findings.iter().find(renamed), None);
    assert!(fixture.shown().await == before);
}

/// Where its row names the pyramid of another as well, the number of its record is what is left of it.
#[tokio::test]
async fn a_name_goes_back_by_the_number_of_its_record_alone() {
    for are_exchanged in [true, false] {
        let fixture = Fixture::new().await;
        let before = fixture.called().await;
        let mut wrong = (FindingKind::Shared, "t1");
        if are_exchanged {
            fixture.call(&[("t1", "t2"), ("t2", "t1")]).await;
            wrong = (FindingKind::Spoilt, "t2");
        }
        let of_another = &fixture.names[3];
        let pyramid = format!(
            "UPDATE tiles SET pyramid = '{of_another}' WHERE name = '{}'",
            wrong.1
        );
        fixture.meddle(&[&pyramid]).await;
        let spoilt = fixture.called().await;
        assert_eq!(spoilt != before, are_exchanged);
        let told = fixture.look(false).await;
        assert!(found(&told).contains(&wrong), "{:?}", told.findings);
        assert!(fixture.called().await == spoilt);
        fixture.look(true).await;
        assert!(fixture.called().await == before, "{are_exchanged}");
    }
}
