//! OME-Zarr 0.5: one Zarr 3 group, one array per level.

use saccade_core::volume::{Dtype, Volume};
use saccade_source::ome;
use serde_json::{Value, json};

use super::{Entry, Unknown, level_index, number, only, padded, per_level};

/// What a key below the image's root names.
pub(super) fn entry(volume: &Volume, key: &str) -> Result<Entry, Unknown> {
    let unknown = || only(&["zarr.json", "LEVEL/zarr.json", "LEVEL/c/C/Z/Y/X"]);
    let number = |text| number(text).ok_or_else(unknown);
    let parts: Vec<&str> = key.split('/').collect();
    match parts[..] {
        ["zarr.json"] => Ok(Entry::Metadata(group(volume))),
        [level, "zarr.json"] => array(volume, number(level)?)
            .map(Entry::Metadata)
            .ok_or_else(|| per_level(volume, "L/zarr.json")),
        [level, "c", c, z, y, x] => {
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
    image["version"] = "0.5".into();
    json!({
        "zarr_format": 3,
        "node_type": "group",
        "attributes": { "ome": image },
    })
}

fn array(volume: &Volume, level: u32) -> Option<Value> {
    let extent = volume.levels[level_index(volume, level)?].extent;
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
        "dimension_names": ome::AXES,
        "attributes": {},
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::Piece;
    use crate::formats::tests::volume;
    use glam::UVec3;
    use saccade_core::voxel_box::VoxelBox;

    #[test]
    fn arrays_turn_around() {
        let Ok(Entry::Metadata(array)) = entry(&volume(), "0/zarr.json") else {
            panic!("no array")
        };
        assert_eq!(array["shape"], json!([1, 50, 900, 1000]));
        assert_eq!(
            array["chunk_grid"]["configuration"]["chunk_shape"],
            json!([1, 32, 48, 64])
        );
        assert!(entry(&volume(), "99/zarr.json").is_err());
    }

    #[test]
    fn chunks_turn_around_and_keep_their_size() {
        let piece = Piece {
            level: 0,
            chunk: UVec3::new(15, 3, 1),
            channels: 0..1,
            voxels: VoxelBox::of_size(UVec3::new(64, 48, 32)),
        };
        assert_eq!(entry(&volume(), "0/c/0/1/3/15"), Ok(Entry::Piece(piece)));
        let others = [
            "0/c/0/1/3/16",
            "0/c/1/1/3/15",
            "99/c/0/0/0/0",
            "01/zarr.json",
            "0/c/0/1/3",
            "0/c/0/1/3/",
            "0/c/0/1/3/4/5",
            "0/c/0/1/3/x",
            "0/c/0/1/3/01",
            ".zattrs",
        ];
        for key in others {
            assert!(entry(&volume(), key).is_err(), "{key}");
        }
    }
}
