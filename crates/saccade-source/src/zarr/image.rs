//! The voxels of an image: which chunks of its arrays they are in, and how those are read.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::StreamExt as _;
use futures::stream;
use glam::{DVec3, UVec3};
use saccade_core::levels::Level;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;

use super::array::Array;
use super::error::{Refusal, ZarrError};
use super::looks::looks;
use super::metadata::{Axis, Image};
use super::packing::Packing;
use super::shard::Index;
use crate::codecs::Damage;
use crate::decoding::{self, Decoding, decode};
use crate::flights::Work;
use crate::objects::{Objects, Part};
use crate::stored::{
    ATTEMPTS, Indexed, Indices, Piece, PieceError, PieceId, Pieces, Place, Placed, Replaced,
    Sample, Stored, coalesced, is_replaced, never_the_same, sampled,
};
use crate::values::{Inside, Number, Values};

/// Indices of shards that are kept \[bytes\].
const INDEX_CACHE: u64 = 64 << 20;
/// Ranges of a shard that are read at once.
const RANGES_AT_ONCE: usize = 8;
/// How far off a level may be because its writer meant another point of its voxels \[voxels of the level\].
const MEANT_OTHERWISE: f64 = 0.501;

/// A level: an array whose axes are known.
#[derive(Debug)]
pub(super) struct LevelArray {
    path: String,
    array: Arc<Array>,
    packing: Packing,
    axes: Vec<Axis>,
    grid: Vec<u64>,
    extent: UVec3,
    placed: Placed,
    note: Option<String>,
    channels: u32,
    /// Values between neighbours along each axis of the array, in a decoded chunk.
    strides: Vec<usize>,
}

impl LevelArray {
    pub(super) fn new(path: &str, array: Array, axes: &[Axis]) -> Result<Self, Refusal> {
        if array.shape.len() != axes.len() {
            let (got, named) = (array.shape.len(), axes.len());
            return Err(Refusal::Wrong(format!(
                "it has {got} axes, and {named} have names"
            )));
        }
        let mut extent = UVec3::ONE;
        let mut channels = 1;
        for (axis, &length) in axes.iter().zip(&array.shape) {
            let length = u32::try_from(length);
            let length = length.map_err(|_| Refusal::wrong("an axis is far too long"))?;
            match axis {
                Axis::T => {}
                Axis::C => channels = length,
                Axis::Space(axis) => extent[*axis] = length,
            }
        }
        let mut strides = vec![0; axes.len()];
        let mut stride = 1;
        for &axis in array.encoding.order.iter().rev() {
            strides[axis] = stride;
            stride *= usize::try_from(array.chunk[axis]).map_err(Refusal::wrong)?;
        }
        Ok(Self {
            path: path.to_owned(),
            grid: array.grid(),
            packing: Packing::new(array.encoding.codecs.clone(), array.chunk_bytes()),
            array: Arc::new(array),
            axes: axes.to_vec(),
            extent,
            placed: Placed::new(extent, DVec3::ZERO, 0.0),
            note: None,
            channels,
            strides,
        })
    }

    /// Puts it where its first corner lies, from that of a volume of so many voxels, of which one of its own is so many: the
    /// level that it is then.
    pub(super) fn place(
        &mut self,
        corner: DVec3,
        finest: UVec3,
        downsampling: DVec3,
    ) -> Result<Level, Refusal> {
        self.placed = Placed::new(self.extent, corner, MEANT_OTHERWISE);
        let level = self.placed.level(finest, downsampling).ok_or_else(|| {
            let path = &self.path;
            Refusal::Unsupported(format!(
                "its level {path:?} lies elsewhere than the finest one (translation)"
            ))
        })?;
        self.note = self.placed.note(&format!("{:?}", self.path), level.extent);
        Ok(level)
    }

    /// How much further it lies than its voxels are put \[voxels of the level\].
    pub(super) fn off(&self) -> DVec3 {
        self.placed.off()
    }

    /// What a user should know of where it lies.
    pub(super) fn note(&self) -> Option<String> {
        self.note.clone()
    }

    pub(super) fn extent(&self) -> UVec3 {
        self.extent
    }

    pub(super) fn channels(&self) -> u32 {
        self.channels
    }

    pub(super) fn number(&self) -> Number {
        self.array.number
    }

    /// The shard that a chunk lies in, if there are shards.
    fn shard(&self, chunk: u64) -> Option<Vec<u64>> {
        let sharding = self.array.sharding.as_ref()?;
        let index = unravel(chunk, &self.grid).into_iter();
        let shard = index.zip(&sharding.chunks).map(|(at, count)| at / count);
        Some(shard.collect())
    }

    /// Shards along each axis.
    fn shards(&self) -> Vec<u64> {
        let each = self.array.sharding.as_ref().map(|each| &each.chunks[..]);
        let axes = self.grid.iter().zip(each.unwrap_or_default());
        axes.map(|(chunks, each)| chunks.div_ceil(*each)).collect()
    }

    /// Stored voxels of a shard, of all its channels.
    fn voxels_of_shard(&self, shard: &[u64]) -> VoxelBox {
        let mut voxels = VoxelBox::of_size(self.extent);
        let each = self.array.sharding.as_ref().map(|each| &each.chunks[..]);
        for (n, (axis, each)) in self.axes.iter().zip(each.unwrap_or_default()).enumerate() {
            if let Axis::Space(axis) = *axis {
                let edge = |more: u64| {
                    let edge = (shard[n] + more).saturating_mul(each * self.array.chunk[n]);
                    u32::try_from(edge)
                        .unwrap_or(u32::MAX)
                        .min(self.extent[axis])
                };
                (voxels.min[axis], voxels.max[axis]) = (edge(0), edge(1));
            }
        }
        voxels
    }

    /// Which numbers of a chunk are voxels that are shown, where not all are.
    fn inside(&self, number: u64) -> Option<Inside> {
        let at = unravel(number, &self.grid);
        let length = |n: u64| usize::try_from(n).expect("checked when it was read");
        Inside::new(self.array.encoding.order.iter().map(|&axis| {
            let (chunk, all) = (self.array.chunk[axis], self.array.shape[axis]);
            let inside = match self.axes[axis] {
                Axis::T => 1,
                _ => chunk.min(all - at[axis] * chunk),
            };
            (length(chunk), length(inside))
        }))
    }

    /// Chunks that a box of a channel's stored voxels touches: their numbers, and where they have their voxels.
    fn touched(&self, channel: u32, voxels: VoxelBox) -> Vec<(u64, Place)> {
        let mut index = vec![0; self.axes.len()];
        let mut offset = 0;
        let (mut strides, mut cell, mut spatial) = ([0; 3], [1_u64; 3], [None; 3]);
        for (n, axis) in self.axes.iter().enumerate() {
            let chunk = self.array.chunk[n];
            match axis {
                Axis::T => {}
                Axis::C => {
                    index[n] = u64::from(channel) / chunk;
                    let inside = u64::from(channel) % chunk;
                    offset = usize::try_from(inside).expect("within a chunk") * self.strides[n];
                }
                Axis::Space(axis) => {
                    strides[*axis] = self.strides[n];
                    cell[*axis] = chunk;
                    spatial[*axis] = Some(n);
                }
            }
        }
        let cells = |axis: usize| {
            let (min, max) = (u64::from(voxels.min[axis]), u64::from(voxels.max[axis]));
            min / cell[axis]..max.div_ceil(cell[axis])
        };
        let mut touched = Vec::new();
        for z in cells(2) {
            for y in cells(1) {
                for x in cells(0) {
                    let at = [x, y, z];
                    let edge = |axis: usize, more: u64| {
                        let edge = (at[axis] + more).saturating_mul(cell[axis]);
                        u32::try_from(edge)
                            .unwrap_or(u32::MAX)
                            .min(self.extent[axis])
                    };
                    let corner = |more| UVec3::new(edge(0, more), edge(1, more), edge(2, more));
                    for (axis, n) in spatial.iter().enumerate() {
                        if let Some(n) = n {
                            index[*n] = at[axis];
                        }
                    }
                    let place = Place {
                        voxels: VoxelBox::new(corner(0), corner(1)),
                        strides,
                        offset,
                    };
                    touched.push((ravel(&index, &self.grid), place));
                }
            }
        }
        touched
    }
}

/// The number of an index, last axis fastest.
fn ravel(index: &[u64], counts: &[u64]) -> u64 {
    index
        .iter()
        .zip(counts)
        .fold(0, |number, (at, count)| number * count + at)
}

fn unravel(mut number: u64, counts: &[u64]) -> Vec<u64> {
    let mut index = vec![0; counts.len()];
    for (at, count) in index.iter_mut().zip(counts).rev() {
        *at = number % count;
        number /= count;
    }
    index
}

/// A shard, by level and number within it.
type ShardId = (u32, u64);
type Raw = Result<Option<Bytes>, PieceError>;

/// An open image.
pub(super) struct ZarrImage {
    objects: Arc<dyn Objects>,
    volume: Arc<Volume>,
    levels: Vec<LevelArray>,
    values: Arc<Values>,
    indices: Indices<ShardId, Index>,
}

impl ZarrImage {
    pub(super) async fn new(
        objects: Arc<dyn Objects>,
        volume: Volume,
        levels: Vec<LevelArray>,
        metadata: &Image,
        missing_for: Duration,
    ) -> Result<Self, ZarrError> {
        // Levels have the same type; in foreign files not always the same order of bytes.
        let finest = &levels[0].array;
        let (number, big_endian) = (finest.number, finest.encoding.big_endian);
        if levels
            .iter()
            .any(|level| level.array.encoding.big_endian != big_endian)
            && number.bytes() > 1
        {
            let refusal =
                Refusal::Unsupported("its levels differ in the order of their bytes".to_owned());
            return Err(refusal.at(objects.location("")));
        }
        let index = levels
            .iter()
            .filter_map(|level| level.array.sharding.as_ref());
        let index = index
            .map(super::array::Sharding::index_bytes)
            .max()
            .unwrap_or(1);
        let mut image = Self {
            objects,
            volume: Arc::new(volume),
            levels,
            values: Arc::new(Values::fitted(number, big_endian, None)),
            indices: Indices::new(INDEX_CACHE.max(index * 2), index, missing_for),
        };
        let names = { metadata.is_labels }.then(|| Values::names(number, big_endian));
        let known = { names.flatten() }.or_else(|| Values::kept(number, big_endian));
        image.values = Arc::new(match known {
            Some(known) => known,
            None => {
                let sample = image.sample().await;
                let sample = sample.map_err(|source| ZarrError::Sample { source })?;
                let declared = metadata
                    .channels
                    .iter()
                    .flat_map(|c| [c.window, c.whole])
                    .flatten();
                sample.values(number, big_endian, declared)
            }
        });
        let (count, dtype) = (image.volume.channels.len(), image.volume.dtype);
        let looks = looks(&metadata.channels, count, &image.values, dtype);
        if !metadata.is_labels && !looks.is_empty() {
            image.volume = Arc::new(Volume {
                looks,
                ..(*image.volume).clone()
            });
        }
        Ok(image)
    }

    /// About what a decoded chunk takes \[bytes\].
    pub(super) fn piece_bytes(&self) -> u64 {
        self.levels[0].array.chunk_bytes() as u64
    }

    /// Some values of the coarsest level, of all channels.
    async fn sample(&self) -> Result<Sample, PieceError> {
        let level = self.levels.len() - 1;
        let array = &self.levels[level];
        let mut piece = UVec3::ONE;
        for (axis, chunk) in array.axes.iter().zip(&array.array.chunk) {
            if let Axis::Space(axis) = axis {
                piece[*axis] = u32::try_from(*chunk).unwrap_or(u32::MAX);
            }
        }
        let channels = array.channels.min(16);
        let (boxes, partial) = sampled(array.extent, piece, array.array.chunk_bytes(), channels);
        let touched = (0..channels).flat_map(|channel| {
            let of_box = move |voxels: &VoxelBox| array.touched(channel, *voxels);
            boxes.iter().flat_map(of_box)
        });
        let chosen: Vec<(u64, Place)> = touched.collect();
        let mut sample = Sample::new(partial || level > 0);
        let number = array.number();
        for (piece, place) in chosen {
            let id = PieceId {
                level: u32::try_from(level).unwrap_or(0),
                number: piece,
            };
            let raw = self.raw(id.level, vec![id], None).await;
            for (_, raw) in raw {
                if let Some(bytes) = raw? {
                    sample.add(&bytes, &place, number, array.array.encoding.big_endian);
                }
            }
        }
        Ok(sample)
    }

    /// How messages name a chunk.
    fn which(&self, id: PieceId) -> String {
        let level = &self.levels[id.level as usize];
        let index = unravel(id.number, &level.grid);
        format!("chunk {index:?} of level {}", id.level)
    }

    fn damaged(&self, id: PieceId, key: &str, reason: Damage) -> PieceError {
        PieceError::Damaged {
            reason,
            which: self.which(id),
            location: self.objects.location(key),
        }
    }

    async fn part(&self, id: PieceId, key: &str, part: Part) -> Raw {
        let read = self.objects.read(key, part).await;
        read.map_err(|source| PieceError::Unread {
            source: Arc::new(source),
            which: self.which(id),
        })
    }

    /// Decodes a chunk; what came over a network and does not decode is read once more.
    async fn decoded(
        &self,
        id: PieceId,
        key: &str,
        part: Part,
        mut bytes: Bytes,
        values: Option<&Arc<Values>>,
    ) -> Raw {
        let level = &self.levels[id.level as usize];
        let packing = decoding::Packing::Zarr(level.packing.clone());
        let inside = values.and_then(|_| level.inside(id.number));
        let decoding = Decoding::new(packing, values).within(inside);
        let mut again = self.objects.is_remote();
        loop {
            match decode(decoding.clone(), bytes).await {
                Ok(decoded) => return Ok(Some(decoded)),
                Err(_) if again => again = false,
                Err(damage) => return Err(self.damaged(id, key, damage)),
            }
            match self.part(id, key, part.clone()).await? {
                Some(read) => bytes = read,
                None => return Ok(None),
            }
        }
    }

    /// Chunks as stored numbers, or as values; `None` for one that is not stored. All are of one level, and,
    /// where there are shards, of one.
    async fn raw(
        &self,
        level: u32,
        ids: Vec<PieceId>,
        values: Option<&Arc<Values>>,
    ) -> Vec<(PieceId, Raw)> {
        let array = &self.levels[level as usize];
        let most = array.packing.most();
        if array.array.sharding.is_none() {
            let one = async |id: PieceId| {
                let index = unravel(id.number, &array.grid);
                let key = super::below(&array.path, &array.array.keys.key(&index));
                let whole = Part::Whole { most };
                match self.part(id, &key, whole.clone()).await {
                    Ok(Some(bytes)) => (id, self.decoded(id, &key, whole, bytes, values).await),
                    other => (id, other),
                }
            };
            return stream::iter(ids)
                .map(one)
                .buffer_unordered(RANGES_AT_ONCE)
                .collect()
                .await;
        }
        let Some(&first) = ids.first() else {
            return Vec::new();
        };
        let shard = array.shard(first.number).unwrap_or_default();
        let key = super::below(&array.path, &array.array.keys.key(&shard));
        for _ in 0..ATTEMPTS {
            let Indexed { index, version } = match self.index(level, &shard, first, &key).await {
                Ok(index) => index,
                Err(error) if is_replaced(&error) => continue,
                Err(error) => return ids.into_iter().map(|id| (id, Err(error.clone()))).collect(),
            };
            let Some(index) = index else {
                return ids.into_iter().map(|id| (id, Ok(None))).collect();
            };
            let read = self.indexed(array, &key, &index, ids.clone(), values).await;
            // Else its index was of another shard, whether that was noticed by this read or by one beside it.
            let is_another = |(_, raw): &(_, Raw)| raw.as_ref().is_err_and(is_replaced);
            if self.objects.replacements(&key) == version && !read.iter().any(is_another) {
                return read;
            }
        }
        let error = |id| never_the_same(self.which(id), self.objects.location(&key));
        ids.into_iter().map(|id| (id, Err(error(id)))).collect()
    }

    /// Chunks of a shard, by its index.
    async fn indexed(
        &self,
        array: &LevelArray,
        key: &str,
        index: &Index,
        ids: Vec<PieceId>,
        values: Option<&Arc<Values>>,
    ) -> Vec<(PieceId, Raw)> {
        let most = array.packing.most();
        let Some(sharding) = &array.array.sharding else {
            return Vec::new();
        };
        let (mut done, mut wanted, mut ranges) = (Vec::new(), Vec::new(), Vec::new());
        for id in ids {
            let at = unravel(id.number, &array.grid);
            let inside: Vec<u64> = at
                .iter()
                .zip(&sharding.chunks)
                .map(|(at, count)| at % count)
                .collect();
            match index.chunk(ravel(&inside, &sharding.chunks), most) {
                Ok(Some(range)) => {
                    wanted.push(id);
                    ranges.push(range);
                }
                Ok(None) => done.push((id, Ok(None))),
                Err(damage) => done.push((id, Err(self.damaged(id, key, damage)))),
            }
        }
        let merged = coalesced(&ranges, self.objects.read_cost());
        let (wanted, ranges) = (&wanted, &ranges);
        let read = async |(span, numbers): (std::ops::Range<u64>, Vec<usize>)| {
            let bytes = self
                .part(wanted[numbers[0]], key, Part::Range(span.clone()))
                .await;
            let each = numbers.into_iter().map(|n| {
                let (id, range, bytes) = (wanted[n], ranges[n].clone(), bytes.clone());
                let begin = range.start - span.start;
                async move {
                    let bytes = match bytes {
                        Ok(Some(bytes)) => bytes,
                        // An index, but no shard: it was deleted in between.
                        Ok(None) => return (id, Ok(None)),
                        Err(error) => return (id, Err(error)),
                    };
                    let at = |at: u64| usize::try_from(at).expect("within what was read");
                    let own = bytes.slice(at(begin)..at(begin + (range.end - range.start)));
                    (
                        id,
                        self.decoded(id, key, Part::Range(range), own, values).await,
                    )
                }
            });
            futures::future::join_all(each).await
        };
        let read = stream::iter(merged)
            .map(read)
            .buffer_unordered(RANGES_AT_ONCE);
        done.extend(read.collect::<Vec<_>>().await.into_iter().flatten());
        done
    }

    /// The index of a shard; none if there is no such shard.
    async fn index(
        &self,
        level: u32,
        shard: &[u64],
        of: PieceId,
        key: &str,
    ) -> Result<Indexed<Index>, PieceError> {
        let array = &self.levels[level as usize];
        let Some(sharding) = array.array.sharding.clone() else {
            return Ok(Indexed {
                index: None,
                version: 0,
            });
        };
        let id = (level, ravel(shard, &array.shards()));
        let object = Replaced {
            object: id,
            voxels: array.voxels_of_shard(shard),
        };
        let read = |version| {
            let (objects, sharding) = (self.objects.clone(), sharding.clone());
            let (which, key) = (self.which(of), key.to_owned());
            let work: Work<ShardId, Indexed<Index>, PieceError> = Box::pin(async move {
                let length = sharding.index_bytes();
                let part = match sharding.index_at_start {
                    true => Part::Range(0..length),
                    false => Part::Last(length),
                };
                let mut again = objects.is_remote();
                let index = loop {
                    let bytes = match objects.read(&key, part.clone()).await {
                        Ok(Some(bytes)) => bytes,
                        Ok(None) => break Ok(None),
                        Err(source) => {
                            let source = Arc::new(source);
                            break Err(PieceError::Unread { source, which });
                        }
                    };
                    match Index::read(bytes, &sharding) {
                        Ok(index) => break Ok(Some(index)),
                        Err(_) if again => again = false,
                        Err(reason) => {
                            let location = objects.location(&key);
                            break Err(PieceError::Damaged {
                                reason,
                                which,
                                location,
                            });
                        }
                    }
                };
                vec![(id, index.map(|index| Indexed { index, version }))]
            });
            work
        };
        let objects = &*self.objects;
        self.indices.get(id, objects, key, object, read).await
    }
}

impl Stored for ZarrImage {
    fn object(&self, id: PieceId) -> u64 {
        let array = &self.levels[id.level as usize];
        match array.shard(id.number) {
            Some(shard) => ravel(&shard, &array.shards()),
            None => id.number,
        }
    }

    fn take_replaced(&self) -> Vec<Replaced> {
        self.indices.take_replaced()
    }

    fn volume(&self) -> &Arc<Volume> {
        &self.volume
    }

    fn values(&self) -> &Values {
        &self.values
    }

    fn placed(&self, level: u32) -> Placed {
        self.levels[level as usize].placed
    }

    fn touched(&self, channel: u32, level: u32, voxels: VoxelBox) -> Vec<(PieceId, Place)> {
        let touched = self.levels[level as usize].touched(channel, voxels);
        let touched = touched.into_iter();
        touched
            .map(|(number, place)| (PieceId { level, number }, place))
            .collect()
    }

    fn read(self: &Arc<Self>, pieces: Vec<PieceId>) -> Vec<(Vec<PieceId>, Pieces)> {
        // Chunks of a shard together, others alone.
        let mut groups: BTreeMap<(u32, Vec<u64>), Vec<PieceId>> = BTreeMap::new();
        for id in pieces {
            let level = &self.levels[id.level as usize];
            let alone = || unravel(id.number, &level.grid);
            let group = level.shard(id.number).unwrap_or_else(alone);
            groups.entry((id.level, group)).or_default().push(id);
        }
        let groups = groups.into_iter().map(|((level, _), ids)| {
            let (this, wanted) = (self.clone(), ids.clone());
            let work: Pieces = Box::pin(async move {
                let fill = &this.levels[level as usize].array.fill;
                let missing = || Piece::Uniform(this.values.of_missing(fill));
                let read = this.raw(level, wanted, Some(&this.values)).await;
                let piece = |raw: Option<Bytes>| raw.map_or_else(missing, Piece::Values);
                read.into_iter()
                    .map(|(id, raw)| (id, raw.map(piece)))
                    .collect()
            });
            (ids, work)
        });
        groups.collect()
    }
}
