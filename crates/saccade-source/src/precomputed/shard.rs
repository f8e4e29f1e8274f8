//! Which shard a chunk is in, and where.
//!
//! Neuroglancer's `sharded.md` tells the format.

use std::ops::Range;

use bytes::Bytes;
use glam::UVec3;

use super::info::Sharding;
use crate::codecs::{Codec, Damage};
use crate::flights::Weighed;

/// An index of a minishard that is longer than this is refused \[bytes\].
pub(super) const MOST_INDEX: u64 = 64 << 20;

/// A chunk's number: the bits of its position, taken in turns from x, y and z, as long as the axis has any.
pub(super) fn compressed_morton(at: UVec3, grid: UVec3) -> u64 {
    let (mut number, mut bit) = (0_u64, 0);
    for level in 0..32 {
        for axis in 0..3 {
            if level < 32 && (1_u64 << level) < u64::from(grid[axis]) {
                number |= u64::from(at[axis] >> level & 1).unbounded_shl(bit);
                bit += 1;
            }
        }
    }
    number
}

/// Where a chunk's index is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct Minishard {
    pub(super) shard: u64,
    pub(super) minishard: u64,
}

impl Sharding {
    /// The minishard of a chunk's number.
    pub(super) fn minishard(&self, number: u64) -> Minishard {
        let shifted = number.unbounded_shr(self.preshift_bits);
        let hashed = if self.murmur {
            murmur(shifted)
        } else {
            shifted
        };
        let low = |bits: u32| 1_u64.unbounded_shl(bits).wrapping_sub(1);
        Minishard {
            minishard: hashed & low(self.minishard_bits),
            shard: hashed.unbounded_shr(self.minishard_bits) & low(self.shard_bits),
        }
    }

    /// A shard's object below its level.
    pub(super) fn name(&self, shard: u64) -> String {
        let width = self.shard_bits.div_ceil(4) as usize;
        format!("{shard:0width$x}.shard")
    }

    /// Bytes of the index at a shard's beginning.
    pub(super) fn index_bytes(&self) -> u64 {
        16 << self.minishard_bits
    }
}

/// The first half of `MurmurHash3_x86_128` of eight bytes.
fn murmur(key: u64) -> u64 {
    let (low, high) = (key & 0xffff_ffff, key >> 32);
    let part = |value: u64| u32::try_from(value).expect("32 bits");
    let (low, high) = (part(low), part(high));
    let mut h = [0_u32; 4];
    let mixed = high.wrapping_mul(0xab0e_9789).rotate_left(16);
    h[1] ^= mixed.wrapping_mul(0x38b3_4ae5);
    let mixed = low.wrapping_mul(0x239b_961b).rotate_left(15);
    h[0] ^= mixed.wrapping_mul(0xab0e_9789);
    for h in &mut h {
        *h ^= 8;
    }
    let stirred = |h: &mut [u32; 4]| {
        h[0] = h[0]
            .wrapping_add(h[1])
            .wrapping_add(h[2])
            .wrapping_add(h[3]);
        for n in 1..4 {
            h[n] = h[n].wrapping_add(h[0]);
        }
    };
    stirred(&mut h);
    for h in &mut h {
        *h = (*h ^ *h >> 16).wrapping_mul(0x85eb_ca6b);
        *h = (*h ^ *h >> 13).wrapping_mul(0xc2b2_ae35);
        *h ^= *h >> 16;
    }
    stirred(&mut h);
    u64::from(h[1]) << 32 | u64::from(h[0])
}

/// No shard is longer \[bytes\]: an empty minishard that is said to lie behind that is damage, not absence.
const LONGEST: u64 = 1 << 48;

/// Bytes of a minishard's index within its shard, from its entry of the shard's index; `None` if it is empty.
pub(super) fn index_range(entry: &[u8], sharding: &Sharding) -> Result<Option<Range<u64>>, Damage> {
    let [start, end] = *entry.as_chunks::<8>().0 else {
        return Err("its index is too short".to_owned());
    };
    let (start, end) = (u64::from_le_bytes(start), u64::from_le_bytes(end));
    let base = sharding.index_bytes();
    let range = base.checked_add(start).zip(base.checked_add(end));
    match range {
        Some((start, end)) if start == end && end <= LONGEST => Ok(None),
        Some((start, end)) if start < end && end - start <= MOST_INDEX => Ok(Some(start..end)),
        _ => Err(format!(
            "its index says bytes {start} to {end}, which cannot be"
        )),
    }
}

/// Where the chunks of a minishard are: numbers and ranges, sorted.
#[derive(Clone, Debug)]
pub(super) struct Index(Vec<(u64, Range<u64>)>);

impl Weighed for Index {
    fn bytes(&self) -> u64 {
        self.0.len() as u64 * 24
    }
}

impl Index {
    /// Of its bytes in the shard.
    pub(super) fn read(bytes: Bytes, sharding: &Sharding) -> Result<Self, Damage> {
        let bytes = match sharding.index_gzip {
            true => Codec::Gzip.decode(bytes, usize::try_from(MOST_INDEX).unwrap_or(usize::MAX)),
            false => Ok(bytes),
        };
        let bytes = bytes.map_err(|damage| format!("its index: {damage}"))?;
        let (numbers, rest) = bytes.as_chunks::<8>();
        if !rest.is_empty() || !numbers.len().is_multiple_of(3) {
            return Err(format!(
                "its index has {} bytes, which 24 does not divide",
                bytes.len()
            ));
        }
        let count = numbers.len() / 3;
        let number = |row: usize, n: usize| u64::from_le_bytes(numbers[row * count + n]);
        let (mut id, mut end) = (0_u64, sharding.index_bytes());
        let mut chunks = Vec::with_capacity(count);
        for n in 0..count {
            id = id.wrapping_add(number(0, n));
            let begin = end.checked_add(number(1, n));
            let range = begin.and_then(|begin| Some(begin..begin.checked_add(number(2, n))?));
            let range = range.ok_or("its index says bytes that no file has")?;
            end = range.end;
            chunks.push((id, range));
        }
        chunks.sort_by_key(|(id, _)| *id);
        Ok(Self(chunks))
    }

    /// A chunk's bytes within the shard; `None` if it is not stored.
    pub(super) fn chunk(&self, number: u64) -> Option<Range<u64>> {
        let found = self.0.binary_search_by_key(&number, |(id, _)| *id);
        found.ok().map(|n| self.0[n].1.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Values of tensorstore's and Neuroglancer's own tests of the same function.
    #[test]
    fn numbers_take_bits_in_turns() {
        let grid = UVec3::new(3, 5, 1);
        let of = |x, y| compressed_morton(UVec3::new(x, y, 0), grid);
        assert_eq!(
            [
                of(0, 0),
                of(1, 0),
                of(0, 1),
                of(2, 0),
                of(0, 2),
                of(0, 4),
                of(2, 4)
            ],
            [0, 1, 2, 4, 8, 16, 20]
        );
        let largest = UVec3::splat((1 << 21) - 1);
        assert_eq!(
            compressed_morton(largest, UVec3::splat(1 << 21)),
            (1 << 63) - 1
        );
    }

    #[test]
    fn indices_that_lie_are_refused() {
        let sharding = Sharding {
            preshift_bits: 0,
            murmur: false,
            minishard_bits: 1,
            shard_bits: 0,
            index_gzip: false,
            data_gzip: false,
        };
        let index = |numbers: &[u64]| {
            Index::read(
                numbers.iter().flat_map(|n| n.to_le_bytes()).collect(),
                &sharding,
            )
        };
        let good = index(&[5, 2, 0, 10, 7, 8]).unwrap();
        assert_eq!(
            (good.chunk(5), good.chunk(7), good.chunk(6)),
            (Some(32..39), Some(49..57), None)
        );
        assert!(index(&[1, 2]).is_err() && index(&[1, u64::MAX, 5]).is_err());
        let entry = |start: u64, end: u64| {
            index_range(
                &[start.to_le_bytes(), end.to_le_bytes()].concat(),
                &sharding,
            )
        };
        assert_eq!((entry(3, 3), entry(3, 9)), (Ok(None), Ok(Some(35..41))));
        assert!(
            entry(9, 3).is_err()
                && entry(0xaaaa_aaaa_aaaa_aaaa, 0xaaaa_aaaa_aaaa_aaaa).is_err()
                && entry(u64::MAX, u64::MAX).is_err()
                && entry(0, u64::MAX).is_err()
                && index_range(&[1], &sharding).is_err()
        );
    }
}
