//! Which tiles name a pyramid, and which records say what these are.

use super::{Catalog, CatalogError, rows};

/// Which records say what a tile is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Origin {
    /// The tile's name.
    pub tile: String,
    /// Position of the record that brought its image.
    pub position: u64,
    /// Position of the record that brought its transform.
    pub transform_position: u64,
}

impl Catalog {
    /// The tiles that name a pyramid, by their ids. Looks at all tiles of the volume.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn origins(&self, volume: &str, pyramid: &str) -> Result<Vec<Origin>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT name, position, transform_position FROM tiles \
                        WHERE volume = $1 AND pyramid = $2 AND deleted = 0 ORDER BY id";
        let values = [id.into(), pyramid.into()];
        self.ask(question, &values, rows::origin).await
    }
}
