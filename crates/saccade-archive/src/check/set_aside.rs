//! What an earlier check set aside, and nothing is wrong with any more.

use super::repair::{DAMAGED, WRONG};
use super::{Check, CheckError, Repair};

impl Check<'_> {
    /// Takes tiles out of quarantine that a check put there, and that are whole now, or deleted: no record will come that ends it.
    pub(super) async fn no_longer_set_aside(&self, volume: &str) -> Result<(), CheckError> {
        let catalog = self.archive.catalog();
        if !self.options.repair {
            return Ok(());
        }
        for what in catalog.quarantined(volume).await? {
            let is_checks = [DAMAGED, WRONG]
                .iter()
                .any(|how| what.reason.starts_with(how));
            let Some(tile) = what.tile.as_deref().filter(|_| is_checks) else {
                continue;
            };
            if self.has_found(volume, tile) || !self.is_as_it_should_be(volume, tile).await? {
                continue;
            }
            let mut commit = catalog.begin(volume).await?;
            commit.no_longer_set_aside(&what).await?;
            commit.finish().await?;
        }
        Ok(())
    }

    /// Whether anything was found of a tile that is not mended now.
    fn has_found(&self, volume: &str, tile: &str) -> bool {
        let is_mended = |repair| {
            use Repair::{Confirmed, Kept, Moved, Renamed, Renumbered, Restored, TakenAway};
            matches!(
                repair,
                Confirmed | Kept | Moved | Renamed | Renumbered | Restored | TakenAway
            )
        };
        let mut findings = self.report.findings.iter();
        findings.any(|finding| {
            let is_its =
                finding.volume.as_deref() == Some(volume) && finding.tile.as_deref() == Some(tile);
            is_its && !finding.repair.is_some_and(is_mended)
        })
    }

    /// Whether a tile of which nothing was found, or that is mended, is deleted, or was looked at as a whole.
    async fn is_as_it_should_be(&self, volume: &str, tile: &str) -> Result<bool, CheckError> {
        let holder = self.archive.catalog().holder(volume, tile).await?;
        Ok(holder.is_some_and(|row| row.deleted || !self.options.quick))
    }
}
