#![expect(clippy::cast_possible_truncation, reason = "texture wraps")]
#![expect(clippy::print_stderr, reason = "a skipped test says so")]

use std::fs;
use std::io::Cursor;
use std::path::PathBuf;
use std::sync::LazyLock;

use ::png::{BitDepth, ColorType, Encoder};
use ::tiff::encoder::{Compression, DeflateLevel, Predictor, TiffEncoder, colortype};
use proptest::prelude::*;

use super::{GrayImage, ImageError, decode, decode_file, sniff};

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
        assert!(matches!(error, ImageError::Depth { bits: 16 }), "{error:?}");
        assert!(error.to_string().contains("convert it to 8 bit"), "{error}");
        assert!(!error.is_transient());
    }
}

#[test]
fn colours_become_luma() {
    let colors = [
        [255, 255, 255],
        [0, 0, 0],
        [255, 0, 0],
        [0, 255, 0],
        [0, 0, 255],
        [10, 200, 90],
    ];
    let want = [255, 0, 76, 150, 29, 131];
    let rgb: Vec<u8> = colors.iter().flatten().copied().collect();
    let rgba: Vec<u8> = colors.iter().flat_map(|&[r, g, b]| [r, g, b, 7]).collect();
    let mut tiff = Cursor::new(Vec::new());
    TiffEncoder::new(&mut tiff)
        .unwrap()
        .write_image::<colortype::RGB8>(3, 2, &rgb)
        .unwrap();
    let png = |color, data: &[u8]| png_file(3, 2, color, BitDepth::Eight, data);
    for file in [
        tiff.into_inner(),
        png(ColorType::Rgb, &rgb),
        png(ColorType::Rgba, &rgba),
    ] {
        assert_eq!(decode(&file).unwrap().voxels, want);
    }
    let gray_alpha = png(
        ColorType::GrayscaleAlpha,
        &[1, 9, 2, 9, 3, 9, 4, 9, 5, 9, 6, 9],
    );
    assert_eq!(decode(&gray_alpha).unwrap().voxels, [1, 2, 3, 4, 5, 6]);
    let bits = png_file(8, 1, ColorType::Grayscale, BitDepth::One, &[0b1010_0011]);
    assert_eq!(
        decode(&bits).unwrap().voxels,
        [255, 0, 255, 0, 0, 0, 255, 255]
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
            matches!(error, ImageError::Broken { .. }),
            "{width} x {height}: {error}"
        );
    }
    let mut jpeg = jpeg_file(&image, false);
    let frame = jpeg.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
    jpeg[frame + 5..frame + 9].fill(0xff);
    let error = decode(&jpeg).unwrap_err();
    assert!(matches!(error, ImageError::Broken { .. }), "{error}");
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
            matches!(error, ImageError::Broken { .. }),
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
        kind in 0_usize..8,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), any::<bool>()), 1..8),
    ) {
        static FILES: LazyLock<Vec<(&str, Vec<u8>)>> = LazyLock::new(|| files(&texture(23, 29)));
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
