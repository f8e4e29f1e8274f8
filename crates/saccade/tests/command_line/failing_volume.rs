//! A volume of an archive that cannot be opened, beside one that can.

use std::path::Path;
use std::time::{Duration, SystemTime};

use glam::{DVec3, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_core::volume::Volume;
use serde_json::Value;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::{ConnectOptions, Connection};

use super::{Running, archive, run, saccade, stderr};

async fn catalog(archive: &Path) -> SqliteConnection {
    let file = archive.join(VisualizationArchive::CATALOG);
    { SqliteConnectOptions::new().filename(file) }
        .connect()
        .await
        .unwrap()
}

/// Says that a volume has a section of which there can be none, or takes it back.
async fn spoil(archive: &Path, volume: &str, spoilt: bool) {
    let statement = match spoilt {
        true => "INSERT INTO sections SELECT id, -7, 1 FROM volumes WHERE name = $1",
        false => {
            "DELETE FROM sections WHERE section = -7 AND volume = (SELECT id FROM volumes WHERE name = $1)"
        }
    };
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
    let get = async |path: &str| {
        let answer = reqwest::get(format!("{url}{path}")).await.unwrap();
        let retry = answer.headers().contains_key("retry-after");
        (
            answer.status().as_u16(),
            retry,
            answer.text().await.unwrap(),
        )
    };
    runtime.block_on(async {
        let (_, _, list) = get("volumes.json").await;
        let list: Value = serde_json::from_str(&list).unwrap();
        assert_eq!(list["volumes"][0]["name"], "phantom", "{list}");
        assert_eq!(list["failing"][0]["name"], "a-first", "{list}");
        let cause = list["failing"][0]["cause"].as_str().unwrap();
        assert!(cause.contains("section"), "{cause}");
        assert!(!cause.contains(&archive), "{cause}");
        let (status, ..) = get("v/phantom/volume.json").await;
        assert_eq!(status, 200);
        for path in ["v/a-first/volume.json", "v/a-first/zarr/0/c/0/0/0/0"] {
            let (status, retry, text) = get(path).await;
            assert_eq!((status, retry), (503, true), "{text}");
            let refusal: Value = serde_json::from_str(&text).unwrap();
            assert_eq!(refusal["cause"], cause);
        }
        let (_, _, page) = get("volumes").await;
        assert!(
            page.contains("a-first</h2>\n<p>cannot be opened now"),
            "{page}"
        );

        // Once it is mended, it is there.
        spoil(place, "a-first", false).await;
        let until = SystemTime::now() + Duration::from_secs(30);
        while get("v/a-first/volume.json").await.0 != 200 {
            assert!(SystemTime::now() < until, "it is not tried again");
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        let (_, _, list) = get("volumes.json").await;
        assert!(!list.contains("failing"), "{list}");
    });
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
        !output.status.success() && said.contains("section"),
        "{said}"
    );
}
