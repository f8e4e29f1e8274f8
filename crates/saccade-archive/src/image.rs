//! Images as microscopes write them, decoded to grey of 8 or 16 bits.
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
//! A volume of 8 bits refuses images of 16: which of their values matter is not ours to guess. A volume of
//! 16 bits spreads 8 over the whole range, exactly (times 257). Labels are numbers, not shades: none is
//! spread, averaged or read out of a lossy file.
//!
//! Files may be hostile: no panic, and memory is set aside only for a size that the caller expects
//! ([`Wanted::size`]), or, where none is expected, for one that a file of that many bytes can fill.
//! A TIFF is read as it is decoded, so that its pixels are in memory once; other files are read whole, and
//! refused where they are longer than [`Wanted::size`] can explain.

use std::io::{BufReader, Cursor, Read, Seek};
use std::path::{Path, PathBuf};

use bytemuck::Pod;
use bytemuck::allocation::try_zeroed_vec;
use glam::UVec2;
use saccade_core::volume::Dtype;
use sniff::Kind;

use crate::large_buffer::LargeBuffer;
use crate::pyramid::Voxel;
use crate::storage::open_regular;

mod jpeg;
mod png;
mod sniff;
mod tiff;

#[cfg(test)]
mod tests;

pub use self::tiff::pages::Pages;

/// Largest width or height \[pixels\]: 12 levels above one sub-tile, whose sums fit 32 bits.
pub const MAX_EDGE: u32 = 1 << 19;

/// Most pixels that an image is decoded to; four gigabytes.
const MAX_PIXELS: u64 = 1 << 32;

/// A grey image, or one of labels.
#[derive(Clone, PartialEq, Eq)]
pub struct Gray<T: Pod> {
    /// Pixels along x.
    pub width: u32,
    /// Pixels along y.
    pub height: u32,
    /// `width * height` values, x fastest. 0 is black.
    pub voxels: LargeBuffer<T>,
}

/// An image of 8 bits.
pub type GrayImage = Gray<u8>;

/// An image of 16 bits.
pub type GrayImage16 = Gray<u16>;

/// An image of any of the types that volumes have.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Image {
    /// 8 bits.
    Uint8(GrayImage),
    /// 16 bits.
    Uint16(GrayImage16),
}

impl Image {
    /// Width and height \[pixels\].
    pub fn size(&self) -> [u32; 2] {
        match self {
            Self::Uint8(image) => [image.width, image.height],
            Self::Uint16(image) => [image.width, image.height],
        }
    }
}

/// What the values of an image are to become.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wanted {
    /// Type of the volume's voxels.
    pub dtype: Dtype,
    /// Whether they are labels, which are kept as they are.
    pub labels: bool,
    /// The only size that will do, if it is known; another is refused before any pixel \[pixels\].
    pub size: Option<UVec2>,
}

impl Wanted {
    /// Grey of 8 bits.
    pub const GRAY_8: Self = Self {
        dtype: Dtype::Uint8,
        labels: false,
        size: None,
    };
    /// Grey of 16 bits.
    pub const GRAY_16: Self = Self {
        dtype: Dtype::Uint16,
        labels: false,
        size: None,
    };

    /// Refuses images of other bits than fit the volume.
    fn check(self, bits: u32) -> Result<(), ImageError> {
        if matches!(bits, 1 | 2 | 4 | 8) || (bits == 16 && self.dtype == Dtype::Uint16) {
            Ok(())
        } else {
            Err(ImageError::Depth {
                bits,
                volume: 8 * u32::try_from(self.dtype.bytes()).unwrap_or(1),
            })
        }
    }

    /// The number of pixels, if it is one that a tile can have, and this one.
    fn check_size(self, width: u32, height: u32) -> Result<usize, ImageError> {
        if let Some(want) = self.size
            && want != UVec2::new(width, height)
        {
            return Err(ImageError::Size {
                width,
                height,
                want,
            });
        }
        check_size(width, height)
    }

    /// The longest file, read whole, that can hold such an image \[bytes\]: four channels of 16 bits
    /// that did not compress at all, twice, and descriptions.
    fn longest_file(self) -> u64 {
        let pixels = self.size.map_or(MAX_PIXELS, |size| {
            u64::from(size.x).saturating_mul(size.y.into())
        });
        pixels.saturating_mul(16).saturating_add(64 << 20)
    }

    /// An image of 8 bits as what is wanted.
    fn of_8(self, image: GrayImage) -> Result<Image, ImageError> {
        if self.dtype == Dtype::Uint8 {
            return Ok(Image::Uint8(image));
        }
        let scale = if self.labels { 1 } else { 257 };
        let mut voxels = allocate(image.voxels.len())?;
        for (to, &from) in voxels.iter_mut().zip(&*image.voxels) {
            *to = u16::from(from) * scale;
        }
        Ok(Image::Uint16(Gray::of(image.width, image.height, voxels)))
    }
}

impl<T: Pod> std::fmt::Debug for Gray<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let bits = 8 * size_of::<T>();
        write!(f, "Gray({} x {} x {bits} bits)", self.width, self.height)
    }
}

impl<T: Pod> Gray<T> {
    /// An image of these voxels.
    ///
    /// # Panics
    ///
    /// If there are not `width * height` of them.
    pub fn new(width: u32, height: u32, voxels: Vec<T>) -> Self {
        Self::of(width, height, voxels.into())
    }

    fn of(width: u32, height: u32, voxels: LargeBuffer<T>) -> Self {
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
    /// More bits per sample than the volume holds, or an odd number of them.
    #[error(
        "the image has {bits} bits per sample, but the volume has {volume}; convert it to {volume} bit \
         grey, or say another \"dtype\" in the volume.json of a new acquisition"
    )]
    Depth {
        /// Bits of one sample.
        bits: u32,
        /// Bits that the volume has.
        volume: u32,
    },
    /// Another size than the caller expects.
    #[error(
        "the image has {width} x {height} pixels, but its record says {} x {}; mend the record or the \
         image",
        want.x, want.y
    )]
    Size {
        /// Pixels along x.
        width: u32,
        /// Pixels along y.
        height: u32,
        /// What was expected \[pixels\].
        want: UVec2,
    },
    /// More pixels than any tile may have, or none.
    #[error(
        "the image says that it has {width} x {height} pixels, but tiles have 1 to {MAX_EDGE} along each edge, and \
         at most {MAX_PIXELS}; cut it into smaller tiles"
    )]
    TooLarge {
        /// Pixels along x.
        width: u32,
        /// Pixels along y.
        height: u32,
    },
    /// A file that no image of its size needs.
    #[error(
        "the file has {bytes} bytes, more than {most} that an image of its size can need; write it \
         without what else is in it"
    )]
    TooLong {
        /// Its length \[bytes\].
        bytes: u64,
        /// Most that could be \[bytes\].
        most: u64,
    },
    /// A pixel is not grey.
    #[error(
        "the image is in colour (red, green, blue are {rgb:?} at pixel {x}, {y}), but the volume is \
         grey; convert it to grey, or write the channel that matters as an image of its own"
    )]
    Color {
        /// Column of the first such pixel.
        x: u32,
        /// Its row.
        y: u32,
        /// Its red, green and blue, as they are stored.
        rgb: [u16; 3],
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

    /// Whether what should be read is a named pipe, a socket or a device, of which nothing is read.
    pub fn is_of_no_file(&self) -> bool {
        let kind = match self {
            Self::Read { source, .. } => source.kind(),
            _ => return false,
        };
        kind == std::io::ErrorKind::NotSeekable
    }
}

/// Decodes a TIFF, PNG or JPEG file, told apart by its first bytes, to grey of 8 bits.
///
/// Only the first image of a file is read, see [`Pages`] for others; alpha is ignored.
///
/// # Errors
///
/// [`ImageError`].
pub fn decode(bytes: &[u8]) -> Result<GrayImage, ImageError> {
    of_8_bits(decode_as(bytes, Wanted::GRAY_8)?)
}

/// Decodes a TIFF, PNG or JPEG file to what is wanted.
///
/// # Errors
///
/// [`ImageError`].
pub fn decode_as(bytes: &[u8], wanted: Wanted) -> Result<Image, ImageError> {
    match sniff::kind(bytes)? {
        Kind::Tiff => tiff::decode(Cursor::new(bytes), bytes.len() as u64, wanted),
        Kind::Png => png::decode(bytes, wanted),
        Kind::Jpeg => jpeg::decode(bytes, wanted),
    }
}

/// Width and height of an image \[pixels\], from its beginning; of a TIFF from its first directory.
///
/// # Errors
///
/// [`ImageError`].
pub fn read_size(path: &Path) -> Result<[u32; 2], ImageError> {
    /// Bytes that a JPEG's frame may be away from the beginning: comments and profiles come first.
    const HEADER: u64 = 1 << 20;
    let failed = |source| ImageError::Read {
        source,
        path: path.to_owned(),
    };
    let mut file = open_regular(path).map_err(failed)?;
    let mut head = Vec::new();
    let mut start = file.by_ref().take(sniff::HEAD);
    start.read_to_end(&mut head).map_err(failed)?;
    let kind = sniff::kind(&head)?;
    if kind == Kind::Tiff {
        file.rewind().map_err(failed)?;
        return tiff::size(BufReader::new(file));
    }
    file.take(HEADER).read_to_end(&mut head).map_err(failed)?;
    if kind == Kind::Png {
        png::size(&head)
    } else {
        jpeg::size(&head)
    }
}

/// Bits of an image's samples, from its beginning; of a TIFF from its first directory.
///
/// # Errors
///
/// [`ImageError`].
pub fn read_bits(path: &Path) -> Result<u32, ImageError> {
    let failed = |source| ImageError::Read {
        source,
        path: path.to_owned(),
    };
    let mut file = open_regular(path).map_err(failed)?;
    let mut head = Vec::new();
    let mut start = file.by_ref().take(sniff::HEAD);
    start.read_to_end(&mut head).map_err(failed)?;
    match sniff::kind(&head)? {
        Kind::Tiff => {
            file.rewind().map_err(failed)?;
            tiff::bits(BufReader::new(file))
        }
        Kind::Png => {
            /// Up to the byte after the size, in the first chunk.
            const HEADER: u64 = 64;
            file.take(HEADER).read_to_end(&mut head).map_err(failed)?;
            png::bits(&head)
        }
        // Of others nothing is decoded.
        Kind::Jpeg => Ok(8),
    }
}

/// Reads and decodes a file to grey of 8 bits.
///
/// # Errors
///
/// [`ImageError`].
pub fn decode_file(path: &Path) -> Result<GrayImage, ImageError> {
    of_8_bits(decode_file_as(path, Wanted::GRAY_8)?)
}

/// Reads and decodes a file to what is wanted.
///
/// # Errors
///
/// [`ImageError`].
pub fn decode_file_as(path: &Path, wanted: Wanted) -> Result<Image, ImageError> {
    let failed = |source| ImageError::Read {
        source,
        path: path.to_owned(),
    };
    let mut file = open_regular(path).map_err(failed)?;
    let len = file.metadata().map_err(failed)?.len();
    let mut head = Vec::new();
    file.by_ref()
        .take(sniff::HEAD)
        .read_to_end(&mut head)
        .map_err(failed)?;
    if sniff::kind(&head)? == Kind::Tiff {
        file.rewind().map_err(failed)?;
        return tiff::decode(BufReader::with_capacity(READ_AHEAD, file), len, wanted);
    }
    let most = wanted.longest_file();
    if len > most {
        return Err(ImageError::TooLong { bytes: len, most });
    }
    // It may still grow.
    let mut bytes = head;
    file.take(most).read_to_end(&mut bytes).map_err(failed)?;
    decode_as(&bytes, wanted)
}

fn of_8_bits(image: Image) -> Result<GrayImage, ImageError> {
    match image {
        Image::Uint8(image) => Ok(image),
        Image::Uint16(_) => Err(ImageError::Depth {
            bits: 16,
            volume: 8,
        }),
    }
}

/// Bytes of a TIFF that are read at once.
const READ_AHEAD: usize = 1 << 20;

/// The number of pixels, if it is one that a tile can have.
fn check_size(width: u32, height: u32) -> Result<usize, ImageError> {
    let edges = 1..=MAX_EDGE;
    let pixels = u64::from(width) * u64::from(height);
    let possible = edges.contains(&width) && edges.contains(&height) && pixels <= MAX_PIXELS;
    let pixels = usize::try_from(pixels).ok().filter(|_| possible);
    pixels.ok_or(ImageError::TooLarge { width, height })
}

/// Refuses sizes that so few bytes cannot hold, before memory is set aside for them. `most`: what a byte can hold.
fn check_ratio(kind: &str, stored: usize, samples: usize, most: usize) -> Result<(), ImageError> {
    if samples / most > stored {
        return Err(sniff::broken(format!(
            "{stored} bytes cannot hold the {samples} values that it says it has: {kind} packs at most {most} \
             into one"
        )));
    }
    Ok(())
}

/// Zeros, or an error where memory does not suffice.
fn allocate<T: Voxel>(len: usize) -> Result<LargeBuffer<T>, ImageError> {
    let bytes = len.saturating_mul(T::DTYPE.bytes());
    LargeBuffer::zeroed(len).ok_or(ImageError::Memory { bytes })
}

/// The same for samples of several channels, of which [`gray`] keeps a part in place.
fn allocate_channels<T: Voxel>(len: usize, channels: usize) -> Result<LargeBuffer<T>, ImageError> {
    if channels == 1 {
        return allocate(len);
    }
    let bytes = len.saturating_mul(T::DTYPE.bytes());
    let samples = try_zeroed_vec(len).map_err(|()| ImageError::Memory { bytes })?;
    Ok(samples.into())
}

/// Farthest that red, green and blue of a grey pixel lie apart where they are stored as they are, in steps of their own
/// type: converting between colour spaces rounds. A part of the range would not do: dim channels of 16 bits fit in it.
const EXACT: u8 = 4;

/// The same for lossy storage, which keeps brightness well and colours roughly.
const LOSSY: u8 = 24;

/// Grey values of an image's interleaved ones, in place: of the first channel, or of three that are
/// `apart` at most, and of any others nothing.
fn gray<T: Voxel>(
    (width, height): (u32, u32),
    samples: LargeBuffer<T>,
    channels: usize,
    apart: u8,
) -> Result<Gray<T>, ImageError> {
    if channels == 1 {
        return Ok(Gray::of(width, height, samples));
    }
    let mut samples = samples.into_vec();
    let pixels = samples.len() / channels;
    if channels == 2 {
        for pixel in 0..pixels {
            samples[pixel] = samples[2 * pixel];
        }
    } else {
        for pixel in 0..pixels {
            let rgb = [0, 1, 2].map(|c| u32::from(samples[channels * pixel + c].value()));
            let [r, g, b] = rgb;
            if r.max(g).max(b) - r.min(g).min(b) > u32::from(apart) {
                // Both are less than the image's edges.
                let place = |at: usize| u32::try_from(at).unwrap_or(u32::MAX);
                let (x, y) = (pixel % width as usize, pixel / width as usize);
                let (x, y) = (place(x), place(y));
                let rgb = rgb.map(|v| u16::try_from(v).unwrap_or(u16::MAX));
                return Err(ImageError::Color { x, y, rgb });
            }
            // Rec. 601, in thousandths that add up to one: white stays white.
            let luma = (299 * r + 587 * g + 114 * b + 500) / 1000;
            samples[pixel] = T::from_wide(luma.into());
        }
    }
    samples.truncate(pixels);
    samples.shrink_to_fit();
    Ok(Gray::new(width, height, samples))
}
