//! What a check gives back to ingest is made anew.

use std::fs;
use std::time::{Duration, SystemTime};

use glam::UVec2;
use saccade_archive::check::{CheckOptions, Repair, check};

use crate::scope::{Scope, VOLUME, archive, pixels, seen, texture};

const SIZE: UVec2 = UVec2::new(140, 130);

#[tokio::test]
async fn damaged_tiles_are_made_anew() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    for n in 0..4u8 {
        scope.tile(&format!("t{n}"), u32::from(n), SIZE, n);
    }
    let archive = archive(folder.path()).await;
    scope.ingest(&archive).await;
    let whole = seen(&archive).await;
    let path = |n: &str| folder.path().join(&whole[n].pyramid);
    fs::write(path("t1"), "damaged").unwrap();
    fs::remove_file(path("t3")).unwrap();
    fs::copy(path("t0"), path("t2")).unwrap();

    let options = CheckOptions {
        repair: true,
        acquisition: Some(scope.path().to_owned()),
        safe_age: Duration::ZERO,
        ..CheckOptions::default()
    };
    let report = check(&archive, &options, &|_, _| {}).await.unwrap();
    let repairs: Vec<_> = report.findings.iter().map(|f| f.repair).collect();
    assert_eq!(repairs, [Some(Repair::Queued); 3], "{:?}", report.findings);
    assert_eq!(report.damage(), 0);
    assert_eq!(scope.ingest(&archive).await.tiles, 3);

    let report = check(&archive, &options, &|_, _| {}).await.unwrap();
    assert_eq!(report.findings, []);
    let mended = seen(&archive).await;
    assert_eq!(mended.len(), whole.len());
    for (n, (name, tile)) in (0..).zip(&mended) {
        let before = &whole[name];
        assert_eq!(
            (tile.section, tile.size, tile.transform),
            (before.section, before.size, before.transform)
        );
        // Another object: whoever has kept something of the damaged one does not take it for this.
        assert_eq!(tile.pyramid != before.pyramid, name != "t0", "{name}");
        assert_eq!(pixels(tile).await, texture(SIZE, n));
    }
    let later = SystemTime::now() + Duration::from_secs(60);
    let retired = archive.catalog().retired(VOLUME, later, 9).await.unwrap();
    assert_eq!(retired.len(), 3);
    assert_eq!(pixels(&mended["t2"]).await, texture(SIZE, 2));
    assert!(archive.catalog().waiting(VOLUME).await.unwrap().is_empty());
}
