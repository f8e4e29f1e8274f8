//! Folders that must not lie within one another.

use std::io;
use std::path::{Path, PathBuf};

/// Whether one of two folders is the other or lies within it. They need not exist.
pub(crate) fn overlap(one: &Path, other: &Path) -> io::Result<bool> {
    let (one, other) = (resolved(one)?, resolved(other)?);
    Ok(one.starts_with(&other) || other.starts_with(&one))
}

/// Where a folder is, links followed. Of one that does not exist yet, its nearest parent that does tells where it
/// would be.
fn resolved(folder: &Path) -> io::Result<PathBuf> {
    let mut existing = std::path::absolute(folder)?;
    let mut missing = PathBuf::new();
    while !existing.exists() {
        let name = existing.file_name().unwrap_or_default().to_owned();
        missing = Path::new(&name).join(missing);
        if !existing.pop() {
            break;
        }
    }
    Ok(existing.canonicalize()?.join(missing))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_within_one_another_are_found() {
        let folder = tempfile::tempdir().unwrap();
        let one = folder.path().join("one");
        std::fs::create_dir(&one).unwrap();
        for within in [
            one.clone(),
            one.join("a/b"),
            one.join("../one"),
            folder.path().into(),
        ] {
            assert!(overlap(&one, &within).unwrap(), "{}", within.display());
            assert!(overlap(&within, &one).unwrap(), "{}", within.display());
        }
        for beside in ["two", "one2", "deep/one"] {
            assert!(!overlap(&one, &folder.path().join(beside)).unwrap());
        }
    }
}
