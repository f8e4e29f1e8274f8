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
//! `export.json` says what is being written; the same export begun again keeps the shards that are there,
//! but for those in which the volume has changed since, as far as its source knows where. Once the image is
//! whole, its attribute `saccade` says the same, and how many shards there are, and that of its finest level
//! does, by which an image goes on that has lost its description. Begun once more, nothing is
//! done where all of them are there; what is missing is exported again, and so is a shard that has lost its
//! end or its index.
//!
//! What changes while it is exported is exported again, until all is of one state: once the volume rests,
//! the finest levels first, so that a coarse shard waits for what changes below it.
//!
//! What was begun without letting ids of labels become others may go on with it: the shards that are there
//! have only ids that fit.
//!
//! # Memory
//!
//! Two shards of at most 64 MiB, and what the source keeps.

mod plan;
mod queue;
mod shard;
mod sound;
#[cfg(test)]
mod tests;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::StreamExt;
use futures::stream::FuturesUnordered;
use glam::UVec3;
use saccade_archive::storage::{Storage, StorageError};
use saccade_core::voxel_box::VoxelBox;

use crate::{ChunkError, VolumeSource};
use plan::{Plan, ShardId};
use queue::{Changes, Queue};
use shard::ShardEncoder;
use sound::sound;

#[cfg(any(test, fuzzing))]
pub(crate) use {plan::fuzz_state, sound::fuzz_description, sound::fuzz_shard};

/// Object in which an export says what it is, as long as it is not whole.
pub const UNFINISHED: &str = "export.json";
/// What makes a folder an image.
const GROUP: &str = "zarr.json";
/// Attribute of it, and of the finest level, that says which export it is.
const OURS: &str = "saccade";
/// What describes the finest level, and where in it that attribute is.
const FINEST: &str = "0/zarr.json";
const STATE: &str = "/attributes/saccade";
/// How many shards there are, in it.
const SHARDS: &str = "shards";
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
    /// Whether ids of labels that are too large for the volume's type may become other numbers, which several may share.
    pub rename_labels: bool,
    /// Pause before a chunk that failed for a passing reason is asked for again, if the source names none.
    pub retry: Duration,
    /// A chunk that fails for passing reasons is asked for up to ten times, and not again once it has been asked for during so
    /// long. Each request has deadlines of its source's: [`Patience`](crate::objects::Patience),
    /// [`RemoteOptions`](crate::remote::RemoteOptions).
    pub patience: Duration,
    /// How long nothing must have changed before shards are exported again; waited for at most fifteen times
    /// as long.
    pub quiet: Duration,
}

impl Default for ExportOptions {
    fn default() -> Self {
        Self {
            region: None,
            channels: None,
            finest: 0,
            compression: 3,
            rename_labels: false,
            retry: Duration::from_secs(1),
            patience: Duration::from_secs(300),
            quiet: Duration::from_secs(2),
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
    /// Whether nothing was to be done: the same export was there, and whole.
    pub was_whole: bool,
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
    /// The same export is there, of another state of the volume.
    #[error(
        "the same export is there and whole, of the volume's revision {there}; the volume is at {now}: export to another place, \
         or empty this one"
    )]
    Outdated {
        /// Revision of the volume that was exported.
        there: u64,
        /// Its revision.
        now: u64,
    },
    /// An id of labels has no room in the image that would be written.
    #[error(
        "the labels have ids such as {id}, which do not fit into an exported voxel (0 to 65535); copy the image as it is, or \
         let such ids become other numbers, which several may share"
    )]
    Label {
        /// The id.
        id: i128,
    },
    /// Voxels could not be had.
    #[error("cannot read what is to be exported{}", asked(*times))]
    Read {
        /// How often the chunk was asked for; a source may have made several attempts each time.
        times: u32,
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

fn asked(times: u32) -> String {
    match times {
        1 => String::new(),
        times => format!(", though asked for {times} times"),
    }
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
    let mut changes = Changes::of(source);
    let begun = begin(&**source, storage, &plan, changes.revision()).await?;

    let mut state = ExportProgress {
        shards: plan.shards().count() as u64,
        was_whole: begun == Begun::Whole,
        ..ExportProgress::default()
    };
    if state.was_whole {
        (state.kept, state.done) = (state.shards, state.shards);
        progress(state);
        return Ok(state);
    }
    let there = match begun {
        Begun::Partly => sound(storage, &plan).await?,
        _ => BTreeSet::new(),
    };
    // Shards that are objects, and those that are to be.
    let (mut full, missing): (BTreeSet<ShardId>, BTreeSet<_>) =
        { plan.shards() }.partition(|shard| there.contains(&shard.key()));
    state.kept = full.len() as u64;
    state.done = state.kept;
    progress(state);

    let encoder = ShardEncoder::new(&plan)?;
    let mut queue = Queue::new(missing);
    let mut running = FuturesUnordered::new();
    loop {
        if queue.is_only_again() && running.is_empty() {
            changes.wait_for_quiet(options.quiet).await;
        }
        let mut again = 0;
        for voxels in changes.take() {
            again += queue.changed(plan.touched(voxels));
        }
        if again > 0 {
            state.again += again;
            state.shards += again;
            progress(state);
        }
        while running.len() < SHARDS_AT_ONCE
            && let Some(shard) = queue.begin()
        {
            let (encoder, plan) = (&encoder, &plan);
            running.push(async move {
                let bytes = encoder.shard(source, plan, shard, options).await?;
                // Before it is written: an export that goes on keeps what is there.
                if let Some(id) = source.renamed_label().filter(|_| !plan.rename_labels) {
                    return Err(ExportError::Label { id });
                }
                Ok((shard, write(storage, &shard.key(), bytes).await?))
            });
        }
        let Some(done) = running.next().await else {
            break;
        };
        let (shard, bytes) = done?;
        queue.end(shard);
        match bytes {
            0 => full.remove(&shard),
            _ => full.insert(shard),
        };
        state.done += 1;
        state.empty += u64::from(bytes == 0);
        state.bytes += bytes;
        progress(state);
    }
    drop(running);

    let ours = state_of(&plan, changes.revision());
    for level in 0..plan.levels.len() {
        let mut array = plan.array(level);
        if level == 0 {
            array["attributes"][OURS] = ours.clone();
        }
        let key = format!("{level}/zarr.json");
        storage.write_durable(&key, pretty(&array)).await?;
    }
    let mut group = plan.group();
    group["attributes"][OURS] = ours;
    group["attributes"][OURS][SHARDS] = full.len().into();
    storage.write_durable(GROUP, pretty(&group)).await?;
    storage.delete(UNFINISHED).await?;
    Ok(state)
}

/// What there is of an export before it begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Begun {
    /// Nothing.
    Not,
    /// Shards that are still right.
    Partly,
    /// All of it.
    Whole,
}

/// What is exported, and of which state of the volume.
fn state_of(plan: &Plan, revision: u64) -> serde_json::Value {
    serde_json::json!({ "export": plan.description(), "revision": revision })
}

async fn json(storage: &dyn Storage, key: &str) -> Result<Option<serde_json::Value>, ExportError> {
    match storage.read(key, None).await {
        Ok(text) => Ok(Some(serde_json::from_slice(&text).unwrap_or_default())),
        Err(StorageError::NotFound { .. }) => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// Names of the objects that the levels of an export have.
async fn there(storage: &dyn Storage, plan: &Plan) -> Result<BTreeSet<String>, ExportError> {
    let mut there = BTreeSet::new();
    for level in 0..plan.levels.len() {
        there.extend(storage.list(&format!("{level}/")).await?);
    }
    Ok(there)
}

/// Whether all of an export is there that had so many shards when it was whole.
async fn is_whole(
    storage: &dyn Storage,
    plan: &Plan,
    shards: Option<u64>,
) -> Result<bool, ExportError> {
    let there = sound(storage, plan).await?;
    let arrays = (0..plan.levels.len()).all(|level| there.contains(&format!("{level}/zarr.json")));
    let found = { plan.shards() }.filter(|shard| there.contains(&shard.key()));
    Ok(arrays && shards == Some(found.count() as u64))
}

/// Removes shards of an attempt that began at another revision: those in which something has changed since, or all where
/// nobody knows.
async fn remove_outdated(
    source: &dyn VolumeSource,
    storage: &dyn Storage,
    plan: &Plan,
    since: Option<u64>,
    now: u64,
) -> Result<(), ExportError> {
    let changes = match since.filter(|since| *since < now) {
        Some(since) => source.changes_after(since).await,
        None => None,
    };
    let touched: Option<BTreeSet<String>> = changes.map(|changes| {
        let touched = { changes.iter() }.flat_map(|change| plan.touched(change.voxels));
        touched.map(ShardId::key).collect()
    });
    let (mut removed, mut left) = (0_u64, 0_u64);
    for name in there(storage, plan).await? {
        if name.split('/').nth(1) != Some("c") {
            continue;
        }
        if touched
            .as_ref()
            .is_none_or(|touched| touched.contains(&name))
        {
            storage.delete(&name).await?;
            removed += 1;
        } else {
            left += 1;
        }
    }
    let since = since.map_or("another revision".to_owned(), |since| {
        format!("revision {since}")
    });
    match touched {
        Some(_) => log::info!(
            "the volume is at revision {now}, and the export was begun at {since}: {removed} of its shards are exported \
             again, and {left} have not changed"
        ),
        None => log::warn!(
            "the volume is at revision {now}, and the export was begun at {since}; what has changed in between is no longer \
             known, so it begins anew, without the {removed} shards that were there"
        ),
    }
    Ok(())
}

/// Says what is being written, unless all of it is there.
async fn begin(
    source: &dyn VolumeSource,
    storage: &dyn Storage,
    plan: &Plan,
    revision: u64,
) -> Result<Begun, ExportError> {
    let ours = state_of(plan, revision);
    let unfinished = json(storage, UNFINISHED).await?;
    let group = json(storage, GROUP).await?;
    let finest = json(storage, FINEST).await?;
    // Where neither is there, it was whole once, and has lost its description.
    let finest = finest.and_then(|mut array| Some(array.pointer_mut(STATE)?.take()));
    let begun = match group {
        Some(_) => unfinished,
        None => unfinished.or(finest),
    };
    if let Some(begun) = begun {
        if !plan::goes_on(&begun["export"], &ours["export"]) {
            let differences = plan::differences(&begun["export"], &ours["export"]);
            return Err(ExportError::Other { differences });
        }
        if begun["revision"] == ours["revision"] {
            // Also where it was there: from now on ids may become others.
            storage.write_durable(UNFINISHED, pretty(&ours)).await?;
            return Ok(Begun::Partly);
        }
        // It may have been whole but for the end of this object: no image while it is written anew.
        storage.delete(GROUP).await?;
        let of = begun["revision"].as_u64();
        remove_outdated(source, storage, plan, of, revision).await?;
        // Not before these are gone: an attempt that ends here goes on from the revision that is told.
        storage.write_durable(UNFINISHED, pretty(&ours)).await?;
        return Ok(Begun::Partly);
    } else if let Some(group) = group {
        let there = &group["attributes"][OURS];
        if !plan::goes_on(&there["export"], &ours["export"]) {
            return Err(ExportError::Exists);
        }
        let of = there["revision"].as_u64().unwrap_or_default();
        if of != revision {
            return Err(ExportError::Outdated {
                there: of,
                now: revision,
            });
        }
        if is_whole(storage, plan, there[SHARDS].as_u64()).await? {
            return Ok(Begun::Whole);
        }
        // Somebody took a part of it away, or spoilt it: no image until that is there again.
        storage.write_durable(UNFINISHED, pretty(&ours)).await?;
        storage.delete(GROUP).await?;
        return Ok(Begun::Partly);
    } else if !storage.list("").await?.is_empty() {
        return Err(ExportError::Exists);
    }
    storage.write_durable(UNFINISHED, pretty(&ours)).await?;
    Ok(Begun::Not)
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
