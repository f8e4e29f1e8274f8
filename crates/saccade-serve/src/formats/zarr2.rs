//! OME-Zarr 0.4: one Zarr 2 group, one array per level.

use saccade_core::volume::{Dtype, Volume};
use saccade_source::ome;
use serde_json::{Value, json};

use super::{Entry, Unknown, level_index, number, only, padded, per_level};

/// The version of the metadata, which it repeats in every part.
const VERSION: &str = "0.4";

/// What a key below the image's root names.
pub(super) fn entry(volume: &Volume, key: &str) -> Result<Entry, Unknown> {
    let unknown = || {
        only(&[
            ".zgroup",
            ".zattrs",
            "LEVEL/.zarray",
            "LEVEL/.zattrs",
            "LEVEL/C/Z/Y/X",
        ])
    };
    let number = |text| number(text).ok_or_else(unknown);
    let parts: Vec<&str> = key.split('/').collect();
    match parts[..] {
        [".zgroup"] => Ok(Entry::Metadata(json!({ "zarr_format": 2 }))),
        [".zattrs"] => Ok(Entry::Metadata(group(volume))),
        [level, ".zarray"] => array(volume, number(level)?)
            .map(Entry::Metadata)
            .ok_or_else(|| per_level(volume, "L/.zarray")),
        [level, ".zattrs"] => level_index(volume, number(level)?)
            // The convention of xarray for the names of axes; Zarr 2 has none of its own.
            .map(|_| Entry::Metadata(json!({ "_ARRAY_DIMENSIONS": ome::AXES })))
            .ok_or_else(|| per_level(volume, "L/.zattrs")),
        [level, c, z, y, x] => {
            let level = number(level)?;
            padded(
                volume,
                level,
                [number(c)?, number(z)?, number(y)?, number(x)?],
            )
        }
        _ => Err(unknown()),
    }
}

fn group(volume: &Volume) -> Value {
    let section = volume.extent().z / 2;
    let (channels, levels) = (ome::channels(volume), ome::placed(volume));
    let mut image = ome::image(volume, &channels, &levels, section);
    image["multiscales"][0]["version"] = VERSION.into();
    for part in ["omero", "image-label"] {
        if let Some(part) = image.get_mut(part) {
            part["version"] = VERSION.into();
        }
    }
    image
}

fn array(volume: &Volume, level: u32) -> Option<Value> {
    let extent = volume.levels[level_index(volume, level)?].extent;
    let dtype = match volume.dtype {
        Dtype::Uint16 => "<u2",
        _ => "|u1",
    };
    let chunk = volume.chunk;
    Some(json!({
        "zarr_format": 2,
        "shape": [volume.channels.len(), extent.z, extent.y, extent.x],
        "chunks": [1, chunk.z, chunk.y, chunk.x],
        "dtype": dtype,
        "compressor": null,
        "fill_value": 0,
        "order": "C",
        "filters": null,
        "dimension_separator": "/",
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::Format;
    use crate::formats::tests::volume;
    use saccade_core::volume::VoxelKind;

    #[test]
    fn it_is_the_image_of_the_newer_version_with_older_names() {
        fn of(volume: &Volume, format: Format, key: &str) -> Value {
            match format.entry(volume, key) {
                Ok(Entry::Metadata(metadata)) => metadata,
                other => panic!("{key}: {other:?}"),
            }
        }
        for (kind, part) in [
            (VoxelKind::Intensity, "omero"),
            (VoxelKind::Labels, "image-label"),
        ] {
            let mut volume = volume();
            volume.kind = kind;
            let mut older = of(&volume, Format::Zarr2, ".zattrs");
            assert_eq!(older["multiscales"][0]["version"].take(), "0.4");
            assert_eq!(older[part]["version"].take(), "0.4");
            let mut newer = of(&volume, Format::Zarr3, "zarr.json")["attributes"]["ome"].clone();
            newer["multiscales"][0]["version"] = Value::Null;
            newer[part]["version"] = Value::Null;
            newer.as_object_mut().unwrap().remove("version");
            assert_eq!(older, newer);
        }
        let metadata = |format, key: &str| of(&volume(), format, key);
        for level in 0..volume().levels.len() {
            let older = metadata(Format::Zarr2, &format!("{level}/.zarray"));
            let newer = metadata(Format::Zarr3, &format!("{level}/zarr.json"));
            assert_eq!(older["shape"], newer["shape"]);
            let chunk = &newer["chunk_grid"]["configuration"]["chunk_shape"];
            assert_eq!(older["chunks"], *chunk);
        }
    }

    #[test]
    fn chunks_are_those_of_the_newer_version() {
        for (older, newer) in [("0/0/1/3/15", "0/c/0/1/3/15"), ("2/0/0/1/0", "2/c/0/0/1/0")] {
            let of = |format: Format, key| format.entry(&volume(), key);
            assert!(of(Format::Zarr2, older).is_ok());
            assert_eq!(of(Format::Zarr2, older), of(Format::Zarr3, newer));
        }
        for key in [
            "0/0.1.3.15",
            "0/c/0/1/3/15",
            "0/0/1/3/16",
            "9/0/0/0/0",
            "99/.zattrs",
            ".zmetadata",
        ] {
            assert!(entry(&volume(), key).is_err(), "{key}");
        }
    }
}
