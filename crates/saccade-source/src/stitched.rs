//! Voxels stitched from tiles when they are asked for \[000 §5\].
//!
//! Nothing is computed before somebody asks. A request for a chunk builds the block around it
//! (512 x 512 x 32 voxels of its level), straight from the level of the tiles' pyramids that
//! matches, and keeps it for its neighbours.
//!
//! # What a voxel is
//!
//! Its sample sits at its centre, `(v + 0.5) * downsampling`.
//!
//! - Along z it takes, of the sections within its extent, the one nearest to its centre that has a
//!   tile there; of two equally near ones the first. Of the sections with tiles, in that order, the
//!   first four are looked at, then the 8th, 16th, 32nd and so on: a voxel that spans thousands of
//!   sections asks a dozen.
//!   A section counts as soon as it has a tile of any channel. Where a voxel spans none, see [`Gaps`];
//!   [`AlongZ`] says what else one can be that spans several.
//! - A tile is there if it is of the voxel's channel and the sample lies in the tile's rectangle (low edges
//!   included, high ones not) and not in a sub-tile of its finest level that is blank. Of several, those count whose pixels are at
//!   most one and a half times as large as the smallest ones there: a region imaged at a high magnification is
//!   seen within an overview at a low one \[003 §3.3\]. Of these, the one whose centre is nearest
//!   wins, then the one whose image was recorded last; or all are blended
//!   ([`Overlaps`]).
//! - The value is interpolated linearly, or as [`Interpolation`] says, in the pyramid level whose pixels are most like the voxel
//!   in size, with the tile's edge pixels repeated outward; it is at least 1. Where no tile is: 0.
//! - Where a voxel is larger than the pixels of a tile's coarsest level, it is the mean of 2 x 2,
//!   4 x 4, at most 16 x 16 such samples, those where no tile is left out. The largest tile pixels near
//!   decide how many; where tiles of a section differ in size, it is the same number for all. Coarsest
//!   levels stay in memory when their pyramids are closed, and on disk over restarts: coarse
//!   voxels open each pyramid once.
//!
//! # Labels
//!
//! Numbers of objects ([`VoxelKind::Labels`](saccade_core::volume::VoxelKind::Labels)) are never mixed, whatever is asked for: every voxel of every level is a
//! label that a tile has near there, or 0. Each is that of the nearest pixel, tile and section, and gaps are filled from
//! the nearer side. Pixels of pyramids are the most frequent of the pixels they cover, of several the
//! smallest; so is a voxel that is larger than those of the coarsest level, of the samples where a tile is. 0, no object, is
//! a label like any other: a tile hides others where it has 0, whole blank sub-tiles included, and 0 counts among
//! samples.
//!
//! # Changes
//!
//! When the catalog tells of a tile that came or moved, all that touches its old and new place is
//! forgotten, and what is being built there is delivered only to those who asked before.
//!
//! # Failure
//!
//! A tile that cannot be read fails the chunks it would be seen in, with its file's name; all other
//! chunks are delivered. The tile is tried again after some seconds.

mod along_z;
mod block;
mod blocks;
mod build;
mod canvas;
mod coverage;
mod damage;
mod disk_cache;
mod error;
mod follow;
mod holes;
mod index;
mod resample;
mod sampling;
mod thumbnails;
mod tiles;

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use glam::UVec2;
use saccade_archive::VisualizationArchive;
use saccade_archive::catalog::CatalogError;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use tokio::runtime::Handle;
use tokio::sync::Semaphore;
use tokio::task::AbortHandle;

use crate::changes::Changes;
use crate::maybe_send::{BoxFuture, BoxStream};
use crate::{Change, Chunk, ChunkError, ChunkId, Damage, SourceError, ValueRange, VolumeSource};
#[cfg(any(test, fuzzing))]
pub(crate) use {block::fuzz as fuzz_block, thumbnails::fuzz as fuzz_thumbnail};

use block::{BlockGrid, CutChunk};
use blocks::Blocks;
use build::{Builder, Place, Rules};
use follow::{Counted, Seen};
use tiles::Tiles;

pub use along_z::{AlongZ, Gaps};
pub use coverage::Overlaps;
pub use disk_cache::{DiskCache, DiskCacheError};
pub use error::StitchError;
pub use index::{SectionIndex, TileIndex, TileUpdate};
pub use resample::{Interpolation, Patch, Sample};

/// How a [`StitchedSource`] stitches, and its limits.
#[derive(Clone, Debug, PartialEq)]
pub struct StitchedOptions {
    /// Memory for finished blocks \[bytes\].
    pub block_bytes: u64,
    /// Memory for decoded sub-tiles \[bytes\].
    pub sub_tile_bytes: u64,
    /// Memory for the indices of pyramids \[bytes\].
    pub index_bytes: u64,
    /// Memory for the coarsest levels of tiles' pyramids \[bytes\], 16 or 32 kB each: all that levels show whose
    /// voxels are larger than their pixels.
    pub thumbnail_bytes: u64,
    /// Memory for the beginnings of pyramids that were read with their indices \[bytes\], until they are used once: coarse levels
    /// lie there, and need no other read.
    pub beginning_bytes: u64,
    /// Memory for where the tiles of sections lie \[bytes\]: about 300 for each tile of those looked at
    /// last.
    pub section_bytes: u64,
    /// Blocks built at a time.
    pub builds: usize,
    /// What lies between pixels; `None`: linearly between shades, and of labels, of which there is nothing in between,
    /// the nearest pixel. These three and [`Gaps::Linear`] are not done to labels, which is told when the volume is opened.
    pub interpolation: Option<Interpolation>,
    /// What is seen where tiles overlap.
    pub overlaps: Overlaps,
    /// What a voxel is that spans several sections.
    pub along_z: AlongZ,
    /// What is shown in place of sections that have no tile of a channel.
    pub gaps: Gaps,
    /// Keeps finished blocks and coarsest levels of pyramids over restarts. For archives that can be written, which then get an object
    /// `identity` that tells them from others.
    pub disk_cache: Option<DiskCache>,
    /// How long chunks fail that show a tile which cannot be read, until it is tried again.
    pub try_again: Duration,
    /// How long a pyramid that is not there counts as one on its way: some stores show a file later than
    /// the catalog names it. After that it counts as lost, though it is still looked for.
    pub may_come_for: Duration,
}

impl Default for StitchedOptions {
    fn default() -> Self {
        Self {
            block_bytes: 512 << 20,
            sub_tile_bytes: 256 << 20,
            index_bytes: 64 << 20,
            thumbnail_bytes: 128 << 20,
            beginning_bytes: 16 << 20,
            section_bytes: 256 << 20,
            interpolation: None,
            overlaps: Overlaps::NearestCentre,
            along_z: AlongZ::Nearest,
            gaps: Gaps::Empty,
            disk_cache: None,
            try_again: Duration::from_secs(3),
            may_come_for: Duration::from_mins(1),
            builds: std::thread::available_parallelism().map_or(2, usize::from),
        }
    }
}

/// What a [`StitchedSource`] holds and has done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct StitchedStatistics {
    /// Blocks built since it was opened.
    pub blocks_built: u64,
    /// Blocks found in the cache on disk since it was opened.
    pub blocks_from_disk: u64,
    /// Voxels of those blocks that were built.
    pub voxels_built: u64,
    /// Pyramids opened since it was opened, also those opened again.
    pub pyramids_opened: u64,
    /// Coarsest levels of pyramids found in the cache on disk since it was opened.
    pub thumbnails_from_disk: u64,
    /// Memory that coarsest levels of pyramids take \[bytes\].
    pub thumbnail_bytes: u64,
    /// Sub-tiles decoded since it was opened.
    pub sub_tiles_decoded: u64,
    /// Memory that finished blocks take \[bytes\].
    pub block_bytes: u64,
    /// Tiles in the indices of the sections touched so far.
    pub tiles_indexed: u64,
    /// Memory that these indices take \[bytes\].
    pub section_bytes: u64,
}

/// A piece of one z of a level, see [`StitchedSource::cross_section`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CrossSection {
    /// Voxels along x and y.
    pub size: UVec2,
    /// Their values, x fastest; of 16 bits little-endian.
    pub values: Vec<u8>,
}

/// A volume of an archive, stitched on demand.
pub struct StitchedSource {
    inner: Arc<Inner>,
    follower: AbortHandle,
}

struct Inner {
    volume: Arc<Volume>,
    grid: BlockGrid,
    blocks: Blocks,
    builder: Builder,
    builds: Arc<Semaphore>,
    /// With what tells the archive from others.
    disk: Option<(DiskCache, Vec<u8>)>,
    from_disk: AtomicU64,
    changes: Arc<Changes>,
    counted: Mutex<Counted>,
    runtime: Handle,
    /// What it is to leave out, so that a test finds that.
    #[cfg(test)]
    wrong: std::sync::OnceLock<tests::Wrong>,
}

impl Drop for StitchedSource {
    fn drop(&mut self) {
        self.follower.abort();
    }
}

impl StitchedSource {
    /// Opens the volume `name` of an archive, and follows its changes from now on. Must be called
    /// on a Tokio runtime, which does the source's work until it is dropped.
    ///
    /// # Errors
    ///
    /// [`SourceError::NoVolume`] if the archive has none of that name, [`SourceError::Open`] if its
    /// catalog cannot be read.
    pub async fn open(
        archive: &VisualizationArchive,
        name: &str,
        options: StitchedOptions,
    ) -> Result<Self, SourceError> {
        let catalog = archive.catalog().clone();
        let open_error = |error: StitchError| SourceError::Open {
            source: Arc::new(error),
            location: catalog.location().to_string(),
        };
        let failed = |source| open_error(StitchError::Catalog { source });
        // The watch exists before the revision is read, so that no change falls in between.
        let replaced = catalog.times_replaced();
        let news = match catalog.subscribe(name).await {
            Err(CatalogError::UnknownVolume { .. }) => {
                let volumes = catalog.volumes().await.map_err(failed)?;
                let known = volumes.into_iter().map(|volume| volume.name).collect();
                let name = name.to_owned();
                return Err(SourceError::NoVolume { name, known });
            }
            news => news.map_err(failed)?,
        };
        let entry = catalog.entry(name).await.map_err(failed)?;
        let volume = Arc::new(entry.volume);
        let index = TileIndex::open(&catalog, name, options.section_bytes)
            .await
            .map_err(failed)?;
        let disk = match options.disk_cache.clone() {
            Some(disk) => {
                let place = catalog.location().to_string();
                let identity = disk_cache::identity(archive).await;
                identity.map(|identity| (disk, (identity + &place).into_bytes()))
            }
            None => None,
        };
        let refused = Rules::refused(&options, volume.kind);
        if !refused.is_empty() {
            log::warn!(
                "volume {name:?} holds labels, which are not mixed: it is stitched from nearest pixels, tiles and \
                 sections, without {}",
                refused.join(", ")
            );
        }
        let tiles = Tiles::new(archive, index, &volume, disk.clone(), &options);
        let inner = Arc::new(Inner {
            disk,
            from_disk: AtomicU64::new(0),
            grid: BlockGrid::new(&volume),
            blocks: Blocks::new(options.block_bytes),
            builder: Builder::new(volume.clone(), tiles, &options),
            builds: Arc::new(Semaphore::new(options.builds.max(1))),
            changes: Changes::new(VoxelBox::of_size(volume.extent()), entry.revision),
            counted: Mutex::default(),
            runtime: Handle::current(),
            volume,
            #[cfg(test)]
            wrong: std::sync::OnceLock::new(),
        });
        let seen = Seen {
            revision: entry.revision,
            replaced,
        };
        let follow = follow::follow(Arc::downgrade(&inner), catalog, news, seen);
        let follower = tokio::spawn(follow).abort_handle();
        Ok(Self { inner, follower })
    }

    /// Where its tiles lie.
    pub fn index(&self) -> &TileIndex {
        self.inner.builder.tiles().index()
    }

    /// One z of a channel's level, cut out at `min` and `size` voxels large, x fastest; `None` where nothing was
    /// acquired. Built alone, and not kept: a picture of a plane costs a plane, not a block. Voxels
    /// past the level's end are left out.
    ///
    /// # Errors
    ///
    /// [`StitchError`] if a tile that is seen cannot be read.
    ///
    /// # Panics
    ///
    /// If the volume has no such level.
    pub async fn cross_section(
        &self,
        channel: u32,
        level: u32,
        z: u32,
        min: UVec2,
        size: UVec2,
    ) -> Result<Option<CrossSection>, Arc<StitchError>> {
        let extent = self.inner.volume.levels[level as usize].extent;
        let max = min.saturating_add(size).min(extent.truncate());
        let voxels = VoxelBox::new(min.extend(z), max.extend(z.saturating_add(1).min(extent.z)));
        if voxels.is_empty() {
            return Ok(None);
        }
        let place = Place {
            channel,
            level,
            voxels,
        };
        let values = self.inner.builder.cross_section(place).await?;
        let size = voxels.size().truncate();
        Ok(values.map(|values| CrossSection { size, values }))
    }

    /// What it holds and has done.
    pub fn statistics(&self) -> StitchedStatistics {
        let mut statistics = self.inner.builder.statistics();
        statistics.blocks_from_disk = self.inner.from_disk.load(Ordering::Relaxed);
        statistics.block_bytes = self.inner.blocks.bytes();
        statistics
    }
}

impl VolumeSource for StitchedSource {
    fn volume(&self) -> &Arc<Volume> {
        &self.inner.volume
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        Box::pin(async move {
            if id.voxels(&self.inner.volume).is_none() {
                return Err(ChunkError::OutOfRange { id });
            }
            let (key, chunk) = self.inner.grid.block_of(id);
            if !self.inner.builder.may_have_data(self.inner.place(key)) {
                return Ok(Chunk::Empty);
            }
            let block = self.inner.block(key).await;
            match block.map_err(|source| failed(id, source))?.chunk(chunk) {
                CutChunk::Empty => Ok(Chunk::Empty),
                CutChunk::Voxels(bytes, _) => Ok(Chunk::Voxels(bytes.clone())),
                CutChunk::Failed(error) => Err(failed(id, error.clone())),
            }
        })
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        self.inner.changes.stream()
    }

    fn revision(&self) -> u64 {
        self.inner.changes.revision()
    }

    fn changes_after(&self, revision: u64) -> BoxFuture<'_, Option<Vec<Change>>> {
        Box::pin(self.inner.changes_after(revision))
    }

    fn damage(&self) -> Vec<Damage> {
        self.inner.builder.tiles().damaged().list()
    }

    /// Known of chunks that were built and are still held; see [`Self::find_value_range`] for others.
    fn value_range(&self, id: ChunkId) -> Option<ValueRange> {
        id.voxels(&self.inner.volume)?;
        let (key, chunk) = self.inner.grid.block_of(id);
        match self.inner.blocks.peek(key)?.chunk(chunk) {
            CutChunk::Voxels(_, range) => Some(*range),
            CutChunk::Empty | CutChunk::Failed(_) => None,
        }
    }

    /// Of chunks that were not built, the bounds of the sub-tiles below them: opens pyramids, decodes
    /// nothing.
    fn find_value_range(
        &self,
        id: ChunkId,
    ) -> BoxFuture<'_, Result<Option<ValueRange>, ChunkError>> {
        Box::pin(async move {
            let Some(voxels) = id.voxels(&self.inner.volume) else {
                return Err(ChunkError::OutOfRange { id });
            };
            if let Some(range) = self.value_range(id) {
                return Ok(Some(range));
            }
            let place = Place {
                channel: id.channel,
                level: id.level,
                voxels,
            };
            let found = self.inner.builder.range(place).await;
            found.map_err(|source| failed(id, Arc::new(source)))
        })
    }
}

fn failed(id: ChunkId, source: Arc<StitchError>) -> ChunkError {
    ChunkError::Failed {
        id,
        transient: source.is_transient(),
        source,
    }
}

#[cfg(test)]
mod tests;
