//! Rows of one name.

use super::*;
use crate::acquisition::DeleteRecord;

/// What the index would have refused is mended first.
#[tokio::test]
async fn a_name_that_two_rows_have_keeps_its_index_from_being_made() {
    let fixture = Fixture::new().await;
    let twice = "UPDATE tiles SET name = 't1' WHERE name = 't0'";
    fixture.meddle(&["DROP INDEX tiles_by_name", twice]).await;
    // Nothing tells whose it is.
    let without = fixture.repair(false).await;
    let index = &without.findings[0];
    assert_eq!((index.kind, index.repair), (FindingKind::Unsound, None));
    assert!(
        index.reason.contains("two rows have one name") && index.reason.contains("--acquisition"),
        "{}",
        index.reason
    );
    // Which they are, whoever asks.
    for report in [without, fixture.check(false).await] {
        let reasons = { report.findings.iter() }.map(|finding| &finding.reason);
        let told: Vec<_> = reasons.filter(|r| r.contains("2 rows of")).collect();
        let [told] = told[..] else {
            panic!("{:?}", report.findings);
        };
        for what in ["\"t1\"", "--repair --acquisition FOLDER"] {
            assert!(told.contains(what), "{what}: {told}");
        }
    }
    let repaired = fixture.repair(true).await;
    assert_eq!(repaired.findings[0].repair, Some(Repair::Reindexed));
    assert!(fixture.has_all());
    fixture.has_each_once().await;
}

/// Whatever somebody wrote into them; the one that is the tile's stays, be it not the first.
#[tokio::test]
async fn of_rows_of_one_name_the_one_of_its_record_is_kept() {
    const COLUMNS: &str = "section, channel, width, height, a, b, c, d, tx, ty, revision, transform_position, deleted";
    for (which, pyramid, position) in [
        // The same once more, another's image, an image of none.
        ("t0", "pyramid", "position"),
        ("t1", "pyramid", "position"),
        ("t0", "'tiles/none'", "0"),
        ("t1", "pyramid", "999999999"),
    ] {
        for original_is_last in [false, true] {
            let fixture = Fixture::new().await;
            let copy = format!(
                "INSERT INTO tiles (volume, name, pyramid, position, {COLUMNS}) \
                 SELECT volume, 't0', {pyramid}, {position}, {COLUMNS} FROM tiles WHERE name = '{which}'"
            );
            let last = "UPDATE tiles SET id = (SELECT max(id) + 1 FROM tiles) \
                        WHERE id = (SELECT min(id) FROM tiles WHERE name = 't0')";
            let mut meddle = vec!["DROP INDEX tiles_by_name", &copy];
            meddle.extend(original_is_last.then_some(last));
            fixture.meddle(&meddle).await;
            let what = format!("{which} {pyramid} {position} {original_is_last}");
            let told = fixture.look(false).await;
            let reasons: Vec<_> = told.findings.iter().map(|f| &f.reason).collect();
            assert!(
                { reasons.iter() }.any(|reason| reason.contains("another row has its name")),
                "{what}: {reasons:?}"
            );
            let repaired = fixture.repair(true).await;
            assert_eq!(repaired.damage(), 0, "{what}: {:?}", repaired.findings);
            assert!(fixture.has_all(), "{what}");
            fixture.has_each_once().await;
        }
    }
}

impl Fixture {
    /// All are there, once, with their own pyramids, and nothing is found.
    async fn has_each_once(&self) {
        let catalog = self.archive.catalog();
        assert_eq!(catalog.lacking_indexes().await.unwrap(), [""; 0]);
        assert_eq!(self.check(true).await.findings, []);
        for n in 0..TILES {
            let name = format!("t{n}");
            let tile = catalog.tile(VOLUME, &name).await.unwrap().unwrap();
            assert!(tile.pyramid.contains(&name), "{name}: {}", tile.pyramid);
        }
    }
}

const ALL_BUT_PLACE: &str =
    "section, channel, width, height, a, b, c, d, revision, position, transform_position, pyramid";

/// Adds a row of `t2`'s name that says what that one says but for what is given, before or after all others.
fn copied(is_first: bool, place: &str, deleted: &str) -> String {
    let id = if is_first {
        "min(id) - 1"
    } else {
        "max(id) + 1"
    };
    format!(
        "INSERT INTO tiles (id, volume, name, {ALL_BUT_PLACE}, tx, ty, deleted) \
         SELECT (SELECT {id} FROM tiles), volume, name, {ALL_BUT_PLACE}, {place}, {deleted} FROM tiles WHERE name = 't2'"
    )
}

/// No record tells where somebody has moved a tile.
#[tokio::test]
async fn of_a_tile_that_was_moved_the_row_that_was_moved_is_kept() {
    for is_first in [false, true] {
        for place in ["3.0, 3.0", "55.0, 66.0"] {
            let fixture = Fixture::new().await;
            let to = SectionFromTile::translation(DVec2::splat(90.0));
            let catalog = fixture.archive.catalog();
            catalog.set_transform(VOLUME, "t2", to).await.unwrap();
            let copy = copied(is_first, place, "0");
            fixture.meddle(&["DROP INDEX tiles_by_name", &copy]).await;
            let repaired = fixture.repair(true).await;
            assert_eq!(repaired.damage(), 0, "{:?}", repaired.findings);
            let reason = &repaired.findings[1].reason;
            assert!(reason.contains("the catalog's changes tell"), "{reason}");
            fixture.has_each_once().await;
            let tile = catalog.tile(VOLUME, "t2").await.unwrap().unwrap();
            assert_eq!(tile.transform, to, "{is_first} {place}");
        }
    }
}

/// Nor does one tell that somebody has deleted it.
#[tokio::test]
async fn of_a_tile_that_was_deleted_the_row_that_says_so_is_kept() {
    let pyramid_of = |fixture: &Fixture| {
        format!(
            "UPDATE tiles SET pyramid = '{}' WHERE name = 't2' AND deleted = 0",
            fixture.names[2]
        )
    };
    for is_first in [false, true] {
        for has_changes in [false, true] {
            for has_pyramid in [false, true] {
                let fixture = Fixture::new().await;
                fixture.delete("t2").await;
                let (copy, pyramid) = (copied(is_first, "3.0, 3.0", "0"), pyramid_of(&fixture));
                let mut meddle = vec!["DROP INDEX tiles_by_name", &copy];
                meddle.extend(has_pyramid.then_some(&*pyramid));
                meddle.extend(
                    (!has_changes).then_some("DELETE FROM changes WHERE reason = 'deleted'"),
                );
                fixture.meddle(&meddle).await;
                let what = format!("{is_first} {has_changes} {has_pyramid}");
                let repaired = fixture.repair(true).await;
                if has_changes {
                    assert_eq!(repaired.damage(), 0, "{what}: {:?}", repaired.findings);
                }
                let catalog = fixture.archive.catalog();
                assert_eq!(catalog.tile(VOLUME, "t2").await.unwrap(), None, "{what}");
                assert_eq!(
                    catalog.rows_of_one_name(VOLUME).await.unwrap(),
                    [],
                    "{what}"
                );
            }
        }
    }
}

/// What cannot be known is left, and told.
#[tokio::test]
async fn of_rows_of_which_nothing_tells_none_is_taken_away() {
    for is_exchanged in [false, true] {
        nothing_tells(is_exchanged).await;
    }
}

/// The row that was moved has another id; the copy, which lies where the record says, has one of its own or that one's.
async fn nothing_tells(is_exchanged: bool) {
    let fixture = Fixture::new().await;
    let to = SectionFromTile::translation(DVec2::splat(90.0));
    let catalog = fixture.archive.catalog();
    catalog.set_transform(VOLUME, "t2", to).await.unwrap();
    let copy = copied(false, "3.0, 3.0", "0");
    let id = catalog.tile(VOLUME, "t2").await.unwrap().unwrap().id.0;
    let taken = format!("UPDATE tiles SET id = {id} WHERE name = 't2' AND tx = 3");
    let mut meddle = vec![
        "DROP INDEX tiles_by_name",
        &copy,
        "UPDATE tiles SET id = (SELECT max(id) + 1 FROM tiles) WHERE name = 't2' AND tx = 90",
    ];
    meddle.extend(is_exchanged.then_some(&*taken));
    fixture.meddle(&meddle).await;
    for with_records in [true, false, true] {
        let report = fixture.repair(with_records).await;
        assert!(report.damage() > 0, "{:?}", report.findings);
        assert_eq!(catalog.rows_of_one_name(VOLUME).await.unwrap().len(), 2);
        if !with_records {
            continue;
        }
        let reasons = { report.findings.iter() }.map(|finding| &finding.reason);
        let told: Vec<_> = reasons.filter(|r| r.contains("2 rows of")).collect();
        let [told] = told[..] else {
            panic!("{:?}", report.findings);
        };
        for what in ["\"t2\"", "90.0", "3.0", "take the others out"] {
            assert!(told.contains(what), "{what}: {told}");
        }
    }
    // As they are told.
    fixture
        .meddle(&["DELETE FROM tiles WHERE name = 't2' AND tx = 3"])
        .await;
    assert_eq!(fixture.repair(true).await.damage(), 0);
    fixture.has_each_once().await;
    let tile = catalog.tile(VOLUME, "t2").await.unwrap().unwrap();
    assert_eq!(tile.transform, to);
}

/// A row that has another's name and pyramid, but not the position of its record.
#[tokio::test]
async fn a_row_with_anothers_name_and_pyramid_is_mended_at_once() {
    // Of one section and of two, with the original before and after.
    for [lost, of] in [["t2", "t3"], ["t3", "t2"], ["t0", "t5"], ["t5", "t0"]] {
        let fixture = Fixture::new().await;
        let meddle = format!(
            "UPDATE tiles SET name = '{of}', pyramid = (SELECT pyramid FROM tiles WHERE name = '{of}') \
             WHERE name = '{lost}'"
        );
        fixture.meddle(&["DROP INDEX tiles_by_name", &meddle]).await;
        let told = fixture.look(false).await;
        let what = "which the catalog lacks";
        assert!(told.findings.iter().any(|f| f.reason.contains(what)));
        let repaired = fixture.repair(true).await;
        assert_eq!(repaired.damage(), 0, "{lost} {of}: {:?}", repaired.findings);
        // What shares a pyramid with another is made anew.
        let kinds: Vec<_> = { repaired.findings.iter() }.map(|f| f.repair).collect();
        assert!(kinds.contains(&Some(Repair::Renamed)), "{kinds:?}");
        let catalog = fixture.archive.catalog();
        assert_eq!(catalog.lacking_indexes().await.unwrap(), [""; 0]);
        assert_eq!(catalog.queued(VOLUME).await.unwrap(), (0, 1));
        for name in [lost, of] {
            assert!(catalog.tile(VOLUME, name).await.unwrap().is_some());
        }
        let of = catalog.tile(VOLUME, of).await.unwrap().unwrap();
        assert!(of.pyramid.contains(&of.name), "{}", of.pyramid);
    }
}

/// A row that has the name of a tile that was deleted, and no pyramid.
#[tokio::test]
async fn a_row_with_a_deleted_tiles_name_and_no_pyramid_is_made_anew_at_once() {
    for by_record in [false, true] {
        let fixture = Fixture::new().await;
        let catalog = fixture.archive.catalog();
        match by_record {
            true => {
                let gone = DeleteRecord { tile: "t2".into() };
                let position = fixture.append(&Record::Delete(gone)).await;
                catalog.delete_tile(VOLUME, "t2", position).await.unwrap();
            }
            false => fixture.delete("t2").await,
        }
        let meddle = "UPDATE tiles SET name = 't2', pyramid = '' WHERE name = 't4'";
        fixture.meddle(&["DROP INDEX tiles_by_name", meddle]).await;
        let repaired = fixture.repair(true).await;
        assert_eq!(repaired.damage(), 0, "{by_record}: {:?}", repaired.findings);
        assert_eq!(catalog.lacking_indexes().await.unwrap(), [""; 0]);
        assert_eq!(catalog.tile(VOLUME, "t2").await.unwrap(), None);
        fixture.ingest().await;
        assert!(catalog.tile(VOLUME, "t4").await.unwrap().is_some());
        assert_eq!(fixture.look(false).await.damage(), 0, "{by_record}");
    }
}
