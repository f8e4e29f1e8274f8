use reqwest::Client;
use serde::Deserialize;

use crate::Damage;

use super::{RemoteError, RemoteOptions, RemoteSource, Url, get_json, joined};

/// How the acquisition of a volume is coming along, as its server knows it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
pub struct Status {
    /// Revision of the volume.
    pub revision: u64,
    /// Tiles taken in; `None` where the volume is not made of tiles.
    pub tiles: Option<u64>,
    /// Sections with at least one tile; `None` where the volume is not made of tiles.
    pub sections: Option<u64>,
    /// Files that could not be taken in.
    #[serde(default)]
    pub set_aside: u64,
    /// The first of them.
    pub quarantined: Vec<Quarantined>,
    /// Tiles that were taken in and could not be read when they were looked at last.
    #[serde(default)]
    pub damaged: u64,
    /// The first of them.
    #[serde(default)]
    pub damaged_tiles: Vec<Damage>,
}

/// A file set aside.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct Quarantined {
    /// As the acquisition names it.
    pub file: String,
    /// The tile it was to become, if known.
    pub tile: Option<String>,
    /// Why, in words for people.
    pub reason: String,
}

/// Asks the server of one volume for its [`Status`].
#[derive(Clone, Debug)]
pub struct StatusReader {
    client: Client,
    url: Url,
    options: RemoteOptions,
}

impl StatusReader {
    /// The state now.
    ///
    /// # Errors
    ///
    /// [`RemoteError`] if the server does not answer, or not as one.
    pub async fn read(&self) -> Result<Status, RemoteError> {
        get_json(&self.client, self.url.clone(), self.options).await
    }
}

impl RemoteSource {
    /// What asks for the state of this volume's acquisition.
    pub fn status_reader(&self) -> StatusReader {
        StatusReader {
            client: self.client.clone(),
            url: joined(&self.url, &["status.json"]),
            options: self.options,
        }
    }
}
