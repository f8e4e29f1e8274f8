//! Bad input gets an error that names the thing and the way out.

mod acquisitions;
mod archives;
mod exports;
mod inputs;

use std::net::TcpListener;
use std::path::Path;
use std::process::Output;

use super::{archive, run, saccade, stderr};

/// Failed, in one report that holds all of `parts`.
pub(crate) fn assert_failed(output: &Output, code: i32, parts: &[&str]) {
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

pub(crate) fn text(path: &Path) -> &str {
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
            &[
                "no visualization archive (catalog.sqlite)",
                nowhere,
                "saccade ingest",
                "no image, neither OME-Zarr (zarr.json, .zattrs) nor precomputed (info)",
            ],
        ),
        (&["serve", nonsense], &["not a Saccade catalog", nonsense]),
        (
            &["render", empty, "-o", picture],
            &["no visualization archive", "no image", empty],
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
    let cases: [(&[&str], &[&str]); 24] = [
        (
            &["simulate", "a", "--input", "b", "--extent", "9,9,9"],
            &["--extent", "cannot be used with", "--input"],
        ),
        (
            &["demo", "--extent", "9,9,9", "--input", "b"],
            &["--extent", "cannot be used with", "--input"],
        ),
        (
            &["simulate", "a", "--phantom", "--name", "my volume"],
            &["my volume", "letters, digits"],
        ),
        (
            &["ingest", "a", "b", "--volume", "../b"],
            &["../b", "letters, digits"],
        ),
        (
            &["render", "a", "-o", "x.jpg"],
            &["x.jpg", "PNG only", "name it .png"],
        ),
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
            &["render", "a", "-o", "b", "--slice", "1,0@2,3,4"],
            &["1,0@2,3,4", "z=40"],
        ),
        (&["render", "a", "-o", "b", "--slab", "40"], &["--slice"]),
        (
            &["render", "a", "-o", "b", "--heat", "nodes=0"],
            &["nodes=0", "lookups"],
        ),
        (
            &["render", "a", "-o", "b", "--detail", "fine"],
            &["fine", "content"],
        ),
        (
            &["render", "a", "-o", "b", "--detail", "0:4-1"],
            &["0:4-1", "from the finest to the coarsest"],
        ),
        (
            &["view", "a", "--detail", "0:4-1"],
            &["0:4-1", "from the finest to the coarsest"],
        ),
        (&["view", "a", "--slab", "40"], &["--slice"]),
        (
            &["render", "a", "-o", "b", "--host-memory", "15"],
            &["15", "whole MiB from 16 on"],
        ),
        (
            &["view", "a", "--gpu-memory", "0"],
            &["whole MiB from 1 on"],
        ),
        (
            &["view", "a", "--false-colors", "levels"],
            &["levels", "none, residency or level"],
        ),
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

/// What a window is asked for is looked at before there is one.
#[test]
fn a_window_without_a_display() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let view = |more: &[&str]| run(["view", &archive].iter().chain(more));
    let transfer = r##"0:{"polarity": "dark", "color_map": "#ff8000", "window": [0.1, 0.8],
        "opacity_length_nm": 200, "opacity": [{"value": 0.3, "opacity": 0.9}]}"##;
    let all = [
        "--channels",
        "0",
        "--mode",
        "maximum",
        "--slice",
        "z=6",
        "--slab",
        "80",
        "--clip",
        "0,0,0,90,90,9",
        "--cut",
        "x=9",
        "--heat",
        "nodes",
        "--detail",
        "0:1-2",
        "--iso",
        "0.4",
        "--transfer",
        transfer,
        "--host-memory",
        "64",
        "--camera",
        "30,20,9000,1200,1000,240",
    ];
    assert_failed(&view(&all), 1, &["is there a display"]);
    for (more, parts) in [
        (&["--slice", "z=12"][..], &["z=12", "from 0 to 11"][..]),
        (&["--detail", "3:1-2"], &["there is no channel 3"]),
        (
            &["--transfer", "0:nowhere.json"],
            &["cannot read", "nowhere.json"],
        ),
        (
            &["--transfer", "0:{}"],
            &["no transfer function", "--transfer"],
        ),
        (&["--transfer", "0:"], &["--transfer names no file"]),
    ] {
        assert_failed(&view(more), 1, parts);
    }
    assert_failed(&view(&["--lod-bias", "nan"]), 2, &["number of levels"]);
}
