//! Bad input gets an error that names the thing and the way out.

use std::net::TcpListener;
use std::path::Path;
use std::process::Output;

use super::{Running, archive, done, run, saccade, simulate, stderr};

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

/// What is there goes on only with the options that made it.
#[test]
fn demos_and_simulations_of_other_options_do_not_go_on() {
    let folder = tempfile::tempdir().unwrap();
    let work = folder.path().join("work");
    simulate(&work.join("acquisition"), "100,90,3");
    let demo = |more: &[&str]| {
        let fixed = [
            "demo",
            "--no-open",
            "--once",
            "--port",
            "0",
            "--rate",
            "max",
            "--voxel-nm",
            "16,16,40",
            "--work",
        ];
        run(fixed
            .iter()
            .copied()
            .chain([text(&work)])
            .chain(more.iter().copied()))
    };
    let size = ["--extent", "100,90,3", "--tile", "64x64"];
    let other = demo(&[&size[..], &["--seed", "5", "--overlap", "0.2"]].concat());
    assert_failed(
        &other,
        1,
        &["overlap is 0.1 there, 0.2 now", "seed is 1 there, 5 now"],
    );
    assert!(other.stdout.is_empty(), "nothing is offered");
    assert!(!work.join("archive").exists());
    let same = demo(&size);
    assert!(same.status.success(), "{}", stderr(&same));

    std::fs::remove_file(work.join("acquisition/simulation.json")).unwrap();
    assert_failed(&demo(&size), 1, &["not simulated", "empty folder"]);
}

/// A folder of sections below others, as data sets are often given away.
fn sections(folder: &Path) {
    std::fs::create_dir_all(folder).unwrap();
    for n in 0..3_u8 {
        let image = image::GrayImage::from_fn(70, 60, |x, y| {
            image::Luma([u8::try_from((x * 3 + y) % 200).unwrap() + n])
        });
        image.save(folder.join(format!("s{n}.png"))).unwrap();
    }
}

#[test]
fn inputs_keep_their_name_and_tell_what_is_assumed() {
    let folder = tempfile::tempdir().unwrap();
    let input = folder.path().join("cortex 7");
    sections(&input.join("deep/grayscale_maps"));
    let out = folder.path().join("out");
    let base = [
        "simulate",
        text(&out),
        "--input",
        text(&input),
        "--rate",
        "max",
    ];
    let base = base.iter().copied().chain(["--tile", "48x48"]);
    let output = run(base.clone());
    let said = stderr(&output);
    assert!(output.status.success(), "{said}");
    let assumed = "voxel size assumed: 4 x 4 x 40 nm; --voxel-nm sets it";
    assert_eq!(
        said.lines().filter(|line| *line == assumed).count(),
        1,
        "{said}"
    );
    assert!(said.contains("simulate: 12 of 12 tiles, "), "{said}");
    let info = std::fs::read_to_string(out.join("volume.json")).unwrap();
    assert!(info.contains("\"cortex-7\""), "{info}");

    // Other tissue of the same size does not go on there.
    let first = input.join("deep/grayscale_maps/s0.png");
    std::fs::copy(input.join("deep/grayscale_maps/s2.png"), first).unwrap();
    assert_failed(&run(base), 1, &["another acquisition", "input is stack"]);
    let told = ["--voxel-nm", "5", "--tile", "48x48", "--rate", "max"];
    let out = folder.path().join("out2");
    let output = run(["simulate", text(&out), "--input", text(&input)]
        .iter()
        .chain(&told));
    assert!(!stderr(&output).contains("assumed"), "{}", stderr(&output));
}

#[test]
fn a_replay_refuses_what_is_for_tissue() {
    let folder = tempfile::tempdir().unwrap();
    let input = folder.path().join("real");
    sections(&input);
    let list = "s0.png 0 0 0\ns1.png 60 0 0\ns2.png 0 0 1\n";
    std::fs::write(input.join("positions.txt"), list).unwrap();
    let out = folder.path().join("out");
    let base = [
        "simulate",
        text(&out),
        "--input",
        text(&input),
        "--rate",
        "max",
    ];
    let with = |more: &[&'static str]| run(base.iter().copied().chain(more.iter().copied()));
    let refused = with(&["--tile", "64x64", "--jitter", "3", "--shuffle"]);
    assert_failed(
        &refused,
        1,
        &["--tile, --jitter, --shuffle", "replayed as it is"],
    );
    assert!(!out.exists());
    let replayed = with(&[]);
    assert!(replayed.status.success(), "{}", stderr(&replayed));
    assert!(stderr(&replayed).contains("voxel size assumed: 73 x 73 x 200 nm"));

    // Another list into the same folder.
    std::fs::write(input.join("positions.txt"), list.replace("60 0", "50 0")).unwrap();
    assert_failed(
        &with(&[]),
        1,
        &["another acquisition", "extent is 130 x 60 x 2 there"],
    );
    std::fs::write(
        input.join("positions.txt"),
        list.replace("s2.png 0", "s2.png 9"),
    )
    .unwrap();
    assert_failed(
        &with(&[]),
        1,
        &["another acquisition", "input is acquisition"],
    );
}

#[test]
fn a_volume_without_tiles() {
    let folder = tempfile::tempdir().unwrap();
    let acquisition = folder.path().join("acquisition");
    std::fs::create_dir(&acquisition).unwrap();
    let info = r#"{"name":"later","extent":[50,40,9],"voxel_nm":[4,4,40]}"#;
    std::fs::write(acquisition.join("volume.json"), info).unwrap();
    let archive = folder.path().join("archive");
    let ingested = run(["ingest", text(&acquisition), text(&archive), "--once"]);
    assert!(ingested.status.success(), "{}", stderr(&ingested));
    let picture = folder.path().join("picture.png");
    let output = run([
        "render",
        text(&archive),
        "-o",
        text(&picture),
        "--size",
        "16x16",
    ]);
    let required = std::env::var("SACCADE_GPU_TESTS").is_ok_and(|v| v == "require");
    if !required && stderr(&output).contains("no GPU adapter") {
        return;
    }
    assert!(output.status.success(), "{}", stderr(&output));
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        said.contains("nothing was acquired yet") && !said.contains("complete"),
        "{said}"
    );
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

/// A catalog and the pyramids of another archive; a cache on disk where other things are.
#[test]
fn what_does_not_belong_together() {
    let folder = tempfile::tempdir().unwrap();
    let (one, other) = (folder.path().join("one"), folder.path().join("other"));
    let (one, other) = (archive(&one), archive(&other));
    let catalog = format!("{one}/catalog.sqlite");
    let acquisition = folder.path().join("one/acquisition");
    let strangers = ["not of one archive", &catalog, &other];
    for arguments in [
        &["serve", &other, "--port", "0"][..],
        &["render", &other, "-o", "never.png"],
        &["ingest", text(&acquisition), &other, "--once"],
        &["check", &other],
    ] {
        let output = run(arguments.iter().chain(&["--catalog", &catalog]));
        assert_failed(&output, 1, &strangers);
    }

    let thesis = folder.path().join("thesis");
    std::fs::create_dir(&thesis).unwrap();
    std::fs::write(thesis.join("thesis.tex"), "chapter 1").unwrap();
    let within = format!("{one}/cache");
    let caches: [(&str, &[&str]); 4] = [
        (text(&thesis), &["other things", "thesis"]),
        (&within, &["neither in the archive's folder", "cache"]),
        (text(folder.path()), &["neither in the archive's folder"]),
        (&one, &["neither in the archive's folder"]),
    ];
    for (cache, parts) in caches {
        let output = run(["serve", &one, "--port", "0", "--disk-cache", cache]);
        assert_failed(&output, 1, parts);
    }
    assert_eq!(std::fs::read_dir(&thesis).unwrap().count(), 1);
    assert!(!Path::new(&within).exists());
    for (size, part) in [
        ("0", "at least"),
        ("1.5 potatoes", "MB, GB or TB"),
        ("1.2.3", "1.5"),
    ] {
        let sized = ["serve", "a", "--disk-cache", "b", "--disk-cache-size", size];
        assert_failed(&run(sized), 2, &[part]);
    }
}

/// Pyramids whose catalog is another, or was lost.
#[test]
fn pyramids_of_which_the_catalog_knows_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let one = archive(folder.path());
    let acquisition = folder.path().join("acquisition");
    let ingest = ["ingest", text(&acquisition), &one, "--once"];
    let own = Path::new(&one).join("catalog.sqlite");
    let copy = folder.path().join("copy");
    std::fs::copy(&own, &copy).unwrap();
    let pyramids = || {
        let listed = std::fs::read_dir(Path::new(&one).join("tiles")).unwrap();
        listed.count()
    };
    let before = pyramids();

    let fresh = folder.path().join("fresh.sqlite");
    let output = run(ingest
        .iter()
        .chain(&["--catalog", text(&fresh), "--volume", "second"]));
    let way_out = [
        "another catalog's",
        "Name that one",
        "put a copy of it back",
        "ingest",
        &one,
    ];
    assert_failed(&output, 1, &way_out);
    assert!(stderr(&output).contains(text(&fresh)));
    assert!(!fresh.exists(), "no catalog is left behind");
    assert_eq!(pyramids(), before, "nothing is taken in");

    // More is taken in, and then the catalog is lost.
    let records = acquisition.join("tiles.jsonl");
    let said = std::fs::read_to_string(&records).unwrap();
    let again = said.lines().next().unwrap();
    let more = again.replace("\"tile\":\"", "\"tile\":\"later-");
    std::fs::write(&records, format!("{said}{more}\n")).unwrap();
    assert!(stderr(&done(ingest)).contains("1 tiles taken in"));
    std::fs::remove_file(&own).unwrap();
    for lost in [
        &["serve", &one, "--port", "0"][..],
        &["render", &one, "-o", "never.png"],
        &["check", &one],
        &ingest,
    ] {
        assert_failed(&run(lost), 1, &way_out);
    }
    // A copy knows less, and what is missing is taken in again.
    std::fs::copy(&copy, &own).unwrap();
    assert!(stderr(&done(ingest)).contains("1 tiles taken in"));
    let whole = stderr(&done(["check", &one]));
    assert!(whole.contains("all whole"), "{whole}");

    // Cut short while it was copied, say.
    let identity = Path::new(&one).join("identity");
    let said = std::fs::read_to_string(&identity).unwrap();
    for damaged in ["", &said[..7]] {
        std::fs::write(&identity, damaged).unwrap();
        let told = stderr(&done(["check", &one]));
        assert!(
            told.contains("\"identity\"") && told.contains("damaged"),
            "{told}"
        );
        done(ingest);
        assert_eq!(std::fs::read_to_string(&identity).unwrap(), said);
    }
}

#[test]
fn what_an_export_finds_in_its_place() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let out = folder.path().join("out.zarr");
    let export = |more: &[&str]| run(["export", &archive, text(&out)].iter().chain(more));
    assert!(export(&[]).status.success());
    assert!(stderr(&done(["export", &archive, text(&out)])).contains("nothing to do"));
    let taken = export(&["--channels", "0", "--compression", "0"]);
    assert_failed(&taken, 1, &["something already", text(&out)]);
    // What was taken away is exported again.
    let shard = out.join("0/c/0/0/0/0");
    let bytes = std::fs::read(&shard).unwrap();
    std::fs::remove_file(&shard).unwrap();
    let mended = stderr(&done(["export", &archive, text(&out)]));
    assert!(mended.contains("were there already"), "{mended}");
    assert_eq!(std::fs::read(&shard).unwrap().len(), bytes.len());
    // Whoever is refused leaves nothing behind, whose folder it may be.
    let others = folder.path().join("others");
    std::fs::create_dir(&others).unwrap();
    std::fs::write(others.join("letter.txt"), "hello").unwrap();
    let taken = run(["export", &archive, text(&others)]);
    assert_failed(&taken, 1, &["something already", text(&others)]);
    let nowhere = folder.path().join("nowhere");
    let outside = run(["export", &archive, text(&nowhere), "--finest", "99"]);
    assert_failed(&outside, 1, &["no level 99"]);
    assert_eq!(std::fs::read_dir(&others).unwrap().count(), 1);
    assert!(!nowhere.exists() && !out.join(".incoming").exists());
    let cut = folder.path().join("cut.zarr");
    let told = stderr(&done([
        "export",
        &archive,
        text(&cut),
        "--region",
        "0,0,0,100,100,9999",
    ]));
    assert!(
        told.contains("reaches beyond the volume, and is cut at 100,100,12"),
        "{told}"
    );

    // As an export that was killed leaves it.
    std::fs::remove_file(out.join("zarr.json")).unwrap();
    let begun = r#"{"export": {"volume": "phantom", "channels": [0, 1]}, "revision": 1}"#;
    std::fs::write(out.join("export.json"), begun).unwrap();
    let other = export(&[]);
    assert_failed(
        &other,
        1,
        &["another export", "channels 0,1 there, 0 now", text(&out)],
    );
    assert!(stderr(&other).len() < 600, "{}", stderr(&other));
    let half = run(["render", text(&out), "-o", "never.png"]);
    assert_failed(
        &half,
        1,
        &[
            "export to this folder was begun",
            "repeat the command",
            text(&out),
        ],
    );
}

#[test]
fn what_is_asked_for_outside_the_volume() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let picture = folder.path().join("picture.png");
    let render = |more: &[&str]| {
        run(["render", &archive, "-o", text(&picture)]
            .iter()
            .chain(more))
    };
    for (more, parts) in [
        (&["--slice", "z=9999"][..], &["z=9999", "from 0 to 11"][..]),
        (&["--clip", "150,0,0,160,9,9"], &["along x", "150", "160"]),
        (
            &["--slice", "z=3", "--clip", "0,0,5,9,9,9"],
            &["along z", "from 5 to 9", "from 3 to 3"],
        ),
    ] {
        assert_failed(&render(more), 1, parts);
    }
    for (transfer, part) in [
        (
            r#""window": [0.5, 0.5], "opacity": [], "opacity_length_nm": 9"#,
            "window",
        ),
        (
            r#""window": [0, 1], "opacity": [], "opacity_length_nm": 0"#,
            "above 0",
        ),
        (
            r#""window": [0, 1], "opacity": [{"value": 0.9, "opacity": 1}, {"value": 0.1, "opacity": 0}],
               "opacity_length_nm": 9"#,
            "order of their values",
        ),
    ] {
        let json = format!(r#"{{"polarity": "dark", "color_map": "bone", {transfer}}}"#);
        assert_failed(&render(&["--transfer", &json]), 1, &[part]);
    }
    assert_failed(&render(&["--iso", "2"]), 2, &["0 to 1"]);
    for more in [
        &["--iso", "1:0.5"][..],
        &["--transfer", "1:auto"],
        &["--channels", "1"],
    ] {
        assert_failed(&render(more), 1, &["there is no channel 1", "has 1"]);
    }
    let five = ["--cut", "x=1"].repeat(5);
    assert_failed(&render(&five), 1, &["4 planes", "--cut fewer times"]);
    assert!(!picture.exists());
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
    ] {
        assert_failed(&view(more), 1, parts);
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

    // What is done is done.
    let again = run(["ingest", text(&acquisition), text(&archive), "--once"]);
    assert!(again.status.success(), "{}", stderr(&again));
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
