//! What lies where an image should be and cannot be looked at.

use std::fs;
use std::io;
use std::path::Path;

/// Why an image cannot be looked at though its name is there, and what to do; `None` if it can, or if nothing is there.
/// Nothing is opened.
pub(super) fn why(path: &Path) -> Option<String> {
    let at = path.display();
    let is_gone = |e: &io::Error| e.kind() == io::ErrorKind::NotFound;
    match (fs::metadata(path), fs::symlink_metadata(path)) {
        (Ok(there), _) if there.is_dir() => Some(format!(
            "a folder lies where an image should be; put the image itself there: {at}"
        )),
        (Ok(_), _) => None,
        (Err(e), Ok(_)) if is_gone(&e) => Some(format!(
            "a link to nothing lies where an image should be; put there what it leads to, or the image itself: {at}"
        )),
        (Err(_), Ok(_)) => Some(format!(
            "a link that cannot be followed lies where an image should be; put the image itself there: {at}"
        )),
        (Err(_), Err(e)) if is_gone(&e) || e.kind() == io::ErrorKind::NotADirectory => None,
        (Err(_), Err(e)) => Some(format!(
            "an image cannot be looked at ({e}); check its disk or network, and that you may: {at}"
        )),
    }
}

#[cfg(all(test, unix))]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn what_is_no_image_is_called_by_its_kind() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::write(at("image"), "").unwrap();
        symlink(at("image"), at("link")).unwrap();
        symlink("none", at("dangling")).unwrap();
        symlink("loop", at("loop")).unwrap();
        fs::create_dir(at("folder")).unwrap();
        symlink("folder", at("to-folder")).unwrap();
        for (name, kind) in [
            ("dangling", "a link to nothing lies"),
            ("loop", "a link that cannot be followed lies"),
            ("folder", "a folder lies"),
            ("to-folder", "a folder lies"),
        ] {
            let why = why(&at(name)).unwrap();
            assert!(
                why.starts_with(kind) && why.ends_with(at(name).to_str().unwrap()),
                "{why}"
            );
        }
        for clear in ["image", "link", "none", "image/none"] {
            assert_eq!(why(&at(clear)), None, "{clear}");
        }
    }
}
