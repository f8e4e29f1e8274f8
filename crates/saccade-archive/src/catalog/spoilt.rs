//! Rows that mean nothing, which no program of ours writes: each is told by name, and keeps nobody from the others.

use super::database::Row;
use super::{Catalog, CatalogError, Tile, TileId, VolumeEntry, rows};

/// A volume that the catalog names.
#[derive(Debug)]
pub struct Listed {
    /// Its name.
    pub name: String,
    /// What it is, or [`CatalogError::SpoiltVolume`].
    pub entry: Result<VolumeEntry, CatalogError>,
}

/// A tile of which the catalog says what cannot be.
#[derive(Clone, Debug, PartialEq)]
pub struct SpoiltTile {
    /// Its id.
    pub id: TileId,
    /// Its name, or what can be read of one that is no text.
    pub name: Result<String, String>,
    /// Section: z index of the volume, if there is such a one.
    pub section: Option<u32>,
    /// Name of its pyramid in the storage, or what can be read where the storage cannot have it.
    pub pyramid: Result<String, String>,
    /// Position of its record, where that was asked for and can be.
    pub position: Option<u64>,
    /// What cannot be.
    pub reason: String,
    /// As if it lay at the origin, if all but its transform is as it can be.
    pub but_for_place: Option<Box<Tile>>,
    /// As if it had a pyramid, if all but the name of that is as it can be.
    pub but_for_pyramid: Option<Box<Tile>>,
}

impl Catalog {
    /// The tiles of a section, by id, and those of which something cannot be understood, be it which records they are of.
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
                        pyramid, revision, position, transform_position FROM tiles \
                        WHERE volume = $1 AND section = $2 AND deleted = 0 ORDER BY id";
        let values = [id.into(), z.into()];
        self.ask(question, &values, rows::tile_whose_records_are_known)
            .await
    }

    /// The tiles that are in no section that can be, by id.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn rows_without_section(
        &self,
        volume: &str,
    ) -> Result<Vec<SpoiltTile>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, \
                        pyramid, revision, position, transform_position FROM tiles WHERE volume = $1 AND deleted = 0 \
                        AND (section < 0 OR section > 4294967295) ORDER BY id";
        let rows = self
            .ask(question, &[id.into()], rows::tile_whose_records_are_known)
            .await?;
        Ok(rows.into_iter().filter_map(Result::err).collect())
    }

    /// Refuses a volume of which a row says what cannot be, so that its tile is found by nobody who looks for the tiles of a
    /// place: of a section or channel that the volume has not, of no size, of a section that counts no tiles, or of one that is
    /// neither there nor deleted as it should be. Looks at all tiles of the volume.
    ///
    /// # Errors
    ///
    /// [`CatalogError::SpoiltTile`] of the first, [`CatalogError::UnknownVolume`], [`CatalogError::SpoiltVolume`], or what the
    /// database says.
    pub async fn refuse_impossible(&self, volume: &str) -> Result<(), CatalogError> {
        let of = self.volume(volume).await?;
        let id = self.volume_id(volume).await?;
        let (depth, channels) = (of.extent().z, of.channels.len() as u64);
        let question = "SELECT id, name, section, channel, width, height, deleted FROM tiles WHERE volume = $1 \
                        AND ((deleted <> 0 AND pyramid <> '') OR (deleted = 0 AND (section < 0 OR section >= $2 \
                        OR channel < 0 OR channel >= $3 OR width <= 0 OR height <= 0 OR NOT EXISTS \
                        (SELECT 1 FROM sections s WHERE s.volume = tiles.volume AND s.section = tiles.section)))) \
                        ORDER BY id LIMIT 1";
        let wrong = |row: &Row| {
            let [deleted, section, channel] =
                ["deleted", "section", "channel"].map(|column| row.get::<i64>(column));
            let (deleted, section, channel) = (deleted?, section?, channel?);
            let reason = match () {
                () if deleted != 0 => {
                    "it is called deleted, and its pyramid is still named".to_owned()
                }
                () if !(0..i64::from(depth)).contains(&section) => {
                    format!("section {section} of a volume with {depth}")
                }
                () if u64::try_from(channel).map_or(true, |channel| channel >= channels) => {
                    format!("channel {channel} of a volume with {channels}")
                }
                () if row.get::<i64>("width")?.min(row.get("height")?) <= 0 => {
                    "it has no pixels".to_owned()
                }
                () => format!("section {section} is said to have no tiles"),
            };
            Ok((rows::legible(row, "name"), reason))
        };
        let values = [id.into(), depth.into(), channels.into()];
        let wrong = self.ask(question, &values, wrong).await?;
        match wrong.into_iter().next() {
            None => Ok(()),
            Some((tile, reason)) => Err(CatalogError::SpoiltTile {
                tile,
                volume: volume.to_owned(),
                reason,
                location: self.location().clone(),
            }),
        }
    }

    /// The rows of tiles that are said to be deleted as no deletion leaves them: they name their pyramid still.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn half_deleted(
        &self,
        volume: &str,
    ) -> Result<Vec<Result<Tile, SpoiltTile>>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, \
                        pyramid, revision, position, transform_position FROM tiles \
                        WHERE volume = $1 AND deleted <> 0 AND pyramid <> '' ORDER BY id";
        self.ask(question, &[id.into()], rows::tile_whose_records_are_known)
            .await
    }

    /// Rows after one, by their numbers, of tiles that are said to be deleted as deletions leave those that were there, some
    /// thousand at once: the last row's number, and the tiles, which name no pyramid of theirs, with their rows' positions; without
    /// what cannot be understood.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn deleted_after(
        &self,
        volume: &str,
        row: i64,
    ) -> Result<Option<(i64, Vec<(Tile, u64)>)>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, \
                        'none' AS pyramid, revision, position FROM tiles \
                        WHERE volume = $1 AND id > $2 AND deleted <> 0 AND pyramid = '' AND width > 0 \
                        ORDER BY id LIMIT 4096";
        let deleted = |row: &Row| {
            let tile = rows::tile_or_spoilt(row)?.ok();
            let position = rows::unsigned(row, "position").ok();
            Ok((row.get::<i64>("id")?, tile.zip(position)))
        };
        let values = [id.into(), row.into()];
        let rows = self.ask(question, &values, deleted).await?;
        let last = rows.last().map(|(row, _)| *row);
        let tiles = rows.into_iter().filter_map(|(_, tile)| tile).collect();
        Ok(last.map(|last| (last, tiles)))
    }

    /// Whether anything is known of a tile: it is there, or was deleted, or waits, or is in quarantine.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn knows(&self, volume: &str, tile: &str) -> Result<bool, CatalogError> {
        let id = self.volume_id(volume).await?;
        // In one question, so that none that goes from one to another meanwhile is missed.
        let question = "SELECT (SELECT count(*) FROM tiles WHERE volume = $1 AND name = $2) \
                        + (SELECT count(*) FROM waiting WHERE volume = $1 AND tile = $2) \
                        + (SELECT count(*) FROM quarantine WHERE volume = $1 AND tile = $2) AS known";
        let known = |row: &Row| row.get::<i64>("known");
        let known = self.ask(question, &[id.into(), tile.into()], known).await?;
        Ok(known.into_iter().any(|known| known > 0))
    }

    /// All of them, or the error of the first that is spoilt.
    pub(super) fn whole(
        &self,
        volume: &str,
        rows: Vec<Result<Tile, SpoiltTile>>,
    ) -> Result<Vec<Tile>, CatalogError> {
        let whole = rows.into_iter().collect::<Result<_, _>>();
        whole.map_err(|spoilt: SpoiltTile| CatalogError::SpoiltTile {
            tile: spoilt.name.unwrap_or_else(|legible| legible),
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
