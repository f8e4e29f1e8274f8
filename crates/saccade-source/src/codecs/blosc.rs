//! Blosc, version 1: blocks, each compressed in one piece or one per byte of its elements, and shuffled.
//!
//! The format is told in c-blosc's README_CHUNK_FORMAT.rst.

use bytes::Bytes;

use super::{Damage, blosc_lz, lz4_into, read, too_much, zstd};

const HEADER: usize = 16;
const SHUFFLED: u8 = 1;
const COPIED: u8 = 2;
const BIT_SHUFFLED: u8 = 4;
const NOT_SPLIT: u8 = 16;
/// Blocks are compressed in as many pieces as an element has bytes, up to so many.
const MOST_SPLITS: usize = 16;
/// And only if the pieces have so many bytes.
const LEAST_SPLIT: usize = 128;

/// What a header says.
struct Header {
    flags: u8,
    element: usize,
    length: usize,
    block: usize,
}

fn number(bytes: &[u8], at: usize) -> Result<usize, Damage> {
    let four = bytes.get(at..).and_then(|rest| rest.first_chunk());
    let number = u32::from_le_bytes(*four.ok_or("it is too short")?);
    usize::try_from(number).map_err(|_| "its numbers are too large".to_owned())
}

impl Header {
    fn read(bytes: &[u8], most: usize) -> Result<Self, Damage> {
        let [version, _, flags, element, ..] = *bytes else {
            return Err("it is too short".to_owned());
        };
        let header = Self {
            flags,
            element: usize::from(element).max(1),
            length: number(bytes, 4)?,
            block: number(bytes, 8)?,
        };
        if number(bytes, 12)? != bytes.len() {
            let (told, got) = (number(bytes, 12)?, bytes.len());
            return Err(format!("it has {got} bytes, and says {told}"));
        }
        if version > 2 {
            return Err(format!(
                "it is of blosc's format {version}, and up to 2 are known"
            ));
        }
        if header.length > most {
            return Err(too_much(most));
        }
        Ok(header)
    }
}

pub(super) fn decode(bytes: Bytes, most: usize) -> Result<Bytes, Damage> {
    let header = Header::read(&bytes, most)?;
    if header.flags & COPIED != 0 {
        if bytes.len() != HEADER + header.length {
            return Err("its lengths do not fit".to_owned());
        }
        return Ok(bytes.slice(HEADER..));
    }
    if header.length == 0 {
        return Ok(Bytes::new());
    }
    if header.block == 0 {
        return Err("its blocks are empty".to_owned());
    }
    let mut decoded = vec![0; header.length];
    let block = header.block.min(header.length);
    let mut shuffled = vec![0; block];
    for (n, to) in decoded.chunks_mut(block).enumerate() {
        let start = number(&bytes, HEADER + n * 4)?;
        let whole = to.len() == header.block;
        let shuffles = (header.flags & SHUFFLED != 0 && header.element > 1)
            || (header.flags & BIT_SHUFFLED != 0 && to.len() >= header.element);
        if shuffles {
            let from = &mut shuffled[..to.len()];
            block_into(&bytes, start, &header, whole, from)?;
            if header.flags & SHUFFLED != 0 {
                unshuffle(from, to, header.element);
            } else {
                unshuffle_bits(from, to, header.element);
            }
        } else {
            block_into(&bytes, start, &header, whole, to)?;
        }
    }
    Ok(decoded.into())
}

/// Decompresses one block.
fn block_into(
    bytes: &[u8],
    mut at: usize,
    header: &Header,
    whole: bool,
    to: &mut [u8],
) -> Result<(), Damage> {
    let split = header.flags & NOT_SPLIT == 0
        && header.element <= MOST_SPLITS
        && header.block / header.element >= LEAST_SPLIT
        && whole;
    let pieces = if split { header.element } else { 1 };
    if !to.len().is_multiple_of(pieces) {
        return Err("its blocks do not split".to_owned());
    }
    let piece = to.len() / pieces;
    for to in to.chunks_mut(piece) {
        let length = number(bytes, at)?;
        at += 4;
        let from = at.checked_add(length).and_then(|end| bytes.get(at..end));
        let from = from.ok_or("a block ends behind its end")?;
        at += length;
        if length == piece {
            to.copy_from_slice(from);
            continue;
        }
        match header.flags >> 5 {
            0 => blosc_lz::decode_into(from, to)?,
            1 => lz4_into(from, to)?,
            3 => {
                let decoded = read(flate2::read::ZlibDecoder::new(from), to.len())?;
                if decoded.len() != to.len() {
                    return Err("a block is too short".to_owned());
                }
                to.copy_from_slice(&decoded);
            }
            4 => zstd::decode_into(from, to)?,
            other => {
                return Err(format!(
                    "its compression {other} is not known (snappy is 2)"
                ));
            }
        }
    }
    Ok(())
}

/// First bytes of all elements, second bytes, and so on, become elements.
fn unshuffle(from: &[u8], to: &mut [u8], element: usize) {
    let count = from.len() / element;
    match element {
        2 => unshuffle_of::<2>(from, to, count),
        4 => unshuffle_of::<4>(from, to, count),
        8 => unshuffle_of::<8>(from, to, count),
        _ => {
            for byte in 0..element {
                let plane = &from[byte * count..][..count];
                for (to, from) in to[byte..].iter_mut().step_by(element).zip(plane) {
                    *to = *from;
                }
            }
        }
    }
    let rest = count * element;
    to[rest..].copy_from_slice(&from[rest..]);
}

fn unshuffle_of<const N: usize>(from: &[u8], to: &mut [u8], count: usize) {
    let planes: [&[u8]; N] = std::array::from_fn(|byte| &from[byte * count..][..count]);
    for (n, to) in to.as_chunks_mut::<N>().0.iter_mut().enumerate().take(count) {
        *to = planes.map(|plane| plane[n]);
    }
}

/// First bits of all elements, second bits, and so on, become elements. Blocks whose count of elements
/// 8 does not divide are not shuffled.
fn unshuffle_bits(from: &[u8], to: &mut [u8], element: usize) {
    let count = from.len() / element;
    if !count.is_multiple_of(8) {
        to.copy_from_slice(from);
        return;
    }
    let row = count / 8;
    for byte in 0..element {
        let rows: [&[u8]; 8] = std::array::from_fn(|bit| &from[(byte * 8 + bit) * row..][..row]);
        for group in 0..row {
            let bits = u64::from_le_bytes(rows.map(|row| row[group]));
            for (n, value) in transposed(bits).to_le_bytes().into_iter().enumerate() {
                to[(group * 8 + n) * element + byte] = value;
            }
        }
    }
    let rest = count * element;
    to[rest..].copy_from_slice(&from[rest..]);
}

/// An 8 x 8 matrix of bits, transposed (Warren, Hacker's Delight, section 7-3).
fn transposed(mut bits: u64) -> u64 {
    for (shift, mask) in [
        (7, 0x00aa_00aa_00aa_00aa),
        (14, 0x0000_cccc_0000_cccc),
        (28, 0x0000_0000_f0f0_f0f0),
    ] {
        let swapped = (bits ^ (bits >> shift)) & mask;
        bits ^= swapped ^ (swapped << shift);
    }
    bits
}

#[cfg(test)]
mod tests {
    use super::transposed;

    #[test]
    fn bits_are_transposed() {
        for row in 0..8 {
            for column in 0..8 {
                assert_eq!(transposed(1 << (row * 8 + column)), 1 << (column * 8 + row));
            }
        }
    }
}
