//! Images of other programs, part by part: the fuzzed bytes are one object of an image that is right otherwise.

use std::sync::Arc;

use glam::UVec3;
use saccade_source::objects::MemoryObjects;
use saccade_source::precomputed::PrecomputedSource;
use saccade_source::zarr::ZarrSource;
use saccade_source::{ChunkId, VolumeSource};

/// A reader.
pub type Target = fn(&[u8]);

/// All of them, by name.
pub const TARGETS: [(&str, Target); 7] = [
    ("zarr_group", zarr_group),
    ("zarr_array", zarr_array),
    ("zarr_shard", zarr_shard),
    ("zarr_blosc", zarr_blosc),
    ("precomputed_info", precomputed_info),
    ("precomputed_shard", precomputed_shard),
    ("compressed_segmentation", compressed_segmentation),
];

const GROUP: &str = r#"{"zarr_format":3,"node_type":"group","attributes":{"ome":{"multiscales":[{"axes":[{"name":"z"},
    {"name":"y"},{"name":"x"}],"datasets":[{"path":"0"}]}]}}}"#;
const SHARDED: &str = r#"[{"name":"sharding_indexed","configuration":{"chunk_shape":[2,4,4],"codecs":[{"name":"bytes"}],
    "index_codecs":[{"name":"bytes","configuration":{"endian":"little"}}]}}]"#;
const BLOSC: &str = r#"[{"name":"bytes"},{"name":"blosc"}]"#;

fn array(codecs: &str) -> String {
    format!(
        r#"{{"zarr_format":3,"node_type":"array","shape":[4,8,8],"data_type":"uint8","fill_value":0,
        "chunk_grid":{{"name":"regular","configuration":{{"chunk_shape":[4,8,8]}}}},
        "chunk_key_encoding":{{"name":"default"}},"codecs":{codecs}}}"#
    )
}

fn objects(all: &[(&str, &[u8])]) -> Arc<MemoryObjects> {
    let owned = |(key, bytes): &(&str, &[u8])| ((*key).to_owned(), bytes.to_vec().into());
    Arc::new(all.iter().map(owned).collect())
}

fn run(work: impl Future<Output = ()>) {
    thread_local! {
        static RUNTIME: tokio::runtime::Runtime = tokio::runtime::Builder::new_current_thread()
            .enable_time()
            .build()
            .expect("a runtime");
    }
    RUNTIME.with(|runtime| runtime.block_on(work));
}

/// The first chunk of each level and of the first and last channel: whole, or an error.
async fn look_at(source: &dyn VolumeSource) {
    let volume = source.volume().clone();
    let whole = volume.chunk.as_usizevec3().element_product() * volume.dtype.bytes();
    for level in (0..).take(volume.levels.len()) {
        for channel in [0, u32::try_from(volume.channels.len()).expect("a few") - 1] {
            let chunk = UVec3::ZERO;
            let id = ChunkId {
                channel,
                level,
                chunk,
            };
            if let Ok(saccade_source::Chunk::Voxels(bytes)) = source.read(id).await {
                assert_eq!(bytes.len(), whole);
            }
        }
    }
}

fn zarr(group: &[u8], array: &[u8], chunk: &[u8]) {
    run(async {
        let chunk = [("0/c/0/0/0", chunk), ("0/c/0/0", chunk)];
        let objects = objects(&[
            ("zarr.json", group),
            ("0/zarr.json", array),
            chunk[0],
            chunk[1],
        ]);
        if let Ok(source) = ZarrSource::open(objects, "image").await {
            look_at(&source).await;
        }
    });
}

fn zarr_group(bytes: &[u8]) {
    zarr(bytes, array(SHARDED).as_bytes(), &[1; 300]);
}

fn zarr_array(bytes: &[u8]) {
    zarr(GROUP.as_bytes(), bytes, &[1; 300]);
}

fn zarr_shard(bytes: &[u8]) {
    zarr(GROUP.as_bytes(), array(SHARDED).as_bytes(), bytes);
}

fn zarr_blosc(bytes: &[u8]) {
    zarr(GROUP.as_bytes(), array(BLOSC).as_bytes(), bytes);
}

fn precomputed(info: &[u8], chunk: &[u8]) {
    run(async {
        let chunks = [("s/0-9_0-7_0-3", chunk), ("s/0.shard", chunk)];
        let objects = objects(&[("info", info), chunks[0], chunks[1]]);
        if let Ok(source) = PrecomputedSource::open(objects, "image").await {
            look_at(&source).await;
        }
    });
}

fn info(sharding: &str) -> String {
    format!(
        r#"{{"type":"segmentation","data_type":"uint64","num_channels":1,"scales":[{{"key":"s","size":[9,7,3],
        "chunk_sizes":[[9,7,3]],"resolution":[1,1,1],"encoding":"compressed_segmentation",
        "compressed_segmentation_block_size":[4,4,2]{sharding}}}]}}"#
    )
}

fn precomputed_info(bytes: &[u8]) {
    precomputed(bytes, &[1; 300]);
}

fn precomputed_shard(bytes: &[u8]) {
    let sharding = r#","sharding":{"@type":"neuroglancer_uint64_sharded_v1","preshift_bits":0,"hash":"identity",
        "minishard_bits":0,"shard_bits":1}"#;
    precomputed(info(sharding).as_bytes(), bytes);
}

fn compressed_segmentation(bytes: &[u8]) {
    precomputed(info("").as_bytes(), bytes);
}
