//! What is asked for and does nothing is told, or refused where it is a mistake for certain.

use crate::errors::{assert_failed, text};
use crate::{archive, done, run, stderr};

#[test]
fn an_image_is_not_told_how_to_stitch() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let image = folder.path().join("copy.zarr");
    let image = text(&image);
    done(["export", &archive, image, "--overlaps", "blend"]);
    let picture = folder.path().join("picture.png");
    let out = folder.path().join("again.zarr");
    let cache = folder.path().join("cache");
    let commands: [&[&str]; 3] = [
        &["render", image, "-o", text(&picture)],
        &["export", image, text(&out)],
        &["serve", image, "--port", "0"],
    ];
    for command in commands {
        for (more, named) in [
            (
                &["--interpolation", "cubic"][..],
                "leave out --interpolation",
            ),
            (
                &["--overlaps", "nearest", "--along-z", "linear"],
                "leave out --overlaps, --along-z",
            ),
            (&["--fill-gaps", "2"], "leave out --fill-gaps"),
            (&["--disk-cache", text(&cache)], "leave out --disk-cache"),
        ] {
            let output = run(command.iter().chain(more));
            assert_failed(&output, 1, &["an image is not stitched", named]);
        }
    }
    assert!(!picture.exists() && !out.exists() && !cache.exists());
}

#[test]
fn what_does_not_show_in_a_picture_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let picture = folder.path().join("picture.png");
    let fixed = ["render", &archive, "-o", text(&picture), "--size", "32x24"];
    let render = |more: &[&str]| {
        let output = run(fixed.iter().chain(more));
        let said = stderr(&output);
        let required = std::env::var("SACCADE_GPU_TESTS").is_ok_and(|v| v == "require");
        // It is said before a GPU is looked for.
        assert!(output.status.success() || !required, "{said}");
        said
    };
    for (more, part) in [
        (&["--iso", "0.4"][..], "--mode surface"),
        (&["--mode", "surface", "--slice", "z=6"], "--slab"),
        (&["--heat", "nodes", "--false-colors", "level"], "--heat"),
    ] {
        let said = render(more);
        assert!(
            said.contains(part) && said.contains("show"),
            "{more:?}: {said}"
        );
    }
    let said = render(&["--mode", "surface", "--iso", "0.4", "--transfer", "0:auto"]);
    assert!(
        !said.contains("does not show") && !said.contains("--iso"),
        "{said}"
    );
    // A window can show it later; it is told all the same.
    let output = run(["view", &archive, "--iso", "0.4"]);
    assert_failed(&output, 1, &["--iso shows where", "is there a display"]);
}

/// A rod that is less than a pixel wide from where it fits however it is turned.
#[test]
fn a_thin_volume_is_seen_in_a_narrow_picture() {
    let folder = tempfile::tempdir().unwrap();
    let acquisition = folder.path().join("acquisition");
    crate::simulate(&acquisition, "20,600,6");
    let archive = folder.path().join("archive");
    let [acquisition, archive] = [&acquisition, &archive].map(|path| text(path));
    done(["ingest", acquisition, archive, "--once", "--lossless"]);
    let picture = folder.path().join("picture.png");
    let output = run(["render", archive, "-o", text(&picture), "--size", "8x600"]);
    let required = std::env::var("SACCADE_GPU_TESTS").is_ok_and(|v| v == "require");
    if !output.status.success() && !required {
        return;
    }
    let told = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(told.starts_with("complete, level "), "{told}");
    let picture = image::open(&picture).unwrap().to_rgb8();
    let lit = picture
        .pixels()
        .filter(|pixel| pixel.0.iter().any(|&v| v > 20));
    assert!(lit.count() > 60, "hardly anything is seen");
}
