//! Images written by hand, byte by byte, and real ones.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

mod changing;
mod hostile;
mod labels;
mod places;
mod systems;
mod written;

use std::fs;
use std::path::Path;

use proptest::prelude::*;
use saccade_core::volume::{Dtype, Look};
use serde_json::json;

use saccade_core::voxel_box::VoxelBox;

use super::*;
use crate::SourceError;
use crate::conformance::{check_reading, check_volume};

/// Finest voxels, odd on every axis \[x, y, z\].
const EXTENT: UVec3 = UVec3::new(83, 41, 9);
const CHANNELS: u32 = 2;
/// Chunks of the files \[x, y, z\]: thin, and no divisor of anything.
const FILE_CHUNK: UVec3 = UVec3::new(50, 17, 2);

#[derive(Clone, Copy, Debug, PartialEq)]
enum Version {
    V2,
    V3,
}

/// A value for every channel and voxel, never 0.
fn value(channel: u32, level: u32, voxel: UVec3) -> u32 {
    1 + (voxel.x * 7 + voxel.y * 131 + voxel.z * 1009 + channel * 17 + level * 3) % 250
}

fn extent(level: u32) -> UVec3 {
    UVec3::new(
        EXTENT.x.div_ceil(1 << level),
        EXTENT.y.div_ceil(1 << level),
        EXTENT.z,
    )
}

/// Size of an axis.
fn length(axis: char, channels: u32, of: UVec3) -> u32 {
    match axis {
        't' => 1,
        'c' => channels,
        'z' => of.z,
        'y' => of.y,
        _ => of.x,
    }
}

/// Writes an array without compression.
fn write_array(folder: &Path, axes: &str, dtype: &str, version: Version, level: u32) {
    let of = extent(level);
    let shape: Vec<u32> = axes.chars().map(|a| length(a, CHANNELS, of)).collect();
    let chunk: Vec<u32> = axes.chars().map(|a| length(a, 1, FILE_CHUNK)).collect();
    fs::create_dir_all(folder).unwrap();
    let (name, metadata) = match version {
        Version::V2 => {
            let dtype = match dtype {
                "uint8" => "|u1",
                "int8" => "|i1",
                "uint16" => ">u2",
                "int16" => "<i2",
                other => other,
            };
            let metadata = json!({"zarr_format": 2, "shape": shape, "chunks": chunk, "dtype": dtype,
                "compressor": null, "fill_value": 0, "filters": null, "order": "C"});
            (".zarray", metadata)
        }
        Version::V3 => {
            let metadata = json!({"zarr_format": 3, "node_type": "array", "shape": shape,
                "data_type": dtype, "fill_value": 0,
                "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}},
                "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
                "codecs": [{"name": "bytes", "configuration": {"endian": "little"}}]});
            ("zarr.json", metadata)
        }
    };
    fs::write(folder.join(name), metadata.to_string()).unwrap();
    let counts: Vec<u32> = shape
        .iter()
        .zip(&chunk)
        .map(|(s, c)| s.div_ceil(*c))
        .collect();
    for number in 0..counts.iter().product::<u32>() {
        let index = unravel(number, &counts);
        let mut bytes = Vec::new();
        for inside in 0..chunk.iter().product::<u32>() {
            let at = unravel(inside, &chunk);
            let at: Vec<u32> = (0..at.len()).map(|d| index[d] * chunk[d] + at[d]).collect();
            let part = |name| axes.find(name).map_or(0, |d| at[d]);
            let voxel = UVec3::new(part('x'), part('y'), part('z'));
            let beyond = at.iter().zip(&shape).any(|(at, end)| at >= end);
            // Nothing outside of the array may be read.
            let value = if beyond {
                77
            } else {
                value(part('c'), level, voxel)
            };
            match (dtype, version) {
                ("uint8", _) => bytes.push(u8::try_from(value).unwrap()),
                ("int8", _) => bytes.push(u8::try_from(value).unwrap().wrapping_sub(128)),
                ("uint16", Version::V2) => bytes.extend(wide(value).to_be_bytes()),
                ("uint16", _) => bytes.extend(wide(value).to_le_bytes()),
                _ => bytes.extend(wide(value).wrapping_sub(1 << 15).to_le_bytes()),
            }
        }
        let names: Vec<String> = index.iter().map(u32::to_string).collect();
        let file = match version {
            Version::V2 => folder.join(names.join(".")),
            Version::V3 => folder.join("c").join(names.join("/")),
        };
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        fs::write(file, bytes).unwrap();
    }
}

/// A value that needs both bytes.
fn wide(value: u32) -> u16 {
    u16::try_from(value * 200 + 3).unwrap()
}

fn unravel(mut number: u32, counts: &[u32]) -> Vec<u32> {
    let mut index = vec![0; counts.len()];
    for (at, count) in index.iter_mut().zip(counts).rev() {
        *at = number % count;
        number /= count;
    }
    index
}

/// Attributes of an image with these axes.
fn attributes(axes: &str, levels: u32) -> Value {
    let list: Vec<_> = axes
        .chars()
        .map(|axis| match axis {
            't' => json!({"name": "t", "type": "time"}),
            'c' => json!({"name": "c", "type": "channel"}),
            _ => json!({"name": axis.to_string(), "type": "space", "unit": "micrometer"}),
        })
        .collect();
    let scale = |level: u32| -> Vec<f64> {
        let of = axes.chars().map(|axis| match axis {
            'z' => 2.0,
            'x' | 'y' => 0.25 * f64::from(1 << level),
            _ => 1.0,
        });
        of.collect()
    };
    let datasets: Vec<_> = (0..levels)
        .map(|level| {
            let scale = json!([{"type": "scale", "scale": scale(level)}]);
            json!({"path": format!("s{level}"), "coordinateTransformations": scale})
        })
        .collect();
    let channels = [json!({"label": "nuclei"}), json!({"label": ""})];
    json!({"multiscales": [{"axes": list, "datasets": datasets}], "omero": {"channels": channels}})
}

fn write_attributes(folder: &Path, version: Version, attributes: &Value) {
    fs::create_dir_all(folder).unwrap();
    match version {
        Version::V2 => {
            fs::write(folder.join(".zgroup"), r#"{"zarr_format": 2}"#).unwrap();
            fs::write(folder.join(".zattrs"), attributes.to_string()).unwrap();
        }
        Version::V3 => {
            let group =
                json!({"zarr_format": 3, "node_type": "group", "attributes": {"ome": attributes}});
            fs::write(folder.join("zarr.json"), group.to_string()).unwrap();
        }
    }
}

fn write_image(folder: &Path, axes: &str, dtype: &str, version: Version) {
    write_attributes(folder, version, &attributes(axes, 2));
    for level in 0..2 {
        write_array(
            &folder.join(format!("s{level}")),
            axes,
            dtype,
            version,
            level,
        );
    }
}

fn open(folder: &Path) -> Result<ZarrSource, SourceError> {
    runtime().block_on(ZarrSource::open_folder(folder))
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread()
        .build()
        .unwrap()
}

/// A chunk from the values alone.
fn expected(volume: &Volume, id: ChunkId, has_z: bool, has_c: bool) -> Vec<u8> {
    let min = id.chunk * volume.chunk;
    let chunk = VoxelBox::new(min, min + volume.chunk);
    let level = &volume.levels[id.level as usize];
    let voxels = chunk.iter().map(|at| {
        let inside = at.cmplt(level.extent).all();
        let at = if has_z { at } else { UVec3::new(at.x, at.y, 0) };
        let channel = if has_c { id.channel } else { 0 };
        inside.then(|| value(channel, id.level, at))
    });
    match volume.dtype {
        Dtype::Uint16 => voxels
            .flat_map(|v| v.map_or(0, wide).to_le_bytes())
            .collect(),
        _ => voxels
            .map(|v| u8::try_from(v.unwrap_or(0)).unwrap())
            .collect(),
    }
}

#[test]
fn any_axes_in_any_order_of_any_type() {
    for (axes, dtype, version) in [
        ("tczyx", "uint8", Version::V2),
        ("czyx", "uint16", Version::V3),
        ("zyx", "int16", Version::V3),
        ("xyzc", "uint16", Version::V2),
        ("yx", "uint8", Version::V3),
        ("zcxy", "int8", Version::V2),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path().join("cells.ome.zarr");
        write_image(&folder, axes, dtype, version);
        assert!(ZarrSource::is_zarr(&folder));
        let source = open(&folder).unwrap();
        let volume = source.volume().clone();
        let (has_z, has_c) = (axes.contains('z'), axes.contains('c'));
        assert_eq!(volume.name, "cells");
        assert_eq!(
            volume.extent(),
            UVec3::new(83, 41, if has_z { 9 } else { 1 })
        );
        let voxel_nm = DVec3::new(250.0, 250.0, if has_z { 2000.0 } else { 250.0 });
        assert_eq!(volume.voxel_nm, voxel_nm, "{axes}");
        assert_eq!(volume.levels[1].downsampling, DVec3::new(2.0, 2.0, 1.0));
        if has_c {
            assert_eq!(volume.channels, ["nuclei", "channel 1"]);
        }
        check_volume(&volume).unwrap();
        let oracle = |id| expected(&volume, id, has_z, has_c);
        runtime()
            .block_on(check_reading(&source, oracle, 0))
            .unwrap();
        // A check that can fail.
        let wrong = |id: ChunkId| {
            expected(
                &volume,
                ChunkId {
                    level: 1 - id.level,
                    ..id
                },
                has_z,
                has_c,
            )
        };
        assert!(
            runtime()
                .block_on(check_reading(&source, wrong, 0))
                .is_err(),
            "{axes}"
        );
    }
}

/// An image of several times, none of which but the first is seen: whoever opens it should know.
#[test]
fn times_that_are_not_shown_are_told() {
    let notes = |times: u32| {
        let folder = tempfile::tempdir().unwrap();
        write_image(folder.path(), "tzyx", "uint8", Version::V3);
        for level in 0..2 {
            let file = folder.path().join(format!("s{level}/zarr.json"));
            let mut array: Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
            array["shape"][0] = times.into();
            fs::write(&file, array.to_string()).unwrap();
        }
        open(folder.path()).unwrap().notes().join(" ")
    };
    let told = notes(7);
    assert!(
        told.contains("7 times") && told.contains("the first is shown"),
        "{told}"
    );
    assert_eq!(notes(1), "");
}

/// Notes and voxel size of an image whose attributes were edited.
fn sized(edit: impl Fn(&mut Value)) -> (String, DVec3) {
    let folder = tempfile::tempdir().unwrap();
    write_image(folder.path(), "zyx", "uint8", Version::V3);
    let mut attributes = attributes("zyx", 2);
    edit(&mut attributes["multiscales"][0]);
    write_attributes(folder.path(), Version::V3, &attributes);
    let source = open(folder.path()).unwrap();
    (source.notes().join(" "), source.volume().voxel_nm)
}

#[test]
fn units_are_those_of_the_specification_and_others_are_told() {
    for (unit, nm) in [
        ("yoctometer", 1e-15),
        ("femtometer", 1e-6),
        ("angstrom", 0.1),
        ("nanometer", 1.0),
        ("inch", 25.4e6),
        ("foot", 12.0 * 25.4e6),
        ("yard", 36.0 * 25.4e6),
        ("kilometer", 1e12),
        ("mile", 1760.0 * 36.0 * 25.4e6),
        ("yottameter", 1e33),
    ] {
        let (notes, voxel_nm) = sized(|image| {
            for n in 0..3 {
                image["axes"][n]["unit"] = unit.into();
            }
        });
        assert_eq!(notes, "", "{unit}");
        let want = DVec3::new(0.25, 0.25, 2.0) * nm;
        assert!(
            (voxel_nm / want - 1.0).abs().max_element() < 1e-9,
            "{unit}: {voxel_nm}"
        );
    }
    let (notes, voxel_nm) = sized(|image| image["axes"][1]["unit"] = "furlong".into());
    assert!(
        notes.contains("not known: \"furlong\"") && notes.contains("micrometers"),
        "{notes}"
    );
    assert_eq!(voxel_nm, DVec3::new(250.0, 250.0, 2000.0));
}

#[test]
fn what_is_not_said_of_a_size_is_told() {
    let without = |image: &mut Value| {
        for level in 0..2 {
            image["datasets"][level]["coordinateTransformations"] = json!([]);
        }
    };
    let (notes, voxel_nm) = sized(without);
    assert!(notes.contains("are taken for 1 micrometer"), "{notes}");
    assert_eq!(voxel_nm, DVec3::splat(1000.0));
    let (notes, voxel_nm) = sized(|image| {
        without(image);
        for n in 0..3 {
            image["axes"][n]["unit"] = "nanometer".into();
        }
    });
    assert!(
        notes.contains("(scale)") && notes.ends_with("voxels are taken for 1 nanometer"),
        "{notes}"
    );
    assert_eq!(voxel_nm, DVec3::ONE);
    let (notes, _) = sized(|image| image["axes"] = json!(["z", "y", "x"]));
    assert!(notes.contains("1 micrometer where it does not"), "{notes}");
}

fn refusal(folder: &Path) -> String {
    let error = open(folder).unwrap_err();
    std::error::Error::source(&error).unwrap().to_string()
}

#[test]
fn what_cannot_be_shown_is_refused_in_words() {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("image.zarr");
    let refuses = |attributes: &Value, words: &str| {
        for version in [Version::V2, Version::V3] {
            drop(fs::remove_dir_all(&folder));
            write_attributes(&folder, version, attributes);
            for level in 0..2 {
                write_array(
                    &folder.join(format!("s{level}")),
                    "zyx",
                    "uint8",
                    version,
                    level,
                );
            }
            let refusal = refusal(&folder);
            assert!(refusal.contains(words), "{refusal}");
        }
    };
    refuses(&json!({"plate": {"wells": []}}), "PLATE/A/1/0");
    refuses(&json!({"well": {"images": []}}), "WELL/0");
    refuses(&json!({"bioformats2raw.layout": 3}), "COLLECTION/0");
    refuses(&json!({}), "multiscales");
    refuses(
        &json!({"multiscales": [{"axes": [], "datasets": []}]}),
        "levels",
    );
    let edit = |path: &str, value: Value| {
        let mut attributes = attributes("zyx", 2);
        *attributes.pointer_mut(path).unwrap() = value;
        attributes
    };
    refuses(
        &edit("/multiscales/0/datasets/0/path", json!("../s0")),
        "outside",
    );
    refuses(
        &edit("/multiscales/0/datasets/1/path", json!("/s0")),
        "outside",
    );
    refuses(
        &edit("/multiscales/0/datasets/0/path", json!("s7")),
        "no array",
    );
    refuses(
        &edit("/multiscales/0/axes/0/name", json!("q")),
        "axis \"q\"",
    );
    refuses(&edit("/multiscales/0/axes/0/name", json!("x")), "two axes");
    refuses(
        &edit("/multiscales/0/axes", json!(["y", "x"])),
        "3 axes, and 2 have names",
    );
    let swapped = json!([{"path": "s1"}, {"path": "s0"}]);
    refuses(&edit("/multiscales/0/datasets", swapped), "fine to coarse");
    let scale = "/multiscales/0/datasets/0/coordinateTransformations/0/scale";
    refuses(&edit(scale, json!([1.0, 0.0, 1.0])), "no size");
    for wrong in [json!([1.0, 1.0]), json!([1.0, 1.0, 1.0, 1.0]), json!(2.0)] {
        refuses(&edit(scale, wrong), "a scale has no number for each axis");
    }

    drop(fs::remove_dir_all(&folder));
    let nothing = refusal(&root.path().join("nothing"));
    assert!(
        nothing.contains("neither zarr.json nor .zattrs"),
        "{nothing}"
    );
    fs::create_dir(&folder).unwrap();
    fs::write(folder.join(".zattrs"), "{").unwrap();
    assert!(refusal(&folder).contains("make no sense"));
}

#[test]
fn other_types_and_absurd_shapes_are_refused() {
    let root = tempfile::tempdir().unwrap();
    for (what, from, to, words) in [
        ("type", "\"uint8\"", "\"complex64\"", "complex64"),
        ("codec", "\"bytes\"", "\"zfp\"", "zfp"),
        (
            "chunk",
            "[2,17,50]",
            "[70000,70000,70000]",
            "too large to decode",
        ),
        ("chunk", "[2,17,50]", "[2,17]", "do not fit"),
        ("chunk", "[2,17,50]", "[2,0,50]", "do not fit"),
        ("shape", "[9,41,83]", "[9,41,99000000000]", "too long"),
        (
            "shape",
            "[9,41,83]",
            "[9,41,4000000000]",
            "an axis can have",
        ),
        ("shape", "[9,41,83]", "[9,-41,83]", "no shape"),
        (
            "key",
            "\"node_type\"",
            "\"wrapped\":{\"name\":\"x\"},\"node_type\"",
            "it has \"wrapped\", which is not known",
        ),
        // What would make every chunk a missing one.
        (
            "key encoding",
            "\"name\":\"default\"",
            "\"name\":\"suffix\"",
            "named in another way (chunk_key_encoding)",
        ),
        (
            "version",
            "\"zarr_format\":3",
            "\"zarr_format\":4",
            "its zarr_format is 4",
        ),
        (
            "key",
            "\"node_type\"",
            "\"plain\":false,\"node_type\"",
            "it has \"plain\", which is not known",
        ),
    ] {
        let folder = root.path().join(format!("{words}.zarr"));
        write_image(&folder, "zyx", "uint8", Version::V3);
        let file = folder.join("s0/zarr.json");
        let text = fs::read_to_string(&file).unwrap();
        assert!(text.contains(from), "{what}: {text}");
        fs::write(&file, text.replace(from, to)).unwrap();
        let refusal = refusal(&folder);
        assert!(refusal.contains(words), "{what}: {refusal}");
    }
}

/// Version 3 tells the bits of floating-point numbers that have no other name.
#[test]
fn fill_values_may_be_told_by_their_bits() {
    for (fill, dtype, filled) in [
        ("0x40490fdb", "float32", true),
        ("0x400921fb54442d18", "float64", true),
        ("0x40490fd", "float32", false),
        ("0x40490fdb", "float64", false),
        ("0x4049zfdb", "float32", false),
        ("0x00000005", "uint32", false),
    ] {
        let metadata = json!({"zarr_format": 3, "node_type": "array", "shape": [4, 5, 6],
            "data_type": dtype, "fill_value": fill,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [2, 5, 6]}},
            "chunk_key_encoding": {"name": "default"},
            "codecs": [{"name": "bytes", "configuration": {"endian": "little"}}]});
        let array = Array::version_3(&metadata);
        assert_eq!(array.is_ok(), filled, "{fill} {dtype}");
        let Ok(array) = array else { continue };
        let value = match dtype {
            "float32" => f64::from(f32::from_le_bytes(array.fill.try_into().unwrap())),
            _ => f64::from_le_bytes(array.fill.try_into().unwrap()),
        };
        assert!((value - std::f64::consts::PI).abs() < 1e-6, "{value}");
    }
}

/// What says of itself that it need not be understood, and what is said of groups.
#[test]
fn what_an_array_says_beside_the_matter_is_passed_over() {
    let folder = tempfile::tempdir().unwrap();
    write_image(folder.path(), "zyx", "uint8", Version::V3);
    let file = folder.path().join("s0/zarr.json");
    let mut array: Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
    array["remark"] = json!({"must_understand": false, "text": "hello"});
    array["consolidated_metadata"] = Value::Null;
    array["storage_transformers"] = json!([]);
    array["dimension_names"] = json!(["z", "y", "x"]);
    fs::write(&file, array.to_string()).unwrap();
    open(folder.path()).unwrap();
}

#[test]
fn one_damaged_chunk_costs_its_own_voxels_and_names_its_array() {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("image.zarr");
    write_image(&folder, "zyx", "uint8", Version::V3);
    // x from 50 on is damaged in sections 0 and 1; from y = 34 on nothing was stored.
    fs::write(folder.join("s0/c/0/0/1"), [1, 2, 3]).unwrap();
    for z in 0..5 {
        for x in 0..2 {
            fs::remove_file(folder.join(format!("s0/c/{z}/2/{x}"))).unwrap();
        }
    }
    let source = open(&folder).unwrap();
    let read = |x: u32, level: u32| {
        let chunk = UVec3::new(x, 0, 0);
        runtime().block_on(source.read(ChunkId {
            channel: 0,
            level,
            chunk,
        }))
    };
    let error = read(1, 0).unwrap_err();
    assert!(!error.is_transient());
    let cause = std::error::Error::source(&error).unwrap().to_string();
    assert!(cause.contains("damaged") && cause.contains("s0"), "{cause}");
    assert!(matches!(read(0, 1), Ok(Chunk::Voxels(_))));
    // A folder in its place is not a chunk that was never stored.
    fs::remove_file(folder.join("s0/c/0/0/1")).unwrap();
    fs::create_dir(folder.join("s0/c/0/0/1")).unwrap();
    let error = read(1, 0).unwrap_err();
    assert!(!error.is_transient(), "{error:?}");
}

#[test]
fn what_was_never_stored_is_empty() {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("image.zarr");
    write_image(&folder, "czyx", "uint16", Version::V2);
    for entry in fs::read_dir(folder.join("s1")).unwrap() {
        let path = entry.unwrap().path();
        if path
            .file_name()
            .unwrap()
            .to_string_lossy()
            .starts_with("1.")
        {
            fs::remove_file(path).unwrap();
        }
    }
    let source = open(&folder).unwrap();
    let read = |channel| {
        let chunk = UVec3::ZERO;
        runtime().block_on(source.read(ChunkId {
            channel,
            level: 1,
            chunk,
        }))
    };
    assert!(matches!(read(0), Ok(Chunk::Voxels(_))));
    assert!(matches!(read(1), Ok(Chunk::Empty)));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    /// Whatever stands in the metadata, opening ends, with an image or a reason.
    #[test]
    fn any_metadata_end_in_an_image_or_a_reason(at in 0_usize..2000, byte in any::<u8>(), which in 0..3_u8) {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("image.zarr");
        write_attributes(&folder, Version::V3, &attributes("zyx", 1));
        write_array(&folder.join("s0"), "zyx", "uint8", Version::V3, 0);
        let file = folder.join(["zarr.json", "s0/zarr.json", "s0/c/0/0/0"][usize::from(which)]);
        let mut bytes = fs::read(&file).unwrap();
        let at = at % bytes.len();
        bytes[at] = byte;
        fs::write(&file, bytes).unwrap();
        if let Ok(source) = open(&folder) {
            let id = ChunkId { channel: 0, level: 0, chunk: UVec3::ZERO };
            drop(runtime().block_on(source.read(id)));
        }
    }
}

/// The same blastocyst by two programs: version 0.1 with blosc, 0.5 in shards. Its level 2 there is every
/// fourth voxel here, from the fourth on.
#[test]
fn two_versions_of_a_real_image_agree() {
    let old = crate::shared::data("idr0062-6001240-ngff01/6001240.zarr");
    let new = crate::shared::data("idr0062-6001240-ngff05/6001240_labels_v0.5.zarr");
    let (Some(old), Some(new)) = (old, new) else {
        return;
    };
    let (old, new) = (open(&old).unwrap(), open(&new).unwrap());
    assert_eq!(old.volume().channels, ["LaminB1", "Dapi"]);
    assert_eq!(old.volume().channels, new.volume().channels);
    let end = 1500.0 / 65_535.0;
    for volume in [old.volume(), new.volume()] {
        let looks = [[0, 0, 255], [255, 255, 0]].map(|color| Look {
            color: Some(color),
            window: Some([0.0, end]),
            hidden: false,
        });
        assert_eq!(volume.looks, looks);
    }
    assert_eq!(old.volume().extent(), UVec3::new(271, 275, 236));
    assert_eq!(old.volume().levels.len(), 3);
    let voxel = |source: &ZarrSource, channel: u32, at: UVec3| -> u16 {
        let chunk = at / source.volume().chunk;
        let id = ChunkId {
            channel,
            level: 0,
            chunk,
        };
        let inside = at % source.volume().chunk;
        let size = source.volume().chunk;
        match runtime().block_on(source.read(id)).unwrap() {
            Chunk::Empty => 0,
            Chunk::Voxels(bytes) => {
                let index = ((inside.z * size.y + inside.y) * size.x + inside.x) as usize * 2;
                u16::from_le_bytes([bytes[index], bytes[index + 1]])
            }
        }
    };
    let mut different = 0;
    for n in 0..40_u32 {
        let at = UVec3::new(n * 37 % 67, n * 53 % 68, n * 71 % 236);
        for channel in 0..2 {
            let fine = UVec3::new(at.x * 4 + 3, at.y * 4 + 3, at.z);
            let want = voxel(&old, channel, fine);
            assert_eq!(voxel(&new, channel, at), want, "channel {channel} at {at}");
            different += u32::from(voxel(&old, channel, fine - UVec3::X) != want);
        }
    }
    assert!(different > 20, "neighbours differ, so that places matter");
}
