//! The bytes of one shard.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::{StreamExt, stream};
use glam::UVec3;
use saccade_core::voxel_box::VoxelBox;
use tokio::time::Instant;
use zarrs::array::{Array, ArrayBytes, ArrayMetadata};
use zarrs::storage::store::MemoryStore;
use zarrs::storage::{ReadableStorageTraits, WritableStorageTraits};

use super::plan::{Plan, ShardId};
use super::{ExportError, ExportOptions};
use crate::objects::{chain, is_to_be_told};
use crate::{Chunk, ChunkError, ChunkId, VolumeSource};

/// Chunks that are read at a time for one shard.
const CHUNKS_AT_ONCE: usize = 8;
/// Times that a chunk is asked for which fails for passing reasons.
const TIMES: u32 = 10;
/// Longest pause between two of them.
const LONGEST_PAUSE: Duration = Duration::from_secs(30);

/// Encodes shards of every level.
pub(super) struct ShardEncoder {
    levels: Vec<Arc<Array<MemoryStore>>>,
    /// Where shards are for the moment between encoding and writing.
    store: Arc<MemoryStore>,
}

impl ShardEncoder {
    pub(super) fn new(plan: &Plan) -> Result<Self, ExportError> {
        let store = Arc::new(MemoryStore::new());
        let array = |level: usize| {
            let metadata = plan.array(level).to_string();
            let metadata = ArrayMetadata::try_from(metadata.as_str()).map_err(encode)?;
            let path = format!("/{level}");
            let array = Array::new_with_metadata(store.clone(), &path, metadata);
            Ok(Arc::new(array.map_err(encode)?))
        };
        let levels = (0..plan.levels.len()).map(array);
        let levels = levels.collect::<Result<_, ExportError>>()?;
        Ok(Self { levels, store })
    }

    /// Reads and encodes a shard; `None` where everything is 0.
    pub(super) async fn shard(
        &self,
        source: &Arc<dyn VolumeSource>,
        plan: &Plan,
        shard: ShardId,
        options: &ExportOptions,
    ) -> Result<Option<Bytes>, ExportError> {
        let Some(voxels) = read(source, plan, shard, options).await? else {
            return Ok(None);
        };
        let (array, store) = (self.levels[shard.level].clone(), self.store.clone());
        let encoded = tokio::task::spawn_blocking(move || {
            let [z, y, x] = shard.zyx.map(u64::from);
            let at = [shard.channel.into(), z, y, x];
            array
                .store_chunk(&at, ArrayBytes::new_flen(voxels))
                .map_err(encode)?;
            let key = array.chunk_key(&at);
            let bytes = store.get(&key).map_err(encode)?;
            store.erase(&key).map_err(encode)?;
            Ok(bytes)
        });
        encoded.await.map_err(encode)?
    }
}

/// The voxels of a whole shard, x fastest, 0 beyond the volume; `None` where nothing was acquired.
async fn read(
    source: &Arc<dyn VolumeSource>,
    plan: &Plan,
    shard: ShardId,
    options: &ExportOptions,
) -> Result<Option<Vec<u8>>, ExportError> {
    let (volume, planned) = (&plan.volume, &plan.levels[shard.level]);
    let wanted = planned.voxels_of(shard.xyz());
    let first = planned.voxels.min + shard.xyz() * planned.shard;
    let ids = wanted.cells(volume.chunk).map(|chunk| ChunkId {
        channel: plan.channels[shard.channel as usize],
        level: planned.level,
        chunk,
    });
    let mut chunks = stream::iter(ids)
        .map(|id| async move { Ok::<_, ExportError>((id, patiently(source, id, options).await?)) })
        .buffer_unordered(CHUNKS_AT_ONCE);
    let bytes = volume.dtype.bytes();
    let mut voxels = None;
    while let Some(read) = chunks.next().await {
        let (id, chunk): (ChunkId, Chunk) = read?;
        let Chunk::Voxels(from) = chunk else { continue };
        let to = voxels.get_or_insert_with(|| {
            let all = planned.shard.as_usizevec3().element_product();
            vec![0; all * bytes]
        });
        let corner = id.chunk * volume.chunk;
        let part = VoxelBox::new(corner, corner.saturating_add(volume.chunk)).intersection(wanted);
        let row = part.size().x as usize * bytes;
        let rows = VoxelBox::new(part.min, UVec3::new(part.min.x + 1, part.max.y, part.max.z));
        for start in rows.iter() {
            let from_at = offset(start - corner, volume.chunk) * bytes;
            let to_at = offset(start - first, planned.shard) * bytes;
            to[to_at..][..row].copy_from_slice(&from[from_at..][..row]);
        }
    }
    Ok(voxels)
}

/// Where a voxel is in a box, counted in voxels.
fn offset(at: UVec3, size: UVec3) -> usize {
    let (at, size) = (at.as_usizevec3(), size.as_usizevec3());
    (at.z * size.y + at.y) * size.x + at.x
}

/// Reads a chunk, again where that may help.
async fn patiently(
    source: &Arc<dyn VolumeSource>,
    id: ChunkId,
    options: &ExportOptions,
) -> Result<Chunk, ExportError> {
    let begun = Instant::now();
    let mut pause = options.retry;
    let mut times = 1;
    loop {
        let error: ChunkError = match source.read(id).await {
            Ok(chunk) => return Ok(chunk),
            Err(error) => error,
        };
        let is_last = times == TIMES || begun.elapsed() >= options.patience;
        if !error.is_transient() || is_last {
            return Err(ExportError::Read {
                times,
                source: error,
            });
        }
        match is_to_be_told() {
            true => log::warn!("{}; asking again", chain(&error)),
            false => log::info!("{error}; asking again"),
        }
        tokio::time::sleep(error.retry_after().unwrap_or(pause)).await;
        pause = (pause * 2).min(LONGEST_PAUSE);
        times += 1;
    }
}

fn encode(error: impl std::fmt::Display) -> ExportError {
    ExportError::Encode {
        reason: error.to_string(),
    }
}
