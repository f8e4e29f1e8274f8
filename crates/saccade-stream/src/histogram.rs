//! What values a volume has, from a few of its chunks.

use std::collections::{BTreeSet, HashSet};

use futures::StreamExt;
use saccade_core::levels::Level;
use saccade_core::transfer::Histogram;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_source::maybe_send::sleep;
use saccade_source::{Chunk, ChunkError, ChunkId, VolumeSource};

use crate::policy::Retry;

/// Chunks read of the coarsest level, to find where data are.
const COARSE_CHUNKS: usize = 8;
/// Where all of these are empty, so many times as many, and again.
const MORE_CHUNKS: usize = 8;
/// Chunks read of the coarsest level at most.
const MOST_CHUNKS: usize = 512;
/// Finer levels are searched where they have so many chunks at most.
const SEARCHED_CHUNKS: u64 = 4096;
/// Chunks counted.
const COUNTED_CHUNKS: usize = 12;
/// The counted level has at most so many voxels along an axis: about what a first look shows.
/// Coarser ones are so blurred that thin structures are gone.
const COUNTED_EXTENT: u32 = 512;
/// Reads at once.
const CONCURRENT: usize = 4;

/// Values counted in a part of a volume.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sample {
    /// Counts of the values of the channel.
    pub histogram: Histogram,
    /// Whether a chunk that should be in it could not be read yet, but may be later.
    pub partial: bool,
}

/// Counts a channel's values where the coarsest level has data, in a few chunks of a level of medium
/// resolution. Depends on nothing but the voxels: the same volume gives the same sample.
///
/// Reads that fail for a passing reason are repeated a few times, as `retry` says.
pub async fn sample(source: &dyn VolumeSource, channel: u32, retry: Retry) -> Sample {
    let volume = source.volume();
    let mut result = Sample {
        histogram: Histogram::new(volume.dtype),
        partial: false,
    };
    let Some((coarsest, counted)) = levels(volume) else {
        return result;
    };
    let mut places = BTreeSet::new();
    // One damaged tile spoils every coarse chunk it is in: where data are, finer ones tell as well.
    for level in (counted..=coarsest).rev() {
        let chunks = VoxelBox::of_size(volume.chunks(level as usize));
        if level < coarsest && chunks.voxels() > SEARCHED_CHUNKS {
            break;
        }
        let all: BTreeSet<Ordered> = chunks.iter().map(|chunk| ordered(level, chunk)).collect();
        let mut looked_at = HashSet::new();
        let (mut most, mut failed) = (COARSE_CHUNKS, 0);
        while places.is_empty() && failed == 0 && most <= MOST_CHUNKS {
            let chosen = spread(channel, &all, most).into_iter();
            let chosen = chosen.filter(|id| looked_at.insert(*id)).collect();
            let read = read(source, retry, chosen, &mut result.partial).await;
            failed = read.1;
            for (id, chunk) in read.0 {
                places.extend(places_with_data(volume, id, &chunk, counted));
            }
            most *= MORE_CHUNKS;
        }
        if !places.is_empty() || failed == 0 {
            break;
        }
    }
    let chosen = spread(channel, &places, COUNTED_CHUNKS);
    let (read, _) = read(source, retry, chosen, &mut result.partial).await;
    for (id, chunk) in read {
        count(volume, id, &chunk, &mut result.histogram);
    }
    result
}

/// The coarsest level, and the one to count: the finest of moderate size.
fn levels(volume: &Volume) -> Option<(u32, u32)> {
    let coarsest = volume.levels.len().checked_sub(1)?;
    let moderate = |level: &Level| level.extent.max_element() <= COUNTED_EXTENT;
    let counted = volume.levels.iter().position(moderate).unwrap_or(coarsest);
    Some((u32::try_from(coarsest).ok()?, u32::try_from(counted).ok()?))
}

/// Chunks by level, z, y, x.
type Ordered = (u32, [u32; 3]);

fn ordered(level: u32, chunk: glam::UVec3) -> Ordered {
    (level, [chunk.z, chunk.y, chunk.x])
}

/// At most `count` of them, at even distances.
fn spread(channel: u32, chunks: &BTreeSet<Ordered>, count: usize) -> Vec<ChunkId> {
    let step = chunks.len().div_ceil(count).max(1);
    let chosen = chunks.iter().skip(step / 2).step_by(step);
    let id = |&(level, [z, y, x]): &Ordered| ChunkId {
        channel,
        level,
        chunk: [x, y, z].into(),
    };
    chosen.map(id).collect()
}

/// Times a chunk is asked for before it is left out.
const ATTEMPTS: u32 = 6;

async fn read_patiently(
    source: &dyn VolumeSource,
    retry: Retry,
    id: ChunkId,
) -> Result<Chunk, ChunkError> {
    let mut attempt = 1;
    loop {
        match source.read(id).await {
            Err(error) if error.is_transient() && attempt < ATTEMPTS => {
                sleep(retry.delay(attempt, error.retry_after())).await;
                attempt += 1;
            }
            answer => return answer,
        }
    }
}

/// The chunks that hold something, and how many could not be read.
async fn read(
    source: &dyn VolumeSource,
    retry: Retry,
    ids: Vec<ChunkId>,
    partial: &mut bool,
) -> (Vec<(ChunkId, Vec<u8>)>, usize) {
    let read = |id| async move { (id, read_patiently(source, retry, id).await) };
    let reads: Vec<_> = ids.into_iter().map(read).collect();
    let answers: Vec<_> = futures::stream::iter(reads)
        .buffered(CONCURRENT)
        .collect()
        .await;
    let (mut chunks, mut failed) = (Vec::new(), 0);
    for (id, answer) in answers {
        match answer {
            Ok(Chunk::Voxels(voxels)) => chunks.push((id, voxels.to_vec())),
            Ok(Chunk::Empty) => {}
            Err(error) => {
                *partial |= error.is_transient();
                failed += 1;
            }
        }
    }
    (chunks, failed)
}

/// Rows of the chunk's voxels inside of the volume, with the first voxel of each \[bytes\].
fn rows<'c>(
    volume: &'c Volume,
    id: ChunkId,
    chunk: &'c [u8],
) -> impl Iterator<Item = (glam::UVec3, &'c [u8])> {
    let inside = id.voxels(volume).unwrap_or(VoxelBox::EMPTY);
    let [width, height, _] = volume.chunk.to_array().map(|edge| edge as usize);
    let size = inside.size();
    let bytes = volume.dtype.bytes();
    let starts = (0..size.z).flat_map(move |z| (0..size.y).map(move |y| (y, z)));
    starts.filter_map(move |(y, z)| {
        let from = (z as usize * height + y as usize) * width * bytes;
        let row = chunk.get(from..from + size.x as usize * bytes)?;
        Some((inside.min + glam::UVec3::new(0, y, z), row))
    })
}

/// The chunks of `level` in the middle of each voxel of the chunk that has data.
fn places_with_data(volume: &Volume, id: ChunkId, chunk: &[u8], level: u32) -> BTreeSet<Ordered> {
    let (coarse, fine) = (
        &volume.levels[id.level as usize],
        &volume.levels[level as usize],
    );
    let mut places = BTreeSet::new();
    for (start, row) in rows(volume, id, chunk) {
        let voxels = row.chunks(volume.dtype.bytes());
        let measured = (start.x..)
            .zip(voxels)
            .filter(|(_, voxel)| **voxel != [0, 0][..voxel.len()]);
        for (x, _) in measured {
            let at = glam::UVec3::new(x, start.y, start.z);
            let level0 = coarse.voxels_from_box(VoxelBox::new(at, at + 1));
            let voxels = fine.box_from_voxels(level0);
            if !voxels.is_empty() {
                let middle = voxels.min + voxels.size() / 2;
                places.insert(ordered(level, middle / volume.chunk));
            }
        }
    }
    places
}

fn count(volume: &Volume, id: ChunkId, chunk: &[u8], histogram: &mut Histogram) {
    for (_, row) in rows(volume, id, chunk) {
        histogram.add(row);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};
    use std::time::Duration;

    use glam::{DVec3, UVec3};
    use saccade_source::Change;
    use saccade_source::maybe_send::{BoxFuture, BoxStream};
    use saccade_source::memory::ArraySource;

    use super::*;

    fn source(extent: UVec3, value: impl Fn(UVec3) -> u8) -> ArraySource {
        let volume = Volume::new("v", extent, DVec3::ONE).unwrap();
        let volume = Volume {
            chunk: UVec3::new(32, 32, 16),
            ..volume
        };
        let voxels = VoxelBox::of_size(extent).iter().map(value).collect();
        ArraySource::new(volume, voxels).unwrap()
    }

    fn take(source: &dyn VolumeSource) -> Sample {
        let retry = Retry {
            first: Duration::from_millis(1),
            longest: Duration::from_millis(2),
        };
        // Repetitions wait for a timer.
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_time()
            .build();
        runtime.unwrap().block_on(sample(source, 0, retry))
    }

    #[test]
    fn a_small_volume_is_counted_where_its_data_are() {
        let source = source(UVec3::new(70, 50, 33), |at| if at.x < 20 { 90 } else { 0 });
        let Sample { histogram, partial } = take(&source);
        assert!(!partial);
        assert!(histogram.total() > 1000);
        assert_eq!(
            histogram.total(),
            histogram.counts()[90],
            "padding and nothing do not count"
        );
    }

    #[test]
    fn one_tile_in_a_large_volume_is_found() {
        let corner = UVec3::new(1100, 60, 2);
        let inside = move |at: UVec3| at.cmpge(corner).all() && at.x < 1130;
        let source = source(
            UVec3::new(1500, 90, 5),
            move |at| if inside(at) { 200 } else { 0 },
        );
        let histogram = take(&source).histogram;
        assert!(histogram.counts()[200] > 0);
    }

    #[test]
    fn nothing_acquired_gives_an_empty_histogram() {
        assert_eq!(take(&source(UVec3::splat(40), |_| 0)).histogram.total(), 0);
    }

    /// The coarsest level is large where there is but one.
    #[test]
    fn data_that_the_first_chunks_miss_are_found() {
        let extent = UVec3::splat(192);
        let block = |at: UVec3| {
            u8::from(at.cmpge(UVec3::splat(100)).all() && at.cmplt(UVec3::splat(120)).all())
        };
        let levels = source(UVec3::splat(8), |_| 0).volume().levels[..1].to_vec();
        let volume = Volume {
            chunk: UVec3::new(32, 32, 16),
            levels: vec![Level {
                extent,
                ..levels[0]
            }],
            ..Volume::new("v", extent, DVec3::ONE).unwrap()
        };
        let voxels = VoxelBox::of_size(extent)
            .iter()
            .map(|at| 90 * block(at))
            .collect();
        let source = ArraySource::new(volume, voxels).unwrap();
        assert_eq!(take(&source).histogram.counts()[90], 8000);
    }

    #[test]
    fn the_same_voxels_give_the_same_sample() {
        let value = |at: UVec3| u8::try_from((at.x * 13 + at.y * 7 + at.z) % 256).unwrap();
        let grown = source(UVec3::new(90, 80, 70), |_| 0);
        let whole = VoxelBox::of_size(UVec3::new(90, 80, 70));
        take(&grown);
        grown
            .set(whole, &whole.iter().map(value).collect::<Vec<_>>())
            .unwrap();
        let fresh = source(UVec3::new(90, 80, 70), value);
        assert_eq!(take(&grown), take(&fresh));
        assert!(take(&fresh).histogram.total() > 0);
    }

    /// Is not ready for the first reads of the counted level.
    struct Flaky {
        inner: ArraySource,
        refusals: AtomicU32,
    }

    impl VolumeSource for Flaky {
        fn volume(&self) -> &Arc<Volume> {
            self.inner.volume()
        }

        fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
            let one_less = |n: u32| n.checked_sub(1);
            let refusals = &self.refusals;
            let refuses = || refusals.fetch_update(Ordering::Relaxed, Ordering::Relaxed, one_less);
            if id.level == 0 && refuses().is_ok() {
                let retry_after = Duration::ZERO;
                return Box::pin(async move { Err(ChunkError::NotReady { id, retry_after }) });
            }
            self.inner.read(id)
        }

        fn changes(&self) -> BoxStream<'static, Change> {
            self.inner.changes()
        }
    }

    /// Has lost a tile: the chunks of the coarsest level fail for good, and one of each other.
    struct Damaged(ArraySource);

    impl VolumeSource for Damaged {
        fn volume(&self) -> &Arc<Volume> {
            self.0.volume()
        }

        fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
            let coarsest = id.level as usize + 1 == self.volume().levels.len();
            if coarsest || id.chunk == UVec3::ZERO {
                let source = Arc::new(std::io::Error::other("damaged"));
                return Box::pin(async move {
                    Err(ChunkError::Failed {
                        id,
                        transient: false,
                        source,
                    })
                });
            }
            self.0.read(id)
        }

        fn changes(&self) -> BoxStream<'static, Change> {
            self.0.changes()
        }
    }

    #[test]
    fn what_is_damaged_does_not_hide_the_rest() {
        let inner = source(
            UVec3::new(1300, 90, 40),
            |at| if at.x > 600 { 77 } else { 0 },
        );
        assert!(inner.volume().levels.len() > 2);
        let Sample { histogram, partial } = take(&Damaged(inner));
        assert!(!partial, "asking again would not help");
        assert!(histogram.total() > 0);
        assert!(histogram.counts()[77] > histogram.total() / 2);
    }

    #[test]
    fn a_source_that_hesitates_is_asked_again() {
        let inner = || source(UVec3::splat(70), |_| 9);
        let whole = take(&inner());
        let flaky = |refusals| {
            take(&Flaky {
                inner: inner(),
                refusals: AtomicU32::new(refusals),
            })
        };
        assert_eq!(flaky(5), whole);
        assert!(flaky(u32::MAX).partial, "what could not be read is told");
    }
}
