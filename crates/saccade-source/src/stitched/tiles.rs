//! What is known of the tiles: indices of sections and of pyramids, decoded sub-tiles.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::StitchedOptions;
use super::damage::DamagedTiles;
use super::disk_cache::DiskCache;
use super::error::StitchError;
use super::holes::Holes;
use super::index::{IndexedTile, TileIndex};
use super::thumbnails::Thumbnail;
use bytes::Bytes;
use futures::future::try_join_all;
use glam::{DVec2, UVec2};
use quick_cache::Weighter;
use quick_cache::sync::Cache;
use saccade_archive::VisualizationArchive;
use saccade_archive::pyramid::{
    PyramidIndex, PyramidLevel, SUB_TILE_EDGE, SUB_TILE_VOXELS, SubTileEntry,
};
use saccade_archive::storage::Storage;
use saccade_core::volume::{Dtype, Volume};
use tokio::sync::Semaphore;

/// Reads under way, at most: enough to hide a network's latency, few enough to leave files for others.
const READS_AT_ONCE: usize = 64;

/// An opened pyramid.
pub(super) struct Pyramid {
    pub(super) index: PyramidIndex,
    /// Another each time one is opened.
    serial: u64,
    holes: Option<Holes>,
}

impl Pyramid {
    fn new(index: PyramidIndex, serial: u64) -> Self {
        Self {
            holes: Holes::of(&index),
            index,
            serial,
        }
    }

    /// Memory it takes \[bytes\].
    fn memory(&self) -> usize {
        self.index.memory() + self.holes.as_ref().map_or(0, Holes::memory)
    }

    /// Smallest and largest value of the sub-tiles that a rectangle \[pixels of the level\] touches; `None` if all are
    /// blank. The interpolation reaches over `reach` pixels.
    fn range(&self, level: u32, min: DVec2, max: DVec2, reach: f64) -> Option<(u16, u16)> {
        let size = self.index.levels()[level as usize];
        let last = UVec2::new(size.width - 1, size.height - 1).as_dvec2();
        // Between the centres of pixels in each direction.
        let reach = reach - 0.49;
        let low = (min - reach).clamp(DVec2::ZERO, last).as_uvec2() / SUB_TILE_EDGE;
        let high = (max + reach).clamp(DVec2::ZERO, last).as_uvec2() / SUB_TILE_EDGE;
        let mut range: Option<(u16, u16)> = None;
        let mut blanks = false;
        for y in low.y..=high.y {
            for x in low.x..=high.x {
                match self.index.sub_tile(level as usize, x, y) {
                    Some(entry) if !entry.is_blank() => {
                        let (min, max) = (entry.min, entry.max);
                        let (least, most) = range.unwrap_or((min, max));
                        range = Some((least.min(min), most.max(max)));
                    }
                    _ => blanks = true,
                }
            }
        }
        if blanks {
            // Beside a blank sub-tile, values fall off to 0.
            range = range.map(|(_, most)| (0, most));
        }
        range
    }
}

/// Names a sub-tile while its pyramid is open.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct SubTileKey {
    pyramid: u64,
    level: u32,
    at: UVec2,
}

/// A sub-tile as it was read or, better, as it was decoded before or need not be.
pub(super) enum Fetched {
    Constant(u16),
    /// Of this pyramid.
    Encoded(Arc<Pyramid>, Bytes),
    Decoded(Bytes),
}

/// What is drawn of a tile.
#[derive(Clone)]
pub(super) enum Image {
    Pyramid(Arc<Pyramid>),
    /// Its coarsest level alone.
    Thumbnail(Arc<Thumbnail>),
}

impl Image {
    /// Size of a level, which of a thumbnail is its own.
    pub(super) fn level(&self, level: u32) -> PyramidLevel {
        match self {
            Self::Pyramid(pyramid) => pyramid.index.levels()[level as usize],
            Self::Thumbnail(thumbnail) => thumbnail.level(),
        }
    }

    /// Where it is blank, if it is anywhere.
    pub(super) fn holes(&self) -> Option<&Holes> {
        match self {
            Self::Pyramid(pyramid) => pyramid.holes.as_ref(),
            Self::Thumbnail(thumbnail) => thumbnail.holes(),
        }
    }

    /// See [`Pyramid::range`].
    pub(super) fn range(
        &self,
        level: u32,
        min: DVec2,
        max: DVec2,
        reach: f64,
    ) -> Option<(u16, u16)> {
        match self {
            Self::Pyramid(pyramid) => pyramid.range(level, min, max, reach),
            Self::Thumbnail(thumbnail) => thumbnail.range(),
        }
    }
}

#[derive(Clone)]
struct Bytewise;

impl Weighter<SubTileKey, Bytes> for Bytewise {
    fn weight(&self, _: &SubTileKey, voxels: &Bytes) -> u64 {
        voxels.len() as u64 + 64
    }
}

impl Weighter<u64, Bytes> for Bytewise {
    fn weight(&self, _: &u64, beginning: &Bytes) -> u64 {
        beginning.len() as u64 + 64
    }
}

impl Weighter<Box<str>, Arc<Thumbnail>> for Bytewise {
    fn weight(&self, name: &Box<str>, thumbnail: &Arc<Thumbnail>) -> u64 {
        (thumbnail.memory() + name.len() + 64) as u64
    }
}

impl Weighter<Box<str>, Arc<Pyramid>> for Bytewise {
    fn weight(&self, name: &Box<str>, pyramid: &Arc<Pyramid>) -> u64 {
        (pyramid.memory() + name.len() + 64) as u64
    }
}

pub(super) struct Tiles {
    index: TileIndex,
    storage: Arc<dyn Storage>,
    /// Of the volume.
    dtype: Dtype,
    /// Whether they are labels.
    labels: bool,
    reads: Semaphore,
    pyramids: Cache<Box<str>, Arc<Pyramid>, Bytewise>,
    sub_tiles: Cache<SubTileKey, Bytes, Bytewise>,
    thumbnails: Cache<Box<str>, Arc<Thumbnail>, Bytewise>,
    /// What was read with the indices of pyramids, by their serials, until it is used.
    beginnings: Cache<u64, Bytes, Bytewise>,
    /// With what tells the archive from others.
    disk: Option<(DiskCache, Vec<u8>)>,
    from_disk: AtomicU64,
    next_serial: AtomicU64,
    decoded: AtomicU64,
    damaged: DamagedTiles,
}

impl Tiles {
    pub(super) fn new(
        archive: &VisualizationArchive,
        index: TileIndex,
        volume: &Volume,
        disk: Option<(DiskCache, Vec<u8>)>,
        options: &StitchedOptions,
    ) -> Self {
        let items = |bytes: u64, each: usize| {
            usize::try_from(bytes)
                .map_or(usize::MAX, |b| b / each)
                .clamp(16, 1 << 20)
        };
        Self {
            index,
            storage: archive.storage().clone(),
            dtype: volume.dtype,
            labels: volume.kind.is_labels(),
            reads: Semaphore::new(READS_AT_ONCE),
            pyramids: Cache::with_weighter(
                items(options.index_bytes, 64 << 10),
                options.index_bytes,
                Bytewise,
            ),
            sub_tiles: Cache::with_weighter(
                items(options.sub_tile_bytes, SUB_TILE_VOXELS),
                options.sub_tile_bytes,
                Bytewise,
            ),
            thumbnails: Cache::with_weighter(
                items(options.thumbnail_bytes, SUB_TILE_VOXELS),
                options.thumbnail_bytes,
                Bytewise,
            ),
            beginnings: Cache::with_weighter(
                items(options.beginning_bytes, 192 << 10),
                options.beginning_bytes,
                Bytewise,
            ),
            disk,
            from_disk: AtomicU64::new(0),
            next_serial: AtomicU64::new(0),
            decoded: AtomicU64::new(0),
            damaged: DamagedTiles::new(options.may_come_for),
        }
    }

    /// Where they lie.
    pub(super) fn index(&self) -> &TileIndex {
        &self.index
    }

    /// Those that could not be read.
    pub(super) fn damaged(&self) -> &DamagedTiles {
        &self.damaged
    }

    /// What is drawn of a tile at a level of its pyramid.
    pub(super) async fn image(&self, tile: &IndexedTile, level: u32) -> Result<Image, StitchError> {
        if level < tile.coarsest_level() {
            return self.pyramid(tile).await.map(Image::Pyramid);
        }
        let make = self.thumbnail(tile);
        let made = self.thumbnails.get_or_insert_async(&tile.pyramid, make);
        made.await.map(Image::Thumbnail)
    }

    /// What tells a tile's values at a level, with nothing decoded.
    pub(super) async fn bounds(
        &self,
        tile: &IndexedTile,
        level: u32,
    ) -> Result<Image, StitchError> {
        let known = || self.thumbnails.get(&tile.pyramid);
        match Some(level).filter(|level| *level >= tile.coarsest_level()) {
            Some(_) if let Some(thumbnail) = known() => Ok(Image::Thumbnail(thumbnail)),
            _ => self.pyramid(tile).await.map(Image::Pyramid),
        }
    }

    /// The pyramid of a tile, opened if it is not open.
    async fn pyramid(&self, tile: &IndexedTile) -> Result<Arc<Pyramid>, StitchError> {
        let open = self.open(tile);
        self.pyramids.get_or_insert_async(&tile.pyramid, open).await
    }

    async fn open(&self, tile: &IndexedTile) -> Result<Arc<Pyramid>, StitchError> {
        let _turn = self.reads.acquire().await;
        let opened = PyramidIndex::open_with_beginning(&*self.storage, &tile.pyramid).await;
        let (index, beginning) = opened.map_err(|source| {
            let section = tile.section;
            StitchError::Tile { source, section }
        })?;
        if index.is_mistaken() {
            return Err(StitchError::Mistaken {
                name: tile.pyramid.to_string(),
            });
        }
        let got = UVec2::new(index.levels()[0].width, index.levels()[0].height);
        let levels = index.levels().len();
        if index.dtype() != self.dtype {
            return Err(StitchError::Dtype {
                expected: self.dtype,
                got: index.dtype(),
                name: tile.pyramid.to_string(),
            });
        }
        if got != tile.size || levels <= tile.coarsest_level() as usize {
            let (expected, name) = (tile.size, tile.pyramid.to_string());
            return Err(StitchError::Size {
                expected,
                got,
                name,
            });
        }
        let serial = self.next_serial.fetch_add(1, Ordering::Relaxed);
        self.beginnings.insert(serial, beginning);
        Ok(Arc::new(Pyramid::new(index, serial)))
    }

    /// The thumbnail of a tile: from the cache on disk, or read now.
    async fn thumbnail(&self, tile: &IndexedTile) -> Result<Arc<Thumbnail>, StitchError> {
        let kept = self.disk.as_ref().map(|(disk, identity)| {
            let (name, size, dtype) = (&tile.pyramid, tile.size, self.dtype);
            let description = format!("thumbnail 2 {name:?} {size:?} {dtype:?}");
            (disk, [identity, description.as_bytes()].concat())
        });
        if let Some((disk, description)) = &kept
            && let Some(bytes) = disk.get(description).await
            && let Some(thumbnail) = Thumbnail::from_bytes(bytes, self.dtype)
        {
            self.from_disk.fetch_add(1, Ordering::Relaxed);
            return Ok(Arc::new(thumbnail));
        }
        // Thousands of pyramids that are opened for this alone leave the others open.
        let room = self.pyramids.weight() < self.pyramids.capacity() / 2;
        let pyramid = match self.pyramids.get(&tile.pyramid) {
            Some(pyramid) => pyramid,
            None if room => self.pyramid(tile).await?,
            None => self.open(tile).await?,
        };
        let level = tile.coarsest_level();
        let PyramidLevel { width, height, .. } = pyramid.index.levels()[level as usize];
        let size = UVec2::new(width, height);
        let entry = pyramid.index.sub_tile(level as usize, 0, 0);
        let range = entry.map_or((0, 0), |entry| (entry.min, entry.max));
        let voxels = if range.0 == range.1 {
            Bytes::new()
        } else {
            let wanted = vec![UVec2::ZERO];
            let mut fetched = self.fetch(&pyramid, tile.section, level, wanted).await?;
            let (_, fetched) = fetched.pop().expect("it is not blank");
            self.decode(tile.section, level, UVec2::ZERO, fetched)?
        };
        let thumbnail = Thumbnail::new(size, range, pyramid.holes.clone(), voxels);
        if let Some((disk, description)) = &kept {
            disk.put(description, &thumbnail.to_bytes());
        }
        Ok(Arc::new(thumbnail))
    }

    /// Fetches sub-tiles of a level, neighbours together. Blank ones are left out, but for those of labels;
    /// those of one value are known without a read.
    pub(super) async fn fetch(
        &self,
        pyramid: &Arc<Pyramid>,
        section: u32,
        level: u32,
        wanted: Vec<UVec2>,
    ) -> Result<Vec<(UVec2, Fetched)>, StitchError> {
        let mut fetched = Vec::with_capacity(wanted.len());
        let mut missing = Vec::new();
        for at in wanted {
            let entry = pyramid.index.sub_tile(level as usize, at.x, at.y);
            let known = |e: &SubTileEntry| e.min == e.max && (self.labels || !e.is_blank());
            if let Some(entry) = entry.filter(known) {
                fetched.push((at, Fetched::Constant(entry.min)));
                continue;
            }
            match self.sub_tiles.get(&key(pyramid, level, at)) {
                Some(voxels) => fetched.push((at, Fetched::Decoded(voxels))),
                None => missing.push(at),
            }
        }
        if missing.is_empty() {
            return Ok(fetched);
        }
        let gap = self.storage.read_cost();
        let reads = pyramid.index.reads(level as usize, missing, gap);
        let name = pyramid.index.name();
        // Whoever opened it wanted what comes next: this.
        let beginning = self.beginnings.remove(&pyramid.serial);
        let beginning = beginning.map_or(Bytes::new(), |(_, bytes)| bytes);
        let read = reads.iter().map(async |read| {
            let [begin, end] = [read.range.start, read.range.end].map(usize::try_from);
            if let (Ok(begin), Ok(end)) = (begin, end)
                && end <= beginning.len()
            {
                return Ok(beginning.slice(begin..end));
            }
            let _turn = self.reads.acquire().await;
            let bytes = self.storage.read(name, Some(read.range.clone())).await;
            bytes.map_err(|source| {
                let name = name.to_owned();
                let source = saccade_archive::pyramid::PyramidError::Storage { source, name };
                StitchError::Tile { source, section }
            })
        });
        for (read, bytes) in reads.iter().zip(try_join_all(read).await?) {
            for (at, within) in &read.sub_tiles {
                if within.end > bytes.len() {
                    return Err(StitchError::Cut { name: name.into() });
                }
                let bytes = bytes.slice(within.clone());
                fetched.push((*at, Fetched::Encoded(pyramid.clone(), bytes)));
            }
        }
        Ok(fetched)
    }

    /// Decodes a fetched sub-tile to little-endian voxels, and remembers it.
    pub(super) fn decode(
        &self,
        section: u32,
        level: u32,
        at: UVec2,
        fetched: Fetched,
    ) -> Result<Bytes, StitchError> {
        let (pyramid, bytes) = match fetched {
            Fetched::Constant(value) => return Ok(self.constant(value)),
            Fetched::Decoded(voxels) => return Ok(voxels),
            Fetched::Encoded(pyramid, bytes) => (pyramid, bytes),
        };
        let decoded = pyramid
            .index
            .decode_sub_tile(level as usize, at.x, at.y, &bytes);
        let voxels = decoded.map_err(|source| StitchError::Tile { source, section })?;
        let voxels = Bytes::from(voxels);
        self.decoded.fetch_add(1, Ordering::Relaxed);
        self.sub_tiles
            .insert(key(&pyramid, level, at), voxels.clone());
        Ok(voxels)
    }

    fn constant(&self, value: u16) -> Bytes {
        match self.dtype {
            Dtype::Uint16 => value.to_le_bytes().repeat(SUB_TILE_VOXELS).into(),
            _ => value.to_le_bytes()[..1].repeat(SUB_TILE_VOXELS).into(),
        }
    }

    /// Sub-tiles decoded so far.
    pub(super) fn decoded(&self) -> u64 {
        self.decoded.load(Ordering::Relaxed)
    }

    /// Thumbnails found in the cache on disk so far.
    pub(super) fn thumbnails_from_disk(&self) -> u64 {
        self.from_disk.load(Ordering::Relaxed)
    }

    /// Memory that thumbnails take \[bytes\].
    pub(super) fn thumbnail_bytes(&self) -> u64 {
        self.thumbnails.weight()
    }

    /// Pyramids opened so far.
    pub(super) fn opened(&self) -> u64 {
        self.next_serial.load(Ordering::Relaxed)
    }
}

fn key(pyramid: &Pyramid, level: u32, at: UVec2) -> SubTileKey {
    SubTileKey {
        pyramid: pyramid.serial,
        level,
        at,
    }
}
