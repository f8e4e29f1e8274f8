//! The fuzz targets of images on seeds, and on seeds changed at random: a smoke test of what `./dev fuzz` runs for long.

#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]
#![allow(clippy::cast_possible_truncation, reason = "random bytes")]
#![cfg(not(target_family = "wasm"))]

use std::path::Path;

#[allow(unreachable_pub, reason = "another crate's tests have the same file")]
#[path = "../../../fuzz/src/changed.rs"]
mod changed;
#[allow(unreachable_pub, reason = "the fuzzer's crate has the same file")]
#[path = "../../../fuzz/src/images.rs"]
mod images;

use changed::{files, survives};

/// Changed inputs per target.
const INPUTS: u32 = 1_500;
/// Of targets that take connections for each.
const ANSWERS: u32 = 200;

#[test]
fn readers_of_images_survive_foreign_bytes() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/seeds");
    for (name, target) in images::TARGETS {
        let inputs = match name.ends_with("_answer") {
            true => ANSWERS,
            false => INPUTS,
        };
        survives(name, target, &files(&root.join(name)), inputs);
    }
}
