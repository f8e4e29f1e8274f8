//! The voxels of a volume: which of its chunks they are in, and how those are read.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use bytes::Bytes;
use futures::StreamExt as _;
use futures::stream;
use glam::UVec3;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;

use super::decode::{self, Shape};
use super::info::{Info, Scale};
use super::shard::{Index, Minishard, compressed_morton, index_range};
use crate::codecs::Damage;
use crate::decoding::{Decoding, Packing};
use crate::flights::Work;
use crate::objects::{Objects, Part};
use crate::stored::{
    AT_ONCE, Indexed, Indices, Packed, Piece, PieceError, PieceId, Pieces, Place, Placed, Raw,
    Replaced, Sample, Stored, sampled,
};
use crate::values::Values;

/// Indices of minishards that are kept \[bytes\].
const INDEX_CACHE: u64 = 64 << 20;

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
        if let (Some(sharding), Some(&first)) = (&scale.sharding, ids.first()) {
            let shard = sharding.minishard(self.number_in_shards(first)).shard;
            let key = format!("{}/{}", scale.key, sharding.name(shard));
            return self.together(&key, ids, values).await;
        }
        let most = self.most_encoded(scale);
        let one = async |id: PieceId| (id, self.alone(id, most, values).await);
        let read = stream::iter(ids).map(one).buffer_unordered(AT_ONCE);
        read.collect().await
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
}

impl Packed for PrecomputedImage {
    type Index = Index;

    fn objects(&self) -> &dyn Objects {
        &*self.objects
    }

    fn which(&self, id: PieceId) -> String {
        let (at, _) = self.chunk(id);
        format!("chunk {at} of level {}", id.level)
    }

    fn decoding(&self, id: PieceId, values: Option<&Arc<Values>>) -> Decoding {
        let scale = self.scale(id.level);
        let zipped = scale.sharding.is_some_and(|sharding| sharding.data_gzip);
        let most = usize::try_from(self.most_encoded(scale)).unwrap_or(usize::MAX);
        let packing = decode::Packing {
            encoding: scale.encoding,
            shape: self.shape(self.chunk(id).1.size()),
            zipped: zipped.then_some(most),
        };
        Decoding::new(Packing::Precomputed(packing), values)
    }

    fn range(&self, index: &Index, id: PieceId) -> Result<Option<Range<u64>>, Damage> {
        let range = index.chunk(self.number_in_shards(id));
        let length = range.as_ref().map_or(0, |range| range.end - range.start);
        let most = self.most_encoded(self.scale(id.level));
        match length > most {
            true => Err(format!(
                "its index says {length} bytes, and it can need {most} at most"
            )),
            false => Ok(range),
        }
    }

    /// Of the minishard; none also if there is nothing in it.
    async fn index(&self, of: PieceId, key: &str) -> Result<Indexed<Index>, PieceError> {
        let Some(sharding) = self.scale(of.level).sharding else {
            return Ok(Indexed {
                index: None,
                version: 0,
            });
        };
        let minishard = sharding.minishard(self.number_in_shards(of));
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
                let read = async |range: Range<u64>| {
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
