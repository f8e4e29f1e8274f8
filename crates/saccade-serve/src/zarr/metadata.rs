//! OME-Zarr 0.5 metadata: one group, one array per level.

use glam::DVec3;
use saccade_core::volume::{Dtype, Volume};
use serde_json::{Value, json};

/// The image's `zarr.json`.
pub(crate) fn group(volume: &Volume) -> Value {
    let space = |name| json!({ "name": name, "type": "space", "unit": "nanometer" });
    let datasets: Vec<Value> = volume
        .levels
        .iter()
        .enumerate()
        .map(|(level, geometry)| {
            let scale = volume.voxel_nm * geometry.downsampling;
            // A voxel that averages several has its middle in theirs.
            let moved = (scale - volume.voxel_nm) / 2.0;
            let mut transforms = vec![json!({ "type": "scale", "scale": czyx(1.0, scale) })];
            if moved != DVec3::ZERO {
                transforms.push(json!({ "type": "translation", "translation": czyx(0.0, moved) }));
            }
            json!({ "path": level.to_string(), "coordinateTransformations": transforms })
        })
        .collect();
    let largest = match volume.dtype {
        Dtype::Uint16 => u16::MAX,
        _ => u16::from(u8::MAX),
    };
    let channels: Vec<Value> = volume
        .channels
        .iter()
        .map(|label| {
            json!({
                "active": true,
                "coefficient": 1,
                "color": "FFFFFF",
                "family": "linear",
                "inverted": false,
                "label": label,
                "window": { "min": 0, "max": largest, "start": 0, "end": largest },
            })
        })
        .collect();
    json!({
        "zarr_format": 3,
        "node_type": "group",
        "attributes": { "ome": {
            "version": "0.5",
            "multiscales": [{
                "name": volume.name,
                "type": "mean",
                "axes": [{ "name": "c", "type": "channel" }, space("z"), space("y"), space("x")],
                "datasets": datasets,
            }],
            "omero": { "channels": channels, "rdefs": { "model": "greyscale" } },
        }},
    })
}

/// The `zarr.json` of a level's array; `None` for no such level.
pub(crate) fn array(volume: &Volume, level: u32) -> Option<Value> {
    let extent = volume.levels.get(usize::try_from(level).ok()?)?.extent;
    let (data_type, bytes) = match volume.dtype {
        Dtype::Uint16 => (
            "uint16",
            json!({ "name": "bytes", "configuration": { "endian": "little" } }),
        ),
        _ => ("uint8", json!({ "name": "bytes" })),
    };
    let chunk = volume.chunk;
    Some(json!({
        "zarr_format": 3,
        "node_type": "array",
        "shape": [volume.channels.len(), extent.z, extent.y, extent.x],
        "data_type": data_type,
        "fill_value": 0,
        "chunk_grid": {
            "name": "regular",
            "configuration": { "chunk_shape": [1, chunk.z, chunk.y, chunk.x] },
        },
        "chunk_key_encoding": { "name": "default", "configuration": { "separator": "/" } },
        "codecs": [bytes],
        "dimension_names": ["c", "z", "y", "x"],
        "attributes": {},
    }))
}

fn czyx(c: f64, xyz: DVec3) -> [f64; 4] {
    [c, xyz.z, xyz.y, xyz.x]
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::UVec3;

    /// Every level spans the same nanometres: first edge at minus half a voxel of level 0.
    #[test]
    fn levels_lie_on_each_other() {
        let voxel_nm = DVec3::new(4.0, 4.0, 40.0);
        let volume = Volume::new("em", UVec3::new(1000, 900, 50), voxel_nm).unwrap();
        let group = group(&volume);
        let datasets = &group["attributes"]["ome"]["multiscales"][0]["datasets"];
        assert_eq!(datasets.as_array().unwrap().len(), volume.levels.len());
        for dataset in datasets.as_array().unwrap() {
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
    fn arrays_turn_around() {
        let volume = Volume::new("em", UVec3::new(1000, 900, 50), DVec3::ONE).unwrap();
        let array = array(&volume, 0).unwrap();
        assert_eq!(array["shape"], json!([1, 50, 900, 1000]));
        let (x, y, z) = volume.chunk.into();
        assert_eq!(
            array["chunk_grid"]["configuration"]["chunk_shape"],
            json!([1, z, y, x])
        );
        assert_eq!(super::array(&volume, 99), None);
    }
}
