//! Named pipes and links to nothing where files should be.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use super::errors::text;
use super::server_away::{Program, says};
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

    // Nor are records read of one: there is nothing to compare with.
    put_a_pipe(&acquisition.join("tiles.jsonl"));
    let without = run(&[&["check", &archive][..], &records].concat());
    ended(&without, 1, &["no records (tiles.jsonl)"]);

    // One that nobody writes to says nothing of what is to be taken in, either.
    put_a_pipe(&acquisition.join("volume.json"));
    let other = folder.path().join("other");
    let refused = run(&["ingest", text(&acquisition), text(&other)]);
    ended(&refused, 1, &["no regular file", "volume.json"]);
    let catalog = Path::new(&archive).join("catalog.sqlite");
    put_a_pipe(&catalog);
    ended(&run(&["check", &archive]), 1, &["catalog.sqlite"]);
}

/// It is told once, with what to do, and what comes in its place is taken in.
#[cfg(unix)]
#[test]
fn a_pipe_in_the_place_of_a_folder_of_images_is_told_once() {
    let folder = tempfile::tempdir().unwrap();
    let [scope, archive, new] = ["scope", "archive", "new"].map(|name| folder.path().join(name));
    let picture = |folder: &Path| {
        fs::create_dir_all(folder).unwrap();
        let grey = image::GrayImage::from_pixel(40, 30, image::Luma([9]));
        grey.save(folder.join("r0_c0.png")).unwrap();
    };
    picture(&scope.join("s0"));
    let second = scope.join("s1");
    fs::write(&second, "").unwrap();
    put_a_pipe(&second);
    let of_names = [
        "--pattern",
        "s{section}/r{row}_c{column}.png",
        "--extent",
        "99,99,9",
    ];
    let sized = ["--voxel", "4", "--pitch", "40,30"];
    let ingest = ["ingest", text(&scope), text(&archive)];
    let ingest = [&ingest[..], &of_names, &sized].concat();
    let once = run(&[&ingest[..], &["--once"]].concat());
    ended(
        &once,
        3,
        &["1 tiles taken in", "a named pipe", text(&second)],
    );
    let following = Program::start_with(&ingest, &[]);
    let said = says(&following.stderr, "a named pipe");
    assert!(
        said.contains("put the folder itself there") && said.contains(text(&second)),
        "{said}"
    );
    std::thread::sleep(Duration::from_secs(2));
    picture(&new);
    fs::remove_file(&second).unwrap();
    fs::rename(&new, &second).unwrap();
    let mut before: Vec<String> = Vec::new();
    while let Ok(line) = following.stderr.recv_timeout(Duration::from_secs(60)) {
        if line.contains("1 of 1 tiles") {
            assert!(!before.concat().contains("pipe"), "{before:#?}");
            return;
        }
        before.push(line);
    }
    panic!("the folder is not taken in: {before:#?}");
}

/// It is told once and not waited for, and the other images are taken in.
#[cfg(unix)]
#[test]
fn a_link_to_nothing_in_the_place_of_an_image_is_told_once() {
    let folder = tempfile::tempdir().unwrap();
    let [scope, archive] = ["scope", "archive"].map(|name| folder.path().join(name));
    fs::create_dir_all(scope.join("s0")).unwrap();
    let picture = |name: &str| {
        let grey = image::GrayImage::from_pixel(40, 30, image::Luma([9]));
        grey.save(scope.join("s0").join(name)).unwrap();
    };
    picture("r0_c0.png");
    let link = scope.join("s0/r0_c1.png");
    std::os::unix::fs::symlink("nowhere.png", &link).unwrap();
    let of_names = ["--pattern", "s{section}/r{row}_c{column}.png"];
    let sized = ["--extent", "99,99,1", "--voxel", "4", "--pitch", "40,30"];
    let ingest = ["ingest", text(&scope), text(&archive), "--once"];
    let ingest = [&ingest[..], &of_names, &sized].concat();
    let once = run(&ingest);
    ended(&once, 3, &["1 tiles taken in", text(&link)]);
    let said = stderr(&once);
    assert_eq!(said.matches("a link to nothing").count(), 1, "{said}");
    picture("nowhere.png");
    ended(&run(&ingest), 0, &["1 tiles taken in"]);
}
