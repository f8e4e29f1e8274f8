//! Runs one target under libFuzzer: `SACCADE_FUZZ_TARGET` names it.
#![no_main]

mod images;
mod pieces;
mod scratch;
mod targets;
// What is shown needs a window; what is read of it does not.
#[path = "../../crates/saccade-view/src/fuzz_targets.rs"]
mod texts;
#[path = "../../crates/saccade-view/src/transfer_text.rs"]
mod transfer_text;

use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;

/// All of them, by name.
fn all() -> impl Iterator<Item = &'static (&'static str, targets::Target)> {
    { targets::TARGETS.iter() }
        .chain(&images::TARGETS)
        .chain(texts::TARGETS)
        .chain(saccade_ingest::fuzz_targets::TARGETS)
        .chain(saccade_source::fuzz_targets::TARGETS)
        .chain(saccade_serve::fuzz_targets::TARGETS)
}

static TARGET: LazyLock<targets::Target> = LazyLock::new(|| {
    let wanted = std::env::var("SACCADE_FUZZ_TARGET").unwrap_or_default();
    match all().find(|(name, _)| *name == wanted) {
        Some((_, target)) => *target,
        None => {
            let names: Vec<_> = all().map(|(name, _)| *name).collect();
            panic!(
                "SACCADE_FUZZ_TARGET is {wanted:?}, but must be one of {}",
                names.join(", ")
            );
        }
    }
});

fuzz_target!(|bytes: &[u8]| TARGET(bytes));
