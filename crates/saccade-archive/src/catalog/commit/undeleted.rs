//! Tiles that were called deleted and are not.

use super::Commit;
use crate::catalog::database::Value;
use crate::catalog::{CatalogError, ChangeReason, Tile};

impl Commit<'_> {
    /// Brings a tile back whose row is called deleted and is whole otherwise, as [`half_deleted`] finds them, or names
    /// no pyramid: then it gets the one that is said. It lies where `tile` says then.
    ///
    /// # Errors
    ///
    /// [`CatalogError::OutsideVolume`] if no voxel is under it; what the database says.
    ///
    /// [`half_deleted`]: crate::catalog::Catalog::half_deleted
    pub async fn undelete(&mut self, tile: &Tile) -> Result<(), CatalogError> {
        let place = self.place(&tile.name, tile.section, tile.size, tile.transform)?;
        self.log_change(tile.id, None, Some(place), ChangeReason::Tile)
            .await?;
        let update = "UPDATE tiles SET deleted = 0, revision = $3, pyramid = $4, a = $5, b = $6, c = $7, d = $8, \
                      tx = $9, ty = $10, moved = NULL WHERE id = $1 AND volume = $2 AND deleted <> 0 \
                      AND (pyramid = $4 OR pyramid = '')";
        let mut values = vec![
            tile.id.0.into(),
            self.volume.into(),
            self.revision.into(),
            (&tile.pyramid).into(),
        ];
        values.extend(tile.transform.elements().map(Value::from));
        self.run(update, &values).await?;
        self.forget_retired(&tile.pyramid).await?;
        // Nobody knows whether it was counted.
        self.uncounted = true;
        Ok(())
    }
}
