use std::io;

/// Why an object could not be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StorageError {
    /// There is no object of this name.
    #[error("there is no object {name:?} in the archive; it was never written, or was deleted")]
    NotFound {
        /// As asked for.
        name: String,
    },
    /// No space left. What was there before is untouched.
    #[error("no space is left to write; free some, then try again: {path}")]
    Full {
        /// What the system said.
        source: io::Error,
        /// File or object.
        path: String,
    },
    /// The system forbids it.
    #[error(
        "access is denied; check the owner and permissions, and that the disk is not mounted read-only: {path}"
    )]
    Denied {
        /// What the system said.
        source: io::Error,
        /// File or object.
        path: String,
    },
    /// A name that no object can have: the caller's mistake.
    #[error("{name:?} cannot name an object: {reason}")]
    Name {
        /// As asked for.
        name: String,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// Anything else; see the source. The same request may succeed later.
    #[error("reading or writing failed; check the disk or the network, then try again: {path}")]
    Io {
        /// What the system said.
        source: io::Error,
        /// File or object.
        path: String,
    },
}

impl StorageError {
    /// Sorts what the system said into the caller's cases.
    pub(crate) fn new(source: io::Error, name: &str, path: String) -> Self {
        match source.kind() {
            io::ErrorKind::NotFound => Self::NotFound {
                name: name.to_owned(),
            },
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                Self::Full { source, path }
            }
            io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem => {
                Self::Denied { source, path }
            }
            _ => Self::Io { source, path },
        }
    }

    /// Whether the same request may succeed later without anyone changing the request.
    pub fn is_transient(&self) -> bool {
        matches!(self, Self::Full { .. } | Self::Io { .. })
    }
}
