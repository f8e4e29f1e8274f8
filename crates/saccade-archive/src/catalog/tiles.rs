//! Which tiles there are, and how many.

use std::ops::Range;

use super::database::{Durability, Row, Statement};
use super::{Catalog, CatalogError, Statistics, Tile, TileId, rows};

/// Counts the tiles of a volume, in all and by section.
pub(super) const RECOUNT: [&str; 3] = [
    "UPDATE volumes SET tiles = \
     (SELECT count(*) FROM tiles WHERE volume = $1 AND deleted = 0) WHERE id = $1",
    "DELETE FROM sections WHERE volume = $1",
    "INSERT INTO sections (volume, section, tiles) SELECT volume, section, count(*) \
     FROM tiles WHERE volume = $1 AND deleted = 0 AND section BETWEEN 0 AND 4294967295 \
     GROUP BY volume, section",
];

impl Catalog {
    /// The tiles of a section, by id.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], [`CatalogError::SpoiltTile`], or what the database says.
    pub async fn section_tiles(&self, volume: &str, z: u32) -> Result<Vec<Tile>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, \
                        pyramid, revision, position FROM tiles \
                        WHERE volume = $1 AND section = $2 AND deleted = 0 ORDER BY id";
        let values = [id.into(), z.into()];
        let rows = self.ask(question, &values, rows::tile_or_spoilt).await?;
        self.whole(volume, rows)
    }

    /// The tile of that name, if the volume has it.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], [`CatalogError::SpoiltTile`], or what the database says.
    pub async fn tile(&self, volume: &str, name: &str) -> Result<Option<Tile>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, \
                        pyramid, revision, position FROM tiles \
                        WHERE volume = $1 AND name = $2 AND deleted = 0";
        let values = [id.into(), name.into()];
        let rows = self.ask(question, &values, rows::tile_or_spoilt).await?;
        Ok(self.whole(volume, rows)?.pop())
    }

    /// The name of a tile's pyramid, if the volume has the tile and the storage can have the name: also of one of which
    /// nothing else can be understood.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn tile_pyramid(
        &self,
        volume: &str,
        tile: &str,
    ) -> Result<Option<String>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT pyramid FROM tiles WHERE volume = $1 AND name = $2 AND deleted = 0";
        let pyramid = |row: &Row| Ok(rows::pyramid(row).ok());
        let found = self
            .ask(question, &[id.into(), tile.into()], pyramid)
            .await?;
        Ok(found.into_iter().flatten().next())
    }

    /// The tiles of these ids, by id; those that the volume has not are left out.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], [`CatalogError::SpoiltTile`], or what the database says.
    pub async fn tiles(&self, volume: &str, ids: &[TileId]) -> Result<Vec<Tile>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = Statement {
            sqlite: "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, \
                     pyramid, revision, position FROM tiles \
                     WHERE id IN (SELECT value FROM json_each($1)) AND volume = $2 \
                     AND deleted = 0 ORDER BY id",
            postgres: "SELECT id, name, section, channel, width, height, a, b, c, d, tx, ty, \
                       pyramid, revision, position FROM tiles \
                       WHERE id IN (SELECT value::bigint FROM json_array_elements_text($1::text::json)) \
                       AND volume = $2 AND deleted = 0 ORDER BY id",
        };
        let ids = serde_json::to_string(ids).expect("numbers become JSON");
        let values = [(&ids).into(), id.into()];
        let rows = self.ask(question, &values, rows::tile_or_spoilt).await?;
        self.whole(volume, rows)
    }

    /// The sections that have a tile, ascending.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn sections(&self, volume: &str) -> Result<Vec<u32>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT section FROM sections WHERE volume = $1 \
                        AND section BETWEEN 0 AND 4294967295 ORDER BY section";
        self.ask(question, &[id.into()], rows::section).await
    }

    /// Of each of the first `channels` channels, the sections of a range that have a tile of it, ascending. A tile of which
    /// the channel cannot be told counts for all of them: whoever looks for it is to learn that it cannot be read.
    ///
    /// # Errors
    ///
    /// As [`Self::sections`].
    pub async fn sections_of_channels(
        &self,
        volume: &str,
        channels: u32,
        within: Range<u32>,
    ) -> Result<Vec<Vec<u32>>, CatalogError> {
        let id = self.volume_id(volume).await?;
        // Looks each pair up in the tiles' index; of one channel, the counts say the same.
        let question = match channels {
            0 | 1 => {
                "SELECT section, CAST(0 AS BIGINT) AS channel FROM sections WHERE volume = $1 \
                 AND section >= $2 AND section < $3 AND CAST(0 AS BIGINT) < $4 ORDER BY section"
            }
            _ => {
                "WITH RECURSIVE channels (channel) AS (SELECT CAST(0 AS BIGINT) \
                 UNION ALL SELECT channel + 1 FROM channels WHERE channel + 1 < $4) \
                 SELECT s.section AS section, c.channel AS channel \
                 FROM sections s CROSS JOIN channels c \
                 WHERE s.volume = $1 AND s.section >= $2 AND s.section < $3 AND (\
                 EXISTS (SELECT 1 FROM tiles t WHERE t.volume = $1 AND t.section = s.section \
                 AND t.channel = c.channel AND t.deleted = 0) \
                 OR EXISTS (SELECT 1 FROM tiles t WHERE t.volume = $1 AND t.section = s.section \
                 AND t.channel < 0 AND t.deleted = 0) \
                 OR EXISTS (SELECT 1 FROM tiles t WHERE t.volume = $1 AND t.section = s.section \
                 AND t.channel > 4294967295 AND t.deleted = 0)) ORDER BY s.section"
            }
        };
        let values = [
            id.into(),
            within.start.into(),
            within.end.into(),
            channels.into(),
        ];
        let pair = |row: &Row| Ok((rows::section(row)?, row.get::<i64>("channel")?));
        let mut of_channels = vec![Vec::new(); channels as usize];
        for (section, channel) in self.ask(question, &values, pair).await? {
            let channel = usize::try_from(channel).ok();
            if let Some(sections) = channel.and_then(|channel| of_channels.get_mut(channel)) {
                sections.push(section);
            }
        }
        Ok(of_channels)
    }

    /// The sections that have a tile, by looking at the tiles themselves: what [`Self::sections`] should say.
    ///
    /// # Errors
    ///
    /// As [`Self::sections`].
    pub async fn sections_of_tiles(&self, volume: &str) -> Result<Vec<u32>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT DISTINCT section FROM tiles WHERE volume = $1 AND deleted = 0 \
                        AND section BETWEEN 0 AND 4294967295 ORDER BY section";
        self.ask(question, &[id.into()], rows::section).await
    }

    /// The sections that have tiles and are not counted among those, ascending. Looks at all tiles of the volume.
    ///
    /// # Errors
    ///
    /// As [`Self::sections`].
    pub async fn uncounted_sections(&self, volume: &str) -> Result<Vec<u32>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT DISTINCT section FROM tiles AS t WHERE volume = $1 AND deleted = 0 \
                        AND section BETWEEN 0 AND 4294967295 AND NOT EXISTS \
                        (SELECT 1 FROM sections AS s WHERE s.volume = t.volume AND s.section = t.section) \
                        ORDER BY section";
        self.ask(question, &[id.into()], rows::section).await
    }

    /// Whether as many tiles are there as are counted, at one moment. Looks at all tiles of the volume.
    ///
    /// # Errors
    ///
    /// As [`Self::sections`].
    pub async fn is_counted(&self, volume: &str) -> Result<bool, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT v.tiles AS counted, \
                        (SELECT count(*) FROM tiles AS t WHERE t.volume = v.id AND t.deleted = 0) AS there \
                        FROM volumes AS v WHERE v.id = $1";
        let is_so = |row: &Row| Ok(row.get::<i64>("counted")? == row.get::<i64>("there")?);
        let found = self.ask(question, &[id.into()], is_so).await?;
        Ok(found.into_iter().all(|is_so| is_so))
    }

    /// Counts. Cheap at any number of tiles.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn statistics(&self, volume: &str) -> Result<Statistics, CatalogError> {
        let question = "SELECT v.revision, v.tiles, \
                        (SELECT count(*) FROM sections WHERE volume = v.id) AS sections, \
                        (SELECT count(*) FROM quarantine WHERE volume = v.id) AS quarantined, \
                        (SELECT count(*) FROM waiting WHERE volume = v.id AND parked = 1) AS waiting, \
                        (SELECT count(*) FROM waiting WHERE volume = v.id AND parked = 0) AS queued, \
                        (SELECT count(*) FROM early_transforms WHERE volume = v.id) AS early \
                        FROM volumes v WHERE v.name = $1";
        let found = self
            .ask(question, &[volume.into()], rows::statistics)
            .await?;
        match found.into_iter().next() {
            Some(statistics) => Ok(statistics),
            None => Err(self.unknown_volume(volume).await),
        }
    }

    /// Counts a volume's tiles anew, in all and by section.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn recount(&self, volume: &str) -> Result<(), CatalogError> {
        let id = self.volume_id(volume).await?;
        let mut transaction = self.transaction(Durability::Durable).await?;
        for statement in RECOUNT {
            let done = transaction.run(statement, &[id.into()]).await;
            done.map_err(|e| self.failed(e))?;
        }
        let done = transaction.commit().await;
        done.map_err(|e| self.failed(e))
    }
}
