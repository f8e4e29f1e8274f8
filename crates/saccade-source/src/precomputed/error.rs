use std::sync::Arc;

use crate::objects::ObjectError;
use crate::stored::PieceError;

/// Why a precomputed volume cannot be opened.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PrecomputedError {
    /// The metadata cannot be read.
    #[error("the metadata cannot be read")]
    Read {
        /// What went wrong.
        source: Arc<ObjectError>,
    },
    /// There is no volume.
    #[error("there is no info, so it is no precomputed volume: {location}")]
    NoVolume {
        /// Folder or address.
        location: String,
    },
    /// Metadata that are no JSON, or say what cannot be.
    #[error("the metadata make no sense: {reason}: {location}")]
    Metadata {
        /// What is wrong.
        reason: String,
        /// File or address.
        location: String,
    },
    /// A volume of another kind.
    #[error("this cannot be shown: {reason}: {location}")]
    Unsupported {
        /// What is not supported, and what would be.
        reason: String,
        /// File or address.
        location: String,
    },
    /// The voxels by which to choose how wide values are shown cannot be read.
    #[error("its values cannot be looked at, which is needed to show them in 16 bit")]
    Sample {
        /// What went wrong.
        source: PieceError,
    },
}

/// What is wrong with metadata, before it is known where they are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Refusal {
    /// They say what cannot be.
    Wrong(String),
    /// They say what is not supported.
    Unsupported(String),
}

impl Refusal {
    pub(super) fn at(self, location: String) -> PrecomputedError {
        match self {
            Self::Wrong(reason) => PrecomputedError::Metadata { reason, location },
            Self::Unsupported(reason) => PrecomputedError::Unsupported { reason, location },
        }
    }
}
