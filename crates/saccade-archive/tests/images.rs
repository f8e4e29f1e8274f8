//! Images that other programs wrote, voxel by voxel; and those that nobody should try to hold.
//!
//! `images/make.py` writes them with tifffile, Pillow and libtiff. Both know the texture, and nothing else
//! of each other.

#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]
#![expect(clippy::cast_possible_truncation, reason = "small images")]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use glam::UVec2;
use saccade_archive::image::{Image, ImageError, Wanted, decode_as, decode_file_as};

const WIDTH: u32 = 53;
const HEIGHT: u32 = 37;

fn texture() -> Vec<u16> {
    let value = |x: u32, y: u32| ((x * 977 + y * 613 + (x * y) % 89 * 301) % 65521) as u16;
    (0..HEIGHT)
        .flat_map(|y| (0..WIDTH).map(move |x| value(x, y)))
        .collect()
}

/// All images, by name without and with its ending.
fn images() -> BTreeMap<String, PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/images");
    let files = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    let images = files.filter(|path| path.extension().is_some_and(|e| e != "py"));
    images
        .map(|path| {
            (
                path.file_name().unwrap().to_string_lossy().into_owned(),
                path,
            )
        })
        .collect()
}

fn expected(size: UVec2, wanted: Wanted) -> Wanted {
    Wanted {
        size: Some(size),
        ..wanted
    }
}

#[test]
fn every_kind_of_file_comes_back() {
    let deep = texture();
    let images = images();
    let size = UVec2::new(WIDTH, HEIGHT);
    let mut exact = 0;
    for (name, path) in images.iter().filter(|(name, _)| !name.contains("smooth")) {
        let bits: u32 = name.split(['-', '.']).find_map(|s| s.parse().ok()).unwrap();
        let want: Vec<u16> = match bits {
            16 => deep.clone(),
            8 => deep.iter().map(|v| v >> 8).collect(),
            _ => deep.iter().map(|v| v >> 15).collect(),
        };
        let spread: Vec<u16> = want
            .iter()
            .map(|v| v * (255 / ((1 << bits.min(8)) - 1)))
            .collect();
        let in_8 = decode_file_as(path, expected(size, Wanted::GRAY_8));
        let in_16 = decode_file_as(path, expected(size, Wanted::GRAY_16));
        let Ok(Image::Uint16(in_16)) = in_16 else {
            panic!("{name}: {in_16:?}")
        };
        assert_eq!((in_16.width, in_16.height), (WIDTH, HEIGHT), "{name}");
        match in_8 {
            Err(ImageError::Depth { bits: 16, .. }) if bits == 16 => {
                assert!(in_16.voxels == want, "{name}");
            }
            Ok(Image::Uint8(in_8)) if bits != 16 => {
                assert!(
                    in_8.voxels
                        .iter()
                        .map(|&v| u16::from(v))
                        .eq(spread.iter().copied()),
                    "{name}"
                );
                assert!(
                    in_16.voxels.iter().eq(spread
                        .iter()
                        .map(|v| v * 257)
                        .collect::<Vec<_>>()
                        .iter()),
                    "{name}"
                );
            }
            other => panic!("{name}: {other:?}"),
        }
        // From memory as from a file.
        let again = decode_as(&fs::read(path).unwrap(), Wanted::GRAY_16).unwrap();
        assert!(again == Image::Uint16(in_16), "{name}");
        // The record knows its size: another is not even decoded.
        let other = decode_file_as(path, expected(size + 1, Wanted::GRAY_16));
        assert!(
            matches!(other, Err(ImageError::Size { .. })),
            "{name}: {other:?}"
        );
        exact += 1;
    }
    assert!(exact >= 40, "{exact} images");
    for (name, path) in images.iter().filter(|(name, _)| name.contains("smooth")) {
        let Image::Uint8(seen) = decode_file_as(path, Wanted::GRAY_8).unwrap() else {
            panic!("8 bit")
        };
        let far = seen.voxels.iter().enumerate().filter(|&(i, &got)| {
            let (x, y) = (i as u32 % WIDTH, i as u32 / WIDTH);
            u32::from(got).abs_diff(x * 3 + y * 2) > 6
        });
        assert_eq!(far.count(), 0, "{name}");
    }
}

/// A TIFF directory of these tags: `(tag, type, count, value)`.
fn tiff(tags: &[(u16, u16, u32, u32)], data: &[u8]) -> Vec<u8> {
    let mut file = b"II\x2a\0".to_vec();
    file.extend((8 + data.len() as u32).to_le_bytes());
    file.extend(data);
    file.extend((tags.len() as u16).to_le_bytes());
    for (tag, kind, count, value) in tags {
        file.extend(tag.to_le_bytes());
        file.extend(kind.to_le_bytes());
        file.extend(count.to_le_bytes());
        file.extend(value.to_le_bytes());
    }
    file.extend([0; 4]);
    file
}

/// A PNG chunk.
fn chunk(name: &[u8; 4], data: &[u8]) -> Vec<u8> {
    let body = [name, data].concat();
    let mut crc = !0_u32;
    for byte in &body {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 {
                crc >> 1 ^ 0xedb8_8320
            } else {
                crc >> 1
            };
        }
    }
    let len = (data.len() as u32).to_be_bytes();
    [&len[..], &body, &(!crc).to_be_bytes()].concat()
}

/// Deflated zeros of so many bytes.
fn zeros(len: usize) -> Vec<u8> {
    use std::io::Write;
    let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::best());
    let piece = vec![0; 1 << 20];
    for _ in 0..len >> 20 {
        encoder.write_all(&piece).unwrap();
    }
    encoder.finish().unwrap()
}

fn png(width: u32, height: u32, depth: u8, color: u8, data: &[u8]) -> Vec<u8> {
    let mut head = [width.to_be_bytes(), height.to_be_bytes()].concat();
    head.extend([depth, color, 0, 0, 0]);
    [
        b"\x89PNG\r\n\x1a\n".to_vec(),
        chunk(b"IHDR", &head),
        chunk(b"IDAT", data),
        chunk(b"IEND", &[]),
    ]
    .concat()
}

/// Files of a few kilobytes that say, or unpack to, gigabytes.
fn bombs() -> Vec<(&'static str, Vec<u8>)> {
    let edge = 1 << 16;
    let strip = |width, height, compression, offset, len| {
        [
            (256, 4, 1, width),
            (257, 4, 1, height),
            (258, 3, 1, 8),
            (259, 3, 1, compression),
            (262, 3, 1, 1),
            (273, 4, 1, offset),
            (277, 3, 1, 1),
            (278, 4, 1, height),
            (279, 4, 1, len),
        ]
    };
    let packed = zeros(256 << 20);
    let len = packed.len() as u32;
    let tiles = [
        (256, 4, 1, 1024),
        (257, 4, 1, 1024),
        (258, 3, 1, 8),
        (259, 3, 1, 8),
        (262, 3, 1, 1),
        (277, 3, 1, 1),
        (322, 4, 1, 1 << 30),
        (323, 4, 1, 1 << 30),
        (324, 4, 1, 8),
        (325, 4, 1, len),
    ];
    let mut jpeg = fs::read(&images()["smooth-8.jpg"]).unwrap();
    let frame = jpeg.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
    jpeg[frame + 5..frame + 9].copy_from_slice(&[0xff, 0xdc, 0xff, 0xdc]);
    let many_values = [
        (256, 4, 1, 16),
        (257, 4, 1, 16),
        (258, 3, 1, 8),
        (273, 4, u32::MAX >> 2, 8),
        (279, 4, u32::MAX >> 2, 8),
    ];
    vec![
        (
            "a TIFF of gigapixels in 64 bytes",
            tiff(&strip(edge, edge, 1, 8, 64), &[1; 64]),
        ),
        (
            "a deflated TIFF of gigapixels",
            tiff(&strip(edge, edge, 8, 8, len), &packed),
        ),
        (
            "a deflated TIFF of 2^40 pixels",
            tiff(&strip(1 << 20, 1 << 20, 8, 8, len), &packed),
        ),
        ("a TIFF with tiles of 2^60 pixels", tiff(&tiles, &packed)),
        (
            "a TIFF with a billion offsets",
            tiff(&many_values, &[1; 64]),
        ),
        ("a PNG of gigapixels", png(edge, edge, 8, 0, &packed)),
        (
            "a PNG of 2^62 pixels",
            png(1 << 31 >> 1, 1 << 31 >> 1, 16, 6, &packed),
        ),
        ("a JPEG of gigapixels in a few hundred bytes", jpeg),
    ]
}

/// Most that refusing one may take \[bytes\].
const CEILING: u64 = 64 << 20;

fn resident(key: &str) -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|l| l.strip_prefix(key)).unwrap();
    let kib: u64 = line
        .trim_matches([':', ' ', '\t'])
        .trim_end_matches(" kB")
        .parse()
        .unwrap();
    kib << 10
}

/// What `work` took at most, above what was there before. Other tests run at the same time: theirs are small.
fn took(work: impl FnOnce()) -> u64 {
    fs::write("/proc/self/clear_refs", "5").unwrap();
    let before = resident("VmRSS");
    work();
    resident("VmHWM").saturating_sub(before)
}

/// Whoever knows the size of the tile never sets memory aside for another.
#[test]
#[cfg(target_os = "linux")]
fn bombs_are_refused_before_memory_is_set_aside() {
    let folder = tempfile::tempdir().unwrap();
    let control = took(|| drop(std::hint::black_box(vec![1_u8; 2 * CEILING as usize])));
    assert!(control > CEILING, "the measure sees {control} bytes");
    for (what, file) in bombs() {
        let path = folder.path().join("bomb");
        fs::write(&path, &file).unwrap();
        for wanted in [Wanted::GRAY_8, Wanted::GRAY_16] {
            let tile = expected(UVec2::splat(1024), wanted);
            let took = took(|| {
                let refused = decode_file_as(&path, tile);
                assert!(refused.is_err(), "{what}: {refused:?}");
            });
            assert!(took < CEILING, "{what} took {took} bytes to refuse");
        }
        if file.len() < 1 << 14 {
            // Without a size, what so few bytes cannot hold is refused as well.
            let took = took(|| {
                let refused = decode_as(&file, Wanted::GRAY_8);
                assert!(refused.is_err(), "{what}: {refused:?}");
            });
            assert!(took < CEILING, "{what} took {took} bytes to refuse");
        }
    }
}

/// A file that no tile of this size needs is not read.
#[test]
fn files_longer_than_their_image_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("long.png");
    fs::copy(&images()["pillow-8.png"], &path).unwrap();
    let file = fs::OpenOptions::new().write(true).open(&path).unwrap();
    // Sparse: it takes no space.
    file.set_len(1 << 40).unwrap();
    let size = UVec2::new(WIDTH, HEIGHT);
    let refused = decode_file_as(&path, expected(size, Wanted::GRAY_8)).unwrap_err();
    assert!(matches!(refused, ImageError::TooLong { .. }), "{refused}");
}
