//! How a volume is coming along.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use futures::future::BoxFuture;
use saccade_archive::catalog::{Catalog, CatalogError};
use saccade_source::Damage;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// The state of a volume's acquisition.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Status {
    /// Revision of the voxels that are served. What is counted here may be of a later one.
    pub revision: u64,
    /// Tiles that have been taken in; `None` where the volume is not made of tiles.
    pub tiles: Option<u64>,
    /// Sections with at least one tile; `None` where the volume is not made of tiles.
    pub sections: Option<u64>,
    /// Tiles that are announced but whose files are not whole yet; `None` likewise.
    pub waiting: Option<u64>,
    /// Tiles that are announced and whole, and not taken in yet; `None` likewise.
    #[serde(default)]
    pub queued: Option<u64>,
    /// Transforms whose tile has not come yet; `None` likewise.
    pub early_transforms: Option<u64>,
    /// What those wait for who take tiles in, the longest first; empty while they go on, or are not there.
    #[serde(default)]
    pub held_up: Vec<HeldUp>,
    /// Files that could not be taken in.
    #[serde(default)]
    pub set_aside: u64,
    /// The first hundred of them.
    pub quarantined: Vec<Quarantined>,
    /// Tiles that were taken in, and could not be read when the server looked at them last.
    #[serde(default)]
    pub damaged: u64,
    /// The first hundred of them.
    #[serde(default)]
    pub damaged_tiles: Vec<DamagedTile>,
}

/// A tile that cannot be read any more.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct DamagedTile {
    /// Section: z index of the volume.
    pub section: u32,
    /// Name of its pyramid in the archive.
    pub object: String,
    /// What is wrong and how to mend it, in words for people.
    pub reason: String,
}

/// Files set aside, and damaged tiles, that are listed: a mistake in the settings sets aside all that come.
const LISTED: u32 = 100;

impl Status {
    /// The same, with what a source could not read.
    #[must_use]
    pub fn with_damage(self, damage: Vec<Damage>) -> Self {
        let tile = |damage: Damage| DamagedTile {
            section: damage.section,
            object: damage.object,
            reason: damage.reason,
        };
        Self {
            damaged: damage.len() as u64,
            damaged_tiles: damage.into_iter().take(LISTED as usize).map(tile).collect(),
            ..self
        }
    }
}

/// Why tiles are not taken in.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct HeldUp {
    /// Machine and process that wait, or what they all wait for.
    pub worker: String,
    /// What they wait for, in words for people.
    pub why: String,
    /// Since when \[s since 1970\].
    pub since: u64,
}

/// A file set aside.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Quarantined {
    /// As the acquisition names it.
    pub file: String,
    /// The tile it was to become, if known.
    pub tile: Option<String>,
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
    /// Whether it may be told later.
    pub transient: bool,
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

/// Reads the state of a volume from a catalog.
#[derive(Clone, Debug)]
pub struct CatalogStatus {
    catalog: Catalog,
    volume: String,
    full: Full,
}

/// Since when the catalog's disk is found full. Clones share it.
#[derive(Clone, Debug, Default)]
struct Full(Arc<Mutex<Option<SystemTime>>>);

impl Full {
    /// Whoever finds it full does so for all that wait.
    const WHO: &str = "the catalog's disk";

    fn since(
        &self,
        why: Option<String>,
        now: SystemTime,
    ) -> Option<saccade_archive::catalog::HeldUp> {
        let mut since = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(why) = why else {
            *since = None;
            return None;
        };
        Some(saccade_archive::catalog::HeldUp {
            worker: Self::WHO.to_owned(),
            why,
            since: *since.get_or_insert(now),
        })
    }
}

impl CatalogStatus {
    /// Of the volume of that name.
    pub fn new(catalog: Catalog, volume: &str) -> Self {
        Self {
            catalog,
            volume: volume.to_owned(),
            full: Full::default(),
        }
    }

    async fn read(&self) -> Result<Status, CatalogError> {
        let statistics = self.catalog.statistics(&self.volume).await?;
        let quarantined = self.catalog.first_quarantined(&self.volume, LISTED);
        let quarantined = quarantined.await?;
        let file = |q: saccade_archive::catalog::Quarantined| Quarantined {
            file: q.file,
            tile: q.tile,
            reason: q.reason,
        };
        let mut held_up = self.catalog.held_up(&self.volume).await?;
        let full = self.catalog.held_up_for_space();
        held_up.extend(self.full.since(full, self.catalog.clock().now()));
        held_up.sort_by_key(|held| held.since);
        let waits = |held: saccade_archive::catalog::HeldUp| HeldUp {
            since: held
                .since
                .duration_since(UNIX_EPOCH)
                .map_or(0, |since| since.as_secs()),
            worker: held.worker,
            why: held.why,
        };
        Ok(Status {
            held_up: held_up.into_iter().map(waits).collect(),
            revision: statistics.revision,
            tiles: Some(statistics.tiles),
            sections: Some(statistics.sections),
            waiting: Some(statistics.waiting),
            queued: Some(statistics.queued),
            early_transforms: Some(statistics.early),
            set_aside: statistics.quarantined,
            quarantined: quarantined.into_iter().map(file).collect(),
            ..Status::default()
        })
    }
}

impl StatusSource for CatalogStatus {
    fn status(&self) -> BoxFuture<'_, Result<Status, StatusError>> {
        Box::pin(async {
            self.read().await.map_err(|error| StatusError {
                transient: error.is_transient(),
                source: Arc::new(error),
                volume: self.volume.clone(),
            })
        })
    }
}
