//! Tiles packed with LZW, unpacked before the decoder sees them.
//!
//! The decoder reads a tile row by row, and its LZW then loses what is left in its buffer once the input
//! has ended: files that libtiff and tifffile write seem to end early (image-tiff, issue 395). Unpacked in
//! one piece, the same streams are whole. So such a file becomes one without compression, in memory.

use std::io::{Read, Seek, SeekFrom};

use tiff::decoder::Decoder;
use tiff::tags::{ByteOrder, Tag};
use weezl::BitOrder;

use super::sort;
use crate::image::sniff::{broken, incomplete};
use crate::image::{ImageError, allocate};

const LZW: u64 = 5;
const LONG8: u16 = 16;

/// Tags that say how to read pixels, beside those of where they are and how they are packed.
const KEPT: [u16; 11] = [256, 257, 258, 262, 277, 284, 317, 322, 323, 338, 339];

/// Bytes that tiles may have more than their image: those at its edges reach beyond it.
const ROOM: usize = 1 << 20;

/// The file without compression, if it is one of tiles packed with LZW. Its image has `pixels` bytes.
pub(super) fn unpacked(
    decoder: &mut Decoder<impl Read + Seek>,
    pixels: usize,
) -> Result<Option<Vec<u8>>, ImageError> {
    let mut values = |tag: u16| {
        let values = decoder.find_tag_unsigned_vec::<u64>(Tag::from_u16_exhaustive(tag));
        Ok::<_, ImageError>(values.map_err(sort)?.unwrap_or_default())
    };
    let (offsets, lens) = (values(324)?, values(325)?);
    if values(259)? != [LZW] || offsets.is_empty() || offsets.len() != lens.len() {
        return Ok(None);
    }
    let mut tags = Vec::new();
    for tag in KEPT {
        let values = values(tag)?;
        if !values.is_empty() {
            tags.push((tag, values));
        }
    }
    let one = |tag| {
        let (_, values) = tags.iter().find(|(t, _)| *t == tag)?;
        usize::try_from(*values.first()?).ok()
    };
    let samples = one(277).unwrap_or(1);
    let bits = one(258).unwrap_or(1);
    let row = || one(322)?.checked_mul(bits.checked_mul(samples)?);
    let tile = || row()?.div_ceil(8).checked_mul(one(323)?);
    let tile = tile().ok_or_else(|| broken("its tiles have no size"))?;
    let total = tile.checked_mul(offsets.len());
    let total = total.filter(|&total| total / 8 <= pixels.saturating_add(ROOM));
    let total = total.ok_or_else(|| broken("its tiles are far larger than its image"))?;

    let mut data = allocate::<u8>(total)?;
    for ((offset, len), to) in offsets.iter().zip(lens).zip(data.chunks_exact_mut(tile)) {
        let mut packed = Vec::new();
        let file = decoder.inner();
        let read = file.seek(SeekFrom::Start(*offset));
        read.and_then(|_| file.take(len).read_to_end(&mut packed))
            .map_err(|e| sort(e.into()))?;
        let mut lzw = weezl::decode::Decoder::with_tiff_size_switch(BitOrder::Msb, 8);
        let mut unpacked = 0;
        // The decoder stops between blocks of codes.
        let mut rest = &packed[..];
        while unpacked < to.len() {
            let done = lzw.decode_bytes(rest, &mut to[unpacked..]);
            unpacked += done.consumed_out;
            rest = &rest[done.consumed_in..];
            done.status.map_err(broken)?;
            if done.consumed_out == 0 && done.consumed_in == 0 {
                return Err(incomplete("a tile ends early"));
            }
        }
    }
    written(decoder.byte_order(), tags, &data, tile).map(Some)
}

/// A `BigTIFF` of these tags, and of tiles of `tile` bytes.
fn written(
    order: ByteOrder,
    mut tags: Vec<(u16, Vec<u64>)>,
    data: &[u8],
    tile: usize,
) -> Result<Vec<u8>, ImageError> {
    let short = |v: u16| match order {
        ByteOrder::LittleEndian => v.to_le_bytes(),
        ByteOrder::BigEndian => v.to_be_bytes(),
    };
    let long8 = |v: u64| match order {
        ByteOrder::LittleEndian => v.to_le_bytes(),
        ByteOrder::BigEndian => v.to_be_bytes(),
    };
    let first = 16_u64;
    let starts = (0..data.len() / tile).map(|n| first + (n * tile) as u64);
    tags.push((259, vec![1]));
    tags.push((324, starts.collect()));
    tags.push((325, vec![tile as u64; data.len() / tile]));
    tags.sort_unstable();
    let directory = first + data.len() as u64;
    let mut file = match order {
        ByteOrder::LittleEndian => b"II".to_vec(),
        ByteOrder::BigEndian => b"MM".to_vec(),
    };
    let room = file.try_reserve_exact(data.len() + 24 * tags.len() + 16 * data.len() / tile + 64);
    room.map_err(|_| ImageError::Memory { bytes: data.len() })?;
    for value in [43, 8, 0] {
        file.extend(short(value));
    }
    file.extend(long8(directory));
    file.extend_from_slice(data);
    file.extend(long8(tags.len() as u64));
    let mut values_at = directory + 8 + 20 * tags.len() as u64 + 8;
    let mut values_after = Vec::new();
    for (tag, values) in tags {
        file.extend(short(tag));
        file.extend(short(LONG8));
        file.extend(long8(values.len() as u64));
        if let [value] = *values {
            file.extend(long8(value));
        } else {
            file.extend(long8(values_at));
            values_at += 8 * values.len() as u64;
            values_after.extend(values.into_iter().flat_map(long8));
        }
    }
    file.extend(long8(0));
    file.extend(values_after);
    Ok(file)
}
