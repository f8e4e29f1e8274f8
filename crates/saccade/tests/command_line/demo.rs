//! Everything at once.

use std::process::Command;
use std::time::Duration;

use super::{Running, saccade, stderr};

const SMALL: [&str; 10] = [
    "demo",
    "--no-open",
    "--port",
    "0",
    "--extent",
    "150,130,6",
    "--tile",
    "64x64",
    "--rate",
    "max",
];

#[test]
fn the_demo_serves_what_it_simulates_and_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let (mut demo, url) = Running::start(saccade().args(SMALL).env("TMPDIR", folder.path()));
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let get = |path: &str| {
        let response = async { reqwest::get(format!("{url}{path}")).await?.text().await };
        runtime.block_on(response).unwrap()
    };
    assert!(get("volumes.json").contains("\"phantom\""));
    // 3 x 3 tiles in 6 sections; how long they take is not this test's business.
    while !get("v/phantom/status.json").contains("\"tiles\":54") {
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(std::fs::read_dir(folder.path()).unwrap().next().is_some());
    let id = demo.0.id().to_string();
    assert!(
        Command::new("kill")
            .args(["-TERM", &id])
            .status()
            .unwrap()
            .success()
    );
    assert!(
        demo.0.wait().unwrap().success(),
        "being told to end is no failure"
    );
    assert!(std::fs::read_dir(folder.path()).unwrap().next().is_none());
}

#[test]
fn a_kept_demo_can_be_served_later() {
    let folder = tempfile::tempdir().unwrap();
    let work = folder.path().join("work");
    let once = saccade()
        .args(SMALL)
        .args(["--once", "--work"])
        .arg(&work)
        .output()
        .unwrap();
    assert!(once.status.success(), "{}", stderr(&once));
    let mut serve = saccade();
    let (_server, url) = Running::start(
        serve
            .arg("serve")
            .arg(work.join("archive"))
            .args(["--port", "0"]),
    );
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let status = async {
        reqwest::get(format!("{url}v/phantom/status.json"))
            .await?
            .text()
            .await
    };
    assert!(runtime.block_on(status).unwrap().contains("\"tiles\":54"));
}
