//! The fuzz targets of images on seeds, and on seeds changed at random: a smoke test of what `./dev fuzz` runs for long.
//!
//! Every run of one seed number is the same. `SACCADE_FUZZ_SEED` chooses it, and a failure names it.

#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]
#![allow(clippy::cast_possible_truncation, reason = "random bytes")]
#![cfg(not(target_family = "wasm"))]

use std::panic::catch_unwind;
use std::path::Path;

#[allow(unreachable_pub, reason = "another crate's tests have the same file")]
#[path = "../../../fuzz/src/changed.rs"]
mod changed;
#[allow(unreachable_pub, reason = "the fuzzer's crate has the same file")]
#[path = "../../../fuzz/src/images.rs"]
mod images;

use changed::{Random, changed, files};

/// Changed inputs per target.
const INPUTS: u32 = 1_500;
/// Of targets that take connections for each.
const ANSWERS: u32 = 200;

#[test]
fn readers_of_images_survive_foreign_bytes() {
    let seed: u64 = std::env::var("SACCADE_FUZZ_SEED").map_or(1, |s| s.parse().unwrap());
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/seeds");
    for (name, target) in images::TARGETS {
        let seeds = files(&root.join(name));
        assert!(!seeds.is_empty(), "{name} has no seeds");
        for bytes in &seeds {
            target(bytes);
        }
        let inputs = match name.ends_with("_answer") {
            true => ANSWERS,
            false => INPUTS,
        };
        let mut random = Random::new(seed);
        for n in 0..inputs {
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
