//! TIFF files: strips or tiles; no compression, LZW, deflate, `PackBits` or JPEG.

use std::io::{self, Cursor};

use tiff::decoder::{Decoder, Limits};
use tiff::tags::Tag;
use tiff::{ColorType, TiffError};

use super::sniff::{broken, incomplete};
use super::{GrayImage, ImageError, allocate, check_size, luma};

pub(super) fn decode(bytes: &[u8]) -> Result<GrayImage, ImageError> {
    check_header(bytes)?;
    let mut limits = Limits::default();
    // What a file holds is no longer than the file; the image is given its memory below.
    limits.ifd_value_size = bytes.len();
    limits.intermediate_buffer_size = bytes.len();
    limits.decoding_buffer_size = bytes.len().max(1 << 20);
    let mut decoder = Decoder::new(Cursor::new(bytes))
        .map_err(sort)?
        .with_limits(limits);
    let (width, height) = decoder.dimensions().map_err(sort)?;
    let pixels = check_size(width, height)?;
    let channels = match decoder.colortype().map_err(sort)? {
        ColorType::Gray(8) => 1,
        ColorType::GrayA(8) => 2,
        ColorType::RGB(8) => 3,
        ColorType::RGBA(8) => 4,
        ColorType::Gray(bits)
        | ColorType::GrayA(bits)
        | ColorType::RGB(bits)
        | ColorType::RGBA(bits) => return Err(ImageError::Depth { bits: bits.into() }),
        other => {
            return Err(ImageError::Unsupported {
                what: format!("TIFF colours {other:?}"),
            });
        }
    };
    check_data(&mut decoder, bytes.len() as u64)?;
    let layout = decoder.image_buffer_layout().map_err(sort)?;
    if layout.len != pixels * channels || layout.complete_len != layout.len {
        return Err(ImageError::Unsupported {
            what: "a TIFF of several planes".to_owned(),
        });
    }
    check_ratio(bytes.len(), layout.len)?;
    let mut voxels = allocate(layout.len)?;
    decoder.read_image_bytes(&mut voxels).map_err(sort)?;
    Ok(GrayImage::new(width, height, luma(voxels, channels)))
}

/// Writers leave the place of the first directory empty until they know it.
fn check_header(bytes: &[u8]) -> Result<(), ImageError> {
    let big = bytes.get(2..4).is_some_and(|v| v.contains(&43));
    let Some(place) = (if big {
        bytes.get(8..16)
    } else {
        bytes.get(4..8)
    }) else {
        return Err(incomplete("it ends within its header"));
    };
    if place.iter().all(|&b| b == 0) {
        return Err(incomplete("its directory has not been written"));
    }
    Ok(())
}

/// Checks that all strips or tiles lie within the file.
fn check_data(decoder: &mut Decoder<Cursor<&[u8]>>, len: u64) -> Result<(), ImageError> {
    let mut values = |tags: [Tag; 2]| {
        for tag in tags {
            if let Some(values) = decoder.find_tag_unsigned_vec::<u64>(tag).map_err(sort)? {
                return Ok(values);
            }
        }
        Err(broken("it does not say where its pixels are"))
    };
    let offsets = values([Tag::StripOffsets, Tag::TileOffsets])?;
    let lens = values([Tag::StripByteCounts, Tag::TileByteCounts])?;
    for (&offset, &count) in offsets.iter().zip(&lens) {
        if offset == 0 || count == 0 {
            return Err(incomplete("a part of its pixels has not been written"));
        }
        let end = offset
            .checked_add(count)
            .ok_or_else(|| broken("its pixels have no place"))?;
        if end > len {
            return Err(incomplete(format!(
                "its pixels end at byte {end}, the file at {len}"
            )));
        }
    }
    Ok(())
}

/// Refuses sizes that so few bytes cannot hold, before memory is set aside for them.
fn check_ratio(stored: usize, pixels: usize) -> Result<(), ImageError> {
    /// LZW packs a little more than 1:1300, deflate 1:1032; blank tiles that share one stream
    /// take 8 bytes of offset and count for 1:2048 pixels.
    const MAX_RATIO: usize = 2048;
    if pixels / MAX_RATIO > stored {
        return Err(broken(format!(
            "{stored} bytes cannot hold {pixels} pixels"
        )));
    }
    Ok(())
}

fn sort(e: TiffError) -> ImageError {
    match e {
        TiffError::IoError(e) if e.kind() == io::ErrorKind::UnexpectedEof => {
            incomplete("it ends early")
        }
        TiffError::UnsupportedError(e) => ImageError::Unsupported {
            what: e.to_string(),
        },
        e => broken(e),
    }
}
