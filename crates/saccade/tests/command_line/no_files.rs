//! Named pipes where files should be.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use super::errors::text;
use super::update::ended;
use super::{archive, done, saccade, stderr};

/// Runs it, unless it never ends.
fn run(arguments: &[&str]) -> Output {
    let mut command = saccade();
    command
        .args(arguments)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let mut looks = 0;
    while child.try_wait().unwrap().is_none() {
        looks += 1;
        if looks > 2000 {
            child.kill().unwrap();
            panic!("{arguments:?} does not end");
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    child.wait_with_output().unwrap()
}

fn pyramid(archive: &str) -> PathBuf {
    let section = Path::new(archive).join("tiles/phantom/000003");
    let mut files: Vec<_> = { fs::read_dir(section).unwrap() }
        .map(|file| file.unwrap().path())
        .collect();
    files.sort();
    files.swap_remove(1)
}

fn put_a_pipe(at: &Path) {
    fs::remove_file(at).unwrap();
    let made = Command::new("mkfifo").arg(at).status();
    assert!(made.unwrap().success());
}

#[cfg(unix)]
#[test]
fn a_pipe_in_the_place_of_a_pyramid_is_damage_and_mended() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let acquisition = folder.path().join("acquisition");
    let pyramid = pyramid(&archive);
    put_a_pipe(&pyramid);
    for quick in [&["--quick"][..], &[]] {
        let checked = run(&[&["check", &archive], quick].concat());
        ended(&checked, 3, &["1 damaged"]);
        let told = String::from_utf8(checked.stdout).unwrap();
        assert!(
            told.contains("a named pipe")
                && told.contains(text(pyramid.strip_prefix(&archive).unwrap())),
            "{told}"
        );
    }
    let out = folder.path().join("out.zarr");
    ended(
        &run(&["export", &archive, text(&out)]),
        1,
        &["a named pipe"],
    );
    let records = ["--acquisition", text(&acquisition)];
    let repaired = run(&[&["check", &archive, "--repair"][..], &records].concat());
    ended(&repaired, 0, &["1 damaged"]);
    done([
        "ingest",
        text(&acquisition),
        &archive,
        "--once",
        "--lossless",
    ]);
    let whole = stderr(&done(["check", &archive]));
    assert!(whole.contains("all whole"), "{whole}");

    // Nor are records read of one.
    put_a_pipe(&acquisition.join("tiles.jsonl"));
    let without = run(&[&["check", &archive][..], &records].concat());
    ended(&without, 0, &["all whole"]);

    // One that nobody writes to says nothing of what is to be taken in, either.
    put_a_pipe(&acquisition.join("volume.json"));
    let other = folder.path().join("other");
    let refused = run(&["ingest", text(&acquisition), text(&other)]);
    ended(&refused, 1, &["no regular file", "volume.json"]);
    let catalog = Path::new(&archive).join("catalog.sqlite");
    put_a_pipe(&catalog);
    ended(&run(&["check", &archive]), 1, &["catalog.sqlite"]);
}
