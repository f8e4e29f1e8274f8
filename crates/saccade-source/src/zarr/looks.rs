//! How channels are meant to be shown: what `omero` says, as far as it says anything.

use saccade_core::volume::{Dtype, Look};

use super::metadata::Channel;
use crate::values::Values;

/// Looks of so many channels, whose values are shown as `values` has them; none if nothing is said.
///
/// Programs write the block whether or not anybody chose anything. A window of all that the type can hold says nothing, nor does a colour
/// that all channels have, nor that all are switched off.
pub(super) fn looks(said: &[Channel], count: usize, values: &Values, dtype: Dtype) -> Vec<Look> {
    let said = &said[..said.len().min(count)];
    let same = said.windows(2).all(|pair| pair[0].color == pair[1].color);
    let plain = match said {
        [one] => one.color == Some([255; 3]),
        _ => same,
    };
    let none_is_seen = said.iter().all(|channel| !channel.active) && said.len() == count;
    let looks: Vec<Look> = said
        .iter()
        .map(|channel| Look {
            color: channel.color.filter(|_| !plain),
            window: channel
                .window
                .and_then(|window| share(window, values, dtype)),
            hidden: !channel.active && !none_is_seen,
        })
        .collect();
    match looks.iter().all(|look| *look == Look::default()) {
        true => Vec::new(),
        false => looks,
    }
}

/// A window of stored numbers as values of the volume, `[0, 1]` of their type's range.
fn share(window: [f64; 2], values: &Values, dtype: Dtype) -> Option<[f32; 2]> {
    let (factor, shift) = values.scale();
    let largest = match dtype {
        Dtype::Uint16 => f64::from(u16::MAX),
        _ => f64::from(u8::MAX),
    };
    let [low, high] = window.map(|number| (number * factor + shift) / largest);
    // Scaled windows begin at value 1.
    let says_nothing = low * largest <= 1.0 && high >= 1.0;
    #[expect(clippy::cast_possible_truncation, reason = "from 0 to 1")]
    let window = [low.clamp(0.0, 1.0) as f32, high.clamp(0.0, 1.0) as f32];
    (!says_nothing && !values.are_names() && window[0] < window[1]).then_some(window)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::values::{Number, Spread};

    fn channel(color: [u8; 3], window: [f64; 2], active: bool) -> Channel {
        Channel {
            color: Some(color),
            window: Some(window),
            active,
            ..Channel::default()
        }
    }

    fn of_u16(said: &[Channel]) -> Vec<Look> {
        let values = Values::kept(Number::U16, false).unwrap();
        looks(said, said.len(), &values, Dtype::Uint16)
    }

    #[test]
    fn what_is_said_is_kept_and_what_says_nothing_is_not() {
        let looks = of_u16(&[
            channel([0, 0, 255], [0.0, 655.35], true),
            channel([255, 255, 0], [0.0, 65_535.0], false),
        ]);
        let [blue, yellow] = looks[..] else {
            panic!("{looks:?}")
        };
        assert_eq!((blue.color, blue.hidden), (Some([0, 0, 255]), false));
        assert_eq!(blue.window, Some([0.0, 0.01]));
        assert_eq!((yellow.color, yellow.hidden), (Some([255, 255, 0]), true));
        assert_eq!(yellow.window, None, "all values");
        // Written by programs for which nobody chose anything.
        let whole = [0.0, 65_535.0];
        assert_eq!(of_u16(&[channel([255; 3], whole, true)]), []);
        let same = [
            channel([128; 3], whole, true),
            channel([128; 3], whole, true),
        ];
        assert_eq!(of_u16(&same), []);
        let off = [channel([1; 3], whole, false), channel([2; 3], whole, false)];
        assert!(of_u16(&off).iter().all(|look| !look.hidden));
        assert_eq!(of_u16(&[]), []);
        // More are described than there are.
        let values = Values::kept(Number::U16, false).unwrap();
        let one = looks_of_first(
            &values,
            &[channel([9; 3], whole, true), channel([8; 3], whole, true)],
        );
        assert_eq!(one.len(), 1);
    }

    fn looks_of_first(values: &Values, said: &[Channel]) -> Vec<Look> {
        looks(said, 1, values, Dtype::Uint16)
    }

    #[test]
    fn windows_are_of_values_as_they_are_shown() {
        let window = |values: &Values, dtype, window| share(window, values, dtype);
        let kept = |number| Values::kept(number, false).unwrap();
        assert_eq!(
            window(&kept(Number::U8), Dtype::Uint8, [51.0, 102.0]),
            Some([0.2, 0.4])
        );
        // Signed values are moved up by half their range.
        assert_eq!(
            window(&kept(Number::I16), Dtype::Uint16, [-32_768.0, -1.0]),
            Some([0.0, 32_767.0 / 65_535.0])
        );
        let spread = Some(Spread::Real {
            min: -1.0,
            max: 3.0,
        });
        let floats = Values::fitted(Number::F32, false, spread);
        let [low, high] = window(&floats, Dtype::Uint16, [0.0, 1.0]).unwrap();
        assert!((low - 0.25).abs() < 1e-4 && (high - 0.5).abs() < 1e-4);
        assert_eq!(window(&floats, Dtype::Uint16, [-1.0, 3.0]), None);
        // Elsewhere altogether.
        assert_eq!(
            window(&kept(Number::U8), Dtype::Uint8, [300.0, 400.0]),
            None
        );
        let names = Values::names(Number::U64, false).unwrap();
        assert_eq!(window(&names, Dtype::Uint16, [1.0, 5.0]), None);
    }
}
