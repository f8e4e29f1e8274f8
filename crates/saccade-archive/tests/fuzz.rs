//! The fuzz targets on seeds, and on seeds changed at random: a smoke test of what `./dev fuzz` runs for long.
//!
//! Every run of one seed number is the same. `SACCADE_FUZZ_SEED` chooses it, and a failure names it.

#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]
#![expect(clippy::cast_possible_truncation, reason = "random bytes")]

use std::fs;
use std::panic::catch_unwind;
use std::path::Path;

use glam::UVec2;
use saccade_archive::image::{Gray, GrayImage};
use saccade_archive::pyramid::{Encoding, encode, encode_labels};

#[allow(unreachable_pub, reason = "the fuzzer's crate has the same file")]
#[path = "../../../fuzz/src/targets.rs"]
mod targets;

/// Changed inputs per target.
const INPUTS: u32 = 2_000;

struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn below(&mut self, most: usize) -> usize {
        (self.next() >> 16) as usize % most.max(1)
    }
}

fn files(folder: &Path) -> Vec<Vec<u8>> {
    let Ok(entries) = fs::read_dir(folder) else {
        return Vec::new();
    };
    let mut paths: Vec<_> = entries.map(|e| e.unwrap().path()).collect();
    paths.sort();
    paths.retain(|path| path.extension().is_none_or(|e| e != "py"));
    paths.iter().map(|path| fs::read(path).unwrap()).collect()
}

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
    assert!(!seeds.is_empty(), "{target} has no seeds");
    seeds
}

/// A seed with some bytes changed, pieces repeated or cut out, numbers made large, or two joined.
fn changed(seeds: &[Vec<u8>], random: &mut Random) -> Vec<u8> {
    let mut bytes = seeds[random.below(seeds.len())].clone();
    for _ in 0..=random.below(6) {
        let at = random.below(bytes.len());
        match random.below(7) {
            0 | 1 if !bytes.is_empty() => bytes[at] = random.next() as u8,
            2 if !bytes.is_empty() => bytes[at] ^= 1 << random.below(8),
            3 => {
                let end = (at + random.below(16)).min(bytes.len());
                bytes.drain(at..end);
            }
            4 => {
                let end = (at + random.below(64)).min(bytes.len());
                let piece = bytes[at..end].to_vec();
                bytes.splice(at..at, piece);
            }
            5 => {
                let large = [0xff, 0x7f, 0x00, b'9'][random.below(4)];
                let end = (at + 1 + random.below(8)).min(bytes.len());
                bytes[at..end].fill(large);
            }
            _ => {
                let other = &seeds[random.below(seeds.len())];
                bytes.truncate(at);
                bytes.extend_from_slice(&other[random.below(other.len())..]);
            }
        }
    }
    bytes
}

#[test]
fn parsers_of_foreign_bytes_survive_them() {
    let seed: u64 = std::env::var("SACCADE_FUZZ_SEED").map_or(1, |s| s.parse().unwrap());
    for (name, target) in targets::TARGETS {
        let seeds = seeds(name);
        for bytes in &seeds {
            target(bytes);
        }
        let mut random = Random(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1);
        for n in 0..INPUTS {
            let bytes = changed(&seeds, &mut random);
            let survived = catch_unwind(|| target(&bytes)).is_ok();
            assert!(
                survived,
                "target {name}, SACCADE_FUZZ_SEED={seed}, input {n}: {:?}",
                bytes.escape_ascii().to_string()
            );
        }
    }
}
