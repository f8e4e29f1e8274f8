//! Transfer functions: from value to colour and opacity.

mod auto;
mod color_map;

use serde::{Deserialize, Serialize};

use crate::volume::Polarity;

pub use auto::Histogram;
pub use color_map::{ColorMap, ColorMapError};

/// Entries of the table that the renderer samples.
pub const TABLE_LEN: usize = 256;

/// A corner of the piecewise linear opacity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OpacityPoint {
    /// Voxel value, `[0, 1]` of the value type's range.
    pub value: f32,
    /// Opacity of a slab of [`TransferFunction::opacity_length_nm`], `[0, 1]`.
    pub opacity: f32,
}

/// How values become light: colour from a map, opacity from a polyline.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransferFunction {
    /// Which end of the values is to be seen.
    pub polarity: Polarity,
    /// Colours along the window.
    pub color_map: ColorMap,
    /// Values at the two ends of the colour map, `[0, 1]`.
    pub window: [f32; 2],
    /// Corners, by rising value; constant beyond the first and the last.
    pub opacity: Vec<OpacityPoint>,
    /// Thickness to which opacities apply \[nm\]: pictures do not depend on the step size.
    pub opacity_length_nm: f64,
}

impl TransferFunction {
    /// Opacity of a value in `[0, 1]`.
    pub fn opacity_at(&self, value: f32) -> f32 {
        let Some(first) = self.opacity.first() else {
            return 0.0;
        };
        let next = self.opacity.partition_point(|p| p.value <= value);
        if next == 0 {
            return first.opacity;
        }
        let a = self.opacity[next - 1];
        let Some(b) = self.opacity.get(next) else {
            return a.opacity;
        };
        let t = (value - a.value) / (b.value - a.value);
        a.opacity + t * (b.opacity - a.opacity)
    }

    /// Linear RGB of a value in `[0, 1]`.
    pub fn color_at(&self, value: f32) -> [f32; 3] {
        let [low, high] = self.window;
        let span = high - low;
        let t = if span.abs() < 1e-6 {
            f32::from(value >= low)
        } else {
            (value - low) / span
        };
        // Of a window that is no number, too.
        let t = if t.is_nan() { 0.0 } else { t.clamp(0.0, 1.0) };
        self.color_map.linear_rgb(t)
    }

    /// Colour and opacity for each value *as bricks store it* ([`Polarity::stored`]): linear RGB,
    /// not multiplied by opacity, and the opacity of [`Self::opacity_length_nm`].
    ///
    /// Entry 0, nothing acquired, is transparent.
    pub fn table(&self) -> [[f32; 4]; TABLE_LEN] {
        let mut table = [[0.0; 4]; TABLE_LEN];
        for (stored, entry) in (0..=u8::MAX).zip(&mut table) {
            let value = f32::from(self.polarity.stored(stored)) / 255.0;
            let [r, g, b] = self.color_at(value);
            let opacity = if stored == 0 {
                0.0
            } else {
                self.opacity_at(value).clamp(0.0, 0.999)
            };
            *entry = [r, g, b, opacity];
        }
        table
    }
}

/// Opacity of a slab `length` thick, when one of `reference` length has `opacity`.
pub fn opacity_of_length(opacity: f64, length: f64, reference: f64) -> f64 {
    1.0 - (1.0 - opacity).powf(length / reference)
}

/// Linear light from an sRGB value, both in `[0, 1]`.
pub fn linear_from_srgb(srgb: f32) -> f32 {
    if srgb <= 0.040_45 {
        srgb / 12.92
    } else {
        ((srgb + 0.055) / 1.055).powf(2.4)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp() -> TransferFunction {
        let point = |value, opacity| OpacityPoint { value, opacity };
        TransferFunction {
            polarity: Polarity::Dark,
            color_map: ColorMap::Gray,
            window: [0.0, 1.0],
            opacity: vec![point(0.25, 0.8), point(0.75, 0.0)],
            opacity_length_nm: 100.0,
        }
    }

    #[test]
    fn opacity_is_piecewise_linear() {
        let tf = ramp();
        for (value, want) in [(0.0, 0.8), (0.25, 0.8), (0.5, 0.4), (0.75, 0.0), (1.0, 0.0)] {
            assert!((tf.opacity_at(value) - want).abs() < 1e-6, "at {value}");
        }
    }

    #[test]
    fn windows_that_are_no_numbers_have_colours_that_are() {
        let numbers = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 0.0, 0.5, -1e30];
        for window in numbers.into_iter().flat_map(|a| numbers.map(|b| [a, b])) {
            let transfer = TransferFunction { window, ..ramp() };
            for value in [0.0, 0.3, 1.0] {
                let color = transfer.color_at(value);
                let holds = color.iter().all(|c| (0.0..=1.0).contains(c));
                assert!(holds, "{window:?} at {value}: {color:?}");
            }
        }
        assert!(ramp().color_at(0.9) > ramp().color_at(0.1));
    }

    #[test]
    fn nothing_acquired_is_transparent() {
        let table = ramp().table();
        assert_eq!(table[0][3], 0.0, "value 0 would be opaque");
        assert!(
            table[255][3] > 0.7,
            "the darkest measured value is stored as 255"
        );
        assert_eq!(table[1][3], 0.0);
    }

    #[test]
    fn opacity_does_not_depend_on_the_step() {
        let whole = opacity_of_length(0.7, 8.0, 3.0);
        for steps in [1_u8, 2, 16, 128] {
            let one = opacity_of_length(0.7, 8.0 / f64::from(steps), 3.0);
            let all = 1.0 - (1.0 - one).powi(i32::from(steps));
            assert!((all - whole).abs() < 1e-12, "{steps} steps");
        }
    }
}
