//! Neuroglancer's precomputed volumes, wherever [`crate::objects`] reach.
//!
//! Chunks may be raw, jpeg, png or `compressed_segmentation`, in objects of their own or in shards, of any number of
//! levels and channels. Where a store compresses in transport, copies of it are read as well, in folders and over HTTP (`NAME.gz`, or
//! compressed without saying so).
//!
//! JPEG is decoded by libjpeg-turbo, to the last bit as with most other programs; in browsers by another decoder, which fills in colours
//! that are stored for several pixels at a time (4:2:0) otherwise: such values may be some steps (4 of 255) away.
//!
//! The finest level is where the volume is, and how far that is from 0, 0, 0 is kept in
//! [`Volume::origin_nm`](saccade_core::volume::Volume::origin_nm); others lie where their `voxel_offset` says, which may be off by less than one of their
//! voxels, since it is rounded.
//!
//! # Values
//!
//! As those of [`crate::zarr`]. A volume of type `segmentation` is one of labels: ids that fit into 16 bit stay what they
//! are, others are scattered over 65535 numbers, which [`VolumeSource::notes`] tells: 0 stays nothing, the same id the
//! same number everywhere.
//!
//! # Failure
//!
//! As that of [`crate::zarr`].

mod decode;
mod error;
mod image;
mod info;
mod shard;
#[cfg(all(test, not(target_family = "wasm")))]
mod tests;

use std::sync::Arc;

use glam::{DVec3, UVec3};
use saccade_core::brick::MAX_LEVELS;
use saccade_core::volume::{Dtype, MAX_EXTENT, Volume, VoxelKind};

use crate::images::ImageOptions;
use crate::maybe_send::{BoxFuture, BoxStream};
use crate::objects::{Objects, Part};
use crate::stored::{Stored, StoredSource, leave_out_zero_shifts, volume_name};
use crate::{Change, Chunk, ChunkError, ChunkId, VolumeSource};
pub(crate) use decode::Packing;
pub use error::PrecomputedError;
use error::Refusal;
use image::PrecomputedImage;
use info::Info;

/// Size of the chunks that a volume is read in \[voxels\].
const CHUNK: UVec3 = UVec3::new(64, 64, 64);
/// Metadata longer than this are not read \[bytes\].
const MOST_METADATA: u64 = 16 << 20;
/// By what share the resolutions of levels may differ from what they would be.
const ROUNDED: f64 = 1e-3;

/// A precomputed volume.
pub struct PrecomputedSource {
    stored: StoredSource<PrecomputedImage>,
    notes: Vec<String>,
}

impl std::fmt::Debug for PrecomputedSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PrecomputedSource")
            .field("volume", self.volume())
            .finish_non_exhaustive()
    }
}

impl PrecomputedSource {
    /// Opens the volume that some objects are; its name is made from `name`.
    ///
    /// # Errors
    ///
    /// [`PrecomputedError::NoVolume`] if they are none, others as they occur.
    pub async fn open(objects: Arc<dyn Objects>, name: &str) -> Result<Self, PrecomputedError> {
        Self::open_with(objects, name, ImageOptions::default()).await
    }

    /// Like [`Self::open`], with options.
    ///
    /// # Errors
    ///
    /// As [`Self::open`].
    pub async fn open_with(
        objects: Arc<dyn Objects>,
        name: &str,
        options: ImageOptions,
    ) -> Result<Self, PrecomputedError> {
        let read = objects
            .read(
                "info",
                Part::Whole {
                    most: MOST_METADATA,
                },
            )
            .await;
        let read = read.map_err(|source| PrecomputedError::Read {
            source: Arc::new(source),
        })?;
        let text = read.ok_or_else(|| PrecomputedError::NoVolume {
            location: objects.location("info"),
        })?;
        let here = |refusal: Refusal| refusal.at(objects.location("info"));
        let json = serde_json::from_slice(&text);
        let json = json.map_err(|error| here(Refusal::Wrong(error.to_string())))?;
        let info = Info::parse(&json).map_err(here)?;
        let volume = volume(name, &info).map_err(here)?;
        let mut notes = Vec::new();
        let offset = info.scales[0].offset;
        if offset != [0; 3] {
            let [x, y, z] = offset;
            notes.push(format!(
                "its first voxel is {x}, {y}, {z} elsewhere, and 0, 0, 0 here (voxel_offset); its place is kept where it is served or \
                 exported"
            ));
        }
        for (scale, level) in info.scales.iter().zip(&volume.levels) {
            let key = format!("{:?}", scale.key);
            notes.extend(scale.placed.note(&key, level.extent));
        }
        options.before_voxels(&*objects);
        let missing_for = options.missing_for;
        let stored = PrecomputedImage::new(objects, volume, info, missing_for).await;
        let stored = stored.map_err(|source| PrecomputedError::Sample { source })?;
        notes.extend(stored.values().note());
        let piece = stored.piece_bytes();
        Ok(Self {
            stored: StoredSource::new(stored, piece, missing_for),
            notes,
        })
    }
}

impl VolumeSource for PrecomputedSource {
    fn volume(&self) -> &Arc<Volume> {
        self.stored.volume()
    }

    fn notes(&self) -> &[String] {
        &self.notes
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        self.stored.read(id)
    }

    fn renamed_label(&self) -> Option<i128> {
        self.stored.renamed_label()
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        self.stored.changes()
    }

    fn revision(&self) -> u64 {
        self.stored.revision()
    }

    fn notices_by_reading(&self) -> bool {
        self.stored.notices_by_reading()
    }
}

/// The volume that an `info` describes.
fn volume(name: &str, info: &Info) -> Result<Volume, Refusal> {
    let refused = |reason: String| Refusal::Unsupported(reason);
    let finest = &info.scales[0];
    let volume = Volume::new(&volume_name(name), finest.size, finest.resolution);
    let mut volume = volume.map_err(|error| refused(error.to_string()))?;
    if info.scales.len() > MAX_LEVELS {
        let count = info.scales.len();
        return Err(refused(format!(
            "it has {count} levels, and {MAX_LEVELS} can be shown"
        )));
    }
    volume.dtype = match info.number.bytes() {
        1 => Dtype::Uint8,
        _ => Dtype::Uint16,
    };
    if info.is_segmentation && info.number.is_whole() {
        volume.kind = VoxelKind::Labels;
    }
    volume.origin_nm = finest.corner_nm();
    volume.chunk = CHUNK;
    volume.channels = (0..info.channels).map(|n| format!("channel {n}")).collect();
    let mut by = DVec3::ONE;
    volume.levels.clear();
    for scale in &info.scales {
        if scale.size.max_element() > MAX_EXTENT {
            let size = scale.size;
            return Err(refused(format!(
                "{size} voxels are more than {MAX_EXTENT} along an axis"
            )));
        }
        let downsampling = scale.resolution / finest.resolution;
        if (downsampling * (1.0 + ROUNDED)).cmplt(by).any() {
            return Err(refused("its levels are not from fine to coarse".to_owned()));
        }
        by = downsampling.max(by);
        let level = scale.placed.level(finest.size, by);
        volume.levels.push(level.ok_or_else(|| {
            let key = &scale.key;
            refused(format!(
                "its level {key:?} lies elsewhere than the finest one (voxel_offset)"
            ))
        })?);
        let shift = scale.placed.off() * scale.resolution;
        volume.shifts_nm.push(shift);
    }
    leave_out_zero_shifts(&mut volume);
    Ok(volume)
}
