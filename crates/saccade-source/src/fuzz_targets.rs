//! One function per parser of foreign bytes that this crate keeps to itself. `./dev fuzz` runs them for long, the tests on seeds
//! that are changed at random. Each may refuse; none may panic, or take much time or memory.
//!
//! What a target looks at lies beside it: these only have names here.

use crate::objects::Location;
use crate::{export, remote, stitched};

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
    ("server_volume", remote::fuzz_targets::volume),
    ("server_json", remote::fuzz_targets::answer),
    ("server_ranges", remote::fuzz_targets::ranges),
    ("server_events", remote::fuzz_targets::server_events),
    ("disk_block", stitched::fuzz_block),
    ("disk_thumbnail", stitched::fuzz_thumbnail),
    ("export_state", export::fuzz_state),
    ("export_level", export::fuzz_description),
    ("export_shard", export::fuzz_shard),
    ("image_location", image_location),
];

/// Where an image is: what is shown of it is the same place, without what may be secret.
fn image_location(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    let password = text.replace(['/', '?', '#'], "");
    let secret = Location::Http(format!("https://me:hush{password}hush@host/image?hush"));
    assert!(!secret.to_string().contains("hush") || text.contains("hush"));
    let Ok(place) = text.parse::<Location>() else {
        return;
    };
    let shown = place.to_string();
    match &place {
        Location::Http(_) => {
            assert!(!shown.contains(['?', '#']));
            assert_eq!(shown.parse(), Ok(Location::Http(shown.clone())));
        }
        Location::Folder(folder) => assert!(!folder.as_os_str().is_empty()),
        Location::S3(_) => assert_eq!(shown.parse(), Ok(place.clone())),
    }
    assert!(!place.name().contains('/'));
}

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
