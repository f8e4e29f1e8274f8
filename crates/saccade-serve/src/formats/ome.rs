//! What the metadata of OME-Zarr 0.4 and 0.5 have in common.

use glam::DVec3;
use saccade_core::volume::{Dtype, Volume};
use serde_json::{Value, json};

/// The axes of every array, slowest first.
pub(super) const AXES: [&str; 4] = ["c", "z", "y", "x"];

/// Colours of channels where there are several; one alone is white.
const COLORS: [&str; 6] = ["00FF00", "FF00FF", "00FFFF", "FFFF00", "FF0000", "0000FF"];

/// The image: axes, levels and where they lie.
pub(super) fn multiscale(volume: &Volume) -> Value {
    let space = |name| json!({ "name": name, "type": "space", "unit": "nanometer" });
    let [c, z, y, x] = AXES;
    let dataset = |(level, geometry): (usize, &saccade_core::levels::Level)| {
        let scale = volume.voxel_nm * geometry.downsampling;
        // A voxel that averages several has its middle in theirs.
        let moved = (scale - volume.voxel_nm) / 2.0;
        let mut transforms = vec![json!({ "type": "scale", "scale": czyx(1.0, scale) })];
        if moved != DVec3::ZERO {
            transforms.push(json!({ "type": "translation", "translation": czyx(0.0, moved) }));
        }
        json!({ "path": level.to_string(), "coordinateTransformations": transforms })
    };
    json!({
        "name": volume.name,
        "type": "mean",
        "axes": [{ "name": c, "type": "channel" }, space(z), space(y), space(x)],
        "datasets": volume.levels.iter().enumerate().map(dataset).collect::<Vec<_>>(),
    })
}

/// How channels are to be shown.
pub(super) fn omero(volume: &Volume) -> Value {
    let largest = match volume.dtype {
        Dtype::Uint16 => u16::MAX,
        _ => u16::from(u8::MAX),
    };
    let several = volume.channels.len() > 1;
    let channel = |(index, label): (usize, &String)| {
        let color = if several {
            COLORS[index % COLORS.len()]
        } else {
            "FFFFFF"
        };
        json!({
            "active": true,
            "coefficient": 1,
            "color": color,
            "family": "linear",
            "inverted": false,
            "label": label,
            "window": { "min": 0, "max": largest, "start": 0, "end": largest },
        })
    };
    let model = if several { "color" } else { "greyscale" };
    json!({
        "channels": volume.channels.iter().enumerate().map(channel).collect::<Vec<_>>(),
        "rdefs": { "defaultT": 0, "defaultZ": volume.extent().z / 2, "model": model },
    })
}

fn czyx(c: f64, xyz: DVec3) -> [f64; 4] {
    [c, xyz.z, xyz.y, xyz.x]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::tests::volume;

    /// Every level spans the same nanometres: first edge at minus half a voxel of level 0.
    #[test]
    fn levels_lie_on_each_other() {
        let volume = volume();
        let image = multiscale(&volume);
        let datasets = image["datasets"].as_array().unwrap();
        assert_eq!(datasets.len(), volume.levels.len());
        for dataset in datasets {
            let number = |transform: usize, kind: &str, axis: usize| {
                let transforms = &dataset["coordinateTransformations"];
                transforms[transform][kind][axis].as_f64().unwrap_or(0.0)
            };
            for (axis, nm) in [(1, 40.0), (2, 4.0), (3, 4.0)] {
                let (scale, moved) = (number(0, "scale", axis), number(1, "translation", axis));
                assert_eq!(moved - scale / 2.0, -nm / 2.0, "{dataset}");
            }
            assert_eq!(
                (number(0, "scale", 0), number(1, "translation", 0)),
                (1.0, 0.0)
            );
        }
    }

    #[test]
    fn several_channels_are_told_apart() {
        let mut volume = volume();
        volume.channels = vec!["DAPI".into(), "GFP".into()];
        let omero = omero(&volume);
        let [a, b] = &omero["channels"].as_array().unwrap()[..] else {
            panic!("{omero}")
        };
        assert_eq!((&a["label"], &b["label"]), (&json!("DAPI"), &json!("GFP")));
        assert_ne!(a["color"], b["color"]);
    }
}
