//! Arrays that another library wrote, in every encoding that is known, voxel by voxel.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use glam::UVec3;
use serde_json::{Value, json};
use zarrs::array::{Array, ArrayMetadata};
use zarrs::filesystem::FilesystemStore;

use super::{ZarrSource, runtime};
use crate::{Chunk, ChunkId, VolumeSource};

/// Voxels of an image, odd on every axis \[x, y, z\].
const EXTENT: UVec3 = UVec3::new(75, 61, 13);

/// Noise where x is large, and flat where it is not: chunks that compress and some that do not.
fn noise(n: u64) -> u64 {
    let x = n % u64::from(EXTENT.x);
    let mixed = n.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    if x < 40 {
        n / 300 % 90 + 1
    } else {
        mixed >> 33
    }
}

/// Writes an image of one level by the other library, and what its values are in the volume.
pub(super) fn write(folder: &Path, dtype: &str, metadata: &Value) -> Vec<u16> {
    fs::create_dir_all(folder).unwrap();
    let axis = |name: &str| json!({"name": name, "type": "space", "unit": "nanometer"});
    let scale = json!([{"type": "scale", "scale": [1.0, 1.0, 1.0]}]);
    let attributes = json!({"multiscales": [{"axes": [axis("z"), axis("y"), axis("x")],
        "datasets": [{"path": "0", "coordinateTransformations": scale}]}]});
    let group = json!({"zarr_format": 3, "node_type": "group", "attributes": {"ome": attributes}});
    fs::write(folder.join("zarr.json"), group.to_string()).unwrap();
    let store = Arc::new(FilesystemStore::new(folder).unwrap());
    let metadata: ArrayMetadata = serde_json::from_value(metadata.clone()).unwrap();
    let array = Array::new_with_metadata(store, "/0", metadata).unwrap();
    array.store_metadata().unwrap();
    let count = u64::from(EXTENT.element_product());
    let whole = [
        0..u64::from(EXTENT.z),
        0..u64::from(EXTENT.y),
        0..u64::from(EXTENT.x),
    ];
    let values = (0..count).map(noise);
    macro_rules! store {
        ($type:ty, $modulo:expr) => {{
            let values: Vec<$type> = values.map(|v| (v % $modulo) as $type).collect();
            array.store_array_subset(&&whole[..], &values).unwrap();
            values.iter().map(|v| *v as u16).collect()
        }};
    }
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "below the modulus"
    )]
    match dtype {
        "uint8" => store!(u8, 251),
        "uint16" => store!(u16, 65_000),
        "uint32" => store!(u32, 65_000),
        "int16" => store!(i16, 200),
        "int32" => store!(i32, 60_000),
        "uint64" => store!(u64, 100_000),
        "float64" => store!(f64, 60_000),
        other => panic!("{other} is not written here"),
    }
}

/// An array's metadata, version 3.
pub(super) fn version_3(dtype: &str, chunk: [u32; 3], codecs: &Value) -> Value {
    json!({"zarr_format": 3, "node_type": "array", "shape": [EXTENT.z, EXTENT.y, EXTENT.x],
        "data_type": dtype, "fill_value": 0,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "codecs": codecs})
}

fn version_2(dtype: &str, compressor: &Value, order: &str) -> Value {
    json!({"zarr_format": 2, "shape": [EXTENT.z, EXTENT.y, EXTENT.x], "chunks": [4, 33, 40],
        "dtype": dtype, "compressor": compressor, "fill_value": 0, "filters": null, "order": order,
        "dimension_separator": "/"})
}

/// Values of a whole source, in the order of its voxels.
pub(super) fn read_all(tokio: &tokio::runtime::Runtime, source: &dyn VolumeSource) -> Vec<u16> {
    let volume = source.volume().clone();
    let (extent, width) = (volume.extent(), volume.dtype.bytes());
    let mut all = vec![0; extent.element_product() as usize];
    let chunks = saccade_core::voxel_box::VoxelBox::of_size(volume.chunks(0));
    for chunk in chunks.iter() {
        let id = ChunkId {
            channel: 0,
            level: 0,
            chunk,
        };
        let Chunk::Voxels(bytes) = tokio.block_on(source.read(id)).unwrap() else {
            continue;
        };
        for at in id.voxels(&volume).unwrap().iter() {
            let inside = at - chunk * volume.chunk;
            let n = (inside.z * volume.chunk.y + inside.y) * volume.chunk.x + inside.x;
            let n = n as usize * width;
            let high = if width == 2 { bytes[n + 1] } else { 0 };
            let to = (at.z * extent.y + at.y) * extent.x + at.x;
            all[to as usize] = u16::from_le_bytes([bytes[n], high]);
        }
    }
    all
}

fn check(dtype: &str, metadata: &Value) {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("written.zarr");
    let want = write(&folder, dtype, metadata);
    let source = runtime()
        .block_on(ZarrSource::open_folder(&folder))
        .unwrap();
    if dtype != "float64" {
        assert!(read_all(&runtime(), &source) == want, "{metadata}");
        return;
    }
    // Floating-point values come in a window, in their order.
    let got = read_all(&runtime(), &source);
    assert!(
        source.notes().iter().any(|note| note.contains("float64")),
        "{:?}",
        source.notes()
    );
    let (low, high) = (want.iter().min().unwrap(), want.iter().max().unwrap());
    let step = f64::from(high - low) / 65_534.0;
    for (got, want) in got.iter().zip(&want) {
        let back = (f64::from(*got) - 1.0) * step + f64::from(*low);
        assert!(
            (back - f64::from(*want)).abs() <= step,
            "{got} for {want}: {metadata}"
        );
    }
}

fn bytes() -> Value {
    json!({"name": "bytes", "configuration": {"endian": "little"}})
}

#[test]
fn every_compression_is_read() {
    let gzip = json!({"name": "gzip", "configuration": {"level": 5}});
    let zstd = json!({"name": "zstd", "configuration": {"level": 3, "checksum": true}});
    let crc = json!({"name": "crc32c"});
    for (dtype, codecs) in [
        ("uint8", json!([bytes(), gzip])),
        ("uint16", json!([bytes(), zstd])),
        (
            "uint16",
            json!([{"name": "bytes", "configuration": {"endian": "big"}}, crc]),
        ),
        ("uint32", json!([bytes(), zstd, crc])),
        ("float64", json!([bytes(), gzip, crc])),
    ] {
        check(dtype, &version_3(dtype, [4, 33, 40], &codecs));
    }
}

#[test]
fn every_kind_of_blosc_is_read() {
    for cname in ["blosclz", "lz4", "lz4hc", "zlib", "zstd"] {
        for (shuffle, dtype, size) in [
            ("noshuffle", "uint8", 1),
            ("shuffle", "uint16", 2),
            ("bitshuffle", "uint16", 2),
            ("bitshuffle", "uint8", 1),
            ("shuffle", "float64", 8),
            ("bitshuffle", "uint32", 4),
        ] {
            // Blocks of different lengths, the last one shorter.
            for blocksize in [0, 4096] {
                let blosc = json!({"name": "blosc", "configuration": {"cname": cname, "clevel": 5,
                    "shuffle": shuffle, "typesize": size, "blocksize": blocksize}});
                check(
                    dtype,
                    &version_3(dtype, [5, 33, 40], &json!([bytes(), blosc])),
                );
            }
        }
    }
}

#[test]
fn shards_are_read() {
    let zstd = json!({"name": "zstd", "configuration": {"level": 1, "checksum": false}});
    for (location, checked) in [("end", true), ("start", true), ("end", false)] {
        let mut index = vec![bytes()];
        if checked {
            index.push(json!({"name": "crc32c"}));
        }
        let sharding = json!([{"name": "sharding_indexed", "configuration": {
            "chunk_shape": [4, 16, 20], "codecs": [bytes(), zstd],
            "index_codecs": index, "index_location": location}}]);
        check("uint16", &version_3("uint16", [8, 64, 40], &sharding));
    }
}

#[test]
fn version_2_is_read() {
    let blosc = json!({"id": "blosc", "cname": "lz4", "clevel": 5, "shuffle": 1, "blocksize": 0});
    for (dtype, name, compressor) in [
        ("uint16", "<u2", blosc),
        ("uint16", ">u2", json!({"id": "zstd", "level": 3})),
        ("uint8", "|u1", json!({"id": "gzip", "level": 5})),
        ("uint32", "<u4", Value::Null),
    ] {
        check(dtype, &version_2(name, &compressor, "C"));
    }
}

/// One chunk whose axes are in another order than the array's, by hand.
#[test]
fn transposed_chunks_are_read() {
    let shape = [EXTENT.z, EXTENT.y, EXTENT.x];
    let transpose =
        |order: [usize; 3]| json!({"name": "transpose", "configuration": {"order": order}});
    let version_3 = |codecs: Value| version_3("uint16", shape, &codecs);
    let mut column_major = version_2("<u2", &Value::Null, "F");
    column_major["chunks"] = json!(shape);
    for (order, metadata, file) in [
        (
            [2, 0, 1],
            version_3(json!([transpose([2, 0, 1]), bytes()])),
            "c/0/0/0",
        ),
        // First y x z, of which the second takes x z y.
        (
            [2, 0, 1],
            version_3(json!([transpose([1, 2, 0]), transpose([1, 2, 0]), bytes()])),
            "c/0/0/0",
        ),
        ([2, 1, 0], column_major, "0/0/0"),
        // As drafts of version 3 had it.
        (
            [2, 1, 0],
            version_3(json!([{"name": "transpose", "configuration": {"order": "F"}}, bytes()])),
            "c/0/0/0",
        ),
    ] {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("transposed.zarr");
        let plain = version_3(json!([bytes()]));
        let want = write(&folder, "uint16", &plain);
        let counts = order.map(|axis| shape[axis]);
        let mut stored = Vec::new();
        for a in 0..counts[0] {
            for b in 0..counts[1] {
                for c in 0..counts[2] {
                    let mut at = [0; 3];
                    for (axis, n) in order.iter().zip([a, b, c]) {
                        at[*axis] = n;
                    }
                    let n = (at[0] * shape[1] + at[1]) * shape[2] + at[2];
                    stored.extend(want[n as usize].to_le_bytes());
                }
            }
        }
        fs::remove_file(folder.join("0/zarr.json")).unwrap();
        let name = if metadata["zarr_format"] == 2 {
            ".zarray"
        } else {
            "zarr.json"
        };
        fs::write(folder.join("0").join(name), metadata.to_string()).unwrap();
        let file = folder.join("0").join(file);
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        fs::write(file, stored).unwrap();
        let source = runtime()
            .block_on(ZarrSource::open_folder(&folder))
            .unwrap();
        assert!(read_all(&runtime(), &source) == want, "{metadata}");
    }
}
