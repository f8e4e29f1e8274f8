use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::stream::{self, StreamExt};
use glam::UVec3;
use saccade_core::volume::{Dtype, Volume};
use saccade_core::voxel_box::VoxelBox;
use serde::{Deserialize, Serialize};

use crate::maybe_send::{BoxFuture, BoxStream, MaybeSend, MaybeSync};

/// Chunks whose bounds are looked up at a time.
const RANGES_AT_ONCE: usize = 8;

/// Names one chunk of a volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ChunkId {
    /// Channel.
    pub channel: u32,
    /// Level, 0 the finest.
    pub level: u32,
    /// Position \[chunks of the level\].
    pub chunk: UVec3,
}

impl ChunkId {
    /// Voxels of the level the chunk covers, cut at the volume's end; `None` for no such chunk.
    pub fn voxels(self, volume: &Volume) -> Option<VoxelBox> {
        let level = volume.levels.get(self.level as usize)?;
        let exists = (self.channel as usize) < volume.channels.len()
            && self.chunk.cmplt(volume.chunks(self.level as usize)).all();
        let min = exists.then(|| self.chunk * volume.chunk)?;
        Some(VoxelBox::new(
            min,
            min.saturating_add(volume.chunk).min(level.extent),
        ))
    }
}

impl fmt::Display for ChunkId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "channel {} level {} chunk {}",
            self.channel, self.level, self.chunk
        )
    }
}

/// What a source knows of a chunk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Chunk {
    /// The voxels, x fastest, always a full chunk's worth of bytes.
    Voxels(Bytes),
    /// Nothing was acquired there. Stays so until a [`Change`] touches it.
    Empty,
}

/// Smallest and largest measured value of a box of voxels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ValueRange {
    /// Smallest.
    pub min: u16,
    /// Largest.
    pub max: u16,
}

/// A part of a volume that is lost until somebody mends it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Damage {
    /// Section: z index of the volume.
    pub section: u32,
    /// Name of what cannot be read, within the volume's storage.
    pub object: String,
    /// What is wrong and how to mend it, in words for people.
    pub reason: String,
}

/// Why a chunk could not be delivered.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ChunkError {
    /// The volume has no such chunk: the caller's mistake.
    #[error("the volume has no {id}")]
    OutOfRange {
        /// What was asked for.
        id: ChunkId,
    },
    /// It cannot be built in time; ask again.
    #[error("{id} is not ready")]
    NotReady {
        /// What was asked for.
        id: ChunkId,
        /// When to ask again.
        retry_after: Duration,
    },
    /// Something is in the way that may pass, as the server that reads it says; ask again.
    #[error("{id} could not be read: {reason}")]
    Hindered {
        /// What was asked for.
        id: ChunkId,
        /// When to ask again.
        retry_after: Duration,
        /// What is wrong, in words for people.
        reason: String,
    },
    /// Reading or building failed; see the source.
    #[error("{id} could not be read")]
    Failed {
        /// What was asked for.
        id: ChunkId,
        /// Whether the same request may succeed later.
        transient: bool,
        /// What went wrong.
        source: Arc<dyn std::error::Error + Send + Sync>,
    },
}

impl ChunkError {
    /// Whether the same request may succeed later.
    pub fn is_transient(&self) -> bool {
        match self {
            Self::OutOfRange { .. } => false,
            Self::NotReady { .. } | Self::Hindered { .. } => true,
            Self::Failed { transient, .. } => *transient,
        }
    }

    /// When the source wants to be asked again, if it says so.
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::NotReady { retry_after, .. } | Self::Hindered { retry_after, .. } => {
                Some(*retry_after)
            }
            Self::OutOfRange { .. } | Self::Failed { .. } => None,
        }
    }
}

/// Why a source could not be opened.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SourceError {
    /// There is no such volume.
    #[error("there is no volume {name:?}; the volumes are: {}", known.join(", "))]
    NoVolume {
        /// As asked for.
        name: String,
        /// What there is.
        known: Vec<String>,
    },
    /// The description could not be read or makes no sense.
    #[error("cannot open {location}")]
    Open {
        /// What went wrong.
        source: Arc<dyn std::error::Error + Send + Sync>,
        /// File or address.
        location: String,
    },
}

/// Why voxels changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum ChangeReason {
    /// A tile arrived, or arrived again.
    Tile,
    /// A tile moved.
    Transform,
    /// A tile was deleted.
    Deleted,
    /// Anything may have changed: events were missed.
    Missed,
}

/// Voxels that are no longer what they were.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Change {
    /// The volume's revision after it.
    pub revision: u64,
    /// Where \[level-0 voxels\].
    pub voxels: VoxelBox,
    /// Why.
    pub reason: ChangeReason,
}

/// A volume whose chunks can be asked for. Implementations pass [`crate::conformance`].
pub trait VolumeSource: MaybeSend + MaybeSync {
    /// What the volume is. Never changes for an open source.
    fn volume(&self) -> &Arc<Volume>;

    /// Reads or builds a chunk. Dropping the future cancels the request.
    ///
    /// A read that begins after [`Self::changes`] yielded a change sees that change.
    ///
    /// # Errors
    ///
    /// [`ChunkError`], of the future.
    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>>;

    /// Changes from now on, in order of revision, without gaps: where some were missed, one with
    /// [`ChangeReason::Missed`] covers the whole volume.
    fn changes(&self) -> BoxStream<'static, Change>;

    /// Revision of the newest change told so far, or of the volume when it was opened. A read that
    /// begins now sees that revision or a later one. 0 where nobody counts.
    fn revision(&self) -> u64 {
        0
    }

    /// What has changed since a revision that the volume had, for those who read it then and come back: at least
    /// these voxels. `None` where nobody knows (any more), so that anything may have.
    fn changes_after(&self, _revision: u64) -> BoxFuture<'_, Option<Vec<Change>>> {
        Box::pin(std::future::ready(None))
    }

    /// What could not be read when it was looked at last and will not get better by itself, as far as this
    /// source knows and has looked.
    fn damage(&self) -> Vec<Damage> {
        Vec::new()
    }

    /// What a user should know of how the volume is shown, in sentences: values that were mapped, for one.
    fn notes(&self) -> &[String] {
        &[]
    }

    /// An id of labels among what was read so far that is another number in the volume, which other ids may share, since
    /// the volume's type is too narrow for it, or has no negative numbers.
    fn renamed_label(&self) -> Option<i128> {
        None
    }

    /// Whether a change is noticed only when something is read again, as of files of which nobody tells. Who holds a chunk and asks
    /// whether it still is as it was has to read it.
    fn notices_by_reading(&self) -> bool {
        false
    }

    /// Bounds of a chunk's measured values, if they are at hand.
    fn value_range(&self, _id: ChunkId) -> Option<ValueRange> {
        None
    }

    /// Bounds of a chunk's measured values, looked up without building the chunk: what cannot be seen
    /// need not be read. They hold, and may be wider than they need be; `None` where nothing was
    /// acquired.
    ///
    /// A source that knows nothing says what fits its type.
    ///
    /// # Errors
    ///
    /// [`ChunkError`], of the future.
    fn find_value_range(
        &self,
        id: ChunkId,
    ) -> BoxFuture<'_, Result<Option<ValueRange>, ChunkError>> {
        let found = match id.voxels(self.volume()) {
            None => Err(ChunkError::OutOfRange { id }),
            Some(_) => Ok(Some(self.value_range(id).unwrap_or(ValueRange {
                min: 1,
                max: match self.volume().dtype {
                    Dtype::Uint8 => u16::from(u8::MAX),
                    _ => u16::MAX,
                },
            }))),
        };
        Box::pin(std::future::ready(found))
    }

    /// Bounds of several chunks' values in their order, as [`Self::find_value_range`] has each: asked for
    /// together where asking takes time.
    fn find_value_ranges<'a>(
        &'a self,
        ids: &'a [ChunkId],
    ) -> BoxFuture<'a, Vec<Result<Option<ValueRange>, ChunkError>>> {
        let each: Vec<_> = ids.iter().map(|id| self.find_value_range(*id)).collect();
        Box::pin(stream::iter(each).buffered(RANGES_AT_ONCE).collect())
    }
}
