//! OME-Zarr images, versions 0.1 to 0.5, in a folder.
//!
//! The arrays may be of Zarr version 2 or 3, sharded or not, of any codec that `zarrs` knows; their axes
//! any of t, c, z, y, x in any order. Levels may be of any ratio to the finest. Of several times the
//! first is shown.
//!
//! # Values
//!
//! Unsigned integers of 8 and 16 bit are what they are. Signed ones are moved up by half their range, so that
//! their order stays. Other types are refused in words: what they would lose, nobody would see. A
//! value of 0 counts as nothing measured, as everywhere.
//!
//! # Failure
//!
//! What is in files is believed nothing: absurd shapes and chunks are refused before memory is taken. A
//! chunk that cannot be decoded is [`ChunkError::Failed`] and names the array; the others are not
//! affected.

mod array;
mod error;
mod metadata;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use glam::{DVec3, UVec3};
use saccade_core::brick::MAX_LEVELS;
use saccade_core::levels::Level;
use saccade_core::volume::{MAX_EXTENT, Volume};
use saccade_core::voxel_box::VoxelBox;
use tokio::sync::Semaphore;

use crate::maybe_send::{BoxFuture, BoxStream};
use crate::{Change, Chunk, ChunkError, ChunkId, SourceError, VolumeSource};
use array::LevelArray;
pub use error::ZarrError;
use metadata::Image;

/// Size of the chunks that a volume is read in \[voxels\]: some bricks, whatever the file's own are.
const CHUNK: UVec3 = UVec3::new(64, 64, 64);
/// Decoded chunks of the files that are kept, all levels together \[bytes\].
const CACHE_BYTES: u64 = 512 << 20;

/// An OME-Zarr image in a folder.
#[derive(Debug)]
pub struct ZarrSource {
    volume: Arc<Volume>,
    levels: Arc<[LevelArray]>,
    /// As many decode at once as there are processors: more would only fill memory.
    decoders: Arc<Semaphore>,
}

impl ZarrSource {
    /// Whether a folder is the root of an OME-Zarr image or of another Zarr group.
    pub fn is_zarr(folder: &Path) -> bool {
        ["zarr.json", ".zattrs", ".zgroup", ".zarray"]
            .iter()
            .any(|name| folder.join(name).is_file())
    }

    /// Opens an image. Reads metadata only.
    ///
    /// # Errors
    ///
    /// [`SourceError::Open`] with a [`ZarrError`].
    pub async fn open(folder: &Path) -> Result<Self, SourceError> {
        let path = folder.to_owned();
        let opened = tokio::task::spawn_blocking(move || Self::open_now(&path)).await;
        let opened = opened.unwrap_or_else(|panic| Err(ZarrError::interrupted(folder, &panic)));
        opened.map_err(|error| SourceError::Open {
            source: Arc::new(error),
            location: folder.display().to_string(),
        })
    }

    fn open_now(folder: &Path) -> Result<Self, ZarrError> {
        let image = Image::read(folder)?;
        let cache = CACHE_BYTES / image.datasets.len().max(1) as u64;
        let open = |dataset: &metadata::Dataset| {
            LevelArray::open(&folder.join(&dataset.path), &image.axes, cache)
        };
        let levels: Vec<LevelArray> = image.datasets.iter().map(open).collect::<Result<_, _>>()?;
        let volume = volume(folder, &image, &levels)?;
        let cores = std::thread::available_parallelism().map_or(2, usize::from);
        Ok(Self {
            volume: Arc::new(volume),
            levels: levels.into(),
            decoders: Arc::new(Semaphore::new(cores)),
        })
    }

    async fn chunk(&self, id: ChunkId) -> Result<Chunk, ChunkError> {
        let Some(voxels) = id.voxels(&self.volume) else {
            return Err(ChunkError::OutOfRange { id });
        };
        // The semaphore is never closed.
        let permit = self.decoders.clone().acquire_owned().await.ok();
        let (levels, size) = (self.levels.clone(), self.volume.chunk);
        let read = tokio::task::spawn_blocking(move || {
            let _permit = permit;
            let array = &levels[id.level as usize];
            array.read(id.channel, voxels, size)
        });
        let read = read.await.unwrap_or_else(|panic| {
            let path = self.levels[id.level as usize].path();
            Err(ZarrError::interrupted(path, &panic))
        });
        match read {
            Ok(voxels) if voxels.iter().all(|&byte| byte == 0) => Ok(Chunk::Empty),
            Ok(voxels) => Ok(Chunk::Voxels(Bytes::from(voxels))),
            Err(error) => Err(ChunkError::Failed {
                id,
                transient: error.is_transient(),
                source: Arc::new(error),
            }),
        }
    }
}

impl VolumeSource for ZarrSource {
    fn volume(&self) -> &Arc<Volume> {
        &self.volume
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        Box::pin(self.chunk(id))
    }

    /// Nobody tells of changes in files.
    fn changes(&self) -> BoxStream<'static, Change> {
        Box::pin(futures::stream::pending())
    }
}

/// The volume that an image is.
fn volume(folder: &Path, image: &Image, levels: &[LevelArray]) -> Result<Volume, ZarrError> {
    let refused = |reason: String| ZarrError::Unsupported {
        reason,
        path: folder.to_owned(),
    };
    let Some(finest) = levels.first() else {
        return Err(refused("it has no levels".to_owned()));
    };
    let voxel_nm = image.voxel_nm;
    let volume = Volume::new(&name(folder), finest.extent(), voxel_nm);
    let mut volume = volume.map_err(|error| refused(error.to_string()))?;
    if levels.len() > MAX_LEVELS {
        let count = levels.len();
        return Err(refused(format!(
            "it has {count} levels, and {MAX_LEVELS} can be shown"
        )));
    }
    volume.dtype = finest.dtype();
    volume.chunk = CHUNK;
    volume.channels = (0..finest.channels())
        .map(|index| match image.channels.get(index as usize) {
            Some(label) if !label.is_empty() => label.clone(),
            _ => format!("channel {index}"),
        })
        .collect();
    volume.levels.clear();
    for (level, dataset) in levels.iter().zip(&image.datasets) {
        if level.dtype() != finest.dtype() || level.channels() != finest.channels() {
            return Err(refused("its levels differ in type or channels".to_owned()));
        }
        if level.extent().max_element() > MAX_EXTENT {
            let extent = level.extent();
            return Err(refused(format!(
                "{extent} voxels are more than {MAX_EXTENT} along an axis"
            )));
        }
        // What the transformations say, or, where they say nothing, what the sizes do.
        let by_size = finest.extent().as_dvec3() / level.extent().as_dvec3();
        let downsampling = dataset.downsampling.unwrap_or(by_size);
        volume.levels.push(Level {
            extent: level.extent(),
            downsampling: downsampling.max(DVec3::ONE),
        });
    }
    let coarser = volume.levels.windows(2).all(|pair| {
        pair[1].downsampling.cmpge(pair[0].downsampling).all()
            && pair[1].extent.cmple(pair[0].extent).all()
    });
    if !coarser {
        return Err(refused("its levels are not from fine to coarse".to_owned()));
    }
    Ok(volume)
}

/// A name for addresses, from the folder's.
fn name(folder: &Path) -> String {
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
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

/// A chunk of `size` voxels of some `bytes`, all 0, with its width and height \[voxels\]; `inside` is the part
/// that lies in the volume.
fn padded(size: UVec3, inside: VoxelBox, bytes: usize) -> (Vec<u8>, usize, usize) {
    let [width, height, depth] = size.to_array().map(|edge| edge as usize);
    debug_assert!(inside.size().cmple(size).all(), "a part of the chunk");
    (vec![0; width * height * depth * bytes], width, height)
}

/// Where an array is, for messages.
type ArrayPath = PathBuf;
