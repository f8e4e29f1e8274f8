//! What the catalog says that its pyramids or records do not.

use super::*;
use crate::acquisition::DeleteRecord;

impl Fixture {
    async fn look(&self, repair: bool) -> CheckReport {
        let options = CheckOptions {
            repair,
            acquisition: Some(self.acquisition.path().to_owned()),
            safe_age: Duration::ZERO,
            ..CheckOptions::default()
        };
        check(&self.archive, &options, &|_, _| {}).await.unwrap()
    }

    /// Appends a record that counts as read, and returns its position.
    async fn append(&self, record: &Record) -> u64 {
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

    async fn cursor(&self) -> Cursor {
        self.archive.catalog().cursor(VOLUME).await.unwrap()
    }

    async fn set_cursor(&self, read: Cursor) {
        let mut commit = self.archive.catalog().begin(VOLUME).await.unwrap();
        commit.cursor(read).await.unwrap();
        commit.finish().await.unwrap();
    }
}

fn repairs(report: &CheckReport) -> Vec<(FindingKind, Option<Repair>)> {
    let all = report.findings.iter().map(|f| (f.kind, f.repair));
    all.collect()
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
