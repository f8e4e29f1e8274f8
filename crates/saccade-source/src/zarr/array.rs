//! One level: an array of a few axes, read as boxes of voxels.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::UVec3;
use saccade_core::volume::Dtype;
use saccade_core::voxel_box::VoxelBox;
use zarrs::array::chunk_cache::{ChunkCache, ChunkCacheDecodedLruSizeLimit};
use zarrs::array::{Array, CodecOptions};
use zarrs::filesystem::FilesystemStore;
use zarrs::storage::ReadableStorageTraits;

use super::metadata::{Axis, json};
use super::{ZarrError, padded};

/// Chunks of a file that are larger than this when decoded are refused \[bytes\].
const MOST_CHUNK: u64 = 1 << 30;

/// How values are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stored {
    Uint8,
    Int8,
    Uint16,
    Int16,
}

/// What an array's metadata say.
#[derive(Debug)]
pub(super) struct Metadata {
    /// Slowest axis first.
    pub(super) shape: Vec<u64>,
    /// Of what is decoded in one piece.
    chunk: Vec<u64>,
    dtype: String,
}

impl Metadata {
    /// Reads them, of either version.
    pub(super) fn read(folder: &Path) -> Result<Self, ZarrError> {
        let wrong = |reason: &str| ZarrError::Metadata {
            reason: reason.to_owned(),
            path: folder.to_owned(),
        };
        let numbers = |value: &serde_json::Value| -> Option<Vec<u64>> {
            value
                .as_array()?
                .iter()
                .map(serde_json::Value::as_u64)
                .collect()
        };
        let (shape, chunk, dtype) = if let Some(array) = json(&folder.join("zarr.json"))? {
            let chunk = &array["chunk_grid"]["configuration"]["chunk_shape"];
            let sharding = array["codecs"].as_array().into_iter().flatten();
            let inner = sharding
                .filter(|codec| codec["name"] == "sharding_indexed")
                .find_map(|codec| numbers(&codec["configuration"]["chunk_shape"]));
            let chunk = inner.or_else(|| numbers(chunk));
            (numbers(&array["shape"]), chunk, array["data_type"].clone())
        } else if let Some(array) = json(&folder.join(".zarray"))? {
            let (shape, chunk) = (numbers(&array["shape"]), numbers(&array["chunks"]));
            (shape, chunk, array["dtype"].clone())
        } else {
            return Err(wrong("a level is listed, but is no array"));
        };
        let dtype = match dtype.as_str() {
            Some(name) => name.to_owned(),
            None => dtype.to_string(),
        };
        let shape = shape.ok_or_else(|| wrong("it has no shape"))?;
        let chunk = chunk.ok_or_else(|| wrong("it has no chunk shape"))?;
        if shape.len() != chunk.len() || shape.contains(&0) || chunk.contains(&0) {
            return Err(wrong("its shape and that of its chunks do not fit"));
        }
        Ok(Self {
            shape,
            chunk,
            dtype,
        })
    }

    fn stored(&self, folder: &Path) -> Result<Stored, ZarrError> {
        Ok(match self.dtype.as_str() {
            "uint8" | "|u1" | "<u1" | ">u1" => Stored::Uint8,
            "int8" | "|i1" | "<i1" | ">i1" => Stored::Int8,
            "uint16" | "<u2" | ">u2" => Stored::Uint16,
            "int16" | "<i2" | ">i2" => Stored::Int16,
            other => {
                return Err(ZarrError::Unsupported {
                    reason: format!(
                        "its values are {other}; integers of 8 and 16 bit are shown, others would lose \
                         what nobody could see: convert them"
                    ),
                    path: folder.to_owned(),
                });
            }
        })
    }
}

/// A level of an image.
pub(super) struct LevelArray {
    path: super::ArrayPath,
    axes: Vec<Axis>,
    extent: UVec3,
    channels: u32,
    stored: Stored,
    cache: ChunkCacheDecodedLruSizeLimit,
}

impl std::fmt::Debug for LevelArray {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("LevelArray")
            .field("path", &self.path)
            .finish_non_exhaustive()
    }
}

impl LevelArray {
    /// Opens the array in a folder, whose axes are known. Keeps decoded chunks of up to `cache` bytes.
    pub(super) fn open(folder: &Path, axes: &[Axis], cache: u64) -> Result<Self, ZarrError> {
        let metadata = Metadata::read(folder)?;
        let wrong = |reason: String| ZarrError::Metadata {
            reason,
            path: folder.to_owned(),
        };
        if metadata.shape.len() != axes.len() {
            let (got, named) = (metadata.shape.len(), axes.len());
            return Err(wrong(format!("it has {got} axes, and {named} have names")));
        }
        let stored = metadata.stored(folder)?;
        let bytes = match stored {
            Stored::Uint8 | Stored::Int8 => 1,
            Stored::Uint16 | Stored::Int16 => 2,
        };
        let mut decoded = metadata.chunk.iter();
        let decoded = decoded.try_fold(bytes, |product: u64, n| product.checked_mul(*n));
        if decoded.is_none_or(|decoded| decoded > MOST_CHUNK) {
            let chunk = &metadata.chunk;
            return Err(wrong(format!(
                "its chunks of {chunk:?} values are too large to decode"
            )));
        }
        let mut extent = UVec3::ONE;
        let mut channels = 1;
        for (axis, &length) in axes.iter().zip(&metadata.shape) {
            let length = u32::try_from(length);
            let length = length.map_err(|_| wrong("an axis is far too long".to_owned()))?;
            match axis {
                Axis::T => {}
                Axis::C => channels = length,
                Axis::Space(axis) => extent[*axis] = length,
            }
        }
        let failed = |source: Box<dyn std::error::Error + Send + Sync>| ZarrError::Array {
            source,
            path: folder.to_owned(),
        };
        let store = FilesystemStore::new(folder).map_err(|e| failed(e.into()))?;
        let store: Arc<dyn ReadableStorageTraits> = Arc::new(store);
        let array = Array::open(store, "/").map_err(|e| failed(e.into()))?;
        Ok(Self {
            path: folder.to_owned(),
            axes: axes.to_vec(),
            extent,
            channels,
            stored,
            cache: ChunkCacheDecodedLruSizeLimit::new(Arc::new(array), cache),
        })
    }

    pub(super) fn path(&self) -> &PathBuf {
        &self.path
    }

    /// Size \[voxels\].
    pub(super) fn extent(&self) -> UVec3 {
        self.extent
    }

    pub(super) fn channels(&self) -> u32 {
        self.channels
    }

    /// Type of the voxels that [`Self::read`] gives.
    pub(super) fn dtype(&self) -> Dtype {
        match self.stored {
            Stored::Uint8 | Stored::Int8 => Dtype::Uint8,
            Stored::Uint16 | Stored::Int16 => Dtype::Uint16,
        }
    }

    /// A chunk of `size`, x fastest, little-endian, with the voxels of `inside` and 0 beyond.
    pub(super) fn read(
        &self,
        channel: u32,
        inside: VoxelBox,
        size: UVec3,
    ) -> Result<Vec<u8>, ZarrError> {
        let range = |from: u32, to: u32| u64::from(from)..u64::from(to);
        let subset = self.axes.iter().map(|axis| match axis {
            Axis::T => 0..1,
            Axis::C => range(channel, channel + 1),
            Axis::Space(axis) => range(inside.min[*axis], inside.max[*axis]),
        });
        let subset: Vec<Range<u64>> = subset.collect();
        let options = CodecOptions::default();
        let subset = &subset[..];
        macro_rules! values {
            ($type:ty) => {
                self.cache
                    .retrieve_array_subset::<Vec<$type>>(&subset, &options)
            };
        }
        let bytes = match self.stored {
            Stored::Uint8 => values!(u8),
            Stored::Int8 => values!(i8).map(|values| {
                let up = values.into_iter().map(|value| value.cast_unsigned() ^ 0x80);
                up.collect()
            }),
            Stored::Uint16 => values!(u16).map(|values| to_bytes(&values)),
            Stored::Int16 => values!(i16).map(|values| {
                let up = values
                    .into_iter()
                    .map(|value| value.cast_unsigned() ^ 0x8000);
                to_bytes(&up.collect::<Vec<u16>>())
            }),
        };
        let bytes = bytes.map_err(|error| ZarrError::Array {
            source: error.into(),
            path: self.path.clone(),
        })?;
        Ok(self.arranged(&bytes, inside, size))
    }

    /// Voxels of a box in the order of the array's axes, as a chunk in the order of ours.
    fn arranged(&self, values: &[u8], inside: VoxelBox, size: UVec3) -> Vec<u8> {
        let width = self.dtype().bytes();
        let (mut chunk, chunk_width, chunk_height) = padded(size, inside, width);
        // Values between neighbours along x, y, z.
        let mut strides = [0; 3];
        let mut stride = 1;
        for axis in self.axes.iter().rev() {
            if let Axis::Space(axis) = axis {
                strides[*axis] = stride;
                stride *= inside.size()[*axis] as usize;
            }
        }
        let [nx, ny, nz] = inside.size().to_array().map(|n| n as usize);
        for z in 0..nz {
            for y in 0..ny {
                let from = z * strides[2] + y * strides[1];
                let to = (z * chunk_height + y) * chunk_width * width;
                let row = &mut chunk[to..][..nx * width];
                if strides[0] == 1 {
                    row.copy_from_slice(&values[from * width..][..nx * width]);
                } else {
                    for (x, voxel) in row.chunks_exact_mut(width).enumerate() {
                        voxel.copy_from_slice(&values[(from + x * strides[0]) * width..][..width]);
                    }
                }
            }
        }
        chunk
    }
}

fn to_bytes(values: &[u16]) -> Vec<u8> {
    values
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect()
}
