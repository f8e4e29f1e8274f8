//! Rows that were changed by hand, and of which something else tells what they said.

use super::audit::{at, move_it, repairs};
use super::*;
use crate::acquisition::AcquisitionInfo;

const OTHER: &str = "w";

impl Fixture {
    /// One more volume, with one tile.
    async fn other_volume(&self) -> String {
        let catalog = self.archive.catalog();
        let volume = Volume::new(OTHER, UVec3::new(900, 900, 8), DVec3::ONE).unwrap();
        catalog.create_volume(&volume).await.unwrap();
        let object = "tiles/w/000000/u0-0.tif".to_owned();
        let bytes = pyramid::named(fs::read(self.path(0)).unwrap().into(), &object).unwrap();
        let written = self.archive.storage().write_durable(&object, bytes);
        written.await.unwrap();
        let tile = NewTile {
            name: "u0".to_owned(),
            section: 0,
            channel: 0,
            size: UVec2::new(200, 150),
            transform: at(3.0),
            pyramid: object.clone(),
            position: 0,
        };
        catalog.commit_tile(OTHER, &tile).await.unwrap();
        object
    }

    /// Deletes a tile as `saccade update` does.
    pub(super) async fn delete(&self, tile: &str) {
        let position = self.cursor().await.offset - 1;
        let deleted = self.archive.catalog().delete_tile(VOLUME, tile, position);
        deleted.await.unwrap();
    }

    /// As `look(true)`, without the records.
    async fn repair_alone(&self) -> CheckReport {
        let options = CheckOptions {
            repair: true,
            safe_age: Duration::ZERO,
            ..CheckOptions::default()
        };
        check(&self.archive, &options, &|_, _| {}).await.unwrap()
    }

    /// As ingest does with what waits for it.
    pub(super) async fn ingest(&self) {
        let catalog = self.archive.catalog();
        for waiting in catalog.waiting(VOLUME).await.unwrap() {
            let (record, position) = (waiting.record, waiting.position);
            let object = format!(
                "tiles/v/{:06}/{}-again1-{position:x}.tif",
                record.section, record.tile
            );
            let own = { self.names.iter() }.find(|own| position_of(own) == Some(position));
            let bytes = fs::read(self.folder.path().join(own.unwrap())).unwrap();
            let bytes = pyramid::named(bytes.into(), &object).unwrap();
            let written = self.archive.storage().write_durable(&object, bytes);
            written.await.unwrap();
            let tile = NewTile {
                name: record.tile,
                section: record.section,
                channel: 0,
                size: record.size,
                transform: record.transform,
                pyramid: object,
                position,
            };
            let mut commit = catalog.begin(VOLUME).await.unwrap();
            commit.tile(&tile, catalog.clock().now()).await.unwrap();
            commit.wait_no_more(position).await.unwrap();
            commit.finish().await.unwrap();
        }
    }

    async fn swap(&self, a: usize, b: usize) {
        let name = |tile: usize, of: usize| {
            format!(
                "UPDATE tiles SET pyramid = '{}' WHERE name = 't{tile}'",
                self.names[of]
            )
        };
        self.meddle(&[&name(a, b), &name(b, a)]).await;
    }
}

#[tokio::test]
async fn of_tiles_that_only_their_rows_call_deleted_nothing_is_deleted() {
    let forged = "UPDATE tiles SET deleted = 1, pyramid = '' WHERE name IN ('t2', 't3')";
    let (t2, t3) = ((FindingKind::Spoilt, "t2"), (FindingKind::Spoilt, "t3"));
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    fixture.delete("t5").await;
    catalog.set_transform(VOLUME, "t3", at(44.0)).await.unwrap();
    fixture.meddle(&[forged]).await;
    for report in [fixture.check(false).await, fixture.look(false).await] {
        assert_eq!(found(&report), [t2, t3]);
        let reason = &report.findings[0].reason;
        assert!(reason.contains("--repair"), "{reason}");
    }
    let back = (FindingKind::Spoilt, Some(Repair::Restored));
    assert_eq!(repairs(&fixture.repair_alone().await), [back; 2]);
    assert_eq!(fixture.look(true).await.findings, []);
    assert_eq!(fixture.transform("t3").await, at(44.0));
    assert_eq!(catalog.entry(VOLUME).await.unwrap().tiles, 5);

    // One whose pyramid is not whole is made anew.
    fixture.meddle(&[forged]).await;
    fs::write(fixture.path(2), "damaged").unwrap();
    let report = fixture.look(true).await;
    let anew = (FindingKind::Spoilt, Some(Repair::Queued));
    assert_eq!(repairs(&report), [anew, back]);
    assert!(fixture.path(2).is_file());

    // Where no change is kept nobody knows.
    fixture.meddle(&[forged, "DELETE FROM changes"]).await;
    let report = fixture.look(true).await;
    let of_t3 = report
        .findings
        .iter()
        .find(|f| f.tile.as_deref() == Some("t3"))
        .unwrap();
    assert_eq!((of_t3.kind, of_t3.repair), (FindingKind::Spoilt, None));
    assert!(of_t3.reason.contains("nobody knows"), "{}", of_t3.reason);
    assert!(fixture.path(3).is_file());
    assert!(catalog.tile(VOLUME, "t3").await.unwrap().is_none());
}

#[tokio::test]
async fn tiles_that_are_brought_back_lie_where_they_did() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    catalog.set_transform(VOLUME, "t3", at(44.0)).await.unwrap();
    let (own, moved) = (fixture.transform("t2").await, fixture.transform("t3").await);
    // Elsewhere in the volume, and outside of it.
    for x in ["tx + 31", "1e9"] {
        for names in ["deleted = 1", "deleted = 1, pyramid = ''"] {
            let of =
                |set: &str, tile: &str| format!("UPDATE tiles SET {set} WHERE name = '{tile}'");
            let elsewhere = of(&format!("{names}, tx = {x}"), "t2");
            fixture.meddle(&[&elsewhere, &of(names, "t3")]).await;
            let report = fixture.look(false).await;
            for (tile, is_elsewhere) in [("t2", true), ("t3", false)] {
                let mut findings = report.findings.iter();
                let found = findings.find(|f| f.tile.as_deref() == Some(tile));
                let reason = &found.unwrap().reason;
                assert_eq!(
                    reason.contains("its newest record"),
                    is_elsewhere,
                    "{reason}"
                );
            }
            let back = [(FindingKind::Spoilt, Some(Repair::Restored)); 2];
            assert_eq!(repairs(&fixture.look(true).await), back);
            assert_eq!(fixture.transform("t2").await, own, "{elsewhere}");
            // Its records do not say where somebody has moved it, but its changes do.
            assert_eq!(fixture.transform("t3").await, moved);
            assert_eq!(fixture.look(true).await.findings, []);
        }
    }
}

/// One that is made anew stays where somebody has moved it, but not where its row alone says.
#[tokio::test]
async fn what_is_made_anew_lies_where_it_did() {
    for spoilt in [
        "section = 3, tx = tx + 31",
        "pyramid = '', tx = tx + 31",
        "pyramid = '', c = -1",
        "width = 100, tx = tx + 31",
        "width = 0, b = 2",
        "channel = 1, ty = ty + 22",
        "deleted = 1, section = 3",
        "deleted = 1, channel = 9, tx = tx + 31",
        "deleted = 1, height = 255",
        "deleted = 1, tx = 9e999",
        "deleted = 1, a = -9e999, section = 3",
    ] {
        for moved in [None, Some(at(44.0))] {
            let fixture = Fixture::new().await;
            let catalog = fixture.archive.catalog();
            if let Some(to) = moved {
                // Of that the records say as well: what `saccade update` says is known by its row alone.
                let position = fixture.append(&move_it("t2", to)).await;
                let mut commit = catalog.begin(VOLUME).await.unwrap();
                commit.transform("t2", to, Some(position)).await.unwrap();
                commit.finish().await.unwrap();
            }
            let own = catalog.tile(VOLUME, "t2").await.unwrap().unwrap();
            fixture
                .meddle(&[&format!("UPDATE tiles SET {spoilt} WHERE name = 't2'")])
                .await;
            let report = fixture.look(true).await;
            let is_told = |f: &Finding| f.tile.as_deref() == Some("t2") && f.repair.is_some();
            assert!(
                report.findings.iter().any(is_told),
                "{spoilt}: {:?}",
                report.findings
            );
            fixture.ingest().await;
            let now = catalog.tile(VOLUME, "t2").await.unwrap().unwrap();
            assert_eq!(
                (now.transform, now.section, now.size, now.channel),
                (own.transform, own.section, own.size, own.channel),
                "{spoilt}, moved: {moved:?}"
            );
            // What it was made of before may be nobody's now.
            let mut left = fixture.look(true).await.findings;
            left.retain(|f| f.kind != FindingKind::Orphan);
            assert_eq!(left, [], "{spoilt}");
            catalog.refuse_impossible(VOLUME).await.unwrap();
        }
    }
}

/// Where only that is wrong which says up to where records were followed, the changes tell that somebody moved the tile.
#[tokio::test]
async fn a_position_of_nothing_moves_no_tile() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    let first = fixture.append(&move_it("t2", at(30.0))).await;
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    commit.transform("t2", at(30.0), Some(first)).await.unwrap();
    commit.finish().await.unwrap();
    catalog.set_transform(VOLUME, "t2", at(50.0)).await.unwrap();
    let spoil = "UPDATE tiles SET transform_position = 3 WHERE name = 't2'";
    fixture.meddle(&[spoil]).await;
    fixture.look(true).await;
    assert_eq!(fixture.transform("t2").await, at(50.0));
}

#[tokio::test]
async fn what_was_deleted_names_nothing() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    fixture.delete("t5").await;
    fixture
        .meddle(&["UPDATE tiles SET pyramid = 'nonsense' WHERE name = 't5'"])
        .await;
    assert!(catalog.refuse_impossible(VOLUME).await.is_err());
    let ended = [(FindingKind::Spoilt, Some(Repair::TakenAway))];
    let report = fixture.look(true).await;
    assert_eq!(repairs(&report)[..1], ended, "{:?}", report.findings);
    assert_eq!(fixture.look(true).await.findings, []);
    assert!(catalog.tile(VOLUME, "t5").await.unwrap().is_none());
    catalog.refuse_impossible(VOLUME).await.unwrap();
}

#[tokio::test]
async fn who_names_what_is_not_there_names_its_own_again() {
    let fixture = Fixture::new().await;
    let own = &fixture.names[2];
    let position = position_of(own).unwrap();
    let wrong = own.replace(
        &format!("{position:x}.tif"),
        &format!("{:x}.tif", position - 1),
    );
    let misname = format!("UPDATE tiles SET pyramid = '{wrong}' WHERE name = 't2'");
    fixture.meddle(&[&misname]).await;
    let report = fixture.check(false).await;
    assert_eq!(found(&report), [(FindingKind::Missing, "t2")]);
    assert!(report.findings[0].reason.contains(own));
    let named = [(FindingKind::Missing, Some(Repair::Renamed))];
    assert_eq!(repairs(&fixture.repair_alone().await), named);
    assert_eq!(fixture.look(false).await.findings, []);
    fixture.meddle(&[&misname]).await;
    assert_eq!(repairs(&fixture.look(true).await), named);

    // Where its own is damaged it is made anew, and what there is of it is kept while nothing better is.
    fixture.meddle(&[&misname]).await;
    fs::write(fixture.path(2), "damaged").unwrap();
    let image = fixture.acquisition.path().join("t2.tif");
    fs::rename(&image, image.with_extension("away")).unwrap();
    let aside = [(FindingKind::Missing, Some(Repair::Quarantined))];
    let report = fixture.look(true).await;
    assert_eq!(repairs(&report), aside);
    assert!(report.findings[0].reason.contains("\"t2.tif\""));
    assert!(fixture.path(2).is_file());
    fs::rename(image.with_extension("away"), &image).unwrap();
    let anew = [(FindingKind::Missing, Some(Repair::Queued))];
    assert_eq!(repairs(&fixture.look(true).await), anew);
    assert!(fixture.path(2).is_file());
}

#[tokio::test]
async fn nobody_is_told_to_take_a_folder_of_others_away() {
    let fixture = Fixture::new().await;
    let misname = "UPDATE tiles SET pyramid = 'tiles/v' WHERE name = 't2'";
    fixture.meddle(&[misname]).await;
    let report = fixture.check(false).await;
    assert_eq!(found(&report), [(FindingKind::Spoilt, "t2")]);
    let reason = &report.findings[0].reason;
    assert!(!reason.contains("take it away"), "{reason}");
    assert!(reason.contains(&fixture.names[2]), "{reason}");
    let named = [(FindingKind::Spoilt, Some(Repair::Renamed))];
    assert_eq!(repairs(&fixture.repair_alone().await), named);
    assert_eq!(fixture.look(false).await.findings, []);
}

#[tokio::test]
async fn revisions_that_keep_others_from_writing_are_set() {
    for says in ["3", "9223372036854775807", "-5"] {
        let fixture = Fixture::new().await;
        let catalog = fixture.archive.catalog();
        let before = catalog.revision(VOLUME).await.unwrap();
        let set = format!("UPDATE volumes SET revision = {says}");
        fixture.meddle(&[&set]).await;
        let report = fixture.check(false).await;
        assert_eq!(repairs(&report), [(FindingKind::Spoilt, None)], "{says}");
        let reason = &report.findings[0].reason;
        assert!(
            reason.contains(says) && reason.contains("--repair"),
            "{reason}"
        );
        let report = fixture.look(true).await;
        let counted = (FindingKind::Spoilt, Some(Repair::Recounted));
        assert_eq!((repairs(&report), report.damage()), (vec![counted], 0));
        assert_eq!(catalog.revision(VOLUME).await.unwrap(), before);
        catalog.set_transform(VOLUME, "t1", at(40.0)).await.unwrap();
        assert_eq!(fixture.look(false).await.findings, []);
    }
    // One that is larger keeps nobody from anything.
    let fixture = Fixture::new().await;
    fixture
        .meddle(&["UPDATE volumes SET revision = 5000"])
        .await;
    assert_eq!(fixture.check(false).await.findings, []);
}

#[tokio::test]
async fn records_of_which_there_are_tiles_were_read() {
    let fixture = Fixture::new().await;
    let mut reader = RecordReader::new(fixture.acquisition.path(), Cursor::default());
    reader.read(9).unwrap();
    let right = reader.cursor();
    for seen in [None, right.seen] {
        let none = Cursor {
            seen,
            ..Cursor::default()
        };
        fixture.set_cursor(none).await;
        let report = fixture.look(false).await;
        assert_eq!(repairs(&report), [(FindingKind::Spoilt, None)]);
        let reason = &report.findings[0].reason;
        assert!(reason.contains("none of its records"), "{reason}");
        // Who goes on from there finds nothing that is another's.
        let mut again = RecordReader::new(fixture.acquisition.path(), none);
        assert_eq!(again.read(9).unwrap().len(), TILES as usize);
        let read = (FindingKind::Spoilt, Some(Repair::Reread));
        assert_eq!(repairs(&fixture.look(true).await), [read]);
        assert_eq!(fixture.cursor().await, right);
        assert_eq!(fixture.look(false).await.findings, []);
    }
}

#[tokio::test]
async fn who_names_anothers_alone_names_its_own_again() {
    let fixture = Fixture::new().await;
    let wrong = [(FindingKind::Mistaken, "t1"), (FindingKind::Mistaken, "t3")];
    let named = (FindingKind::Mistaken, Some(Repair::Renamed));
    fixture.swap(1, 3).await;
    for report in [fixture.check(false).await, fixture.look(false).await] {
        assert_eq!(found(&report), wrong);
    }
    for with_records in [false, true] {
        fixture.swap(1, 3).await;
        let report = match with_records {
            false => fixture.repair_alone().await,
            true => fixture.look(true).await,
        };
        assert_eq!(repairs(&report), [named; 2]);
        assert_eq!(fixture.look(false).await.findings, []);
    }
    // One whose own is not whole gets it anew, and leaves the other's to that.
    fixture.swap(1, 3).await;
    fs::write(fixture.path(1), "damaged").unwrap();
    let report = fixture.look(true).await;
    let anew = (FindingKind::Mistaken, Some(Repair::Queued));
    assert_eq!(repairs(&report), [anew, named]);
    assert!(fixture.path(1).is_file());
    let catalog = fixture.archive.catalog();
    let t3 = catalog.origins(VOLUME, &fixture.names[3]).await.unwrap();
    assert_eq!((t3.len(), &*t3[0].tile), (1, "t3"));
}

#[tokio::test]
async fn pyramids_of_another_volume_are_that_ones() {
    let fixture = Fixture::new().await;
    let object = fixture.other_volume().await;
    let misname = format!("UPDATE tiles SET pyramid = '{object}' WHERE name = 't0'");
    fixture.meddle(&[&misname]).await;
    let report = fixture.check(false).await;
    assert_eq!(found(&report), [(FindingKind::Mistaken, "t0")]);
    let reason = &report.findings[0].reason;
    assert!(reason.contains("volume \"w\""), "{reason}");
    let named = [(FindingKind::Mistaken, Some(Repair::Renamed))];
    assert_eq!(repairs(&fixture.repair_alone().await), named);
    assert_eq!(fixture.check(false).await.findings, []);
    // Whoever deletes the tile does not delete the other's pyramid.
    fixture.meddle(&[&misname]).await;
    fixture.delete("t0").await;
    let catalog = fixture.archive.catalog();
    let later = catalog.clock().now() + Duration::from_secs(9);
    assert_eq!(catalog.retired(VOLUME, later, 9).await.unwrap(), []);
}

#[tokio::test]
async fn tiles_that_lie_within_what_changed_and_did_not_come_there_are_moved_back() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    for tile in ["t1", "t2", "t3"] {
        catalog.set_transform(VOLUME, tile, at(90.0)).await.unwrap();
    }
    // Made anew, it stays where it was.
    let t3 = catalog.tile(VOLUME, "t3").await.unwrap().unwrap();
    let again = NewTile {
        name: t3.name,
        section: t3.section,
        channel: 0,
        size: t3.size,
        transform: SectionFromTile::translation(DVec2::splat(3.0)),
        position: position_of(&t3.pyramid).unwrap(),
        pyramid: t3.pyramid,
    };
    catalog.commit_tile(VOLUME, &again).await.unwrap();
    assert_eq!(fixture.transform("t3").await, at(90.0));
    assert_eq!(fixture.look(true).await.findings, []);
    fixture
        .meddle(&[
            "UPDATE tiles SET a = 0.5, d = 0.5, tx = 23, ty = 23 WHERE name = 't0'",
            "UPDATE tiles SET tx = 50, ty = 5 WHERE name = 't1'",
            "UPDATE tiles SET a = -1, tx = tx + 200 WHERE name = 't4'",
        ])
        .await;
    let report = fixture.look(true).await;
    let moved = (FindingKind::Spoilt, Some(Repair::Moved));
    assert_eq!(repairs(&report), [moved; 3]);
    let tiles: Vec<_> = found(&report).into_iter().map(|(_, tile)| tile).collect();
    assert_eq!(tiles, ["t0", "t1", "t4"]);
    for tile in ["t2", "t3"] {
        assert_eq!(fixture.transform(tile).await, at(90.0));
    }
    assert_eq!(fixture.look(false).await.findings, []);
}

#[tokio::test]
async fn records_are_of_the_volume_whose_tiles_they_are_of() {
    let fixture = Fixture::new().await;
    fixture.other_volume().await;
    let catalog = fixture.archive.catalog();
    let mut commit = catalog.begin(OTHER).await.unwrap();
    let read = Cursor {
        offset: 40,
        line: 1,
        seen: None,
    };
    commit.cursor(read).await.unwrap();
    commit.finish().await.unwrap();
    // It was taken in under another name.
    let info = AcquisitionInfo::new(OTHER, UVec3::new(900, 900, 8), DVec3::ONE);
    info.write(fixture.acquisition.path()).unwrap();
    assert_eq!(fixture.look(false).await.findings, []);
    let forget = "DELETE FROM tiles WHERE name = 't5'";
    let count = "UPDATE volumes SET tiles = 5 WHERE name = 'v'";
    fixture.meddle(&[forget, count]).await;
    let report = fixture.look(false).await;
    assert_eq!(found(&report), [(FindingKind::Lost, "t5")]);
}

#[tokio::test]
async fn tiles_that_were_deleted_and_are_called_there_are_deleted_again() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    fixture.delete("t2").await;
    let with_pyramid = format!(
        "UPDATE tiles SET deleted = 0, pyramid = '{}' WHERE name = 't2'",
        fixture.names[2]
    );
    for back in [
        "UPDATE tiles SET deleted = 0 WHERE name = 't2'",
        &with_pyramid,
    ] {
        fixture.meddle(&[back]).await;
        let report = fixture.look(false).await;
        assert_eq!(found(&report), [(FindingKind::Spoilt, "t2")]);
        let reason = &report.findings[0].reason;
        assert!(reason.contains("deleted when it last changed"), "{reason}");
        let away = [(FindingKind::Spoilt, Some(Repair::TakenAway))];
        assert_eq!(repairs(&fixture.look(true).await), away);
        assert!(catalog.tile(VOLUME, "t2").await.unwrap().is_none());
        assert_eq!(catalog.entry(VOLUME).await.unwrap().tiles, 5);
        assert_eq!(fixture.look(false).await.findings, []);
    }
}

/// Where a tile covers all of its section, no box of the changes tells one place from another.
#[tokio::test]
async fn of_a_tile_that_nobody_else_moved_the_place_is_its_records() {
    let large = |x: f64| SectionFromTile::new([10.0, 0.0, 0.0, 10.0, x, -300.0]).unwrap();
    for by_hand in [false, true] {
        for is_known in [false, true] {
            let fixture = Fixture::new().await;
            let catalog = fixture.archive.catalog();
            let to = large(-500.0);
            let position = fixture.append(&move_it("t2", to)).await;
            let mut commit = catalog.begin(VOLUME).await.unwrap();
            commit.transform("t2", to, Some(position)).await.unwrap();
            commit.finish().await.unwrap();
            // As somebody says, or as nobody does.
            let elsewhere = large(-530.0);
            match by_hand {
                true => {
                    let row = "UPDATE tiles SET tx = -530 WHERE name = 't2'";
                    fixture.meddle(&[row]).await;
                }
                false => {
                    let moved = catalog.set_transform(VOLUME, "t2", elsewhere).await;
                    moved.unwrap();
                }
            }
            // Of tiles that an earlier version moved it is not known.
            let earlier = "UPDATE tiles SET moved = NULL";
            if !is_known {
                fixture.meddle(&[earlier]).await;
            }
            let report = fixture.look(true).await;
            if by_hand && is_known {
                let moved = [(FindingKind::Spoilt, Some(Repair::Moved))];
                assert_eq!(repairs(&report), moved, "{:?}", report.findings);
                assert_eq!(fixture.transform("t2").await, to);
            } else {
                assert_eq!(report.findings, [], "{by_hand} {is_known}");
                assert_eq!(fixture.transform("t2").await, elsewhere);
            }
            assert_eq!(fixture.look(false).await.findings, []);
        }
    }
}

/// Nor does one tell where within it somebody has put a tile; the row does, and whether it is still as it was then.
#[tokio::test]
async fn a_tile_that_somebody_moved_stays_unless_its_row_was_altered() {
    let (to, cut) = (
        at(40.0),
        SectionFromTile::translation(DVec2::new(40.0, 800.0)),
    );
    for to in [to, cut] {
        let fixture = Fixture::new().await;
        let catalog = fixture.archive.catalog();
        catalog.set_transform(VOLUME, "t2", to).await.unwrap();
        // Whatever became of its change.
        for changes in [
            "UPDATE changes SET x1 = x0 + 1 WHERE reason = 'transform'",
            "DELETE FROM changes WHERE reason = 'transform'",
        ] {
            fixture.meddle(&[changes]).await;
            assert_eq!(fixture.look(true).await.findings, [], "{changes}");
            assert_eq!(fixture.transform("t2").await, to);
        }
        for altered in ["tx = tx + 1", "ty = ty + 20", "a = 0.99", "b = 0.01"] {
            catalog.set_transform(VOLUME, "t2", to).await.unwrap();
            let alter = format!("UPDATE tiles SET {altered} WHERE name = 't2'");
            fixture.meddle(&[&alter]).await;
            // Where it was put nobody knows any more, but that it was not there.
            let report = fixture.look(true).await;
            let moved = [(FindingKind::Spoilt, Some(Repair::Moved))];
            assert_eq!(repairs(&report), moved, "{altered}");
            let reason = &report.findings[0].reason;
            assert!(reason.contains("once more"), "{altered}: {reason}");
            let said = SectionFromTile::translation(DVec2::splat(3.0));
            assert_eq!(fixture.transform("t2").await, said);
            assert_eq!(fixture.look(false).await.findings, [], "{altered}");
        }
    }
}

/// A transform that comes between somebody's deletion of a tile and its new image, as it is with a record's.
#[tokio::test]
async fn what_is_said_of_a_deleted_tile_before_it_comes_again_is_followed() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    fixture.delete("t2").await;
    let early = fixture.append(&move_it("t2", at(50.0))).await;
    let record = TileRecord {
        tile: "t2".to_owned(),
        file: "t2.tif".to_owned(),
        section: 1,
        size: UVec2::new(200, 150),
        transform: at(100.0),
        channel: None,
    };
    let position = fixture.append(&Record::Tile(record.clone())).await;
    let object = format!("tiles/v/000001/t2-{position:x}.tif");
    let bytes = fs::read(fixture.path(2)).unwrap();
    let bytes = pyramid::named(bytes.into(), &object).unwrap();
    let written = fixture.archive.storage().write_durable(&object, bytes);
    written.await.unwrap();
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    commit.transform("t2", at(50.0), Some(early)).await.unwrap();
    let tile = NewTile {
        name: record.tile,
        section: record.section,
        channel: 0,
        size: record.size,
        transform: record.transform,
        pyramid: object,
        position,
    };
    commit.tile(&tile, catalog.clock().now()).await.unwrap();
    commit.finish().await.unwrap();
    assert_eq!(fixture.transform("t2").await, at(50.0));
    assert_eq!(fixture.look(false).await.damage(), 0);
    // Not where nobody has put it.
    fixture
        .meddle(&["UPDATE tiles SET tx = 60 WHERE name = 't2'"])
        .await;
    assert_eq!(
        found(&fixture.look(false).await)[0],
        (FindingKind::Spoilt, "t2")
    );
}
