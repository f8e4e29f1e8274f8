//! The mipmap of one tile, cut into sub-tiles, as a TIFF file.

use std::ops::Range;
use std::sync::Arc;

use bytes::Bytes;
use glam::UVec2;

use crate::image::GrayImage;
use crate::storage::{Storage, StorageError};

/// Edge of a sub-tile \[pixels\].
pub const SUB_TILE_EDGE: u32 = 128;
/// Voxels of a sub-tile, padding included.
pub const SUB_TILE_VOXELS: usize = (SUB_TILE_EDGE * SUB_TILE_EDGE) as usize;

/// How sub-tiles are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Encoding {
    /// JPEG of this quality, 1 to 100.
    Jpeg {
        /// As of libjpeg.
        quality: u8,
    },
    /// Deflate: every voxel comes back as it was.
    Lossless,
}

/// Size of one level of a pyramid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PyramidLevel {
    /// Pixels along x.
    pub width: u32,
    /// Pixels along y.
    pub height: u32,
    /// Sub-tiles along x and y.
    pub sub_tiles: UVec2,
}

/// Where a sub-tile is and what values it has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SubTileEntry {
    /// First byte in the file.
    pub offset: u64,
    /// Bytes; 0 if blank.
    pub len: u32,
    /// Smallest value.
    pub min: u8,
    /// Largest value.
    pub max: u8,
    /// Mean value, rounded.
    pub mean: u8,
}

impl SubTileEntry {
    /// Whether every voxel is 0: there is nothing to read.
    pub fn is_blank(&self) -> bool {
        self.max == 0
    }
}

/// One read that fetches several sub-tiles.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SubTileRead {
    /// What to read of the file.
    pub range: Range<u64>,
    /// Sub-tiles it holds, and where in the bytes read.
    pub sub_tiles: Vec<(UVec2, Range<usize>)>,
}

/// Why a pyramid could not be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PyramidError {
    /// The storage failed; see the source.
    #[error("a pyramid could not be read")]
    Storage {
        /// What went wrong.
        #[from]
        source: StorageError,
    },
    /// The file is not a pyramid, or damaged.
    #[error("the pyramid is damaged ({reason}); delete it and ingest the tile again: {name}")]
    Broken {
        /// What is wrong.
        reason: String,
        /// The object.
        name: String,
    },
    /// There is no such sub-tile: the caller's mistake.
    #[error("the pyramid has no sub-tile {x}, {y} of level {level}: {name}")]
    OutOfRange {
        /// Level.
        level: usize,
        /// Column.
        x: u32,
        /// Row.
        y: u32,
        /// The object.
        name: String,
    },
}

/// A pyramid's index: where its sub-tiles are, and their values' ranges.
#[derive(Clone, Debug)]
pub struct PyramidIndex {
    name: Arc<str>,
    levels: Vec<PyramidLevel>,
}

impl PyramidIndex {
    /// Reads the index with one or two range reads.
    ///
    /// # Errors
    ///
    /// [`PyramidError`].
    pub async fn open(storage: &dyn Storage, name: &str) -> Result<Self, PyramidError> {
        let _ = storage;
        Err(PyramidError::Broken { reason: String::new(), name: name.to_owned() })
    }

    /// Sizes of the levels, the finest first; at least one.
    pub fn levels(&self) -> &[PyramidLevel] {
        &self.levels
    }

    /// The entry of a sub-tile; `None` for no such sub-tile.
    pub fn sub_tile(&self, level: usize, x: u32, y: u32) -> Option<SubTileEntry> {
        let _ = (level, x, y);
        None
    }

    /// The reads that fetch these sub-tiles of a level, blank ones left out.
    pub fn reads(
        &self,
        level: usize,
        sub_tiles: impl IntoIterator<Item = UVec2>,
        gap: u64,
    ) -> Vec<SubTileRead> {
        let _ = (level, sub_tiles.into_iter().count(), gap);
        Vec::new()
    }

    /// Decodes a sub-tile from the bytes its entry names, to [`SUB_TILE_VOXELS`] values.
    ///
    /// # Errors
    ///
    /// [`PyramidError::Broken`] or [`PyramidError::OutOfRange`].
    pub fn decode_sub_tile(
        &self,
        level: usize,
        x: u32,
        y: u32,
        bytes: &[u8],
    ) -> Result<Vec<u8>, PyramidError> {
        let _ = bytes;
        Err(PyramidError::OutOfRange { level, x, y, name: self.name.to_string() })
    }
}

/// Why an image could not be made into a pyramid.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// No pixels, or more than fit.
    #[error("an image of {width} x {height} pixels cannot be stored; edges may be 1 to {} pixels", crate::image::MAX_EDGE)]
    Size {
        /// Pixels along x.
        width: u32,
        /// Pixels along y.
        height: u32,
    },
    /// The JPEG encoder refused.
    #[error("the JPEG encoder failed; choose a quality from 1 to 100")]
    Jpeg {
        /// What it said.
        source: turbojpeg::Error,
    },
}

/// Makes the pyramid of an image, as the bytes of a TIFF file. Runs on rayon's threads.
///
/// # Errors
///
/// [`EncodeError`].
pub fn encode(image: &GrayImage, encoding: &Encoding) -> Result<Bytes, EncodeError> {
    let _ = encoding;
    Err(EncodeError::Size { width: image.width, height: image.height })
}
