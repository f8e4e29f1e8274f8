//! Stacks and real acquisitions that a demo or a simulation is made of.

use std::path::Path;

use super::{assert_failed, text};
use crate::{run, simulate, stderr};

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
pub(super) fn sections(folder: &Path) {
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
