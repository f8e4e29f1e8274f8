#![expect(
    clippy::cast_possible_truncation,
    reason = "small images; a failed test at worst"
)]

use std::io::Cursor;
use std::sync::Arc;

use bytes::Bytes;
use glam::UVec2;
use proptest::prelude::*;
use tiff::decoder::{Decoder, DecodingResult, ifd::Value};
use tiff::tags::{IfdPointer, Tag};

use super::encode::parts as parts_by;
use super::layout::Parts;
use super::mean::Mean;
use super::morton::morton;
use super::*;
use crate::image::GrayImage;
use crate::storage::{FaultyStorage, MemoryStorage, ReadFault, Storage};

mod voxels;

fn parts(image: &GrayImage, encoding: &Encoding) -> Result<Parts, EncodeError> {
    parts_by::<Mean<u8>>(image, encoding)
}

const EDGE: usize = SUB_TILE_EDGE as usize;

/// Noise: every pixel differs from its neighbours, and no two images are alike.
fn noise(width: u32, height: u32, seed: u32) -> GrayImage {
    let mut state = seed.wrapping_mul(0x9e37_79b9) | 1;
    let voxels = (0..width * height).map(|_| {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        (state >> 24) as u8
    });
    GrayImage::new(width, height, voxels.collect())
}

/// Something smooth, as microscopes see it: JPEG does well.
fn smooth(width: u32, height: u32) -> GrayImage {
    let value = |x: u32, y: u32| {
        let (x, y) = (f64::from(x), f64::from(y));
        (128.0 + 60.0 * (x / 17.0).sin() + 50.0 * (y / 23.0 + x / 41.0).cos()) as u8
    };
    let voxels = (0..height).flat_map(|y| (0..width).map(move |x| value(x, y)));
    GrayImage::new(width, height, voxels.collect())
}

/// A pixel of level k by its definition: the mean, in f64, of what exists of its box.
fn oracle(image: &GrayImage, level: usize, x: u32, y: u32) -> u8 {
    let range = |at: u32, len: u32| at << level..((at + 1) << level).min(len);
    let (mut sum, mut count) = (0.0, 0.0);
    for y in range(y, image.height) {
        for x in range(x, image.width) {
            sum += f64::from(image.voxels[(y * image.width + x) as usize]);
            count += 1.0;
        }
    }
    (sum / count + 0.5).floor() as u8
}

fn whole(bytes: &Bytes) -> PyramidIndex {
    PyramidIndex::parse(bytes, "test").unwrap()
}

fn sub_tile(index: &PyramidIndex, bytes: &Bytes, level: usize, at: UVec2) -> Vec<u8> {
    let entry = index.sub_tile(level, at.x, at.y).unwrap();
    let bytes = &bytes[entry.offset as usize..][..entry.len as usize];
    index.decode_sub_tile(level, at.x, at.y, bytes).unwrap()
}

/// A level's pixels, put together from its sub-tiles, without the padding.
fn level_pixels(index: &PyramidIndex, bytes: &Bytes, level: usize) -> Vec<u8> {
    let PyramidLevel {
        width,
        height,
        sub_tiles,
    } = index.levels()[level];
    let (width, height) = (width as usize, height as usize);
    let mut pixels = vec![0; width * height];
    for at in morton::in_morton_order(sub_tiles) {
        let voxels = sub_tile(index, bytes, level, at);
        let (x, y) = (at.x as usize * EDGE, at.y as usize * EDGE);
        let n = EDGE.min(width - x);
        for (to, from) in pixels[y * width..]
            .chunks_mut(width)
            .zip(voxels.chunks(EDGE))
        {
            to[x..x + n].copy_from_slice(&from[..n]);
        }
    }
    pixels
}

const SIZES: [(u32, u32); 12] = [
    (1, 1),
    (128, 128),
    (129, 128),
    (127, 300),
    (1, 700),
    (255, 257),
    (513, 3),
    (640, 640),
    (1023, 1025),
    (1000, 2111),
    (4097, 130),
    (2049, 2300),
];

#[test]
fn every_level_is_the_exact_mean_of_the_finest() {
    for (width, height) in SIZES {
        let image = noise(width, height, width + height);
        let bytes = encode(&image, &Encoding::Lossless).unwrap();
        let index = whole(&bytes);
        for (k, level) in index.levels().iter().enumerate() {
            assert_eq!(level.width, width.div_ceil(1 << k));
            assert_eq!(level.height, height.div_ceil(1 << k));
            let pixels = level_pixels(&index, &bytes, k);
            for (i, &got) in pixels.iter().enumerate() {
                let (x, y) = (i as u32 % level.width, i as u32 / level.width);
                let want = oracle(&image, k, x, y);
                assert_eq!(got, want, "{width} x {height} level {k} pixel {x}, {y}");
            }
        }
        let last = index.levels().last().unwrap();
        assert_eq!(last.sub_tiles, UVec2::ONE);
    }
}

/// A comparison that cannot fail proves nothing: rounded means of rounded means are not exact.
#[test]
fn the_oracle_tells_exact_from_repeatedly_rounded_means() {
    let image = noise(512, 512, 5);
    let halve = |image: &GrayImage| {
        let (w, h) = (image.width / 2, image.height / 2);
        let at = |x: u32, y: u32| u32::from(image.voxels[(y * image.width + x) as usize]);
        let mean = |x, y| {
            let sum = at(2 * x, 2 * y)
                + at(2 * x + 1, 2 * y)
                + at(2 * x, 2 * y + 1)
                + at(2 * x + 1, 2 * y + 1);
            ((sum + 2) / 4) as u8
        };
        GrayImage::new(
            w,
            h,
            (0..h)
                .flat_map(|y| (0..w).map(move |x| mean(x, y)))
                .collect(),
        )
    };
    let repeated = halve(&halve(&image));
    let differ = (0..128 * 128_u32)
        .filter(|i| repeated.voxels[*i as usize] != oracle(&image, 2, i % 128, i / 128));
    assert!(differ.count() > 100);
}

#[test]
fn padding_repeats_the_last_column_and_row() {
    let image = noise(200, 150, 1);
    let bytes = encode(&image, &Encoding::Lossless).unwrap();
    let voxels = sub_tile(&whole(&bytes), &bytes, 0, UVec2::new(1, 1));
    for (y, row) in voxels.chunks(EDGE).enumerate() {
        for (x, &voxel) in row.iter().enumerate() {
            let (x, y) = ((x + EDGE).min(199), (y + EDGE).min(149));
            assert_eq!(voxel, image.voxels[y * 200 + x], "{x}, {y}");
        }
    }
}

#[test]
fn entries_hold_the_range_and_mean_of_what_exists() {
    let image = noise(300, 140, 9);
    for encoding in [Encoding::Lossless, Encoding::Jpeg { quality: 30 }] {
        let bytes = encode(&image, &encoding).unwrap();
        let index = whole(&bytes);
        let entry = index.sub_tile(0, 2, 1).unwrap();
        let exist: Vec<u8> = (128..140)
            .flat_map(|y| (256..300).map(move |x| (x, y)))
            .map(|(x, y)| image.voxels[y * 300 + x])
            .collect();
        assert_eq!(entry.min, u16::from(*exist.iter().min().unwrap()));
        assert_eq!(entry.max, u16::from(*exist.iter().max().unwrap()));
        let mean = exist.iter().map(|&v| f64::from(v)).sum::<f64>() / exist.len() as f64;
        assert_eq!(entry.mean, (mean + 0.5).floor() as u16);
        // Noise makes JPEG overshoot: the bounds hold nevertheless.
        for (k, level) in index.levels().iter().enumerate() {
            for at in morton::in_morton_order(level.sub_tiles) {
                let entry = index.sub_tile(k, at.x, at.y).unwrap();
                let voxels = sub_tile(&index, &bytes, k, at);
                let values = voxels.into_iter().map(u16::from);
                let bounds = entry.min..=entry.max;
                assert!({ values }.all(|v| bounds.contains(&v)));
            }
        }
    }
}

/// Mean squared error over all pixels of a level.
fn error(index: &PyramidIndex, bytes: &Bytes, level: usize, image: &GrayImage) -> f64 {
    let width = index.levels()[level].width;
    let pixels = level_pixels(index, bytes, level);
    let errors = pixels.iter().enumerate().map(|(i, &got)| {
        let want = oracle(image, level, i as u32 % width, i as u32 / width);
        (f64::from(got) - f64::from(want)).powi(2)
    });
    errors.sum::<f64>() / pixels.len() as f64
}

#[test]
fn jpeg_comes_near_and_takes_less() {
    let image = smooth(700, 500);
    let lossless = encode(&image, &Encoding::Lossless).unwrap();
    let fine = encode(&image, &Encoding::Jpeg { quality: 90 }).unwrap();
    let coarse = encode(&image, &Encoding::Jpeg { quality: 20 }).unwrap();
    assert!(fine.len() < lossless.len() && coarse.len() < fine.len());
    for level in 0..whole(&fine).levels().len() {
        let fine = error(&whole(&fine), &fine, level, &image);
        let coarse = error(&whole(&coarse), &coarse, level, &image);
        assert!(fine < 2.0, "level {level}: {fine}");
        assert!(coarse > fine, "level {level}: {coarse}");
    }
}

#[test]
fn blank_sub_tiles_take_no_space() {
    let mut image = GrayImage::new(1200, 1100, vec![0; 1200 * 1100]);
    let measured = (700..800).flat_map(|y| (600..700).map(move |x| y * 1200 + x));
    measured.for_each(|i| image.voxels[i] = 200);
    for encoding in [Encoding::Lossless, Encoding::Jpeg { quality: 80 }] {
        let bytes = encode(&image, &encoding).unwrap();
        let index = whole(&bytes);
        let size = index.levels()[0].sub_tiles;
        let cells = morton::in_morton_order(size);
        let of = |at: &UVec2| index.sub_tile(0, at.x, at.y).unwrap();
        let measured: Vec<_> = cells.iter().filter(|at| !of(at).is_blank()).collect();
        assert_eq!(measured.len(), 4, "{measured:?}");
        for at in cells.iter().filter(|at| of(at).is_blank()) {
            assert_eq!(of(at), SubTileEntry::BLANK);
            assert_eq!(
                index.decode_sub_tile(0, at.x, at.y, b"anything").unwrap(),
                [0; SUB_TILE_VOXELS]
            );
        }
        let blank = GrayImage::new(1200, 1100, vec![0; 1200 * 1100]);
        let empty = encode(&blank, &encoding).unwrap();
        // 90 sub-tiles of level 0: less than one byte of voxels each, next to 11 of index.
        let index = whole(&empty);
        let sub_tiles = index
            .levels()
            .iter()
            .map(|l| u64::from(l.sub_tiles.element_product()));
        let index_len = parse::index_len(&empty).unwrap();
        let voxels = empty.len() as u64 - index_len;
        assert!(voxels < sub_tiles.sum::<u64>() * 2, "{voxels}");
    }
}

#[test]
fn sub_tiles_lie_in_morton_order_the_coarse_levels_first() {
    let image = noise(1500, 2300, 3);
    for encoding in [Encoding::Lossless, Encoding::Jpeg { quality: 75 }] {
        let bytes = encode(&image, &encoding).unwrap();
        let index = whole(&bytes);
        let mut end = parse::index_len(&bytes).unwrap();
        end += parts(&image, &encoding).unwrap().blank.len() as u64;
        for (k, level) in index.levels().iter().enumerate().rev() {
            let mut cells: Vec<_> = (0..level.sub_tiles.y)
                .flat_map(|y| (0..level.sub_tiles.x).map(move |x| (x, y)))
                .collect();
            cells.sort_by_key(|&(x, y)| morton(x, y));
            for (x, y) in cells {
                let entry = index.sub_tile(k, x, y).unwrap();
                assert_eq!(entry.offset, end, "level {k} sub-tile {x}, {y}");
                end += u64::from(entry.len);
            }
        }
        assert_eq!(end, bytes.len() as u64);
        assert_eq!(index.end(), end);
    }
}

/// A TIFF reader that knows nothing of this crate.
fn read_with_tiff(bytes: &Bytes) -> (GrayImage, Vec<u64>) {
    let mut decoder = Decoder::new(Cursor::new(bytes)).unwrap();
    let (width, height) = decoder.dimensions().unwrap();
    let DecodingResult::U8(voxels) = decoder.read_image().unwrap() else {
        panic!("8 bit")
    };
    let sub_ifds = match decoder.find_tag(Tag::SubIfd).unwrap() {
        Some(value) => value.into_u64_vec().unwrap(),
        None => Vec::new(),
    };
    (GrayImage::new(width, height, voxels), sub_ifds)
}

#[test]
fn other_readers_see_a_tiff_file() {
    let mut image = noise(700, 450, 8);
    image.voxels[..450 * 260].fill(0);
    for big in [false, true] {
        let bytes = parts(&image, &Encoding::Lossless)
            .unwrap()
            .file_of_width(big);
        assert_eq!(bytes[2], if big { 43 } else { 42 });
        let (seen, sub_ifds) = read_with_tiff(&bytes);
        assert!(seen == image, "big: {big}");
        let index = whole(&bytes);
        assert_eq!(sub_ifds.len() + 1, index.levels().len());
        let mut decoder = Decoder::new(Cursor::new(&bytes)).unwrap();
        for (level, at) in index.levels()[1..].iter().zip(sub_ifds) {
            let directory = decoder.read_directory(IfdPointer(at)).unwrap();
            let mut tags = decoder.read_directory_tags(&directory);
            let tag = |v: Option<Value>| v.unwrap().into_u32().unwrap();
            assert_eq!(tag(tags.find_tag(Tag::ImageWidth).unwrap()), level.width);
            assert_eq!(tag(tags.find_tag(Tag::ImageLength).unwrap()), level.height);
            assert_eq!(tag(tags.find_tag(Tag::NewSubfileType).unwrap()), 1);
        }
    }
}

#[test]
fn other_readers_see_the_same_jpeg() {
    let mut image = smooth(500, 300);
    image.voxels[..500 * 140].fill(0);
    let bytes = encode(&image, &Encoding::Jpeg { quality: 85 }).unwrap();
    let (seen, _) = read_with_tiff(&bytes);
    let ours = level_pixels(&whole(&bytes), &bytes, 0);
    assert_eq!((seen.width, seen.height), (500, 300));
    // Decoders differ by one; ours keeps to the bounds, which JPEG overshoots a little.
    let differences = seen
        .voxels
        .iter()
        .zip(&ours)
        .map(|(a, b)| f64::from(a.abs_diff(*b)));
    let (sum, max) = differences.fold((0.0, 0.0_f64), |(sum, max), d| (sum + d, max.max(d)));
    assert!(
        sum / 150_000.0 < 0.5 && max < 40.0,
        "mean {} max {max}",
        sum / 150_000.0
    );
}

#[test]
fn jpeg_streams_share_their_tables() {
    let bytes = encode(&noise(400, 400, 2), &Encoding::Jpeg { quality: 75 }).unwrap();
    let index = whole(&bytes);
    let entry = index.sub_tile(0, 1, 1).unwrap();
    let stream = &bytes[entry.offset as usize..][..entry.len as usize];
    // Start, frame header, scan header: no quantisation and no Huffman tables.
    assert_eq!(stream[..4], [0xff, 0xd8, 0xff, 0xc0]);
    assert!(
        !stream
            .windows(2)
            .any(|w| w == [0xff, 0xdb] || w == [0xff, 0xc4])
    );
    assert!(turbojpeg::decompress(stream, turbojpeg::PixelFormat::GRAY).is_err());
}

#[test]
fn any_number_of_threads_writes_the_same_file() {
    let image = noise(2100, 1300, 4);
    let encoding = Encoding::Jpeg { quality: 75 };
    let many = encode(&image, &encoding).unwrap();
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    assert!(many == pool.install(|| encode(&image, &encoding)).unwrap());
}

#[test]
fn impossible_images_are_refused() {
    let refused = |image: GrayImage| {
        let result = encode(&image, &Encoding::Lossless);
        assert!(
            matches!(result, Err(EncodeError::Size { .. })),
            "{image:?}: {result:?}"
        );
    };
    refused(GrayImage {
        width: 0,
        height: 0,
        voxels: Vec::new().into(),
    });
    refused(GrayImage {
        width: 7,
        height: 0,
        voxels: Vec::new().into(),
    });
    refused(GrayImage {
        width: 7,
        height: 7,
        voxels: vec![1; 48].into(),
    });
    refused(GrayImage {
        width: 1 << 20,
        height: 1,
        voxels: vec![1; 1 << 20].into(),
    });
    for quality in [0, 101, 255] {
        let result = encode(&noise(3, 3, 1), &Encoding::Jpeg { quality });
        assert!(
            matches!(result, Err(EncodeError::Jpeg { .. })),
            "{quality}: {result:?}"
        );
    }
}

#[tokio::test]
async fn opening_takes_one_read_or_two() {
    let storage = FaultyStorage::new(Arc::new(MemoryStorage::new()));
    let small = encode(&noise(700, 300, 1), &Encoding::Jpeg { quality: 75 }).unwrap();
    storage.write_durable("small", small.clone()).await.unwrap();
    let index = PyramidIndex::open(&storage, "small").await.unwrap();
    assert_eq!(storage.reads(), 1);
    let voxels = index.read_sub_tile(&storage, 1, 2, 0).await.unwrap();
    assert_eq!(voxels, sub_tile(&index, &small, 1, UVec2::new(2, 0)));

    // Blank, but the index has its full length: 16,900 sub-tiles of level 0.
    let large = GrayImage::new(130 * 128, 130 * 128, vec![0; (130 * 128) * (130 * 128)]);
    let large = encode(&large, &Encoding::Lossless).unwrap();
    storage.write_durable("large", large.clone()).await.unwrap();
    let before = storage.reads();
    let index = PyramidIndex::open(&storage, "large").await.unwrap();
    assert_eq!(storage.reads() - before, 2);
    assert_eq!(index.levels().len(), 9);

    storage.fail_read(1, ReadFault::CutShort { kept: 1000 });
    let cut = PyramidIndex::open(&storage, "large").await;
    assert!(matches!(cut, Err(PyramidError::Broken { .. })), "{cut:?}");
    storage.fail_read(0, ReadFault::Fail);
    assert!(
        PyramidIndex::open(&storage, "small")
            .await
            .unwrap_err()
            .is_transient()
    );
    let absent = PyramidIndex::open(&storage, "absent").await.unwrap_err();
    assert!(!absent.is_transient());
}

#[test]
fn neighbours_are_read_together() {
    let bytes = encode(&noise(2000, 2000, 6), &Encoding::Jpeg { quality: 75 }).unwrap();
    let index = whole(&bytes);
    let block = |x: u32, y: u32, n: u32| {
        (y..y + n).flat_map(move |y| (x..x + n).map(move |x| UVec2::new(x, y)))
    };
    // An aligned block of 4 x 4 is one run of the curve.
    let reads = index.reads(0, block(4, 8, 4), 0);
    assert_eq!(reads.len(), 1);
    assert_eq!(reads[0].sub_tiles.len(), 16);
    // One that is not aligned has gaps.
    let apart = index.reads(0, block(3, 7, 4), 0);
    assert!(apart.len() > 1);
    assert_eq!(index.reads(0, block(3, 7, 4), u64::MAX).len(), 1);
    for read in apart {
        let fetched = &bytes[read.range.start as usize..read.range.end as usize];
        for (at, within) in read.sub_tiles {
            let voxels = index
                .decode_sub_tile(0, at.x, at.y, &fetched[within])
                .unwrap();
            assert_eq!(voxels, sub_tile(&index, &bytes, 0, at));
        }
    }
    // What is asked for twice, or does not exist, is not read twice, or at all.
    let odd = [(15, 15), (15, 15), (16, 15), (3, 99)].map(UVec2::from);
    let reads = index.reads(0, odd, 0);
    assert_eq!(reads.len(), 1);
    assert_eq!(reads[0].sub_tiles.len(), 1);
    assert!(index.reads(99, odd, 0).is_empty());
}

#[test]
fn what_does_not_exist_is_out_of_range() {
    let bytes = encode(&noise(200, 100, 6), &Encoding::Lossless).unwrap();
    let index = whole(&bytes);
    for (level, x, y) in [
        (0, 2, 0),
        (0, 0, 1),
        (1, 1, 0),
        (2, 0, 0),
        (usize::MAX, 0, 0),
    ] {
        assert_eq!(index.sub_tile(level, x, y), None);
        let decoded = index.decode_sub_tile(level, x, y, &[]);
        assert!(
            matches!(decoded, Err(PyramidError::OutOfRange { .. })),
            "{level} {x} {y}"
        );
    }
}

/// Opens a file and decodes all its sub-tiles, as far as they exist; whether all went well.
fn survives(bytes: &[u8]) -> bool {
    let Ok(index) = PyramidIndex::parse(bytes, "test") else {
        return false;
    };
    let mut well = true;
    for (k, level) in index.levels().iter().enumerate() {
        for at in morton::in_morton_order(level.sub_tiles) {
            let entry = index.sub_tile(k, at.x, at.y).expect("it is in the level");
            let range = entry.offset as usize..(entry.offset + u64::from(entry.len)) as usize;
            let stream = bytes.get(range).unwrap_or(&[]);
            well &= index.decode_sub_tile(k, at.x, at.y, stream).is_ok();
        }
        let cells = morton::in_morton_order(level.sub_tiles);
        assert!(
            index
                .reads(k, cells, 4096)
                .iter()
                .all(|r| r.range.start < r.range.end)
        );
    }
    well
}

#[test]
fn a_file_cut_anywhere_is_noticed() {
    for encoding in [Encoding::Lossless, Encoding::Jpeg { quality: 60 }] {
        let bytes = encode(&smooth(300, 200), &encoding).unwrap();
        assert!(survives(&bytes));
        for len in (0..bytes.len()).step_by(37).chain([bytes.len() - 1]) {
            assert!(!survives(&bytes[..len]), "{len} of {} bytes", bytes.len());
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn damaged_files_never_panic(
        jpeg in any::<bool>(),
        big in any::<bool>(),
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), any::<bool>()), 1..12),
    ) {
        let encoding = if jpeg { Encoding::Jpeg { quality: 60 } } else { Encoding::Lossless };
        let file = parts(&smooth(260, 140), &encoding).unwrap().file_of_width(big);
        let mut bytes = file.to_vec();
        let index_len = parse::index_len(&file).unwrap() as usize;
        for (at, value, in_index) in changes {
            let len = if in_index { index_len } else { bytes.len() };
            bytes[at.index(len)] = value;
        }
        survives(&bytes);
    }

    #[test]
    fn any_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..600), big in any::<bool>()) {
        let mut bytes = bytes;
        let head: &[u8] = if big { b"II\x2b\0\x08\0\0\0\x10\0\0\0\0\0\0\0" } else { b"II\x2a\0\x08\0\0\0" };
        prop_assert!(!survives(&bytes));
        bytes.splice(0..0, head.iter().copied());
        prop_assert!(!survives(&bytes));
    }
}
