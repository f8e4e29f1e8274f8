//! Images of other programs, part by part: the fuzzed bytes are one object of an image that is right otherwise.

use std::sync::Arc;
use std::time::Duration;

use glam::UVec3;
use saccade_source::objects::{HttpObjects, MemoryObjects, Objects, Part, Patience, S3Objects};
use saccade_source::precomputed::PrecomputedSource;
use saccade_source::zarr::ZarrSource;
use saccade_source::{ChunkId, VolumeSource};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpListener;

/// A reader.
pub type Target = fn(&[u8]);

/// All of them, by name.
pub const TARGETS: [(&str, Target); 17] = [
    ("zarr_group", zarr_group),
    ("zarr_array", zarr_array),
    ("zarr_shard", zarr_shard),
    ("zarr_blosc", zarr_blosc),
    ("zarr_gzip", |bytes| zarr_packed("gzip", bytes)),
    ("zarr_zlib", |bytes| zarr_packed("numcodecs.zlib", bytes)),
    ("zarr_zstd", |bytes| zarr_packed("zstd", bytes)),
    ("zarr_lz4", |bytes| zarr_packed("numcodecs.lz4", bytes)),
    ("zarr_2_array", zarr_2_array),
    ("zarr_2_attributes", zarr_2_attributes),
    ("precomputed_info", precomputed_info),
    ("precomputed_shard", precomputed_shard),
    ("compressed_segmentation", compressed_segmentation),
    ("precomputed_png", |bytes| {
        precomputed_picture("png", "uint16", bytes)
    }),
    ("precomputed_jpeg", |bytes| {
        precomputed_picture("jpeg", "uint8", bytes)
    }),
    ("http_answer", http_answer),
    ("s3_answer", s3_answer),
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
            .enable_all()
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

/// Chunks whose bytes are compressed once.
fn zarr_packed(codec: &str, bytes: &[u8]) {
    let codecs = format!(r#"[{{"name":"bytes"}},{{"name":"{codec}","configuration":{{}}}}]"#);
    zarr(GROUP.as_bytes(), array(&codecs).as_bytes(), bytes);
}

fn zarr_2(attributes: &[u8], array: &[u8]) {
    run(async {
        let chunk: &[u8] = &[1; 300];
        let objects = objects(&[
            (".zgroup", br#"{"zarr_format":2}"#),
            (".zattrs", attributes),
            ("0/.zarray", array),
            ("0/0.0.0", chunk),
            ("0/0/0/0", chunk),
        ]);
        if let Ok(source) = ZarrSource::open(objects, "image").await {
            look_at(&source).await;
        }
    });
}

fn zarr_2_array(bytes: &[u8]) {
    let attributes = r#"{"multiscales":[{"version":"0.4","axes":[{"name":"z"},{"name":"y"},{"name":"x"}],
        "datasets":[{"path":"0"}]}]}"#;
    zarr_2(attributes.as_bytes(), bytes);
}

fn zarr_2_attributes(bytes: &[u8]) {
    let array = r#"{"zarr_format":2,"shape":[4,8,8],"chunks":[4,8,8],"dtype":"|u1","compressor":null,"fill_value":0,
        "filters":null,"order":"C"}"#;
    zarr_2(bytes, array.as_bytes());
}

fn precomputed(info: &[u8], chunk: &[u8]) {
    run(async {
        let objects = objects(&[
            ("info", info),
            ("s/0-9_0-7_0-3", chunk),
            ("s/0-16_0-13_0-5", chunk),
            ("s/0.shard", chunk),
        ]);
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

fn precomputed_picture(encoding: &str, number: &str, bytes: &[u8]) {
    let info = format!(
        r#"{{"type":"image","data_type":"{number}","num_channels":1,"scales":[{{"key":"s","size":[16,13,5],
        "chunk_sizes":[[16,13,5]],"resolution":[1,1,1],"encoding":"{encoding}"}}]}}"#
    );
    precomputed(info.as_bytes(), bytes);
}

/// A server that answers whatever it is asked with the same bytes, and what is read of it: no more than was asked for.
async fn answered(bytes: &[u8], store: impl FnOnce(String) -> Arc<dyn Objects>) {
    let listener = TcpListener::bind("127.0.0.1:0").await;
    let listener = listener.expect("a port is free");
    let address = listener.local_addr().expect("it has an address");
    let serve = async {
        loop {
            let (mut stream, _) = listener.accept().await.expect("somebody connects");
            let (mut request, mut part) = (Vec::new(), [0; 1024]);
            while !request.ends_with(b"\r\n\r\n") {
                match stream.read(&mut part).await {
                    Ok(count @ 1..) => request.extend_from_slice(&part[..count]),
                    _ => break,
                }
            }
            // Whoever has read enough goes.
            let _ = stream.write_all(bytes).await;
            let _ = stream.shutdown().await;
        }
    };
    let ask = async {
        let store = store(format!("http://{address}"));
        for (part, least, most) in [
            (Part::Range(2..8), 6, 6),
            (Part::Last(3), 0, 3),
            (Part::Whole { most: 64 }, 0, 64),
        ] {
            if let Ok(Some(bytes)) = store.read("a/b", part.clone()).await {
                assert!((least..=most).contains(&bytes.len()), "{part:?}: {bytes:?}");
            }
        }
    };
    tokio::select! {
        () = serve => {}
        () = ask => {}
    }
}

/// Asks once, and waits for nobody.
const PATIENCE: Patience = Patience {
    attempts: 1,
    first_wait: Duration::ZERO,
    longest_wait: Duration::ZERO,
    idle: Duration::from_millis(500),
    slowest: 1,
};

/// Status, headers and body of an answer by HTTP.
fn http_answer(bytes: &[u8]) {
    let store = |address: String| -> Arc<dyn Objects> {
        Arc::new(HttpObjects::with_patience(&address, PATIENCE).expect("an address"))
    };
    run(answered(bytes, store));
}

/// Those of an answer of a store that speaks S3.
fn s3_answer(bytes: &[u8]) {
    let store = |address: String| -> Arc<dyn Objects> {
        let settings = [("AWS_ENDPOINT_URL", &*address), ("AWS_REGION", "us-east-1")];
        let settings = settings.map(|(name, value)| (name.to_owned(), value.to_owned()));
        let bucket = "s3://bucket".parse().expect("a bucket");
        let store = S3Objects::with_settings(&bucket, settings, PATIENCE);
        Arc::new(store.expect("a store"))
    };
    run(answered(bytes, store));
}
