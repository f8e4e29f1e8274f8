//! OME-Zarr images, versions 0.1 to 0.6, wherever [`crate::objects`] reach.
//!
//! The arrays may be of Zarr version 2 or 3, sharded or not, compressed by blosc, zstd, gzip, zlib or lz4;
//! their axes any of t, c, z, y, x in any order. Levels may be of any ratio to the finest. Of several times
//! the first is shown.
//!
//! Of version 0.6 (RFC-5), an image is shown in the coordinate system in which its levels lie, where they are placed by scale,
//! translation or identity, alone or in sequence. Transformations that lead from there to others are told in
//! [`VolumeSource::notes`], not applied; scenes of several images are refused with their names.
//!
//! The finest level is where the volume is; how far it is moved as a whole is kept in
//! [`Volume::origin_nm`](saccade_core::volume::Volume::origin_nm). Others lie where their transformations say: they may cover a part of it, or more. By up to
//! half of its voxels a level may be off, since writers mean the middle or the corner of a voxel; what is further away is
//! told in [`VolumeSource::notes`].
//!
//! # Values
//!
//! Unsigned integers of 8 and 16 bit are what they are. Signed ones are moved up by half their range, so that
//! their order stays. Wider numbers are shown in 16 bit: whole ones as they are if those of the coarsest
//! level fit, others within a window that [`VolumeSource::notes`] tells. A value of 0 counts as nothing
//! measured, as everywhere.
//!
//! An image of whole numbers is a volume of labels where it says so (`image-label`), or lies in a folder `labels` and has no
//! colours of its own (`omero`), which the notes tell. Its ids stay what they are up to 65535; those of wider
//! types that do not are scattered over 65535 numbers, whatever was looked at, which the notes tell as well.
//!
//! # Reading
//!
//! A shard's index is read once, and anew when the shard was replaced, as far as its store tells; chunks that are wanted together and
//! lie close together come with one request. What is not stored has the array's fill value, and is looked for again when it is read
//! again a while later ([`ImageOptions::missing_for`]). What has come or was replaced is told by [`VolumeSource::changes`].
//!
//! # Failure
//!
//! What others wrote is believed nothing: absurd shapes and chunks are refused before memory is taken. A
//! chunk that cannot be decoded is read once more where it came over a network; then it is
//! [`ChunkError::Failed`] with a [`PieceError`](crate::PieceError) that names it and where it is. The others are not affected.

mod array;
mod error;
mod image;
mod level;
mod looks;
mod metadata;
mod packing;
mod shard;
mod space;
#[cfg(all(test, not(target_family = "wasm")))]
mod tests;

use std::sync::Arc;

use futures::future::join_all;
use glam::{DVec3, UVec3};
use saccade_core::brick::MAX_LEVELS;
use saccade_core::volume::{Dtype, MAX_EXTENT, Volume, VoxelKind};
use serde_json::Value;

use crate::images::ImageOptions;
use crate::maybe_send::{BoxFuture, BoxStream};
use crate::objects::{Objects, Part};
use crate::stored::{Stored, StoredSource, leave_out_zero_shifts, volume_name};
use crate::{Change, Chunk, ChunkError, ChunkId, VolumeSource};
use array::Array;
use error::Refusal;
pub use error::ZarrError;
use image::ZarrImage;
use level::LevelArray;
use metadata::{Axis, Image};
pub(crate) use packing::Packing;

/// Size of the chunks that a volume is read in \[voxels\]: some bricks, whatever the file's own are.
const CHUNK: UVec3 = UVec3::new(64, 64, 64);
/// Metadata longer than this are not read \[bytes\].
const MOST_METADATA: u64 = 16 << 20;
/// By what share the scales of levels may differ from what they would be.
const ROUNDED: f64 = 1e-3;

/// An OME-Zarr image.
pub struct ZarrSource {
    stored: StoredSource<ZarrImage>,
    notes: Vec<String>,
}

impl std::fmt::Debug for ZarrSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ZarrSource")
            .field("volume", self.volume())
            .finish_non_exhaustive()
    }
}

impl ZarrSource {
    /// Whether a folder is the root of an OME-Zarr image or of another Zarr group.
    #[cfg(not(target_family = "wasm"))]
    pub fn is_zarr(folder: &std::path::Path) -> bool {
        ["zarr.json", ".zattrs", ".zgroup", ".zarray"]
            .iter()
            .any(|name| folder.join(name).is_file())
    }

    /// Opens the image in a folder. Reads metadata, and voxels only if values must be fitted into 16 bit.
    ///
    /// # Errors
    ///
    /// [`crate::SourceError::Open`] with a [`ZarrError`].
    #[cfg(not(target_family = "wasm"))]
    pub async fn open_folder(folder: &std::path::Path) -> Result<Self, crate::SourceError> {
        let name = folder.file_name().unwrap_or_default().to_string_lossy();
        let objects = Arc::new(crate::objects::FolderObjects::new(folder));
        let opened = Self::open(objects, &name).await;
        opened.map_err(|error| crate::SourceError::Open {
            source: Arc::new(error),
            location: folder.display().to_string(),
        })
    }

    /// Opens the image that some objects are; its name is made from `name`.
    ///
    /// # Errors
    ///
    /// [`ZarrError::NoImage`] if they are none, others as they occur.
    pub async fn open(objects: Arc<dyn Objects>, name: &str) -> Result<Self, ZarrError> {
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
    ) -> Result<Self, ZarrError> {
        let attributes = attributes(&*objects, "").await?;
        let attributes = attributes.ok_or_else(|| ZarrError::NoImage {
            location: objects.location(""),
        })?;
        let ome = metadata::ome(&attributes);
        let here = |refusal: Refusal| refusal.at(objects.location(""));
        let paths = metadata::paths(ome).map_err(here)?;
        let arrays = join_all(paths.iter().map(|path| array_of(&*objects, path))).await;
        let arrays: Vec<Array> = arrays.into_iter().collect::<Result<_, _>>()?;
        let rank = arrays.first().map_or(0, |array| array.shape.len());
        let mut image = Image::parse(ome, rank).map_err(here)?;
        let whole = { arrays.first() }.is_some_and(|array| array.number.is_whole());
        image.notes.extend(times(&image.axes, &arrays));
        let is_plain = whole && !image.is_labels && ome["omero"].is_null();
        if is_plain && lies_in_labels(&objects.folders()) {
            image.is_labels = true;
            let note = "it lies in a folder labels, so its values are taken for names of things";
            image.notes.push(note.to_owned());
        }
        let levels = arrays.into_iter().zip(&paths).map(|(array, path)| {
            let level = LevelArray::new(path, array, &image.axes);
            level.map_err(|refusal| refusal.at(objects.location(path)))
        });
        let mut levels: Vec<LevelArray> = levels.collect::<Result<_, _>>()?;
        let volume = volume(name, &image, &mut levels).map_err(here)?;
        let mut notes = std::mem::take(&mut image.notes);
        notes.extend(levels.iter().filter_map(LevelArray::note));
        let labels = labels(&*objects).await;
        if !labels.is_empty() {
            let first = &labels[0];
            let all = labels.join(", ");
            notes.push(format!("it has labels, which are images of their own: {all}; open one as IMAGE/labels/{first}"));
        }
        options.before_voxels(&*objects);
        let missing_for = options.missing_for;
        let stored = ZarrImage::new(objects, volume, levels, &image, missing_for).await?;
        notes.extend(stored.values().note());
        let piece = stored.piece_bytes();
        Ok(Self {
            stored: StoredSource::new(stored, piece, missing_for),
            notes,
        })
    }
}

impl VolumeSource for ZarrSource {
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

/// The JSON of an object; `None` if there is none.
async fn json(objects: &dyn Objects, key: &str) -> Result<Option<Value>, ZarrError> {
    let most = MOST_METADATA;
    let Some(text) = objects.read(key, Part::Whole { most }).await? else {
        return Ok(None);
    };
    let value = serde_json::from_slice(&text);
    let value = value.map_err(|error| Refusal::wrong(error).at(objects.location(key)))?;
    Ok(Some(value))
}

fn below(folder: &str, name: &str) -> String {
    match folder {
        "" => name.to_owned(),
        folder => format!("{folder}/{name}"),
    }
}

/// The attributes of a group, whatever its version; `None` if there is none.
async fn attributes(objects: &dyn Objects, folder: &str) -> Result<Option<Value>, ZarrError> {
    let key = below(folder, "zarr.json");
    if let Some(mut group) = json(objects, &key).await? {
        let is_image = metadata::ome(&group["attributes"])["multiscales"].is_array();
        if group["node_type"] == "array" && !is_image {
            let refusal = Refusal::Unsupported(
                "it is an array by itself; name the image (multiscales) that it is a level of"
                    .to_owned(),
            );
            return Err(refusal.at(objects.location(folder)));
        }
        // It may be no object at all.
        let attributes = group.get_mut("attributes").map(Value::take);
        return Ok(Some(attributes.unwrap_or_default()));
    }
    json(objects, &below(folder, ".zattrs")).await
}

/// An array's metadata, of either version.
async fn array_of(objects: &dyn Objects, path: &str) -> Result<Array, ZarrError> {
    let array = if let Some(json) = json(objects, &below(path, "zarr.json")).await? {
        Array::version_3(&json)
    } else if let Some(json) = json(objects, &below(path, ".zarray")).await? {
        Array::version_2(&json)
    } else {
        Err(Refusal::wrong("a level is listed, but is no array"))
    };
    array.map_err(|refusal| refusal.at(objects.location(path)))
}

/// What a user should know of times that are not shown.
fn times(axes: &[Axis], arrays: &[Array]) -> Option<String> {
    let time = axes.iter().position(|axis| *axis == Axis::T)?;
    let count = *arrays.first()?.shape.get(time)?;
    (count > 1).then(|| {
        format!("it has {count} times (axis t); the first is shown, and the others cannot be yet")
    })
}

/// Names of an image's labels. That they cannot be read is no reason not to show the image.
async fn labels(objects: &dyn Objects) -> Vec<String> {
    let Ok(Some(group)) = attributes(objects, "labels").await else {
        return Vec::new();
    };
    let names = metadata::ome(&group)["labels"]
        .as_array()
        .into_iter()
        .flatten();
    names
        .filter_map(Value::as_str)
        .take(20)
        .map(str::to_owned)
        .collect()
}

/// Whether folders, the last of them an image's own, are such that the image is one of labels: they are kept in `labels` of
/// the image that they belong to, with folders in between or without.
fn lies_in_labels(folders: &[String]) -> bool {
    let is_zarr = |name: &String| name.contains(".zarr");
    let Some((own, above)) = folders.split_last() else {
        return false;
    };
    match above.iter().rposition(is_zarr) {
        Some(image) => above[image + 1..].iter().any(|name| name == "labels"),
        None => above.last().is_some_and(|name| name == "labels") && !is_zarr(own),
    }
}

/// The volume that an image is.
fn volume(name: &str, image: &Image, levels: &mut [LevelArray]) -> Result<Volume, Refusal> {
    let refused = |reason: &str| Refusal::Unsupported(reason.to_owned());
    let finest = levels.first().ok_or_else(|| refused("it has no levels"))?;
    let volume = Volume::new(&volume_name(name), finest.extent(), image.voxel_nm);
    let mut volume = volume.map_err(|error| refused(&error.to_string()))?;
    if levels.len() > MAX_LEVELS {
        let count = levels.len();
        return Err(refused(&format!(
            "it has {count} levels, and {MAX_LEVELS} can be shown"
        )));
    }
    volume.dtype = match finest.number().bytes() {
        1 => Dtype::Uint8,
        _ => Dtype::Uint16,
    };
    if image.is_labels && finest.number().is_whole() {
        volume.kind = VoxelKind::Labels;
    }
    volume.origin_nm = image.origin_nm;
    volume.chunk = CHUNK;
    volume.channels = (0..finest.channels())
        .map(|index| match image.channels.get(index as usize) {
            Some(channel) if !channel.label.is_empty() => channel.label.clone(),
            _ => format!("channel {index}"),
        })
        .collect();
    let (kind, channels, extent) = (finest.number(), finest.channels(), finest.extent());
    let mut by = DVec3::ONE;
    volume.levels.clear();
    for (n, level) in levels.iter_mut().enumerate() {
        if level.number() != kind || level.channels() != channels {
            return Err(refused("its levels differ in type or channels"));
        }
        if level.extent().max_element() > MAX_EXTENT {
            let extent = level.extent();
            return Err(refused(&format!(
                "{extent} voxels are more than {MAX_EXTENT} along an axis"
            )));
        }
        // What the transformations say, or, where they say nothing, what the sizes do.
        let by_size = extent.as_dvec3() / level.extent().as_dvec3();
        let downsampling = image.downsampling[n].unwrap_or(by_size);
        if (downsampling * (1.0 + ROUNDED)).cmplt(by).any() {
            return Err(refused("its levels are not from fine to coarse"));
        }
        by = downsampling.max(by);
        // The corner of all voxels, while transformations place the middle of one.
        let corner = (image.first[n] - (by - 1.0) / 2.0) / by;
        volume.levels.push(level.place(corner, extent, by)?);
        volume.shifts_nm.push(level.off() * by * volume.voxel_nm);
    }
    leave_out_zero_shifts(&mut volume);
    Ok(volume)
}
