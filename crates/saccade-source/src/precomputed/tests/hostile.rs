//! Volumes behind stores that fail, and chunks that claim to be what they are not.

use std::io::{Cursor, Write as _};
use std::time::Duration;

use bytes::Bytes;

use super::*;
use crate::objects::Patience;
use crate::test_server::Fault;

const FIRST: ChunkId = ChunkId {
    channel: 0,
    level: 0,
    chunk: UVec3::ZERO,
};

fn told(error: &ChunkError) -> String {
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(&error);
    while let Some(error) = cause {
        text += &format!(": {error}");
        cause = error.source();
    }
    text
}

/// Whatever a store sends, there are the right voxels or an error that names the chunk.
#[tokio::test]
async fn damage_is_told_and_what_passes_is_read_again() {
    let volumes = [
        ("png", "s0/0.shard"),
        ("segments", "s0/0-16_0-13_0-5"),
        ("segments_sharded", "s0/0.shard"),
        ("jpeg", "s0/0-16_0-13_0-5"),
    ];
    // Stores of their own, so that none waits for the faults of another.
    let each = volumes.into_iter().flat_map(|(name, object)| {
        [0, 1].map(|way| async move {
            let server = TestServer::of_folder(&fixture(name)).await;
            each_fault(&server, way, name, object).await;
        })
    });
    futures::future::join_all(each).await;
}

async fn each_fault(server: &TestServer, way: usize, name: &str, object: &str) {
    let patience = Patience {
        attempts: 2,
        first_wait: Duration::from_millis(5),
        longest_wait: Duration::from_millis(50),
        idle: Duration::from_millis(400),
        slowest: 10_000,
    };
    let open = async || {
        let objects = server.stores(patience)[way].clone();
        PrecomputedSource::open(objects, name).await.unwrap()
    };
    let good = open().await.read(FIRST).await.unwrap();
    let sharded = object.ends_with(".shard");
    let mut faults = vec![
        (Fault::Status("429 Too Many Requests"), true),
        (Fault::Status("500 Oops"), true),
        (Fault::Status("503 Slow Down\r\nretry-after: 0"), true),
        (Fault::Stall, true),
        (Fault::Drip, true),
        (Fault::WrongLength, true),
        (Fault::OtherPart, true),
        (Fault::Cut, true),
        (Fault::Reset, true),
        (Fault::Garbage, false),
    ];
    if sharded {
        // Whole objects have whichever length is told.
        faults.extend([(Fault::Longer(3), true), (Fault::Longer(-3), true)]);
    }
    for (fault, transient) in faults {
        let source = open().await;
        server.fail_next([fault]);
        let read = source.read(FIRST).await;
        assert!(read.unwrap() == good, "{name} {way} {fault:?}");
        assert!(server.next.lock().unwrap().is_empty());
        let source = open().await;
        server.fail_always(object, fault);
        let error = source.read(FIRST).await.unwrap_err();
        let text = told(&error);
        assert!(
            text.contains("of level 0") && text.contains(object),
            "{name} {way} {fault:?}: {text}"
        );
        // Garbage in an index points anywhere, which no attempt mends either.
        assert_eq!(
            error.is_transient(),
            transient,
            "{name} {way} {fault:?}: {text}"
        );
        server.always.lock().unwrap().clear();
    }
}

fn zipped(bytes: &[u8]) -> Bytes {
    let mut zip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    zip.write_all(bytes).unwrap();
    zip.finish().unwrap().into()
}

/// A right picture of a chunk, and the same that says it is as large as its format allows.
fn pictures(format: ::image::ImageFormat) -> [Vec<u8>; 2] {
    let picture = ::image::GrayImage::from_pixel(4, 16, ::image::Luma([7]));
    let mut right = Cursor::new(Vec::new());
    picture.write_to(&mut right, format).unwrap();
    let right = right.into_inner();
    let mut large = right.clone();
    if format == ::image::ImageFormat::Png {
        // Behind eight bytes of signature: length, name, width, height, five more, and a checksum.
        large[16..20].copy_from_slice(&0x7fff_ffff_u32.to_be_bytes());
        large[20..24].copy_from_slice(&0x7fff_ffff_u32.to_be_bytes());
        let mut sum = flate2::Crc::new();
        sum.update(&large[12..29]);
        large[29..33].copy_from_slice(&sum.sum().to_be_bytes());
    } else {
        let frame = large
            .windows(2)
            .position(|two| two == [0xff, 0xc0])
            .unwrap();
        large[frame + 5..frame + 9].fill(0xff);
    }
    [right, large]
}

/// What claims to be more than a chunk is refused, before memory is taken for it.
#[tokio::test]
async fn bombs_are_refused() {
    let [png, large_png] = pictures(::image::ImageFormat::Png);
    let [jpeg, large_jpeg] = pictures(::image::ImageFormat::Jpeg);
    let zeros = vec![0; 8 << 20];
    // A right picture, and more behind its end than it can need.
    let trailed = |picture: &[u8]| zipped(&[picture, &zeros].concat());
    let large = "than the";
    for (encoding, bytes, says) in [
        ("raw", Bytes::from(vec![7; 64]), None),
        ("raw", zipped(&[7; 64]), None),
        ("raw", zipped(&zeros), Some(large)),
        ("png", png.clone().into(), None),
        ("png", zipped(&png), None),
        ("png", large_png.clone().into(), Some("")),
        ("png", zipped(&large_png), Some("")),
        ("png", trailed(&png), Some(large)),
        ("png", zipped(&zeros), Some(large)),
        ("jpeg", jpeg.clone().into(), None),
        ("jpeg", zipped(&jpeg), None),
        ("jpeg", large_jpeg.clone().into(), Some("")),
        ("jpeg", zipped(&large_jpeg), Some("")),
        ("jpeg", trailed(&jpeg), Some(large)),
    ] {
        let mut info = info();
        info["scales"][0]["encoding"] = encoding.into();
        let key = "s/0-4_0-4_0-4";
        let objects = [("info", info.to_string().into()), (key, bytes)];
        let objects = objects.map(|(key, bytes)| (key.to_owned(), bytes));
        let objects: MemoryObjects = objects.into_iter().collect();
        let source = PrecomputedSource::open(Arc::new(objects), "bomb")
            .await
            .unwrap();
        let read = source.read(FIRST).await;
        let Some(says) = says else {
            let Chunk::Voxels(voxels) = read.unwrap() else {
                panic!("{encoding} is empty");
            };
            assert_eq!(voxels[0], 7, "{encoding}");
            continue;
        };
        let named = told(&read.unwrap_err());
        assert!(
            named.contains("damaged") && named.contains(key) && named.contains(says),
            "{encoding}: {named}"
        );
    }
}
