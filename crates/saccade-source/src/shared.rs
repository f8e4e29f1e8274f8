//! Data of others, for tests: too large to be kept beside them.

use std::io::Write as _;
use std::path::{Path, PathBuf};

/// A folder of theirs; `None`, and told, where there is none. Where `SACCADE_SHARED` says in which folder `data` is, it has to be
/// there.
pub(crate) fn data(folder: &str) -> Option<PathBuf> {
    let named = std::env::var_os("SACCADE_SHARED").map(PathBuf::from);
    let is_named = named.is_some();
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared");
    let path = named.unwrap_or_else(beside).join("data").join(folder);
    if path.is_dir() {
        return Some(path);
    }
    let missing = format!("{} is not there", path.display());
    assert!(!is_named, "SACCADE_SHARED is set, but {missing}");
    // Past those who hide what tests print that pass.
    let told = std::io::stderr().write_all(format!("skipped: {missing}\n").as_bytes());
    told.expect("there is somebody to tell");
    None
}
