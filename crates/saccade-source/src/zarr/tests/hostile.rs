//! Images behind servers that fail, lie, or are slow.

use std::error::Error as _;
use std::fs;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use bytes::Bytes;
use futures::{FutureExt as _, StreamExt as _};
use glam::UVec3;
use saccade_core::voxel_box::VoxelBox;
use serde_json::{Value, json};

use super::ZarrSource;
use super::written::{read_all, version_3, write};
use crate::objects::{FolderObjects, HttpObjects, Objects, Patience};
use crate::test_server::{Fault, TestServer};
use crate::{Chunk, ChunkError, ChunkId, VolumeSource};

pub(super) fn patience() -> Patience {
    Patience {
        attempts: 3,
        first_wait: Duration::from_millis(5),
        longest_wait: Duration::from_millis(50),
        idle: Duration::from_millis(400),
        slowest: 10_000,
    }
}

fn sharded() -> Value {
    let bytes = json!({"name": "bytes", "configuration": {"endian": "little"}});
    let zstd = json!({"name": "zstd", "configuration": {"level": 1, "checksum": false}});
    json!([{"name": "sharding_indexed", "configuration": {"chunk_shape": [4, 16, 20],
        "codecs": [bytes, zstd], "index_codecs": [bytes, {"name": "crc32c"}], "index_location": "end"}}])
}

pub(super) fn blosc() -> Value {
    let bytes = json!({"name": "bytes", "configuration": {"endian": "little"}});
    json!([bytes, {"name": "blosc", "configuration": {"cname": "zstd", "clevel": 5, "shuffle": "shuffle",
        "typesize": 2, "blocksize": 0}}])
}

/// A server of an image with these codecs, and the image's values.
pub(super) async fn server(shard: [u32; 3], codecs: &Value) -> (Arc<TestServer>, Vec<u16>) {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("image.zarr");
    let want = write(&folder, "uint16", &version_3("uint16", shard, codecs));
    (TestServer::of_folder(&folder).await, want)
}

async fn open(server: &TestServer) -> ZarrSource {
    let [http, _] = server.stores(patience());
    open_of(http).await
}

async fn open_of(objects: Arc<dyn Objects>) -> ZarrSource {
    ZarrSource::open(objects, "image.zarr").await.unwrap()
}

pub(super) fn id(x: u32) -> ChunkId {
    ChunkId {
        channel: 0,
        level: 0,
        chunk: UVec3::new(x, 0, 0),
    }
}

fn told(error: &ChunkError) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text += &format!(": {error}");
        cause = error.source();
    }
    text
}

#[test]
fn voxels_over_http_are_those_of_the_folder() {
    for (shard, codecs) in [([8, 64, 40], sharded()), ([4, 33, 40], blosc())] {
        let tokio = tokio::runtime::Runtime::new().unwrap();
        let (server, want) = tokio.block_on(server(shard, &codecs));
        let source = tokio.block_on(open(&server));
        assert!(read_all(&tokio, &source) == want);
    }
}

#[tokio::test]
async fn neighbours_in_a_shard_come_together_and_once() {
    let (server, _) = server([16, 64, 80], &sharded()).await;
    let source = open(&server).await;
    server.log.lock().unwrap().clear();
    // 64 x 61 x 13 voxels are 4 x 4 x 4 chunks of one shard; several readers want them.
    let readers = (0..6).map(|_| source.read(id(0)));
    for read in futures::future::join_all(readers).await {
        assert!(matches!(read, Ok(Chunk::Voxels(_))));
    }
    let log = server.log.lock().unwrap().clone();
    let indices = log
        .iter()
        .filter(|(_, range)| range.as_deref() == Some("-1028"));
    assert_eq!(indices.count(), 1, "{log:?}");
    assert_eq!(
        log.len(),
        2,
        "an index, and everything else at once: {log:?}"
    );
    // The rest is in the same shard, whose index is known.
    source.read(id(1)).await.unwrap();
    assert_eq!(
        server.log.lock().unwrap().len(),
        2,
        "all of it came with its neighbours"
    );
}

#[tokio::test]
async fn what_passes_is_read_again_and_what_stays_names_the_chunk() {
    let by_way = async |way| {
        let (server, _) = server([4, 33, 40], &blosc()).await;
        what_passes_is_read_again(&server, way).await;
    };
    tokio::join!(by_way(0), by_way(1));
}

async fn what_passes_is_read_again(server: &TestServer, way: usize) {
    let open = async || open_of(server.stores(patience())[way].clone()).await;
    let good = open().await.read(id(0)).await.unwrap();
    let faults = [
        (Fault::Status("429 Too Many Requests"), true),
        (Fault::Status("500 Oops"), true),
        (Fault::Status("503 Slow Down\r\nretry-after: 0"), true),
        (Fault::Reset, true),
        (Fault::Cut, true),
        (Fault::WrongLength, true),
        (Fault::OtherPart, true),
        (Fault::Stall, true),
        (Fault::Drip, true),
        (Fault::Garbage, false),
        (Fault::Longer(-3), false),
        (Fault::Longer(7), false),
    ];
    for (fault, transient) in faults {
        let source = open().await;
        server.fail_next([fault]);
        assert!(source.read(id(0)).await.unwrap() == good, "{fault:?}");

        let source = open().await;
        server.fail_always("0/c/1/0/0", fault);
        let error = source.read(id(0)).await.unwrap_err();
        let named = told(&error);
        assert!(
            named.contains("chunk [1, 0, 0] of level 0"),
            "{fault:?}: {named}"
        );
        assert!(named.contains("sub/0/c/1/0/0"), "{fault:?}: {named}");
        assert_eq!(error.is_transient(), transient, "{fault:?}: {named}");
        // Voxels of other chunks are not affected: x from 64 on is in another one.
        assert!(
            matches!(source.read(id(1)).await, Ok(Chunk::Voxels(_))),
            "{fault:?}"
        );
        // What failed is not remembered.
        server.always.lock().unwrap().clear();
        assert!(source.read(id(0)).await.unwrap() == good, "{fault:?}");
    }
}

#[tokio::test]
async fn missing_is_empty_and_forbidden_is_told() {
    let (server, want) = server([4, 33, 40], &blosc()).await;
    server.objects.lock().unwrap().remove("0/c/0/0/1");
    let source = open(&server).await;
    let Chunk::Voxels(bytes) = source.read(id(0)).await.unwrap() else {
        panic!("the others are there");
    };
    let at = |x: usize| u16::from_le_bytes([bytes[x * 2], bytes[x * 2 + 1]]);
    assert_eq!((at(39), at(40)), (want[39], 0));
    server.fail_always("0/c/0/0/0", Fault::Status("403 Forbidden"));
    let source = open(&server).await;
    let error = source.read(id(0)).await.unwrap_err();
    assert!(
        told(&error).contains("access is denied") && !error.is_transient(),
        "{}",
        told(&error)
    );
}

/// What was not stored is 0; what is not let through any more is not.
#[tokio::test]
async fn a_login_that_runs_out_makes_no_holes() {
    for (status, way) in [
        ("403 Forbidden", 0),
        ("403 Forbidden", 1),
        ("401 Unauthorized", 0),
        ("401 Unauthorized", 1),
    ] {
        let (server, _) = server([4, 33, 40], &blosc()).await;
        *server.missing.lock().unwrap() = "403 Forbidden";
        server.objects.lock().unwrap().remove("0/c/0/0/1");
        let store = server.stores(patience())[way].clone();
        let holed = open_of(store.clone()).await.read(id(0)).await.unwrap();
        assert!(matches!(holed, Chunk::Voxels(_)));
        // One that has read nothing of it so far.
        let source = open_of(store).await;
        server.fail_always("", Fault::Status(status));
        let named = told(&source.read(id(1)).await.unwrap_err());
        assert!(
            named.contains("access is denied") && named.contains("run out"),
            "{named}"
        );
        server.always.lock().unwrap().clear();
        let seen = source.read(id(1)).await.unwrap();
        assert!(matches!(seen, Chunk::Voxels(_)), "nothing was remembered");
        let fresh = open_of(server.stores(patience())[way].clone()).await;
        assert!(fresh.read(id(0)).await.unwrap() == holed);
    }
}

/// Where the shard of [`raw_image`] is.
pub(super) const SHARD: &str = "0/c/0/0/0";

/// An image of two chunks in one shard.
pub(super) fn raw_image(shard: Bytes) -> [(String, Bytes); 3] {
    let bytes = json!({"name": "bytes", "configuration": {"endian": "little"}});
    let array = json!({"zarr_format": 3, "node_type": "array", "shape": [4, 64, 128], "data_type": "uint8",
        "fill_value": 0, "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [4, 64, 128]}},
        "chunk_key_encoding": {"name": "default"}, "codecs": [{"name": "sharding_indexed", "configuration": {
        "chunk_shape": [4, 64, 64], "codecs": [bytes], "index_codecs": [bytes]}}]});
    let group = json!({"zarr_format": 3, "node_type": "group", "attributes": {"ome": {"multiscales": [{
        "axes": [{"name": "z"}, {"name": "y"}, {"name": "x"}], "datasets": [{"path": "0"}]}]}}});
    let objects = [
        ("zarr.json", group.to_string().into()),
        ("0/zarr.json", array.to_string().into()),
        (SHARD, shard),
    ];
    objects.map(|(key, bytes)| (key.to_owned(), bytes))
}

/// Two chunks in a shard, as they are, and in the other order.
pub(super) fn raw_shard(values: [u8; 2], swapped: bool) -> Bytes {
    const LENGTH: usize = 4 * 64 * 64;
    let mut places = [0, LENGTH as u64];
    let mut shard = values.map(|value| vec![value; LENGTH]);
    if swapped {
        places.reverse();
        shard.reverse();
    }
    let mut shard = shard.concat();
    for place in places {
        shard.extend(place.to_le_bytes());
        shard.extend((LENGTH as u64).to_le_bytes());
    }
    shard.into()
}

/// Nothing of a raw shard tells where its chunks end but its index, which is kept.
#[tokio::test]
async fn a_shard_that_is_replaced_is_not_read_by_its_old_index() {
    let shard = SHARD;
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir_all(folder.path().join("0/c/0/0")).unwrap();
    let server = TestServer::start(raw_image(raw_shard([1, 2], false))).await;
    let put = |bytes: Bytes, tag| {
        // Another file in its place, as who writes carefully does it.
        let file = folder.path().join(shard);
        fs::write(file.with_extension("new"), &bytes).unwrap();
        fs::rename(file.with_extension("new"), file).unwrap();
        server
            .objects
            .lock()
            .unwrap()
            .insert(shard.to_owned(), bytes);
        *server.tag.lock().unwrap() = Some(tag);
    };
    for (key, bytes) in server.objects.lock().unwrap().iter() {
        fs::write(folder.path().join(key), bytes).unwrap();
    }
    let [http, s3] = server.stores(patience());
    let first = |chunk: &Chunk| match chunk {
        Chunk::Voxels(bytes) => bytes[0],
        Chunk::Empty => 0,
    };
    let stores: [Arc<dyn Objects>; 3] = [http, s3, Arc::new(FolderObjects::new(folder.path()))];
    for (n, store) in stores.into_iter().enumerate() {
        for replaced in [false, true] {
            // Tags are remembered by the store, which is opened once.
            put(raw_shard([1, 2], false), "\"one\"");
            let store: Arc<dyn Objects> = match (n, replaced) {
                (_, false) => store.clone(),
                (2, true) => Arc::new(FolderObjects::new(folder.path())),
                (way, true) => server.stores(patience())[way].clone(),
            };
            let source = open_of(store.clone()).await;
            // It shares the store, and its own index is as old.
            let beside = open_of(store).await;
            let mut changes = source.changes();
            let mut told = || changes.next().now_or_never().flatten().map(|c| c.voxels);
            for one in [&source, &beside] {
                assert_eq!(first(&one.read(id(0)).await.unwrap()), 1);
            }
            if !replaced {
                assert_eq!(first(&source.read(id(1)).await.unwrap()), 2, "store {n}");
                assert_eq!(told(), None);
                continue;
            }
            put(raw_shard([3, 4], true), "\"two\"");
            assert_eq!(first(&source.read(id(1)).await.unwrap()), 4, "store {n}");
            let whole = VoxelBox::of_size(UVec3::new(128, 64, 4));
            assert_eq!(told(), Some(whole), "store {n}");
            // Nothing of the old one is kept, and nothing is told twice.
            assert_eq!(first(&source.read(id(0)).await.unwrap()), 3, "store {n}");
            assert_eq!(told(), None, "store {n}");
            assert_eq!(first(&beside.read(id(1)).await.unwrap()), 4, "store {n}");
            assert_eq!(first(&beside.read(id(0)).await.unwrap()), 3, "store {n}");
        }
    }
}

#[tokio::test]
async fn bombs_are_refused() {
    let codecs =
        |packer: Value| json!([{"name": "bytes", "configuration": {"endian": "little"}}, packer]);
    let zeros = vec![0; 12 << 20];
    let zstd = zstd::bulk::compress(&zeros, 1).unwrap();
    // Without its length in front: only decompressing tells.
    let hidden = zstd::stream::encode_all(&zeros[..], 1).unwrap();
    let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut gzip, &zeros).unwrap();
    let gzip = gzip.finish().unwrap();
    let mut zlib = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut zlib, &zeros).unwrap();
    let zlib = zlib.finish().unwrap();
    // One that says how much it is, one that says more, and one that says less.
    let block = lz4_flex::block::compress(&zeros);
    let lz4 = |length: u32| [&length.to_le_bytes()[..], &block].concat();
    let whole = u32::try_from(zeros.len()).unwrap();
    let lz4s = [lz4(whole), lz4(u32::MAX), lz4(2 * 4 * 33 * 40)];
    let numcodecs = |name: &str| json!({"name": format!("numcodecs.{name}"), "configuration": {}});
    let mut blosc_header = vec![2, 1, 1, 2];
    for number in [1 << 30, 1 << 20, 20_u32] {
        blosc_header.extend(number.to_le_bytes());
    }
    blosc_header.extend([0; 4]);
    let zstd_codec = json!({"name": "zstd", "configuration": {"level": 1, "checksum": false}});
    let gzip_codec = json!({"name": "gzip", "configuration": {"level": 1}});
    let bombs = [
        (zstd_codec.clone(), zstd),
        (zstd_codec, hidden),
        (gzip_codec, gzip),
        (numcodecs("zlib"), zlib),
        (blosc()[1].clone(), blosc_header),
    ];
    let lz4s = lz4s.map(|bomb| (numcodecs("lz4"), bomb));
    for (packer, bomb) in bombs.into_iter().chain(lz4s) {
        // The other library, which writes the image, does not know all of them.
        let (server, _) = server([4, 33, 40], &blosc()).await;
        let array: Bytes = version_3("uint16", [4, 33, 40], &codecs(packer.clone()))
            .to_string()
            .into();
        server
            .objects
            .lock()
            .unwrap()
            .insert("0/zarr.json".to_owned(), array);
        let source = open(&server).await;
        server
            .objects
            .lock()
            .unwrap()
            .insert("0/c/0/0/0".to_owned(), bomb.into());
        let error = source.read(id(0)).await.unwrap_err();
        let named = told(&error);
        assert!(
            named.contains("damaged") && named.contains("c/0/0/0"),
            "{packer}: {named}"
        );
    }
}

#[tokio::test]
async fn indices_that_lie_are_told() {
    let key = "0/c/0/0/0";
    let (server, _) = server([16, 64, 80], &sharded()).await;
    let whole = server.objects.lock().unwrap()[key].clone();
    let index = whole.len() - 1028;
    let lies = |offset: u64, length: u64, checked: bool| {
        let mut shard = whole.to_vec();
        for entry in shard[index..][..1024].chunks_exact_mut(16) {
            entry[..8].copy_from_slice(&offset.to_le_bytes());
            entry[8..].copy_from_slice(&length.to_le_bytes());
        }
        if checked {
            let sum = crc32c::crc32c(&shard[index..][..1024]).to_le_bytes();
            shard[index + 1024..].copy_from_slice(&sum);
        }
        Bytes::from(shard)
    };
    for (shard, says) in [
        (lies(0, 10, false), "crc32c"),
        (lies(u64::MAX - 5, 10, true), "no file reaches"),
        (lies(1 << 40, 10, true), "ends before"),
        (lies(0, 1 << 50, true), "can need"),
        (lies(3, 100, true), "decompress"),
        (lies(0, 0, true), "decompress"),
        (whole.slice(..500), "index has 500"),
    ] {
        server.objects.lock().unwrap().insert(key.to_owned(), shard);
        let error = open(&server).await.read(id(0)).await.unwrap_err();
        let named = told(&error);
        assert!(
            named.contains(says) && named.contains(key) && named.contains("of level 0"),
            "{says}: {named}"
        );
    }
}

#[tokio::test]
async fn a_request_ends_with_the_last_who_wants_it() {
    let (server, _) = server([16, 64, 80], &sharded()).await;
    let source = open(&server).await;
    server.fail_always("0/c/0/0/0", Fault::Stall);
    let mut first = Box::pin(source.read(id(0)));
    let mut second = Box::pin(source.read(id(1)));
    let both = async {
        drop(futures::future::join(&mut first, &mut second).await);
    };
    assert!(
        tokio::time::timeout(Duration::from_millis(60), both)
            .await
            .is_err()
    );
    drop(first);
    tokio::time::sleep(Duration::from_millis(30)).await;
    assert_eq!(
        server.gone.load(Ordering::SeqCst),
        0,
        "somebody still waits"
    );
    drop(second);
    for _ in 0..200 {
        if server.gone.load(Ordering::SeqCst) > 0 {
            return;
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    panic!("nobody waits, and the request goes on");
}

#[test]
fn metadata_that_cannot_be_read_say_where() {
    let tokio = tokio::runtime::Runtime::new().unwrap();
    tokio.block_on(async {
        let (server, _) = server([16, 64, 80], &sharded()).await;
        for (fault, says) in [
            (Fault::Status("500 Oops"), "500"),
            (Fault::Status("403 Forbidden"), "denied"),
            (Fault::Garbage, "make no sense"),
        ] {
            server.fail_always("zarr.json", fault);
            let objects = HttpObjects::with_patience(&server.url, patience()).unwrap();
            let error = ZarrSource::open(Arc::new(objects), "x").await.unwrap_err();
            let mut text = error.to_string();
            if let Some(cause) = error.source() {
                text += &cause.to_string();
            }
            assert!(
                text.contains(says) && text.contains("/sub/zarr.json"),
                "{text}"
            );
            server.always.lock().unwrap().clear();
        }
    });
}

/// A server that asks to log in, with 200, wherever one asks: of metadata, and later of voxels.
#[tokio::test]
async fn a_page_instead_of_an_image_is_called_one() {
    let (server, _) = server([4, 33, 40], &blosc()).await;
    let page = Bytes::from_static(b"<html><body>Log in</body></html>");
    for way in 0..2 {
        let source = open_of(server.stores(patience())[way].clone()).await;
        let objects = server.objects.lock().unwrap().clone();
        for object in server.objects.lock().unwrap().values_mut() {
            *object = page.clone();
        }
        *server.headers.lock().unwrap() = "\r\ncontent-type: text/html";
        let error = source.read(id(0)).await.unwrap_err();
        let named = told(&error);
        assert!(
            named.contains("a web page (HTML)") && named.contains("of level 0"),
            "{named}"
        );
        let closed = server.stores(patience())[way].clone();
        let error = ZarrSource::open(closed, "x").await.unwrap_err();
        let named = error.source().unwrap().to_string();
        assert!(
            named.contains("a web page (HTML)") && named.contains("zarr.json"),
            "{named}"
        );
        *server.objects.lock().unwrap() = objects;
        *server.headers.lock().unwrap() = "";
    }
}

#[tokio::test]
async fn sharding_that_is_not_read_is_named() {
    let plain = sharded();
    let refused = async |codecs: &Value| {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("image.zarr");
        write(
            &folder,
            "uint16",
            &version_3("uint16", [16, 64, 80], &plain),
        );
        for level in fs::read_dir(&folder).unwrap() {
            let file = level.unwrap().path().join("zarr.json");
            let Ok(text) = fs::read(&file) else { continue };
            let mut array: Value = serde_json::from_slice(&text).unwrap();
            array["codecs"] = codecs.clone();
            fs::write(file, array.to_string()).unwrap();
        }
        let open = ZarrSource::open(Arc::new(FolderObjects::new(&folder)), "x");
        open.await.unwrap_err().to_string()
    };
    let mut nested = plain.clone();
    nested[0]["configuration"]["codecs"] = plain.clone();
    let named = refused(&nested).await;
    assert!(
        named.contains("are shards themselves") && named.contains("one level of shards"),
        "{named}"
    );
    let around = json!([plain[0], {"name": "gzip", "configuration": {"level": 1}}]);
    let named = refused(&around).await;
    assert!(
        named.contains("sharding is combined with other codecs"),
        "{named}"
    );
    // Codecs that are known, though not in this order.
    let bytes = json!({"name": "bytes", "configuration": {"endian": "little"}});
    let zstd = json!({"name": "zstd", "configuration": {"level": 1, "checksum": false}});
    for (codecs, words) in [
        (json!([zstd]), "\"zstd\" takes bytes, and none before it"),
        (
            json!([zstd, bytes]),
            "\"zstd\" takes bytes, and none before it",
        ),
        (json!([bytes, zstd, bytes]), "\"bytes\" takes numbers"),
        (json!([]), "none of its codecs makes bytes"),
        (json!(["pcodec"]), "encoded by \"pcodec\"; blosc"),
    ] {
        let named = refused(&codecs).await;
        assert!(named.contains(words), "{named}");
    }
}
