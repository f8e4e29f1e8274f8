use futures::FutureExt;
use futures::future::{join_all, try_join_all};
use glam::UVec3;
use saccade_core::brick::{MAX_CHANNELS, MAX_LEVELS};
use saccade_core::volume::{MAX_EXTENT, Volume};
use saccade_core::voxel_box::VoxelBox;

use super::{Oracle, Violation, compare, ensure, read_bytes, violation};
use crate::{Chunk, ChunkError, ChunkId, ValueRange, VolumeSource};

/// Chunks of a level and channel that are looked at; larger levels are sampled.
const CHUNKS_PER_LEVEL: u64 = 96;
const NOTHING: &str = "say that nothing was acquired only where nothing was";

/// The description of a volume makes sense. Sources that get theirs from outside check it so.
///
/// # Errors
///
/// The first [`Violation`].
pub fn check_volume(volume: &Volume) -> Result<(), Violation> {
    const RULE: &str = "describe a volume that can be";
    ensure(!volume.name.is_empty(), RULE, || "it has no name".into())?;
    let channels = volume.channels.len();
    ensure((1..=MAX_CHANNELS).contains(&channels), RULE, || {
        format!("it has {channels} channels")
    })?;
    let levels = volume.levels.len();
    ensure((1..=MAX_LEVELS).contains(&levels), RULE, || {
        format!("it has {levels} levels")
    })?;
    ensure(volume.chunk.min_element() > 0, RULE, || {
        format!("its chunks are of {} voxels", volume.chunk)
    })?;
    let nm = volume.voxel_nm;
    ensure(nm.is_finite() && nm.min_element() > 0.0, RULE, || {
        format!("its voxels are of {nm} nm")
    })?;
    let finest = volume.levels[0];
    ensure(finest.extent.max_element() <= MAX_EXTENT, RULE, || {
        format!(
            "it has {} voxels, more than {MAX_EXTENT} along an axis",
            finest.extent
        )
    })?;
    ensure(finest.downsampling == glam::DVec3::ONE, RULE, || {
        format!("level 0 is downsampled by {}", finest.downsampling)
    })?;
    for (n, level) in volume.levels.iter().enumerate() {
        let covers = level.extent.as_dvec3() * level.downsampling;
        let off = (covers - finest.extent.as_dvec3()).abs();
        let fits = level.extent.min_element() > 0 && off.cmplt(level.downsampling).all();
        ensure(fits, RULE, || {
            let (extent, by) = (level.extent, level.downsampling);
            format!(
                "level {n} of {extent}, downsampled by {by}, is not {}",
                finest.extent
            )
        })?;
    }
    for (n, pair) in volume.levels.windows(2).enumerate() {
        let (fine, coarse) = (pair[0].downsampling, pair[1].downsampling);
        let coarser = coarse.cmpge(fine).all() && coarse != fine;
        ensure(coarser, RULE, || {
            format!("level {} is not coarser than level {n}", n + 1)
        })?;
    }
    Ok(())
}

/// Every chunk (of large levels a sample) holds what `oracle` says, within `tolerance`; reading in
/// any order, at once, or after giving up makes no difference.
///
/// # Errors
///
/// The first [`Violation`].
pub async fn check_reading(
    source: &dyn VolumeSource,
    oracle: impl Oracle,
    tolerance: u8,
) -> Result<(), Violation> {
    let volume = source.volume().clone();
    check_volume(&volume)?;
    check_out_of_range(source).await?;
    let ids: Vec<_> = some_chunks(&volume).collect();

    // Given up at once: later reads must not notice.
    for id in ids.iter().step_by(7) {
        drop(source.read(*id).now_or_never());
        drop(source.read(*id));
    }

    let mut serial = Vec::new();
    for id in &ids {
        let got = read_bytes(source, *id).await?;
        check_padding(&volume, *id, &got)?;
        compare(source, *id, &got, &oracle(*id), tolerance)?;
        check_range(source, *id, &got, source.value_range(*id))?;
        match source.find_value_range(*id).await {
            Ok(None) => ensure(got.iter().all(|v| *v == 0), NOTHING, || id.to_string())?,
            Ok(found) => check_range(source, *id, &got, found)?,
            Err(error) => return Err(violation("find bounds of what it can read", error)),
        }
        serial.push(got);
    }

    // At once, each twice, half of them given up, backwards.
    let twice = || ids.iter().rev().flat_map(|id| [*id, *id]);
    let given_up = twice().step_by(2).map(|id| source.read(id).now_or_never());
    let read = twice().map(|id| read_bytes(source, id));
    drop(given_up.collect::<Vec<_>>());
    let together = try_join_all(read).await?;
    let serial = serial.iter().rev().flat_map(|bytes| [bytes, bytes]);
    for ((id, one), other) in twice().zip(&together).zip(serial) {
        ensure(
            one == other,
            "answer the same at once as one by one",
            || format!("{id} differs"),
        )?;
    }
    Ok(())
}

/// Chunks that do not exist are refused, and nothing else is harmed by asking.
async fn check_out_of_range(source: &dyn VolumeSource) -> Result<(), Violation> {
    let volume = source.volume();
    let end = volume.chunks(0);
    let id = |channel, level, x, y, z| ChunkId {
        channel,
        level,
        chunk: UVec3::new(x, y, z),
    };
    let channels = u32::try_from(volume.channels.len()).unwrap_or(u32::MAX);
    let levels = u32::try_from(volume.levels.len()).unwrap_or(u32::MAX);
    let outside = [
        id(channels, 0, 0, 0, 0),
        id(0, levels, 0, 0, 0),
        id(0, 0, end.x, 0, 0),
        id(0, 0, 0, end.y, 0),
        id(0, 0, 0, 0, end.z),
        id(u32::MAX, u32::MAX, u32::MAX, u32::MAX, u32::MAX),
        id(0, 0, u32::MAX, 0, 0),
    ];
    let answers = join_all(outside.map(|id| source.read(id))).await;
    for (outside, answer) in outside.iter().zip(answers) {
        match answer {
            Err(ChunkError::OutOfRange { id }) if id == *outside => {}
            other => {
                let detail = format!("{outside} gave {}", describe(&other));
                return Err(violation("refuse chunks that do not exist", detail));
            }
        }
        ensure(
            source.value_range(*outside).is_none(),
            "know no values of chunks that do not exist",
            || outside.to_string(),
        )?;
        let found = source.find_value_range(*outside).await;
        let refused = matches!(found, Err(ChunkError::OutOfRange { .. }));
        ensure(
            refused,
            "find no values of chunks that do not exist",
            || outside.to_string(),
        )?;
    }
    Ok(())
}

fn describe(answer: &Result<Chunk, ChunkError>) -> String {
    match answer {
        Ok(Chunk::Empty) => "an empty chunk".into(),
        Ok(Chunk::Voxels(_)) => "voxels".into(),
        Err(error) => error.to_string(),
    }
}

fn check_padding(volume: &Volume, id: ChunkId, got: &[u8]) -> Result<(), Violation> {
    let Some(voxels) = id.voxels(volume) else {
        return Err(violation("be asked for chunks that exist", id));
    };
    let inside = VoxelBox::of_size(voxels.size());
    let all = VoxelBox::of_size(volume.chunk).iter();
    for (voxel, value) in all.zip(got.chunks(volume.dtype.bytes())) {
        let padding = !inside.contains(voxel);
        ensure(
            !padding || value.iter().all(|v| *v == 0),
            "pad with 0 past the volume's end",
            || format!("{id} holds {value:?} at {voxel}"),
        )?;
    }
    Ok(())
}

fn check_range(
    source: &dyn VolumeSource,
    id: ChunkId,
    got: &[u8],
    range: Option<ValueRange>,
) -> Result<(), Violation> {
    let Some(range) = range else {
        return Ok(());
    };
    let value = |bytes: &[u8]| bytes.iter().rev().fold(0, |v, b| v << 8 | u16::from(*b));
    let values = got.chunks(source.volume().dtype.bytes()).map(value);
    let outside = values
        .filter(|v| *v != 0)
        .find(|v| !(range.min..=range.max).contains(v));
    ensure(outside.is_none(), "give bounds that hold", || {
        format!("{id} holds {outside:?}, bounds {range:?}")
    })
}

/// All chunks of a volume, of large levels an even sample with both ends.
pub(super) fn some_chunks(volume: &Volume) -> impl Iterator<Item = ChunkId> + '_ {
    let of_level = move |channel, level: u32| {
        let chunks = volume.chunks(level as usize);
        let count = VoxelBox::of_size(chunks).voxels();
        let taken = count.min(CHUNKS_PER_LEVEL);
        (0..taken).map(move |n| {
            // Evenly from 0 to count - 1; u128 cannot overflow here.
            let at = u128::from(n) * u128::from(count - 1) / u128::from(taken.max(2) - 1);
            let at = u64::try_from(at).expect("below the count");
            let (x, y) = (u64::from(chunks.x), u64::from(chunks.y));
            let part = |v: u64| u32::try_from(v).expect("below the chunks of an axis");
            let chunk = UVec3::new(part(at % x), part(at / x % y), part(at / x / y));
            ChunkId {
                channel,
                level,
                chunk,
            }
        })
    };
    let channels = (0..).zip(&volume.channels).map(|(channel, _)| channel);
    channels.flat_map(move |channel| {
        let levels = (0..).zip(&volume.levels).map(|(level, _)| level);
        levels.flat_map(move |level| of_level(channel, level))
    })
}
