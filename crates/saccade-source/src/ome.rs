//! What the metadata of an OME-Zarr image say, the same in versions 0.4 and 0.5: axes, levels and where they
//! lie, how channels are to be shown, or that they are labels.

use glam::DVec3;
use saccade_core::volume::{Dtype, Volume, VoxelKind};
use serde_json::{Value, json};

/// The axes of every array, slowest first.
pub const AXES: [&str; 4] = ["c", "z", "y", "x"];

/// Colours of channels where there are several; one alone is white.
const COLORS: [&str; 6] = ["00FF00", "FF00FF", "00FFFF", "FFFF00", "FF0000", "0000FF"];

/// Where the voxels of a level lie.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placed {
    /// Size of a voxel \[nm\].
    pub voxel_nm: DVec3,
    /// Middle of the first voxel, from that of the first voxel of level 0 of a volume that is not moved \[nm\].
    pub first_nm: DVec3,
}

/// Where the levels of a volume lie: a voxel that averages several has its middle in theirs, unless whoever wrote it says otherwise.
pub fn placed(volume: &Volume) -> Vec<Placed> {
    let levels = volume.levels.iter().enumerate();
    let placed = levels.map(|(n, level)| {
        let voxel_nm = volume.voxel_nm * level.downsampling;
        Placed {
            voxel_nm,
            first_nm: volume.place_nm(n) + (voxel_nm - volume.voxel_nm) / 2.0,
        }
    });
    placed.collect()
}

/// All channels of a volume.
pub fn channels(volume: &Volume) -> Vec<u32> {
    (0..).take(volume.channels.len()).collect()
}

/// The metadata of an image that holds some channels of a volume, in this order, at some levels; `section` is the one
/// to begin with. One of labels says so (`image-label`), and has no colours and windows (`omero`), which are for shades.
///
/// # Panics
///
/// If the volume has no such channel.
pub fn image(volume: &Volume, channels: &[u32], levels: &[Placed], section: u32) -> Value {
    let multiscales = [multiscale(&volume.name, volume.kind, levels)];
    match volume.kind {
        VoxelKind::Intensity => json!({
            "multiscales": multiscales,
            "omero": omero(volume, channels, section),
        }),
        VoxelKind::Labels => json!({ "multiscales": multiscales, "image-label": {} }),
    }
}

/// Axes, and levels whose paths are their numbers.
fn multiscale(name: &str, kind: VoxelKind, levels: &[Placed]) -> Value {
    let space = |name| json!({ "name": name, "type": "space", "unit": "nanometer" });
    let [c, z, y, x] = AXES;
    let dataset = |(level, placed): (usize, &Placed)| {
        let mut transforms = vec![json!({ "type": "scale", "scale": czyx(1.0, placed.voxel_nm) })];
        if placed.first_nm != DVec3::ZERO {
            let moved = czyx(0.0, placed.first_nm);
            transforms.push(json!({ "type": "translation", "translation": moved }));
        }
        json!({ "path": level.to_string(), "coordinateTransformations": transforms })
    };
    json!({
        "name": name,
        "type": match kind {
            VoxelKind::Intensity => "mean",
            VoxelKind::Labels => "mode",
        },
        "axes": [{ "name": c, "type": "channel" }, space(z), space(y), space(x)],
        "datasets": levels.iter().enumerate().map(dataset).collect::<Vec<_>>(),
    })
}

/// How these channels of a volume are to be shown, in this order.
fn omero(volume: &Volume, channels: &[u32], section: u32) -> Value {
    let largest = match volume.dtype {
        Dtype::Uint16 => u16::MAX,
        _ => u16::from(u8::MAX),
    };
    let several = channels.len() > 1;
    let channel = |(index, channel): (usize, &u32)| {
        let of = *channel as usize;
        let look = volume.look(of);
        let color = match look.color {
            Some([r, g, b]) => format!("{r:02X}{g:02X}{b:02X}"),
            None if several => COLORS[index % COLORS.len()].to_owned(),
            None => "FFFFFF".to_owned(),
        };
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "from 0 to the largest value"
        )]
        let end = |share: f32| (f64::from(share) * f64::from(largest)).round() as u16;
        let [start, end] = look.window.unwrap_or([0.0, 1.0]).map(end);
        json!({
            "active": !look.hidden,
            "coefficient": 1,
            "color": color,
            "family": "linear",
            "inverted": false,
            "label": volume.channels[of],
            "window": { "min": 0, "max": largest, "start": start, "end": end },
        })
    };
    let model = if several { "color" } else { "greyscale" };
    json!({
        "channels": channels.iter().enumerate().map(channel).collect::<Vec<_>>(),
        "rdefs": { "defaultT": 0, "defaultZ": section, "model": model },
    })
}

fn czyx(c: f64, xyz: DVec3) -> [f64; 4] {
    [c, xyz.z, xyz.y, xyz.x]
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::UVec3;
    use saccade_core::volume::Look;

    fn volume() -> Volume {
        Volume::new("em", UVec3::new(1000, 900, 50), DVec3::new(4.0, 4.0, 40.0)).unwrap()
    }

    /// Every level spans the same nanometres: first edge at minus half a voxel of level 0.
    #[test]
    fn levels_lie_on_each_other() {
        let volume = volume();
        let image = multiscale(&volume.name, volume.kind, &placed(&volume));
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
    fn what_is_moved_is_moved_at_every_level() {
        let (still, mut moved) = (volume(), volume());
        moved.origin_nm = DVec3::new(-12.0, 1e6, 0.25);
        for (still, moved) in placed(&still).into_iter().zip(placed(&moved)) {
            assert_eq!(
                moved.first_nm,
                still.first_nm + DVec3::new(-12.0, 1e6, 0.25)
            );
            assert_eq!(moved.voxel_nm, still.voxel_nm);
        }
    }

    #[test]
    fn several_channels_are_told_apart() {
        let mut volume = volume();
        volume.channels = ["SE", "DAPI", "GFP"].map(String::from).to_vec();
        let omero = |volume: &Volume| omero(volume, &[1, 2], 0);
        let plain = omero(&volume);
        let [a, b] = &plain["channels"].as_array().unwrap()[..] else {
            panic!("{plain}")
        };
        assert_eq!((&a["label"], &b["label"]), (&json!("DAPI"), &json!("GFP")));
        assert_ne!(a["color"], b["color"]);
        let look = Look {
            color: Some([1, 171, 0]),
            window: Some([0.2, 0.4]),
            hidden: true,
        };
        volume.looks = vec![Look::default(), Look::default(), look];
        let told = omero(&volume);
        assert_eq!(&told["channels"][0], a);
        let b = &told["channels"][1];
        assert_eq!(
            (&b["color"], &b["active"]),
            (&json!("01AB00"), &json!(false))
        );
        let window = json!({ "min": 0, "max": 255, "start": 51, "end": 102 });
        assert_eq!(b["window"], window);
    }

    #[test]
    fn labels_are_said_to_be_labels() {
        let mut volume = volume();
        let said = |volume: &Volume| image(volume, &channels(volume), &placed(volume), 0);
        let shades = said(&volume);
        assert_eq!(shades["multiscales"][0]["type"], "mean");
        assert!(shades["omero"].is_object() && shades.get("image-label").is_none());
        volume.kind = VoxelKind::Labels;
        let labels = said(&volume);
        assert_eq!(labels["multiscales"][0]["type"], "mode");
        assert!(labels["image-label"].is_object() && labels.get("omero").is_none());
    }
}
