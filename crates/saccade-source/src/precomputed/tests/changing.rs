//! Shards that are written while they are read.

use std::sync::Mutex;
use std::time::Duration;

use bytes::Bytes;
use futures::{FutureExt as _, StreamExt as _};
use saccade_core::voxel_box::VoxelBox;

use super::*;
use crate::images::ImageOptions;
use crate::objects::Patience;

const SHARD: &str = "s0/0.shard";
const EXTENT: UVec3 = UVec3::new(128, 64, 4);

/// A shard of two chunks, as they are, and in the other order.
fn shard(values: [u8; 2], swapped: bool) -> Bytes {
    const LENGTH: usize = 4 * 64 * 64;
    let mut chunks = [(0_u64, values[0]), (1, values[1])];
    if swapped {
        chunks.reverse();
    }
    let data = chunks.map(|(_, value)| vec![value; LENGTH]).concat();
    let (length, [(first, _), (second, _)]) = (LENGTH as u64, chunks);
    let index = [first, second.wrapping_sub(first), 0, 0, length, length];
    let entry = [2 * length, 2 * length + 48];
    let numbers = |numbers: &[u64]| numbers.iter().flat_map(|n| n.to_le_bytes()).collect();
    let [entry, index]: [Vec<u8>; 2] = [numbers(&entry), numbers(&index)];
    [entry, data, index].concat().into()
}

fn first(chunk: &Chunk) -> u8 {
    match chunk {
        Chunk::Voxels(bytes) => bytes[0],
        Chunk::Empty => 0,
    }
}

/// The index of a shard that has come, or was replaced, is read anew, and that is told.
#[tokio::test]
async fn shards_that_come_and_are_replaced_are_read_and_told() {
    let info = json!({"@type": "neuroglancer_multiscale_volume", "type": "image", "data_type": "uint8",
        "num_channels": 1, "scales": [{"chunk_sizes": [[64, 64, 4]], "encoding": "raw", "key": "s0",
        "resolution": [8, 8, 40], "size": EXTENT.to_array(), "voxel_offset": [0, 0, 0],
        "sharding": {"@type": "neuroglancer_uint64_sharded_v1", "preshift_bits": 1, "hash": "identity",
        "minishard_bits": 0, "shard_bits": 0, "minishard_index_encoding": "raw", "data_encoding": "raw"}}]});
    let server = TestServer::start([("info".to_owned(), info.to_string().into())]).await;
    let patience = Patience {
        attempts: 1,
        ..Patience::default()
    };
    let put = |bytes: Bytes, tag| {
        server
            .objects
            .lock()
            .unwrap()
            .insert(SHARD.to_owned(), bytes);
        *server.tag.lock().unwrap() = Some(tag);
    };
    for store in server.stores(patience) {
        server.objects.lock().unwrap().remove(SHARD);
        let options = ImageOptions {
            missing_for: Duration::ZERO,
            ..ImageOptions::default()
        };
        let source = PrecomputedSource::open_with(store, "v", options).await;
        let source = source.unwrap();
        let changes = Mutex::new(source.changes());
        let read = async |x| {
            let id = ChunkId {
                chunk: UVec3::new(x, 0, 0),
                channel: 0,
                level: 0,
            };
            let read = source.read(id).await.unwrap();
            let told = changes.lock().unwrap().next().now_or_never().flatten();
            (first(&read), told.map(|change| change.voxels))
        };
        let all = VoxelBox::of_size(EXTENT);
        assert_eq!([read(0).await, read(1).await], [(0, None); 2]);
        put(shard([1, 2], false), "\"one\"");
        assert_eq!(read(0).await, (1, Some(all)));
        put(shard([3, 4], true), "\"two\"");
        assert_eq!(read(1).await, (4, Some(all)));
        assert_eq!(read(0).await, (3, None));
    }
}
