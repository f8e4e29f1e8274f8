use std::path::{Path, PathBuf};

/// Why an OME-Zarr image cannot be shown, or a part of it not read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ZarrError {
    /// A file cannot be read.
    #[error("cannot read {}", path.display())]
    Read {
        /// What the system says.
        source: std::io::Error,
        /// The file.
        path: PathBuf,
    },
    /// Metadata that are no JSON, or say what cannot be.
    #[error("the metadata make no sense: {reason}: {}", path.display())]
    Metadata {
        /// What is wrong.
        reason: String,
        /// The file or folder.
        path: PathBuf,
    },
    /// An image that is of another kind.
    #[error("this cannot be shown: {reason}: {}", path.display())]
    Unsupported {
        /// What is not supported, and what would be.
        reason: String,
        /// The folder.
        path: PathBuf,
    },
    /// An array cannot be opened, or a part of it not be decoded.
    #[error("the array is damaged or of an unknown kind: {}", path.display())]
    Array {
        /// What the decoder says.
        source: Box<dyn std::error::Error + Send + Sync>,
        /// The array's folder.
        path: PathBuf,
    },
}

impl ZarrError {
    /// Whether the same may succeed later.
    pub(super) fn is_transient(&self) -> bool {
        match self {
            Self::Read { source, .. } => !matches!(
                source.kind(),
                std::io::ErrorKind::NotFound | std::io::ErrorKind::PermissionDenied
            ),
            Self::Metadata { .. } | Self::Unsupported { .. } | Self::Array { .. } => false,
        }
    }

    /// The task that worked on it ended before it was done.
    pub(super) fn interrupted(path: &Path, error: &tokio::task::JoinError) -> Self {
        Self::Array {
            source: error.to_string().into(),
            path: path.to_owned(),
        }
    }
}
