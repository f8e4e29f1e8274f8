//! Files of the catalog whose pages are damaged.

use std::io::{Seek as _, SeekFrom, Write as _};

use super::*;

impl Fixture {
    /// Makes the root page of a table or an index say that there is nothing in it. What has the catalog open would keep what it
    /// knows of the page.
    async fn empty(self, what: &str) -> Self {
        self.archive.catalog().close().await;
        let file = self.folder.path().join("catalog.sqlite");
        let look = sqlx::SqlitePool::connect(file.to_str().unwrap())
            .await
            .unwrap();
        let question =
            "SELECT rootpage, page_size, type FROM sqlite_schema, pragma_page_size WHERE name = ?";
        let question = sqlx::query_as(question).bind(what);
        let (page, size, kind): (u64, u64, String) = question.fetch_one(&look).await.unwrap();
        look.close().await;
        assert!(!self.folder.path().join("catalog.sqlite-wal").exists());
        let mut bytes = vec![0; usize::try_from(size).unwrap()];
        // Leaves: no cells, whose content would begin at the end of the page.
        bytes[0] = if kind == "index" { 10 } else { 13 };
        bytes[5..7].copy_from_slice(&u16::try_from(size).unwrap().to_be_bytes());
        let mut file = File::options().write(true).open(file).unwrap();
        file.seek(SeekFrom::Start((page - 1) * size)).unwrap();
        file.write_all(&bytes).unwrap();
        let archive = VisualizationArchive::open(self.folder.path()).await;
        Self {
            archive: archive.unwrap(),
            ..self
        }
    }

    pub(super) async fn repair(&self, with_records: bool) -> CheckReport {
        let options = CheckOptions {
            repair: true,
            safe_age: Duration::ZERO,
            acquisition: with_records.then(|| self.acquisition.path().to_owned()),
            ..CheckOptions::default()
        };
        check(&self.archive, &options, &|_, _| {}).await.unwrap()
    }

    pub(super) fn has_all(&self) -> bool {
        (0..6).all(|n| self.path(n).is_file())
    }
}

#[tokio::test]
async fn indexes_that_have_lost_tiles_are_found_and_made_anew() {
    for index in ["tiles_by_section", "tiles_by_name"] {
        for with_records in [false, true] {
            let fixture = Fixture::new().await.empty(index).await;
            let report = fixture.check(false).await;
            let [found] = &report.findings[..] else {
                panic!("{:?}", report.findings);
            };
            assert_eq!(
                (found.kind, found.repair, report.damage()),
                (FindingKind::Unsound, None, 1)
            );
            for word in [index, "5 more", "saccade check --repair"] {
                assert!(found.reason.contains(word), "{}", found.reason);
            }
            let report = fixture.repair(with_records).await;
            let found: Vec<_> = report.findings.iter().map(|f| (f.kind, f.repair)).collect();
            assert_eq!(
                found,
                [(FindingKind::Unsound, Some(Repair::Reindexed))],
                "{:?}",
                report.findings
            );
            assert_eq!((report.damage(), report.tiles), (0, u64::from(TILES)));
            assert!(fixture.has_all());
            let entry = fixture.archive.catalog().entry(VOLUME).await.unwrap();
            assert_eq!(entry.tiles, u64::from(TILES));
            assert_eq!(fixture.check(false).await.findings, []);
        }
    }
}

/// New indexes would agree with a table that has lost its rows.
#[tokio::test]
async fn of_tables_that_have_lost_tiles_nothing_is_deleted_or_counted() {
    let fixture = Fixture::new().await.empty("tiles").await;
    for with_records in [false, true, true] {
        let report = fixture.repair(with_records).await;
        let found: Vec<_> = report.findings.iter().map(|f| (f.kind, f.repair)).collect();
        assert_eq!(
            (found, report.damage()),
            (vec![(FindingKind::Unsound, None)], 1)
        );
        let reason = &report.findings[0].reason;
        for word in ["table tiles lacks 6 rows", "put a copy", "another archive"] {
            assert!(reason.contains(word), "{reason}");
        }
        assert!(fixture.has_all());
        let entry = fixture.archive.catalog().entry(VOLUME).await.unwrap();
        assert_eq!(entry.tiles, u64::from(TILES));
    }
}

/// Somebody who repairs twice, before ingest has worked on what was found the first time.
#[tokio::test]
async fn pyramids_of_lost_tiles_outlast_any_number_of_repairs() {
    let fixture = Fixture::new().await;
    fixture.meddle(&["DELETE FROM tiles"]).await;
    for round in 0..3 {
        let report = fixture.repair(true).await;
        assert!(fixture.has_all(), "{round}: {:?}", report.findings);
    }
    let (queued, parked) = fixture.archive.catalog().queued(VOLUME).await.unwrap();
    assert_eq!(queued + parked, u64::from(TILES));
}

/// Nothing else says that they are gone: all rows are there.
#[tokio::test]
async fn indexes_that_are_gone_are_found_and_made_anew() {
    let fixture = Fixture::new().await;
    let [by_name, by_section] = ["tiles_by_name", "tiles_by_section"];
    let drops = [by_name, by_section].map(|index| format!("DROP INDEX {index}"));
    fixture.meddle(&drops.each_ref().map(String::as_str)).await;
    let report = fixture.check(false).await;
    let reasons: Vec<_> = report.findings.iter().map(|f| f.reason.as_str()).collect();
    assert_eq!((reasons.len(), report.damage()), (2, 2), "{reasons:?}");
    for (reason, index) in reasons.iter().zip([by_name, by_section]) {
        assert!(
            reason.contains(index) && reason.contains("--repair"),
            "{reason}"
        );
    }
    let repaired = fixture.repair(false).await;
    let found: Vec<_> = { repaired.findings.iter() }
        .map(|f| (f.kind, f.repair))
        .collect();
    let remade = (FindingKind::Unsound, Some(Repair::Reindexed));
    assert_eq!((found, repaired.damage()), (vec![remade; 2], 0));
    assert_eq!(fixture.check(false).await.findings, []);
    let catalog = fixture.archive.catalog();
    assert_eq!(catalog.lacking_indexes().await.unwrap(), [""; 0]);
}

/// An index of its name that is another one finds what it finds, and keeps no names apart.
#[tokio::test]
async fn an_index_that_is_another_one_is_made_anew() {
    let fixture = Fixture::new().await;
    let other = "CREATE INDEX tiles_by_name ON tiles (volume, name)";
    fixture.meddle(&["DROP INDEX tiles_by_name", other]).await;
    let report = fixture.check(false).await;
    assert_eq!(report.findings.len(), 1, "{:?}", report.findings);
    assert!(report.findings[0].reason.contains("tiles_by_name"));
    let repaired = fixture.repair(false).await;
    assert_eq!(repaired.findings[0].repair, Some(Repair::Reindexed));
    assert_eq!(fixture.check(false).await.findings, []);
}
