//! Ingest that is asked to end.
#![cfg(unix)]

use std::process::{Command, Stdio};
use std::time::Duration;

use super::errors::text;
use super::kills::tree;
use super::update::ended;
use super::{done, saccade, simulate, stderr};

/// Who deletes raw images where it ends with 0 loses none.
#[test]
fn who_looks_once_says_that_something_may_be_left() {
    let folder = tempfile::tempdir().unwrap();
    let [acquisition, archive] = ["acquisition", "archive"].map(|name| folder.path().join(name));
    simulate(&acquisition, "400,360,24");
    let once = ["ingest", text(&acquisition), text(&archive), "--once"];
    let following = &once[..3];
    for (arguments, code) in [(&once[..], 130), (following, 0)] {
        let before = tree(&archive.join("tiles")).len();
        let mut command = saccade();
        command.args(arguments).stderr(Stdio::piped());
        let ingest = command.spawn().unwrap();
        let came = (0..6000).any(|_| {
            std::thread::sleep(Duration::from_millis(5));
            tree(&archive.join("tiles")).len() > before
        });
        assert!(came, "nothing is taken in");
        let id = ingest.id().to_string();
        assert!(
            Command::new("kill")
                .args(["-TERM", &id])
                .status()
                .unwrap()
                .success()
        );
        let output = ingest.wait_with_output().unwrap();
        ended(&output, code, &["tiles taken in"]);
        let said = stderr(&output);
        assert_eq!(
            said.contains("the same command takes in what is left"),
            code == 130,
            "{said}"
        );
        let check = ["check", text(&archive), "--acquisition", text(&acquisition)];
        let checked = stderr(&done(check));
        assert!(checked.contains("all whole"), "{checked}");
    }
    let output = done(once);
    let said = stderr(&output);
    assert!(
        !said.contains(" 0 tiles taken in") && !said.starts_with("0 tiles"),
        "nothing was left: {said}"
    );
    ended(&done(once), 0, &["0 tiles taken in"]);
}
