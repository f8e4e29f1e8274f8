//! Rows that mean nothing, which no program of ours writes: each is told by name, and keeps nobody from the others.

use glam::UVec2;

use super::database::Row;
use super::{Catalog, CatalogError, Tile, VolumeEntry, rows};

/// A volume that the catalog names.
#[derive(Debug)]
pub struct Listed {
    /// Its name.
    pub name: String,
    /// What it is, or [`CatalogError::SpoiltVolume`].
    pub entry: Result<VolumeEntry, CatalogError>,
}

/// A tile of which the catalog says what cannot be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SpoiltTile {
    /// Its name.
    pub name: String,
    /// Section: z index of the volume.
    pub section: u32,
    /// Name of its pyramid in the storage.
    pub pyramid: String,
    /// What cannot be.
    pub reason: String,
    /// Width and height \[pixels\], if all but its transform is as it can be.
    pub size: Option<UVec2>,
}

impl Catalog {
    /// The tiles of a section, by id, and those of which nothing can be understood.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn section_rows(
        &self,
        volume: &str,
        z: u32,
    ) -> Result<Vec<Result<Tile, SpoiltTile>>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, \
                        pyramid, revision FROM tiles \
                        WHERE volume = $1 AND section = $2 AND deleted = 0 ORDER BY id";
        let values = [id.into(), z.into()];
        self.ask(question, &values, rows::tile_or_spoilt).await
    }

    /// All of them, or the error of the first that is spoilt.
    pub(super) fn whole(
        &self,
        volume: &str,
        rows: Vec<Result<Tile, SpoiltTile>>,
    ) -> Result<Vec<Tile>, CatalogError> {
        let whole = rows.into_iter().collect::<Result<_, _>>();
        whole.map_err(|spoilt: SpoiltTile| CatalogError::SpoiltTile {
            tile: spoilt.name,
            volume: volume.to_owned(),
            reason: spoilt.reason,
            location: self.location().clone(),
        })
    }

    /// What a row of the volume `name` says.
    pub(super) fn described(&self, name: &str, row: &Row) -> Result<VolumeEntry, CatalogError> {
        rows::volume_entry(row).map_err(|error| CatalogError::SpoiltVolume {
            name: name.to_owned(),
            reason: rows::reason_of(error),
            location: self.location().clone(),
        })
    }
}
