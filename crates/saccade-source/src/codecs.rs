//! Compressions of bytes that other programs' chunks come in.
//!
//! Each decoder is told how much may come out, and stops there: what claims to be more is refused before
//! memory is taken. The same code serves natively and in browsers, except for zstd.

mod blosc;
mod blosc_lz;
#[cfg(not(target_family = "wasm"))]
#[path = "codecs/zstd_native.rs"]
mod zstd;
#[cfg(target_family = "wasm")]
#[path = "codecs/zstd_wasm.rs"]
mod zstd;

use std::io::Read;

use bytes::Bytes;
use serde::{Deserialize, Serialize};

/// A compression, or a checksum.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Codec {
    /// With a header and a checksum.
    Gzip,
    /// The same compression with less around it.
    Zlib,
    Zstd,
    /// Version 1, of any of its compressions but snappy.
    Blosc,
    /// A block of LZ4 behind its length, as numcodecs has it.
    Lz4,
    /// Four bytes behind the others.
    Crc32c,
}

/// Why bytes are not what they should be, in words.
pub(crate) type Damage = String;

impl Codec {
    /// Undoes it. No more than `most` bytes come out.
    pub(crate) fn decode(self, bytes: Bytes, most: usize) -> Result<Bytes, Damage> {
        match self {
            Self::Gzip => read(flate2::read::MultiGzDecoder::new(&*bytes), most),
            Self::Zlib => read(flate2::read::ZlibDecoder::new(&*bytes), most),
            Self::Zstd => zstd::decode(&bytes, most),
            Self::Blosc => blosc::decode(bytes, most),
            Self::Lz4 => lz4(&bytes, most),
            Self::Crc32c => checked(bytes),
        }
    }
}

/// All that a reader has, if it is no more than so many bytes.
pub(crate) fn read(reader: impl Read, most: usize) -> Result<Bytes, Damage> {
    let mut bytes = Vec::new();
    let read = reader.take(most as u64 + 1).read_to_end(&mut bytes);
    read.map_err(|error| format!("it does not decompress: {error}"))?;
    if bytes.len() > most {
        return Err(too_much(most));
    }
    Ok(bytes.into())
}

pub(crate) fn too_much(most: usize) -> Damage {
    format!("it decompresses to more than the {most} bytes that it can need")
}

fn lz4(bytes: &[u8], most: usize) -> Result<Bytes, Damage> {
    let (length, block) = bytes.split_first_chunk().ok_or("it is too short")?;
    let length = u32::from_le_bytes(*length) as usize;
    if length > most {
        return Err(too_much(most));
    }
    let mut decoded = vec![0; length];
    lz4_into(block, &mut decoded)?;
    Ok(decoded.into())
}

fn lz4_into(block: &[u8], decoded: &mut [u8]) -> Result<(), Damage> {
    match lz4_flex::block::decompress_into(block, decoded) {
        Ok(count) if count == decoded.len() => Ok(()),
        Ok(count) => Err(format!(
            "{count} bytes come out instead of {}",
            decoded.len()
        )),
        Err(error) => Err(format!("it does not decompress: {error}")),
    }
}

fn checked(bytes: Bytes) -> Result<Bytes, Damage> {
    let (_, sum) = bytes
        .split_last_chunk()
        .ok_or("it is too short for its checksum")?;
    let content = bytes.slice(..bytes.len() - 4);
    if crc32c::crc32c(&content) == u32::from_le_bytes(*sum) {
        Ok(content)
    } else {
        Err("its checksum (crc32c) does not fit".to_owned())
    }
}
