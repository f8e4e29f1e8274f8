use saccade_archive::ArchiveError;
use saccade_archive::acquisition::AcquisitionError;
use saccade_archive::catalog::CatalogError;
use saccade_archive::storage::StorageError;

/// Why ingest ended early. What was acknowledged is safe; starting again goes on from there.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum IngestError {
    /// The acquisition archive cannot be used.
    #[error(transparent)]
    Acquisition(#[from] AcquisitionError),
    /// The catalog cannot be used.
    #[error(transparent)]
    Catalog(#[from] CatalogError),
    /// A pyramid cannot be written.
    #[error("the pyramid of tile {tile:?} cannot be written")]
    Storage {
        /// What went wrong.
        source: StorageError,
        /// The tile.
        tile: String,
    },
    /// Whether a pyramid was written where the others lie cannot be found out.
    #[error("whether the pyramid of tile {tile:?} lies with the others cannot be found out")]
    Archive {
        /// What went wrong.
        source: Box<ArchiveError>,
        /// The tile.
        tile: String,
    },
}
