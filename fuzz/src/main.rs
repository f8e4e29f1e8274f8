//! Runs one target under libFuzzer: `SACCADE_FUZZ_TARGET` names it.
#![no_main]

mod images;
mod targets;

use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;

static TARGET: LazyLock<targets::Target> = LazyLock::new(|| {
    let wanted = std::env::var("SACCADE_FUZZ_TARGET").unwrap_or_default();
    let mut all = targets::TARGETS.iter().chain(&images::TARGETS);
    let known = all.find(|(name, _)| *name == wanted);
    match known {
        Some((_, target)) => *target,
        None => {
            let all = targets::TARGETS.iter().chain(&images::TARGETS);
            let names: Vec<_> = all.map(|(name, _)| *name).collect();
            panic!(
                "SACCADE_FUZZ_TARGET is {wanted:?}, but must be one of {}",
                names.join(", ")
            );
        }
    }
});

fuzz_target!(|bytes: &[u8]| TARGET(bytes));
