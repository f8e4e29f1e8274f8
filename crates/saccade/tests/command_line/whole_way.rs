//! From a microscope's tiles to a picture, through the program alone.

use std::path::Path;

use image::RgbaImage;
use serde_json::json;

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
    // Without a window that makes more of how samplers round.
    let plain = r#"{"polarity": "bright", "color_map": "gray", "window": [0, 1], "opacity_length_nm": 9,
                    "opacity": [{"value": 0, "opacity": 1}]}"#;
    let slice = |plane| of(&["--slice", plane, "--transfer", plain]);
    let named = slice("z=6");
    let alike = largest_difference(&named, &slice("0,0,2@9,9,6.5"));
    assert!(alike <= ROUNDING, "{alike}");
    let apart = largest_difference(&named, &slice("z=7"));
    assert!(apart > 20, "the comparison sees no difference: {apart}");
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

/// An OME-Zarr image of noise: two channels with more bricks than fit 4 MiB, and three levels.
fn noise(folder: &Path) -> String {
    let image = folder.join("noise.zarr");
    let axis = |name: &str| json!({"name": name, "type": "space", "unit": "nanometer"});
    let mut datasets = Vec::new();
    for level in 0..3_u32 {
        let (edge, depth) = (256 >> level, 64 >> level);
        let name = level.to_string();
        let nm = f64::from(4 << level);
        let scale = json!([{"type": "scale", "scale": [1, nm, nm, nm]}]);
        datasets.push(json!({"path": name, "coordinateTransformations": scale}));
        let array = json!({"zarr_format": 3, "node_type": "array", "shape": [2, depth, edge, edge],
            "data_type": "uint8", "fill_value": 0,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [1, depth, edge, edge]}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "codecs": [{"name": "bytes"}]});
        std::fs::create_dir_all(image.join(&name)).unwrap();
        std::fs::write(image.join(&name).join("zarr.json"), array.to_string()).unwrap();
        for channel in 0..2_u32 {
            let voxels: Vec<u8> = (0..edge * edge * depth)
                .map(|n: u32| {
                    // Each channel is the brighter one somewhere.
                    let noise = (n.wrapping_mul(2_654_435_761) >> 24) + 100 * channel;
                    u8::try_from(noise % 200 + 20 + channel).unwrap()
                })
                .collect();
            let chunk = image.join(format!("{name}/c/{channel}/0/0/0"));
            std::fs::create_dir_all(chunk.parent().unwrap()).unwrap();
            std::fs::write(chunk, voxels).unwrap();
        }
    }
    let channel = json!({"name": "c", "type": "channel"});
    let multiscales =
        json!([{"axes": [channel, axis("z"), axis("y"), axis("x")], "datasets": datasets}]);
    let group = json!({"zarr_format": 3, "node_type": "group",
        "attributes": {"ome": {"version": "0.5", "multiscales": multiscales}}});
    std::fs::write(image.join("zarr.json"), group.to_string()).unwrap();
    image.to_str().unwrap().to_owned()
}

#[test]
fn a_picture_that_is_coarser_because_memory_is_full_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let image = noise(folder.path());
    let picture = folder.path().join("picture.png");
    // Finer than one voxel a pixel: every brick of the finest level is wanted.
    let with = |gpu: &str, more: &[&str]| {
        let fixed = ["--lod-bias", "-2", "--channels", "0", "--gpu-memory", gpu];
        told(&image, &picture, &[&fixed[..], more].concat())
    };
    let Some((plenty, fine)) = with("64", &[]) else {
        return;
    };
    assert_eq!(plenty.trim(), "complete, level 0");
    let (full, coarse) = with("4", &[]).unwrap();
    let parts = [
        "complete, level 1, coarser by ",
        " levels: GPU memory is full",
        "--gpu-memory",
    ];
    for part in parts {
        assert!(full.contains(part), "{part:?} is not in: {full}");
    }
    assert!(
        largest_difference(&fine, &coarse) > 10,
        "the comparison sees no difference"
    );
    // Main memory does not make pictures coarser: chunks that it does not keep are read again.
    let (little, same) = with("64", &["--host-memory", "16"]).unwrap();
    assert_eq!(little.trim(), "complete, level 0");
    assert!(largest_difference(&fine, &same) <= ROUNDING);

    let none = ["render", &image, "-o", "never.png", "--gpu-memory"];
    for (more, parts) in [
        (
            &["1"][..],
            ["1 MiB of GPU memory are too few", "--gpu-memory "],
        ),
        (
            &["8", "--size", "4000x4000"],
            ["4000x4000 pixels does not fit 8 MiB", "--gpu-memory"],
        ),
    ] {
        let output = run(none.iter().chain(more));
        assert_eq!(output.status.code(), Some(1));
        let said = stderr(&output);
        for part in parts {
            assert!(said.contains(part), "{part:?} is not in: {said}");
        }
    }
}

#[test]
fn each_channel_has_its_own_colours_and_surface() {
    let folder = tempfile::tempdir().unwrap();
    let image = noise(folder.path());
    let picture = folder.path().join("picture.png");
    let transfer = |colour: &str| {
        format!(
            r#"{{"polarity": "bright", "color_map": "{colour}", "window": [0.1, 0.8], "opacity_length_nm": 9,
                "opacity": [{{"value": 0.3, "opacity": 0}}, {{"value": 0.7, "opacity": 0.9}}]}}"#
        )
    };
    let (red, blue) = (transfer("#ff0000"), transfer("#0000ff"));
    let file = folder.path().join("blue.json");
    std::fs::write(&file, &blue).unwrap();
    let sums = |more: &[&str]| {
        let fixed = ["--mode", "maximum", "--detail", "2"];
        let (_, picture) = told(&image, &picture, &[&fixed[..], more].concat())?;
        let mut sums = [0_u32; 3];
        for pixel in picture.pixels() {
            for (sum, value) in sums.iter_mut().zip(pixel.0) {
                *sum += u32::from(value);
            }
        }
        Some(sums)
    };
    // The first that is seen, as ever.
    let Some([r, g, b]) = sums(&["--channels", "1", "--transfer", &red]) else {
        return;
    };
    assert!(r > 100_000 && g == 0 && b == 0, "{r} {g} {b}");
    let second = format!("1:{}", file.to_str().unwrap());
    let first = format!("0:{red}");
    let [r, g, b] = sums(&["--transfer", &second, "--transfer", &first]).unwrap();
    assert!(r > 100_000 && g == 0 && b > 100_000, "{r} {g} {b}");
    let alone = [
        "--transfer",
        &second,
        "--transfer",
        &first,
        "--channels",
        "1",
    ];
    let [r, g, b] = sums(&alone).unwrap();
    assert!(r == 0 && g == 0 && b > 100_000, "{r} {g} {b}");
    let [r, g, b] = sums(&[
        "--transfer",
        &second,
        "--transfer",
        "1:auto",
        "--channels",
        "1",
    ])
    .unwrap();
    assert!(
        r > 100_000 && g == 0 && b > 100_000,
        "magenta, as by itself: {r} {g} {b}"
    );

    // Values go to 220 of 255: above that there is no surface.
    let surface = |isos: &str| {
        let of = [
            "--transfer",
            &first,
            "--transfer",
            &second,
            "--detail",
            "2",
            "--mode",
            "surface",
        ];
        let (_, picture) = told(&image, &picture, &[&of[..], &["--iso", isos]].concat()).unwrap();
        let lit = |c: usize| picture.pixels().any(|pixel| pixel.0[c] > 40);
        [lit(0), lit(2)]
    };
    assert_eq!(surface("0.95"), [false, false]);
    assert_eq!(surface("0.4"), [true, true]);
    assert_eq!(surface("0:0.4,1:0.95"), [true, false]);
    assert_eq!(surface("0.95,1:0.4"), [false, true]);
}

/// What is not there yet has a colour of its own, and what is there has not; or each level has one.
#[test]
fn false_colours_show_what_is_missing_and_which_level_is_drawn() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let picture = folder.path().join("picture.png");
    let of = |more: &[&str]| told(&archive, &picture, more).map(|(_, picture)| picture);
    let Some(complete) = of(&["--false-colors", "none"]) else {
        return;
    };
    let same = of(&["--false-colors", "residency"]).unwrap();
    assert!(largest_difference(&complete, &same) <= ROUNDING);
    let early = ["--timeout", "0", "--partial", "--false-colors"];
    let plain = of(&[&early[..], &["none"]].concat()).unwrap();
    let tinted = of(&[&early[..], &["residency"]].concat()).unwrap();
    assert!(largest_difference(&plain, &tinted) > 40);

    // Tissue is grey; level 0 is red and level 2 green.
    let sums = |more: &[&str]| {
        let mut sums = [0_u32; 3];
        for pixel in of(more).unwrap().pixels() {
            for (sum, value) in sums.iter_mut().zip(pixel.0) {
                *sum += u32::from(value);
            }
        }
        sums
    };
    let [r, g, b] = sums(&["--detail", "0-0"]);
    assert!(r > 10_000 && r == g && g == b, "{r} {g} {b}");
    let [r, g, b] = sums(&["--detail", "0-0", "--false-colors", "level"]);
    assert!(r > g + g / 2 && r > b + b / 2, "{r} {g} {b}");
    let [r, g, b] = sums(&["--detail", "2-2", "--false-colors", "level"]);
    assert!(g > r + r / 4 && g > b + b / 4, "{r} {g} {b}");
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
    // It is in view, whatever is known of it.
    let said = stderr(&output);
    assert!(!said.contains("nothing of the volume"), "{said}");
}
