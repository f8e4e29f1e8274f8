//! One function per part of requests that this crate reads by itself. `./dev fuzz` runs them for long, the tests on seeds that
//! are changed at random. Each may refuse; none may panic, or take much time or memory.
//!
//! What a target looks at lies beside it: these only have names here.

use crate::{formats, http, routes, server};

#[cfg(test)]
#[allow(unreachable_pub, reason = "the fuzzer's crate has the same file")]
#[path = "../../../fuzz/src/changed.rs"]
mod changed;
#[allow(unreachable_pub, reason = "the fuzzer's crate has the same file")]
#[path = "../../../fuzz/src/pieces.rs"]
pub(crate) mod pieces;

/// A parser.
pub type Target = fn(&[u8]);

/// All of them, by name.
pub const TARGETS: &[(&str, Target)] = &[
    ("request_heads", server::fuzz_heads),
    ("request_host", server::fuzz_access),
    ("request_range", http::fuzz_range),
    ("request_tags", http::fuzz_tag),
    ("object_keys", formats::fuzz),
    ("chunk_list", routes::fuzz),
];

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::changed::{files, survives};
    use super::*;

    #[test]
    fn parsers_survive_foreign_bytes() {
        let seeds = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/seeds");
        for &(name, target) in TARGETS {
            survives(name, target, &files(&seeds.join(name)), 2_000);
        }
    }
}
