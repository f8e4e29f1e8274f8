//! How a volume is coming along.

use std::sync::Arc;

use futures::future::BoxFuture;
use serde::{Deserialize, Serialize};

/// The state of a volume's acquisition.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Status {
    /// Revision of the volume.
    pub revision: u64,
    /// Tiles that have been taken in; `None` where the volume is not made of tiles.
    pub tiles: Option<u64>,
    /// Sections with at least one tile; `None` where the volume is not made of tiles.
    pub sections: Option<u64>,
    /// Files that could not be taken in.
    pub quarantined: Vec<Quarantined>,
}

/// A file set aside.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Quarantined {
    /// As the acquisition names it.
    pub file: String,
    /// Why, in words for people.
    pub reason: String,
}

/// The state could not be read.
#[derive(Clone, Debug, thiserror::Error)]
#[error("the state of volume {volume:?} could not be read")]
pub struct StatusError {
    /// What went wrong.
    pub source: Arc<dyn std::error::Error + Send + Sync>,
    /// Name of the volume.
    pub volume: String,
}

/// Knows the state of one volume.
pub trait StatusSource: Send + Sync {
    /// The state now.
    ///
    /// # Errors
    ///
    /// [`StatusError`], of the future.
    fn status(&self) -> BoxFuture<'_, Result<Status, StatusError>>;
}
