//! What the catalog says that its pyramids or records do not.

use super::*;

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

}

fn repairs(report: &CheckReport) -> Vec<(FindingKind, Option<Repair>)> {
    let all = report.findings.iter().map(|f| (f.kind, f.repair));
    all.collect()
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
