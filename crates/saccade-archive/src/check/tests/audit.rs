//! What the catalog says that its pyramids or records do not.

use glam::DVec2;

use super::*;
use crate::acquisition::{AcquisitionInfo, DeleteRecord, TransformRecord};
use crate::image::GrayImage16;

impl Fixture {
    pub(super) async fn look(&self, repair: bool) -> CheckReport {
        let options = CheckOptions {
            repair,
            acquisition: Some(self.acquisition.path().to_owned()),
            safe_age: Duration::ZERO,
            ..CheckOptions::default()
        };
        check(&self.archive, &options, &|_, _| {}).await.unwrap()
    }

    /// Appends a record that counts as read, and returns its position.
    pub(super) async fn append(&self, record: &Record) -> u64 {
        let mut writer = RecordWriter::open(self.acquisition.path()).unwrap();
        let path = self.acquisition.path().join(RecordReader::FILE);
        let position = fs::metadata(&path).unwrap().len();
        writer.append(record).unwrap();
        let read = Cursor {
            offset: fs::metadata(&path).unwrap().len(),
            ..self.cursor().await
        };
        self.set_cursor(read).await;
        position
    }

    pub(super) async fn cursor(&self) -> Cursor {
        self.archive.catalog().cursor(VOLUME).await.unwrap()
    }

    pub(super) async fn set_cursor(&self, read: Cursor) {
        let mut commit = self.archive.catalog().begin(VOLUME).await.unwrap();
        commit.cursor(read).await.unwrap();
        commit.finish().await.unwrap();
    }

    pub(super) async fn transform(&self, tile: &str) -> SectionFromTile {
        let tile = self.archive.catalog().tile(VOLUME, tile).await.unwrap();
        tile.unwrap().transform
    }
}

pub(super) fn repairs(report: &CheckReport) -> Vec<(FindingKind, Option<Repair>)> {
    let all = report.findings.iter().map(|f| (f.kind, f.repair));
    all.collect()
}

pub(super) fn at(x: f64) -> SectionFromTile {
    SectionFromTile::translation(DVec2::new(x, 7.0))
}

pub(super) fn move_it(tile: &str, to: SectionFromTile) -> Record {
    Record::Transform(TransformRecord {
        tile: tile.to_owned(),
        transform: to,
    })
}

#[tokio::test]
async fn tiles_that_no_deletion_took_are_brought_back() {
    let fixture = Fixture::new().await;
    let delete = "UPDATE tiles SET deleted = 1 WHERE name IN ('t2', 't3')";
    fixture.meddle(&[delete]).await;
    for quick in [true, false] {
        let report = fixture.check(quick).await;
        let (t2, t3) = ((FindingKind::Spoilt, "t2"), (FindingKind::Spoilt, "t3"));
        assert_eq!(found(&report), [t2, t3]);
        let reason = &report.findings[0].reason;
        assert!(
            reason.contains("deleted") && reason.contains("--repair"),
            "{reason}"
        );
    }
    let before = fixture.archive.catalog().revision(VOLUME).await.unwrap();
    let report = fixture.look(true).await;
    let back = (FindingKind::Spoilt, Some(Repair::Restored));
    assert_eq!((repairs(&report), report.damage()), (vec![back; 2], 0));
    let now = fixture.archive.catalog().entry(VOLUME).await.unwrap();
    assert_eq!((now.tiles, now.revision), (u64::from(TILES), before + 2));
    assert_eq!(fixture.check(false).await.findings, []);

    // One whose pyramid is gone is made anew; one whose records say so is gone.
    fixture.meddle(&[delete]).await;
    fs::remove_file(fixture.path(2)).unwrap();
    let gone = DeleteRecord { tile: "t3".into() };
    fixture.append(&Record::Delete(gone)).await;
    let report = fixture.look(true).await;
    let of_t2 = report
        .findings
        .iter()
        .find(|f| f.tile.as_deref() == Some("t2"));
    assert_eq!(of_t2.unwrap().repair, Some(Repair::Queued));
    assert!(
        report
            .findings
            .iter()
            .all(|f| f.tile.as_deref() != Some("t3"))
    );
    assert!(
        fixture
            .archive
            .catalog()
            .tile(VOLUME, "t3")
            .await
            .unwrap()
            .is_none()
    );
}

#[tokio::test]
async fn records_are_not_read_up_to_where_no_line_begins() {
    let fixture = Fixture::new().await;
    let mut reader = RecordReader::new(fixture.acquisition.path(), Cursor::default());
    reader.read(9).unwrap();
    let right = reader.cursor();
    for seen in [None, right.seen] {
        for (offset, words) in [
            (right.offset - 7, ["midst of a line", "not what was read"]),
            (right.offset + 900, ["bytes", "bytes"]),
        ] {
            let wrong = Cursor {
                offset,
                seen,
                ..right
            };
            fixture.set_cursor(wrong).await;
            // Nothing else tells how far they were read.
            assert_eq!(fixture.check(false).await.findings, []);
            let report = fixture.look(false).await;
            assert_eq!(repairs(&report), [(FindingKind::Spoilt, None)]);
            let reason = &report.findings[0].reason;
            let word = words[usize::from(seen.is_some())];
            assert!(
                reason.contains(word) && reason.contains("--repair"),
                "{reason}"
            );
            let report = fixture.look(true).await;
            assert_eq!(
                repairs(&report),
                [(FindingKind::Spoilt, Some(Repair::Reread))]
            );
            assert_eq!(fixture.cursor().await, right);
            assert_eq!(fixture.look(false).await.findings, []);
        }
    }
    // Others have their place: nothing is found out from them, and nothing deleted.
    let list = fixture.acquisition.path().join(RecordReader::FILE);
    let said = fs::read_to_string(&list).unwrap();
    fs::write(&list, said.replace("\"t", "\"u")).unwrap();
    let stray = fixture.folder.path().join("tiles/v/000000/stray-7.tif");
    fs::write(&stray, "stray").unwrap();
    let report = fixture.look(true).await;
    let want = [(FindingKind::Spoilt, None), (FindingKind::Orphan, None)];
    assert_eq!(repairs(&report), want);
    let reason = &report.findings[0].reason;
    assert!(reason.contains("--acquisition"), "{reason}");
    assert!(stray.exists());
    assert_eq!(fixture.cursor().await, right);
}

#[tokio::test]
async fn what_is_said_of_a_volume_is_held_against_its_acquisition() {
    for (key, value, words) in [
        ("$.voxel_nm", "[1.0, 1.0, 2.0]", "voxel size"),
        ("$.dtype", "\"uint16\"", "16 bits"),
        ("$.channels", "[\"SE\"]", "channels"),
        ("$.kind", "\"labels\"", "kind"),
        ("$.levels[1].extent", "[449, 450, 4]", "levels"),
        ("$.chunk", "[64, 64, 33]", "chunks"),
    ] {
        let fixture = Fixture::new().await;
        let info = AcquisitionInfo::new(VOLUME, UVec3::new(900, 900, 8), DVec3::ONE);
        info.write(fixture.acquisition.path()).unwrap();
        assert_eq!(fixture.look(false).await.findings, []);
        let change = format!(
            "UPDATE volumes SET description = json_set(description, '{key}', json('{value}'))"
        );
        fixture.meddle(&[&change]).await;
        let report = fixture.look(true).await;
        assert!(report.damage() > 0, "{key}");
        let of_volume = report
            .findings
            .iter()
            .all(|f| (f.kind, f.tile.as_deref(), f.repair) == (FindingKind::Spoilt, None, None));
        assert!(of_volume, "{key}: {:?}", report.findings);
        let told = report.findings.iter().any(|f| f.reason.contains(words));
        assert!(told, "{key}: {:?}", report.findings);
    }
}

/// One of many is not its volume's; if all are not, the volume is described wrongly.
#[tokio::test]
async fn pyramids_of_another_type_than_their_volume_are_found() {
    let fixture = Fixture::new().await;
    let wide = GrayImage16 {
        width: 200,
        height: 150,
        voxels: (0..200 * 150).map(|n| n % 977 * 31).collect(),
    };
    let bytes = encode(&wide, &Encoding::Lossless).unwrap();
    let bytes = pyramid::named(bytes, &fixture.names[2]).unwrap();
    fs::write(fixture.path(2), bytes).unwrap();
    for quick in [true, false] {
        let report = fixture.check(quick).await;
        assert_eq!(found(&report), [(FindingKind::Mistaken, "t2")]);
        assert!(report.findings[0].reason.contains("16 bits"));
    }
    let report = fixture.look(true).await;
    assert_eq!(
        repairs(&report),
        [(FindingKind::Mistaken, Some(Repair::Queued))]
    );
}

#[tokio::test]
async fn tiles_that_lie_where_nothing_says_so_are_moved_back() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    // Whoever moves it by hand, and whoever does not follow its record.
    let not_followed = at(61.0);
    fixture.append(&move_it("t2", not_followed)).await;
    // What ingest cannot follow, neither of which keeps somebody from moving the tile.
    let outside = at(-1e6);
    let senseless = SectionFromTile::new([1e3, 0.0, 0.0, 1e3, 3.0, 3.0]).unwrap();
    fixture.append(&move_it("t4", outside)).await;
    fixture.append(&move_it("t5", senseless)).await;
    // Moved by `saccade update`, before and after a record said something.
    let followed = fixture.append(&move_it("t1", at(40.0))).await;
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    commit
        .transform("t1", at(40.0), Some(followed))
        .await
        .unwrap();
    commit.finish().await.unwrap();
    for tile in ["t1", "t5"] {
        catalog.set_transform(VOLUME, tile, at(90.0)).await.unwrap();
    }
    fixture
        .meddle(&["UPDATE tiles SET tx = tx + 20 WHERE name = 't3'"])
        .await;
    assert_eq!(fixture.check(false).await.findings, []);
    let (report, t3) = (fixture.look(false).await, fixture.transform("t3").await);
    assert_eq!(
        found(&report),
        [(FindingKind::Spoilt, "t2"), (FindingKind::Spoilt, "t3")]
    );
    let [t2_said, t3_said] = [0, 1].map(|n| &report.findings[n].reason);
    assert!(
        t2_said.contains("61.0") && t2_said.contains("not followed"),
        "{t2_said}"
    );
    assert!(
        t3_said.contains("23.0") && t3_said.contains("nobody else has moved it"),
        "{t3_said}"
    );
    let report = fixture.look(true).await;
    assert_eq!(
        repairs(&report),
        [(FindingKind::Spoilt, Some(Repair::Moved)); 2]
    );
    assert_eq!(fixture.transform("t2").await, not_followed);
    assert_eq!(
        fixture.transform("t3").await,
        SectionFromTile::translation(DVec2::splat(3.0))
    );
    assert_ne!(t3, fixture.transform("t3").await);
    for tile in ["t1", "t5"] {
        assert_eq!(fixture.transform(tile).await, at(90.0));
    }
    assert_eq!(fixture.look(false).await.findings, []);
    // Of changes that are no longer kept nobody knows, unless the catalog has noted who moved what; the newest are, and where they are
    // not, something is lost.
    fixture
        .meddle(&[
            "DELETE FROM changes WHERE revision < (SELECT max(revision) FROM changes)",
            "UPDATE tiles SET tx = tx + 20 WHERE name = 't0'",
        ])
        .await;
    let t0 = [(FindingKind::Spoilt, "t0")];
    assert_eq!(found(&fixture.look(false).await), t0);
    fixture.meddle(&["UPDATE tiles SET moved = NULL"]).await;
    assert_eq!(fixture.look(false).await.findings, []);
    fixture.meddle(&["DELETE FROM changes"]).await;
    let report = fixture.look(false).await;
    let told = ["t0", "t1", "t5"].map(|tile| (FindingKind::Spoilt, tile));
    assert_eq!(found(&report), told);
}

/// A transform that came before its tile is the tile's.
#[tokio::test]
async fn transforms_of_tiles_that_came_later_are_their_own() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    let early = fixture.append(&move_it("t9", at(30.0))).await;
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    commit.transform("t9", at(30.0), Some(early)).await.unwrap();
    commit.finish().await.unwrap();
    let record = TileRecord {
        tile: "t9".to_owned(),
        file: "t9.tif".to_owned(),
        section: 3,
        size: UVec2::new(200, 150),
        transform: at(0.0),
        channel: None,
    };
    let position = fixture.append(&Record::Tile(record)).await;
    let object = format!("tiles/v/000003/t9-{position:x}.tif");
    fs::create_dir_all(fixture.folder.path().join("tiles/v/000003")).unwrap();
    let bytes = pyramid::named(fs::read(fixture.path(0)).unwrap().into(), &object).unwrap();
    fs::write(fixture.folder.path().join(&object), bytes).unwrap();
    let tile = NewTile {
        name: "t9".to_owned(),
        section: 3,
        channel: 0,
        size: UVec2::new(200, 150),
        transform: at(0.0),
        pyramid: object,
        position,
    };
    catalog.commit_tile(VOLUME, &tile).await.unwrap();
    assert_eq!(fixture.transform("t9").await, at(30.0));
    assert_eq!(fixture.look(false).await.findings, []);
}

/// What is taken in again lies where its records say, and whether it should be there is told to be unknown.
#[tokio::test]
async fn lost_tiles_lie_where_their_newest_record_says() {
    let fixture = Fixture::new().await;
    let catalog = fixture.archive.catalog();
    let position = fixture.append(&move_it("t3", at(44.0))).await;
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    commit
        .transform("t3", at(44.0), Some(position))
        .await
        .unwrap();
    commit.finish().await.unwrap();
    let tile = catalog.tile(VOLUME, "t3").await.unwrap().unwrap();
    let forget = "DELETE FROM tiles WHERE name = 't3'";
    fixture
        .meddle(&[forget, "UPDATE volumes SET tiles = 5"])
        .await;
    let report = fixture.look(true).await;
    assert_eq!(
        repairs(&report),
        [(FindingKind::Lost, Some(Repair::Queued))]
    );
    let reason = &report.findings[0].reason;
    assert!(
        reason.contains("nor whether `saccade update` has deleted it"),
        "{reason}"
    );
    // As ingest does.
    let [waiting] = &catalog.waiting(VOLUME).await.unwrap()[..] else {
        panic!("one waits");
    };
    let new = NewTile {
        name: tile.name,
        section: tile.section,
        channel: tile.channel,
        size: tile.size,
        transform: waiting.record.transform,
        pyramid: tile.pyramid,
        position: waiting.position,
    };
    catalog.commit_tile(VOLUME, &new).await.unwrap();
    assert_eq!(fixture.transform("t3").await, at(44.0));
}

#[tokio::test]
async fn of_what_nothing_is_left_that_is_told() {
    let fixture = Fixture::new().await;
    fs::write(fixture.path(1), "damaged").unwrap();
    fs::remove_file(fixture.acquisition.path().join("t1.tif")).unwrap();
    for repair in [false, true] {
        let report = fixture.look(repair).await;
        let set_aside = repair.then_some(Repair::Quarantined);
        assert_eq!(repairs(&report), [(FindingKind::Damaged, set_aside)]);
        let reason = &report.findings[0].reason;
        for word in [
            "\"t1.tif\"",
            "neither of the two is left",
            "put a copy of the image",
        ] {
            assert!(reason.contains(word), "{reason}");
        }
    }
    let set_aside = fixture.archive.catalog().quarantined(VOLUME).await.unwrap();
    assert!(set_aside[0].reason.contains("neither of the two is left"));
    // As it says.
    File::create(fixture.acquisition.path().join("t1.tif")).unwrap();
    let report = fixture.look(true).await;
    assert_eq!(
        repairs(&report),
        [(FindingKind::Damaged, Some(Repair::Queued))]
    );
}

/// No transform leads back from beyond the last section.
#[tokio::test]
async fn of_sections_beyond_the_last_nobody_is_told_to_move_tiles() {
    let fixture = Fixture::new().await;
    fixture
        .meddle(&["UPDATE tiles SET section = 8 WHERE name = 't3'"])
        .await;
    let options = CheckOptions {
        repair: true,
        ..CheckOptions::default()
    };
    let report = check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
    let misplaced = report
        .findings
        .iter()
        .find(|f| f.kind == FindingKind::Misplaced);
    let misplaced = misplaced.unwrap();
    assert_eq!(
        (misplaced.tile.as_deref(), misplaced.repair),
        (Some("t3"), None)
    );
    let reason = &misplaced.reason;
    assert!(!reason.contains("where it lies"), "{reason}");
    assert!(
        reason.contains("record") && reason.contains("--acquisition FOLDER"),
        "{reason}"
    );
    assert!(
        reason.contains("delete it with `saccade update`"),
        "{reason}"
    );
    // With its record it is taken in anew.
    let report = fixture.look(true).await;
    let of_t3 = report
        .findings
        .iter()
        .filter(|f| f.tile.as_deref() == Some("t3"));
    let of_t3: Vec<_> = of_t3.map(|f| f.repair).collect();
    assert_eq!(of_t3, [Some(Repair::Queued)]);
}
