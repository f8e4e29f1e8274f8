use bytes::Bytes;
use turbojpeg::{Colorspace, Decompressor, Image, PixelFormat};

use super::{Damage, Shape, check_pixels, damage, planes};

/// A picture may refine itself as often as it likes; this many times are enough.
const MOST_SCANS: u32 = 500;

/// To the last bit as with other programs, most of which use the same library.
pub(super) fn decode(bytes: &[u8], shape: Shape) -> Result<Bytes, Damage> {
    let mut decoder = Decompressor::new().map_err(damage)?;
    decoder.set_scan_limit(MOST_SCANS).map_err(damage)?;
    let header = decoder.read_header(bytes).map_err(damage)?;
    check_pixels(header.width as u64, header.height as u64, shape)?;
    let (format, channels) = match header.colorspace {
        Colorspace::Gray => (PixelFormat::GRAY, 1),
        Colorspace::YCbCr | Colorspace::RGB => (PixelFormat::RGB, 3),
        Colorspace::CMYK | Colorspace::YCCK => (PixelFormat::CMYK, 4),
    };
    if (channels, 1) != (shape.channels as usize, shape.number.bytes()) {
        return Err(format!(
            "its picture has {channels} channels of 8 bits for {} channels of {}",
            shape.channels, shape.number
        ));
    }
    let mut mixed = vec![0; shape.bytes()];
    let image = Image {
        pixels: &mut mixed[..],
        width: header.width,
        pitch: header.width * channels,
        height: header.height,
        format,
    };
    decoder.decompress(bytes, image).map_err(damage)?;
    Ok(planes(mixed, channels, 1))
}

#[cfg(test)]
mod tests {
    use glam::UVec3;
    use turbojpeg::{Compressor, Subsamp};

    use super::*;
    use crate::values::Number;

    /// Busy in colour as well, whose values are stored for four pixels at a time.
    #[test]
    fn colours_are_those_of_other_programs() {
        let (width, height) = (66, 61 * 5);
        let value = |n: usize| u8::try_from((n * n / 7 + n * 13) % 241).unwrap();
        let pixels: Vec<u8> = (0..width * height * 3).map(value).collect();
        for subsampling in [Subsamp::Sub2x2, Subsamp::Sub2x1, Subsamp::None] {
            let mut encoder = Compressor::new().unwrap();
            encoder.set_subsamp(subsampling).unwrap();
            encoder.set_quality(80).unwrap();
            let image = Image {
                pixels: &pixels[..],
                width,
                pitch: width * 3,
                height,
                format: PixelFormat::RGB,
            };
            let picture = encoder.compress_to_vec(image).unwrap();
            let want = turbojpeg::decompress(&picture, PixelFormat::RGB).unwrap();
            let shape = Shape {
                size: UVec3::new(66, 61, 5),
                channels: 3,
                number: Number::U8,
            };
            let got = decode(&picture, shape).unwrap();
            let got = |pixel: usize, channel: usize| got[channel * width * height + pixel];
            for (n, pixel) in want.pixels.chunks_exact(3).enumerate() {
                assert_eq!(pixel, [got(n, 0), got(n, 1), got(n, 2)], "pixel {n}");
            }
            for (size, channels, number) in [
                (UVec3::new(66, 61, 4), 3, Number::U8),
                (UVec3::new(66, 61, 5), 1, Number::U8),
                (UVec3::new(66, 61, 5), 3, Number::U16),
            ] {
                let shape = Shape {
                    size,
                    channels,
                    number,
                };
                decode(&picture, shape).unwrap_err();
            }
            decode(&picture[..picture.len() / 2], shape).unwrap_err();
        }
    }
}
