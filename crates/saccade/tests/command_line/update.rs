//! Registration and deletions by others than the microscope.

use std::io::Write as _;
use std::path::Path;
use std::process::{Output, Stdio};
use std::time::Duration;

use serde_json::{Value, json};

use super::errors::{assert_failed, text};
use super::{Running, archive, run, saccade, stderr};

/// What did part of its work ended so, and said this.
pub(super) fn ended(output: &Output, code: i32, parts: &[&str]) {
    let said = stderr(output);
    assert_eq!(output.status.code(), Some(code), "{said}");
    for part in parts {
        assert!(said.contains(part), "{part:?} is not in: {said}");
    }
}

/// Names of the tiles that an acquisition told of.
fn tiles(folder: &Path) -> Vec<String> {
    let records = std::fs::read_to_string(folder.join("acquisition/tiles.jsonl")).unwrap();
    let records = records
        .lines()
        .map(|line| serde_json::from_str(line).unwrap());
    let of_tiles = records.filter(|record: &Value| record["record"] == "tile");
    of_tiles
        .map(|record| record["tile"].as_str().unwrap().to_owned())
        .collect()
}

fn moved(tile: &str) -> String {
    json!({ "record": "transform", "tile": tile, "transform": [1, 0, 0, 1, 40, 30] }).to_string()
}

fn deleted(tile: &str) -> String {
    json!({ "record": "delete", "tile": tile }).to_string()
}

#[test]
fn open_views_see_what_moved_and_what_is_gone() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let names = tiles(folder.path());
    let (_server, url) = Running::start(saccade().args(["serve", &archive, "--port", "0"]));
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    let runtime = runtime.unwrap();
    let get = |path: &str| {
        let answer = async {
            reqwest::get(format!("{url}v/phantom/{path}"))
                .await?
                .bytes()
                .await
        };
        runtime.block_on(answer).unwrap()
    };
    let status = || serde_json::from_slice::<Value>(&get("status.json")).unwrap();
    let (before, picture) = (status(), get("thumbnail.png"));
    let mut events = runtime
        .block_on(reqwest::get(format!("{url}v/phantom/events")))
        .unwrap();

    let changes = folder.path().join("moves.jsonl");
    let lines: Vec<_> = names[1..].iter().map(|name| moved(name)).collect();
    std::fs::write(
        &changes,
        format!("{}\n{}", deleted(&names[0]), lines.join("\n")),
    )
    .unwrap();
    let update = ["update", &archive, text(&changes)];
    let output = run(update);
    assert!(output.status.success(), "{}", stderr(&output));
    let all = names.len() - 1;
    let said = stderr(&output);
    assert!(
        said.contains(&format!("{all} moved, 0 unchanged, 1 deleted")),
        "{said}"
    );

    let heard = async {
        let mut heard = String::new();
        while !heard.contains("event: change") {
            let chunk = events.chunk().await.unwrap().expect("the events go on");
            heard.push_str(&String::from_utf8_lossy(&chunk));
        }
        heard
    };
    let heard = async { tokio::time::timeout(Duration::from_secs(20), heard).await };
    runtime.block_on(heard).expect("a change is told");
    let after = status();
    assert!(
        after["revision"].as_u64() > before["revision"].as_u64(),
        "{after}"
    );
    assert_eq!(after["tiles"], all, "{after}");
    let shows = (0..200).any(|_| {
        std::thread::sleep(Duration::from_millis(50));
        get("thumbnail.png") != picture
    });
    assert!(shows, "the picture stays as it was");

    // Again, there is nothing to do: the one that is gone is deleted already.
    let again = run(update);
    let now = all + 1;
    ended(&again, 0, &[&format!("0 moved, {now} unchanged")]);
    // One that moves what is gone is told.
    std::fs::write(&changes, moved(&names[0])).unwrap();
    ended(&run(update), 3, &["line 1: ", &*names[0]]);
}

#[test]
fn lines_that_cannot_be_applied_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let names = tiles(folder.path());
    let changes = folder.path().join("moves.jsonl");
    // What makes no sense, after what does.
    std::fs::write(
        &changes,
        format!("{}\n\n{{\"record\": \"move\"}}\n", moved(&names[0])),
    )
    .unwrap();
    let wrong = run(["update", &archive, text(&changes)]);
    assert_failed(
        &wrong,
        1,
        &[text(&changes), "line 3", "nothing was changed"],
    );
    let gone = run(["update", &archive, "no-such-file"]);
    assert_failed(&gone, 1, &["no-such-file", "check that it exists"]);
    let other = run(["update", &archive, text(&changes), "--volume", "other"]);
    assert_failed(&other, 1, &["line 3"]);

    // From standard input; what was wrong has changed nothing.
    let mut update = saccade();
    update.args(["update", &archive, "-", "--volume", "phantom"]);
    let mut update = { update.stdin(Stdio::piped()).stderr(Stdio::piped()) }
        .spawn()
        .unwrap();
    let outside = moved(&names[1]).replace("40", "9999");
    let lines = [moved(&names[0]), moved("typo"), outside].join("\n");
    let mut stdin = update.stdin.take().unwrap();
    stdin.write_all(lines.as_bytes()).unwrap();
    drop(stdin);
    let output = update.wait_with_output().unwrap();
    let said = [
        "1 moved, 0 unchanged, 1 unknown, 1 refused",
        "line 2",
        "typo",
        "line 3",
        "outside",
    ];
    ended(&output, 3, &said);
    let unknown = run(["update", &archive, "/dev/null", "--volume", "other"]);
    assert_failed(&unknown, 1, &["other", "phantom"]);
}
