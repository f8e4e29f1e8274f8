use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use super::{HttpObjects, Objects};

/// Where an image is that somebody else wrote.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Location {
    /// A folder.
    #[cfg(not(target_family = "wasm"))]
    Folder(std::path::PathBuf),
    /// An address of HTTP; also for public buckets of Google's, as `gs://bucket/image`.
    Http(String),
    /// `s3://bucket/prefix`.
    #[cfg(not(target_family = "wasm"))]
    S3(saccade_archive::storage::BucketLocation),
}

/// Why a text says no place.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is no place of an image: {reason}")]
pub struct LocationError {
    text: String,
    reason: String,
}

impl LocationError {
    pub(super) fn new(text: &str, reason: impl ToString) -> Self {
        Self {
            text: text.to_owned(),
            reason: reason.to_string(),
        }
    }
}

impl FromStr for Location {
    type Err = LocationError;

    fn from_str(text: &str) -> Result<Self, LocationError> {
        // As Neuroglancer writes them.
        let kinds = ["precomputed://", "zarr://", "zarr2://", "zarr3://"];
        let place = kinds.iter().find_map(|kind| text.strip_prefix(kind));
        let place = place.unwrap_or(text);
        if place.starts_with("http://") || place.starts_with("https://") {
            return Ok(Self::Http(place.to_owned()));
        }
        if let Some(bucket) = place.strip_prefix("gs://") {
            return Ok(Self::Http(format!(
                "https://storage.googleapis.com/{bucket}"
            )));
        }
        Self::elsewhere(text, place)
    }
}

impl Location {
    #[cfg(not(target_family = "wasm"))]
    fn elsewhere(text: &str, place: &str) -> Result<Self, LocationError> {
        if saccade_archive::storage::BucketLocation::is_meant_by(place) {
            let bucket = place.parse();
            return Ok(Self::S3(
                bucket.map_err(|error| LocationError::new(text, error))?,
            ));
        }
        let place = place.strip_prefix("file://").unwrap_or(place);
        if place.contains("://") || place.is_empty() {
            let reason = "give a folder, or an address with http://, https://, s3:// or gs://";
            return Err(LocationError::new(text, reason));
        }
        Ok(Self::Folder(place.into()))
    }

    #[cfg(target_family = "wasm")]
    fn elsewhere(text: &str, _: &str) -> Result<Self, LocationError> {
        let reason = "a browser reads addresses with http://, https:// or gs:// only";
        Err(LocationError::new(text, reason))
    }

    /// Its objects. Sends nothing yet.
    ///
    /// # Errors
    ///
    /// [`LocationError`] if it is no address, or the environment describes no store for it.
    pub fn objects(&self) -> Result<Arc<dyn Objects>, LocationError> {
        Ok(match self {
            #[cfg(not(target_family = "wasm"))]
            Self::Folder(folder) => Arc::new(super::FolderObjects::new(folder)),
            Self::Http(address) => Arc::new(HttpObjects::new(address)?),
            #[cfg(not(target_family = "wasm"))]
            Self::S3(bucket) => Arc::new(super::S3Objects::new(bucket)?),
        })
    }

    /// A name for what is there: the last part of the path.
    pub fn name(&self) -> String {
        let text = self.to_string();
        let path = text.split(['?', '#']).next().unwrap_or_default();
        let last = path.trim_end_matches('/').rsplit('/').next();
        last.unwrap_or_default().to_owned()
    }
}

impl fmt::Display for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            #[cfg(not(target_family = "wasm"))]
            Self::Folder(folder) => folder.display().fmt(f),
            Self::Http(address) => f.write_str(&shown(address)),
            #[cfg(not(target_family = "wasm"))]
            Self::S3(bucket) => bucket.fmt(f),
        }
    }
}

/// An address without what may be secret: its password, its query.
fn shown(address: &str) -> String {
    let address = address.split(['?', '#']).next().unwrap_or_default();
    let (scheme, rest) = address.split_once("://").unwrap_or(("", address));
    let (server, path) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
    match server.rsplit_once('@') {
        Some((login, host)) => {
            let user = login.split(':').next().unwrap_or_default();
            format!("{scheme}://{user}@{host}{path}")
        }
        None => address.to_owned(),
    }
}

#[cfg(all(test, not(target_family = "wasm")))]
mod tests {
    use super::*;

    #[test]
    fn places_are_read_or_refused() {
        for (text, shown, name) in [
            ("https://h/a/b.zarr/?k=1", "https://h/a/b.zarr/", "b.zarr"),
            (
                "precomputed://gs://b/em/v1",
                "https://storage.googleapis.com/b/em/v1",
                "v1",
            ),
            ("https://me:hush@h/a", "https://me@h/a", "a"),
            ("zarr://s3://b/x", "s3://b/x", "x"),
            ("file:///data/em", "/data/em", "em"),
            ("./em.zarr", "./em.zarr", "em.zarr"),
        ] {
            let place: Location = text.parse().unwrap();
            assert_eq!(
                (place.to_string(), place.name()),
                (shown.into(), name.into())
            );
            let folders = place.objects().unwrap().folders();
            assert_eq!(
                folders.last().map(String::as_str),
                Some(name),
                "{folders:?}"
            );
        }
        for bad in ["", "ftp://h/a", "s3:/b", "zarr://"] {
            let error = bad.parse::<Location>().unwrap_err();
            assert!(error.to_string().contains("no place"), "{bad}: {error}");
        }
    }
}
