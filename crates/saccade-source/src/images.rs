//! Images that other programs wrote, of whichever format is at a place.

use std::sync::Arc;

use crate::VolumeSource;
use crate::objects::{Location, LocationError};
use crate::precomputed::{PrecomputedError, PrecomputedSource};
use crate::zarr::{ZarrError, ZarrSource};

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
    /// There is no image of a format that is known.
    #[error(
        "there is no image that can be opened: neither OME-Zarr (zarr.json, .zattrs) nor precomputed (info): {location}"
    )]
    None {
        /// Folder or address.
        location: String,
    },
}

/// Opens the image at a place. Nothing else is asked but the place.
///
/// # Errors
///
/// [`ImageError::None`] if there is none, [`ImageError::Denied`] if nothing may be read there, others if there is one that cannot be opened.
pub async fn open(location: &Location) -> Result<OpenImage, ImageError> {
    let (objects, name) = (location.objects()?, location.name());
    match ZarrSource::open(objects.clone(), &name).await {
        Ok(source) => {
            let notes = source.notes().to_vec();
            let source = Arc::new(source);
            return Ok(OpenImage { source, notes });
        }
        Err(ZarrError::NoImage { .. }) => {}
        Err(error) => return Err(error.into()),
    }
    match PrecomputedSource::open(objects.clone(), &name).await {
        Ok(source) => {
            let notes = source.notes().to_vec();
            let source = Arc::new(source);
            Ok(OpenImage { source, notes })
        }
        Err(PrecomputedError::NoVolume { .. }) => {
            let location = location.to_string();
            Err(match objects.denied() {
                Some(advice) => ImageError::Denied { advice, location },
                None => ImageError::None { location },
            })
        }
        Err(error) => Err(error.into()),
    }
}
