use std::sync::Arc;

use crate::objects::ObjectError;
use crate::stored::PieceError;

/// Why an OME-Zarr image cannot be opened.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ZarrError {
    /// Metadata cannot be read.
    #[error("the metadata cannot be read")]
    Read {
        /// What went wrong.
        source: Arc<ObjectError>,
    },
    /// There is no image.
    #[error("there is neither zarr.json nor .zattrs, so it is no OME-Zarr image: {location}")]
    NoImage {
        /// Folder or address.
        location: String,
    },
    /// Metadata that are no JSON, or say what cannot be.
    #[error("the metadata make no sense: {reason}: {location}")]
    Metadata {
        /// What is wrong.
        reason: String,
        /// File, folder or address.
        location: String,
    },
    /// An image that is of another kind.
    #[error("this cannot be shown: {reason}: {location}")]
    Unsupported {
        /// What is not supported, and what would be.
        reason: String,
        /// Folder or address.
        location: String,
    },
    /// The voxels by which to choose how wide values are shown cannot be read.
    #[error("its values cannot be looked at, which is needed to show them in 16 bit")]
    Sample {
        /// What went wrong.
        source: PieceError,
    },
}

impl From<ObjectError> for ZarrError {
    fn from(source: ObjectError) -> Self {
        let source = Arc::new(source);
        Self::Read { source }
    }
}

/// What is wrong with metadata, before it is known where they are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Refusal {
    /// They say what cannot be.
    Wrong(String),
    /// They say what is not supported.
    Unsupported(String),
}

impl Refusal {
    pub(crate) fn wrong(reason: impl ToString) -> Self {
        Self::Wrong(reason.to_string())
    }

    pub(crate) fn at(self, location: String) -> ZarrError {
        match self {
            Self::Wrong(reason) => ZarrError::Metadata { reason, location },
            Self::Unsupported(reason) => ZarrError::Unsupported { reason, location },
        }
    }
}
