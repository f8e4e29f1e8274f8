//! Images that other programs wrote, of whichever format is at a place.

use std::sync::Arc;
use std::time::Duration;

use crate::VolumeSource;
use crate::objects::{Location, LocationError, Objects, Part};
use crate::precomputed::{PrecomputedError, PrecomputedSource};
use crate::zarr::{ZarrError, ZarrSource};

/// How an image is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageOptions {
    /// Whether voxels that are forbidden count as not stored where the store forbids whatever it does not have; otherwise they are
    /// an error ([`ObjectError::Unclear`](crate::objects::ObjectError::Unclear)).
    pub forbidden_is_missing: bool,
    /// What is not stored is not looked for again for so long.
    pub missing_for: Duration,
}

impl Default for ImageOptions {
    fn default() -> Self {
        Self {
            forbidden_is_missing: true,
            missing_for: Duration::from_secs(5),
        }
    }
}

impl ImageOptions {
    /// To be called between what describes the image, of which much may be missing, and its voxels.
    pub(crate) fn before_voxels(self, objects: &dyn Objects) {
        if !self.forbidden_is_missing {
            objects.stop_guessing();
        }
    }
}

/// An image that is open.
pub struct OpenImage {
    /// Its voxels.
    pub source: Arc<dyn VolumeSource>,
    /// What a user should know of how it is shown, in sentences.
    pub notes: Vec<String>,
}

/// Why no image is open.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
    /// The place cannot be reached as it is given.
    #[error(transparent)]
    Location(#[from] LocationError),
    /// An OME-Zarr image that cannot be opened.
    #[error(transparent)]
    Zarr(#[from] ZarrError),
    /// A precomputed volume that cannot be opened.
    #[error(transparent)]
    Precomputed(#[from] PrecomputedError),
    /// Whatever was asked for was forbidden.
    #[error(
        "whether there is an image is not known, as access to all of it is denied; {advice}: {location}"
    )]
    Denied {
        /// How to mend it.
        advice: &'static str,
        /// Folder or address.
        location: String,
    },
    /// Something else is there.
    #[error("this is {what}: {location}")]
    Other {
        /// What it is, and what to do about it.
        what: &'static str,
        /// Folder or address.
        location: String,
    },
    /// There is no image of a format that is known.
    #[error(
        "there is no image that can be opened: neither OME-Zarr (zarr.json, .zattrs) nor precomputed (info): {location}"
    )]
    None {
        /// Folder or address.
        location: String,
    },
}

/// What else there may be, by an object that it has.
const OTHERS: [(&str, &str); 6] = [
    (
        "attributes.json",
        "N5, which is not read; convert it to OME-Zarr",
    ),
    (
        ".zarray",
        "a Zarr array by itself; name the image (multiscales) that it is a level of",
    ),
    (
        ".zgroup",
        "a Zarr group without an image (multiscales); name the image in it",
    ),
    (
        "manifest.ocdbt",
        "an OCDBT database, which is not read; copy its content into files",
    ),
    ("refs/branch.main/ref.json", ICECHUNK),
    // Of its first version.
    ("refs/branch.main/ZZZZZZZZ.json", ICECHUNK),
];
const ICECHUNK: &str =
    "an Icechunk repository, which is not read; copy its arrays into a Zarr group of files";
/// What a file is, by the end of its name, which says most of them; those that no other fits last.
#[cfg(not(target_family = "wasm"))]
const FILES: [(&str, &str); 8] = [
    (
        ".zip",
        "a zip file, which is not read; unpack it, and name the folder",
    ),
    (
        ".nii",
        "a NIfTI file, which is not read; convert it to OME-Zarr",
    ),
    (
        ".nii.gz",
        "a NIfTI file, which is not read; convert it to OME-Zarr",
    ),
    (
        ".dzi",
        "a Deep Zoom image, which is not read; convert it to OME-Zarr",
    ),
    (
        ".sqlite",
        "a database; if it is the catalog of an archive, name the archive's folder",
    ),
    (
        ".tif",
        "a TIFF file; `saccade demo --input` shows stacks of them, else convert it to OME-Zarr",
    ),
    (
        ".tiff",
        "a TIFF file; `saccade demo --input` shows stacks of them, else convert it to OME-Zarr",
    ),
    (
        "",
        "a file, while archives and the images that are read (OME-Zarr, precomputed) are folders; convert it to OME-Zarr",
    ),
];
/// Longest object that is looked at for that \[bytes\].
const MOST: u64 = 16 << 20;

async fn other(objects: &dyn Objects) -> Option<&'static str> {
    for (key, what) in OTHERS {
        let part = Part::Whole { most: MOST };
        // Whatever fails here says nothing.
        if let Ok(Some(_)) = objects.read(key, part).await {
            return Some(what);
        }
    }
    None
}

/// Whether what is at a path is known as something that is not read, of which opening it as an image tells.
#[cfg(not(target_family = "wasm"))]
pub fn is_other(path: &std::path::Path) -> bool {
    path.is_file() || OTHERS.iter().any(|(key, _)| path.join(key).is_file())
}

/// What is at a path, if that is a file.
#[cfg(not(target_family = "wasm"))]
fn file(location: &Location) -> Option<&'static str> {
    let Location::Folder(path) = location else {
        return None;
    };
    let name = path.file_name()?.to_string_lossy().to_ascii_lowercase();
    let kind = { FILES.iter() }.find(|(end, _)| name.ends_with(end))?;
    path.is_file().then_some(kind.1)
}

#[cfg(target_family = "wasm")]
fn file(_: &Location) -> Option<&'static str> {
    None
}

/// Opens the image at a place. Nothing else is asked but the place.
///
/// # Errors
///
/// [`ImageError::None`] if there is none, [`ImageError::Other`] if there is something else, [`ImageError::Denied`] if nothing may be
/// read there, others if there is one that cannot be opened.
pub async fn open(location: &Location) -> Result<OpenImage, ImageError> {
    open_with(location, ImageOptions::default()).await
}

/// Like [`open`], with options.
///
/// # Errors
///
/// As [`open`].
pub async fn open_with(place: &Location, options: ImageOptions) -> Result<OpenImage, ImageError> {
    let (objects, name) = (place.objects()?, place.name());
    match ZarrSource::open_with(objects.clone(), &name, options).await {
        Ok(source) => {
            let notes = source.notes().to_vec();
            let source = Arc::new(source);
            return Ok(OpenImage { source, notes });
        }
        Err(ZarrError::NoImage { .. }) => {}
        Err(error) => return Err(error.into()),
    }
    match PrecomputedSource::open_with(objects.clone(), &name, options).await {
        Ok(source) => {
            let notes = source.notes().to_vec();
            let source = Arc::new(source);
            Ok(OpenImage { source, notes })
        }
        Err(PrecomputedError::NoVolume { .. }) => {
            let location = place.to_string();
            if let Some(advice) = objects.denied() {
                return Err(ImageError::Denied { advice, location });
            }
            let what = match file(place) {
                None => other(&*objects).await,
                file => file,
            };
            Err(match what {
                Some(what) => ImageError::Other { what, location },
                None => ImageError::None { location },
            })
        }
        Err(error) => Err(error.into()),
    }
}

#[cfg(all(test, not(target_family = "wasm")))]
mod tests {
    use super::*;

    #[tokio::test]
    async fn what_else_there_is_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let refused = async || {
            let location = Location::Folder(folder.path().to_owned());
            open(&location).await.err().unwrap().to_string()
        };
        assert!(refused().await.contains("neither OME-Zarr"));
        for (name, words) in [
            (".zgroup", "Zarr group without"),
            (".zarray", "array by itself"),
            ("attributes.json", "is N5"),
            ("manifest.ocdbt", "OCDBT"),
            ("refs/branch.main/ref.json", "Icechunk"),
        ] {
            assert!(!is_other(folder.path()));
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(&path, "{}").unwrap();
            let refused = refused().await;
            assert!(refused.contains(words), "{refused}");
            assert!(is_other(folder.path()));
            std::fs::remove_file(path).unwrap();
        }
        let array = r#"{"zarr_format": 3, "node_type": "array", "attributes": {}}"#;
        std::fs::write(folder.path().join("zarr.json"), array).unwrap();
        let refused = refused().await;
        assert!(refused.contains("array by itself"), "{refused}");
    }

    #[tokio::test]
    async fn files_are_told_by_what_they_are() {
        let folder = tempfile::tempdir().unwrap();
        for (name, words) in [
            ("image.ome.zarr.zip", "unpack it"),
            ("brain.nii.gz", "NIfTI"),
            ("BRAIN.NII", "NIfTI"),
            ("stack.ome.tif", "saccade demo --input"),
            ("catalog.sqlite", "the archive's folder"),
            ("photo.czi", "are folders; convert it"),
        ] {
            let file = folder.path().join(name);
            std::fs::write(&file, "something").unwrap();
            let location = Location::Folder(file.clone());
            let refused = open(&location).await.err().unwrap().to_string();
            assert!(refused.contains(words), "{refused}");
            assert!(is_other(&file));
        }
    }
}
