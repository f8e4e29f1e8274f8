//! PNG files of up to 16 bits per sample.

use std::io::{self, Cursor};

use png::{BitDepth, ColorType, Decoder, DecodingError, Transformations};

use super::sniff::{broken, check_png, incomplete};
use super::tiff::unpack;
use super::{
    EXACT, Gray, Image, ImageError, Wanted, allocate, allocate_channels, check_ratio, gray,
};

pub(super) fn decode(bytes: &[u8], wanted: Wanted) -> Result<Image, ImageError> {
    check_png(bytes)?;
    // The decoder's own limits would not tell which.
    let [width, height] = size(bytes)?;
    wanted.check_size(width, height)?;
    let mut decoder = Decoder::new(Cursor::new(bytes));
    // Palettes become colours, fewer bits become eight; labels stay the numbers that they are.
    decoder.set_transformations(if wanted.labels {
        Transformations::IDENTITY
    } else {
        Transformations::EXPAND
    });
    let mut reader = decoder.read_info().map_err(sort)?;
    let (width, height) = (reader.info().width, reader.info().height);
    let pixels = wanted.check_size(width, height)?;
    let (color, depth) = reader.output_color_type();
    let bits = depth as usize;
    wanted.check(depth as u32)?;
    let channels = match color {
        ColorType::Grayscale => 1,
        ColorType::Indexed if wanted.labels => 1,
        _ if wanted.labels => {
            let what = "labels in several channels".to_owned();
            return Err(ImageError::Unsupported { what });
        }
        ColorType::GrayscaleAlpha => 2,
        ColorType::Rgb => 3,
        ColorType::Rgba => 4,
        ColorType::Indexed => return Err(broken("it has no palette")),
    };
    /// Deflate's bound is 1032.
    const MAX_RATIO: usize = 2048;
    // Rows begin on whole bytes.
    let row = (width as usize * channels * bits).div_ceil(8);
    let len = row * height as usize;
    check_ratio("PNG", bytes.len(), len, MAX_RATIO)?;
    if reader.output_buffer_size() != Some(len) {
        return Err(broken(format!("its rows do not make {pixels} pixels")));
    }
    if depth == BitDepth::Sixteen {
        let mut samples = allocate_channels::<u16>(pixels * channels, channels)?;
        reader
            .next_frame(bytemuck::cast_slice_mut(&mut samples))
            .map_err(sort)?;
        for sample in &mut *samples {
            *sample = u16::from_be(*sample);
        }
        let image = gray((width, height), samples, channels, EXACT)?;
        return Ok(Image::Uint16(image));
    }
    let mut voxels = allocate_channels::<u8>(len, channels)?;
    reader.next_frame(&mut voxels).map_err(sort)?;
    if bits < 8 {
        // Only labels come as few bits.
        let mut labels = allocate::<u8>(pixels)?;
        unpack(&voxels, row, width as usize, bits, 1, &mut labels);
        return wanted.of_8(Gray::of(width, height, labels));
    }
    wanted.of_8(gray((width, height), voxels, channels, EXACT)?)
}

/// Width and height: of the first chunk, which is the header.
pub(super) fn size(head: &[u8]) -> Result<[u32; 2], ImageError> {
    match head.get(12..24) {
        Some(&[b'I', b'H', b'D', b'R', a, b, c, d, e, f, g, h]) => Ok([
            u32::from_be_bytes([a, b, c, d]),
            u32::from_be_bytes([e, f, g, h]),
        ]),
        Some(_) => Err(broken("its header is missing")),
        None => Err(incomplete("it ends within its header")),
    }
}

/// Bits of a sample: after the size.
pub(super) fn bits(head: &[u8]) -> Result<u32, ImageError> {
    size(head)?;
    let bits = head.get(24).copied().map(u32::from);
    bits.ok_or_else(|| incomplete("it ends within its header"))
}

fn sort(e: DecodingError) -> ImageError {
    match e {
        DecodingError::IoError(e) if e.kind() == io::ErrorKind::UnexpectedEof => {
            // All chunks are there, so nothing more will come.
            broken("its pixels end early")
        }
        DecodingError::IoError(e) => incomplete(e.to_string()),
        e => broken(e),
    }
}
