//! A server whose catalog is taken away, and another is put in its place; a catalog that lost a table.

use std::path::{Path, PathBuf};

use glam::{DVec3, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_archive::catalog::Catalog;
use saccade_core::volume::Volume;

use super::answers::{Answer, Client};
use super::{Running, archive, done, run, saccade, stderr};

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
    let client = Client::of(&url);
    client.until("v/phantom/status.json", |answer| answer.status == 200);
    for file in files(&archive) {
        // What there is of them.
        let _removed = std::fs::remove_file(file);
    }
    let away = client.until("v/phantom/status.json", |answer| answer.status == 503);
    let (retry, answer) = (away.retry, away.json());
    let cause = answer["cause"].as_str().unwrap();
    assert!(retry && cause.contains("put it back"), "{answer}");
    assert!(!cause.contains(&archive), "{cause}");

    std::fs::copy(&other, &files(&archive)[0]).unwrap();
    client.until("v/phantom/volume.json", |answer| {
        answer.json()["volume"]["levels"][0]["extent"][0] == 77
    });
    client.until("v/second/status.json", |answer| answer.status == 200);
    client.until("v/phantom/status.json", |answer| {
        answer.json()["tiles"] == 0
    });
}

#[test]
fn a_server_serves_nothing_of_another_archives_catalog_and_goes_on_with_the_right_one() {
    let folder = tempfile::tempdir().unwrap();
    let [ours, theirs] = ["ours", "theirs"].map(|name| {
        let folder = folder.path().join(name);
        std::fs::create_dir(&folder).unwrap();
        archive(&folder)
    });
    let mut command = saccade();
    let (_server, url) = Running::start(command.args(["serve", &ours, "--port", "0"]));
    let client = Client::of(&url);
    let status = "v/phantom/status.json";
    let before = client.until(status, |answer| answer.status == 200).json();
    let [open, aside] = [files(&ours), files(&format!("{ours}/aside"))];
    std::fs::create_dir(format!("{ours}/aside")).unwrap();
    for (file, aside) in open.iter().zip(&aside) {
        // What there is of them.
        let _moved = std::fs::rename(file, aside);
    }
    std::fs::copy(&files(&theirs)[0], &open[0]).unwrap();
    let told = |answer: &Answer| {
        let cause = answer.json()["cause"].as_str().map(str::to_owned);
        answer.status == 503 && cause.is_some_and(|cause| cause.contains("another archive"))
    };
    let away = client.until(status, told);
    let (retry, answer) = (away.retry, away.json());
    let cause = answer["cause"].as_str().unwrap();
    assert!(
        retry && cause.contains("put the right one back") && !cause.contains(&ours),
        "{answer}"
    );

    for (file, aside) in open.iter().zip(&aside) {
        let _removed = std::fs::remove_file(file);
        let _moved = std::fs::rename(aside, file);
    }
    let after = client.until(status, |answer| answer.status == 200).json();
    assert_eq!(after["tiles"], before["tiles"]);
}

#[test]
fn a_catalog_that_lost_its_table_of_tiles_is_named_and_made_anew_from_the_records() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let acquisition = folder.path().join("acquisition");
    let acquisition = acquisition.to_str().unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let tiles = || {
        runtime.block_on(async {
            let catalog = Catalog::open(files(&archive)[0].as_path()).await.unwrap();
            let tiles = catalog.entry("phantom").await.unwrap().tiles;
            catalog.close().await;
            tiles
        })
    };
    let before = tiles();
    runtime.block_on(async {
        let path = format!("sqlite:{}", files(&archive)[0].display());
        let pool = sqlx::SqlitePool::connect(&path).await.unwrap();
        sqlx::query("DROP TABLE tiles")
            .execute(&pool)
            .await
            .unwrap();
        pool.close().await;
    });
    for command in [
        &["ingest", acquisition, &archive, "--once", "--lossless"][..],
        &["check", &archive],
    ] {
        let output = run(command);
        let said = stderr(&output);
        assert!(!output.status.success(), "{said}");
        assert!(
            said.contains("has no table \"tiles\"")
                && said.contains("saccade check --repair --acquisition FOLDER")
                && said.contains(&archive),
            "{said}"
        );
    }
    let repair = ["check", &archive, "--repair", "--acquisition", acquisition];
    let output = run(repair);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(3), "{said}");
    assert!(
        said.contains("made anew, empty") && said.contains(&format!("{before} lost")),
        "{said}"
    );
    done(["ingest", acquisition, &archive, "--once", "--lossless"]);
    assert_eq!(tiles(), before);
    let checked = stderr(&done(["check", &archive, "--acquisition", acquisition]));
    assert!(checked.contains("all whole"), "{checked}");
}
