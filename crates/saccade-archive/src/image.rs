//! Images as microscopes write them, decoded to 8-bit grey.
//!
//! What counts is what an image shows, not how it is stored: palettes and colours whose channels are
//! equal everywhere are grey, fewer bits are spread over the whole range, white-is-zero is turned
//! round. What shows colours is refused: which of them should be seen is not ours to guess.
//!
//! [`decode`] tells a file that ends early, which whoever writes it may still complete, from one
//! that is damaged and one that is of another kind: the first is waited for, the others are put
//! aside with the reason. What cannot be told: uncompressed pixels of a file whose space was set
//! aside before it was written are zeros like any others.
//!
//! Files may be hostile: no panic, and no more memory than a file of that many bytes can fill.

use std::path::{Path, PathBuf};

use sniff::Kind;

mod jpeg;
mod png;
mod sniff;
mod tiff;

#[cfg(test)]
mod tests;

/// Largest width or height \[pixels\]: 12 levels above one sub-tile, whose sums fit 32 bits.
pub const MAX_EDGE: u32 = 1 << 19;

/// Most pixels that an image is decoded to; four gigabytes.
const MAX_PIXELS: u64 = 1 << 32;

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
        assert_eq!(
            voxels.len() as u64,
            want,
            "an image of {width} x {height} has {want} voxels"
        );
        Self {
            width,
            height,
            voxels,
        }
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
    /// A pixel is not grey.
    #[error(
        "the image is in colour (red, green, blue are {rgb:?} at pixel {x}, {y}), but the volume is \
         grey; convert it to 8 bit grey, or write the channel that matters as an image of its own"
    )]
    Color {
        /// Column of the first such pixel.
        x: u32,
        /// Its row.
        y: u32,
        /// Its red, green and blue.
        rgb: [u8; 3],
    },
    /// Whole, perhaps, but of a kind that cannot be read.
    #[error("this kind of image cannot be read ({what}); convert it to an 8-bit grey TIFF or PNG")]
    Unsupported {
        /// What it is.
        what: String,
    },
    /// More pixels than memory.
    #[error("the image needs {bytes} bytes of memory; cut it into smaller tiles, or add memory")]
    Memory {
        /// Bytes of the decoded image.
        bytes: usize,
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
/// Only the first image of a file is read; alpha is ignored.
///
/// # Errors
///
/// [`ImageError`].
pub fn decode(bytes: &[u8]) -> Result<GrayImage, ImageError> {
    match sniff::kind(bytes)? {
        Kind::Tiff => tiff::decode(bytes),
        Kind::Png => png::decode(bytes),
        Kind::Jpeg => jpeg::decode(bytes),
    }
}

/// Reads and decodes a file.
///
/// # Errors
///
/// [`ImageError`].
pub fn decode_file(path: &Path) -> Result<GrayImage, ImageError> {
    let read = std::fs::read(path);
    decode(&read.map_err(|source| ImageError::Read {
        source,
        path: path.to_owned(),
    })?)
}

/// The number of pixels, if it is one that a tile can have.
fn check_size(width: u32, height: u32) -> Result<usize, ImageError> {
    let edges = 1..=MAX_EDGE;
    let pixels = u64::from(width) * u64::from(height);
    let possible = edges.contains(&width) && edges.contains(&height) && pixels <= MAX_PIXELS;
    let pixels = usize::try_from(pixels).ok().filter(|_| possible);
    pixels.ok_or_else(|| sniff::broken(format!("its size is {width} x {height} pixels")))
}

/// Zeros, or an error where memory does not suffice.
fn allocate(len: usize) -> Result<Vec<u8>, ImageError> {
    let mut voxels = Vec::new();
    let reserved = voxels.try_reserve_exact(len);
    reserved.map_err(|_| ImageError::Memory { bytes: len })?;
    voxels.resize(len, 0);
    Ok(voxels)
}

/// Farthest that red, green and blue of a grey pixel lie apart where they are stored as they are:
/// converting between colour spaces rounds.
const EXACT: u8 = 4;

/// The same for lossy storage, which keeps brightness well and colours roughly.
const LOSSY: u8 = 24;

/// Grey values of an image's interleaved ones, in place: of the first channel, or of three that are
/// `apart` at most, and of any others nothing.
fn gray(
    (width, height): (u32, u32),
    mut samples: Vec<u8>,
    channels: usize,
    apart: u8,
) -> Result<GrayImage, ImageError> {
    let pixels = samples.len() / channels;
    if channels == 2 {
        for pixel in 0..pixels {
            samples[pixel] = samples[2 * pixel];
        }
    } else if channels > 2 {
        for pixel in 0..pixels {
            let rgb = [0, 1, 2].map(|c| samples[channels * pixel + c]);
            let [r, g, b] = rgb;
            if r.max(g).max(b) - r.min(g).min(b) > apart {
                // Both are less than the image's edges.
                let place = |at: usize| u32::try_from(at).unwrap_or(u32::MAX);
                let (x, y) = (pixel % width as usize, pixel / width as usize);
                let (x, y) = (place(x), place(y));
                return Err(ImageError::Color { x, y, rgb });
            }
            // Rec. 601, in thousandths that add up to one: white stays 255.
            let [r, g, b] = rgb.map(u32::from);
            let luma = (299 * r + 587 * g + 114 * b + 500) / 1000;
            samples[pixel] = u8::try_from(luma).unwrap_or(u8::MAX);
        }
    }
    samples.truncate(pixels);
    samples.shrink_to_fit();
    Ok(GrayImage::new(width, height, samples))
}
