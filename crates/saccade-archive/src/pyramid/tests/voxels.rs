//! Voxels of 16 bits, and labels, against oracles that know nothing of sums and votes.

use std::collections::BTreeMap;

use saccade_core::volume::Dtype;

use super::super::layout::SUB_TILE_STATS;
use super::*;
use crate::image::Gray;

/// Values without order: of `most` kinds.
fn scattered<T: Voxel>(width: u32, height: u32, seed: u64, most: u64) -> Gray<T> {
    let mut state = seed ^ 0x9e37_79b9_7f4a_7c15;
    let voxels = (0..width * height).map(|_| {
        state = state
            .wrapping_mul(0x5851_f42d_4c95_7f2d)
            .wrapping_add(0x1405_7b7e_f767_814f);
        T::from_wide((state >> 40) % most)
    });
    Gray::new(width, height, voxels.collect())
}

/// A level's pixels, from its sub-tiles' bytes.
fn pixels(index: &PyramidIndex, bytes: &Bytes, level: usize) -> Vec<u64> {
    let size = index.levels()[level];
    let width = index.dtype().bytes();
    let mut pixels = vec![0; size.width as usize * size.height as usize];
    for at in morton::in_morton_order(size.sub_tiles) {
        let voxels = sub_tile(index, bytes, level, at);
        assert_eq!(voxels.len(), SUB_TILE_VOXELS * width);
        for (i, voxel) in voxels.chunks_exact(width).enumerate() {
            let (x, y) = (
                at.x as usize * EDGE + i % EDGE,
                at.y as usize * EDGE + i / EDGE,
            );
            if x < size.width as usize && y < size.height as usize {
                let value = voxel.iter().rev().fold(0, |v, &b| v << 8 | u64::from(b));
                pixels[y * size.width as usize + x] = value;
            }
        }
    }
    pixels
}

/// The level-0 pixels that a pixel of a level covers.
fn covered<T: Voxel>(image: &Gray<T>, level: usize, x: u32, y: u32) -> Vec<u64> {
    let range = |at: u32, len: u32| at << level..((at + 1) << level).min(len);
    range(y, image.height)
        .flat_map(|y| range(x, image.width).map(move |x| (x, y)))
        .map(|(x, y)| u64::from(image.voxels[(y * image.width + x) as usize].value()))
        .collect()
}

/// The mean by its definition: n * mean lies within n / 2 of the sum; a half goes up.
fn is_mean(values: &[u64], mean: u64) -> bool {
    let (n, twice) = (values.len() as u64, 2 * values.iter().sum::<u64>());
    2 * n * mean <= twice + n && twice + n < 2 * n * (mean + 1)
}

fn mode(values: &[u64]) -> u64 {
    let mut votes = BTreeMap::new();
    for value in values {
        *votes.entry(*value).or_insert(0) += 1;
    }
    let most = *votes.values().max().unwrap();
    *votes.iter().find(|(_, n)| **n == most).unwrap().0
}

fn check_levels<T: Voxel>(image: &Gray<T>, bytes: &Bytes, is: impl Fn(&[u64], u64) -> bool) {
    let index = whole(bytes);
    assert_eq!(index.dtype(), T::DTYPE);
    for (k, level) in index.levels().iter().enumerate() {
        for (i, got) in pixels(&index, bytes, k).into_iter().enumerate() {
            let (x, y) = (i as u32 % level.width, i as u32 / level.width);
            let values = covered(image, k, x, y);
            assert!(
                is(&values, got),
                "{image:?} level {k} pixel {x}, {y}: {got} of {values:?}"
            );
        }
    }
}

#[test]
fn every_level_of_16_bits_is_the_exact_mean() {
    for (width, height) in SIZES {
        let image = scattered::<u16>(width, height, u64::from(width), 1 << 16);
        check_levels(
            &image,
            &encode(&image, &Encoding::Lossless).unwrap(),
            is_mean,
        );
        // The largest sums there are.
        let white = Gray::new(width, height, vec![u16::MAX; image.voxels.len()]);
        check_levels(
            &white,
            &encode(&white, &Encoding::Lossless).unwrap(),
            is_mean,
        );
    }
}

#[test]
fn every_level_of_labels_is_the_most_frequent() {
    for (width, height) in SIZES {
        let seed = u64::from(width);
        let few = scattered::<u8>(width, height, seed, 3);
        check_levels(&few, &encode_labels(&few).unwrap(), |v, got| mode(v) == got);
        let many = scattered::<u16>(width, height, seed, 1 << 16);
        check_levels(&many, &encode_labels(&many).unwrap(), |v, got| {
            mode(v) == got
        });
    }
}

/// Comparisons that cannot fail prove nothing: the winner of winners is not always the winner, a
/// rounded mean of rounded means not always the mean.
#[test]
fn the_oracles_tell_exact_from_repeated_filters() {
    let image = scattered::<u16>(128, 128, 7, 3);
    let twice = |filter: &dyn Fn(&[u64]) -> u64, x, y| {
        let of = |x, y| filter(&covered(&image, 1, x, y));
        let (x, y) = (2 * x, 2 * y);
        filter(&[of(x, y), of(x + 1, y), of(x, y + 1), of(x + 1, y + 1)])
    };
    let mean = |v: &[u64]| (2 * v.iter().sum::<u64>() + v.len() as u64) / (2 * v.len() as u64);
    let places = || (0..32).flat_map(|y| (0..32).map(move |x| (x, y)));
    let modes = places().filter(|&(x, y)| twice(&mode, x, y) != mode(&covered(&image, 2, x, y)));
    let means = places().filter(|&(x, y)| !is_mean(&covered(&image, 2, x, y), twice(&mean, x, y)));
    assert!(modes.count() > 50 && means.count() > 50);
}

#[test]
fn entries_of_16_bits_hold_range_and_mean() {
    let image = scattered::<u16>(300, 140, 9, 50_000);
    let bytes = encode(&image, &Encoding::Lossless).unwrap();
    let entry = whole(&bytes).sub_tile(0, 2, 1).unwrap();
    let exist: Vec<u64> = (128..140)
        .flat_map(|y| (256..300).map(move |x| (x, y)))
        .map(|(x, y)| u64::from(image.voxels[y * 300 + x]))
        .collect();
    assert_eq!(u64::from(entry.min), *exist.iter().min().unwrap());
    assert_eq!(u64::from(entry.max), *exist.iter().max().unwrap());
    assert!(entry.max > 255 && is_mean(&exist, entry.mean.into()));
}

#[test]
fn other_readers_see_16_bits() {
    let image = scattered::<u16>(700, 450, 8, 1 << 16);
    for bytes in [
        encode(&image, &Encoding::Lossless).unwrap(),
        encode_labels(&image).unwrap(),
    ] {
        let mut decoder = Decoder::new(Cursor::new(&bytes)).unwrap();
        let DecodingResult::U16(voxels) = decoder.read_image().unwrap() else {
            panic!("16 bit")
        };
        assert!(image.voxels == voxels);
        let stats = decoder.get_tag(Tag::Unknown(SUB_TILE_STATS)).unwrap();
        assert_eq!(stats.into_u16_vec().unwrap().len(), 6 * 4 * 3);
    }
}

#[test]
fn jpeg_of_16_bits_is_refused_in_words() {
    let image = scattered::<u16>(30, 40, 8, 1 << 16);
    let refused = encode(&image, &Encoding::Jpeg { quality: 85 }).unwrap_err();
    assert!(matches!(refused, EncodeError::JpegDepth));
    assert!(refused.to_string().contains("losslessly"), "{refused}");
}

proptest! {
    #[test]
    fn any_image_comes_back(
        (width, height) in (1_u32..400, 1_u32..400),
        (seed, most, labels) in (any::<u64>(), 1_u64..70_000, any::<bool>()),
    ) {
        let image = scattered::<u16>(width, height, seed, most);
        let bytes = if labels {
            encode_labels(&image).unwrap()
        } else {
            encode(&image, &Encoding::Lossless).unwrap()
        };
        let index = whole(&bytes);
        let values: Vec<_> = image.voxels.iter().map(|&v| u64::from(v)).collect();
        prop_assert_eq!(pixels(&index, &bytes, 0), values);
        let top = index.levels().len() - 1;
        let (x, y) = (index.levels()[top].width - 1, index.levels()[top].height - 1);
        let last = *pixels(&index, &bytes, top).last().unwrap();
        let values = covered(&image, top, x, y);
        let right = if labels { mode(&values) == last } else { is_mean(&values, last) };
        prop_assert!(right);
        prop_assert_eq!(index.dtype(), Dtype::Uint16);
    }

    #[test]
    fn damaged_files_of_16_bits_never_panic(
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), any::<bool>()), 1..12),
    ) {
        let file = encode(&scattered::<u16>(260, 140, 3, 900), &Encoding::Lossless).unwrap();
        let mut bytes = file.to_vec();
        let index_len = parse::index_len(&file).unwrap() as usize;
        for (at, value, in_index) in changes {
            let len = if in_index { index_len } else { bytes.len() };
            bytes[at.index(len)] = value;
        }
        survives(&bytes);
    }
}
