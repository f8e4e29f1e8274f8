//! Neuroglancer precomputed: raw, unsharded; labels of one channel as a segmentation, which cannot have more.
//!
//! Axes are x, y, z as in the rest of this project, the origin is the corner of voxel 0, so levels
//! need no translation, and chunks end where the volume does. A volume that is moved as a whole has an offset in whole
//! voxels of each level, as the format wants it, from which the names of its chunks count.

use glam::{I64Vec3, UVec3};
use saccade_core::volume::{Dtype, Volume, VoxelKind};
use saccade_core::voxel_box::VoxelBox;
use serde_json::{Value, json};

use super::{Entry, Piece, Unknown, has_chunk, level_index, number, only, per_level};

/// What a key below the volume's root names.
pub(super) fn entry(volume: &Volume, key: &str) -> Result<Entry, Unknown> {
    let unknown = || only(&["info", "LEVEL/X0-X1_Y0-Y1_Z0-Z1"]);
    if key == "info" {
        return Ok(Entry::Metadata(info(volume)));
    }
    let (level, voxels) = key.split_once('/').ok_or_else(unknown)?;
    let level = number(level).ok_or_else(unknown)?;
    let (min, max) = bounds(voxels).ok_or_else(unknown)?;
    let inside = level_index(volume, level).and_then(|index| {
        let offset = offset(volume, index);
        let of = |corner: I64Vec3| {
            let axes = (corner - offset).to_array().map(|n| u32::try_from(n).ok());
            let [x, y, z] = axes;
            Some(UVec3::new(x?, y?, z?))
        };
        Some(VoxelBox::new(of(min)?, of(max)?))
    });
    inside
        .and_then(|voxels| piece(volume, level, voxels))
        .map(Entry::Piece)
        .ok_or_else(|| per_level(volume, &first_and_size(volume)))
}

fn info(volume: &Volume) -> Value {
    let scale = |(level, geometry): (usize, &saccade_core::levels::Level)| {
        json!({
            "key": level.to_string(),
            "size": geometry.extent.to_array(),
            "voxel_offset": offset(volume, level).to_array(),
            "resolution": (volume.voxel_nm * geometry.downsampling).to_array(),
            "chunk_sizes": [volume.chunk.to_array()],
            "encoding": "raw",
        })
    };
    let data_type = match volume.dtype {
        Dtype::Uint16 => "uint16",
        _ => "uint8",
    };
    let kind = match (volume.kind, volume.channels.len()) {
        (VoxelKind::Labels, 1) => "segmentation",
        _ => "image",
    };
    json!({
        "@type": "neuroglancer_multiscale_volume",
        "type": kind,
        "data_type": data_type,
        "num_channels": volume.channels.len(),
        "scales": volume.levels.iter().enumerate().map(scale).collect::<Vec<_>>(),
    })
}

/// How far a level is moved, to the nearest of its voxels.
fn offset(volume: &Volume, level: usize) -> I64Vec3 {
    let voxel_nm = volume.voxel_nm * volume.levels[level].downsampling;
    // Far from the ends of what can be counted, so that corners can be added.
    let far = f64::from(1 << 30) * f64::from(1 << 20);
    (volume.place_nm(level) / voxel_nm)
        .round()
        .clamp(glam::DVec3::splat(-far), glam::DVec3::splat(far))
        .as_i64vec3()
}

/// The piece that covers exactly these voxels of a level.
fn piece(volume: &Volume, level: u32, voxels: VoxelBox) -> Option<Piece> {
    let extent = volume.levels[level_index(volume, level)?].extent;
    let chunk = voxels.min / volume.chunk;
    let first = has_chunk(volume, level, chunk).then(|| chunk * volume.chunk)?;
    let whole = VoxelBox::new(first, first.saturating_add(volume.chunk).min(extent));
    (voxels == whole).then(|| Piece {
        level,
        chunk,
        channels: 0..u32::try_from(volume.channels.len()).unwrap_or(u32::MAX),
        voxels: VoxelBox::of_size(whole.size()),
    })
}

/// `x0-x1_y0-y1_z0-z1`: the first voxel, and the one beyond the last.
fn bounds(text: &str) -> Option<(I64Vec3, I64Vec3)> {
    let axis = |text: &str| {
        // A minus may be the sign of the first number.
        let between = 1 + text.get(1..)?.find('-')?;
        Some((whole(&text[..between])?, whole(&text[between + 1..])?))
    };
    let axes: Vec<_> = text.split('_').map(axis).collect::<Option<_>>()?;
    let [x, y, z] = axes[..] else { return None };
    Some((I64Vec3::new(x.0, y.0, z.0), I64Vec3::new(x.1, y.1, z.1)))
}

/// A whole number in its only spelling.
fn whole(text: &str) -> Option<i64> {
    let (digits, sign) = match text.strip_prefix('-') {
        Some(digits) => (digits, -1),
        None => (text, 1),
    };
    let plain = (1..=16).contains(&digits.len())
        && digits.bytes().all(|b| b.is_ascii_digit())
        && (text == "0" || !digits.starts_with('0'));
    plain.then(|| Some(sign * digits.parse::<i64>().ok()?))?
}

/// An example with the size of chunks.
fn first_and_size(volume: &Volume) -> String {
    let UVec3 { x, y, z } = volume.chunk;
    let first = offset(volume, 0).to_array();
    let name = { first.iter().zip([x, y, z]) }
        .map(|(first, size)| format!("{first}-{}", first + i64::from(size)));
    let name = name.collect::<Vec<_>>().join("_");
    format!("L/{name}, chunks of {x} x {y} x {z} voxels that end with the level")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::tests::volume;

    #[test]
    fn every_chunk_has_the_name_of_its_voxels() {
        let volume = volume();
        for (index, level) in volume.levels.iter().enumerate() {
            let mut voxels = 0;
            for chunk in VoxelBox::of_size(volume.chunks(index)).iter() {
                let min = chunk * volume.chunk;
                let max = (min + volume.chunk).min(level.extent);
                let key = format!(
                    "{index}/{}-{}_{}-{}_{}-{}",
                    min.x, max.x, min.y, max.y, min.z, max.z
                );
                let Ok(Entry::Piece(piece)) = entry(&volume, &key) else {
                    panic!("{key}")
                };
                assert_eq!(
                    (piece.chunk, piece.channels.clone()),
                    (chunk, 0..1),
                    "{key}"
                );
                assert_eq!(piece.voxels, VoxelBox::of_size(max - min), "{key}");
                voxels += piece.voxels.voxels();
            }
            assert_eq!(voxels, VoxelBox::of_size(level.extent).voxels());
        }
    }

    #[test]
    fn chunks_of_a_moved_volume_are_named_from_its_offset() {
        let (still, mut moved) = (volume(), volume());
        // 5 nm are more than half a voxel of level 0, and less than half of those from level 2 on.
        moved.origin_nm = glam::DVec3::new(-400.0, 5.0, 1200.0);
        let info = info(&moved);
        for (index, level) in moved.levels.iter().enumerate() {
            let voxel_nm = moved.voxel_nm * level.downsampling;
            let offset = (moved.origin_nm / voxel_nm).round().as_i64vec3();
            let said = &info["scales"][index]["voxel_offset"];
            assert_eq!(said, &json!(offset.to_array()));
            let [ox, oy, oz] = offset.to_array();
            for chunk in VoxelBox::of_size(moved.chunks(index)).iter() {
                let min = (chunk * moved.chunk).as_i64vec3();
                let max = (chunk * moved.chunk + moved.chunk)
                    .min(level.extent)
                    .as_i64vec3();
                let key = |x, y, z| {
                    format!(
                        "{index}/{}-{}_{}-{}_{}-{}",
                        min.x + x,
                        max.x + x,
                        min.y + y,
                        max.y + y,
                        min.z + z,
                        max.z + z
                    )
                };
                let own = entry(&moved, &key(ox, oy, oz));
                assert!(own.is_ok(), "{}", key(ox, oy, oz));
                assert_eq!(own, entry(&still, &key(0, 0, 0)));
            }
        }
        assert_eq!(info["scales"][0]["voxel_offset"], json!([-100, 1, 30]));
        assert!(entry(&moved, "0/0-64_0-48_0-32").is_err());
        let Err(unknown) = entry(&moved, "0/0-1_0-1_0-1") else {
            panic!("a chunk of one voxel")
        };
        assert!(
            unknown.known[0].starts_with("0/-100--36_1-49_30-62"),
            "{:?}",
            unknown.known
        );
        assert!(entry(&moved, "0/-100--36_1-49_30-62").is_ok());
    }

    #[test]
    fn other_boxes_do_not_exist() {
        let others = [
            "0/0-64_0-48_0-31",
            "0/1-65_0-48_0-32",
            "0/960-1024_0-48_0-32",
            "0/64-0_0-48_0-32",
            "0/0-64_0-48",
            "0/0-64_0-48_0-32_0-1",
            "0/00-64_0-48_0-32",
            "0/0-64_0-48_0-32/",
            "99/0-64_0-48_0-32",
            "0/4294967295-4294967295_0-48_0-32",
            "0/-0-64_0-48_0-32",
            "0/--0-64_0-48_0-32",
            "0/-9999999999999999--9999999999999998_0-48_0-32",
            "0/99999999999999999999-99999999999999999999_0-48_0-32",
            "0/0-\u{0661}_0-48_0-32",
            "0/é-64_0-48_0-32",
            "zarr.json",
        ];
        for key in others {
            assert!(entry(&volume(), key).is_err(), "{key}");
        }
    }

    #[test]
    fn levels_span_the_same_nanometres() {
        let volume = volume();
        let info = info(&volume);
        let scales = info["scales"].as_array().unwrap();
        assert_eq!(scales.len(), volume.levels.len());
        for scale in scales {
            for (axis, nm) in [4.0, 4.0, 40.0].into_iter().enumerate() {
                let number = |name: &str| scale[name][axis].as_f64().unwrap();
                let excess = number("size") * number("resolution") - volume.size_nm()[axis];
                assert!((0.0..number("resolution")).contains(&excess), "{scale}");
                assert_eq!(number("resolution") % nm, 0.0);
            }
        }
    }

    #[test]
    fn labels_of_one_channel_are_a_segmentation() {
        let mut volume = volume();
        assert_eq!(info(&volume)["type"], "image");
        volume.kind = VoxelKind::Labels;
        assert_eq!(info(&volume)["type"], "segmentation");
        volume.channels.push("others".to_owned());
        assert_eq!(info(&volume)["type"], "image", "segmentations have one");
    }
}
