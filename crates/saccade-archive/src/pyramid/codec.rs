//! One sub-tile's voxels to bytes and back.

use std::cell::RefCell;

use flate2::{Compress, Compression, Decompress, FlushCompress, FlushDecompress, Status};
use turbojpeg::{Compressor, Decompressor, Image, PixelFormat, Subsamp};

use saccade_core::volume::Dtype;

use super::voxel::pixel::Pixel;
use super::{EncodeError, Encoding, SUB_TILE_EDGE, SUB_TILE_VOXELS};

const EDGE: usize = SUB_TILE_EDGE as usize;

/// Room for the largest JPEG stream: libjpeg's own bound, with a good margin.
const JPEG_ROOM: usize = 4 * SUB_TILE_VOXELS;

/// What the JPEG streams of all sub-tiles have in common.
///
/// Without optimised Huffman tables, everything before a stream's entropy-coded data depends on the
/// size and quality alone. The tables are stored once, in the file's `JPEGTables`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct JpegHeaders {
    /// As the encoder writes it.
    full: Vec<u8>,
    /// Without tables: what each sub-tile begins with.
    short: Vec<u8>,
    /// Start, tables, end: the tag's value.
    pub(super) tables: Vec<u8>,
}

impl JpegHeaders {
    /// Splits the header of a whole JPEG stream.
    fn of(stream: &[u8]) -> Option<Self> {
        let mut short = stream.get(..2).filter(|soi| *soi == [0xff, 0xd8])?.to_vec();
        let mut tables = short.clone();
        let mut at = 2;
        loop {
            let &[0xff, marker, high, low] = stream.get(at..at + 4)? else {
                return None;
            };
            let end = at + 2 + usize::from(u16::from_be_bytes([high, low]));
            let segment = stream.get(at..end)?;
            match marker {
                0xdb | 0xc4 => tables.extend_from_slice(segment),
                // An application's header says nothing that the TIFF does not.
                0xe0..=0xef => {}
                _ => short.extend_from_slice(segment),
            }
            at = end;
            if marker == 0xda {
                tables.extend_from_slice(&[0xff, 0xd9]);
                return Some(Self {
                    full: stream[..at].to_vec(),
                    short,
                    tables,
                });
            }
        }
    }
}

/// Encodes sub-tiles, one after another.
pub(super) enum Encoder {
    Jpeg {
        compressor: Compressor,
        headers: JpegHeaders,
        stream: Vec<u8>,
    },
    Lossless {
        compressor: Compress,
        differences: Vec<u8>,
    },
}

impl Encoder {
    pub(super) fn new(encoding: &Encoding, dtype: Dtype) -> Result<Self, EncodeError> {
        match *encoding {
            Encoding::Jpeg { .. } if dtype != Dtype::Uint8 => Err(EncodeError::JpegDepth),
            Encoding::Jpeg { quality } => {
                let failed = |source| EncodeError::Jpeg { source };
                let mut compressor = Compressor::new().map_err(failed)?;
                compressor.set_quality(quality.into()).map_err(failed)?;
                compressor.set_subsamp(Subsamp::Gray).map_err(failed)?;
                let blank = [0; SUB_TILE_VOXELS];
                let stream = compressor
                    .compress_to_vec(image(&blank, EDGE))
                    .map_err(failed)?;
                let headers = JpegHeaders::of(&stream).ok_or(EncodeError::Headers)?;
                Ok(Self::Jpeg {
                    compressor,
                    headers,
                    stream: vec![0; JPEG_ROOM],
                })
            }
            Encoding::Lossless => Ok(Self::Lossless {
                compressor: Compress::new(Compression::fast(), true),
                differences: vec![0; SUB_TILE_VOXELS * dtype.bytes()],
            }),
        }
    }

    /// The value of the file's `JPEGTables`, if it has one.
    pub(super) fn tables(&self) -> Option<&[u8]> {
        match self {
            Self::Jpeg { headers, .. } => Some(&headers.tables),
            Self::Lossless { .. } => None,
        }
    }

    /// The bytes of a blank sub-tile.
    pub(super) fn blank<T: Pixel>(&mut self) -> Result<Vec<u8>, EncodeError> {
        let mut blank = Vec::new();
        self.encode(&[T::default(); SUB_TILE_VOXELS], EDGE, &mut blank)?;
        Ok(blank)
    }

    /// Appends a sub-tile's bytes to `to`. Its rows are `pitch` voxels apart.
    pub(super) fn encode<T: Pixel>(
        &mut self,
        voxels: &[T],
        pitch: usize,
        to: &mut Vec<u8>,
    ) -> Result<(), EncodeError> {
        match self {
            Self::Jpeg {
                compressor,
                headers,
                stream,
            } => {
                let voxels = T::bytes(voxels).ok_or(EncodeError::JpegDepth)?;
                let written = compressor.compress_to_slice(image(voxels, pitch), stream);
                let written = written.map_err(|source| EncodeError::Jpeg { source })?;
                let data = stream[..written].strip_prefix(&*headers.full);
                to.extend_from_slice(&headers.short);
                to.extend_from_slice(data.ok_or(EncodeError::Headers)?);
            }
            Self::Lossless {
                compressor,
                differences,
            } => {
                let rows = differences.chunks_exact_mut(EDGE * T::DTYPE.bytes());
                for (to, row) in rows.zip(voxels.chunks(pitch)) {
                    T::differences(&row[..EDGE], to);
                }
                compressor.reset();
                // More than deflate's bound, so that one call finishes.
                to.reserve(differences.len() + differences.len() / 8 + 64);
                match compressor.compress_vec(differences, to, FlushCompress::Finish) {
                    Ok(Status::StreamEnd) => {}
                    Ok(_) | Err(_) => return Err(EncodeError::Deflate),
                }
            }
        }
        Ok(())
    }
}

fn image(voxels: &[u8], pitch: usize) -> Image<&[u8]> {
    Image {
        pixels: voxels,
        width: EDGE,
        pitch,
        height: EDGE,
        format: PixelFormat::GRAY,
    }
}

/// Decodes an abbreviated JPEG stream with the tables of its file.
pub(super) fn decode_jpeg(tables: &[u8], bytes: &[u8], to: &mut [u8]) -> Result<(), String> {
    thread_local! {
        // Kept, because making a decoder costs as much as decoding a sub-tile.
        static DECODER: RefCell<Option<(Decompressor, Vec<u8>)>> = const { RefCell::new(None) };
    }
    let (Some(tables), Some(bytes)) = (
        tables.strip_suffix(&[0xff, 0xd9]),
        bytes.strip_prefix(&[0xff, 0xd8]),
    ) else {
        return Err("a JPEG stream has no beginning".to_owned());
    };
    DECODER.with_borrow_mut(|decoder| {
        let (decoder, stream) = match decoder {
            Some(decoder) => decoder,
            None => decoder.insert((Decompressor::new().map_err(text)?, Vec::new())),
        };
        stream.clear();
        stream.extend_from_slice(tables);
        stream.extend_from_slice(bytes);
        let header = decoder.read_header(stream).map_err(text)?;
        if (header.width, header.height) != (EDGE, EDGE) {
            return Err(format!(
                "a sub-tile is {} x {} pixels",
                header.width, header.height
            ));
        }
        if header.subsamp != Subsamp::Gray || header.is_progressive {
            return Err("a sub-tile is not a grey baseline JPEG".to_owned());
        }
        let format = PixelFormat::GRAY;
        let image = Image {
            pixels: to,
            width: EDGE,
            pitch: EDGE,
            height: EDGE,
            format,
        };
        decoder.decompress(stream, image).map_err(text)
    })
}

fn text(e: turbojpeg::Error) -> String {
    e.to_string()
}

/// Decodes a deflated sub-tile with horizontal differences to little-endian voxels.
pub(super) fn decode_lossless(dtype: Dtype, bytes: &[u8], to: &mut [u8]) -> Result<(), String> {
    let mut decoder = Decompress::new(true);
    let status = decoder.decompress(bytes, to, FlushDecompress::Finish);
    let status = status.map_err(|e| e.to_string())?;
    if status != Status::StreamEnd || decoder.total_out() != to.len() as u64 {
        return Err("a deflate stream has the wrong length".to_owned());
    }
    for row in to.chunks_exact_mut(EDGE * dtype.bytes()) {
        match dtype {
            Dtype::Uint16 => {
                let mut value = 0_u16;
                for voxel in row.as_chunks_mut::<2>().0 {
                    value = value.wrapping_add(u16::from_le_bytes(*voxel));
                    *voxel = value.to_le_bytes();
                }
            }
            _ => {
                let mut value = 0_u8;
                for voxel in row {
                    value = value.wrapping_add(*voxel);
                    *voxel = value;
                }
            }
        }
    }
    Ok(())
}
