//! Writes a volume, or a part of one, as an image that needs no Saccade: OME-Zarr 0.5 with shards.
//!
//! # What is written
//!
//! A group, and one array per level: axes c, z, y, x, the volume's chunks compressed by zstd, many in one
//! object (a shard). Levels lie on each other as in the volume; those of a part begin at the voxel that
//! holds its corner, so coarse levels may reach a little further than the fine ones. Chunks that are 0
//! everywhere are left out, and so are shards of nothing else.
//!
//! # What happens meanwhile
//!
//! The group's description, without which nobody takes the folder for an image, comes last. Until then
//! `export.json` says what is being written; the same export begun again keeps the shards that are there, if the
//! volume has not changed since. What changes while it is exported is exported again, until all is of one
//! state.
//!
//! # Memory
//!
//! Two shards of at most 64 MiB, and what the source keeps.

mod plan;
mod shard;
#[cfg(test)]
mod tests;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::{FutureExt, StreamExt, stream};
use glam::UVec3;
use saccade_archive::storage::{Storage, StorageError};
use saccade_core::voxel_box::VoxelBox;

use crate::{ChunkError, VolumeSource};
use plan::{Plan, ShardId};
use shard::ShardEncoder;

/// Object in which an export says what it is, as long as it is not whole.
pub const UNFINISHED: &str = "export.json";
/// What makes a folder an image.
const GROUP: &str = "zarr.json";
/// Shards at a time: one is read while the other is compressed and written.
const SHARDS_AT_ONCE: usize = 2;

/// What to export.
#[derive(Clone, Debug, PartialEq)]
pub struct ExportOptions {
    /// Which part \[voxels of level 0\]; `None` for all of it. Cut at the volume's end.
    pub region: Option<VoxelBox>,
    /// Which channels, in this order; `None` for all.
    pub channels: Option<Vec<u32>>,
    /// The volume's level that becomes the finest of the image.
    pub finest: u32,
    /// How hard zstd tries: 1 is fast, 22 small; 0 stores chunks as they are.
    pub compression: u8,
    /// Pause before a chunk that failed for a passing reason is asked for again, if the source names none.
    pub retry: Duration,
}

impl Default for ExportOptions {
    fn default() -> Self {
        Self {
            region: None,
            channels: None,
            finest: 0,
            compression: 3,
            retry: Duration::from_secs(1),
        }
    }
}

/// How far an export is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ExportProgress {
    /// Shards of all levels; grows when some are exported again.
    pub shards: u64,
    /// Shards that are done: `kept`, `empty` or written.
    pub done: u64,
    /// Shards of an earlier attempt.
    pub kept: u64,
    /// Shards in which nothing was acquired.
    pub empty: u64,
    /// Shards that were exported again, because the volume changed there.
    pub again: u64,
    /// Written \[bytes\].
    pub bytes: u64,
}

/// Why nothing was exported, or not all.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExportError {
    /// No voxel of the volume is in the part.
    #[error(
        "nothing of the volume lies in the region {}: the volume is {}; give a part of it",
        ranges(*region), ranges(VoxelBox::of_size(*extent))
    )]
    Region {
        /// As asked for.
        region: VoxelBox,
        /// Size of the volume \[voxels\].
        extent: UVec3,
    },
    /// There is no such channel, or it is named twice.
    #[error("{channel} is no channel to export, or named twice; the channels are: {}", known.join(", "))]
    Channel {
        /// As asked for.
        channel: u32,
        /// Names of the channels there are, from 0.
        known: Vec<String>,
    },
    /// There is no such level.
    #[error("the volume has no level {level}; its levels are 0 to {last}")]
    Level {
        /// As asked for.
        level: u32,
        /// The coarsest.
        last: u32,
    },
    /// The place is taken.
    #[error("there is something already; export to an empty place, or empty it")]
    Exists,
    /// Something else was begun there.
    #[error(
        "another export was begun there: {differences}; repeat that one to go on with it, or export to another \
         place"
    )]
    Other {
        /// What differs between that one and this.
        differences: String,
    },
    /// Voxels could not be had.
    #[error("cannot read what is to be exported")]
    Read {
        /// Why.
        source: ChunkError,
    },
    /// It could not be written.
    #[error("cannot write the export")]
    Write {
        /// Why.
        #[from]
        source: StorageError,
    },
    /// A shard could not be made.
    #[error("cannot encode a shard ({reason})")]
    Encode {
        /// What the library says.
        reason: String,
    },
}

/// Writes an image into a storage; tells `progress` after each shard. Dropping the future gives up, and the
/// same call goes on with it later.
///
/// # Errors
///
/// [`ExportError`].
pub async fn export(
    source: &Arc<dyn VolumeSource>,
    storage: &dyn Storage,
    options: &ExportOptions,
    progress: &(dyn Fn(ExportProgress) + Sync),
) -> Result<ExportProgress, ExportError> {
    let plan = Plan::new(source.volume(), options)?;
    // Listened to first: what changes from here on is in the stream.
    let mut changes = source.changes();
    let revision = source.revision();
    let resumed = begin(storage, &plan, revision).await?;

    let mut all: Vec<ShardId> = plan.shards().collect();
    let mut state = ExportProgress {
        shards: all.len() as u64,
        ..ExportProgress::default()
    };
    if resumed {
        let mut there = BTreeSet::new();
        for level in 0..plan.levels.len() {
            there.extend(storage.list(&format!("{level}/c/")).await?);
        }
        all.retain(|shard| !there.contains(&shard.key()));
        state.kept = state.shards - all.len() as u64;
        state.done = state.kept;
    }
    progress(state);

    let encoder = ShardEncoder::new(&plan)?;
    loop {
        let mut written = stream::iter(&all)
            .map(|&shard| {
                let (encoder, plan) = (&encoder, &plan);
                async move {
                    let bytes = encoder.shard(source, plan, shard, options.retry).await?;
                    write(storage, &shard.key(), bytes).await
                }
            })
            .buffer_unordered(SHARDS_AT_ONCE);
        while let Some(bytes) = written.next().await {
            let bytes = bytes?;
            state.done += 1;
            state.empty += u64::from(bytes == 0);
            state.bytes += bytes;
            progress(state);
        }
        drop(written);
        let mut again = BTreeSet::new();
        while let Some(Some(change)) = changes.next().now_or_never() {
            again.extend(plan.touched(change.voxels));
        }
        if again.is_empty() {
            break;
        }
        all = again.into_iter().collect();
        state.again += all.len() as u64;
        state.shards += all.len() as u64;
        progress(state);
    }

    for level in 0..plan.levels.len() {
        let text = pretty(&plan.array(level));
        storage
            .write_durable(&format!("{level}/zarr.json"), text)
            .await?;
    }
    storage.write_durable(GROUP, pretty(&plan.group())).await?;
    storage.delete(UNFINISHED).await?;
    Ok(state)
}

/// Says what is being written; whether shards that are there are still right.
async fn begin(storage: &dyn Storage, plan: &Plan, revision: u64) -> Result<bool, ExportError> {
    let ours = plan.description();
    let with_revision = serde_json::json!({ "export": ours, "revision": revision });
    let state = match storage.read(UNFINISHED, None).await {
        Ok(state) => Some(state),
        Err(StorageError::NotFound { .. }) => None,
        Err(error) => return Err(error.into()),
    };
    if let Some(state) = state {
        let begun: serde_json::Value = serde_json::from_slice(&state).unwrap_or_default();
        if begun["export"] != ours {
            let differences = plan::differences(&begun["export"], &ours);
            return Err(ExportError::Other { differences });
        }
        if begun == with_revision {
            return Ok(true);
        }
    } else if !storage.list("").await?.is_empty() {
        return Err(ExportError::Exists);
    }
    storage
        .write_durable(UNFINISHED, pretty(&with_revision))
        .await?;
    Ok(false)
}

/// Writes a shard, or removes one that holds nothing any more; how many bytes it has.
async fn write(storage: &dyn Storage, key: &str, bytes: Option<Bytes>) -> Result<u64, ExportError> {
    let Some(bytes) = bytes else {
        storage.delete(key).await?;
        return Ok(0);
    };
    let len = bytes.len() as u64;
    storage.write_durable(key, bytes).await?;
    Ok(len)
}

/// A box, for people.
fn ranges(voxels: VoxelBox) -> String {
    let axis = |name: &str, n: usize| format!("{name} {} to {}", voxels.min[n], voxels.max[n]);
    [axis("x", 0), axis("y", 1), axis("z", 2)].join(", ")
}

fn pretty(value: &serde_json::Value) -> Bytes {
    format!("{value:#}\n").into()
}
