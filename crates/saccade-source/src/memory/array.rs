use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

use glam::UVec3;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;

use super::average::{coarser, level0_voxels};
use super::{build_chunk, only_bytes};
use crate::changes::Changes;
use crate::maybe_send::{BoxFuture, BoxStream};
use crate::{Change, ChangeReason, Chunk, ChunkError, ChunkId, ValueRange, VolumeSource};

/// Changes that are remembered.
const KEPT: usize = 4096;

/// A small 8-bit volume held whole, all its levels too. Voxels can be set while it is watched.
///
/// Coarser levels are means of the level-0 voxels that are not 0; of labels, the most frequent, of several the
/// smallest.
pub struct ArraySource {
    volume: Arc<Volume>,
    held: RwLock<Held>,
    changes: Arc<Changes>,
    /// The newest changes.
    log: Mutex<VecDeque<Change>>,
}

struct Held {
    /// Per level `[c, z, y, x]`.
    levels: Vec<Vec<u8>>,
    /// Of all chunks that have a measured value. Kept, since who draws asks for many at once.
    ranges: HashMap<ChunkId, ValueRange>,
}

/// An array whose size is not that of the volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{got} values given for {expected} voxels")]
pub struct WrongLength {
    /// Values the place needs.
    pub expected: u64,
    /// Values given.
    pub got: usize,
}

impl WrongLength {
    fn check(expected: u64, got: usize) -> Result<(), Self> {
        if expected == got as u64 {
            Ok(())
        } else {
            Err(Self { expected, got })
        }
    }
}

impl ArraySource {
    /// From the level-0 voxels of all channels `[c, z, y, x]`.
    ///
    /// # Errors
    ///
    /// [`WrongLength`] where there are not as many values as voxels.
    ///
    /// # Panics
    ///
    /// On a volume that is not 8 bit.
    pub fn new(volume: Volume, level0: Vec<u8>) -> Result<Self, WrongLength> {
        let volume = only_bytes(volume);
        let whole = VoxelBox::of_size(volume.extent());
        let channels = volume.channels.len();
        WrongLength::check(whole.voxels() * channels as u64, level0.len())?;
        let coarser = volume.levels[1..].iter().map(|level| {
            let size = level.extent.as_usizevec3();
            vec![0; size.x * size.y * size.z * channels]
        });
        let levels = std::iter::once(level0).chain(coarser).collect();
        let source = Self {
            changes: Changes::new(whole, 0),
            log: Mutex::default(),
            held: RwLock::new(Held {
                levels,
                ranges: HashMap::new(),
            }),
            volume,
        };
        source.average(whole);
        Ok(source)
    }

    /// Sets level-0 voxels of channel 0, x fastest, brings the levels up to date and tells
    /// listeners. Returns the revision.
    ///
    /// # Errors
    ///
    /// [`WrongLength`] where `values` does not fill the box, or the box leaves the volume.
    pub fn set(&self, voxels: VoxelBox, values: &[u8]) -> Result<u64, WrongLength> {
        let inside = voxels.intersection(VoxelBox::of_size(self.volume.extent()));
        WrongLength::check(inside.voxels(), values.len())?;
        if !voxels.is_empty() && inside != voxels {
            return Err(WrongLength {
                expected: inside.voxels(),
                got: values.len(),
            });
        }
        {
            let levels = &mut self.write().levels;
            for (voxel, value) in voxels.iter().zip(values) {
                let at = index(self.volume.extent(), 0, voxel);
                levels[0][at] = *value;
            }
        }
        self.average(voxels);
        let reason = ChangeReason::Tile;
        // Held until it is in there: who has heard of a change finds it.
        let mut log = self.log();
        let revision = self.changes.send_next(voxels, reason);
        log.push_back(Change {
            revision,
            voxels,
            reason,
        });
        if log.len() > KEPT {
            log.pop_front();
        }
        Ok(revision)
    }

    fn log(&self) -> MutexGuard<'_, VecDeque<Change>> {
        self.log.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Brings the coarser levels and the ranges up to date with voxels of the finest.
    fn average(&self, level0: VoxelBox) {
        let extent = self.volume.extent();
        let mut held = self.write();
        let (finest, others) = (held.levels.split_first_mut()).expect("a volume has a level");
        for (level, values) in self.volume.levels[1..].iter().zip(others) {
            for channel in 0..self.volume.channels.len() {
                for voxel in level.box_from_voxels(level0).iter() {
                    let covered = level0_voxels(voxel, level.downsampling, extent);
                    let covered = covered.iter().map(|v| finest[index(extent, channel, v)]);
                    values[index(level.extent, channel, voxel)] =
                        coarser(self.volume.kind, covered);
                }
            }
        }
        let Held { levels, ranges } = &mut *held;
        let channels = (0..).zip(&self.volume.channels);
        for (channel, _) in channels {
            for ((number, level), values) in (0..).zip(&self.volume.levels).zip(&*levels) {
                let voxels = level.box_from_voxels(level0);
                let (first, end) = (voxels.min, voxels.max + (self.volume.chunk - 1));
                let chunks = VoxelBox::new(first / self.volume.chunk, end / self.volume.chunk);
                for chunk in chunks.iter() {
                    let id = ChunkId {
                        channel,
                        level: number,
                        chunk,
                    };
                    match self.range_of(id, values) {
                        Some(range) => ranges.insert(id, range),
                        None => ranges.remove(&id),
                    };
                }
            }
        }
    }

    /// Bounds of the measured values of a chunk, among all of its level.
    fn range_of(&self, id: ChunkId, values: &[u8]) -> Option<ValueRange> {
        let VoxelBox { min, max } = id.voxels(&self.volume)?;
        let extent = self.volume.levels[id.level as usize].extent;
        let rows = (min.z..max.z).flat_map(|z| (min.y..max.y).map(move |y| (y, z)));
        let (mut least, mut most) = (u8::MAX, 0);
        for (y, z) in rows {
            let first = index(extent, id.channel as usize, UVec3::new(min.x, y, z));
            for &value in &values[first..first + (max.x - min.x) as usize] {
                // Nothing, which is 0, is the largest once one is taken away.
                least = least.min(value.wrapping_sub(1));
                most = most.max(value);
            }
        }
        (most > 0).then(|| ValueRange {
            min: u16::from(least) + 1,
            max: u16::from(most),
        })
    }

    fn held(&self) -> RwLockReadGuard<'_, Held> {
        self.held.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, Held> {
        self.held.write().unwrap_or_else(PoisonError::into_inner)
    }

    fn chunk(&self, id: ChunkId) -> Result<Chunk, ChunkError> {
        let levels = &self.held().levels;
        build_chunk(&self.volume, id, |start, row| {
            let extent = self.volume.levels[id.level as usize].extent;
            let at = index(extent, id.channel as usize, start);
            row.copy_from_slice(&levels[id.level as usize][at..at + row.len()]);
        })
    }
}

/// Where a voxel is in an array `[c, z, y, x]`.
fn index(extent: UVec3, channel: usize, voxel: UVec3) -> usize {
    let (extent, voxel) = (extent.as_usizevec3(), voxel.as_usizevec3());
    ((channel * extent.z + voxel.z) * extent.y + voxel.y) * extent.x + voxel.x
}

impl VolumeSource for ArraySource {
    fn volume(&self) -> &Arc<Volume> {
        &self.volume
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        Box::pin(async move { self.chunk(id) })
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        self.changes.stream()
    }

    fn revision(&self) -> u64 {
        self.changes.revision()
    }

    fn changes_after(&self, revision: u64) -> BoxFuture<'_, Option<Vec<Change>>> {
        let log = self.log();
        let now = self.changes.revision();
        // Every revision is one change.
        let known = now - log.len() as u64..=now;
        let after = { log.iter() }.filter(|change| change.revision > revision);
        let after = known.contains(&revision).then(|| after.copied().collect());
        Box::pin(std::future::ready(after))
    }

    fn value_range(&self, id: ChunkId) -> Option<ValueRange> {
        self.held().ranges.get(&id).copied()
    }
}
