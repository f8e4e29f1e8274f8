//! Acquisitions that cannot be taken in, or not into what is there.

use super::inputs::sections;
use super::{assert_failed, text};
use crate::{Running, archive, done, run, saccade, simulate, stderr};

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
        &[
            "another acquisition",
            "extent is 150 x 131 x 12 there, 99 x 99 x 9 now",
            "tile is 64 x 64 there, 1024 x 1024 now",
            "empty folder",
            text(&other),
        ],
    );
}

#[test]
fn bare_folders_whose_names_or_options_do_not_fit() {
    let folder = tempfile::tempdir().unwrap();
    let scope = folder.path().join("scope");
    sections(&scope);
    let archive = folder.path().join("archive");
    let ingest = |pattern: &str, pitch: &str, more: &[&str]| {
        let words = [
            "ingest",
            text(&scope),
            text(&archive),
            "--once",
            "--pattern",
            pattern,
        ];
        let size = ["--extent", "70,60,3", "--voxel", "4,4,40", "--pitch", pitch];
        run(words.iter().chain(&size).chain(more))
    };
    let unfit = ingest("s{section}_r{row}.png", "70,60", &[]);
    assert_failed(
        &unfit,
        1,
        &[
            "no file fits the pattern s{section}_r{row}.png",
            "3 files and 0 folders",
            "comes \".png\" where \"_r\" should be",
        ],
    );
    let twice = ingest("s{section}.png", "70,60", &["--channels", "SE,SE"]);
    assert_failed(&twice, 1, &["two channels", "\"SE\"", "--channels"]);
    // What took nothing in does not bind.
    let fits = |pitch: &str| ingest("s{section}.png", pitch, &[]);
    let done = fits("70,60");
    assert!(done.status.success(), "{}", stderr(&done));
    assert!(
        stderr(&done).contains("3 tiles taken in"),
        "{}",
        stderr(&done)
    );
    assert_failed(
        &fits("70,61"),
        1,
        &[
            "pitch is 70.0 x 60.0 there, 70.0 x 61.0 now",
            "same options",
            "--volume NAME",
        ],
    );
    // A stack has other ways in.
    let plain = run(["ingest", text(&scope), text(&archive)]);
    assert_failed(
        &plain,
        1,
        &[
            "--pattern",
            "saccade simulate ACQUISITION --input FOLDER",
            "saccade demo",
        ],
    );
}

/// Of the same name and size, but not the one that was taken in.
#[test]
fn a_second_acquisition_in_the_same_archive() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let other = folder.path().join("other");
    simulate(&other, "150,130,12");
    let records = other.join("tiles.jsonl");
    let text_of = std::fs::read_to_string(&records).unwrap();
    let line = text_of.lines().last().unwrap();
    std::fs::write(
        &records,
        text_of.replace("\"tile\":\"", "\"tile\":\"other-") + line + "\n",
    )
    .unwrap();
    let ingest = ["ingest", text(&other), &archive, "--once"];
    let output = run(ingest);
    assert_failed(
        &output,
        1,
        &["another acquisition", "--volume NAME", text(&records)],
    );
    done(ingest.iter().chain(&["--volume", "second"]));
}

#[test]
fn descriptions_of_impossible_volumes() {
    let folder = tempfile::tempdir().unwrap();
    let acquisition = folder.path().join("acquisition");
    std::fs::create_dir(&acquisition).unwrap();
    let out = folder.path().join("archive");
    let cases: [(&str, &[&str]); 3] = [
        (
            r#"{"name":"v","extent":[50,0,9],"voxel_nm":[4,4,40]}"#,
            &["[50, 0, 9]", "every axis needs at least 1 voxel"],
        ),
        (
            r#"{"name":"a volume","extent":[50,40,9],"voxel_nm":[4,4,40]}"#,
            &["\"a volume\" cannot name a volume", "letters, digits"],
        ),
        (
            r#"{"name":"v","size":[0,0],"voxel_nm":[4,4,40]}"#,
            &["extent"],
        ),
    ];
    for (info, parts) in cases {
        std::fs::write(acquisition.join("volume.json"), info).unwrap();
        let output = run(["ingest", text(&acquisition), text(&out), "--once"]);
        assert_failed(&output, 1, &[&["volume.json"], parts].concat());
    }
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
    let red = image::RgbImage::from_pixel(20, 20, image::Rgb([190, 20, 30]));
    red.save(acquisition.join("tiles/red.png")).unwrap();
    let record = |name: &str, x: u32| {
        format!(
            "{{\"record\":\"tile\",\"tile\":\"{name}\",\"file\":\"tiles/{name}.png\",\"section\":1,\
             \"size\":[20,20],\"transform\":[1,0,0,1,{x},0]}}\n"
        )
    };
    let records = acquisition.join("tiles.jsonl");
    let mut lines = std::fs::read_to_string(&records).unwrap();
    lines.extend(["deep", "torn", "red"].map(|name| record(name, 0)));
    lines.push_str(&record("far", 5000));
    lines.push_str("{\"record\":\"transform\",\"tile\":\"never\",\"transform\":[1,0,0,1,0,0]}\n");
    std::fs::write(&records, lines).unwrap();

    let archive = folder.path().join("archive");
    let output = run(["ingest", text(&acquisition), text(&archive), "--once"]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(3), "{said}");
    let left = said.lines().rev().nth(1).unwrap();
    assert!(
        left.starts_with("set aside, ")
            && left.contains("status.json")
            && left.contains("(tile ")
            && left.ends_with("; and 1 more"),
        "{said}"
    );
    let summary = said.lines().last().unwrap();
    assert!(
        summary.contains("12 tiles taken in")
            && summary.contains("4 set aside")
            && summary.contains("1 transforms of tiles that have not come"),
        "{said}"
    );
    for part in [
        "deep.png",
        "16",
        "far",
        "outside the volume",
        "torn.png",
        "in colour",
    ] {
        assert!(said.contains(part), "{part:?} is not in: {said}");
    }

    // What is done is done, and images that are set aside are still not in the volume.
    let again = run(["ingest", text(&acquisition), text(&archive), "--once"]);
    let said = stderr(&again);
    assert_eq!(again.status.code(), Some(3), "{said}");
    for part in [
        "set aside before",
        "; and 1 more",
        "0 tiles taken in",
        "0 set aside",
    ] {
        assert!(said.contains(part), "{part:?} is not in: {said}");
    }
    // Three of the four by name; which depends on which worker was first.
    let named = ["deep", "torn", "red", "far"].map(|name| {
        let named = format!("tiles/{name}.png (tile {name})");
        said.matches(&named).count()
    });
    assert_eq!(named.iter().sum::<usize>(), 3, "{said}");
    assert!(named.iter().all(|count| *count <= 1), "{said}");
    let checked = stderr(&done(["check", text(&archive)]));
    assert!(checked.contains("all whole, 4 set aside"), "{checked}");
    let (_server, url) = Running::start(saccade().args(["serve", text(&archive), "--port", "0"]));
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let get = async {
        let status = reqwest::get(format!("{url}v/phantom/status.json")).await?;
        status.json::<serde_json::Value>().await
    };
    let status = runtime.block_on(get).unwrap();
    assert_eq!(status["early_transforms"], 1);
    let mut named: Vec<_> = status["quarantined"]
        .as_array()
        .unwrap()
        .iter()
        .map(|q| q["tile"].as_str().unwrap())
        .collect();
    named.sort_unstable();
    assert_eq!(named, ["deep", "far", "red", "torn"]);
}
