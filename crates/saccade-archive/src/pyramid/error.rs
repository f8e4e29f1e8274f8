use crate::image::MAX_EDGE;
use crate::storage::StorageError;

/// Why a pyramid could not be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PyramidError {
    /// The storage failed; see the source.
    #[error("a pyramid could not be read: {name}")]
    Storage {
        /// What went wrong.
        source: StorageError,
        /// The object.
        name: String,
    },
    /// The file is no pyramid, or is damaged.
    #[error(
        "the pyramid is damaged ({reason}); append the tile's record to its acquisition \
         once more, and ingest makes it anew: {name}"
    )]
    Broken {
        /// What is wrong.
        reason: String,
        /// The object.
        name: String,
    },
    /// There is no such sub-tile: the caller's mistake.
    #[error("the pyramid has no sub-tile {x}, {y} of level {level}: {name}")]
    OutOfRange {
        /// Level, 0 the finest.
        level: usize,
        /// Column.
        x: u32,
        /// Row.
        y: u32,
        /// The object.
        name: String,
    },
}

impl PyramidError {
    /// Whether the same request may succeed later.
    pub fn is_transient(&self) -> bool {
        matches!(self, Self::Storage { source, .. } if source.is_transient())
    }
}

/// Why an image could not be made into a pyramid.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// No pixels, too many, or not as many as the size says.
    #[error(
        "an image of {width} x {height} pixels and {voxels} voxels cannot be stored; \
         edges may be 1 to {MAX_EDGE} pixels long"
    )]
    Size {
        /// Pixels along x.
        width: u32,
        /// Pixels along y.
        height: u32,
        /// Voxels there are.
        voxels: usize,
    },
    /// The JPEG encoder refused.
    #[error("the JPEG encoder failed; choose a quality from 1 to 100")]
    Jpeg {
        /// What it said.
        source: turbojpeg::Error,
    },
    /// JPEG of more than 8 bits.
    #[error("JPEG holds 8 bits, the image has 16; store it losslessly, or as an image of 8 bits")]
    JpegDepth,
    /// The JPEG encoder's streams do not share their tables, as this version's do.
    #[error("the JPEG encoder writes other headers than expected; store the tiles losslessly")]
    Headers,
    /// The deflate encoder did not finish.
    #[error("the deflate encoder failed; store the tiles as JPEG")]
    Deflate,
}
