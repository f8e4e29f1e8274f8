//! TIFF files: strips or tiles; no compression, LZW, deflate, `PackBits` or JPEG.
//!
//! The decoder below turns white-is-zero round itself, whatever the bits; a test holds it to that.

use std::io::{self, Read, Seek};

use tiff::decoder::{Decoder, Limits};
use tiff::tags::Tag;
use tiff::{ColorType, TiffError};

mod lzw;
pub(super) mod pages;

use super::sniff::{HEAD, broken, incomplete};
use super::{EXACT, Gray, Image, ImageError, Wanted, allocate, allocate_channels, gray};

/// What a file is read from.
trait ReadSeek: Read + Seek {}

impl<T: Read + Seek> ReadSeek for T {}

/// Decodes a file of `len` bytes, from its beginning on.
pub(super) fn decode(
    file: impl Read + Seek,
    len: u64,
    wanted: Wanted,
) -> Result<Image, ImageError> {
    decode_page(&mut open(file, len)?, len, wanted)
}

/// Opens a file of `len` bytes, from its beginning on, at its first page.
fn open<R: Read + Seek>(mut file: R, len: u64) -> Result<Decoder<R>, ImageError> {
    let mut head = Vec::new();
    let read = file.by_ref().take(HEAD).read_to_end(&mut head);
    read.and_then(|_| file.rewind())
        .map_err(|e| sort(e.into()))?;
    check_header(&head)?;
    let stored = usize::try_from(len).unwrap_or(usize::MAX);
    let mut limits = Limits::default();
    // What a file holds is no longer than the file; the image is given its memory below.
    limits.ifd_value_size = stored;
    limits.intermediate_buffer_size = stored;
    limits.decoding_buffer_size = stored.max(1 << 20);
    Ok(Decoder::new(file).map_err(sort)?.with_limits(limits))
}

/// What a page says of its pixels, once it was found possible.
struct Page {
    width: u32,
    height: u32,
    /// Bits of a sample.
    bits: u8,
    channels: usize,
    /// Bytes of a row.
    row: usize,
    /// Bytes of all rows.
    len: usize,
}

/// Looks whether the page where the decoder is can be decoded from a file of `len` bytes, before memory is set aside
/// for it.
fn check_page(
    decoder: &mut Decoder<impl Read + Seek>,
    len: u64,
    wanted: Wanted,
) -> Result<Page, ImageError> {
    let (width, height) = decoder.dimensions().map_err(sort)?;
    wanted.check_size(width, height)?;
    check_samples(decoder)?;
    let (channels, bits) = match decoder.colortype().map_err(sort)? {
        ColorType::Gray(bits @ (1 | 2 | 4 | 8 | 16)) => (1, bits),
        ColorType::RGB(bits @ (8 | 16)) => (3, bits),
        ColorType::RGBA(bits @ (8 | 16)) => (4, bits),
        ColorType::Gray(bits)
        | ColorType::RGB(bits)
        | ColorType::RGBA(bits)
        | ColorType::Multiband {
            bit_depth: bits @ 9..,
            ..
        } => {
            wanted.check(bits.into())?;
            return Err(unsupported(format!("a TIFF of {bits} bits per sample")));
        }
        ColorType::Multiband { num_samples, .. } => {
            return Err(unsupported(format!("a TIFF of {num_samples} channels")));
        }
        other => return Err(unsupported(format!("TIFF colours {other:?}"))),
    };
    wanted.check(bits.into())?;
    if wanted.labels && channels > 1 {
        return Err(unsupported("labels in several channels"));
    }
    check_data(decoder, len)?;
    let layout = decoder.image_buffer_layout().map_err(sort)?;
    // Rows begin on whole bytes.
    let row = (width as usize * channels * usize::from(bits)).div_ceil(8);
    if layout.len != row * height as usize || layout.complete_len != layout.len {
        return Err(unsupported("a TIFF of several planes"));
    }
    check_ratio(usize::try_from(len).unwrap_or(usize::MAX), layout.len)?;
    Ok(Page {
        width,
        height,
        bits,
        channels,
        row,
        len: layout.len,
    })
}

/// Decodes the page where the decoder is.
fn decode_page(
    decoder: &mut Decoder<impl Read + Seek>,
    len: u64,
    wanted: Wanted,
) -> Result<Image, ImageError> {
    let page = check_page(decoder, len, wanted)?;
    let (width, height, channels) = (page.width, page.height, page.channels);
    if let Some(plain) = lzw::unpacked(decoder, page.len)? {
        let len = plain.len() as u64;
        // By name: a type that contains itself has no end.
        let plain: Box<dyn ReadSeek> = Box::new(io::Cursor::new(plain));
        return decode(plain, len, wanted);
    }
    if page.bits == 16 {
        let mut samples = allocate_channels::<u16>(page.len / 2, channels)?;
        // In this machine's order of bytes.
        decoder
            .read_image_bytes(bytemuck::cast_slice_mut(&mut samples))
            .map_err(sort)?;
        let image = gray((width, height), samples, channels, EXACT)?;
        return Ok(Image::Uint16(image));
    }
    let mut samples = allocate_channels::<u8>(page.len, channels)?;
    decoder.read_image_bytes(&mut samples).map_err(sort)?;
    if page.bits < 8 {
        let bits = usize::from(page.bits);
        // Spread over 0 to 255, exactly; labels stay the numbers that they are.
        let scale = if wanted.labels {
            1
        } else {
            u8::MAX / (u8::MAX >> (8 - bits))
        };
        let mut voxels = allocate::<u8>(width as usize * height as usize)?;
        unpack(&samples, page.row, width as usize, bits, scale, &mut voxels);
        return wanted.of_8(Gray::of(width, height, voxels));
    }
    wanted.of_8(gray((width, height), samples, channels, EXACT)?)
}

/// Width and height.
pub(super) fn size(file: impl Read + Seek) -> Result<[u32; 2], ImageError> {
    let mut decoder = Decoder::new(file).map_err(sort)?;
    let (width, height) = decoder.dimensions().map_err(sort)?;
    Ok([width, height])
}

/// Bits of a sample.
pub(super) fn bits(file: impl Read + Seek) -> Result<u32, ImageError> {
    let mut decoder = Decoder::new(file).map_err(sort)?;
    let color = decoder.colortype().map_err(sort)?;
    Ok(color.bit_depth().into())
}

/// Samples of 1, 2 or 4 bits, the first in the highest bits, times `scale`.
pub(super) fn unpack(
    packed: &[u8],
    row: usize,
    width: usize,
    bits: usize,
    scale: u8,
    to: &mut [u8],
) {
    let per_byte = 8 / bits;
    let most = u8::MAX >> (8 - bits);
    for (packed, to) in packed.chunks_exact(row).zip(to.chunks_exact_mut(width)) {
        for (x, voxel) in to.iter_mut().enumerate() {
            let shift = (per_byte - 1 - x % per_byte) * bits;
            *voxel = ((packed[x / per_byte] >> shift) & most) * scale;
        }
    }
}

/// Refuses what the decoder below would read as something else than it is, or not explain.
fn check_samples(decoder: &mut Decoder<impl Read + Seek>) -> Result<(), ImageError> {
    let mut value = |tag| {
        let values = decoder.find_tag_unsigned_vec::<u64>(tag).map_err(sort)?;
        Ok::<_, ImageError>(values.and_then(|values| values.first().copied()))
    };
    if value(Tag::PhotometricInterpretation)? == Some(3) {
        return Err(unsupported("a TIFF with a palette"));
    }
    // 1 is unsigned, 4 undefined.
    if value(Tag::SampleFormat)?.is_some_and(|format| format != 1 && format != 4) {
        return Err(unsupported("signed or floating-point numbers"));
    }
    if value(Tag::FillOrder)?.is_some_and(|order| order != 1) {
        return Err(unsupported("a TIFF with the bits of its bytes reversed"));
    }
    Ok(())
}

fn unsupported(what: impl Into<String>) -> ImageError {
    ImageError::Unsupported { what: what.into() }
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
fn check_data(decoder: &mut Decoder<impl Read + Seek>, len: u64) -> Result<(), ImageError> {
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
    super::check_ratio("TIFF", stored, pixels, MAX_RATIO)
}

fn sort(e: TiffError) -> ImageError {
    match e {
        TiffError::IoError(e) if e.kind() == io::ErrorKind::UnexpectedEof => {
            incomplete("it ends early")
        }
        // A share that fails for a moment; the pixels themselves are never told this way.
        TiffError::IoError(e) if e.raw_os_error().is_some() => incomplete(e.to_string()),
        TiffError::UnsupportedError(e) => unsupported(e.to_string()),
        e => broken(e),
    }
}
