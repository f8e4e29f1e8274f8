//! The fuzz targets on seeds, and on seeds changed at random: a smoke test of what `./dev fuzz` runs for long.

#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]
#![allow(clippy::cast_possible_truncation, reason = "random bytes")]

use std::path::Path;

use glam::UVec2;
use saccade_archive::image::{Gray, GrayImage};
use saccade_archive::pyramid::{Encoding, encode, encode_labels};

#[allow(unreachable_pub, reason = "another crate's tests have the same file")]
#[path = "../../../fuzz/src/changed.rs"]
mod changed;
#[allow(unreachable_pub, reason = "the fuzzer's crate has the same file")]
#[path = "../../../fuzz/src/pieces.rs"]
mod pieces;
#[allow(unreachable_pub, reason = "the fuzzer's crate has the same file")]
#[path = "../../../fuzz/src/scratch.rs"]
mod scratch;
#[allow(unreachable_pub, reason = "the fuzzer's crate has the same file")]
#[path = "../../../fuzz/src/targets.rs"]
mod targets;

use changed::{files, survives};

/// Changed inputs per target.
const INPUTS: u32 = 2_000;

fn pyramids() -> Vec<Vec<u8>> {
    let size = UVec2::new(200, 140);
    let value = |i: u32| (i * 7 + i / 200 * 13) as u8;
    let image = GrayImage::new(size.x, size.y, (0..size.x * size.y).map(value).collect());
    let deep = image.voxels.iter().map(|&v| u16::from(v) * 250).collect();
    let deep = Gray::new(size.x, size.y, deep);
    let jpeg = encode(&image, &Encoding::Jpeg { quality: 60 }).unwrap();
    let lossless = encode(&deep, &Encoding::Lossless).unwrap();
    let labels = encode_labels(&image).unwrap();
    [jpeg, lossless, labels].map(|file| file.to_vec()).into()
}

/// What a target is known to be fed with.
fn seeds(target: &str) -> Vec<Vec<u8>> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut seeds = files(&root.join("../../fuzz/seeds").join(target));
    match target {
        "image" | "image_of_size" => seeds.extend(files(&root.join("tests/images"))),
        "pyramid" => seeds.extend(pyramids()),
        _ => {}
    }
    seeds
}

#[test]
fn parsers_of_foreign_bytes_survive_them() {
    for (name, target) in targets::TARGETS {
        // Those that write their input into files for each take a while.
        let inputs = match name {
            "record_file" | "tiff_pages" => INPUTS / 4,
            _ => INPUTS,
        };
        survives(name, target, &seeds(name), inputs);
    }
}
