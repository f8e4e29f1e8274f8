//! A first transfer function from a histogram, so that the first look shows structure.

use glam::DVec3;

use super::{ColorMap, OpacityPoint, TransferFunction};
use crate::volume::{Dtype, Polarity};

/// Share of the range of values below which the median means background.
const BACKGROUND_BELOW: f64 = 0.43;

/// Counts of measured values. Value 0, nothing acquired, is not counted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Histogram {
    dtype: Dtype,
    /// One per value of the type.
    counts: Vec<u64>,
}

impl Default for Histogram {
    fn default() -> Self {
        Self::new(Dtype::Uint8)
    }
}

impl Histogram {
    /// Nothing counted yet.
    pub fn new(dtype: Dtype) -> Self {
        Self {
            dtype,
            counts: vec![0; 1 << (8 * dtype.bytes())],
        }
    }

    /// Counts more voxels, as sources give them: of the histogram's type, little-endian.
    pub fn add(&mut self, voxels: &[u8]) {
        match self.dtype {
            Dtype::Uint8 => {
                for &value in voxels {
                    self.counts[usize::from(value)] += 1;
                }
            }
            Dtype::Uint16 => {
                let (values, _) = voxels.as_chunks::<2>();
                for &value in values {
                    self.counts[usize::from(u16::from_le_bytes(value))] += 1;
                }
            }
        }
        self.counts[0] = 0;
    }

    /// Type of the values.
    pub fn dtype(&self) -> Dtype {
        self.dtype
    }

    /// Voxels counted.
    pub fn total(&self) -> u64 {
        self.counts.iter().sum()
    }

    /// Count per value.
    pub fn counts(&self) -> &[u64] {
        &self.counts
    }

    /// Counts of `bars` equal parts of a range of values, `[0, 1]` of the type's: from low to high.
    pub fn bars(&self, [low, high]: [f32; 2], bars: usize) -> Vec<u64> {
        let mut sums = vec![0; bars];
        let largest = f32::from(self.largest());
        let width = (high - low).max(f32::MIN_POSITIVE);
        for (value, &count) in (0..=u16::MAX).zip(&self.counts) {
            let at = (f32::from(value) / largest - low) / width;
            if count > 0 && (0.0..=1.0).contains(&at) {
                #[expect(clippy::cast_possible_truncation, reason = "from 0 to 1")]
                #[expect(clippy::cast_sign_loss, reason = "from 0 to 1")]
                let bar = (at * bars as f32) as usize;
                sums[bar.min(bars.saturating_sub(1))] += count;
            }
        }
        sums
    }

    /// Largest value that the type has.
    pub fn largest(&self) -> u16 {
        match self.dtype {
            Dtype::Uint8 => u16::from(u8::MAX),
            Dtype::Uint16 => u16::MAX,
        }
    }

    /// Smallest value that at least this share of the voxels does not exceed.
    pub fn percentile(&self, share: f64) -> u16 {
        let want = share * self.total() as f64;
        let mut seen = 0;
        for (value, &count) in (0..=u16::MAX).zip(&self.counts) {
            seen += count;
            if seen > 0 && seen as f64 >= want {
                return value;
            }
        }
        self.largest()
    }

    /// Bits that nearly all values counted fit in, 8 at least; all the type has where none was counted.
    pub fn significant_bits(&self) -> u32 {
        match self.total() {
            0 => self.largest().ilog2() + 1,
            _ => (self.percentile(0.9999).max(1).ilog2() + 1).max(8),
        }
    }

    /// Where the structures are. Electron micrographs fill their range of values, bulk in the
    /// middle or above, and their membranes are dark; a field of labelled cells is mostly
    /// background near the low end, and what is labelled is bright.
    pub fn polarity(&self) -> Polarity {
        let [low, middle, high] = [0.005, 0.5, 0.995].map(|p| f64::from(self.percentile(p)));
        if middle - low > BACKGROUND_BELOW * (high - low) {
            Polarity::Dark
        } else {
            Polarity::Bright
        }
    }

    /// A first transfer function, colours between the 0.5th and 99.5th percentile.
    ///
    /// Dense tissue (dark structures) is shown as a block whose faces look like its sections, only
    /// its brightest parts being translucent; labelled cells (bright structures) are shown in a
    /// transparent background.
    ///
    /// `size_nm` is the volume's size \[nm\]: opacity is chosen so that a ray sees some depth of a
    /// block and a thin slab is still seen. An empty histogram gives a plain ramp over all values.
    pub fn transfer_function(&self, size_nm: DVec3) -> TransferFunction {
        self.transfer_function_of(self.polarity(), size_nm)
    }

    /// [`Self::transfer_function`] where it is known which structures are to be seen.
    pub fn transfer_function_of(&self, polarity: Polarity, size_nm: DVec3) -> TransferFunction {
        let largest = f32::from(self.largest());
        let unit = |v: u16| f32::from(v) / largest;
        let step = 1.0 / largest;
        let [low, high] = if self.total() == 0 {
            [0.0, 1.0]
        } else {
            [0.005, 0.995].map(|p| unit(self.percentile(p)))
        };
        // Where all values are one, as in masks, that one is what is to be seen, and not the least of many.
        let one = self.total() > 0 && low == high;
        let low = if one { 0.0 } else { low };
        let high = if one {
            high
        } else {
            high.max(low + 2.0 * step)
        };
        let point = |value, opacity| OpacityPoint { value, opacity };
        let (longest, shortest) = (size_nm.max_element(), size_nm.min_element());
        let (opacity, opacity_length_nm) = match polarity {
            Polarity::Dark => {
                let from = unit(self.percentile(0.05)).max(low + 0.5 * step);
                let to = unit(self.percentile(0.97)).max(from + step);
                let points = vec![point(from, 0.95), point(to, 0.35)];
                (points, (longest / 128.0).min(shortest / 4.0))
            }
            Polarity::Bright => {
                let background = unit(self.percentile(0.60)).min(high - 1.5 * step);
                let from = if one { high / 2.0 } else { background.max(low) };
                let points = vec![point(from, 0.0), point(high, 0.85)];
                (points, (longest / 64.0).min(shortest / 2.0))
            }
        };
        TransferFunction {
            polarity,
            color_map: ColorMap::Gray,
            window: [low, high],
            opacity,
            opacity_length_nm,
        }
    }

    /// A first transfer function where values are numbers of objects: all are seen alike, whatever their numbers, and the surface between
    /// the opacities' ends is theirs.
    pub fn transfer_function_of_labels(&self, size_nm: DVec3) -> TransferFunction {
        let largest = f32::from(self.largest());
        let high = match self.total() {
            0 => 1.0,
            _ => f32::from(self.percentile(1.0)) / largest,
        };
        let (longest, shortest) = (size_nm.max_element(), size_nm.min_element());
        let point = |value, opacity| OpacityPoint { value, opacity };
        TransferFunction {
            polarity: Polarity::Bright,
            // Not from black, where small numbers beside large ones could not be seen.
            color_map: ColorMap::Viridis,
            window: [0.0, high.max(2.0 / largest)],
            opacity: vec![point(0.0, 0.0), point(1.0 / largest, 0.85)],
            opacity_length_nm: (longest / 64.0).min(shortest / 2.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn objects_are_seen_whatever_their_numbers() {
        for dtype in [Dtype::Uint8, Dtype::Uint16] {
            let mut histogram = Histogram::new(dtype);
            let empty = histogram.transfer_function_of_labels(DVec3::splat(1000.0));
            assert_eq!(empty.window, [0.0, 1.0]);
            for number in [1_u16, 7, 90, 201] {
                let bytes = number.to_le_bytes();
                for _ in 0..number {
                    histogram.add(&bytes[..dtype.bytes()]);
                }
            }
            // By its shades, that would be dark matter, of which the largest numbers are none.
            assert_eq!(histogram.polarity(), Polarity::Dark);
            let tf = histogram.transfer_function_of_labels(DVec3::splat(1000.0));
            assert_eq!(tf.polarity, Polarity::Bright);
            let largest = f32::from(histogram.largest());
            let opacity = |number: u16| tf.opacity_at(f32::from(number) / largest);
            for number in [1, 7, 90, 201] {
                assert_eq!(opacity(number), opacity(201));
                assert!(opacity(number) > 0.8);
            }
            // Small ones are seen beside large ones as well.
            assert!(tf.color_at(1.0 / largest).into_iter().fold(0.0, f32::max) > 0.05);
            let [least, most] = tf.window.map(|v| v * largest);
            assert!(least == 0.0 && (most - 201.0).abs() < 0.01);
        }
    }

    fn bell(centre: f64, width: f64, tail_centre: f64) -> Histogram {
        let mut histogram = Histogram::default();
        for value in 1..=255_u8 {
            let bump = |c: f64, w: f64| (-((f64::from(value) - c) / w).powi(2)).exp();
            let count = 10_000.0 * bump(centre, width) + 1_000.0 * bump(tail_centre, width);
            #[expect(clippy::cast_possible_truncation, reason = "at most 11,000")]
            histogram.add(&vec![value; count as usize]);
        }
        histogram
    }

    #[test]
    fn em_is_dark_on_bright_and_fluorescence_is_not() {
        let em = bell(170.0, 20.0, 80.0);
        let tf = em.transfer_function(DVec3::splat(1000.0));
        assert_eq!(tf.polarity, Polarity::Dark);
        let [membrane, cytoplasm] = [80.0, 200.0].map(|v| tf.opacity_at(v / 255.0));
        assert!(
            membrane > 0.8 && membrane > 2.0 * cytoplasm,
            "{membrane} and {cytoplasm}"
        );

        let fluorescence = bell(30.0, 10.0, 160.0);
        let tf = fluorescence.transfer_function(DVec3::splat(1000.0));
        assert_eq!(tf.polarity, Polarity::Bright);
        assert!(tf.opacity_at(160.0 / 255.0) > 0.5 && tf.opacity_at(20.0 / 255.0) < 0.05);
    }

    #[test]
    fn a_thin_slab_is_seen() {
        let tf = bell(30.0, 10.0, 160.0).transfer_function(DVec3::new(4e5, 2e5, 600.0));
        let slab = super::super::opacity_of_length(0.8, 600.0, tf.opacity_length_nm);
        assert!(slab > 0.9, "three sections across show only {slab}");
    }

    /// A mask is as bright as can be, whatever its value, also where a few voxels have another.
    #[test]
    fn a_mask_is_seen() {
        for (dtype, value) in [
            (Dtype::Uint8, 1_u16),
            (Dtype::Uint8, 128),
            (Dtype::Uint8, 255),
            (Dtype::Uint16, 1),
            (Dtype::Uint16, 30_000),
            (Dtype::Uint16, u16::MAX),
        ] {
            let mut mask = Histogram::new(dtype);
            mask.counts[usize::from(value)] = 10_000;
            if value < mask.largest() {
                mask.counts[usize::from(value) + 1] = 3;
            }
            let seen = f32::from(value) / f32::from(mask.largest());
            for tf in [
                mask.transfer_function(DVec3::splat(1000.0)),
                mask.transfer_function_of(Polarity::Bright, DVec3::splat(1000.0)),
            ] {
                assert_eq!((tf.polarity, tf.window), (Polarity::Bright, [0.0, seen]));
                assert!(tf.opacity_at(seen) > 0.8, "{dtype:?} {value}: {tf:?}");
                assert!(
                    tf.opacity_at(seen / 3.0) < 0.01,
                    "{dtype:?} {value}: {tf:?}"
                );
                assert!(tf.color_at(seen)[0] > 0.99, "{dtype:?} {value}: {tf:?}");
            }
        }
    }

    /// Twelve bits in sixteen look as the same values in eight do.
    #[test]
    fn depth_does_not_change_the_look() {
        let eight = bell(30.0, 10.0, 160.0);
        let mut sixteen = Histogram::new(Dtype::Uint16);
        for (value, &count) in (0..=255_u16).zip(eight.counts()) {
            sixteen.add(
                &(value * 16)
                    .to_le_bytes()
                    .repeat(usize::try_from(count).unwrap()),
            );
        }
        assert_eq!(
            (sixteen.total(), eight.total()),
            (sixteen.total(), sixteen.total())
        );
        assert_eq!(
            (eight.significant_bits(), sixteen.significant_bits()),
            (8, 12)
        );
        let size = DVec3::splat(1000.0);
        let [of_eight, of_sixteen] = [&eight, &sixteen].map(|h| h.transfer_function(size));
        assert_eq!(of_eight.polarity, of_sixteen.polarity);
        let scale = 16.0 * 255.0 / 65_535.0;
        for (a, b) in of_eight.opacity.iter().zip(&of_sixteen.opacity) {
            assert!((a.value * scale - b.value).abs() < 1e-5 && a.opacity == b.opacity);
        }
        assert_eq!(
            eight.bars([0.0, 1.0], 256).iter().sum::<u64>(),
            eight.total()
        );
        let few = sixteen.bars([0.0, 255.0 * 16.0 / 65_535.0], 8);
        let same = eight.bars([0.0, 1.0], 8);
        assert!(
            few.iter()
                .zip(&same)
                .all(|(a, b)| a.abs_diff(*b) * 20 <= eight.total()),
            "{few:?}, {same:?}"
        );
    }

    #[test]
    fn degenerate_histograms_give_rising_corners() {
        let mut constant = Histogram::default();
        constant.add(&[255; 100]);
        for histogram in [Histogram::default(), constant] {
            let tf = histogram.transfer_function(DVec3::ONE);
            assert!(
                tf.opacity.windows(2).all(|p| p[0].value < p[1].value),
                "{:?}",
                tf.opacity
            );
            assert!(tf.window[0] < tf.window[1]);
        }
    }
}
