//! Which tiles name a pyramid, and which records say what these are.

use saccade_core::voxel_box::VoxelBox;

use super::database::Row;
use super::{Catalog, CatalogError, Mover, Tile, TileId, rows};

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

/// What brought a tile to where it lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Placing {
    /// The tile.
    pub tile: TileId,
    /// Position of the record that brought its transform, or on which somebody moved it.
    pub transform_position: u64,
    /// The volume's revision when the tile last changed.
    pub revision: u64,
    /// Who put it there, if that is known.
    pub moved: Option<Mover>,
    /// Which voxels changed then \[level-0 voxels\]; `None` if that is no longer kept.
    pub change: Option<VoxelBox>,
}

/// A row of the table of tiles, of whichever volume, be the tile there or deleted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Naming {
    /// Its number: larger than those before it.
    pub row: i64,
    /// What can be read of the tile's name.
    pub tile: String,
    /// What can be read of the name of its pyramid; nothing of most that are deleted.
    pub pyramid: String,
    /// Number of the volume whose it is said to be.
    pub volume: i64,
    /// Whether the catalog has a volume of that number.
    pub has_volume: bool,
}

/// A row that has a name which another has as well.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedRow {
    /// Its id.
    pub id: TileId,
    /// The name.
    pub name: String,
    /// Its section, if it can be.
    pub section: Option<u32>,
    /// Position of its record, if it can be.
    pub position: Option<u64>,
    /// Name of its pyramid.
    pub pyramid: String,
    /// Whether it is called deleted.
    pub deleted: bool,
    /// What it says of its tile, if that can be, whatever its pyramid is called.
    pub tile: Option<Tile>,
}

/// The row that has a tile's name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Holder {
    /// The tile whose row it is.
    pub tile: TileId,
    /// Position of the record that brought its image, or of its end; `None` where that cannot be.
    pub position: Option<u64>,
    /// Whether it is called deleted.
    pub deleted: bool,
}

/// A row that has the position of a record that was not read yet: what the records before that say of its tile is not followed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ahead {
    /// The tile whose row it is.
    pub id: TileId,
    /// What can be read of its name.
    pub tile: String,
    /// Position of the record that brought its image, or of its end.
    pub position: u64,
    /// Position of the record that brought its transform.
    pub transform_position: u64,
    /// Whether it is called deleted.
    pub deleted: bool,
    /// How far the records were read [bytes].
    pub read: u64,
}

/// Asks for [`Placing`]s of a volume's rows.
macro_rules! placings {
    ($which:literal) => {
        concat!(
            "SELECT t.id AS placed, t.transform_position AS transform_position, t.revision AS placed_at, t.moved AS moved, \
             coalesce(c.revision, -1) AS revision, coalesce(c.tile, -1) AS tile, \
             coalesce(c.section, 0) AS section, coalesce(c.x0, 0) AS x0, coalesce(c.y0, 0) AS y0, \
             coalesce(c.x1, 0) AS x1, coalesce(c.y1, 0) AS y1, coalesce(c.reason, 'tile') AS reason \
             FROM tiles AS t LEFT JOIN changes AS c \
             ON c.volume = t.volume AND c.revision = t.revision AND c.tile = t.id \
             WHERE t.volume = $1 AND ",
            $which
        )
    };
}

fn placing(row: &Row) -> Result<Option<Placing>, sqlx::Error> {
    let change = match row.get::<i64>("revision")? {
        -1 => None,
        _ => rows::change(row).ok(),
    };
    let known = rows::unsigned(row, "transform_position")
        .and_then(|position| Ok((position, rows::unsigned(row, "placed_at")?)));
    let Ok((transform_position, revision)) = known else {
        return Ok(None);
    };
    Ok(Some(Placing {
        tile: TileId(row.get("placed")?),
        transform_position,
        revision,
        moved: Mover::of(row),
        change: change.map(|change| change.voxels),
    }))
}

impl Catalog {
    /// Rows of the table of tiles after one, by their numbers, some thousand at once: also those that are found by no volume.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn namings_after(&self, row: i64) -> Result<Vec<Naming>, CatalogError> {
        let question = "SELECT t.id AS id, t.name AS name, t.pyramid AS pyramid, t.volume AS volume, \
                        coalesce(v.id, -1) AS found FROM tiles AS t LEFT JOIN volumes AS v ON v.id = t.volume \
                        WHERE t.id > $1 ORDER BY t.id LIMIT 4096";
        self.ask(question, &[row.into()], rows::naming).await
    }

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

    /// Which records say what a tile is.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn origin(&self, volume: &str, tile: TileId) -> Result<Option<Origin>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT name, position, transform_position FROM tiles \
                        WHERE volume = $1 AND id = $2 AND deleted = 0";
        let values = [id.into(), tile.0.into()];
        Ok(self.ask(question, &values, rows::origin).await?.pop())
    }

    /// The row that has a tile's name, be the tile there or deleted.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn holder(&self, volume: &str, tile: &str) -> Result<Option<Holder>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT id, position, deleted FROM tiles WHERE volume = $1 AND name = $2";
        let holder = |row: &Row| {
            Ok(Holder {
                tile: TileId(row.get("id")?),
                position: rows::unsigned(row, "position").ok(),
                deleted: row.get::<i64>("deleted")? != 0,
            })
        };
        let values = [id.into(), tile.into()];
        Ok(self.ask(question, &values, holder).await?.pop())
    }

    /// Rows that have a name which another row of the volume has, by id: none, as long as the catalog has its indexes. Looks at
    /// all tiles of the volume.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn rows_of_one_name(&self, volume: &str) -> Result<Vec<NamedRow>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, \
                        pyramid, revision, position, deleted FROM tiles WHERE volume = $1 AND name IN \
                        (SELECT name FROM tiles WHERE volume = $1 GROUP BY name HAVING count(*) > 1) ORDER BY id";
        let named = |row: &Row| {
            Ok(NamedRow {
                id: TileId(row.get("id")?),
                name: rows::legible(row, "name"),
                section: rows::section(row).ok(),
                position: rows::unsigned(row, "position").ok(),
                pyramid: rows::legible(row, "pyramid"),
                deleted: row.get::<i64>("deleted").is_ok_and(|deleted| deleted != 0),
                tile: rows::tile_but_for_pyramid(row),
            })
        };
        self.ask(question, &[id.into()], named).await
    }

    /// The rows whose tiles lie where a record says that was not read yet, and those of tiles that one has deleted; without what cannot
    /// be understood. Looks at all tiles of the volume.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn ahead(&self, volume: &str) -> Result<Vec<Ahead>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT t.id AS id, t.name AS name, t.position AS position, \
                        t.transform_position AS transform_position, t.deleted AS deleted, c.byte AS byte \
                        FROM tiles AS t JOIN cursors AS c ON c.volume = t.volume WHERE t.volume = $1 \
                        AND ((t.deleted = 0 AND t.transform_position >= c.byte) \
                        OR (t.deleted <> 0 AND t.position >= c.byte)) ORDER BY t.id";
        let ahead = |row: &Row| {
            let said = |column| rows::unsigned(row, column);
            let known = said("position")
                .and_then(|position| Ok((position, said("transform_position")?, said("byte")?)));
            let (id, deleted) = (TileId(row.get("id")?), row.get::<i64>("deleted")? != 0);
            let tile = rows::legible(row, "name");
            Ok(known
                .ok()
                .map(|(position, transform_position, read)| Ahead {
                    id,
                    tile,
                    position,
                    transform_position,
                    deleted,
                    read,
                }))
        };
        let rows = self.ask(question, &[id.into()], ahead).await?;
        Ok(rows.into_iter().flatten().collect())
    }

    /// What brought the tiles of a section to where they lie; those of which it cannot be understood are left out.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn placings(&self, volume: &str, z: u32) -> Result<Vec<Placing>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = placings!("t.section = $2 AND t.deleted = 0");
        let placings = self.ask(question, &[id.into(), z.into()], placing).await?;
        Ok(placings.into_iter().flatten().collect())
    }

    /// What brought a tile to where its row says that it lies, also if it calls it deleted; `None` where that cannot be
    /// understood.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn placing(
        &self,
        volume: &str,
        tile: TileId,
    ) -> Result<Option<Placing>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = placings!("t.id = $2");
        let values = [id.into(), tile.0.into()];
        let placings = self.ask(question, &values, placing).await?;
        Ok(placings.into_iter().flatten().next())
    }

    /// The tiles that were entered last, as far as their records tell, at most `most`: names, and positions of records. Looks at
    /// all tiles of the volume.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn newest_records(
        &self,
        volume: &str,
        most: u32,
    ) -> Result<Vec<(String, u64)>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT name, position FROM tiles WHERE volume = $1 AND deleted = 0 \
                        ORDER BY position DESC LIMIT $2";
        let newest = |row: &Row| {
            let position = rows::unsigned(row, "position").unwrap_or(u64::MAX);
            Ok((rows::legible(row, "name"), position))
        };
        let values = [id.into(), most.into()];
        self.ask(question, &values, newest).await
    }

    /// Whether a tile names a pyramid, which is looked for where a pyramid of that name belongs: in its section, and with
    /// the tile that it is called after. Cheap at any number of tiles; those of other names are looked for everywhere.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn is_named(&self, volume: &str, pyramid: &str) -> Result<bool, CatalogError> {
        let parts: Vec<_> = pyramid.split('/').collect();
        let section = match parts[..] {
            ["tiles", _, section, _] => section.parse::<u32>().ok(),
            _ => None,
        };
        let Some(section) = section else {
            return Ok(!self.origins(volume, pyramid).await?.is_empty());
        };
        let stem = parts[3].rsplit_once('-').map_or(parts[3], |(stem, _)| stem);
        let id = self.volume_id(volume).await?;
        let question = "SELECT id FROM tiles WHERE volume = $1 AND (section = $2 OR name = $3) \
                        AND pyramid = $4 AND deleted = 0 LIMIT 1";
        let values = [id.into(), section.into(), stem.into(), pyramid.into()];
        let named = self.ask(question, &values, |row| row.get::<i64>("id"));
        Ok(!named.await?.is_empty())
    }
}
