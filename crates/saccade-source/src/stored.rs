//! Images that lie somewhere in chunks of their own, read as chunks of a volume.
//!
//! A chunk of ours may touch many of theirs, and one of theirs many of ours. Each of theirs is read and decoded
//! once for all who want it, kept while there is room, and given up when nobody waits any more.

mod packed;
mod piece;
mod placed;
mod replaced;
mod sample;
mod watch;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use glam::{DVec3, UVec3};
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;

use crate::flights::{Flights, Weighed, Work};
use crate::limits::CACHE_BYTES;
use crate::maybe_send::{BoxFuture, BoxStream, MaybeSend, MaybeSync};
use crate::objects::ObjectError;
use crate::values::Values;
use crate::{Change, Chunk, ChunkError, ChunkId, VolumeSource};

pub(crate) use packed::{AT_ONCE, Packed, Raw};
pub(crate) use piece::{ChunkMut, Place, copy, fill};
pub(crate) use placed::Placed;
pub(crate) use replaced::{Indexed, Indices, Replaced};
pub(crate) use sample::{Sample, sampled};
use watch::Watch;

/// One of the image's own chunks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct PieceId {
    /// Level.
    pub(crate) level: u32,
    /// Number within the level, in an order of the format's.
    pub(crate) number: u64,
}

/// What it holds.
#[derive(Clone, Debug)]
pub(crate) enum Piece {
    /// It is not stored: this value everywhere.
    Uniform(u16),
    /// Values of the volume's type.
    Values(Bytes),
}

impl Weighed for Piece {
    fn bytes(&self) -> u64 {
        match self {
            Self::Uniform(_) => 0,
            Self::Values(bytes) => bytes.len() as u64,
        }
    }

    fn is_missing(&self) -> bool {
        matches!(self, Self::Uniform(_))
    }
}

/// Why one cannot be read.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PieceError {
    /// Its object cannot be read.
    #[error("{which} cannot be read")]
    Unread {
        /// What went wrong.
        source: Arc<ObjectError>,
        /// The chunk, as its format counts.
        which: String,
    },
    /// What was read is no chunk.
    #[error("{which} is damaged: {reason}: {location}")]
    Damaged {
        /// What is wrong with it.
        reason: String,
        /// The chunk, as its format counts.
        which: String,
        /// Its object.
        location: String,
    },
}

impl PieceError {
    /// What is wrong and how to mend it, without saying where the image is kept: for those who only look.
    pub fn without_place(&self) -> String {
        match self {
            Self::Unread { source, .. } => format!("{self}: {}", source.without_place()),
            Self::Damaged { reason, which, .. } => format!(
                "{which} is damaged where the image is kept, and has to be written there anew: {reason}"
            ),
        }
    }

    fn is_transient(&self) -> bool {
        match self {
            Self::Unread { source, .. } => source.is_transient(),
            Self::Damaged { .. } => false,
        }
    }
}

/// Work on pieces, by their ids.
pub(crate) type Pieces = Work<PieceId, Piece, PieceError>;

/// A format of stored images.
pub(crate) trait Stored: MaybeSend + MaybeSync + 'static {
    /// What the image is.
    fn volume(&self) -> &Arc<Volume>;

    /// How stored numbers become values of the volume.
    fn values(&self) -> &Values;

    /// Where what is stored of a level lies in it.
    fn placed(&self, level: u32) -> Placed;

    /// The pieces that a box of stored voxels touches, and where each has its voxels.
    fn touched(&self, channel: u32, level: u32, voxels: VoxelBox) -> Vec<(PieceId, Place)>;

    /// Reads pieces, in groups that are best read together.
    fn read(self: &Arc<Self>, pieces: Vec<PieceId>) -> Vec<(Vec<PieceId>, Pieces)>;

    /// The number, within its level, of the object that a piece lies in.
    fn object(&self, id: PieceId) -> u64 {
        id.number
    }

    /// Objects of several pieces that were found to be others than before, since this was asked last.
    fn take_replaced(&self) -> Vec<Replaced> {
        Vec::new()
    }
}

/// A stored image as a source.
pub(crate) struct StoredSource<F> {
    format: Arc<F>,
    pieces: Arc<Flights<PieceId, Piece, PieceError>>,
    watch: Watch,
}

impl<F: Stored> StoredSource<F> {
    /// `piece_bytes` is about what a decoded piece takes. One that is missing is not looked for again for `missing_for`.
    pub(crate) fn new(format: F, piece_bytes: u64, missing_for: Duration) -> Self {
        Self::keeping(format, CACHE_BYTES, piece_bytes, missing_for)
    }

    /// The same, with another number of bytes that are kept.
    fn keeping(format: F, bytes: u64, piece_bytes: u64, missing_for: Duration) -> Self {
        Self {
            watch: Watch::new(VoxelBox::of_size(format.volume().extent())),
            format: Arc::new(format),
            pieces: Flights::new(bytes, piece_bytes, missing_for),
        }
    }

    /// Reads pieces of a level, and notices those that have changed.
    fn start(
        &self,
        level: u32,
        places: &[(PieceId, Place)],
        missing: Vec<PieceId>,
    ) -> Vec<(Vec<PieceId>, Pieces)> {
        let voxels = |(id, place): &(PieceId, Place)| {
            (*id, whole_voxels(&*self.format, level, place.voxels))
        };
        let places = places.iter().map(voxels);
        let places: Arc<HashMap<PieceId, VoxelBox>> = Arc::new(places.collect());
        let work = self.format.read(missing).into_iter();
        let watched = work.map(|(ids, work)| {
            let noticed = self.noticing(work);
            (ids, self.watch.over(places.clone(), noticed))
        });
        watched.collect()
    }

    /// The same work, after which nothing is kept of objects that it, or another, found replaced, and whoever listens is told.
    fn noticing(&self, work: Pieces) -> Pieces {
        let (format, pieces) = (self.format.clone(), self.pieces.clone());
        let watch = self.watch.clone();
        Box::pin(async move {
            let done = work.await;
            for Replaced { object, voxels } in format.take_replaced() {
                let is_in = |id: &PieceId| (id.level, format.object(*id)) == object;
                // Also of this work, which may have read before another found it.
                pieces.forget(is_in);
                watch.replaced(is_in, whole_voxels(&*format, object.0, voxels));
            }
            done
        })
    }

    async fn chunk(&self, id: ChunkId) -> Result<Chunk, ChunkError> {
        let volume = self.format.volume();
        let voxels = id.voxels(volume).ok_or(ChunkError::OutOfRange { id })?;
        let Some((voxels, begin)) = self.format.placed(id.level).part(voxels) else {
            return Ok(Chunk::Empty);
        };
        let touched = self.format.touched(id.channel, id.level, voxels);
        let ids: Vec<PieceId> = touched.iter().map(|(piece, _)| *piece).collect();
        let pieces = self
            .pieces
            .get(&ids, |missing| self.start(id.level, &touched, missing))
            .await;
        let mut found = Vec::with_capacity(pieces.len());
        for (piece, (_, place)) in pieces.into_iter().zip(touched) {
            match piece {
                Some(Ok(Piece::Uniform(0))) => {}
                Some(Ok(piece)) => found.push((piece, place)),
                Some(Err(error)) => {
                    return Err(ChunkError::Failed {
                        id,
                        transient: error.is_transient(),
                        source: Arc::new(error),
                    });
                }
                // Every group has an outcome for each of its keys.
                None => return Err(unfinished(id)),
            }
        }
        if found.is_empty() {
            return Ok(Chunk::Empty);
        }
        let (size, width) = (volume.chunk, volume.dtype.bytes());
        let length = size.as_usizevec3().element_product() * width;
        let bytes = match &*found {
            // It is the chunk: nothing is copied.
            [(Piece::Values(values), place)]
                if values.len() == length && begin == UVec3::ZERO && place.is(voxels, size) =>
            {
                values.clone()
            }
            _ => {
                let mut bytes = vec![0; length];
                let mut chunk = ChunkMut {
                    bytes: &mut bytes,
                    size,
                    width,
                    begin,
                };
                for (piece, place) in &found {
                    match piece {
                        Piece::Uniform(value) => fill(*value, place, voxels, &mut chunk),
                        Piece::Values(values) => copy(values, place, voxels, &mut chunk),
                    }
                }
                bytes.into()
            }
        };
        Ok(match is_zero(&bytes) {
            true => Chunk::Empty,
            false => Chunk::Voxels(bytes),
        })
    }
}

/// The level-0 voxels of stored ones of a level.
fn whole_voxels<F: Stored>(format: &F, level: u32, stored: VoxelBox) -> VoxelBox {
    let (placed, volume) = (format.placed(level), format.volume());
    let level0 = volume.levels[level as usize].voxels_from_box(placed.whole(stored));
    level0.intersection(VoxelBox::of_size(volume.extent()))
}

/// Whether there is no other byte. Looks at many at a time.
fn is_zero(bytes: &[u8]) -> bool {
    let (blocks, rest) = bytes.as_chunks::<64>();
    let any = |bytes: &[u8]| bytes.iter().fold(0, |any, byte| any | byte);
    blocks.iter().all(|block| any(block) == 0) && any(rest) == 0
}

fn unfinished(id: ChunkId) -> ChunkError {
    ChunkError::Failed {
        id,
        transient: true,
        source: Arc::new(PieceError::Damaged {
            reason: "its reading ended without a result".to_owned(),
            which: "a chunk".to_owned(),
            location: String::new(),
        }),
    }
}

impl<F: Stored> VolumeSource for StoredSource<F> {
    fn volume(&self) -> &Arc<Volume> {
        self.format.volume()
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        Box::pin(self.chunk(id))
    }

    fn renamed_label(&self) -> Option<i128> {
        self.format.values().renamed()
    }

    /// Those that are noticed when something is read again.
    fn changes(&self) -> BoxStream<'static, Change> {
        self.watch.stream()
    }

    fn revision(&self) -> u64 {
        self.watch.revision()
    }

    fn notices_by_reading(&self) -> bool {
        true
    }
}

/// Says nothing of how much further levels lie where none does.
pub(crate) fn leave_out_zero_shifts(volume: &mut Volume) {
    if volume.shifts_nm.iter().all(|shift| *shift == DVec3::ZERO) {
        volume.shifts_nm.clear();
    }
}

/// A name for addresses, from that of a folder.
pub(crate) fn volume_name(name: &str) -> String {
    let name = name.trim_end_matches(".zarr").trim_end_matches(".ome");
    let allowed = |c: char| {
        if c.is_ascii_alphanumeric() || "-_.".contains(c) {
            c
        } else {
            '-'
        }
    };
    let name: String = name.chars().map(allowed).take(100).collect();
    match name.trim_start_matches('.') {
        "" => "image".to_owned(),
        name => name.to_owned(),
    }
}
