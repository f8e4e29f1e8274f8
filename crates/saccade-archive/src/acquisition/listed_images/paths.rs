//! Paths as lists write them, and how much they are like those of files.

use std::hash::{BuildHasher, BuildHasherDefault, DefaultHasher};
use std::path::{Component, Path, PathBuf};

use super::super::image_path;
use super::super::tile_list::{base, decoded};

/// Folders before an image's name that are compared at most. What differs only before them is not told apart.
pub(super) const MOST_FOLDERS: usize = 8;

/// The hash by which a name or path is known.
pub fn key(name: &str) -> u64 {
    BuildHasherDefault::<DefaultHasher>::default().hash_one(name)
}

/// A path's parts from its end on, however they are separated, without those that mean nothing.
fn parts(file: &str) -> impl Iterator<Item = &str> {
    let parts = file.rsplit(['/', '\\']);
    parts.filter(|part| !matches!(*part, "" | "."))
}

/// A path's last part and so many folders before it; `None` if there are not so many.
pub(super) fn tail(file: &str, folders: usize) -> Option<String> {
    let mut parts: Vec<_> = parts(file).take(folders + 1).collect();
    parts.reverse();
    (parts.len() > folders).then(|| parts.join("/"))
}

/// The folder that a list names for an image, in one spelling; `None` if it names none.
pub(super) fn folder_of(file: &str) -> Option<String> {
    let mut folders: Vec<_> = parts(file).skip(1).collect();
    folders.reverse();
    (!folders.is_empty()).then(|| folders.join("/"))
}

/// How many folders two paths have in common from their ends on.
pub(super) fn likeness(path: &Path, file: &str) -> usize {
    let folders = path.components().rev().skip(1);
    let both = folders.zip(parts(file).skip(1));
    both.take_while(|(folder, named)| folder.as_os_str() == *named)
        .count()
}

/// The path below the root that a list names, in one spelling; `None` if it leads out.
pub(super) fn path_of(file: &str) -> Option<PathBuf> {
    let path = image_path(Path::new(""), file)?;
    let parts = { path.components() }.filter(|part| !matches!(part, Component::CurDir));
    Some(parts.collect())
}

/// Whether a file is called as an image of a list is.
pub(super) fn is_named(path: &Path, file: &str) -> bool {
    path.file_name().is_some_and(|name| name == base(file))
}

/// The names that the image may have which a list calls `file`: as it is written, and as it is meant if that is part of a
/// URL.
pub fn names(file: &str) -> impl Iterator<Item = String> {
    let meant = decoded(file).map(|decoded| base(&decoded).to_owned());
    let meant = meant.filter(|name| name != base(file));
    [base(file).to_owned()].into_iter().chain(meant)
}
