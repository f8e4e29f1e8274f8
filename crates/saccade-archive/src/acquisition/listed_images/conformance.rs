//! What all [`Files`] must do. All implementations run it, also those of other crates.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use super::Files;

/// Files of a few names, in folders whose ends are alike.
const FILES: [&str; 9] = [
    "r.tif",
    "s01/r.tif",
    "s01/raw/r.tif",
    "xs01/raw/r.tif",
    "deep/s01/raw/r.tif",
    "deep/s01/raw/xr.tif",
    "deep/s02/raw/one.tif",
    "deep/s02/raw/50%20 ü.tif",
    "raw/s01/other.tif",
];

/// A folder that is called as images are.
const FOLDER: &str = "s02/r.tif";

/// Lays files into an empty folder, and checks what `look`, which looks it through, finds there.
///
/// # Panics
///
/// If the files break their contract: this is a test.
pub fn check<F: Files>(root: &Path, look: impl Fn(&Path) -> F) {
    for file in FILES {
        let path = root.join(file);
        fs::create_dir_all(path.parent().expect("a folder")).expect("a folder is made");
        fs::write(path, "").expect("a file is written");
    }
    fs::create_dir_all(root.join(FOLDER)).expect("a folder is made");
    let files = look(root);
    kinds_are_told_apart(&files);
    all_of_a_name_are_found(&files);
    those_in_folders_are_among_them(&files);
    what_is_gone_is_not_there(root, &files);
}

fn kinds_are_told_apart(files: &impl Files) {
    for file in FILES.map(Path::new) {
        assert!(files.is_there(file), "{}", file.display());
        assert!(!files.is_folder(file), "{}", file.display());
        let folders = file.ancestors().skip(1);
        for folder in folders.filter(|folder| !folder.as_os_str().is_empty()) {
            assert!(files.is_folder(folder), "{}", folder.display());
            assert!(!files.is_there(folder), "{}", folder.display());
        }
    }
    assert!(files.is_folder(Path::new(FOLDER)), "a folder may be called");
    assert!(!files.is_there(Path::new(FOLDER)), "as an image is");
    for none in ["none.tif", "s01/none.tif", "none/r.tif", "s01/raw/s01"].map(Path::new) {
        let either = files.is_there(none) || files.is_folder(none);
        assert!(!either, "{} is nothing", none.display());
    }
}

/// What is called so, of which each is named once.
fn called(files: &impl Files, name: &str, folders: &str) -> BTreeSet<PathBuf> {
    let called: Vec<_> = files.called(name, folders).collect();
    let each: BTreeSet<_> = called.iter().cloned().collect();
    assert_eq!(called.len(), each.len(), "{called:?} has one twice");
    each
}

fn all_of_a_name_are_found(files: &impl Files) {
    for file in FILES.map(Path::new) {
        let name = file.file_name().and_then(|name| name.to_str());
        let name = name.expect("a name");
        let of_the_name = |file: &&Path| file.file_name().is_some_and(|other| other == name);
        let all = { FILES.map(Path::new) }.into_iter().filter(of_the_name);
        let all: BTreeSet<_> = all.map(Path::to_owned).collect();
        let mut found = called(files, name, "");
        found.retain(|path| files.is_there(path));
        assert_eq!(found, all, "{name}");
    }
    for none in ["none.tif", ".tif", "raw"] {
        let mut found = called(files, none, "");
        found.retain(|path| files.is_there(path));
        assert!(found.is_empty(), "{none:?}: {found:?}");
    }
}

fn those_in_folders_are_among_them(files: &impl Files) {
    for folders in ["raw", "s01/raw", "deep/s01/raw", "s01", "none/raw"] {
        let all = called(files, "r.tif", "");
        let found = called(files, "r.tif", folders);
        let lie_in = |path: &&PathBuf| path.parent().is_some_and(|at| at.ends_with(folders));
        for path in all.iter().filter(lie_in) {
            assert!(found.contains(path), "{folders}: {}", path.display());
        }
        assert!(found.is_subset(&all), "{folders}: {found:?}");
    }
}

/// Whatever was seen before.
fn what_is_gone_is_not_there(root: &Path, files: &impl Files) {
    fs::remove_file(root.join("s01/r.tif")).expect("a file is removed");
    assert!(!files.is_there(Path::new("s01/r.tif")), "it is gone");
    fs::remove_dir(root.join(FOLDER)).expect("a folder is removed");
    assert!(!files.is_folder(Path::new(FOLDER)), "it is gone");
}

#[cfg(test)]
mod tests {
    use super::super::Images;
    use super::*;

    /// Files as they are, but for one thing.
    struct Wrong(Images, Kind);

    #[derive(Clone, Copy, PartialEq)]
    enum Kind {
        /// One of several is not found.
        Misses,
        /// What is found in folders must be the whole path.
        WholePaths,
        /// Names that end alike are the same.
        Ends,
        /// A folder is taken for an image.
        Folders,
        /// One is named twice.
        Twice,
    }

    impl Files for Wrong {
        fn is_there(&self, path: &Path) -> bool {
            let folder = self.1 == Kind::Folders && self.0.is_folder(path);
            folder || self.0.is_there(path)
        }

        fn is_folder(&self, path: &Path) -> bool {
            self.0.is_folder(path)
        }

        fn called(&self, name: &str, folders: &str) -> impl Iterator<Item = PathBuf> {
            let mut found: Vec<_> = self.0.called(name, folders).collect();
            match self.1 {
                Kind::Misses if found.len() > 1 => drop(found.pop()),
                Kind::WholePaths if !folders.is_empty() => {
                    found.retain(|path| path.parent() == Some(Path::new(folders)));
                }
                Kind::Ends if name == "r.tif" => found.extend(self.0.called("xr.tif", folders)),
                Kind::Twice => found.extend(found.first().cloned()),
                _ => {}
            }
            found.into_iter()
        }
    }

    fn wrong(kind: Kind) {
        let root = tempfile::tempdir().unwrap();
        let images = |root: &Path| Images::below(root).unwrap();
        check(root.path(), |root| Wrong(images(root), kind));
    }

    #[test]
    #[should_panic(expected = "r.tif")]
    fn one_that_is_missed_is_found_out() {
        wrong(Kind::Misses);
    }

    #[test]
    #[should_panic(expected = "deep/s01/raw/r.tif")]
    fn whole_paths_are_found_out() {
        wrong(Kind::WholePaths);
    }

    #[test]
    #[should_panic(expected = "xr.tif")]
    fn ends_of_names_are_found_out() {
        wrong(Kind::Ends);
    }

    #[test]
    #[should_panic(expected = "s01")]
    fn folders_are_found_out() {
        wrong(Kind::Folders);
    }

    #[test]
    #[should_panic(expected = "has one twice")]
    fn what_is_named_twice_is_found_out() {
        wrong(Kind::Twice);
    }
}
