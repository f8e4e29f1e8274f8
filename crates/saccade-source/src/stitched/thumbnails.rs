//! The coarsest level of a tile's pyramid, which is all that coarse levels of the volume show of it.
//!
//! A voxel that is larger than the pixels of a tile's coarsest level is a mean of samples of that level, or the
//! most frequent of labels
//! \[000 §5.2, "Strategy for coarse resolution levels"\]. There the paper keeps the whole coarsest level that is
//! stitched, and halves it. Here what that level is stitched from is kept: 128 x 128 pixels of each tile
//! that was seen. Coarse blocks are made of it whichever tile comes or moves, and no pyramid is opened
//! twice for them, though the index alone of a large pyramid is twenty times as large as its thumbnail.
//!
//! A pyramid never changes, so neither does its thumbnail: there is nothing to be forgotten.

use bytes::{Buf, BufMut, Bytes, BytesMut};
use glam::UVec2;
use saccade_archive::pyramid::{PyramidLevel, SUB_TILE_EDGE, SUB_TILE_VOXELS};
use saccade_core::volume::Dtype;

use super::holes::Holes;
use super::tiles::Fetched;

/// The one sub-tile of a pyramid's coarsest level, decoded.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Thumbnail {
    size: UVec2,
    min: u16,
    max: u16,
    /// Of the whole pyramid.
    holes: Option<Holes>,
    /// Little-endian; none where all pixels have one value.
    voxels: Bytes,
}

impl Thumbnail {
    /// Of `size` pixels with values from `min` to `max`; `voxels` are those of a whole sub-tile, padding
    /// included, and none where `min` is `max`: 0 if it is blank.
    pub(super) fn new(
        size: UVec2,
        (min, max): (u16, u16),
        holes: Option<Holes>,
        voxels: Bytes,
    ) -> Self {
        Self {
            size,
            min,
            max,
            holes,
            voxels,
        }
    }

    pub(super) fn level(&self) -> PyramidLevel {
        PyramidLevel {
            width: self.size.x,
            height: self.size.y,
            sub_tiles: UVec2::ONE,
        }
    }

    pub(super) fn is_blank(&self) -> bool {
        self.max == 0
    }

    /// Where its pyramid is blank, if it is anywhere.
    pub(super) fn holes(&self) -> Option<&Holes> {
        self.holes.as_ref()
    }

    /// Bounds of its values; `None` if it is blank.
    pub(super) fn range(&self) -> Option<(u16, u16)> {
        (!self.is_blank()).then_some((self.min, self.max))
    }

    /// Its sub-tile, as far as it is wanted; a blank one is left out unless it is of `labels`.
    pub(super) fn fetched(&self, wanted: &[UVec2], labels: bool) -> Vec<(UVec2, Fetched)> {
        let there = wanted.iter().filter(|_| labels || !self.is_blank());
        let fetched = there.map(|at| match self.voxels.is_empty() {
            true => (*at, Fetched::Constant(self.min)),
            false => (*at, Fetched::Decoded(self.voxels.clone())),
        });
        fetched.collect()
    }

    /// Memory it takes \[bytes\].
    pub(super) fn memory(&self) -> usize {
        size_of::<Self>() + self.voxels.len() + self.holes.as_ref().map_or(0, Holes::memory)
    }

    /// For [`Self::from_bytes`].
    pub(super) fn to_bytes(&self) -> Bytes {
        let mut bytes = BytesMut::with_capacity(20 + self.memory());
        bytes.put_u32_le(self.size.x);
        bytes.put_u32_le(self.size.y);
        bytes.put_u16_le(self.min);
        bytes.put_u16_le(self.max);
        Holes::put(self.holes(), &mut bytes);
        bytes.put_slice(&self.voxels);
        bytes.freeze()
    }

    /// What bytes were made of; `None` if they were not made of a thumbnail of `dtype`.
    pub(super) fn from_bytes(mut bytes: Bytes, dtype: Dtype) -> Option<Self> {
        let size = UVec2::new(bytes.try_get_u32_le().ok()?, bytes.try_get_u32_le().ok()?);
        let (min, max) = (bytes.try_get_u16_le().ok()?, bytes.try_get_u16_le().ok()?);
        let most = match dtype {
            Dtype::Uint8 => u16::from(u8::MAX),
            _ => u16::MAX,
        };
        let can_be = size.min_element() > 0
            && size.max_element() <= SUB_TILE_EDGE
            && min <= max
            && max <= most;
        if !can_be {
            return None;
        }
        let holes = Holes::take(&mut bytes)?;
        let voxels = if min == max {
            0
        } else {
            SUB_TILE_VOXELS * dtype.bytes()
        };
        (bytes.len() == voxels).then(|| Self::new(size, (min, max), holes, bytes))
    }
}

/// What lies in the cache on disk as a thumbnail: its head, and what its voxels are filled with.
#[cfg(any(test, fuzzing))]
pub(crate) fn fuzz(bytes: &[u8]) {
    let (head, value) = bytes.split_at(bytes.len().min(12));
    for dtype in [Dtype::Uint8, Dtype::Uint16] {
        for (holes, fill) in [0, 1, 9, 40].into_iter().flat_map(|words| {
            [0, SUB_TILE_VOXELS * dtype.bytes()].map(|fill| (8 + 8 * words, fill))
        }) {
            let (holes, value) = value.split_at(value.len().min(holes));
            let filled = value.iter().copied().cycle().take(fill);
            let bytes: Bytes = head.iter().chain(holes).copied().chain(filled).collect();
            let Some(thumbnail) = Thumbnail::from_bytes(bytes.clone(), dtype) else {
                continue;
            };
            assert_eq!(thumbnail.to_bytes(), bytes);
            // All pixels lie in the one sub-tile that there is.
            let PyramidLevel { width, height, .. } = thumbnail.level();
            assert!((1..=SUB_TILE_EDGE).contains(&width) && (1..=SUB_TILE_EDGE).contains(&height));
            assert!(thumbnail.range().is_none_or(|(min, max)| min <= max));
            assert_eq!(thumbnail.range().is_none(), thumbnail.is_blank());
            for (_, fetched) in thumbnail.fetched(&[UVec2::ZERO], true) {
                match fetched {
                    Fetched::Constant(value) => {
                        assert_eq!((value, value), (thumbnail.min, thumbnail.max))
                    }
                    Fetched::Decoded(voxels) => {
                        assert_eq!(voxels.len(), SUB_TILE_VOXELS * dtype.bytes())
                    }
                    _ => panic!("its voxels are there"),
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_a_thumbnail_or_none() {
        let size = UVec2::new(100, 70);
        let voxels = |bytes: usize| Bytes::from(vec![7; SUB_TILE_VOXELS * bytes]);
        let mut holes = BytesMut::new();
        for word in [3, 5, 0b0101, 0] {
            holes.put_u32_le(word);
        }
        let holes = Holes::take(&mut holes.freeze()).unwrap();
        assert!(holes.is_some());
        let of = |range, holes: &Option<Holes>, voxels| {
            Thumbnail::new(size, range, holes.clone(), voxels)
        };
        for (thumbnail, dtype) in [
            (of((3, 9), &None, voxels(1)), Dtype::Uint8),
            (of((3, 900), &holes, voxels(2)), Dtype::Uint16),
            (of((177, 177), &None, Bytes::new()), Dtype::Uint8),
            (of((177, 177), &holes, Bytes::new()), Dtype::Uint8),
            (of((0, 0), &holes, Bytes::new()), Dtype::Uint16),
        ] {
            let bytes = thumbnail.to_bytes();
            for cut in [0, 3, 11, 15, bytes.len() - 1] {
                let cut = bytes.slice(..cut);
                assert_eq!(Thumbnail::from_bytes(cut, dtype), None);
            }
            assert_eq!(Thumbnail::from_bytes(bytes, dtype), Some(thumbnail));
        }
        let of_other_type = of((3, 9), &None, voxels(1)).to_bytes();
        assert_eq!(Thumbnail::from_bytes(of_other_type, Dtype::Uint16), None);
    }
}
