//! The mipmap of one tile, cut into sub-tiles, as a TIFF file.
//!
//! [`encode`] makes a file's bytes from an image, [`PyramidIndex::open`] reads what is where in it,
//! [`PyramidIndex::decode_sub_tile`] gives voxels back. Nothing else knows the file's layout.
//!
//! # Voxels
//!
//! `u8` or `u16`: a pyramid has the type of its image. JPEG holds 8 bits only.
//!
//! # Levels
//!
//! Level k has `ceil(w / 2^k)` by `ceil(h / 2^k)` pixels, down to one sub-tile. A pixel is the mean
//! of the level-0 pixels it covers that exist, rounded half up once: not the mean of rounded means. Of labels
//! ([`encode_labels`]) it is the one that most of these pixels have.
//!
//! # Sub-tiles
//!
//! [`SUB_TILE_EDGE`]² pixels. Where a level ends within a sub-tile, its last column and row are
//! repeated. Decoded voxels lie within the sub-tile's `min..=max`, also after JPEG, so what is
//! culled by those bounds could not have been seen. A sub-tile whose pixels are all 0 is blank: it
//! takes no space, needs no read, and counts as not acquired, for it cannot be told from what surrounds an image that was turned.
//! Elsewhere a 0 is a measured black like any other.
//!
//! # Checksums
//!
//! Each sub-tile's bytes and the description have a CRC-32. Reading a sub-tile does not compute it;
//! [`verify`] does, of a whole file, which also knows the name of its object ([`named`]). Files from before there were checksums are read as well.
//!
//! # Failure
//!
//! A file may be damaged or hostile: reading it ends in a [`PyramidError`], never a panic, and
//! allocates no more than the file has bytes, or one sub-tile.

use glam::UVec2;

mod codec;
mod encode;
mod error;
mod filter;
mod index;
mod layout;
mod mean;
mod mode;
mod morton;
mod parse;
#[cfg(test)]
mod tests;
mod verify;
mod voxel;

pub use encode::{encode, encode_labels};
pub use error::{EncodeError, PyramidError};
pub use index::{PyramidIndex, SubTileRead};
pub use verify::{Verified, named, verify, verify_quickly};
pub use voxel::Voxel;

/// Edge of a sub-tile \[pixels\].
pub const SUB_TILE_EDGE: u32 = 128;
/// Voxels of a sub-tile, padding included.
pub const SUB_TILE_VOXELS: usize = (SUB_TILE_EDGE * SUB_TILE_EDGE) as usize;

/// How sub-tiles are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Encoding {
    /// JPEG of this quality, 1 to 100. Of 8 bits only.
    Jpeg {
        /// As libjpeg counts it. EM at 75 takes 2 to 2.5 bits per pixel, at 50 less than 2.
        quality: u8,
    },
    /// Deflated differences: every voxel comes back as it was.
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

/// The levels of an image's pyramid, the finest first.
pub fn levels_of(width: u32, height: u32) -> Vec<PyramidLevel> {
    let mut levels = Vec::new();
    let (mut width, mut height) = (width, height);
    loop {
        let sub_tiles = UVec2::new(
            width.div_ceil(SUB_TILE_EDGE),
            height.div_ceil(SUB_TILE_EDGE),
        );
        levels.push(PyramidLevel {
            width,
            height,
            sub_tiles,
        });
        if sub_tiles.max_element() <= 1 {
            return levels;
        }
        (width, height) = (width.div_ceil(2), height.div_ceil(2));
    }
}

/// Where a sub-tile is and what values it has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SubTileEntry {
    /// First byte in the file; 0 if blank.
    pub offset: u64,
    /// Bytes; 0 if blank.
    pub len: u32,
    /// Smallest value.
    pub min: u16,
    /// Largest value.
    pub max: u16,
    /// Mean value, rounded.
    pub mean: u16,
}

impl SubTileEntry {
    /// The entry of every blank sub-tile.
    pub const BLANK: Self = Self {
        offset: 0,
        len: 0,
        min: 0,
        max: 0,
        mean: 0,
    };

    /// Whether every voxel is 0: there is nothing to read.
    pub fn is_blank(&self) -> bool {
        self.max == 0
    }
}
