//! Bad input gets an error that names the thing and the way out.

use std::net::TcpListener;
use std::path::Path;
use std::process::Output;

use super::{archive, run, saccade, simulate, stderr};

/// Failed, in one report that holds all of `parts`.
fn assert_failed(output: &Output, code: i32, parts: &[&str]) {
    let text = stderr(output);
    assert_eq!(output.status.code(), Some(code), "{text}");
    assert_eq!(text.matches("error: ").count(), 1, "{text}");
    assert!(!text.contains("panicked"), "{text}");
    for part in parts {
        assert!(text.contains(part), "{part:?} is not in: {text}");
    }
    let mut lines: Vec<&str> = text
        .lines()
        .filter(|line| !line.trim().is_empty())
        .collect();
    let all = lines.len();
    lines.sort_unstable();
    lines.dedup();
    assert_eq!(lines.len(), all, "something is said twice: {text}");
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn folders_that_are_not_what_they_should_be() {
    let folder = tempfile::tempdir().unwrap();
    let empty = text(folder.path());
    let nowhere = &format!("{empty}/nowhere");
    let out = &format!("{empty}/out");
    let picture = &format!("{empty}/picture.png");
    let nonsense = folder.path().join("nonsense");
    std::fs::create_dir(&nonsense).unwrap();
    std::fs::write(nonsense.join("volume.json"), "{\"name\": 3}").unwrap();
    std::fs::write(
        nonsense.join("catalog.sqlite"),
        "no database, but long enough to be one",
    )
    .unwrap();
    let nonsense = text(&nonsense);
    let cases: [(&[&str], &[&str]); 10] = [
        (
            &["ingest", nowhere, out],
            &["cannot read", nowhere, "check that it exists"],
        ),
        (
            &["ingest", empty, out],
            &["no acquisition archive", empty, "saccade simulate"],
        ),
        (
            &["ingest", nonsense, out],
            &["volume.json", "extent", "because"],
        ),
        (
            &["serve", nowhere],
            &["no visualization archive", nowhere, "saccade ingest"],
        ),
        (&["serve", nonsense], &["not a Saccade catalog", nonsense]),
        (
            &["render", empty, "-o", picture],
            &["no visualization archive", empty],
        ),
        (&["view", empty], &["no visualization archive", empty]),
        (
            &["simulate", out, "--input", nowhere],
            &[nowhere, "check that it exists"],
        ),
        (
            &["demo", "--port", "0", "--input", empty],
            &[empty, "neither"],
        ),
        (
            &["demo", "--port", "0", "--input", nowhere],
            &[nowhere, "check that it exists"],
        ),
    ];
    for (arguments, parts) in cases {
        assert_failed(&run(arguments), 1, parts);
        assert!(
            !Path::new(out).exists(),
            "{arguments:?} left something behind"
        );
    }
}

#[test]
fn a_volume_of_another_size() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let other = folder.path().join("other");
    simulate(&other, "150,131,12");
    let output = run(["ingest", text(&other), &archive, "--once"]);
    assert_failed(&output, 1, &["wrong extent", "130", "131", "another name"]);

    let again = ["simulate", text(&other), "--phantom", "--extent", "99,99,9"];
    assert_failed(
        &run(again),
        1,
        &["another acquisition", "empty folder", text(&other)],
    );
}

#[test]
fn volumes_that_are_not_there() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let picture = folder.path().join("picture.png");
    let render = |place: &str, more: &[&str]| {
        let fixed = ["render", place, "-o", text(&picture)];
        run(fixed.iter().chain(more))
    };
    let unknown = render(&archive, &["--volume", "mitochondria"]);
    assert_failed(
        &unknown,
        1,
        &["mitochondria", "the volumes are: phantom", &archive],
    );
    let nobody = render("http://127.0.0.1:9", &[]);
    assert_failed(&nobody, 1, &["http://127.0.0.1:9", "is the server running"]);
    let odd = render(&archive, &["--transfer", "{\"window\": 3}"]);
    assert_failed(&odd, 1, &["no transfer function", "--transfer"]);
    let missing = render(&archive, &["--transfer", "nowhere.json"]);
    assert_failed(
        &missing,
        1,
        &["cannot read the transfer function", "nowhere.json"],
    );
    assert!(!picture.exists());
}

#[test]
fn a_port_in_use() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    for arguments in [vec!["serve", &archive], vec!["demo", "--no-open"]] {
        let output = run(arguments.into_iter().chain(["--port", &port]));
        assert_failed(&output, 1, &[&port, "in use", "--port 0"]);
    }
}

#[test]
fn no_gpu() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let picture = folder.path().join("picture.png");
    let output = saccade()
        .args(["render", &archive, "-o", text(&picture)])
        .env("VK_ICD_FILENAMES", "/nonexistent")
        .env("VK_DRIVER_FILES", "/nonexistent")
        .env("WGPU_BACKEND", "vulkan")
        .output()
        .unwrap();
    assert_failed(&output, 1, &["no GPU adapter", "install"]);
    assert!(!picture.exists());
}

#[test]
fn words_that_make_no_sense() {
    let cases: [(&[&str], &[&str]); 9] = [
        (
            &["render", "a", "-o", "b", "--camera", "here"],
            &["here", "yaw,pitch,distance"],
        ),
        (
            &["render", "a", "-o", "b", "--camera", "0,95,1,0,0,0"],
            &["0,95,1,0,0,0"],
        ),
        (&["render", "a", "-o", "b", "--size", "12"], &["12", "WxH"]),
        (
            &["render", "a", "-o", "b", "--background", "red"],
            &["red", "#rrggbb"],
        ),
        (&["render", "a"], &["--output"]),
        (&["simulate", "a"], &["--phantom", "--input"]),
        (
            &["simulate", "a", "--phantom", "--extent", "5,0,5"],
            &["5,0,5", "at least one voxel"],
        ),
        (&["ingest", "a", "b", "--quality", "101"], &["101"]),
        (
            &["ingest", "a", "b", "--quality", "50", "--lossless"],
            &["--lossless"],
        ),
    ];
    for (arguments, parts) in cases {
        assert_failed(&run(arguments), 2, parts);
    }
    let settings = ["simulate", "a", "--phantom", "--overlap", "0.9"];
    let folder = tempfile::tempdir().unwrap();
    let output = saccade()
        .args(settings)
        .current_dir(folder.path())
        .output()
        .unwrap();
    assert_failed(&output, 1, &["the overlap is 0.9", "between"]);
}

#[test]
fn bad_tiles_are_set_aside_and_told() {
    let folder = tempfile::tempdir().unwrap();
    let acquisition = folder.path().join("acquisition");
    simulate(&acquisition, "100,90,3");
    let deep: image::ImageBuffer<image::Luma<u16>, Vec<u16>> = image::ImageBuffer::new(20, 20);
    deep.save(acquisition.join("tiles/deep.png")).unwrap();
    let flat = image::GrayImage::from_pixel(20, 20, image::Luma([90]));
    flat.save(acquisition.join("tiles/far.png")).unwrap();
    std::fs::write(acquisition.join("tiles/torn.png"), "no image at all").unwrap();
    let record = |name: &str, x: u32| {
        format!(
            "{{\"record\":\"tile\",\"tile\":\"{name}\",\"file\":\"tiles/{name}.png\",\"section\":1,\
             \"size\":[20,20],\"transform\":[1,0,0,1,{x},0]}}\n"
        )
    };
    let records = acquisition.join("tiles.jsonl");
    let mut lines = std::fs::read_to_string(&records).unwrap();
    lines.extend([record("deep", 0), record("far", 5000), record("torn", 0)]);
    std::fs::write(&records, lines).unwrap();

    let archive = folder.path().join("archive");
    let output = run(["ingest", text(&acquisition), text(&archive), "--once"]);
    let said = stderr(&output);
    assert!(output.status.success(), "{said}");
    let summary = said.lines().last().unwrap();
    assert!(
        summary.contains("12 tiles taken in") && summary.contains("3 set aside"),
        "{said}"
    );
    for part in ["deep.png", "16", "far", "outside the volume", "torn.png"] {
        assert!(said.contains(part), "{part:?} is not in: {said}");
    }
}
