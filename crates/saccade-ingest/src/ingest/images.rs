//! Where a record's image lies, and in which words people are told of it.

use std::path::{Path, PathBuf};

use saccade_archive::acquisition::{image_path, is_inside};

use crate::watch::file_name;

/// The images of an acquisition archive, or of a folder without records, of which a
/// [`Watch`](crate::watch::Watch) keeps some elsewhere.
#[derive(Clone, Copy, Debug)]
pub(super) struct Images<'a> {
    /// Where the records are.
    folder: &'a Path,
    /// The folder that is watched.
    watched: Option<&'a Path>,
}

impl<'a> Images<'a> {
    pub(super) fn new(folder: &'a Path, watched: Option<&'a Path>) -> Self {
        Self { folder, watched }
    }

    /// Whether the records are kept by a watch: whoever wrote the images knows nothing of them.
    pub(super) fn are_watched(&self) -> bool {
        self.watched.is_some()
    }

    /// The image that a record names, by the path that people know; `None` if the name leads out of the archive.
    pub(super) fn path(&self, file: &str) -> Option<PathBuf> {
        match self.watched {
            Some(watched) if file_name(file) != file => image_path(watched, file_name(file)),
            _ => image_path(self.folder, file),
        }
    }

    /// Whether an image lies there, wherever links on its way lead.
    pub(super) fn hold(&self, image: &Path) -> bool {
        is_inside(image, self.folder, self.watched)
    }

    /// What people call the image that a record names.
    pub(super) fn name(&self, file: &str) -> String {
        match self.watched {
            Some(_) => file_name(file).to_owned(),
            None => file.to_owned(),
        }
    }

    /// What to do once an image is as it should be, at the end of a sentence.
    pub(super) fn again(&self) -> &'static str {
        match self.watched {
            Some(_) => "rename it over this file",
            None => "append its record again",
        }
    }
}
