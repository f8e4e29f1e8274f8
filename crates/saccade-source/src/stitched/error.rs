use saccade_archive::catalog::CatalogError;
use saccade_archive::pyramid::PyramidError;
use saccade_archive::storage::StorageError;
use saccade_core::volume::Dtype;

/// Why a block, or the part of it that a tile covers, could not be built.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StitchError {
    /// The catalog could not be read.
    #[error("the tiles of a section could not be looked up")]
    Catalog {
        /// What went wrong.
        source: CatalogError,
    },
    /// A tile's pyramid could not be read.
    #[error("a tile of section {section} could not be read")]
    Tile {
        /// What went wrong, with the file.
        source: PyramidError,
        /// Where the tile is seen.
        section: u32,
    },
    /// A tile's pyramid is not there, and has not come for a while.
    #[error(
        "the pyramid of a tile of section {section} is missing; `saccade check ARCHIVE --repair --acquisition FOLDER` has it made \
         anew: {name}"
    )]
    Missing {
        /// Where the tile is seen.
        section: u32,
        /// The file.
        name: String,
    },
    /// A tile's pyramid is not of the size that the catalog says.
    #[error(
        "the pyramid is of {got} pixels, the catalog says {expected}; append the tile's \
         record to its acquisition once more: {name}"
    )]
    Size {
        /// As the catalog says \[pixels\].
        expected: glam::UVec2,
        /// Of the pyramid \[pixels\].
        got: glam::UVec2,
        /// The file.
        name: String,
    },
    /// A tile's pyramid has values of another type than its volume.
    #[error(
        "the pyramid is of {} bits, its volume of {}; append the tile's record to its acquisition once \
         more, and ingest makes it anew: {name}",
        8 * got.bytes(), 8 * expected.bytes()
    )]
    Dtype {
        /// Of the volume.
        expected: Dtype,
        /// Of the pyramid.
        got: Dtype,
        /// The file.
        name: String,
    },
    /// A tile's pyramid is that of another tile.
    #[error(
        "the pyramid was made for another tile; `saccade check ARCHIVE --repair --acquisition FOLDER` has it made anew: {name}"
    )]
    Mistaken {
        /// The file.
        name: String,
    },
    /// A tile's pyramid is shorter than its index says.
    #[error(
        "the pyramid ends early; append the tile's record to its acquisition \
         once more, and ingest makes it anew: {name}"
    )]
    Cut {
        /// The file.
        name: String,
    },
    /// The runtime that does the work has ended, or building panicked.
    #[error("building stopped")]
    Stopped {
        /// How.
        source: tokio::task::JoinError,
    },
}

impl StitchError {
    /// What is wrong and how to mend it, without saying where the archive is: for those who only look.
    pub fn without_place(&self) -> String {
        match self {
            Self::Catalog { source } => format!("{self}: {}", source.without_place()),
            Self::Tile {
                source: PyramidError::Storage { source, name },
                section,
            } => match source {
                StorageError::NotFound { .. } => format!(
                    "the pyramid of a tile of section {section} is missing; `saccade check ARCHIVE --repair --acquisition FOLDER` \
                     has it made anew: {name}"
                ),
                other => format!("{self}: {}: {name}", other.without_place()),
            },
            Self::Tile { source, .. } => format!("{self}: {source}"),
            Self::Missing { .. }
            | Self::Size { .. }
            | Self::Dtype { .. }
            | Self::Mistaken { .. }
            | Self::Cut { .. }
            | Self::Stopped { .. } => self.to_string(),
        }
    }

    /// The pyramid that is not there, if that is what is wrong.
    pub(super) fn missing(&self) -> Option<&str> {
        match self {
            Self::Tile {
                source:
                    PyramidError::Storage {
                        source: StorageError::NotFound { .. },
                        name,
                    },
                ..
            } => Some(name),
            _ => None,
        }
    }

    /// Whether a tile's pyramid is not as it should be; else what holds the tiles cannot be used, or there is
    /// no time.
    pub(super) fn is_damage(&self) -> bool {
        match self {
            Self::Tile {
                source: PyramidError::Storage { source, .. },
                ..
            } => !source.is_outage() && !source.is_shortage(),
            Self::Tile { .. }
            | Self::Missing { .. }
            | Self::Size { .. }
            | Self::Dtype { .. }
            | Self::Mistaken { .. }
            | Self::Cut { .. } => true,
            Self::Catalog { .. } | Self::Stopped { .. } => false,
        }
    }

    /// Whether the same request may succeed later, without the tile being ingested again.
    pub fn is_transient(&self) -> bool {
        match self {
            Self::Catalog { source } => source.is_transient(),
            Self::Tile {
                source:
                    PyramidError::Storage {
                        source: StorageError::NoFile { .. },
                        ..
                    },
                ..
            } => false,
            // A file that is not there may be on its way; the catalog named it.
            Self::Tile { source, .. } => matches!(source, PyramidError::Storage { .. }),
            Self::Missing { .. }
            | Self::Size { .. }
            | Self::Dtype { .. }
            | Self::Mistaken { .. }
            | Self::Cut { .. }
            | Self::Stopped { .. } => false,
        }
    }
}
