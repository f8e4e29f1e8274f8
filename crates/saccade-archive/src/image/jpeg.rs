//! JPEG files of 8 bits per sample.

use turbojpeg::{Colorspace, Decompressor, Image, PixelFormat};

use super::sniff::{broken, check_jpeg};
use super::{Image as Decoded, ImageError, LOSSY, Wanted, allocate_channels, check_ratio, gray};

/// Progressive files may refine the image as often as they like; this many times are enough.
const MAX_SCANS: u32 = 500;

/// Width and height.
pub(super) fn size(head: &[u8]) -> Result<[u32; 2], ImageError> {
    let mut decoder = Decompressor::new().map_err(broken)?;
    let header = decoder.read_header(head).map_err(broken)?;
    let size = |len: usize| u32::try_from(len).map_err(broken);
    Ok([size(header.width)?, size(header.height)?])
}

pub(super) fn decode(bytes: &[u8], wanted: Wanted) -> Result<Decoded, ImageError> {
    let bits = check_jpeg(bytes)?;
    if wanted.labels {
        return Err(ImageError::Unsupported {
            what: "labels in a JPEG, which keeps numbers only roughly".to_owned(),
        });
    }
    if bits != 8 {
        let volume = 8 * u32::try_from(wanted.dtype.bytes()).unwrap_or(1);
        return Err(ImageError::Depth { bits, volume });
    }
    let mut decoder = Decompressor::new().map_err(broken)?;
    decoder.set_scan_limit(MAX_SCANS).map_err(broken)?;
    let header = decoder.read_header(bytes).map_err(broken)?;
    let size = |len: usize| u32::try_from(len).map_err(broken);
    let (width, height) = (size(header.width)?, size(header.height)?);
    let pixels = wanted.check_size(width, height)?;
    /// A block of 64 pixels takes two bits at least; runs of empty ones take less in refining
    /// scans, but the first still names each row of blocks.
    const MAX_RATIO: usize = 1 << 15;
    check_ratio("JPEG", bytes.len(), pixels, MAX_RATIO)?;
    let (format, channels) = match header.colorspace {
        Colorspace::Gray => (PixelFormat::GRAY, 1),
        Colorspace::YCbCr | Colorspace::RGB => (PixelFormat::RGB, 3),
        Colorspace::CMYK | Colorspace::YCCK => {
            return Err(ImageError::Unsupported {
                what: "a JPEG of four printing colours".to_owned(),
            });
        }
    };
    let mut voxels = allocate_channels(pixels * channels, channels)?;
    let image = Image {
        pixels: &mut voxels[..],
        width: header.width,
        pitch: header.width * channels,
        height: header.height,
        format,
    };
    decoder.decompress(bytes, image).map_err(broken)?;
    wanted.of_8(gray((width, height), voxels, channels, LOSSY)?)
}
