//! Numbers of a chunk, from its bytes.

#[cfg(not(target_family = "wasm"))]
#[path = "decode/jpeg_native.rs"]
mod jpeg;
#[cfg(target_family = "wasm")]
#[path = "decode/jpeg_wasm.rs"]
mod jpeg;

use std::io::Cursor;

use bytes::Bytes;
use glam::UVec3;
use image::codecs::png::PngDecoder;
use image::{ExtendedColorType, ImageDecoder};
use serde::{Deserialize, Serialize};

use super::info::Encoding;
use crate::codecs::{Codec, Damage};
use crate::values::Number;

/// What was done with the numbers of a chunk.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Packing {
    pub(super) encoding: Encoding,
    pub(super) shape: Shape,
    /// Whether they were compressed by gzip once more, and what may come out of that \[bytes\].
    pub(super) zipped: Option<usize>,
}

impl Packing {
    /// Numbers in the order x, y, z, channel, the first fastest, little-endian.
    pub(crate) fn unpack(&self, mut bytes: Bytes) -> Result<Bytes, Damage> {
        if let Some(most) = self.zipped {
            bytes = Codec::Gzip.decode(bytes, most)?;
        }
        decode(self.encoding, self.shape, bytes)
    }
}

/// What a chunk should hold.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Shape {
    /// \[voxels\]
    pub(super) size: UVec3,
    pub(super) channels: u32,
    pub(super) number: Number,
}

impl Shape {
    fn voxels(self) -> usize {
        self.size.as_usizevec3().element_product()
    }

    /// Bytes of all its numbers.
    pub(super) fn bytes(self) -> usize {
        self.voxels() * self.channels as usize * self.number.bytes()
    }
}

fn decode(encoding: Encoding, shape: Shape, mut bytes: Bytes) -> Result<Bytes, Damage> {
    let want = shape.bytes();
    // Stores that compress in transport are copied to folders as they are.
    let zipped = bytes.starts_with(&[0x1f, 0x8b, 8]);
    if zipped && !(encoding == Encoding::Raw && bytes.len() == want) {
        bytes = Codec::Gzip.decode(bytes, want + want / 4 + (64 << 10))?;
    }
    match encoding {
        Encoding::Raw => {}
        Encoding::Jpeg => bytes = jpeg::decode(&bytes, shape)?,
        Encoding::Png => {
            let decoder = PngDecoder::new(Cursor::new(&*bytes));
            bytes = picture(decoder.map_err(damage)?, shape)?;
        }
        Encoding::CompressedSegmentation(block) => bytes = segmentation(&bytes, shape, block)?,
    }
    if bytes.len() == want {
        Ok(bytes)
    } else {
        Err(format!(
            "it has {} bytes of voxels instead of {want}",
            bytes.len()
        ))
    }
}

fn damage(error: impl std::fmt::Display) -> Damage {
    format!("its picture does not decode: {error}")
}

/// Whether a picture has as many pixels as a chunk has voxels.
fn check_pixels(width: u64, height: u64, shape: Shape) -> Result<(), Damage> {
    if width.checked_mul(height) == Some(shape.voxels() as u64) {
        return Ok(());
    }
    let voxels = shape.size;
    Err(format!(
        "its picture has {width} x {height} pixels for {voxels} voxels"
    ))
}

/// Pixels of a picture, channel after channel.
fn picture(decoder: impl ImageDecoder, shape: Shape) -> Result<Bytes, Damage> {
    let (width, height) = decoder.dimensions();
    check_pixels(width.into(), height.into(), shape)?;
    let color = decoder.color_type();
    let (channels, width) = (usize::from(color.channel_count()), shape.number.bytes());
    let deep = matches!(ExtendedColorType::from(color).bits_per_pixel(), bits if usize::from(bits) == channels * width * 8);
    if channels != shape.channels as usize || !deep {
        return Err(format!(
            "its picture is {color:?} for {} channels of {}",
            shape.channels, shape.number
        ));
    }
    let mut mixed = vec![0; shape.bytes()];
    decoder.read_image(&mut mixed).map_err(damage)?;
    if width == 2 {
        for value in mixed.as_chunks_mut::<2>().0 {
            *value = u16::from_ne_bytes(*value).to_le_bytes();
        }
    }
    Ok(planes(mixed, channels, width))
}

/// Channel after channel, of pixels whose channels are mixed, of so many bytes each.
fn planes(mixed: Vec<u8>, channels: usize, width: usize) -> Bytes {
    if channels == 1 {
        return mixed.into();
    }
    let mut planes = Vec::with_capacity(mixed.len());
    for channel in 0..channels {
        for pixel in mixed.chunks_exact(channels * width) {
            planes.extend_from_slice(&pixel[channel * width..][..width]);
        }
    }
    planes.into()
}

/// Blocks that have a table each, and voxels that are numbers of entries in it.
fn segmentation(bytes: &[u8], shape: Shape, block: UVec3) -> Result<Bytes, Damage> {
    let (words, rest) = bytes.as_chunks::<4>();
    if !rest.is_empty() {
        return Err("its length is no multiple of 4".to_owned());
    }
    let word = |at: usize| -> Result<u32, Damage> {
        let word = words.get(at).ok_or("it points behind its end")?;
        Ok(u32::from_le_bytes(*word))
    };
    let index =
        |number: u32| usize::try_from(number).map_err(|_| "its numbers are too large".to_owned());
    let wide = shape.number.bytes() == 8;
    let [nx, ny, nz] = shape.size.to_array().map(|n| n as usize);
    let [bx, by, bz] = block.to_array().map(|n| n as usize);
    let [gx, gy] = [nx.div_ceil(bx), ny.div_ceil(by)];
    let mut numbers = vec![0; shape.bytes()];
    let width = shape.number.bytes();
    for channel in 0..shape.channels as usize {
        let start = index(word(channel)?)?;
        let plane = channel * nx * ny * nz;
        for z in 0..nz {
            for y in 0..ny {
                for first in (0..nx).step_by(bx) {
                    let number = ((z / bz) * gy + y / by) * gx + first / bx;
                    let head = word(start + number * 2)?;
                    let (table, bits) = (start + index(head & 0xff_ffff)?, head >> 24);
                    let values = start + index(word(start + number * 2 + 1)?)?;
                    if !matches!(bits, 0 | 1 | 2 | 4 | 8 | 16 | 32) {
                        return Err(format!("a block has {bits} bits per voxel"));
                    }
                    let mask = u32::MAX.unbounded_shr(32 - bits);
                    let row = ((z % bz) * by + y % by) * bx;
                    let to = plane + (z * ny + y) * nx + first;
                    let count = bx.min(nx - first);
                    let to = &mut numbers[to * width..][..count * width];
                    for (n, to) in to.chunks_exact_mut(width).enumerate() {
                        let bit = (row + n) * bits as usize;
                        let entry = match bits {
                            0 => 0,
                            _ => word(values + bit / 32)? >> (bit % 32) & mask,
                        };
                        let entry = index(entry)?;
                        if wide {
                            to[..4].copy_from_slice(&word(table + entry * 2)?.to_le_bytes());
                            to[4..].copy_from_slice(&word(table + entry * 2 + 1)?.to_le_bytes());
                        } else {
                            to.copy_from_slice(&word(table + entry)?.to_le_bytes());
                        }
                    }
                }
            }
        }
    }
    Ok(numbers.into())
}
