//! One function per text of other people that says how a volume is shown. The fuzzer includes this file, and
//! [`super::transfer_text`], which need nothing of the rest.

use saccade_core::camera::Camera;
use saccade_core::transfer::{ColorMap, TransferFunction};

use super::transfer_text::{channel_of_text, transfer_from_text};

#[cfg(test)]
#[allow(unreachable_pub, reason = "the fuzzer's crate has the same file")]
#[path = "../../../fuzz/src/changed.rs"]
mod changed;

/// A parser.
pub(crate) type Target = fn(&[u8]);

/// All of them, by name.
pub(crate) const TARGETS: &[(&str, Target)] = &[
    ("transfer_function", transfer_function),
    ("color_map", color_map),
    ("camera", camera),
];

/// A transfer function, and the channel that it is for: what is accepted has colours and opacities, and is printed as what it is.
fn transfer_function(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    let (channel, rest) = channel_of_text(text);
    assert!(text.ends_with(rest) || text.trim().ends_with(rest));
    if let Some(channel) = channel {
        assert_eq!(
            channel_of_text(&format!("{channel}:{rest}")),
            (Some(channel), rest)
        );
    }
    let Ok(transfer) = transfer_from_text(rest) else {
        return;
    };
    for [red, green, blue, opacity] in transfer.table() {
        let inside = [red, green, blue, opacity]
            .iter()
            .all(|v| (0.0..=1.0).contains(v));
        assert!(inside, "{red} {green} {blue} {opacity}");
    }
    assert_eq!(transfer.table()[0][3], 0.0, "nothing acquired is not seen");
    // Between its points there is nothing that is not between their opacities.
    let points = transfer.opacity.iter().map(|point| point.opacity);
    let (least, most) = (
        points.clone().fold(1.0, f32::min),
        points.fold(0.0, f32::max),
    );
    for value in (0..=64_u8).map(|n| f32::from(n) / 64.0) {
        let opacity = transfer.opacity_at(value);
        let inside = (least.min(most) - 1e-6..=most + 1e-6).contains(&opacity);
        assert!(inside, "{opacity} of {value}");
    }
    let printed = serde_json::to_string(&transfer).expect("a transfer function becomes JSON");
    let again: TransferFunction = transfer_from_text(&printed).expect("what is printed is read");
    assert_eq!(again, transfer);
}

/// Colours by name, or one of them.
fn color_map(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    let Ok(map) = text.parse::<ColorMap>() else {
        return;
    };
    assert_eq!(map.to_string().parse(), Ok(map));
    for t in [-1.0, 0.0, 0.3, 1.0, 7.0] {
        let light = map.linear_rgb(t);
        assert!(
            light.iter().all(|light| (0.0..=1.0).contains(light)),
            "{light:?}"
        );
    }
}

/// Where somebody looks from.
fn camera(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    let Ok(camera) = text.parse::<Camera>() else {
        return;
    };
    assert_eq!(camera.to_string().parse(), Ok(camera));
    assert!(
        camera.pitch.abs() <= 90.0
            && camera.distance_nm > 0.0
            && camera.fov > 0.0
            && camera.fov < 180.0
    );
    assert!(
        camera.target.xyz.is_finite() && camera.yaw.is_finite() && camera.distance_nm.is_finite()
    );
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::changed::{files, survives};
    use super::*;

    #[test]
    fn texts_of_others_are_survived() {
        let seeds = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/seeds");
        for &(name, target) in TARGETS {
            survives(name, target, &files(&seeds.join(name)), 2_000);
        }
    }
}
