//! PNG files of 8 bits per sample or less.

use std::io::{self, Cursor};

use png::{BitDepth, ColorType, Decoder, DecodingError, Transformations};

use super::sniff::{broken, check_png, incomplete};
use super::{EXACT, GrayImage, ImageError, allocate, check_size, gray};

pub(super) fn decode(bytes: &[u8]) -> Result<GrayImage, ImageError> {
    check_png(bytes)?;
    let mut decoder = Decoder::new(Cursor::new(bytes));
    // Palettes become colours, fewer bits become eight.
    decoder.set_transformations(Transformations::EXPAND);
    let mut reader = decoder.read_info().map_err(sort)?;
    let (width, height) = (reader.info().width, reader.info().height);
    let pixels = check_size(width, height)?;
    let (color, depth) = reader.output_color_type();
    if depth != BitDepth::Eight {
        return Err(ImageError::Depth { bits: depth as u32 });
    }
    let channels = match color {
        ColorType::Grayscale => 1,
        ColorType::GrayscaleAlpha => 2,
        ColorType::Rgb => 3,
        ColorType::Rgba => 4,
        ColorType::Indexed => return Err(broken("it has no palette")),
    };
    /// Deflate's bound is 1032.
    const MAX_RATIO: usize = 2048;
    let len = pixels * channels;
    if reader.output_buffer_size() != Some(len) || len / MAX_RATIO > bytes.len() {
        return Err(broken(format!(
            "{} bytes cannot hold {pixels} pixels",
            bytes.len()
        )));
    }
    let mut voxels = allocate(len)?;
    reader.next_frame(&mut voxels).map_err(sort)?;
    gray((width, height), voxels, channels, EXACT)
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
