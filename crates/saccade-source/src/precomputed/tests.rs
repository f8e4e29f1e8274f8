//! Volumes that tensorstore wrote (`fixtures/write.py`), voxel by voxel, and what is not right.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

mod changing;
mod hostile;

use std::path::{Path, PathBuf};

use saccade_core::voxel_box::VoxelBox;
use serde_json::{Value, json};

use super::*;
use crate::conformance::{check_reading, check_volume};
use crate::objects::{FolderObjects, HttpObjects, MemoryObjects};
use crate::test_server::TestServer;

const SIZE: UVec3 = UVec3::new(45, 31, 11);

fn fixture(name: &str) -> PathBuf {
    let fixtures = "src/precomputed/tests/fixtures";
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join(fixtures)
        .join(name)
}

async fn open(name: &str) -> PrecomputedSource {
    let objects = FolderObjects::new(&fixture(name));
    PrecomputedSource::open(Arc::new(objects), name)
        .await
        .unwrap()
}

/// The script's `busy`, `smooth` and `blocks`.
fn busy(at: UVec3, channel: u32) -> u32 {
    1 + (7 * at.x + 131 * at.y + 1009 * at.z + 17 * channel) % 250
}

fn smooth(at: UVec3, channel: u32) -> u32 {
    40 + 2 * at.x + at.y + 3 * at.z + 20 * channel
}

fn blocks(at: UVec3, channel: u32) -> u32 {
    (at.x / 7 + 3 * (at.y / 5) + 11 * (at.z / 3)) % 40 * (1 + channel)
}

/// A chunk of values that follow from positions.
fn chunk(volume: &Volume, id: ChunkId, value: impl Fn(UVec3, u32) -> u32) -> Vec<u8> {
    let min = id.chunk * volume.chunk;
    let extent = volume.levels[id.level as usize].extent;
    let all = VoxelBox::new(min, min + volume.chunk);
    let bytes = all.iter().flat_map(|at| {
        let value = if at.cmplt(extent).all() {
            value(at, id.channel)
        } else {
            0
        };
        value.to_le_bytes().into_iter().take(volume.dtype.bytes())
    });
    bytes.collect()
}

#[tokio::test]
async fn voxels_are_those_that_were_written() {
    type Formula = fn(UVec3, u32) -> u32;
    let cases: [(&str, Formula, usize); 6] = [
        ("raw", busy, 1),
        ("raw_sharded", |at, c| busy(at, c) * 200, 2),
        ("png", busy, 1),
        ("png_deep", |at, c| busy(at, c) * 200, 1),
        ("segments", blocks, 1),
        ("segments_sharded", blocks, 2),
    ];
    for (name, formula, channels) in cases {
        let source = open(name).await;
        let volume = source.volume().clone();
        check_volume(&volume).unwrap();
        assert_eq!(
            (volume.extent(), volume.channels.len()),
            (SIZE, channels),
            "{name}"
        );
        assert_eq!(volume.voxel_nm, DVec3::new(8.0, 8.0, 40.0));
        assert_eq!(volume.kind.is_labels(), name.starts_with("segments"));
        check_reading(&source, |id| chunk(&volume, id, formula), 0)
            .await
            .unwrap();
        let wrong = |id| chunk(&volume, id, |at, c| formula(at + UVec3::X, c));
        assert!(check_reading(&source, wrong, 0).await.is_err(), "{name}");
    }
}

#[tokio::test]
async fn levels_and_first_voxels_are_as_the_info_says() {
    let source = open("raw").await;
    let level = source.volume().levels[1];
    assert_eq!(level.extent, UVec3::new(23, 16, 11));
    assert_eq!(level.downsampling, DVec3::new(2.0, 2.0, 1.0));
    assert!(
        source.notes()[0].contains("100, -20, 3"),
        "{:?}",
        source.notes()
    );
}

/// The second level is named as if it began elsewhere; what it holds is not moved.
#[tokio::test]
async fn levels_lie_where_their_offsets_say() {
    let folder = tempfile::tempdir().unwrap();
    let value = |at: UVec3| u8::try_from(busy(at, 0)).unwrap();
    let write = |key: &str, begin: [i64; 3], size: UVec3| {
        let ends = (0..3).map(|n| format!("{}-{}", begin[n], begin[n] + i64::from(size[n])));
        let name = ends.collect::<Vec<_>>().join("_");
        std::fs::create_dir_all(folder.path().join(key)).unwrap();
        let bytes: Vec<u8> = VoxelBox::of_size(size).iter().map(value).collect();
        std::fs::write(folder.path().join(key).join(name), bytes).unwrap();
    };
    let coarse = UVec3::new(23, 16, 11);
    write("s0", [7, -20, 3], SIZE);
    // Where it belongs is 3.5, -10, 3, which is rounded.
    for (n, (begin, at)) in [([3, -10, 3], [0; 3]), ([8, -13, 3], [5, -3, 0])]
        .into_iter()
        .enumerate()
    {
        let key = format!("s1{n}");
        write(&key, begin, coarse);
        let scale = |key: &str, by: u32, size: UVec3, offset: [i64; 3]| {
            json!({"key": key, "size": size.to_array(), "chunk_sizes": [size.to_array()], "encoding": "raw",
                "resolution": [8 * by, 8 * by, 40], "voxel_offset": offset})
        };
        let scales = [
            scale("s0", 1, SIZE, [7, -20, 3]),
            scale(&key, 2, coarse, begin),
        ];
        let info = json!({"@type": "neuroglancer_multiscale_volume", "type": "image", "data_type": "uint8",
            "num_channels": 1, "scales": scales});
        std::fs::write(folder.path().join("info"), info.to_string()).unwrap();
        let objects = FolderObjects::new(folder.path());
        let source = PrecomputedSource::open(Arc::new(objects), "moved")
            .await
            .unwrap();
        let volume = source.volume().clone();
        assert_eq!(volume.origin_nm.to_array(), [56.0, -160.0, 120.0]);
        // 3 and 8 voxels of 16 nm are half a one less than 3.5 and, rounded, 9 from where the whole is.
        let shift = DVec3::new(-8.0, 0.0, 0.0);
        assert_eq!(volume.shifts_nm, [DVec3::ZERO, shift]);
        let oracle = |id: ChunkId, off: glam::IVec3| {
            let size = if id.level == 0 { SIZE } else { coarse };
            let begin = if id.level == 0 {
                glam::IVec3::ZERO
            } else {
                off
            };
            chunk(&volume, id, |at, _| {
                let own = at.as_ivec3() - begin;
                let inside = own.cmpge(glam::IVec3::ZERO).all() && own.as_uvec3().cmplt(size).all();
                if inside { busy(own.as_uvec3(), 0) } else { 0 }
            })
        };
        check_reading(&source, |id| oracle(id, at.into()), 0)
            .await
            .unwrap();
        let wrong = |id| oracle(id, glam::IVec3::from(at) + glam::IVec3::Y);
        assert!(check_reading(&source, wrong, 0).await.is_err());
        let note = source.notes().join(" ");
        assert_eq!(note.contains("begins 5, -3, 0"), n == 1, "{note}");
    }
}

#[tokio::test]
async fn pictures_that_lose_a_little_lose_a_little() {
    for (name, channels) in [("jpeg", 1), ("jpeg_colour", 3)] {
        let source = open(name).await;
        let volume = source.volume().clone();
        let mut furthest = 0;
        for channel in 0..channels {
            let id = ChunkId {
                channel,
                level: 0,
                chunk: UVec3::ZERO,
            };
            let Chunk::Voxels(bytes) = source.read(id).await.unwrap() else {
                panic!("{name} is empty");
            };
            for (got, want) in bytes.iter().zip(chunk(&volume, id, smooth)) {
                furthest = furthest.max(got.abs_diff(want));
            }
        }
        // Colours are stored as differences; neighbours in another order would be 60 away.
        assert!(
            furthest <= if channels == 1 { 2 } else { 8 },
            "{name}: {furthest}"
        );
    }
}

#[tokio::test]
async fn large_names_and_fractions_are_fitted_and_told() {
    let source = open("segments_large").await;
    assert!(
        source.notes()[0].contains("names of things"),
        "{:?}",
        source.notes()
    );
    let id = ChunkId {
        channel: 0,
        level: 0,
        chunk: UVec3::ZERO,
    };
    let Chunk::Voxels(bytes) = source.read(id).await.unwrap() else {
        panic!("it is empty");
    };
    let shown = bytes
        .as_chunks::<2>()
        .0
        .iter()
        .map(|two| u16::from_le_bytes(*two));
    let mut of_name = std::collections::BTreeMap::new();
    let ids = chunk(source.volume(), id, blocks);
    for (shown, name) in shown.zip(ids.as_chunks::<2>().0) {
        assert_eq!(
            *of_name.entry(*name).or_insert(shown),
            shown,
            "a thing has one number"
        );
    }
    let numbers: std::collections::BTreeSet<u16> = of_name.values().copied().collect();
    assert_eq!(
        (of_name[&[0, 0]], numbers.len()),
        (0, 40),
        "nothing is nothing, and things differ"
    );

    let source = open("floats").await;
    let Chunk::Voxels(bytes) = source.read(id).await.unwrap() else {
        panic!("it is empty");
    };
    // From 0.25 to 62.5 in 65535 steps.
    let step = (250.0 - 1.0) / 65_534.0;
    let wanted = chunk(source.volume(), id, busy);
    for (shown, want) in bytes
        .as_chunks::<2>()
        .0
        .iter()
        .zip(wanted.as_chunks::<2>().0)
    {
        let (shown, want) = (u16::from_le_bytes(*shown), u16::from_le_bytes(*want));
        let back = (f64::from(shown) - 1.0) * step + 1.0;
        assert!(
            want == 0 || (back - f64::from(want)).abs() <= step,
            "{shown} for {want}"
        );
    }
}

fn info() -> Value {
    json!({"@type": "neuroglancer_multiscale_volume", "type": "image", "data_type": "uint8", "num_channels": 1,
        "scales": [{"key": "s", "size": [4, 4, 4], "chunk_sizes": [[4, 4, 4]], "resolution": [1, 1, 1],
        "encoding": "raw", "voxel_offset": [0, 0, 0]}]})
}

#[tokio::test]
async fn what_cannot_be_shown_is_refused_in_words() {
    let sharding = |name: &str, value: Value| {
        let mut sharding = json!({"@type": "neuroglancer_uint64_sharded_v1", "preshift_bits": 9, "hash": "identity",
            "minishard_bits": 6, "shard_bits": 15});
        sharding[name] = value;
        sharding
    };
    for (pointer, value, words) in [
        ("/@type", json!("neuroglancer_skeletons"), "only volumes"),
        ("/data_type", json!("complex64"), "complex64"),
        ("/num_channels", json!(0), "channels"),
        ("/scales", json!([]), "levels"),
        ("/scales/0/key", json!("../s"), "outside"),
        ("/scales/0/size", json!([4, 0, 4]), "size"),
        ("/scales/0/size", json!([1e12, 4, 4]), "size"),
        ("/scales/0/resolution", json!([1, -1, 1]), "no size"),
        ("/scales/0/chunk_sizes", json!([]), "chunk size"),
        ("/scales/0/encoding", json!("compresso"), "compresso"),
        (
            "/scales/0/encoding",
            json!("compressed_segmentation"),
            "uint32",
        ),
        ("/scales/0/sharding", sharding("hash", json!("md5")), "md5"),
        (
            "/scales/0/sharding",
            sharding("minishard_bits", json!(61)),
            "minishard_bits",
        ),
        (
            "/scales/0/sharding",
            sharding("shard_bits", json!(60)),
            "64 bits",
        ),
    ] {
        let mut info = info();
        if pointer.ends_with("sharding") {
            info["scales"][0]["sharding"] = Value::Null;
        }
        *info.pointer_mut(pointer).unwrap() = value;
        let objects: MemoryObjects = [("info".to_owned(), info.to_string().into())]
            .into_iter()
            .collect();
        let error = PrecomputedSource::open(Arc::new(objects), "x")
            .await
            .unwrap_err();
        assert!(error.to_string().contains(words), "{words}: {error}");
    }
    let mut large = info();
    large["scales"][0]["size"] = json!([70_000, 70_000, 70_000]);
    large["scales"][0]["chunk_sizes"] = json!([[70_000, 70_000, 70_000]]);
    let objects: MemoryObjects = [("info".to_owned(), large.to_string().into())]
        .into_iter()
        .collect();
    let error = PrecomputedSource::open(Arc::new(objects), "x")
        .await
        .unwrap_err();
    assert!(error.to_string().contains("too large"), "{error}");
}

/// Copies of stores that compress in transport, behind a server that knows nothing of that.
#[tokio::test]
async fn chunks_that_are_called_gz_are_found() {
    let server = TestServer::of_folder(&fixture("segments")).await;
    let id = ChunkId {
        channel: 0,
        level: 0,
        chunk: UVec3::ZERO,
    };
    let read = async || {
        server.log.lock().unwrap().clear();
        let objects = Arc::new(HttpObjects::new(&server.url).unwrap());
        let source = PrecomputedSource::open(objects, "segments").await.unwrap();
        source.read(id).await.unwrap()
    };
    let good = read().await;
    assert_eq!(server.asked(".gz"), 0);
    let objects = server.objects.lock().unwrap().clone();
    let chunks = objects.keys().filter(|key| key.starts_with("s0/"));
    let names: Vec<String> = chunks.cloned().collect();
    assert_eq!(names.len(), 27);
    // What is missing among others that are there is asked for by both names at most once.
    server.objects.lock().unwrap().remove(&names[0]);
    assert!(read().await != good);
    assert!(server.asked(".gz") <= 1);
    let mut objects = objects;
    for name in &names {
        let bytes = objects.remove(name).unwrap();
        let mut zip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        std::io::Write::write_all(&mut zip, &bytes).unwrap();
        objects.insert(format!("{name}.gz"), zip.finish().unwrap().into());
    }
    *server.objects.lock().unwrap() = objects;
    assert!(read().await == good);
    assert_eq!(server.asked(".gz"), 27);
}

/// Segmentations of a real brain by cloud-volume and tensorstore, if they are there.
#[tokio::test]
async fn real_volumes_open() {
    for (name, extent) in [
        ("precomputed_gray_raw_unsharded", UVec3::new(140, 135, 130)),
        ("precomputed_seg_cseg_sharded", UVec3::splat(250)),
        ("precomputed_pinky40_16nm_cseg_u32_gz", UVec3::splat(512)),
    ] {
        let Some(folder) = crate::shared::data(&format!("derived-refwriters/dev/{name}")) else {
            continue;
        };
        let source = PrecomputedSource::open(Arc::new(FolderObjects::new(&folder)), name)
            .await
            .unwrap();
        assert_eq!(source.volume().extent(), extent, "{name}");
        let mut seen = 0;
        for chunk in VoxelBox::of_size(source.volume().chunks(0)).iter().take(8) {
            let id = ChunkId {
                channel: 0,
                level: 0,
                chunk,
            };
            if let Chunk::Voxels(bytes) = source.read(id).await.unwrap() {
                seen += bytes.iter().filter(|byte| **byte != 0).count();
            }
        }
        assert!(seen > 100_000, "{name}: {seen} bytes are not 0");
    }
}
