//! Which image a list means: lists name folders of other machines, or none.
//!
//! [`Seeker`] finds it among [`Files`], which are those [below a folder](Images) as it lies, or what a watch knows of one. What else the
//! list [`Mentions`] tells whether an image that lies elsewhere can be another one's. All three speak of paths by their ends,
//! since those are what two machines have in common.

pub mod conformance;
mod ends;
mod images;
mod mentions;
mod paths;
mod seeker;

use std::path::{Path, PathBuf};

pub use ends::Ends;
pub use images::Images;
pub use mentions::Mentions;
pub use paths::{key, names};
pub use seeker::{NotTaken, Seeker};

/// What is found under a name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Sought {
    /// The image, below the root.
    There(PathBuf),
    /// Images in several folders, of which the list does not say which one it means; two of them.
    Several([PathBuf; 2]),
    /// No image.
    Missing,
}

/// The files below a root.
pub trait Files {
    /// Whether a file lies at a path below the root.
    fn is_there(&self, path: &Path) -> bool;

    /// Where files of a name may lie, below the root: at least all that lie in folders whose last parts are `folders`, such as
    /// `s01/raw`; all of them where that is empty.
    fn called(&self, name: &str, folders: &str) -> impl Iterator<Item = PathBuf>;

    /// Whether a folder lies at a path below the root.
    fn is_folder(&self, path: &Path) -> bool;

    /// Whether an image that lies elsewhere can be what a list calls `file`, as far as its path alone tells.
    fn can_be(&self, _path: &Path, _file: &str) -> bool {
        true
    }
}
