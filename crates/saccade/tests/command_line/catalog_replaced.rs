//! A server whose catalog is taken away, and another is put in its place.

use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use glam::{DVec3, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_archive::catalog::Catalog;
use saccade_core::volume::Volume;
use serde_json::Value;

use super::{Running, archive, saccade};

fn files(archive: &str) -> [PathBuf; 3] {
    let file = Path::new(archive).join(VisualizationArchive::CATALOG);
    ["", "-wal", "-shm"].map(|end| PathBuf::from(format!("{}{end}", file.display())))
}

#[test]
fn a_server_tells_that_its_catalog_is_away_and_serves_the_one_that_comes_instead() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let other = folder.path().join("other.sqlite");
    runtime.block_on(async {
        let other = Catalog::create(other.as_path()).await.unwrap();
        for (name, width) in [("phantom", 77), ("second", 64)] {
            let extent = UVec3::new(width, 64, 64);
            let volume = Volume::new(name, extent, DVec3::splat(8.0)).unwrap();
            other.create_volume(&volume).await.unwrap();
        }
        other.close().await;
    });
    let mut command = saccade();
    let (_server, url) = Running::start(command.args(["serve", &archive, "--port", "0"]));
    let get = async |path: &str| {
        let answer = reqwest::get(format!("{url}{path}")).await.unwrap();
        let status = answer.status().as_u16();
        let retry = answer.headers().contains_key("retry-after");
        let text = answer.text().await.unwrap();
        let answer: Value = serde_json::from_str(&text).unwrap_or_default();
        (status, retry, answer)
    };
    let until = async |path: &str, is_so: &dyn Fn(u16, &Value) -> bool| {
        let end = SystemTime::now() + Duration::from_secs(30);
        loop {
            let (status, retry, answer) = get(path).await;
            if is_so(status, &answer) {
                return (retry, answer);
            }
            assert!(SystemTime::now() < end, "{path}: {status} {answer}");
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    runtime.block_on(async {
        until("v/phantom/status.json", &|status, _| status == 200).await;
        for file in files(&archive) {
            // What there is of them.
            let _removed = std::fs::remove_file(file);
        }
        let (retry, answer) = until("v/phantom/status.json", &|status, _| status == 503).await;
        let cause = answer["cause"].as_str().unwrap();
        assert!(retry && cause.contains("put it back"), "{answer}");
        assert!(!cause.contains(&archive), "{cause}");

        std::fs::copy(&other, &files(&archive)[0]).unwrap();
        until("v/phantom/volume.json", &|_, answer| {
            answer["volume"]["levels"][0]["extent"][0] == 77
        })
        .await;
        until("v/second/status.json", &|status, _| status == 200).await;
        until("v/phantom/status.json", &|_, answer| answer["tiles"] == 0).await;
    });
}
