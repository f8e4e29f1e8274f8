//! Where a tile's image is blank, which says that nothing was acquired there.
//!
//! Blank sub-tiles of the finest level decide for all levels: those of coarser ones are larger, and what is left of a hole
//! in them would be black there, and hide what is seen through it at finer ones.

use bytes::{Buf, BufMut, Bytes, BytesMut};
use glam::{DVec2, UVec2};
use saccade_archive::pyramid::{PyramidIndex, SUB_TILE_EDGE};

/// The blank sub-tiles of the finest level of a pyramid that has such: a bit for each sub-tile.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Holes {
    /// Of the finest level.
    sub_tiles: UVec2,
    bits: Box<[u64]>,
}

/// More sub-tiles than an image may have pixels for.
const MOST: u64 = 1 << 26;

impl Holes {
    /// Those of a pyramid; `None` if it has none.
    pub(super) fn of(index: &PyramidIndex) -> Option<Self> {
        let sub_tiles = index.levels()[0].sub_tiles;
        let rows = (0..sub_tiles.y).map(|y| (y, 0..sub_tiles.x));
        let all = rows.flat_map(|(y, xs)| xs.map(move |x| (x, y)));
        let is_blank = |(x, y)| index.sub_tile(0, x, y).is_none_or(|e| e.is_blank());
        Self::new(sub_tiles, all.map(is_blank))
    }

    /// Whether each sub-tile is blank, x fastest.
    fn new(sub_tiles: UVec2, blank: impl Iterator<Item = bool>) -> Option<Self> {
        let mut bits = vec![0; words(sub_tiles)?].into_boxed_slice();
        let mut any = false;
        for (n, blank) in blank.enumerate() {
            bits[n / 64] |= u64::from(blank) << (n % 64);
            any |= blank;
        }
        any.then_some(Self { sub_tiles, bits })
    }

    fn is_blank(&self, x: u32, y: u32) -> bool {
        let n = y as usize * self.sub_tiles.x as usize + x as usize;
        self.bits[n / 64] >> (n % 64) & 1 == 1
    }

    /// The sub-tile of a position \[pixels of level 0\]; beside the image, the next one.
    fn sub_tile(&self, pixel: DVec2) -> UVec2 {
        let at = pixel.max(DVec2::ZERO).as_uvec2() / SUB_TILE_EDGE;
        at.min(self.sub_tiles - 1)
    }

    /// Whether a position \[pixels of level 0\] is in one.
    pub(super) fn has(&self, pixel: DVec2) -> bool {
        let at = self.sub_tile(pixel);
        self.is_blank(at.x, at.y)
    }

    /// Whether a rectangle \[pixels of level 0\] touches any, and nothing else.
    pub(super) fn within(&self, min: DVec2, max: DVec2) -> (bool, bool) {
        let (low, high) = (self.sub_tile(min), self.sub_tile(max));
        let (mut any, mut all) = (false, true);
        for y in low.y..=high.y {
            for x in low.x..=high.x {
                let blank = self.is_blank(x, y);
                any |= blank;
                all &= blank;
            }
        }
        (any, all)
    }

    /// Memory it takes on the heap \[bytes\].
    pub(super) fn memory(&self) -> usize {
        size_of_val(&*self.bits)
    }

    /// For [`Self::take`].
    pub(super) fn put(holes: Option<&Self>, bytes: &mut BytesMut) {
        let sub_tiles = holes.map_or(UVec2::ZERO, |holes| holes.sub_tiles);
        bytes.put_u32_le(sub_tiles.x);
        bytes.put_u32_le(sub_tiles.y);
        for word in holes.iter().flat_map(|holes| &holes.bits) {
            bytes.put_u64_le(*word);
        }
    }

    /// What [`Self::put`] has put; the outer `None` if it was something else.
    #[expect(clippy::option_option, reason = "most images have none")]
    pub(super) fn take(bytes: &mut Bytes) -> Option<Option<Self>> {
        let sub_tiles = UVec2::new(bytes.try_get_u32_le().ok()?, bytes.try_get_u32_le().ok()?);
        if sub_tiles == UVec2::ZERO {
            return Some(None);
        }
        let words = words(sub_tiles).filter(|words| 8 * words <= bytes.len())?;
        let bits: Box<[u64]> = (0..words).map(|_| bytes.get_u64_le()).collect();
        let has_some = bits.iter().any(|word| *word != 0);
        has_some.then_some(Some(Self { sub_tiles, bits }))
    }
}

/// How many words hold a bit for each sub-tile; `None` if there can be no such image.
fn words(sub_tiles: UVec2) -> Option<usize> {
    let all = u64::from(sub_tiles.x) * u64::from(sub_tiles.y);
    let words = usize::try_from(all.div_ceil(64)).ok()?;
    (1..=MOST).contains(&all).then_some(words)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of 7 x 10 sub-tiles, those for which x + 3 y is a multiple of five.
    fn some() -> Holes {
        let all = (0..10).flat_map(|y| (0..7).map(move |x| x + 3 * y));
        Holes::new(UVec2::new(7, 10), all.map(|n| n % 5 == 0)).unwrap()
    }

    #[test]
    fn positions_are_in_holes_or_not() {
        let holes = some();
        for (x, y) in (0..10).flat_map(|y| (0..7).map(move |x| (x, y))) {
            for (dx, dy) in [(0.0, 0.0), (127.9, 0.5), (64.0, 127.99)] {
                let at = DVec2::new(f64::from(x) * 128.0 + dx, f64::from(y) * 128.0 + dy);
                assert_eq!(holes.has(at), (x + 3 * y) % 5 == 0, "{x} {y}");
            }
        }
        assert!(holes.has(DVec2::splat(-3.0)));
        assert_eq!(holes.has(DVec2::splat(1e9)), (6 + 27) % 5 == 0);
        let at = |x: f64, y: f64| DVec2::new(x, y) * 128.0;
        assert_eq!(holes.within(at(0.1, 0.2), at(0.9, 0.9)), (true, true));
        assert_eq!(holes.within(at(0.1, 0.2), at(1.1, 0.9)), (true, false));
        assert_eq!(holes.within(at(1.1, 0.2), at(4.9, 0.9)), (false, false));
    }

    #[test]
    fn bytes_are_holes_or_none() {
        for holes in [None, Some(some())] {
            let mut put = BytesMut::new();
            Holes::put(holes.as_ref(), &mut put);
            let bytes = put.freeze();
            assert_eq!(Holes::take(&mut bytes.clone()), Some(holes));
            for cut in [0, 3, bytes.len() - 1] {
                assert_eq!(Holes::take(&mut bytes.slice(..cut)), None);
            }
        }
        // None at all, an absurd number, one side of none.
        for sub_tiles in [[1, 1], [u32::MAX, u32::MAX], [0, 3]] {
            let mut bytes = BytesMut::new();
            for n in sub_tiles {
                bytes.put_u32_le(n);
            }
            bytes.put_u64_le(0);
            assert_eq!(Holes::take(&mut bytes.freeze()), None);
        }
    }
}
