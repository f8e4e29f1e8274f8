//! What became of tiles, as far as the changes are kept.

use std::collections::HashMap;

use saccade_core::voxel_box::VoxelBox;

use super::database::Row;
use super::{CHANGES_AT_ONCE, Catalog, CatalogChange, CatalogError, ChangeReason, TileId, rows};

/// What the kept changes of a volume tell of its tiles.
#[derive(Clone, Debug, Default)]
pub struct History {
    last: HashMap<TileId, LastChange>,
    oldest: Option<i64>,
    newest: u64,
}

/// How a tile changed last.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LastChange {
    /// The change.
    pub change: CatalogChange,
    /// Where the one before it was, if that is kept.
    pub before: Option<VoxelBox>,
    /// Whether any that is kept moved the tile.
    pub was_moved: bool,
}

impl History {
    /// How a tile changed last, if that is kept.
    pub fn last(&self, tile: TileId) -> Option<&LastChange> {
        self.last.get(&tile)
    }

    /// Whether all changes are kept from the first on.
    pub fn is_whole(&self) -> bool {
        self.oldest.is_some_and(|oldest| oldest <= 1)
    }

    /// Whether changes of a revision are kept: all are from the oldest one on, and the newest always.
    pub fn is_kept(&self, revision: u64) -> bool {
        let oldest = self.oldest.unwrap_or(0);
        revision > 0 && i64::try_from(revision).is_ok_and(|revision| oldest <= revision)
    }

    /// Whether a tile's last change is its deletion, of one that is said to have changed `at` a revision: nothing that could
    /// have brought it back since is missed.
    pub fn was_deleted(&self, tile: TileId, at: u64) -> bool {
        let last = self.last(tile);
        let is_end = |last: &LastChange| last.change.reason == ChangeReason::Deleted;
        at <= self.newest && last.is_some_and(is_end)
    }

    fn note(&mut self, revision: i64, change: Option<CatalogChange>) {
        self.oldest.get_or_insert(revision);
        let Some(change) = change else {
            return;
        };
        self.newest = change.revision;
        let moves = change.reason == ChangeReason::Transform;
        let known = self.last.get(&change.tile);
        let last = LastChange {
            before: known.map(|known| known.change.voxels),
            was_moved: moves || known.is_some_and(|known| known.was_moved),
            change,
        };
        self.last.insert(change.tile, last);
    }
}

impl Catalog {
    /// What the kept changes of a volume tell of its tiles; those that cannot be understood tell nothing. Reads them all.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn history(&self, volume: &str) -> Result<History, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT revision, tile, section, x0, y0, x1, y1, reason FROM changes \
                        WHERE volume = $1 AND revision > $2 ORDER BY revision LIMIT $3";
        let change = |row: &Row| Ok((row.get::<i64>("revision")?, rows::change(row).ok()));
        let (mut history, mut after) = (History::default(), i64::MIN);
        loop {
            let values = [id.into(), after.into(), (CHANGES_AT_ONCE as u64).into()];
            let changes = self.ask(question, &values, change).await?;
            let Some((last, _)) = changes.last() else {
                return Ok(history);
            };
            after = *last;
            for (revision, change) in changes {
                history.note(revision, change);
            }
        }
    }
}
