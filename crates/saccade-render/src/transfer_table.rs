//! From a transfer function to the table that shaders read, and to what it hides.

use saccade_core::transfer::{OpacityPoint, TABLE_LEN, TransferFunction};
use saccade_core::volume::{Dtype, Polarity, VoxelKind};

use crate::channel::ChannelView;
use crate::octree::Bins;
use crate::view::Mode;

/// Extinction beyond which nothing is seen any more, yet finite \[1/nm\].
const OPAQUE: f64 = 1e6;

/// A channel's colours by stored value.
///
/// Entry `i` belongs to stored value `(i - offset) / scale`. 8-bit values have an entry each; of 16-bit ones
/// the entries share the range in which what is drawn changes, so that a narrow window is as smooth as a wide one.
#[derive(Clone, Debug)]
pub(crate) struct TransferTable {
    /// Linear RGB, extinction \[1/nm\].
    pub(crate) colors: [[f32; 4]; TABLE_LEN],
    /// Entries below an index that are not transparent.
    opaque_before: [u32; TABLE_LEN + 1],
    /// A bit per bin of stored values: whether any is not transparent.
    pub(crate) visible_bins: u32,
    /// Stored value of the surface, `[0, 1]`.
    pub(crate) iso: f32,
    /// Entries per stored value.
    pub(crate) scale: f32,
    /// Entry of stored value 0.
    pub(crate) offset: f32,
    bins: Bins,
    mode: Mode,
}

/// Largest value of a type.
pub(crate) fn largest(dtype: Dtype) -> u16 {
    match dtype {
        Dtype::Uint16 => u16::MAX,
        _ => u16::from(u8::MAX),
    }
}

/// How the values of a channel are divided among the octree's bins.
pub(crate) fn bins_of(view: &ChannelView, dtype: Dtype) -> Bins {
    Bins::of_bits(match (dtype, view.transfer.polarity) {
        // Inverted, small values are near the largest.
        (Dtype::Uint16, Polarity::Dark) => 16,
        (Dtype::Uint16, Polarity::Bright) => view.significant_bits,
        _ => 8,
    })
}

impl TransferTable {
    pub(crate) fn new(view: &ChannelView, dtype: Dtype, kind: VoxelKind, mode: Mode) -> Self {
        let largest = f64::from(largest(dtype));
        let (first, span) = match dtype {
            Dtype::Uint16 => domain(view, largest, mode),
            _ => (0.0, largest),
        };
        let last_entry = (TABLE_LEN - 1) as f64;
        let scale = last_entry / span;
        let inverted = |value: f64| match view.transfer.polarity {
            Polarity::Bright => value,
            Polarity::Dark => largest + 1.0 - value,
        };
        let iso = inverted(f64::from(view.iso) * largest);
        let mut table = Self {
            colors: [[0.0; 4]; TABLE_LEN],
            opaque_before: [0; TABLE_LEN + 1],
            visible_bins: 0,
            iso: single(iso / largest),
            scale: single(scale),
            offset: single(-first * scale),
            bins: bins_of(view, dtype),
            mode,
        };
        for index in 0..TABLE_LEN {
            let stored = first + index as f64 / scale;
            // Nothing acquired is nothing seen. No value lies between that and an object's number, however many share an entry.
            let stored = match kind {
                VoxelKind::Labels => stored.max(1.0),
                _ => stored,
            };
            let nothing = stored < 0.5;
            let value = if nothing {
                0.0
            } else {
                inverted(stored) / largest
            };
            let [r, g, b] = view.transfer.color_at(single(value));
            let extinction = match mode {
                _ if nothing => 0.0,
                Mode::EmissionAbsorption => extinction(&view.transfer, value),
                Mode::Maximum => 1.0,
                Mode::IsoSurface => f64::from(u8::from(stored >= iso)),
            };
            table.colors[index] = [r, g, b, single(extinction)];
            let opaque = u32::from(table.colors[index][3] > 0.0);
            table.opaque_before[index + 1] = table.opaque_before[index] + opaque;
        }
        for bin in 0..32 {
            let [low, high] = table.bins.values(bin);
            let seen = u32::from(!table.hides(low, high));
            table.visible_bins |= seen << bin;
        }
        table
    }

    /// Whether no stored value between two, ends included, is seen.
    pub(crate) fn hides(&self, low: u16, high: u16) -> bool {
        // As shaders do.
        let at = |value: u16| (f32::from(value) * self.scale + self.offset).clamp(0.0, 255.0);
        #[expect(clippy::cast_possible_truncation, reason = "0 to 255")]
        #[expect(clippy::cast_sign_loss, reason = "0 to 255")]
        let [first, last] = [at(low).floor(), at(high).ceil()].map(|at| at as usize);
        let before = &self.opaque_before;
        high == 0 || before[last + 1] == before[first]
    }

    /// The first and the last entry that is not transparent; the first is beyond the last where none is.
    pub(crate) fn opaque_entries(&self) -> [f32; 2] {
        let opaque = |color: &[f32; 4]| color[3] > 0.0;
        let first = self.colors.iter().position(opaque);
        let last = self.colors.iter().rposition(opaque);
        #[expect(clippy::cast_precision_loss, reason = "a few hundred")]
        [first.unwrap_or(TABLE_LEN) as f32, last.unwrap_or(0) as f32]
    }

    /// Whether no stored value between two is seen, or the largest so far is all that matters and
    /// there is none.
    pub(crate) fn hides_for_good(&self, low: u16, high: u16) -> bool {
        match self.mode {
            Mode::Maximum => high == 0,
            Mode::EmissionAbsorption | Mode::IsoSurface => self.hides(low, high),
        }
    }
}

/// The stored values between which a channel's colours change: the first, and how many. Beyond them it looks as
/// at their ends.
fn domain(view: &ChannelView, largest: f64, mode: Mode) -> (f64, f64) {
    let transfer = &view.transfer;
    let corners = match mode {
        Mode::EmissionAbsorption => changing(&transfer.opacity),
        Mode::Maximum | Mode::IsoSurface => &[],
    };
    let corners = corners.iter().map(|point| point.value);
    let iso = (mode == Mode::IsoSurface).then_some(view.iso);
    let corners = corners.chain(transfer.window).chain(iso);
    let corners = corners.map(|value| f64::from(value) * largest);
    let corners = corners.filter(|value| value.is_finite());
    let (low, high) = corners.fold((largest, 0.0_f64), |(low, high), value| {
        (low.min(value), high.max(value))
    });
    let (low, high) = match transfer.polarity {
        Polarity::Bright => (low, high),
        Polarity::Dark => (largest + 1.0 - high, largest + 1.0 - low),
    };
    let low = low.clamp(0.0, largest).floor();
    let span = (high - low).clamp((TABLE_LEN - 1) as f64, largest);
    (low.min(largest - span), span)
}

/// Corners without those before the first and after the last change of opacity.
fn changing(corners: &[OpacityPoint]) -> &[OpacityPoint] {
    if !corners.is_sorted_by(|a, b| a.value <= b.value) {
        return corners;
    }
    let differ = |pair: &[OpacityPoint]| pair[0].opacity != pair[1].opacity;
    let first = corners.windows(2).position(differ);
    let last = corners.windows(2).rposition(differ);
    match first.zip(last) {
        Some((first, last)) => &corners[first..last + 2],
        None => &[],
    }
}

/// Extinction of a measured value in `[0, 1]` \[1/nm\]: opacity in a form in which interpolation and step length
/// commute.
fn extinction(transfer: &TransferFunction, value: f64) -> f64 {
    let length_nm = transfer.opacity_length_nm.max(f64::MIN_POSITIVE);
    let opacity = transfer.opacity_at(single(value)).clamp(0.0, 0.999);
    (-(-f64::from(opacity)).ln_1p() / length_nm).min(OPAQUE)
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "the nearest f32 is what is wanted"
)]
fn single(value: f64) -> f32 {
    value as f32
}

#[cfg(test)]
#[expect(clippy::cast_possible_truncation, reason = "values are made to fit")]
mod tests {
    use super::*;
    use saccade_core::transfer::ColorMap;

    fn view(polarity: Polarity, points: &[(f32, f32)], window: [f32; 2]) -> ChannelView {
        let point = |&(value, opacity): &(f32, f32)| OpacityPoint { value, opacity };
        let transfer = TransferFunction {
            polarity,
            color_map: ColorMap::Gray,
            window,
            opacity: points.iter().map(point).collect(),
            opacity_length_nm: 100.0,
        };
        ChannelView {
            iso: 0.3,
            significant_bits: 12,
            ..ChannelView::new(0, transfer)
        }
    }

    fn table(view: &ChannelView, dtype: Dtype) -> TransferTable {
        TransferTable::new(view, dtype, VoxelKind::Intensity, Mode::EmissionAbsorption)
    }

    #[test]
    fn eight_bit_has_an_entry_per_value() {
        for polarity in [Polarity::Bright, Polarity::Dark] {
            let view = view(polarity, &[(0.25, 0.8), (0.75, 0.0)], [0.0, 1.0]);
            let table = table(&view, Dtype::Uint8);
            assert_eq!((table.scale, table.offset), (1.0, 0.0));
            let want = view.transfer.table();
            for (got, want) in table.colors.iter().zip(&want) {
                assert!((0..3).all(|c| (got[c] - want[c]).abs() < 1e-6));
                let extinction = -(-want[3]).ln_1p() / 100.0;
                assert!((got[3] - extinction).abs() <= 1e-6 * extinction);
            }
        }
    }

    /// A table over the window is as fine there as one over all values is where it is wide.
    #[test]
    fn a_narrow_window_of_sixteen_bit_is_smooth() {
        for polarity in [Polarity::Bright, Polarity::Dark] {
            let at = |counts: f32| counts / 65_535.0;
            let points = [(at(300.0), 0.0), (at(1300.0), 0.9)];
            let mut view = view(polarity, &points, [at(200.0), at(1400.0)]);
            view.iso = at(800.0);
            let table = table(&view, Dtype::Uint16);
            for measured in (1..3000_u16).step_by(7) {
                let stored = match polarity {
                    Polarity::Bright => measured,
                    Polarity::Dark => measured.wrapping_neg(),
                };
                let x = (f32::from(stored) * table.scale + table.offset).clamp(0.0, 255.0);
                let (low, t) = (x.floor().min(254.0), x - x.floor().min(254.0));
                let [a, b] = [low, low + 1.0].map(|i| table.colors[i as usize][3]);
                let want = extinction(&view.transfer, f64::from(at(f32::from(measured)))) as f32;
                let got = a + t * (b - a);
                let off = (got - want).abs();
                assert!(off < 3e-4, "{polarity:?} {measured}: {got} not {want}");
            }
        }
    }

    /// Corners at the ends of all values, and a surface where none is drawn, take no entries away.
    #[test]
    fn entries_lie_where_colours_change() {
        let at = |counts: f32| counts / 65_535.0;
        let points = [
            (0.0, 0.0),
            (at(300.0), 0.0),
            (at(1300.0), 0.9),
            (at(50_000.0), 0.9),
            (1.0, 0.9),
        ];
        for polarity in [Polarity::Bright, Polarity::Dark] {
            let mut view = view(polarity, &points, [at(200.0), at(1400.0)]);
            view.iso = at(30_000.0);
            // 1200 values on 255 steps between entries.
            let spacing = |view: &ChannelView, mode| {
                let table = TransferTable::new(view, Dtype::Uint16, VoxelKind::Intensity, mode);
                1.0 / f64::from(table.scale)
            };
            for mode in [Mode::EmissionAbsorption, Mode::Maximum] {
                let spacing = spacing(&view, mode);
                assert!(spacing <= 5.0, "{polarity:?} {mode:?}: {spacing} values");
            }
            // Where surfaces are drawn theirs has to be in the table.
            let with_iso = spacing(&view, Mode::IsoSurface);
            assert!((100.0..120.0).contains(&with_iso), "{with_iso}");
            view.iso = at(900.0);
            assert!(spacing(&view, Mode::IsoSurface) <= 5.0);
            // One that changes far away does count.
            view.transfer.opacity[3].opacity = 0.8;
            let wide = spacing(&view, Mode::EmissionAbsorption);
            assert!(wide > 250.0, "{polarity:?}: {wide} values");
        }
    }

    /// Also beyond the first and the last entry the table says what the transfer function says.
    #[test]
    fn flat_ends_are_as_opaque_as_they_should_be() {
        let at = |counts: f32| counts / 65_535.0;
        let points = [(0.0, 0.7), (at(300.0), 0.7), (at(1300.0), 0.2), (1.0, 0.2)];
        for polarity in [Polarity::Bright, Polarity::Dark] {
            let view = view(polarity, &points, [at(200.0), at(1400.0)]);
            let table = table(&view, Dtype::Uint16);
            for measured in (1..u16::MAX).step_by(7) {
                let stored = match polarity {
                    Polarity::Bright => measured,
                    Polarity::Dark => measured.wrapping_neg(),
                };
                let x = (f32::from(stored) * table.scale + table.offset).clamp(0.0, 255.0);
                let (low, t) = (x.floor().min(254.0), x - x.floor().min(254.0));
                let [a, b] = [low, low + 1.0].map(|i| table.colors[i as usize]);
                let value = at(f32::from(measured));
                let want = extinction(&view.transfer, f64::from(value)) as f32;
                let off = (a[3] + t * (b[3] - a[3]) - want).abs();
                assert!(off < 3e-4, "{polarity:?} {measured}: off by {off}");
                let [red, ..] = view.transfer.color_at(value);
                let off = (a[0] + t * (b[0] - a[0]) - red).abs();
                assert!(off < 3e-3, "{polarity:?} {measured}: off by {off}");
            }
            assert!(!table.hides(1, 1) && !table.hides(60_000, 65_535));
        }
    }

    /// However far apart the entries are that the largest number leaves to the small ones.
    #[test]
    fn objects_of_small_numbers_are_as_opaque_as_those_of_large_ones() {
        let largest = 65_535.0;
        for most in [2.0_f32, 300.0, 4000.0, largest] {
            let points = [(0.0, 0.0), (1.0 / largest, 0.85)];
            let view = view(Polarity::Bright, &points, [0.0, most / largest]);
            let of =
                |kind| TransferTable::new(&view, Dtype::Uint16, kind, Mode::EmissionAbsorption);
            let table = of(VoxelKind::Labels);
            let extinction_of = |table: &TransferTable, number: f32| {
                let x = (number * table.scale + table.offset).clamp(0.0, 255.0);
                let low = x.floor().min(254.0);
                let [a, b] = [low, low + 1.0].map(|i| table.colors[i as usize][3]);
                a + (x - low) * (b - a)
            };
            let want = extinction(&view.transfer, 0.5) as f32;
            for number in [1.0, 2.0, 10.0, 100.0, 299.0, most] {
                let got = extinction_of(&table, number);
                assert!((got - want).abs() < 1e-6, "{number} of {most}: {got}");
            }
            assert!(table.hides(0, 0) && !table.hides(0, 1) && !table.hides(1, 1));
            // Where values are shades, those near nothing fade.
            let got = extinction_of(&of(VoxelKind::Intensity), 1.0);
            assert!(most < 1000.0 || got < 0.5 * want, "{most}: {got}");
        }
    }

    #[test]
    fn what_is_hidden_is_transparent_everywhere() {
        let at = |counts: f32| counts / 65_535.0;
        let points = [(at(999.5), 0.0), (at(1000.5), 0.5), (at(4000.0), 0.0)];
        let view = view(Polarity::Bright, &points, [0.0, at(9000.0)]);
        let table = table(&view, Dtype::Uint16);
        assert!(table.hides(0, 900) && table.hides(5000, 65_535));
        assert!(!table.hides(0, 1100) && !table.hides(1000, 1000) && !table.hides(3000, 65_535));
        // Bins of 128 values each.
        let seen = table.visible_bins;
        assert_eq!((seen & 0b111_1111, seen >> 8 & 1), (0, 1), "{seen:b}");
    }

    #[test]
    fn surfaces_hide_what_is_below() {
        for (dtype, largest) in [(Dtype::Uint8, 255.0_f32), (Dtype::Uint16, 65_535.0)] {
            for polarity in [Polarity::Bright, Polarity::Dark] {
                let view = view(polarity, &[(0.0, 1.0)], [0.0, 1.0]);
                let table =
                    TransferTable::new(&view, dtype, VoxelKind::Intensity, Mode::IsoSurface);
                let iso = (table.iso * largest).round() as u16;
                let step = (largest / 100.0).ceil() as u16;
                assert!(table.hides(0, iso - step), "{dtype:?} {polarity:?}");
                assert!(!table.hides(0, iso + 1) && !table.hides(iso + 1, iso + 1));
            }
        }
    }

    #[test]
    fn opacity_of_no_length_is_not_infinite() {
        let mut view = view(Polarity::Bright, &[(0.0, 0.5)], [0.0, 1.0]);
        view.transfer.opacity_length_nm = 100.0;
        let table_8 = table(&view, Dtype::Uint8);
        assert_eq!(
            (table_8.colors[0][3], table_8.opaque_entries()),
            (0.0, [1.0, 255.0])
        );
        assert!((table_8.colors[9][3] - 0.5_f32.ln().abs() / 100.0).abs() < 1e-6);
        for length in [0.0, -1.0, f64::NAN, 1e-300] {
            view.transfer.opacity_length_nm = length;
            for dtype in [Dtype::Uint8, Dtype::Uint16] {
                let colors = table(&view, dtype).colors;
                assert!(colors.iter().flatten().all(|c| c.is_finite()), "{length}");
            }
        }
    }
}
