//! The voxels of an image: which chunks of its arrays they are in, and how those are read.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::StreamExt as _;
use futures::stream;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;

use super::error::{Refusal, ZarrError};
use super::level::LevelArray;
use super::looks::looks;
use super::metadata::Image;
use super::shard::Index;
use crate::codecs::Damage;
use crate::decoding::{Decoding, Packing};
use crate::flights::Work;
use crate::objects::{Objects, Part};
use crate::stored::{
    AT_ONCE, Indexed, Indices, Packed, Piece, PieceError, PieceId, Pieces, Place, Placed, Raw,
    Replaced, Sample, Stored, sampled,
};
use crate::values::Values;

/// Indices of shards that are kept \[bytes\].
const INDEX_CACHE: u64 = 64 << 20;

/// A shard, by level and number within it.
type ShardId = (u32, u64);

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
        let channels = array.channels().min(16);
        let (boxes, partial) = sampled(
            array.extent(),
            array.cell(),
            array.array.chunk_bytes(),
            channels,
        );
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

    fn level(&self, id: PieceId) -> &LevelArray {
        &self.levels[id.level as usize]
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
        let first = ids.first().map_or(0, |first| first.number);
        if let Some(shard) = array.shard(first) {
            return self.together(&array.key(&shard), ids, values).await;
        }
        let most = array.packing.most();
        let one = async |id: PieceId| {
            let key = array.key(&array.chunk(id.number));
            let whole = Part::Whole { most };
            match self.part(id, &key, whole.clone()).await {
                Ok(Some(bytes)) => (id, self.decoded(id, &key, whole, bytes, values).await),
                other => (id, other),
            }
        };
        let read = stream::iter(ids).map(one).buffer_unordered(AT_ONCE);
        read.collect().await
    }
}

impl Packed for ZarrImage {
    type Index = Index;

    fn objects(&self) -> &dyn Objects {
        &*self.objects
    }

    fn which(&self, id: PieceId) -> String {
        let index = self.level(id).chunk(id.number);
        format!("chunk {index:?} of level {}", id.level)
    }

    fn decoding(&self, id: PieceId, values: Option<&Arc<Values>>) -> Decoding {
        let level = self.level(id);
        let packing = Packing::Zarr(level.packing.clone());
        let inside = values.and_then(|_| level.inside(id.number));
        Decoding::new(packing, values).within(inside)
    }

    fn range(&self, index: &Index, id: PieceId) -> Result<Option<Range<u64>>, Damage> {
        let level = self.level(id);
        index.chunk(level.number_in_shard(id.number), level.packing.most())
    }

    async fn index(&self, of: PieceId, key: &str) -> Result<Indexed<Index>, PieceError> {
        let array = self.level(of);
        let (Some(sharding), Some(shard)) = (&array.array.sharding, array.shard(of.number)) else {
            return Ok(Indexed {
                index: None,
                version: 0,
            });
        };
        let id = (of.level, array.shard_number(&shard));
        let object = Replaced {
            object: id,
            voxels: array.voxels_of_shard(&shard),
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
        let array = self.level(id);
        match array.shard(id.number) {
            Some(shard) => array.shard_number(&shard),
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
            let level = self.level(id);
            let alone = || level.chunk(id.number);
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
