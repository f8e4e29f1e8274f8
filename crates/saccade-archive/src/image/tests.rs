#![expect(clippy::cast_possible_truncation, reason = "texture wraps")]
#![expect(clippy::print_stderr, reason = "a skipped test says so")]

use std::fs;
use std::io::Cursor;
use std::path::PathBuf;
use std::sync::LazyLock;

use ::png::{BitDepth, ColorType, Encoder};
use ::tiff::encoder::{Compression, DeflateLevel, Predictor, TiffEncoder, colortype};
use proptest::prelude::*;

use super::{GrayImage, Image, ImageError, Wanted, decode, decode_as, decode_file, sniff};

mod pages;

/// Texture with odd sides: neighbours differ, yet it compresses.
fn texture(width: u32, height: u32) -> GrayImage {
    let value = |x: u32, y: u32| (x * 7 + y * 13 + (x * y) % 11) as u8 | 1;
    let voxels = (0..height).flat_map(|y| (0..width).map(move |x| value(x, y)));
    GrayImage::new(width, height, voxels.collect())
}

fn tiff_file(image: &GrayImage, compression: Compression, predictor: Predictor) -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut file)
        .unwrap()
        .with_compression(compression)
        .with_predictor(predictor);
    let mut strips = encoder
        .new_image::<colortype::Gray8>(image.width, image.height)
        .unwrap();
    strips.rows_per_strip(7).unwrap();
    strips.write_data(&image.voxels).unwrap();
    file.into_inner()
}

fn png_file(width: u32, height: u32, color: ColorType, depth: BitDepth, data: &[u8]) -> Vec<u8> {
    let mut file = Vec::new();
    let mut encoder = Encoder::new(&mut file, width, height);
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder
        .write_header()
        .unwrap()
        .write_image_data(data)
        .unwrap();
    file
}

fn gray_png(image: &GrayImage) -> Vec<u8> {
    png_file(
        image.width,
        image.height,
        ColorType::Grayscale,
        BitDepth::Eight,
        &image.voxels,
    )
}

fn jpeg_file(image: &GrayImage, progressive: bool) -> Vec<u8> {
    let mut encoder = turbojpeg::Compressor::new().unwrap();
    encoder.set_quality(95).unwrap();
    encoder.set_subsamp(turbojpeg::Subsamp::Gray).unwrap();
    encoder.set_progressive(progressive).unwrap();
    let (width, height) = (image.width as usize, image.height as usize);
    let format = turbojpeg::PixelFormat::GRAY;
    let pixels = &image.voxels[..];
    encoder
        .compress_to_vec(turbojpeg::Image {
            pixels,
            width,
            pitch: width,
            height,
            format,
        })
        .unwrap()
}

/// A file of each kind and compression.
fn files(image: &GrayImage) -> Vec<(&'static str, Vec<u8>)> {
    let deflate = Compression::Deflate(DeflateLevel::Balanced);
    vec![
        (
            "plain TIFF",
            tiff_file(image, Compression::Uncompressed, Predictor::None),
        ),
        (
            "LZW TIFF",
            tiff_file(image, Compression::Lzw, Predictor::None),
        ),
        (
            "LZW TIFF with differences",
            tiff_file(image, Compression::Lzw, Predictor::Horizontal),
        ),
        ("deflate TIFF", tiff_file(image, deflate, Predictor::None)),
        (
            "PackBits TIFF",
            tiff_file(image, Compression::Packbits, Predictor::None),
        ),
        ("PNG", gray_png(image)),
        ("JPEG", jpeg_file(image, false)),
        ("progressive JPEG", jpeg_file(image, true)),
    ]
}

/// Files of kinds that show the same, but are decoded in other ways.
fn unusual_files(image: &GrayImage) -> Vec<(&'static str, Vec<u8>)> {
    let size = [image.width, image.height].map(|edge| u16::try_from(edge).unwrap());
    let rgb = channels(image, 3);
    let (width, height) = (image.width as usize, image.height as usize);
    let subsamp = turbojpeg::Subsamp::Sub2x2;
    let packed = &image.voxels[..usize::from(size[0]).div_ceil(2) * usize::from(size[1])];
    vec![
        ("RGB TIFF", rgb_tiff(image.width, image.height, &rgb)),
        ("RGB JPEG", rgb_jpeg(width, height, &rgb, subsamp)),
        (
            "TIFF of 4 bits",
            raw_tiff(size, 4, &[(PHOTOMETRIC, 0)], packed),
        ),
    ]
}

#[test]
fn images_come_back() {
    let image = texture(101, 67);
    for (what, file) in files(&image) {
        let seen = decode(&file).unwrap_or_else(|e| panic!("{what}: {e}"));
        assert_eq!((seen.width, seen.height), (101, 67), "{what}");
        if what.contains("JPEG") {
            let differences = seen
                .voxels
                .iter()
                .zip(&image.voxels)
                .map(|(a, b)| a.abs_diff(*b));
            let sum: u32 = differences.map(u32::from).sum();
            assert!(sum < 5 * 101 * 67, "{what}: {sum}");
        } else {
            assert!(seen == image, "{what}");
        }
    }
}

#[test]
fn tiles_of_our_own_pyramids_come_back() {
    let image = texture(300, 150);
    let file = crate::pyramid::encode(&image, &crate::pyramid::Encoding::Lossless).unwrap();
    assert!(decode(&file).unwrap() == image);
}

#[test]
fn files_on_disk_come_back() {
    let dir = tempfile::tempdir().unwrap();
    let image = texture(33, 21);
    let path = dir.path().join("a.whatever");
    fs::write(&path, gray_png(&image)).unwrap();
    assert!(decode_file(&path).unwrap() == image);
    let absent = decode_file(&dir.path().join("absent"));
    assert!(matches!(absent, Err(ImageError::Read { .. })), "{absent:?}");
}

/// The heart of it: whatever is missing, the file is waited for.
#[test]
fn a_file_cut_anywhere_is_incomplete() {
    let image = texture(41, 59);
    for (what, file) in files(&image) {
        // What follows the last thing that is needed may be missing: a TIFF ends with padding.
        let needed = (0..file.len())
            .rev()
            .find(|&len| decode(&file[..len]).is_err())
            .unwrap()
            + 1;
        assert!(
            file.len() - needed < 8,
            "{what} needs {needed} of {} bytes",
            file.len()
        );
        for len in (0..needed).rev().step_by(3).chain(0..64) {
            let error = decode(&file[..len]).expect_err(what);
            let incomplete = matches!(error, ImageError::Incomplete { .. });
            assert!(
                incomplete,
                "{what} cut to {len} of {} bytes: {error}",
                file.len()
            );
            assert!(error.is_transient());
        }
    }
}

/// Space that was set aside reads as zeros until it is written.
#[test]
fn a_file_not_yet_filled_is_not_decoded() {
    let image = texture(41, 59);
    for (what, file) in files(&image) {
        for len in [0, 1, 2, 4, 8, 16, file.len() / 3, file.len() / 2] {
            let mut file = file.clone();
            file[len..].fill(0);
            match decode(&file) {
                Err(ImageError::Incomplete { .. } | ImageError::Broken { .. }) => {}
                // A TIFF may end with its directory, or begin with it: then its pixels are zeros.
                other => panic!("{what} zero from {len}: {other:?}"),
            }
        }
        let zeros = decode(&vec![0; file.len()]);
        assert!(
            matches!(zeros, Err(ImageError::Incomplete { .. })),
            "{what}: {zeros:?}"
        );
    }
}

#[test]
fn damage_is_told_from_lateness() {
    let image = texture(64, 64);
    for (what, file) in [
        ("PNG", gray_png(&image)),
        ("deflate TIFF", files(&image).swap_remove(3).1),
    ] {
        let mut broken = 0;
        for at in (60..file.len() - 40).step_by(11) {
            let mut file = file.clone();
            file[at] ^= 0x55;
            broken += u32::from(matches!(decode(&file), Err(ImageError::Broken { .. })));
        }
        assert!(broken > 5, "{what}: {broken}");
    }
}

#[test]
fn sixteen_bits_are_refused() {
    let mut file = Cursor::new(Vec::new());
    let pixels: Vec<u16> = (0..30 * 20).map(|i| i * 100).collect();
    let mut encoder = TiffEncoder::new(&mut file).unwrap();
    encoder
        .write_image::<colortype::Gray16>(30, 20, &pixels)
        .unwrap();
    let bytes: Vec<u8> = pixels.iter().flat_map(|p| p.to_be_bytes()).collect();
    let png = png_file(30, 20, ColorType::Grayscale, BitDepth::Sixteen, &bytes);
    for file in [file.into_inner(), png] {
        let error = decode(&file).unwrap_err();
        assert!(
            matches!(
                error,
                ImageError::Depth {
                    bits: 16,
                    volume: 8
                }
            ),
            "{error:?}"
        );
        assert!(error.to_string().contains("convert it to 8 bit"), "{error}");
        assert!(!error.is_transient());
    }
}

/// In a volume of 16 bits: as they are, and of 8 bits spread over the whole range.
#[test]
fn sixteen_bits_come_back_where_there_is_room() {
    let pixels: Vec<u16> = (0..31 * 20).map(|i| i * 105).collect();
    let tiff = |pixels: &[u16]| {
        let mut file = Cursor::new(Vec::new());
        let mut encoder = TiffEncoder::new(&mut file).unwrap();
        let mut strips = encoder.new_image::<colortype::Gray16>(31, 20).unwrap();
        strips.rows_per_strip(3).unwrap();
        strips.write_data(pixels).unwrap();
        file.into_inner()
    };
    let bytes: Vec<u8> = pixels.iter().flat_map(|p| p.to_be_bytes()).collect();
    let png = png_file(31, 20, ColorType::Grayscale, BitDepth::Sixteen, &bytes);
    let rgb: Vec<u8> = pixels
        .iter()
        .flat_map(|p| [p.to_be_bytes(); 3].concat())
        .collect();
    let rgb = png_file(31, 20, ColorType::Rgb, BitDepth::Sixteen, &rgb);
    let labels = Wanted {
        labels: true,
        ..Wanted::GRAY_16
    };
    for file in [tiff(&pixels), png, rgb.clone()] {
        let Image::Uint16(seen) = decode_as(&file, Wanted::GRAY_16).unwrap() else {
            panic!("16 bit")
        };
        assert!((seen.width, seen.height) == (31, 20) && seen.voxels == pixels);
        let several = file == rgb;
        let seen = decode_as(&file, labels);
        assert!(
            seen.is_ok_and(|image| matches!(image, Image::Uint16(i) if i.voxels == pixels))
                != several
        );
    }
    let image = texture(31, 20);
    let of_8 = |wanted| match decode_as(&gray_png(&image), wanted).unwrap() {
        Image::Uint16(seen) => seen.voxels,
        Image::Uint8(_) => panic!("16 bit"),
    };
    let spread: Vec<u16> = image.voxels.iter().map(|&v| u16::from(v) * 257).collect();
    assert_eq!(of_8(Wanted::GRAY_16), spread);
    let kept: Vec<u16> = image.voxels.iter().map(|&v| v.into()).collect();
    assert_eq!(of_8(labels), kept);
}

/// Labels are numbers: indices of a palette, and few bits, come as they are; roughly is not enough.
#[test]
fn labels_are_not_shades() {
    let labels = Wanted {
        labels: true,
        ..Wanted::GRAY_8
    };
    let seen = |file: &[u8]| match decode_as(file, labels).unwrap() {
        Image::Uint8(seen) => seen.voxels,
        Image::Uint16(_) => panic!("8 bit"),
    };
    let bits = png_file(
        5,
        2,
        ColorType::Grayscale,
        BitDepth::Two,
        &[0b0110_1100, 0b0100_0000, 0xff, 0],
    );
    assert_eq!(seen(&bits), [1, 2, 3, 0, 1, 3, 3, 3, 3, 0]);
    let colours = [9, 200, 3, 77, 0, 128, 255, 255, 1];
    assert_eq!(seen(&palette_png(3, 1, &colours, &[2, 0, 1])), [2, 0, 1]);
    let four = raw_tiff([4, 1], 4, &[(PHOTOMETRIC, 1)], &[0x3a, 0x0f]);
    assert_eq!(seen(&four), [3, 10, 0, 15]);
    let rough = decode_as(&jpeg_file(&texture(16, 16), false), labels).unwrap_err();
    assert!(rough.to_string().contains("labels in a JPEG"), "{rough}");
}

/// Pixels of an image as so many equal channels, and alpha after three.
fn channels(image: &GrayImage, channels: usize) -> Vec<u8> {
    let pixel = |&v: &u8| (0..channels).map(move |c| if c == 3 { 77 } else { v });
    image.voxels.iter().flat_map(pixel).collect()
}

fn rgb_tiff(width: u32, height: u32, data: &[u8]) -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    TiffEncoder::new(&mut file)
        .unwrap()
        .write_image::<colortype::RGB8>(width, height, data)
        .unwrap();
    file.into_inner()
}

fn rgb_jpeg(width: usize, height: usize, data: &[u8], subsamp: turbojpeg::Subsamp) -> Vec<u8> {
    let mut encoder = turbojpeg::Compressor::new().unwrap();
    encoder.set_quality(75).unwrap();
    encoder.set_subsamp(subsamp).unwrap();
    encoder
        .compress_to_vec(turbojpeg::Image {
            pixels: data,
            width,
            pitch: 3 * width,
            height,
            format: turbojpeg::PixelFormat::RGB,
        })
        .unwrap()
}

fn palette_png(width: u32, height: u32, palette: &[u8], data: &[u8]) -> Vec<u8> {
    let mut file = Vec::new();
    let mut encoder = Encoder::new(&mut file, width, height);
    encoder.set_color(ColorType::Indexed);
    encoder.set_depth(BitDepth::Eight);
    encoder.set_palette(palette.to_vec());
    let mut writer = encoder.write_header().unwrap();
    writer.write_image_data(data).unwrap();
    drop(writer);
    file
}

#[test]
fn equal_channels_are_grey() {
    let image = texture(37, 22);
    let (rgb, rgba) = (channels(&image, 3), channels(&image, 4));
    let png = |color, data: &[u8]| png_file(37, 22, color, BitDepth::Eight, data);
    let ramp: Vec<u8> = (0..=255).flat_map(|v: u8| [255 - v; 3]).collect();
    let turned: Vec<u8> = image.voxels.iter().map(|v| 255 - v).collect();
    for (what, file) in [
        ("RGB PNG", png(ColorType::Rgb, &rgb)),
        ("RGBA PNG", png(ColorType::Rgba, &rgba)),
        ("grey alpha PNG", {
            let data: Vec<u8> = image.voxels.iter().flat_map(|&v| [v, 9]).collect();
            png(ColorType::GrayscaleAlpha, &data)
        }),
        (
            "PNG with a grey palette",
            palette_png(37, 22, &ramp, &turned),
        ),
        ("RGB TIFF", rgb_tiff(37, 22, &rgb)),
    ] {
        let seen = decode(&file).unwrap_or_else(|e| panic!("{what}: {e}"));
        assert!(seen == image, "{what}");
    }
    // What is lossy shows what the same file without colours would.
    for subsamp in [turbojpeg::Subsamp::None, turbojpeg::Subsamp::Sub2x2] {
        let seen = decode(&rgb_jpeg(37, 22, &rgb, subsamp)).unwrap();
        let pairs = seen.voxels.iter().zip(&image.voxels);
        let sum: u32 = pairs.map(|(a, b)| u32::from(a.abs_diff(*b))).sum();
        assert!(sum < 10 * 37 * 22, "{subsamp:?}: {sum}");
    }
}

/// One pixel among many suffices; a shade that rounding makes does not.
#[test]
fn colours_are_refused_and_shown() {
    let image = texture(37, 22);
    let tinted = |[r, g, b]: [u8; 3]| {
        let mut rgb = channels(&image, 3);
        rgb[3 * (5 * 37 + 11)..][..3].copy_from_slice(&[r, g, b]);
        rgb
    };
    let palette = |color: [u8; 3]| {
        let mut palette: Vec<u8> = (0..=255).flat_map(|v: u8| [v; 3]).collect();
        palette[3 * 250..][..3].copy_from_slice(&color);
        let mut data: Vec<u8> = image.voxels.iter().map(|&v| v.min(249)).collect();
        data[5 * 37 + 11] = 250;
        palette_png(37, 22, &palette, &data)
    };
    let files = |color: [u8; 3]| {
        let rgb = tinted(color);
        [
            png_file(37, 22, ColorType::Rgb, BitDepth::Eight, &rgb),
            rgb_tiff(37, 22, &rgb),
            palette(color),
        ]
    };
    for file in files([90, 97, 99]) {
        let error = decode(&file).unwrap_err();
        let rgb = [90, 97, 99_u16];
        let place = matches!(error, ImageError::Color { x: 11, y: 5, rgb: seen } if seen == rgb);
        assert!(place && !error.is_transient(), "{error:?}");
        let said = error.to_string();
        assert!(
            said.contains("11, 5") && said.contains("convert it to grey"),
            "{said}"
        );
    }
    for file in files([99, 97, 96]) {
        assert_eq!(decode(&file).unwrap().voxels[5 * 37 + 11], 97);
    }

    // Deep images have finer steps, and what is dim in them is in colour as well.
    let deep = |color: [u16; 3]| {
        let mut samples: Vec<u16> = { image.voxels.iter() }
            .flat_map(|&v| [u16::from(v); 3])
            .collect();
        samples[3 * (5 * 37 + 11)..][..3].copy_from_slice(&color);
        let big: Vec<u8> = samples.iter().flat_map(|v| v.to_be_bytes()).collect();
        let mut tiff = Cursor::new(Vec::new());
        TiffEncoder::new(&mut tiff)
            .unwrap()
            .write_image::<colortype::RGB16>(37, 22, &samples)
            .unwrap();
        let png = png_file(37, 22, ColorType::Rgb, BitDepth::Sixteen, &big);
        [png, tiff.into_inner()]
    };
    for file in deep([200, 205, 202]) {
        let error = decode_as(&file, Wanted::GRAY_16).unwrap_err();
        let rgb = [200, 205, 202_u16];
        let place = matches!(error, ImageError::Color { x: 11, y: 5, rgb: seen } if seen == rgb);
        assert!(place && !error.is_transient(), "{error:?}");
    }
    for file in deep([200, 204, 202]) {
        let Image::Uint16(seen) = decode_as(&file, Wanted::GRAY_16).unwrap() else {
            panic!("16 bit");
        };
        assert_eq!(seen.voxels[5 * 37 + 11], 203);
    }

    // A patch, so that subsampling does not average it away.
    let patch = |color: [u8; 3]| {
        let mut rgb = channels(&GrayImage::new(40, 40, vec![120; 1600]), 3);
        for y in 8..24 {
            for x in 8..24 {
                rgb[3 * (y * 40 + x)..][..3].copy_from_slice(&color);
            }
        }
        rgb
    };
    for subsamp in [turbojpeg::Subsamp::None, turbojpeg::Subsamp::Sub2x2] {
        let error = decode(&rgb_jpeg(40, 40, &patch([180, 110, 60]), subsamp)).unwrap_err();
        assert!(matches!(error, ImageError::Color { .. }), "{error}");
        assert!(decode(&rgb_jpeg(40, 40, &patch([124, 120, 116]), subsamp)).is_ok());
    }
}

/// A TIFF of one strip, written by hand: what the encoder does not write.
fn raw_tiff(size: [u16; 2], bits: u16, tags: &[(u16, u16)], data: &[u8]) -> Vec<u8> {
    let len = u16::try_from(data.len()).unwrap();
    let [width, height] = size;
    let mut entries = vec![
        (256, width),
        (257, height),
        (258, bits),
        (259, 1),
        (273, 8),
        (277, 1),
        (278, height),
        (279, len),
    ];
    entries.extend(tags);
    entries.sort_unstable();
    let mut file = b"II\x2a\0".to_vec();
    file.extend((8 + u32::from(len)).to_le_bytes());
    file.extend(data);
    file.extend(u16::try_from(entries.len()).unwrap().to_le_bytes());
    for (tag, value) in entries {
        for half in [tag, 3, 1, 0, value, 0] {
            file.extend(half.to_le_bytes());
        }
    }
    file.extend([0; 4]);
    file
}

const PHOTOMETRIC: u16 = 262;

#[test]
fn few_bits_are_spread_over_the_whole_range() {
    let bits = png_file(8, 1, ColorType::Grayscale, BitDepth::One, &[0b1010_0011]);
    let want = [255, 0, 255, 0, 0, 0, 255, 255];
    assert_eq!(decode(&bits).unwrap().voxels, want);

    // Rows of five pixels do not fill their last byte.
    let want_1 = [255, 0, 255, 0, 0, 0, 255, 255, 0, 255];
    let want_2 = [0, 85, 170, 255, 85, 255, 170, 85, 0, 170];
    let want_4 = [0, 17, 34, 51, 68, 255, 238, 221, 204, 187];
    let cases: [(u16, BitDepth, &[u8], [u8; 10]); 3] = [
        (1, BitDepth::One, &[0b1010_0111, 0b0110_1111], want_1),
        (
            2,
            BitDepth::Two,
            &[0b0001_1011, 0x7f, 0b1110_0100, 0xbf],
            want_2,
        ),
        (
            4,
            BitDepth::Four,
            &[0x01, 0x23, 0x4f, 0xfe, 0xdc, 0xbf],
            want_4,
        ),
    ];
    for (bits, depth, data, want) in cases {
        let seen = decode(&raw_tiff([5, 2], bits, &[(PHOTOMETRIC, 1)], data));
        assert_eq!(seen.unwrap().voxels, want, "TIFF of {bits} bits");
        let seen = decode(&png_file(5, 2, ColorType::Grayscale, depth, data));
        assert_eq!(seen.unwrap().voxels, want, "PNG of {bits} bits");
        // White is zero: the other way round.
        let seen = decode(&raw_tiff([5, 2], bits, &[(PHOTOMETRIC, 0)], data));
        let turned = want.map(|v| 255 - v);
        assert_eq!(seen.unwrap().voxels, turned, "white-is-zero of {bits} bits");
    }
}

#[test]
fn white_is_zero_shows_black_as_0() {
    let image = texture(31, 17);
    let turned: Vec<u8> = image.voxels.iter().map(|v| 255 - v).collect();
    let turned = GrayImage::new(31, 17, turned);
    let plain = raw_tiff([31, 17], 8, &[(PHOTOMETRIC, 0)], &turned.voxels);
    assert!(decode(&plain).unwrap() == image);
    // With every compression: the tag's value is all that changes.
    for (what, mut file) in files(&turned).into_iter().take(5) {
        let entry = file
            .windows(8)
            .position(|w| w == [6, 1, 3, 0, 1, 0, 0, 0])
            .unwrap();
        assert!(file[entry + 8] == 1, "{what} is written as black-is-zero");
        file[entry + 8] = 0;
        assert!(decode(&file).unwrap() == image, "{what}");
    }
}

#[test]
fn what_would_be_read_wrongly_is_refused() {
    let pixels = [0, 50, 100, 150];
    let sample_format = 339;
    let fill_order = 266;
    for (bits, tags, word) in [
        (8, &[(PHOTOMETRIC, 3)][..], "palette"),
        (8, &[(PHOTOMETRIC, 1), (sample_format, 2)], "signed"),
        (8, &[(PHOTOMETRIC, 1), (fill_order, 2)], "reversed"),
    ] {
        let error = decode(&raw_tiff([2, 2], bits, tags, &pixels)).unwrap_err();
        assert!(matches!(error, ImageError::Unsupported { .. }), "{error}");
        let said = error.to_string();
        assert!(said.contains(word) && said.contains("convert it"), "{said}");
    }
    let few = decode(&raw_tiff([2, 2], 6, &[(PHOTOMETRIC, 1)], &pixels)).unwrap_err();
    assert!(
        matches!(few, ImageError::Depth { bits: 6, volume: 8 }),
        "{few:?}"
    );

    let mut twelve = jpeg_file(&texture(16, 16), false);
    let frame = twelve.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
    assert_eq!(std::mem::replace(&mut twelve[frame + 4], 12), 8);
    let error = decode(&twelve).unwrap_err();
    assert!(
        matches!(
            error,
            ImageError::Depth {
                bits: 12,
                volume: 8
            }
        ),
        "{error:?}"
    );
}

/// Claims of gigapixels in a few bytes are refused before memory is set aside.
#[test]
fn absurd_sizes_are_refused() {
    let image = texture(16, 16);
    let mut png = gray_png(&image);
    for (width, height) in [
        (0, 16),
        (16, 0),
        (1 << 19, 1 << 19),
        (u32::MAX >> 1, 1),
        (60_000, 60_000),
    ] {
        png[16..20].copy_from_slice(&u32::to_be_bytes(width));
        png[20..24].copy_from_slice(&u32::to_be_bytes(height));
        let mut crc = flate2::Crc::new();
        crc.update(&png[12..29]);
        png[29..33].copy_from_slice(&crc.sum().to_be_bytes());
        let error = decode(&png).unwrap_err();
        assert!(
            matches!(
                error,
                ImageError::Broken { .. } | ImageError::TooLarge { .. }
            ),
            "{width} x {height}: {error}"
        );
    }
    let mut jpeg = jpeg_file(&image, false);
    let frame = jpeg.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
    jpeg[frame + 5..frame + 9].fill(0xff);
    let error = decode(&jpeg).unwrap_err();
    assert!(
        matches!(
            error,
            ImageError::Broken { .. } | ImageError::TooLarge { .. }
        ),
        "{error}"
    );
    let tiff = tiff_file(&image, Compression::Lzw, Predictor::None);
    for value in [0_u32, 1 << 17, 1 << 19, u32::MAX] {
        let mut tiff = tiff.clone();
        for tag in [256_u16, 257] {
            let entry = tiff
                .windows(2)
                .position(|w| w == tag.to_le_bytes())
                .unwrap();
            tiff[entry + 8..entry + 12].copy_from_slice(&value.to_le_bytes());
        }
        let error = decode(&tiff).unwrap_err();
        assert!(
            matches!(
                error,
                ImageError::Broken { .. } | ImageError::TooLarge { .. }
            ),
            "{value}: {error}"
        );
    }
}

#[test]
fn other_kinds_are_unsupported() {
    for file in [
        &b"GIF89a is not what microscopes write"[..],
        b"BM bitmap",
        b"not an image at all",
    ] {
        let error = decode(file).unwrap_err();
        assert!(matches!(error, ImageError::Unsupported { .. }), "{error}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(600))]

    #[test]
    fn damaged_files_never_panic(
        kind in 0_usize..11,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), any::<bool>()), 1..8),
    ) {
        static FILES: LazyLock<Vec<(&str, Vec<u8>)>> = LazyLock::new(|| {
            let image = texture(23, 29);
            let mut all = files(&image);
            all.extend(unusual_files(&image));
            all
        });
        let (_, mut file) = FILES[kind].clone();
        for (at, value, at_ends) in changes {
            let at = at.index(file.len());
            // Headers are at the ends, pixels in the middle.
            let at = if at_ends { [at % 64, file.len() - 1 - at % 300.min(file.len())][at % 2] } else { at };
            file[at] = value;
        }
        if let Ok(image) = decode(&file) {
            prop_assert_eq!(image.voxels.len() as u64, u64::from(image.width) * u64::from(image.height));
        }
    }

    #[test]
    fn any_bytes_never_panic(kind in 0_usize..4, bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let magic: [&[u8]; 4] = [b"II\x2a\0\x08\0\0\0", b"MM\0\x2b\0\x08\0\0\0\0\0\0\0\0\0\x10", &sniff::PNG_SIGNATURE, b"\xff\xd8\xff\xe0"];
        let file = [magic[kind], &bytes].concat();
        let _ = decode(&file);
    }
}

/// Tiles as a microscope wrote them, where they are at hand.
#[test]
fn microscope_tiles_decode() {
    let shared = std::env::var_os("SACCADE_SHARED").map(PathBuf::from);
    let shared =
        shared.unwrap_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared"));
    let dir = shared.join("data/at-tutorial-tiles");
    if !dir.is_dir() {
        let is_named = std::env::var_os("SACCADE_SHARED").is_some();
        assert!(
            !is_named,
            "SACCADE_SHARED is set, but {} is not there",
            dir.display()
        );
        eprintln!("skipped: no data in {}", dir.display());
        return;
    }
    let mut folders = vec![dir];
    let mut decoded = 0;
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path
                .extension()
                .is_some_and(|e| e == "tif" || e == "png" || e == "jpg")
                && decoded < 3
            {
                let image =
                    decode_file(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
                let (min, max) = (image.voxels.iter().min(), image.voxels.iter().max());
                assert!(
                    image.width > 100 && min < max,
                    "{}: {image:?}",
                    path.display()
                );
                decoded += 1;
            }
        }
    }
    assert!(decoded > 0);
}
