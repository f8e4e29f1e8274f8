//! What lies where a folder should be.

use std::fs::{self, FileType};
use std::path::Path;

/// What lies there and is no folder to look into, in words; `None` if it is one, or if nothing is there. Nothing is opened.
fn kind(path: &Path) -> Option<&'static str> {
    let kind = fs::symlink_metadata(path).ok()?.file_type();
    match kind {
        kind if kind.is_dir() => None,
        kind if kind.is_file() => Some("a file"),
        kind if kind.is_symlink() => Some("a link"),
        kind if is_pipe(kind) => Some("a named pipe"),
        _ => Some("a socket or a device"),
    }
}

#[cfg(unix)]
fn is_pipe(kind: FileType) -> bool {
    std::os::unix::fs::FileTypeExt::is_fifo(&kind)
}

#[cfg(not(unix))]
fn is_pipe(_: FileType) -> bool {
    false
}

/// Why nothing is found in what should be a folder, as far as something else lies there, and what to do.
pub(crate) fn why(path: &Path) -> Option<String> {
    let kind = kind(path)?;
    Some(format!(
        "images should be in a folder where {kind} lies; put the folder itself there: {}",
        path.display()
    ))
}

/// The same of what should be a folder on the way to a file.
pub(crate) fn why_on_the_way(file: &Path) -> Option<String> {
    // A link to a folder is as good as one there.
    let is_none = |path: &&Path| fs::metadata(path).is_ok_and(|there| !there.is_dir());
    why(file.ancestors().skip(1).find(is_none)?)
}

#[cfg(all(test, unix))]
mod tests {
    use std::os::unix::fs::symlink;
    use std::os::unix::net::UnixListener;

    use super::*;

    #[test]
    fn what_is_no_folder_is_called_by_its_kind() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::create_dir(at("folder")).unwrap();
        fs::write(at("file"), "").unwrap();
        symlink(at("folder"), at("link")).unwrap();
        let _socket = UnixListener::bind(at("socket")).unwrap();
        let made = std::process::Command::new("mkfifo")
            .arg(at("pipe"))
            .status();
        assert!(made.unwrap().success());
        for (name, kind) in [
            ("file", "a file lies"),
            ("link", "a link lies"),
            ("pipe", "a named pipe lies"),
            ("socket", "a socket or a device lies"),
        ] {
            let why = why(&at(name)).unwrap();
            assert!(
                why.contains(kind) && why.ends_with(at(name).to_str().unwrap()),
                "{why}"
            );
        }
        assert_eq!([why(&at("folder")), why(&at("none"))], [None, None]);
        assert!(
            why_on_the_way(&at("pipe/deep/a.tif"))
                .unwrap()
                .ends_with("/pipe")
        );
        for clear in ["link/a.tif", "folder/a.tif", "none/a.tif", "pipe"] {
            assert_eq!(why_on_the_way(&at(clear)), None, "{clear}");
        }
    }
}
