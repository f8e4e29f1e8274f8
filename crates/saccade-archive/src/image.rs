//! Images as microscopes write them, decoded to 8-bit grey.

use std::path::{Path, PathBuf};

/// Largest width or height \[pixels\]: 12 levels above one sub-tile, whose sums fit 32 bits.
pub const MAX_EDGE: u32 = 1 << 19;

/// An 8-bit grey image.
#[derive(Clone, PartialEq, Eq)]
pub struct GrayImage {
    /// Pixels along x.
    pub width: u32,
    /// Pixels along y.
    pub height: u32,
    /// `width * height` values, x fastest. 0 is black.
    pub voxels: Vec<u8>,
}

impl std::fmt::Debug for GrayImage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "GrayImage({} x {})", self.width, self.height)
    }
}

impl GrayImage {
    /// An image of these voxels.
    ///
    /// # Panics
    ///
    /// If there are not `width * height` of them.
    pub fn new(width: u32, height: u32, voxels: Vec<u8>) -> Self {
        let want = u64::from(width) * u64::from(height);
        assert_eq!(voxels.len() as u64, want, "an image of {width} x {height} has {want} voxels");
        Self { width, height, voxels }
    }
}

/// Why an image could not be decoded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
    /// The file ends early: whoever writes it may still be at it.
    #[error("the image is not complete yet: {reason}; wait until it is written, or copy it again")]
    Incomplete {
        /// What is missing.
        reason: String,
    },
    /// The file is damaged; waiting does not help.
    #[error("the image is damaged ({reason}); write or copy it again")]
    Broken {
        /// What is wrong.
        reason: String,
    },
    /// More (or fewer) bits per sample than an 8-bit volume holds.
    #[error("the image has {bits} bits per sample, but the volume has 8; convert it to 8 bit grey")]
    Depth {
        /// Bits of one sample.
        bits: u32,
    },
    /// Whole, perhaps, but of a kind that cannot be read.
    #[error("this kind of image cannot be read ({what}); convert it to an 8-bit grey TIFF or PNG")]
    Unsupported {
        /// What it is.
        what: String,
    },
    /// The file could not be read at all.
    #[error("the image cannot be read; check that it exists and may be read: {}", path.display())]
    Read {
        /// What the system said.
        source: std::io::Error,
        /// The file.
        path: PathBuf,
    },
}

impl ImageError {
    /// Whether the same file may be readable later.
    pub fn is_transient(&self) -> bool {
        matches!(self, Self::Incomplete { .. } | Self::Read { .. })
    }
}

/// Decodes a TIFF, PNG or JPEG file, told apart by its first bytes.
///
/// # Errors
///
/// [`ImageError`].
pub fn decode(bytes: &[u8]) -> Result<GrayImage, ImageError> {
    let _ = bytes;
    Err(ImageError::Unsupported { what: "not yet".to_owned() })
}

/// Reads and decodes a file.
///
/// # Errors
///
/// [`ImageError`].
pub fn decode_file(path: &Path) -> Result<GrayImage, ImageError> {
    let read = std::fs::read(path);
    decode(&read.map_err(|source| ImageError::Read { source, path: path.to_owned() })?)
}
