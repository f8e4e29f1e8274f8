//! Colours by stored value.

use saccade_core::transfer::TABLE_LEN;
use saccade_core::volume::{Dtype, Polarity};
use saccade_render::ChannelView;

/// Colours of a channel; entry `i` belongs to stored value `(i - offset) / scale`.
#[derive(Clone, Debug)]
pub(crate) struct Table {
    /// Linear RGB, extinction \[1/nm\].
    pub(crate) colors: Vec<[f32; 4]>,
    /// Entries below an index that are not transparent.
    pub(crate) opaque_before: Vec<u32>,
    pub(crate) scale: f32,
    pub(crate) offset: f32,
}

/// Largest value of a type.
pub(crate) fn largest(dtype: Dtype) -> f64 {
    match dtype {
        Dtype::Uint16 => 65_535.0,
        _ => 255.0,
    }
}

impl Table {
    /// Of a channel of bright structures: other polarities are not measured.
    pub(crate) fn new(view: &ChannelView, dtype: Dtype) -> Self {
        debug_assert_eq!(view.transfer.polarity, Polarity::Bright);
        let largest = largest(dtype);
        let transfer = &view.transfer;
        let (first, span) = match dtype {
            // The values between which colours change share the entries.
            Dtype::Uint16 => {
                let corners = transfer.opacity.iter().map(|point| point.value);
                let corners = corners.chain(transfer.window).chain([view.iso]);
                let corners: Vec<f64> = corners.map(|v| f64::from(v) * largest).collect();
                let low = corners.iter().copied().fold(largest, f64::min);
                let high = corners.iter().copied().fold(0.0, f64::max);
                let low = low.clamp(0.0, largest).floor();
                let span = (high - low).clamp(255.0, largest);
                (low.min(largest - span), span)
            }
            _ => (0.0, largest),
        };
        let scale = 255.0 / span;
        let mut colors = Vec::with_capacity(TABLE_LEN);
        let mut opaque_before = vec![0];
        let mut opaque = 0;
        for index in 0..TABLE_LEN {
            let stored = first + index as f64 / scale;
            let value = single(stored / largest);
            let opacity = match stored < 0.5 {
                true => 0.0,
                false => f64::from(transfer.opacity_at(value).clamp(0.0, 0.999)),
            };
            let extinction = -(-opacity).ln_1p() / transfer.opacity_length_nm;
            let [r, g, b] = transfer.color_at(if stored < 0.5 { 0.0 } else { value });
            colors.push([r, g, b, single(extinction)]);
            opaque += u32::from(extinction > 0.0);
            opaque_before.push(opaque);
        }
        Self {
            colors,
            opaque_before,
            scale: single(scale),
            offset: single(-first * scale),
        }
    }
}

/// The nearest.
#[expect(
    clippy::cast_possible_truncation,
    reason = "the nearest f32 is what is wanted"
)]
pub(crate) fn single(value: f64) -> f32 {
    value as f32
}
