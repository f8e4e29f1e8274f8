//! From a microscope's tiles to a picture, through the program alone.

use std::path::Path;

use image::RgbaImage;

use super::{Running, archive, run, saccade, stderr};

/// Pictures of one view agree to a step of 255: where a brick lies in the cache moves roundings.
const ROUNDING: u8 = 1;

/// The picture; `None` without a GPU, unless `SACCADE_GPU_TESTS=require`.
fn render(place: &str, to: &Path, more: &[&str]) -> Option<RgbaImage> {
    let (said, picture) = told(place, to, more)?;
    assert!(said.starts_with("complete, level "), "{said}");
    Some(picture)
}

/// What was said of the picture, and the picture.
fn told(place: &str, to: &Path, more: &[&str]) -> Option<(String, RgbaImage)> {
    let fixed = [
        "render",
        place,
        "-o",
        to.to_str().unwrap(),
        "--size",
        "64x64",
    ];
    let output = run(fixed.iter().chain(more));
    let required = std::env::var("SACCADE_GPU_TESTS").is_ok_and(|v| v == "require");
    if stderr(&output).contains("no GPU adapter") && !required {
        #[expect(clippy::print_stderr, reason = "a skipped test says why")]
        {
            eprintln!("skipped: no GPU adapter");
        }
        return None;
    }
    assert!(output.status.success(), "{}", stderr(&output));
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    let picture = image::open(to).unwrap().into_rgba8();
    assert_eq!(picture.dimensions(), (64, 64));
    Some((said, picture))
}

fn largest_difference(a: &RgbaImage, b: &RgbaImage) -> u8 {
    let pairs = a.as_raw().iter().zip(b.as_raw());
    pairs.map(|(a, b)| a.abs_diff(*b)).max().unwrap()
}

#[test]
fn from_tissue_to_picture() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let picture = folder.path().join("picture.png");
    let Some(first) = render(&archive, &picture, &[]) else {
        return;
    };

    let lit = first
        .pixels()
        .filter(|pixel| pixel.0[..3].iter().any(|v| *v > 40))
        .count();
    assert!(lit > 64 * 64 / 20, "only {lit} pixels show anything");
    assert!(first.pixels().all(|pixel| pixel.0[3] == 255));

    let again = render(&archive, &picture, &[]).unwrap();
    assert!(largest_difference(&first, &again) <= ROUNDING);

    let (_server, url) = Running::start(saccade().args(["serve", &archive, "--port", "0"]));
    let remote = render(&url, &picture, &[]).unwrap();
    assert!(largest_difference(&first, &remote) <= ROUNDING);

    let elsewhere = ["--camera", "-40,10,9000,1200,1000,240"];
    let other = render(&archive, &picture, &elsewhere).unwrap();
    assert!(
        largest_difference(&first, &other) > 40,
        "the comparison sees no difference"
    );
}

#[test]
fn planes_slabs_cuts_and_the_work_of_rays_are_pictures_of_their_own() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let picture = folder.path().join("picture.png");
    let Some(whole) = render(&archive, &picture, &[]) else {
        return;
    };
    let of = |more: &[&str]| render(&archive, &picture, more).unwrap();
    let pictures = [
        whole,
        of(&["--slice", "z=6"]),
        of(&["--slice", "0.3,-1,0@75,65,6"]),
        of(&["--slice", "z=6", "--slab", "160"]),
        of(&["--cut", "-1,0,0@75,65,6"]),
        of(&["--cut", "-1,0,0@75,65,6", "--cut", "y=65"]),
        of(&["--heat", "samples=200"]),
        of(&["--detail", "3"]),
    ];
    for (n, one) in pictures.iter().enumerate() {
        for (m, other) in pictures.iter().enumerate().skip(n + 1) {
            let apart = largest_difference(one, other);
            assert!(apart > 20, "pictures {n} and {m} are alike: {apart}");
        }
    }
    // Named in other words, they are the same.
    let alike = largest_difference(&pictures[1], &of(&["--slice", "0,0,2@9,9,6"]));
    assert!(alike <= ROUNDING, "{alike}");
    let alike = largest_difference(&pictures[0], &of(&["--detail", "0:full"]));
    assert!(alike <= ROUNDING, "{alike}");
}

/// The finest level that a picture asks for is one of those that its channel may be drawn from.
#[test]
fn levels_that_a_channel_may_be_drawn_from_bound_the_picture() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let picture = folder.path().join("picture.png");
    let level = |more: &[&str]| {
        let (said, _) = told(&archive, &picture, more)?;
        let level = said.trim().strip_prefix("complete, level ").unwrap();
        let level = level.split(',').next().unwrap();
        Some(level.parse::<u32>().unwrap())
    };
    let Some(free) = level(&[]) else {
        return;
    };
    for (detail, want) in [
        ("0-", free),
        ("0-0", 0),
        ("0:0-0+2", 0),
        ("2-", free.max(2)),
        ("0:2-3", free.max(2)),
        ("0:2-2", 2),
        ("0-1+1", 1),
    ] {
        assert_eq!(level(&["--detail", detail]), Some(want), "{detail}");
    }
    assert!(free < 2, "the comparison sees no difference: level {free}");
    let nobody = ["render", &archive, "-o", "never.png", "--detail", "1:2-"];
    let output = run(nobody);
    assert_eq!(output.status.code(), Some(1));
    let said = stderr(&output);
    assert!(said.contains("there is no channel 1"), "{said}");
}

#[test]
fn what_is_not_complete_is_not_written_unless_wanted() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let picture = folder.path().join("picture.png");
    if render(&archive, &picture, &[]).is_none() {
        return;
    }
    std::fs::remove_file(&picture).unwrap();
    let late = [
        "render",
        &archive,
        "-o",
        picture.to_str().unwrap(),
        "--timeout",
        "0",
    ];
    let output = run(late);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("--partial"), "{}", stderr(&output));
    assert!(!picture.exists());
    let output = run(late.iter().chain(&["--partial"]));
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(picture.exists());
}
