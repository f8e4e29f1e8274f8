//! What the metadata of a group say of its image.

use std::path::{Component, Path};

use glam::DVec3;
use serde_json::Value;

use super::ZarrError;

/// Metadata files larger than this are not read \[bytes\].
const MOST_METADATA: u64 = 16 << 20;

/// What an axis of an array is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Axis {
    /// Time: the first is shown.
    T,
    /// Channel.
    C,
    /// Space: 0 for x, 1 for y, 2 for z.
    Space(usize),
}

/// An image of several levels.
#[derive(Debug)]
pub(super) struct Image {
    /// Of its arrays, slowest first.
    pub(super) axes: Vec<Axis>,
    /// Voxel size of the finest level \[nm\].
    pub(super) voxel_nm: DVec3,
    /// Levels, finest first.
    pub(super) datasets: Vec<Dataset>,
    /// Names of channels, as far as they have any.
    pub(super) channels: Vec<String>,
}

/// A level.
#[derive(Debug)]
pub(super) struct Dataset {
    /// Folder of its array, below the image's.
    pub(super) path: String,
    /// Finest voxels per voxel, if transformations tell.
    pub(super) downsampling: Option<DVec3>,
}

/// JSON of a file; `None` if there is no such file.
pub(super) fn json(path: &Path) -> Result<Option<Value>, ZarrError> {
    let failed = |source| ZarrError::Read {
        source,
        path: path.to_owned(),
    };
    let size = match std::fs::metadata(path) {
        Ok(metadata) => metadata.len(),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(failed(error)),
    };
    let wrong = |reason: String| ZarrError::Metadata {
        reason,
        path: path.to_owned(),
    };
    if size > MOST_METADATA {
        return Err(wrong(format!("{size} bytes are no metadata")));
    }
    let text = std::fs::read(path).map_err(failed)?;
    let value = serde_json::from_slice(&text).map_err(|error| wrong(error.to_string()))?;
    Ok(Some(value))
}

/// The attributes of a group, whatever its version.
fn attributes(folder: &Path) -> Result<Value, ZarrError> {
    if let Some(group) = json(&folder.join("zarr.json"))? {
        let attributes = &group["attributes"];
        // Version 0.5 has a name space of its own.
        let ome = &attributes["ome"];
        return Ok(if ome.is_object() {
            ome.clone()
        } else {
            attributes.clone()
        });
    }
    let attributes = json(&folder.join(".zattrs"))?;
    attributes.ok_or_else(|| ZarrError::Unsupported {
        reason: "there is neither zarr.json nor .zattrs, so it is no OME-Zarr image".to_owned(),
        path: folder.to_owned(),
    })
}

impl Image {
    /// Reads the metadata of the image in a folder.
    pub(super) fn read(folder: &Path) -> Result<Self, ZarrError> {
        let attributes = attributes(folder)?;
        let refused = |reason: &str| ZarrError::Unsupported {
            reason: reason.to_owned(),
            path: folder.to_owned(),
        };
        let wrong = |reason: &str| ZarrError::Metadata {
            reason: reason.to_owned(),
            path: folder.to_owned(),
        };
        if attributes["plate"].is_object() {
            return Err(refused(
                "it is a plate of many images; name one of them, as in PLATE/A/1/0",
            ));
        }
        if attributes["well"].is_object() {
            return Err(refused(
                "it is a well of several images; name one of them, as in WELL/0",
            ));
        }
        if !attributes["bioformats2raw.layout"].is_null() && attributes["multiscales"].is_null() {
            return Err(refused(
                "it is a collection of images; name one of them, as in COLLECTION/0",
            ));
        }
        let multiscale = &attributes["multiscales"][0];
        if !multiscale.is_object() {
            return Err(refused(
                "it has no multiscales, so it is no OME-Zarr image; name the image in it",
            ));
        }
        let datasets = multiscale["datasets"].as_array();
        let datasets = datasets.filter(|list| !list.is_empty());
        let datasets = datasets.ok_or_else(|| wrong("it lists no levels (datasets)"))?;
        let paths = datasets.iter().map(|dataset| dataset["path"].as_str());
        let paths: Option<Vec<&str>> = paths.collect();
        let paths = paths.ok_or_else(|| wrong("a level (dataset) has no path"))?;
        if let Some(outside) = paths.iter().find(|path| !is_inside(path)) {
            return Err(wrong(&format!(
                "the level {outside:?} lies outside of the image"
            )));
        }
        let axes = axes(folder, multiscale, paths[0])?;
        let scales = datasets
            .iter()
            .map(|dataset| scale(&axes, &dataset["coordinateTransformations"]));
        let scales: Vec<Option<DVec3>> = scales.collect();
        let of_all = scale(&axes, &multiscale["coordinateTransformations"]).unwrap_or(DVec3::ONE);
        let finest = scales[0].unwrap_or(DVec3::ONE);
        let units = units(multiscale, &axes);
        if scales[0].is_none() || units.is_none() {
            let path = folder.display();
            log::warn!(
                "the image does not say how large its voxels are; taken for 1 micrometer where it does not: {path}"
            );
        }
        let mut voxel_nm = finest * of_all * units.unwrap_or(DVec3::splat(1e3));
        if !axes.contains(&Axis::Space(2)) {
            voxel_nm.z = voxel_nm.x;
        }
        if !(voxel_nm.is_finite() && voxel_nm.min_element() > 0.0) {
            return Err(wrong("its voxels have no size (coordinateTransformations)"));
        }
        let datasets = paths.iter().zip(scales).map(|(path, scale)| Dataset {
            path: (*path).to_owned(),
            downsampling: scale.map(|scale| scale / finest).filter(|d| d.is_finite()),
        });
        let channels = attributes["omero"]["channels"].as_array();
        let channels = channels.into_iter().flatten();
        let label = |channel: &Value| channel["label"].as_str().unwrap_or_default().to_owned();
        Ok(Self {
            voxel_nm,
            datasets: datasets.collect(),
            channels: channels.map(label).collect(),
            axes,
        })
    }
}

/// Whether a level's path stays below its image's folder.
fn is_inside(path: &str) -> bool {
    let mut parts = Path::new(path).components();
    parts.all(|part| matches!(part, Component::Normal(_) | Component::CurDir))
}

/// Axes by name; before version 0.3 they had none, and were t, c, z, y, x.
fn axes(folder: &Path, multiscale: &Value, first: &str) -> Result<Vec<Axis>, ZarrError> {
    let wrong = |reason: String| ZarrError::Metadata {
        reason,
        path: folder.to_owned(),
    };
    let named = multiscale["axes"].as_array();
    let names: Vec<String> = match named {
        Some(axes) => {
            // Version 0.3 had plain names.
            let name = |axis: &Value| {
                axis.as_str()
                    .or(axis["name"].as_str())
                    .map(str::to_lowercase)
            };
            let names: Option<Vec<_>> = axes.iter().map(name).collect();
            names.ok_or_else(|| wrong("an axis has no name".to_owned()))?
        }
        None => {
            let array = super::array::Metadata::read(&folder.join(first))?;
            let skip = 5_usize.checked_sub(array.shape.len());
            let skip = skip.ok_or_else(|| wrong("more than five axes have no names".to_owned()))?;
            ["t", "c", "z", "y", "x"][skip..]
                .iter()
                .map(|name| (*name).to_owned())
                .collect()
        }
    };
    let mut axes = Vec::new();
    for name in &names {
        let axis = match name.as_str() {
            "t" => Axis::T,
            "c" => Axis::C,
            "x" => Axis::Space(0),
            "y" => Axis::Space(1),
            "z" => Axis::Space(2),
            _ => {
                return Err(ZarrError::Unsupported {
                    reason: format!("it has an axis {name:?}; t, c, z, y and x are known"),
                    path: folder.to_owned(),
                });
            }
        };
        if axes.contains(&axis) {
            return Err(wrong(format!("it has two axes {name:?}")));
        }
        axes.push(axis);
    }
    if !(axes.contains(&Axis::Space(0)) && axes.contains(&Axis::Space(1))) {
        return Err(wrong("it has no axes x and y".to_owned()));
    }
    Ok(axes)
}

/// The scale of a list of transformations, x, y, z; 1 for an axis that there is not.
fn scale(axes: &[Axis], transformations: &Value) -> Option<DVec3> {
    let scale = { transformations.as_array()?.iter() }.find_map(|t| t["scale"].as_array())?;
    let mut result = DVec3::ONE;
    for (axis, value) in axes.iter().zip(scale) {
        if let Axis::Space(axis) = axis {
            result[*axis] = value.as_f64()?;
        }
    }
    (scale.len() == axes.len()).then_some(result)
}

/// Nanometres in the units of x, y, z; `None` where one has none.
fn units(multiscale: &Value, axes: &[Axis]) -> Option<DVec3> {
    let named = multiscale["axes"].as_array()?;
    let mut units: [Option<f64>; 3] = [None; 3];
    for (axis, value) in axes.iter().zip(named) {
        if let Axis::Space(axis) = axis {
            units[*axis] = Some(nm_per(value["unit"].as_str()?)?);
        }
    }
    let [x, y, z] = units;
    Some(DVec3::new(x?, y?, z.or(x)?))
}

fn nm_per(unit: &str) -> Option<f64> {
    Some(match unit {
        "angstrom" => 0.1,
        "picometer" => 1e-3,
        "nanometer" => 1.0,
        "micrometer" | "micron" => 1e3,
        "millimeter" => 1e6,
        "centimeter" => 1e7,
        "meter" => 1e9,
        _ => return None,
    })
}
