//! A volume of an archive that cannot be opened, beside one that can.

use std::path::Path;

use glam::{DVec3, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_core::volume::Volume;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::{ConnectOptions, Connection};

use super::answers::Client;
use super::{Running, archive, done, run, saccade, stderr};

async fn catalog(archive: &Path) -> SqliteConnection {
    let file = archive.join(VisualizationArchive::CATALOG);
    { SqliteConnectOptions::new().filename(file) }
        .connect()
        .await
        .unwrap()
}

/// Makes what a volume is to be such as cannot be understood, or takes it back.
async fn spoil(archive: &Path, volume: &str, spoilt: bool) {
    let statement = match spoilt {
        true => "UPDATE volumes SET description = '!' || description WHERE name = $1",
        false => "UPDATE volumes SET description = substr(description, 2) WHERE name = $1",
    };
    change(archive, volume, statement).await;
}

async fn change(archive: &Path, volume: &str, statement: &'static str) {
    let mut catalog = catalog(archive).await;
    let done = sqlx::query(statement).bind(volume).execute(&mut catalog);
    assert_eq!(done.await.unwrap().rows_affected(), 1);
    catalog.close().await.unwrap();
}

#[test]
fn a_volume_that_cannot_be_opened_keeps_no_other_from_being_offered() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let place = Path::new(&archive);
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        let open = VisualizationArchive::open(place).await.unwrap();
        // Before the other one, by name.
        let volume = Volume::new("a-first", UVec3::splat(64), DVec3::splat(8.0)).unwrap();
        open.catalog().create_volume(&volume).await.unwrap();
        open.catalog().close().await;
        spoil(place, "a-first", true).await;
    });

    let mut command = saccade();
    let (_server, url) = Running::start(command.args(["serve", &archive, "--port", "0"]));
    let client = Client::of(&url);
    let list = client.get("volumes.json").json();
    assert_eq!(list["volumes"][0]["name"], "phantom", "{list}");
    assert_eq!(list["failing"][0]["name"], "a-first", "{list}");
    let cause = list["failing"][0]["cause"].as_str().unwrap();
    assert!(cause.contains("description"), "{cause}");
    assert!(!cause.contains(&archive), "{cause}");
    assert_eq!(client.get("v/phantom/volume.json").status, 200);
    for path in ["v/a-first/volume.json", "v/a-first/zarr/0/c/0/0/0/0"] {
        let answer = client.get(path);
        assert_eq!((answer.status, answer.retry), (503, true), "{answer:?}");
        assert_eq!(answer.json()["cause"], cause);
    }
    let page = client.get("volumes").text;
    assert!(
        page.contains("a-first</h2>\n<p>cannot be opened now"),
        "{page}"
    );

    // Neither does it keep those from the other who name none.
    let out = folder.path().join("out.zarr");
    let said = stderr(&done(["export", &archive, out.to_str().unwrap()]));
    assert!(said.contains("\"a-first\""), "{said}");
    let checked = run(["check", &archive]);
    let found = String::from_utf8_lossy(&checked.stdout);
    assert!(found.starts_with("spoilt: of a-first: "), "{found}");
    assert_eq!(found.lines().count(), 1, "{found}");
    assert_eq!(checked.status.code(), Some(3));

    // Once it is mended, it is there.
    runtime.block_on(spoil(place, "a-first", false));
    client.until("v/a-first/volume.json", |answer| answer.status == 200);
    let list = client.get("volumes.json").text;
    assert!(!list.contains("failing"), "{list}");
}

/// Where there is nothing else to look at, whoever can mend it is told at once.
#[test]
fn an_archive_of_which_nothing_can_be_opened_is_not_served() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(spoil(Path::new(&archive), "phantom", true));
    let output = run(["serve", &archive, "--port", "0"]);
    let said = stderr(&output);
    assert!(
        !output.status.success() && said.contains("description"),
        "{said}"
    );
}

/// Its tiles are shown, whatever else the list of sections says.
#[test]
fn an_impossible_section_keeps_nothing_from_being_shown() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let insert = "INSERT INTO sections SELECT id, -7, 1 FROM volumes WHERE name = $1";
    tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap()
        .block_on(change(Path::new(&archive), "phantom", insert));
    let mut command = saccade();
    let (_server, url) = Running::start(command.args(["serve", &archive, "--port", "0"]));
    let client = Client::of(&url);
    let list = client.get("volumes.json").json();
    assert!(list["failing"].is_null(), "{list}");
    assert_eq!(client.get("v/phantom/zarr/0/c/0/0/0/0").status, 200);
}
