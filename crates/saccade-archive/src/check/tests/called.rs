//! Rows that have another tile's name, or that of none.

use super::audit::{at, repairs};
use super::*;

const NAMED: (FindingKind, Option<Repair>) = (FindingKind::Spoilt, Some(Repair::Renamed));

impl Fixture {
    /// What each tile shows, and where: all but revisions.
    async fn shown(&self) -> Vec<(String, String, SectionFromTile, u32)> {
        let catalog = self.archive.catalog();
        let mut shown = Vec::new();
        for z in catalog.sections_of_tiles(VOLUME).await.unwrap() {
            let tiles = catalog.section_tiles(VOLUME, z).await.unwrap();
            let tiles = tiles.into_iter();
            shown.extend(tiles.map(|t| (t.name, t.pyramid, t.transform, t.section)));
        }
        shown.sort_by(|a, b| a.0.cmp(&b.0));
        shown
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
