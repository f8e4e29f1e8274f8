//! Which values samples of a region may have.

use std::ops::Range;

use saccade_core::brick::{BRICK_EDGE, BRICK_STORED_EDGE, BRICK_STORED_VOXELS};

/// Edge of a stored brick \[voxels\].
const STORED: usize = BRICK_STORED_EDGE as usize;
/// Gaps between stored voxels along an axis: in each, a sample lies between two voxels.
const GAPS: usize = STORED - 1;
/// Bins.
const BINS_LOG2: u32 = 5;

/// Bounds of the stored values that a sample may have, and which of 32 bins between them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Values {
    /// A bit per bin of stored values, see [`Bins`]. Interpolation between two voxels reaches all bins
    /// between theirs, and these are set as well.
    pub(crate) bins: u32,
    /// Smallest.
    pub(crate) min: u16,
    /// Largest.
    pub(crate) max: u16,
}

impl Values {
    /// No value at all: there is no sample.
    pub(crate) const NONE: Self = Self {
        bins: 0,
        min: u16::MAX,
        max: 0,
    };
    /// Nothing was acquired: every sample is 0.
    pub(crate) const ZERO: Self = Self {
        bins: 1,
        min: 0,
        max: 0,
    };

    /// Anything from `min` to `max`.
    pub(crate) fn between(min: u16, max: u16, bins: Bins) -> Self {
        Self {
            bins: bins.between(min, max.max(min)),
            min,
            max: max.max(min),
        }
    }

    /// The same with other bins: all that those which were set may hold.
    fn rebinned(self, from: Bins, to: Bins) -> Self {
        let mut bins = 0;
        for bin in (0..32).filter(|bin| self.bins >> bin & 1 == 1) {
            let [first, last] = from.values(bin);
            let (low, high) = (first.max(self.min), last.min(self.max));
            if low <= high {
                bins |= to.between(low, high);
            }
        }
        Self { bins, ..self }
    }

    /// What either may be.
    pub(crate) fn or(self, other: Self) -> Self {
        Self {
            bins: self.bins | other.bins,
            min: self.min.min(other.min),
            max: self.max.max(other.max),
        }
    }

    /// Both bounds in a word, as shaders read them.
    pub(crate) fn range_word(self) -> u32 {
        u32::from(self.min) | u32::from(self.max) << 16
    }

    /// The inverse of [`Self::range_word`], with the bins.
    pub(crate) fn from_words(bins: u32, range: u32) -> Self {
        let [a, b, c, d] = range.to_le_bytes();
        Self {
            bins,
            min: u16::from_le_bytes([a, b]),
            max: u16::from_le_bytes([c, d]),
        }
    }
}

/// How stored values are divided among 32 bins: evenly, up to a power of two. The last bin takes
/// what is larger as well.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Bins {
    /// Values per bin \[log2\].
    shift: u32,
}

impl Bins {
    /// For values of mostly `bits` bits, 5 to 16.
    pub(crate) fn of_bits(bits: u32) -> Self {
        Self {
            shift: bits.clamp(BINS_LOG2, 16) - BINS_LOG2,
        }
    }

    /// The bin of a value.
    pub(crate) fn of(self, value: u16) -> u32 {
        (u32::from(value) >> self.shift).min((1 << BINS_LOG2) - 1)
    }

    /// Bins from that of `low` to that of `high`, which is not smaller, as bits.
    pub(crate) fn between(self, low: u16, high: u16) -> u32 {
        (u32::MAX << self.of(low)) & (u32::MAX >> (31 - self.of(high)))
    }

    /// The values of a bin: first and last.
    pub(crate) fn values(self, bin: u32) -> [u16; 2] {
        let first = (bin << self.shift).min(u32::from(u16::MAX));
        let last = match bin {
            31 => u32::from(u16::MAX),
            _ => ((bin + 1) << self.shift) - 1,
        };
        [first, last].map(|v| u16::try_from(v).expect("at most 16 bits"))
    }
}

/// What the samples of a brick may be, as a whole and, where it pays, by region.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct BrickValues {
    pub(crate) whole: Values,
    /// Per region, x fastest; none where all are alike.
    pub(crate) regions: Option<Vec<Values>>,
}

impl BrickValues {
    /// The same everywhere.
    pub(crate) fn uniform(whole: Values) -> Self {
        Self {
            whole,
            regions: None,
        }
    }

    /// The same with other bins.
    pub(crate) fn rebinned(&self, from: Bins, to: Bins) -> Self {
        let regions = self.regions.as_ref().map(|regions| {
            let regions = regions.iter();
            regions.map(|values| values.rebinned(from, to)).collect()
        });
        Self {
            whole: self.whole.rebinned(from, to),
            regions,
        }
    }

    /// Of a brick's stored voxels with their border, for regions that are ranges of gaps per axis.
    ///
    /// Gap `i` lies between stored voxels `i` and `i + 1`; a sample in it is interpolated from
    /// the eight voxels around.
    pub(crate) fn of_voxels<T>(voxels: &[T], bins: Bins, regions: [&[Range<usize>]; 3]) -> Self
    where
        T: Copy + Default + Ord + Into<u16>,
    {
        debug_assert_eq!(voxels.len(), BRICK_STORED_VOXELS);
        let low = reached(voxels, T::min);
        let high = reached(voxels, T::max);
        let [xs, ys, zs] = regions;
        let mut values = Vec::with_capacity(xs.len() * ys.len() * zs.len());
        for z in zs {
            for y in ys {
                values.extend(xs.iter().map(|x| of_gaps(&low, &high, bins, [x, y, z])));
            }
        }
        let whole = if regions.iter().all(|ranges| cover_all(ranges)) {
            // Each gap was looked at once already.
            values.iter().fold(Values::NONE, |all, v| all.or(*v))
        } else {
            let all = 0..GAPS;
            of_gaps(&low, &high, bins, [&all, &all, &all])
        };
        let alike = values.iter().all(|v| *v == whole);
        Self {
            whole,
            regions: (!alike).then_some(values),
        }
    }
}

/// Whether ranges in order leave no gap out.
fn cover_all(ranges: &[Range<usize>]) -> bool {
    let mut end = 0;
    for range in ranges {
        if range.start > end {
            return false;
        }
        end = end.max(range.end);
    }
    end >= GAPS
}

fn zeros<T: Copy + Default>(count: usize) -> Vec<T> {
    vec![T::default(); count]
}

/// Per gap, x fastest, the smallest (or largest) of the eight voxels around it.
fn reached<T: Copy + Default>(voxels: &[T], of: impl Fn(T, T) -> T + Copy) -> Vec<T> {
    let pairs = |a: &[T], b: &[T], to: &mut [T]| {
        for ((to, a), b) in to.iter_mut().zip(a).zip(b) {
            *to = of(*a, *b);
        }
    };
    let mut along_x = zeros(STORED * STORED * GAPS);
    for (row, to) in voxels
        .chunks_exact(STORED)
        .zip(along_x.chunks_exact_mut(GAPS))
    {
        pairs(row, &row[1..], to);
    }
    let mut along_y = zeros(STORED * GAPS * GAPS);
    for (slice, to) in along_x
        .chunks_exact(STORED * GAPS)
        .zip(along_y.chunks_exact_mut(GAPS * GAPS))
    {
        pairs(slice, &slice[GAPS..], to);
    }
    let mut along_z = zeros(GAPS * GAPS * GAPS);
    pairs(&along_y, &along_y[GAPS * GAPS..], &mut along_z);
    along_z
}

/// What gaps of a region reach together. Where values are noisy, the first rows set nearly all bins that there are to set,
/// and the bounds of a row tell that it has no others.
fn of_gaps<T>(low: &[T], high: &[T], of: Bins, [x, y, z]: [&Range<usize>; 3]) -> Values
where
    T: Copy + Ord + Into<u16>,
{
    let (mut bins, mut min, mut max) = (0, u16::MAX, 0);
    for z in z.clone() {
        for y in y.clone() {
            let row = (z * GAPS + y) * GAPS;
            let row = row + x.start..row + x.end;
            let (low, high) = (&low[row.clone()], &high[row]);
            let (Some(&least), Some(&most)) = (low.iter().min(), high.iter().max()) else {
                continue;
            };
            let (least, most) = (least.into(), most.into());
            min = min.min(least);
            max = max.max(most);
            let reached = of.between(least, most);
            if bins & reached != reached {
                for (&low, &high) in low.iter().zip(high) {
                    bins |= of.between(low.into(), high.into());
                }
            }
        }
    }
    if bins == 0 {
        return Values::NONE;
    }
    Values { bins, min, max }
}

const _: () = assert!(GAPS == BRICK_EDGE as usize + 1);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bins_are_those_between() {
        let eight = Bins::of_bits(8);
        assert_eq!(eight.between(0, 0), 1);
        assert_eq!(eight.between(7, 8), 0b11);
        assert_eq!(eight.between(255, 255), 1 << 31);
        assert_eq!(eight.between(0, 255), u32::MAX);
        for low in 0..=255_u16 {
            for high in [low, (low + 9).min(255), 255] {
                let want = (low >> 3..=high >> 3).fold(0, |bins, bin| bins | 1_u32 << bin);
                assert_eq!(eight.between(low, high), want, "{low} to {high}");
            }
        }
        // Twelve bits in sixteen: what is larger than expected is in the last bin.
        let twelve = Bins::of_bits(12);
        assert_eq!(twelve.between(127, 128), 0b11);
        assert_eq!(twelve.between(4095, 60_000), 1 << 31);
    }

    #[test]
    fn bins_cover_all_values_once() {
        for bits in [5, 8, 12, 16] {
            let bins = Bins::of_bits(bits);
            let mut next = 0_u32;
            for bin in 0..32 {
                let [first, last] = bins.values(bin);
                assert_eq!(u32::from(first), next, "{bits} bits, bin {bin}");
                assert_eq!((bins.of(first), bins.of(last)), (bin, bin));
                next = u32::from(last) + 1;
            }
            assert_eq!(next, 1 << 16);
        }
    }

    /// Whatever the bins were, those after them hold all that may have been, and with the same ones nothing is lost.
    #[test]
    fn other_bins_hold_the_same_values() {
        let all = [5, 8, 12, 16].map(Bins::of_bits);
        for (from, to) in all.into_iter().flat_map(|from| all.map(|to| (from, to))) {
            for low in (0..=u16::MAX).step_by(977) {
                for width in [0, 1, 9, 130, 5000] {
                    let high = low.saturating_add(width);
                    let apart = Values::between(low, high, from).or(Values::between(7, 7, from));
                    let got = apart.rebinned(from, to);
                    let least = Values::between(low, high, to).or(Values::between(7, 7, to));
                    assert_eq!((got.min, got.max), (least.min, least.max));
                    assert_eq!(got.bins & least.bins, least.bins, "{low} to {high}");
                    if from == to {
                        assert_eq!(got, apart);
                    }
                }
            }
            assert_eq!(Values::NONE.rebinned(from, to), Values::NONE);
        }
        // From fine to coarse it is not all of them.
        let few = Values::between(100, 100, all[2]).or(Values::between(4000, 4000, all[2]));
        assert_eq!(few.rebinned(all[2], all[3]).bins.count_ones(), 2);
    }

    #[test]
    fn words_keep_ranges() {
        let values = Values::between(3, 200, Bins::of_bits(8));
        assert_eq!(Values::from_words(values.bins, values.range_word()), values);
        assert_eq!(Values::NONE.or(values), values);
    }

    /// Against interpolation at many places.
    #[test]
    #[expect(clippy::cast_possible_truncation, reason = "values are made to fit")]
    fn samples_stay_within_what_their_region_says() {
        let mut random = 7_u32;
        let voxels: Vec<u8> = (0..BRICK_STORED_VOXELS)
            .map(|i| {
                random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                // Mostly one of two values, so that many bins stay free in places.
                match (random >> 16, i % STORED / 12) {
                    (0..8, _) => 250,
                    (_, 0) => 20,
                    _ => 90,
                }
            })
            .collect();
        let thirds = [0..9, 8..17, 16..25, 24..33];
        let halves = [0..17, 16..33];
        let values = BrickValues::of_voxels(&voxels, Bins::of_bits(8), [&thirds, &halves, &halves]);
        let regions = values.regions.clone().unwrap();
        assert!(regions.iter().any(|v| v.bins.count_ones() < 20));
        let at = |[x, y, z]: [usize; 3]| f64::from(voxels[(z * STORED + y) * STORED + x]);
        let mut tight = 0;
        for n in 0..40_000_u32 {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            // A position in the brick, and the gap it lies in.
            let position = [0, 10, 20].map(|shift| f64::from(random >> shift & 1023) / 32.0);
            let gap = position.map(|p| (p + 0.5).floor() as usize);
            let t = position.map(|p| (p + 0.5).fract());
            let mut sample = 0.0;
            for corner in 0..8_usize {
                let offset = [corner & 1, corner >> 1 & 1, corner >> 2];
                let weight: f64 = (0..3)
                    .map(|a| if offset[a] == 1 { t[a] } else { 1.0 - t[a] })
                    .product();
                sample += weight * at(std::array::from_fn(|a| gap[a] + offset[a]));
            }
            let [x, y, z] = [position[0] / 8.0, position[1] / 16.0, position[2] / 16.0]
                .map(|region| region as usize);
            let region = regions[(z * 2 + y) * 4 + x];
            let bin = (sample / 8.0) as u32;
            assert!(
                region.bins >> bin & 1 == 1,
                "sample {n}: {sample} at {position:?}"
            );
            assert!(f64::from(region.min) <= sample && sample <= f64::from(region.max));
            tight += u32::from(region.bins.count_ones() < 32);
        }
        assert!(tight > 100, "regions that exclude nothing prove nothing");
    }

    /// Against each gap's eight voxels, one by one.
    #[test]
    #[expect(clippy::cast_possible_truncation, reason = "values are made to fit")]
    fn regions_say_no_more_than_their_gaps() {
        let mut random = 99_u32;
        for (kind, spread) in [(0, 3), (1, 40), (2, 255)] {
            let voxels: Vec<u8> = (0..BRICK_STORED_VOXELS)
                .map(|i| {
                    random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    let slope = (i % STORED * kind) as u8;
                    slope.wrapping_add(((random >> 16) % spread) as u8)
                })
                .collect();
            let at = |x, y, z| u16::from(voxels[(z * STORED + y) * STORED + x]);
            let ranges = [0..9, 8..17, 20..20, 24..33];
            let odd = [0..1, 3..19, 32..33];
            let bins = Bins::of_bits(8);
            let got = BrickValues::of_voxels(&voxels, bins, [&ranges, &odd, &ranges]);
            let got = got.regions.unwrap();
            let regions = ranges.iter().flat_map(|z| odd.iter().map(move |y| (z, y)));
            let regions = regions.flat_map(|(z, y)| ranges.iter().map(move |x| (x, y, z)));
            for ((x, y, z), got) in regions.zip(got) {
                let mut want = Values::NONE;
                for z in z.clone() {
                    for y in y.clone() {
                        for x in x.clone() {
                            let corners =
                                (0..8).map(|c| at(x + (c & 1), y + (c >> 1 & 1), z + (c >> 2)));
                            let corners: Vec<_> = corners.collect();
                            let (low, high) = (corners.iter().min(), corners.iter().max());
                            want = want.or(Values::between(*low.unwrap(), *high.unwrap(), bins));
                        }
                    }
                }
                assert_eq!(got, want, "{x:?} {y:?} {z:?}");
            }
        }
    }

    #[test]
    fn bricks_of_one_value_have_no_regions() {
        let quarters = [0..17, 16..33];
        let regions: [&[Range<usize>]; 3] = [&quarters, &quarters, &quarters];
        let bins = Bins::of_bits(8);
        let brick = BrickValues::of_voxels(&[9_u8; BRICK_STORED_VOXELS], bins, regions);
        assert_eq!(brick, BrickValues::uniform(Values::between(9, 9, bins)));
        let deep = Bins::of_bits(12);
        let brick = BrickValues::of_voxels(&[999_u16; BRICK_STORED_VOXELS], deep, regions);
        assert_eq!(brick, BrickValues::uniform(Values::between(999, 999, deep)));
    }
}
