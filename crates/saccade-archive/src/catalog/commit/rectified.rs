//! Rows that say what nothing explains, made to say what they did.

use glam::UVec3;
use saccade_core::transform::SectionFromTile;
use saccade_core::voxel_box::VoxelBox;

use super::Commit;
use crate::catalog::database::Value;
use crate::catalog::{Ahead, CatalogError, ChangeReason, Mover, NamedRow, Tile, TileId, place};

impl Commit<'_> {
    /// Has a tile name another pyramid, if it is still as it was found. The one that it named is not retired: it is another's.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn rename_pyramid(&mut self, tile: &Tile, to: &str) -> Result<(), CatalogError> {
        self.log_again(tile).await?;
        let update = "UPDATE tiles SET pyramid = $4, revision = $5 \
                      WHERE id = $1 AND volume = $2 AND pyramid = $3 AND deleted = 0";
        let values = [
            tile.id.0.into(),
            self.volume.into(),
            (&tile.pyramid).into(),
            to.into(),
            self.revision.into(),
        ];
        self.run(update, &values).await?;
        self.forget_retired(to).await
    }

    /// Gives a tile another name, if it is still called as it was found; a row that has that name gets the tile's. No voxel changes, and
    /// nothing that tells what brought the two to where they lie.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn rename(&mut self, tile: &Tile, to: &str) -> Result<(), CatalogError> {
        // By its row: where the index of names is gone, another may be called so as well.
        let question = "SELECT id FROM tiles WHERE id = $1 AND volume = $2 AND name = $3";
        let values = [tile.id.0.into(), self.volume.into(), (&tile.name).into()];
        if self.one(question, &values).await?.is_none() {
            return Ok(());
        }
        match self.existing(to).await? {
            Some(holder) => {
                // No two rows have one name, also not in between.
                let between = format!("{to} {}", holder.id.0);
                self.call(holder.id, &between).await?;
                self.call(tile.id, to).await?;
                self.call(holder.id, &tile.name).await
            }
            None => self.call(tile.id, to).await,
        }
    }

    async fn call(&mut self, tile: TileId, name: &str) -> Result<(), CatalogError> {
        let update = "UPDATE tiles SET name = $2 WHERE id = $1";
        self.run(update, &[tile.0.into(), name.into()]).await?;
        Ok(())
    }

    /// Has a tile be of another record, if it names still the pyramid that it was found with.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn number(&mut self, tile: &Tile, position: u64) -> Result<(), CatalogError> {
        self.log_again(tile).await?;
        let update = "UPDATE tiles SET position = $4, revision = $5 \
                      WHERE id = $1 AND volume = $2 AND pyramid = $3 AND deleted = 0";
        let values = [
            tile.id.0.into(),
            self.volume.into(),
            (&tile.pyramid).into(),
            position.into(),
            self.revision.into(),
        ];
        self.run(update, &values).await?;
        Ok(())
    }

    /// Has what records say of a tile from a position on be followed, if its row still has the position of one that was not read. No voxel
    /// changes.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn follow_from(&mut self, row: &Ahead, position: u64) -> Result<(), CatalogError> {
        let update = match row.deleted {
            false => {
                "UPDATE tiles SET transform_position = $4 \
                 WHERE id = $1 AND volume = $2 AND transform_position = $3 AND deleted = 0"
            }
            true => {
                "UPDATE tiles SET position = $4 WHERE id = $1 AND volume = $2 AND position = $3 AND deleted <> 0"
            }
        };
        let found = match row.deleted {
            false => row.transform_position,
            true => row.position,
        };
        let values = [
            row.id.0.into(),
            self.volume.into(),
            found.into(),
            position.into(),
        ];
        self.run(update, &values).await?;
        Ok(())
    }

    /// Takes it as said that a tile lies where it does, of which nothing tells any more what brought it there.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn confirm(&mut self, tile: &Tile) -> Result<(), CatalogError> {
        let at = place(self.extent, tile.section, tile.size, tile.transform);
        self.log_change(tile.id, at, at, ChangeReason::Transform)
            .await?;
        let update = "UPDATE tiles SET revision = $4, moved = $5 \
                      WHERE id = $1 AND volume = $2 AND revision = $3 AND deleted = 0";
        let values = [
            tile.id.0.into(),
            self.volume.into(),
            tile.revision.into(),
            self.revision.into(),
            Mover::somebody(tile.transform).number().into(),
        ];
        self.run(update, &values).await?;
        Ok(())
    }

    /// Tells those who follow the volume that what is seen of a section may be another everywhere. That is a change of no tile.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn show_again(&mut self, section: u32) -> Result<(), CatalogError> {
        /// Less than all numbers of tiles.
        const NONE: TileId = TileId(0);
        let corner = UVec3::new(0, 0, section);
        let end = self.extent.truncate().extend(section.saturating_add(1));
        let whole = VoxelBox::new(corner, end);
        self.log_change(NONE, None, Some(whole), ChangeReason::Tile)
            .await
    }

    /// Has a tile lie where its record says, if it is still as it was found, whatever else its row says.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn lay(&mut self, tile: &Tile, to: SectionFromTile) -> Result<(), CatalogError> {
        let at = |transform| place(self.extent, tile.section, tile.size, transform);
        let (old, new) = (at(tile.transform), at(to));
        self.log_change(tile.id, old, new, ChangeReason::Transform)
            .await?;
        let update = "UPDATE tiles SET revision = $4, a = $5, b = $6, c = $7, d = $8, tx = $9, ty = $10, moved = 0 \
                      WHERE id = $1 AND volume = $2 AND revision = $3 AND deleted = 0";
        let mut values = vec![
            tile.id.0.into(),
            self.volume.into(),
            tile.revision.into(),
            self.revision.into(),
        ];
        values.extend(to.elements().map(Value::from));
        self.run(update, &values).await?;
        Ok(())
    }

    /// Takes a tile away that is none, or was deleted before, and leaves the pyramid that it names to others.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn take_away(&mut self, tile: &str) -> Result<(), CatalogError> {
        let Some(existing) = self.existing(tile).await?.filter(|e| !e.deleted) else {
            return Ok(());
        };
        self.log_change(existing.id, existing.place, None, ChangeReason::Deleted)
            .await?;
        let update = "UPDATE tiles SET deleted = 1, pyramid = '', revision = $2 WHERE id = $1";
        let values = [existing.id.0.into(), self.revision.into()];
        self.run(update, &values).await?;
        // Nobody knows whether it was counted.
        self.uncounted = true;
        Ok(())
    }

    /// Takes a row out of the catalog whose name another row has; the pyramid that it names is left.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn take_out(&mut self, row: &NamedRow) -> Result<(), CatalogError> {
        let take = "DELETE FROM tiles WHERE volume = $1 AND id = $2 AND EXISTS \
                    (SELECT 1 FROM tiles other WHERE other.volume = $1 AND other.id <> $2 AND other.name = tiles.name)";
        self.run(take, &[self.volume.into(), row.id.0.into()])
            .await?;
        self.uncounted = true;
        match row.section.filter(|z| *z < self.extent.z) {
            Some(section) => self.show_again(section).await,
            None => Ok(()),
        }
    }

    async fn log_again(&mut self, tile: &Tile) -> Result<(), CatalogError> {
        let at = place(self.extent, tile.section, tile.size, tile.transform);
        self.log_change(tile.id, at, at, ChangeReason::Tile).await
    }
}
