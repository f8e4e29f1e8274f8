//! The voxels of a volume: which of its chunks they are in, and how those are read.

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use bytes::Bytes;
use futures::StreamExt as _;
use futures::stream;
use glam::UVec3;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;

use super::decode::{Packing, Shape};
use super::info::{Info, Scale, Sharding};
use super::shard::{Index, Minishard, compressed_morton, index_range};
use crate::codecs::Damage;
use crate::decoding::{self, Decoding, decode};
use crate::flights::Work;
use crate::objects::{Objects, Part};
use crate::stored::{
    ATTEMPTS, Indexed, Indices, Piece, PieceError, PieceId, Pieces, Place, Placed, Replaced,
    Sample, Stored, coalesced, is_replaced, never_the_same, sampled,
};
use crate::values::Values;

/// Indices of minishards that are kept \[bytes\].
const INDEX_CACHE: u64 = 64 << 20;
/// Objects, or ranges of one, that are read at once.
const AT_ONCE: usize = 8;

type Raw = Result<Option<Bytes>, PieceError>;
type IndexId = (u32, Minishard);

/// An open volume.
pub(super) struct PrecomputedImage {
    objects: Arc<dyn Objects>,
    volume: Arc<Volume>,
    info: Info,
    values: Arc<Values>,
    indices: Indices<IndexId, Index>,
    /// How the first chunk was called that there was.
    names: OnceLock<Name>,
}

/// How the object of a chunk is called.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Name {
    /// As the format says.
    Plain,
    /// `NAME.gz`: as copies of stores that compress in transport have it, and servers that decompress do not.
    Zipped,
}

impl PrecomputedImage {
    pub(super) async fn new(
        objects: Arc<dyn Objects>,
        volume: Volume,
        info: Info,
        missing_for: Duration,
    ) -> Result<Self, PieceError> {
        let number = info.number;
        let mut image = Self {
            objects,
            volume: Arc::new(volume),
            info,
            values: Arc::new(Values::fitted(number, false, None)),
            indices: Indices::new(INDEX_CACHE, 4096, missing_for),
            names: OnceLock::new(),
        };
        let names = { image.info.is_segmentation }.then(|| Values::names(number, false));
        let known = { names.flatten() }.or_else(|| Values::kept(number, false));
        image.values = Arc::new(match known {
            Some(known) => known,
            None => {
                let sample = image.sample().await?;
                sample.values(number, false, std::iter::empty())
            }
        });
        Ok(image)
    }

    /// About what a decoded chunk takes \[bytes\].
    pub(super) fn piece_bytes(&self) -> u64 {
        let scale = &self.info.scales[0];
        self.shape(scale.chunk.min(scale.size)).bytes() as u64
    }

    fn shape(&self, size: UVec3) -> Shape {
        Shape {
            size,
            channels: self.info.channels,
            number: self.info.number,
        }
    }

    fn scale(&self, level: u32) -> &Scale {
        &self.info.scales[level as usize]
    }

    /// Position of a chunk, and its voxels.
    fn chunk(&self, id: PieceId) -> (UVec3, VoxelBox) {
        let scale = self.scale(id.level);
        let [gx, gy, _] = scale.grid().to_array().map(u64::from);
        let part = |n: u64| u32::try_from(n).unwrap_or(u32::MAX);
        let (x, y, z) = (id.number % gx, id.number / gx % gy, id.number / gx / gy);
        let at = UVec3::new(part(x), part(y), part(z));
        let min = at * scale.chunk;
        let max = min.saturating_add(scale.chunk).min(scale.size);
        (at, VoxelBox::new(min, max))
    }

    /// Some values of the coarsest level.
    async fn sample(&self) -> Result<Sample, PieceError> {
        let level = u32::try_from(self.info.scales.len() - 1).unwrap_or(0);
        let scale = self.scale(level);
        let channels = self.info.channels.min(16);
        let piece = scale.chunk.min(scale.size);
        let (boxes, partial) = sampled(scale.size, piece, self.shape(piece).bytes(), channels);
        let touched = (0..channels).flat_map(|channel| {
            let of_box = move |voxels: &VoxelBox| self.touched(channel, level, *voxels);
            boxes.iter().flat_map(of_box)
        });
        let chosen: Vec<(PieceId, Place)> = touched.collect();
        let mut sample = Sample::new(partial || level > 0);
        for (id, place) in chosen {
            for (_, raw) in self.raw(level, vec![id], None).await {
                if let Some(bytes) = raw? {
                    sample.add(&bytes, &place, self.info.number, false);
                }
            }
        }
        Ok(sample)
    }

    /// How messages name a chunk.
    fn which(&self, id: PieceId) -> String {
        let (at, _) = self.chunk(id);
        format!("chunk {at} of level {}", id.level)
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
        let scale = self.scale(id.level);
        let zipped = scale.sharding.is_some_and(|sharding| sharding.data_gzip);
        let most = usize::try_from(self.most_encoded(scale)).unwrap_or(usize::MAX);
        let packing = Packing {
            encoding: scale.encoding,
            shape: self.shape(self.chunk(id).1.size()),
            zipped: zipped.then_some(most),
        };
        let decoding = Decoding::new(decoding::Packing::Precomputed(packing), values);
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

    /// Longest that an encoded chunk can sensibly be \[bytes\].
    fn most_encoded(&self, scale: &Scale) -> u64 {
        let decoded = self.shape(scale.chunk.min(scale.size)).bytes() as u64;
        // Tables and headers of compressed_segmentation, for the smallest blocks.
        decoded * 4 + (64 << 10)
    }

    /// Chunks as stored numbers, or as values; `None` for one that is not stored. All are of one level, and,
    /// where there are shards, of one minishard.
    async fn raw(
        &self,
        level: u32,
        ids: Vec<PieceId>,
        values: Option<&Arc<Values>>,
    ) -> Vec<(PieceId, Raw)> {
        let scale = self.scale(level);
        let most = self.most_encoded(scale);
        match &scale.sharding {
            None => {
                let one = async |id: PieceId| (id, self.alone(id, most, values).await);
                stream::iter(ids)
                    .map(one)
                    .buffer_unordered(AT_ONCE)
                    .collect()
                    .await
            }
            Some(sharding) => self.of_minishard(level, sharding, ids, values).await,
        }
    }

    /// A chunk that has an object to itself.
    async fn alone(&self, id: PieceId, most: u64, values: Option<&Arc<Values>>) -> Raw {
        let scale = self.scale(id.level);
        let (_, voxels) = self.chunk(id);
        let axis = |n: usize| {
            let from = scale.offset[n] + i64::from(voxels.min[n]);
            let to = scale.offset[n] + i64::from(voxels.max[n]);
            format!("{from}-{to}")
        };
        let key = format!("{}/{}_{}_{}", scale.key, axis(0), axis(1), axis(2));
        let part = Part::Whole { most };
        // Of remote volumes whose chunks are known to be plain, one that is missing is asked for once.
        let names = match (self.names(), self.objects.is_remote()) {
            (Some(Name::Plain), true) => vec![Name::Plain],
            (Some(Name::Zipped), _) => vec![Name::Zipped, Name::Plain],
            _ => vec![Name::Plain, Name::Zipped],
        };
        for name in names {
            let key = match name {
                Name::Plain => key.clone(),
                Name::Zipped => format!("{key}.gz"),
            };
            if let Some(bytes) = self.part(id, &key, part.clone()).await? {
                // Whichever is the first.
                let _ = self.names.set(name);
                return self.decoded(id, &key, part, bytes, values).await;
            }
        }
        Ok(None)
    }

    fn names(&self) -> Option<Name> {
        self.names.get().copied()
    }

    fn number_in_shards(&self, id: PieceId) -> u64 {
        compressed_morton(self.chunk(id).0, self.scale(id.level).grid())
    }

    async fn of_minishard(
        &self,
        level: u32,
        sharding: &Sharding,
        ids: Vec<PieceId>,
        values: Option<&Arc<Values>>,
    ) -> Vec<(PieceId, Raw)> {
        let Some(&first) = ids.first() else {
            return Vec::new();
        };
        let minishard = sharding.minishard(self.number_in_shards(first));
        let key = format!(
            "{}/{}",
            self.scale(level).key,
            sharding.name(minishard.shard)
        );
        for _ in 0..ATTEMPTS {
            let index = self.index(first, *sharding, minishard, &key).await;
            let Indexed { index, version } = match index {
                Ok(index) => index,
                Err(error) if is_replaced(&error) => continue,
                Err(error) => return ids.into_iter().map(|id| (id, Err(error.clone()))).collect(),
            };
            let Some(index) = index else {
                return ids.into_iter().map(|id| (id, Ok(None))).collect();
            };
            let read = self.indexed(level, &key, &index, ids.clone(), values).await;
            // Else its index was of another shard, whether that was noticed by this read or by one beside it.
            let is_another = |(_, raw): &(_, Raw)| raw.as_ref().is_err_and(is_replaced);
            if self.objects.replacements(&key) == version && !read.iter().any(is_another) {
                return read;
            }
        }
        let error = |id| never_the_same(self.which(id), self.objects.location(&key));
        ids.into_iter().map(|id| (id, Err(error(id)))).collect()
    }

    /// Chunks of a minishard, by its index.
    async fn indexed(
        &self,
        level: u32,
        key: &str,
        index: &Index,
        ids: Vec<PieceId>,
        values: Option<&Arc<Values>>,
    ) -> Vec<(PieceId, Raw)> {
        let most = self.most_encoded(self.scale(level));
        let (mut done, mut wanted, mut ranges) = (Vec::new(), Vec::new(), Vec::new());
        for id in ids {
            match index.chunk(self.number_in_shards(id)) {
                None => done.push((id, Ok(None))),
                Some(range) if range.end - range.start > most => {
                    let length = range.end - range.start;
                    let reason =
                        format!("its index says {length} bytes, and it can need {most} at most");
                    done.push((id, Err(self.damaged(id, key, reason))));
                }
                Some(range) => {
                    wanted.push(id);
                    ranges.push(range);
                }
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
        let read = stream::iter(merged).map(read).buffer_unordered(AT_ONCE);
        done.extend(read.collect::<Vec<_>>().await.into_iter().flatten());
        done
    }

    /// The index of a minishard; none if there is nothing in it.
    async fn index(
        &self,
        of: PieceId,
        sharding: Sharding,
        minishard: Minishard,
        key: &str,
    ) -> Result<Indexed<Index>, PieceError> {
        let id = (of.level, minishard);
        let object = Replaced {
            object: (of.level, minishard.shard),
            // Its chunks lie wherever the hash puts them.
            voxels: VoxelBox::of_size(self.scale(of.level).size),
        };
        let read = |version| {
            let objects = self.objects.clone();
            let (which, key) = (self.which(of), key.to_owned());
            let work: Work<IndexId, Indexed<Index>, PieceError> = Box::pin(async move {
                let damaged = |reason: Damage| PieceError::Damaged {
                    reason,
                    which: which.clone(),
                    location: objects.location(&key),
                };
                let read = async |range: std::ops::Range<u64>| {
                    let read = objects.read(&key, Part::Range(range)).await;
                    read.map_err(|source| PieceError::Unread {
                        source: Arc::new(source),
                        which: which.clone(),
                    })
                };
                let once = async || {
                    let entry = minishard.minishard * 16;
                    let Some(entry) = read(entry..entry + 16).await? else {
                        return Ok(None);
                    };
                    let Some(range) = index_range(&entry, &sharding).map_err(damaged)? else {
                        return Ok(None);
                    };
                    let Some(bytes) = read(range).await? else {
                        return Ok(None);
                    };
                    Index::read(bytes, &sharding).map(Some).map_err(damaged)
                };
                let mut index = once().await;
                // A damaged entry points anywhere.
                let damaged = match &index {
                    Err(PieceError::Damaged { .. }) => true,
                    Err(PieceError::Unread { source, .. }) => !source.is_transient(),
                    Ok(_) => false,
                };
                if damaged && objects.is_remote() {
                    index = once().await;
                }
                vec![(id, index.map(|index| Indexed { index, version }))]
            });
            work
        };
        let objects = &*self.objects;
        self.indices.get(id, objects, key, object, read).await
    }
}

impl Stored for PrecomputedImage {
    fn object(&self, id: PieceId) -> u64 {
        match &self.scale(id.level).sharding {
            Some(sharding) => sharding.minishard(self.number_in_shards(id)).shard,
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
        self.scale(level).placed
    }

    fn touched(&self, channel: u32, level: u32, voxels: VoxelBox) -> Vec<(PieceId, Place)> {
        let scale = self.scale(level);
        let [gx, gy, _] = scale.grid().to_array().map(u64::from);
        let cells = voxels.cells(scale.chunk);
        let each = cells.map(|at| {
            let [x, y, z] = at.to_array().map(u64::from);
            let number = x + gx * (y + gy * z);
            let id = PieceId { level, number };
            let (_, voxels) = self.chunk(id);
            let [nx, ny, nz] = voxels.size().to_array().map(|n| n as usize);
            let place = Place {
                voxels,
                strides: [1, nx, nx * ny],
                offset: channel as usize * nx * ny * nz,
            };
            (id, place)
        });
        each.collect()
    }

    fn read(self: &Arc<Self>, pieces: Vec<PieceId>) -> Vec<(Vec<PieceId>, Pieces)> {
        // Chunks of a minishard together, others alone.
        let mut groups: BTreeMap<(u32, Minishard), Vec<PieceId>> = BTreeMap::new();
        for id in pieces {
            let group = match &self.scale(id.level).sharding {
                Some(sharding) => sharding.minishard(self.number_in_shards(id)),
                None => Minishard {
                    shard: id.number,
                    minishard: 0,
                },
            };
            groups.entry((id.level, group)).or_default().push(id);
        }
        let groups = groups.into_iter().map(|((level, _), ids)| {
            let (this, wanted) = (self.clone(), ids.clone());
            let work: Pieces = Box::pin(async move {
                let read = this.raw(level, wanted, Some(&this.values)).await;
                // What is not stored is 0.
                let piece = |raw: Option<Bytes>| raw.map_or(Piece::Uniform(0), Piece::Values);
                read.into_iter()
                    .map(|(id, raw)| (id, raw.map(piece)))
                    .collect()
            });
            (ids, work)
        });
        groups.collect()
    }
}
