//! OME-Zarr, versions 0.4 and 0.5, as a stack: its finest level.

use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::{DVec3, UVec2, UVec3};
use saccade_archive::image::{GrayImage, ImageError};
use serde_json::Value;
use zarrs::array::chunk_cache::{ChunkCache, ChunkCacheDecodedLruSizeLimit};
use zarrs::array::{Array, CodecOptions};
use zarrs::filesystem::FilesystemStore;
use zarrs::storage::ReadableStorageTraits;

use super::{BoxError, Stack, StackError, StackInfo, check_inside, files};

/// Decoded chunks kept \[bytes\]: those of one section, mostly, are needed for the next one.
const CACHE_BYTES: u64 = 512 << 20;
/// Largest chunk, or shard of chunks, decoded \[bytes\].
const LARGEST_CHUNK: u64 = 1 << 30;

/// Which 16-bit values become the darkest and the brightest 8-bit ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// Becomes 1; so does all below.
    pub low: u16,
    /// Becomes 255; so does all above.
    pub high: u16,
}

impl Window {
    /// The 8-bit value, 1 to 255: 0 would mean that nothing was measured.
    pub fn apply(self, value: u16) -> u8 {
        let span = self.high.saturating_sub(self.low).max(1);
        let share = f32::from(value.saturating_sub(self.low)) / f32::from(span);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "1 to 255"
        )]
        let value = (1.5 + 254.0 * share.min(1.0)) as u8;
        value
    }
}

/// The finest level of an OME-Zarr image in a folder; of other axes than z, y, x the first entry.
pub struct ZarrStack {
    info: StackInfo,
    path: PathBuf,
    cache: ChunkCacheDecodedLruSizeLimit,
    /// Axes before z, y, x: time and channels.
    leading: usize,
    /// How 16-bit values become 8-bit ones; `None` if they are 8-bit.
    window: Option<Window>,
}

impl std::fmt::Debug for ZarrStack {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ZarrStack")
            .field("info", &self.info)
            .finish_non_exhaustive()
    }
}

impl ZarrStack {
    /// Opens an OME-Zarr image of 8 bit; of 16 bit only with a `window`.
    ///
    /// # Errors
    ///
    /// [`StackError::Read`], [`StackError::Zarr`]; [`StackError::Image`] for other data types.
    pub fn open(path: &Path, window: Option<Window>) -> Result<Self, StackError> {
        let wrong = |reason: &str| StackError::Zarr {
            source: reason.into(),
            path: path.to_owned(),
        };
        let multiscale = multiscale(path)?;
        let dataset = &multiscale["datasets"][0];
        let level = dataset["path"]
            .as_str()
            .ok_or_else(|| wrong("it names no level"))?;
        let folder = saccade_archive::acquisition::image_path(path, level)
            .ok_or_else(|| wrong("its first level lies outside"))?;

        let failed = |source: BoxError| StackError::Zarr {
            source,
            path: folder.clone(),
        };
        let store = FilesystemStore::new(&folder).map_err(|e| failed(e.into()))?;
        let store: Arc<dyn ReadableStorageTraits> = Arc::new(store);
        let array = Array::open(store, "/").map_err(|e| failed(e.into()))?;
        let depth = bits(&folder)?;
        let window = match (depth, window) {
            (Some(8), _) => None,
            (Some(16), Some(window)) => Some(window),
            (bits, _) => {
                let source = match bits {
                    Some(bits) => ImageError::Depth { bits, volume: 8 },
                    None => ImageError::Unsupported {
                        what: "values that are no unsigned integers".to_owned(),
                    },
                };
                return Err(StackError::Image {
                    source,
                    path: folder,
                });
            }
        };
        let shape = array.shape();
        let &[.., z, y, x] = shape else {
            return Err(wrong("it has fewer than three axes"));
        };
        let names: Vec<&str> = axes(&multiscale)
            .map(|axis| axis["name"].as_str().unwrap_or(""))
            .collect();
        if !names.is_empty() && !names.ends_with(&["z", "y", "x"]) {
            return Err(wrong("its last axes are not z, y, x"));
        }
        let side = |n: u64| u32::try_from(n).ok().filter(|n| *n > 0);
        let extent = side(x).zip(side(y)).zip(side(z));
        let ((x, y), z) = extent.ok_or_else(|| wrong("an axis is empty, or far too long"))?;
        // Chunks are decoded whole, and those that are not there are as large.
        let chunk = array.chunk_shape(&vec![0; shape.len()]);
        let chunk = chunk.map_err(|e| failed(e.into()))?;
        let voxel = if window.is_some() { 2 } else { 1 };
        let bytes = { chunk.iter() }.try_fold(voxel, |n: u64, edge| n.checked_mul(edge.get()));
        if bytes.is_none_or(|bytes| bytes > LARGEST_CHUNK) {
            return Err(wrong("its chunks are of more than 1 GiB"));
        }
        let info = StackInfo {
            name: files::volume_name(path),
            extent: UVec3::new(x, y, z),
            voxel_nm: voxel_nm(&multiscale),
        };
        let leading = shape.len() - 3;
        let cache = ChunkCacheDecodedLruSizeLimit::new(Arc::new(array), CACHE_BYTES);
        Ok(Self {
            info,
            path: folder,
            cache,
            leading,
            window,
        })
    }
}

impl Stack for ZarrStack {
    fn info(&self) -> &StackInfo {
        &self.info
    }

    fn region(&self, section: u32, min: UVec2, size: UVec2) -> Result<GrayImage, StackError> {
        check_inside(&self.info, section, min, size)?;
        let range = |from: u32, len: u32| u64::from(from)..u64::from(from) + u64::from(len);
        let mut subset = vec![0..1; self.leading];
        subset.extend([
            range(section, 1),
            range(min.y, size.y),
            range(min.x, size.x),
        ]);
        let options = CodecOptions::default();
        let read = || match self.window {
            None => self
                .cache
                .retrieve_array_subset::<Vec<u8>>(&subset, &options),
            Some(window) => self
                .cache
                .retrieve_array_subset::<Vec<u16>>(&subset, &options)
                .map(|values| {
                    values
                        .into_iter()
                        .map(|value| window.apply(value))
                        .collect()
                }),
        };
        let failed = |source: BoxError| StackError::Zarr {
            source,
            path: self.path.clone(),
        };
        // The library panics where the index of a shard leads out of what can be counted.
        let voxels = match catch_unwind(AssertUnwindSafe(read)) {
            Ok(read) => read.map_err(|e| failed(e.into()))?,
            Err(_) => return Err(failed("a chunk of it is damaged".into())),
        };
        Ok(GrayImage::new(size.x, size.y, voxels))
    }
}

fn json(path: &Path) -> Result<Option<Value>, StackError> {
    let text = match fs::read(path) {
        Ok(text) => text,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(source) => {
            return Err(StackError::Read {
                source,
                path: path.to_owned(),
            });
        }
    };
    let failed = |e: serde_json::Error| StackError::Zarr {
        source: e.into(),
        path: path.to_owned(),
    };
    serde_json::from_slice(&text).map(Some).map_err(failed)
}

/// The first image of the group, wherever its version keeps it.
fn multiscale(path: &Path) -> Result<Value, StackError> {
    let v3 =
        json(&path.join("zarr.json"))?.map(|v| v["attributes"]["ome"]["multiscales"][0].clone());
    let v2 = json(&path.join(".zattrs"))?.map(|v| v["multiscales"][0].clone());
    let image = [v3, v2].into_iter().flatten().find(Value::is_object);
    image.ok_or_else(|| StackError::Zarr {
        source: "it has no `multiscales`, so it is no OME-Zarr image; name the image in it".into(),
        path: path.to_owned(),
    })
}

/// Bits of an unsigned integer type; `None` for other types.
fn bits(array: &Path) -> Result<Option<u32>, StackError> {
    let v3 = json(&array.join("zarr.json"))?.map(|v| v["data_type"].clone());
    let v2 = json(&array.join(".zarray"))?.map(|v| v["dtype"].clone());
    let name = [v3, v2]
        .into_iter()
        .flatten()
        .find_map(|v| v.as_str().map(str::to_owned));
    Ok(match name.as_deref() {
        Some("uint8" | "|u1" | "<u1" | ">u1") => Some(8),
        Some("uint16" | "<u2" | ">u2") => Some(16),
        Some("uint32" | "<u4" | ">u4") => Some(32),
        Some("uint64" | "<u8" | ">u8") => Some(64),
        _ => None,
    })
}

fn axes(multiscale: &Value) -> impl Iterator<Item = &Value> {
    multiscale["axes"].as_array().into_iter().flatten()
}

/// Voxel size of the finest level \[nm\], if units are given.
fn voxel_nm(multiscale: &Value) -> Option<DVec3> {
    let scale_of = |transforms: &Value| -> Option<Vec<f64>> {
        let scales = transforms
            .as_array()?
            .iter()
            .find_map(|t| t["scale"].as_array())?;
        scales.iter().map(Value::as_f64).collect()
    };
    let level = scale_of(&multiscale["datasets"][0]["coordinateTransformations"])?;
    // A second scale may apply to all levels.
    let all = scale_of(&multiscale["coordinateTransformations"]);
    let units: Vec<Option<f64>> = axes(multiscale)
        .map(|axis| nm_per(axis["unit"].as_str()?))
        .collect();
    let size = |from_last: usize| -> Option<f64> {
        let n = units.len().checked_sub(from_last)?;
        let all = all.as_ref().map_or(Some(1.0), |all| all.get(n).copied())?;
        Some(*level.get(n)? * all * (*units.get(n)?)?)
    };
    let size = DVec3::new(size(1)?, size(2)?, size(3)?);
    (size.is_finite() && size.min_element() > 0.0).then_some(size)
}

fn nm_per(unit: &str) -> Option<f64> {
    Some(match unit {
        "angstrom" => 0.1,
        "nanometer" => 1.0,
        "micrometer" => 1e3,
        "millimeter" => 1e6,
        "meter" => 1e9,
        _ => return None,
    })
}
