//! Telling a folder from another that takes its place.

use std::fs::Metadata;

/// Which folder it is, as long as its disk stays mounted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FolderId {
    /// Number of the file system.
    pub device: u64,
    /// Number of the folder there.
    pub number: u64,
}

impl FolderId {
    /// As the system says.
    #[cfg(unix)]
    pub(super) fn of(metadata: &Metadata) -> Option<Self> {
        use std::os::unix::fs::MetadataExt as _;
        Some(Self {
            device: metadata.dev(),
            number: metadata.ino(),
        })
    }

    /// This system says nothing of the kind.
    #[cfg(not(unix))]
    pub(super) fn of(_: &Metadata) -> Option<Self> {
        None
    }
}
