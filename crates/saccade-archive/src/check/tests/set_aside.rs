//! What a check set aside, and is mended since.

use super::*;
use crate::catalog::Quarantined;

impl Fixture {
    async fn set_aside(&self) -> Vec<Quarantined> {
        self.archive.catalog().quarantined(VOLUME).await.unwrap()
    }
}

/// What ingest says of an image.
fn of_an_image(tile: &str) -> Quarantined {
    Quarantined {
        file: "t.tif".to_owned(),
        tile: Some(tile.to_owned()),
        reason: "the image is no TIFF".to_owned(),
        bytes: Some(3),
        at: std::time::UNIX_EPOCH,
        awaited: None,
    }
}

#[tokio::test]
async fn what_is_whole_again_is_set_aside_no_longer() {
    let fixture = Fixture::new().await;
    let whole = fs::read(fixture.path(2)).unwrap();
    fs::write(fixture.path(2), "damaged").unwrap();
    assert_eq!(fixture.repair(false).await.set_aside, 1);
    fixture.repair(false).await;
    let still = fixture.set_aside().await;
    assert!(!still.is_empty() && still.iter().all(Quarantined::is_of_an_image));
    fs::write(fixture.path(2), &whole).unwrap();
    // Who only looks changes nothing.
    assert!(fixture.look(false).await.set_aside > 0);
    let catalog = fixture.archive.catalog();
    let image = of_an_image("t2");
    catalog.quarantine(VOLUME, &image).await.unwrap();
    let report = fixture.repair(false).await;
    assert_eq!((report.findings, report.set_aside), (vec![], 1));
    assert_eq!(fixture.set_aside().await, [image]);
}

#[tokio::test]
async fn what_was_deleted_since_is_set_aside_no_longer() {
    for is_quick in [false, true] {
        let fixture = Fixture::new().await;
        fs::remove_file(fixture.path(2)).unwrap();
        fs::remove_file(fixture.path(3)).unwrap();
        assert_eq!(fixture.repair(false).await.set_aside, 2);
        // By somebody who knows nothing of what is set aside.
        let delete = "UPDATE tiles SET deleted = 1, pyramid = '', position = 1 WHERE name = 't2'";
        fixture.meddle(&[delete]).await;
        let options = CheckOptions {
            quick: is_quick,
            repair: true,
            ..CheckOptions::default()
        };
        check(&fixture.archive, &options, &|_, _| {}).await.unwrap();
        let left = fixture.set_aside().await;
        assert!(!left.is_empty());
        for what in left {
            assert_eq!(what.tile.as_deref(), Some("t3"), "{is_quick}");
        }
    }
}

/// Of one that takes another's place, too.
#[tokio::test]
async fn a_tile_that_names_anothers_pyramid_is_of_an_image() {
    let fixture = Fixture::new().await;
    let shared = "UPDATE tiles SET pyramid = (SELECT pyramid FROM tiles WHERE name = 't2') WHERE name = 't3'";
    fixture.meddle(&[shared]).await;
    let own = fs::read(fixture.path(3)).unwrap();
    fs::remove_file(fixture.path(3)).unwrap();
    let report = fixture.repair(false).await;
    assert_eq!(report.set_aside, 1, "{:?}", report.findings);
    let [what] = &fixture.set_aside().await[..] else {
        panic!("more than one");
    };
    assert!(what.is_of_an_image());
    assert!(what.reason.contains("transform"), "{}", what.reason);
    // By the repair that mends it, not the one after.
    fs::write(fixture.path(3), own).unwrap();
    let report = fixture.repair(true).await;
    assert_eq!(
        (report.damage(), report.set_aside),
        (0, 0),
        "{:?}",
        report.findings
    );
}
