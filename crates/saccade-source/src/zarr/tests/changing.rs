//! Images that are written while they are read.

use std::time::Duration;

use bytes::Bytes;
use futures::{FutureExt as _, StreamExt as _};
use glam::UVec3;
use saccade_core::voxel_box::VoxelBox;

use super::ZarrSource;
use super::hostile::{SHARD, blosc, id, patience, raw_image, raw_shard, server};
use crate::images::ImageOptions;
use crate::test_server::TestServer;
use crate::{Chunk, VolumeSource};

async fn open(server: &TestServer, missing_for: Duration) -> ZarrSource {
    let [http, _] = server.stores(patience());
    let options = ImageOptions {
        missing_for,
        ..ImageOptions::default()
    };
    let opened = ZarrSource::open_with(http, "image.zarr", options).await;
    opened.unwrap()
}

fn take(server: &TestServer, key: &str) -> Bytes {
    server.objects.lock().unwrap().remove(key).unwrap()
}

fn put(server: &TestServer, key: &str, bytes: Bytes) {
    let mut objects = server.objects.lock().unwrap();
    objects.insert(key.to_owned(), bytes);
}

/// What of a shard was looked at before it came is other voxels now, whichever of it is looked at next.
#[tokio::test]
async fn a_shard_that_comes_is_told_as_a_whole() {
    let shard = raw_shard([5, 6], false);
    let server = TestServer::start(raw_image(shard.clone())).await;
    for kept in [false, true] {
        take(&server, SHARD);
        let missing_for = Duration::from_secs(if kept { 1000 } else { 0 });
        let source = open(&server, missing_for).await;
        let mut changes = source.changes();
        let mut told = || changes.next().now_or_never().flatten();
        let before = server.asked(SHARD);
        for x in [0, 1, 0] {
            assert_eq!(source.read(id(x)).await.unwrap(), Chunk::Empty);
        }
        let asked = server.asked(SHARD) - before;
        assert_eq!(asked, if kept { 1 } else { 3 });
        put(&server, SHARD, shard.clone());
        let read = source.read(id(1)).await.unwrap();
        if kept {
            assert_eq!((read, told()), (Chunk::Empty, None));
            continue;
        }
        assert!(matches!(read, Chunk::Voxels(bytes) if bytes[0] == 6));
        let change = told().map(|change| (change.revision, change.voxels));
        let whole = VoxelBox::of_size(UVec3::new(128, 64, 4));
        assert_eq!(change, Some((1, whole)));
        let read = source.read(id(0)).await.unwrap();
        assert!(matches!(read, Chunk::Voxels(bytes) if bytes[0] == 5));
        assert_eq!(told(), None, "that was told");
    }
}

#[tokio::test]
async fn a_chunk_that_comes_is_told() {
    const KEY: &str = "0/c/0/0/1";
    let (server, _) = server([4, 33, 40], &blosc()).await;
    let good = open(&server, Duration::ZERO).await.read(id(0)).await;
    let bytes = take(&server, KEY);
    let source = open(&server, Duration::ZERO).await;
    let mut changes = source.changes();
    let mut told = || changes.next().now_or_never().flatten().map(|c| c.voxels);
    let holed = source.read(id(0)).await.unwrap();
    assert!(holed != good.as_ref().unwrap().clone() && told().is_none());
    put(&server, KEY, bytes);
    assert_eq!(source.read(id(0)).await.unwrap(), good.unwrap());
    let piece = VoxelBox::new(UVec3::new(40, 0, 0), UVec3::new(75, 33, 4));
    assert_eq!(told(), Some(piece));
}
