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
const OTHERS: [(&str, &str); 4] = [
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
pub async fn open_with(
    location: &Location,
    options: ImageOptions,
) -> Result<OpenImage, ImageError> {
    let (objects, name) = (location.objects()?, location.name());
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
            let location = location.to_string();
            if let Some(advice) = objects.denied() {
                return Err(ImageError::Denied { advice, location });
            }
            Err(match other(&*objects).await {
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
        ] {
            std::fs::write(folder.path().join(name), "{}").unwrap();
            let refused = refused().await;
            assert!(refused.contains(words), "{refused}");
            std::fs::remove_file(folder.path().join(name)).unwrap();
        }
    }
}
