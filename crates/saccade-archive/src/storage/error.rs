use std::io;

/// What is said of a store that has no such bucket.
pub(super) const NO_BUCKET: &str =
    "there is no such bucket; make it first, or check its name and AWS_ENDPOINT_URL";

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
    /// A folder has the name that the file is to have.
    #[error(
        "a folder lies where a file is to be written, and is left as it is; take it away: {path}"
    )]
    Occupied {
        /// The folder.
        path: String,
    },
    /// A named pipe, a socket or a device has the name of an object.
    #[error(
        "what lies in the place of a file is none, but a named pipe, a socket or a device, of which nothing is read; take it away: \
         {path}"
    )]
    NoFile {
        /// What is there.
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
    /// The disk did not keep what was written. Nothing more is written until someone has looked at it
    /// and started anew; what was acknowledged before is not affected.
    #[error(
        "the disk could not keep what was written, and nothing more is written to it; look for disk \
         errors in the system's log, mend or replace the disk, then start again: {path}"
    )]
    NotKept {
        /// What the system said.
        source: io::Error,
        /// File or folder that was to be kept.
        path: String,
    },
    /// The folder that was opened is no longer there, or another is in its place, as where a disk was
    /// unmounted. Nothing is written to that one.
    #[error(
        "the archive's folder is not there any more, or another lies in its place, to which nothing is written; is \
         its disk mounted? Mount it again, or put the folder back, and work goes on: {path}"
    )]
    Away {
        /// The folder.
        path: String,
    },
    /// An object store refuses, and will until someone changes something.
    #[error("{advice}: {path}")]
    Refused {
        /// What the store said.
        source: Box<object_store::Error>,
        /// What is wrong, and how to mend it.
        advice: &'static str,
        /// The object, or the bucket.
        path: String,
    },
    /// An object store does not answer, or says that it is overloaded. It was asked several times.
    #[error(
        "the object store does not do its work at present; check the network and the store: {path}"
    )]
    Unavailable {
        /// What the store said, or the network.
        source: Box<object_store::Error>,
        /// The object, or the bucket.
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
            io::ErrorKind::IsADirectory => Self::Occupied { path },
            io::ErrorKind::NotSeekable => Self::NoFile { path },
            _ => Self::Io { source, path },
        }
    }

    /// What is wrong and how to mend it, without saying where the storage is: for those who only look.
    pub fn without_place(&self) -> String {
        let text = self.to_string();
        match self {
            Self::Full { path, .. }
            | Self::Denied { path, .. }
            | Self::NotKept { path, .. }
            | Self::Refused { path, .. }
            | Self::Unavailable { path, .. }
            | Self::Occupied { path }
            | Self::NoFile { path }
            | Self::Away { path }
            | Self::Io { path, .. } => text.replace(&format!(": {path}"), ""),
            Self::NotFound { .. } | Self::Name { .. } => text,
        }
    }

    /// Whether the same request may succeed later without anyone changing the request.
    pub fn is_transient(&self) -> bool {
        self.is_outage() || matches!(self, Self::Io { .. })
    }

    /// Whether the store has no such bucket.
    pub fn lacks_bucket(&self) -> bool {
        matches!(self, Self::Refused { advice, .. } if *advice == NO_BUCKET)
    }

    /// Whether this process, or the system, has too many files open: nothing is wrong with what was asked for.
    pub fn is_shortage(&self) -> bool {
        // EMFILE, ENFILE: the same on all systems.
        const TOO_MANY: [i32; 2] = [24, 23];
        match self {
            Self::Io { source, .. } => {
                { source.raw_os_error() }.is_some_and(|n| TOO_MANY.contains(&n))
            }
            _ => false,
        }
    }

    /// Whether nothing but waiting helps, however long: the disk is full or not mounted, the object store is away.
    pub fn is_outage(&self) -> bool {
        matches!(
            self,
            Self::Full { .. } | Self::Away { .. } | Self::Unavailable { .. }
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn too_many_open_files_are_no_damage() {
        let error = |number| {
            let source = io::Error::from_raw_os_error(number);
            StorageError::new(source, "a", "/srv/a".to_owned())
        };
        // EMFILE, ENFILE; EIO, ENOENT.
        for (number, shortage) in [(24, true), (23, true), (5, false), (2, false)] {
            assert_eq!(error(number).is_shortage(), shortage, "{number}");
        }
    }
}
