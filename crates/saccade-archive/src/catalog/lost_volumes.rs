//! Rows of volumes that are gone from the table of volumes.

use super::database::{Row, Value};
use super::{Catalog, CatalogError, Durability};

/// A volume that the table of volumes lacks, and others tell of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LostVolume {
    /// Its number.
    pub number: i64,
    /// How many rows of tiles it has, be they deleted.
    pub tiles: u64,
    /// Its name, as its pyramids have it; `None` where it has none.
    pub name: Option<String>,
}

impl Catalog {
    /// Volumes of tiles that the table of volumes lacks, by their numbers. Foreign keys keep a database from it; a file has them only
    /// for who asks for them.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn lost_volumes(&self) -> Result<Vec<LostVolume>, CatalogError> {
        let (mut lost, mut after) = (Vec::new(), i64::MIN);
        // From one to the next: reading all rows would take seconds.
        let next = "SELECT volume FROM tiles WHERE volume > $1 ORDER BY volume LIMIT 1";
        let number = |row: &Row| row.get::<i64>("volume");
        while let Some(number) = self.ask(next, &[after.into()], number).await?.pop() {
            after = number;
            let there = "SELECT id FROM volumes WHERE id = $1";
            let id = |row: &Row| row.get::<i64>("id");
            if self.ask(there, &[number.into()], id).await?.is_empty() {
                lost.push(self.lost_volume(number).await?);
            }
        }
        Ok(lost)
    }

    async fn lost_volume(&self, number: i64) -> Result<LostVolume, CatalogError> {
        let values = [number.into()];
        let count = "SELECT count(*) AS tiles FROM tiles WHERE volume = $1";
        let tiles = |row: &Row| row.get::<i64>("tiles");
        let tiles = self.ask(count, &values, tiles).await?.pop();
        let pyramid =
            "SELECT pyramid FROM tiles WHERE volume = $1 AND pyramid LIKE 'tiles/%/%' LIMIT 1";
        let name = |row: &Row| row.get::<String>("pyramid");
        let name = self.ask(pyramid, &values, name).await?.pop();
        let name = name.and_then(|pyramid| {
            let (name, _) = pyramid.strip_prefix("tiles/")?.split_once('/')?;
            Some(name.to_owned())
        });
        Ok(LostVolume {
            number,
            tiles: tiles.map_or(0, i64::unsigned_abs),
            name,
        })
    }

    /// Takes rows of a lost volume out whose tiles the volume of its name has, and returns how many are left.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn take_out_lost(&self, lost: &LostVolume) -> Result<u64, CatalogError> {
        let take = "DELETE FROM tiles WHERE volume = $1 AND EXISTS \
                    (SELECT 1 FROM tiles AS other JOIN volumes ON volumes.id = other.volume \
                     WHERE volumes.name = $2 AND other.name = tiles.name AND other.deleted = 0)";
        let values = [lost.number.into(), Value::MaybeText(lost.name.as_deref())];
        let mut transaction = self.transaction(Durability::Durable).await?;
        let done = transaction.run(take, &values).await;
        done.map_err(|e| self.failed(e))?;
        transaction.commit().await.map_err(|e| self.failed(e))?;
        Ok(self.lost_volume(lost.number).await?.tiles)
    }

    /// Enters a volume. One that was lost gets its number again, and with it its tiles; no other ever gets a number of which there is
    /// anything.
    pub(super) async fn insert_volume(
        &self,
        name: &str,
        description: &str,
    ) -> Result<(), CatalogError> {
        let lost = self.lost_volumes().await?;
        let own = { lost.iter() }.find(|lost| lost.name.as_deref() == Some(name));
        let known = |row: &Row| Ok([row.get::<i64>("known")?, row.get::<i64>("read")?]);
        let question = "SELECT (SELECT coalesce(max(id), 0) FROM volumes) AS known, \
                        (SELECT coalesce(max(volume), 0) FROM cursors) AS read";
        let [known, read] = { self.ask(question, &[], known).await? }
            .pop()
            .unwrap_or([0, 0]);
        let held = lost.iter().map(|lost| lost.number).chain([read]).max();
        let held = held.unwrap_or(0);
        let number = match own {
            Some(own) => {
                log::warn!(
                    "the catalog's table \"volumes\" lacked volume {name:?}, whose {} tiles are there: it has them again",
                    own.tiles
                );
                Some(own.number)
            }
            None => (held > known).then(|| held.saturating_add(1)),
        };
        let mut values: Vec<Value<'_>> = vec![name.into(), description.into()];
        let insert = match number {
            None => {
                "INSERT INTO volumes (name, description) VALUES ($1, $2) ON CONFLICT DO NOTHING"
            }
            Some(number) => {
                values.push(number.into());
                "INSERT INTO volumes (name, description, id, revision, tiles) VALUES ($1, $2, $3, \
                 (SELECT coalesce(max(newest), 0) FROM \
                   (SELECT max(revision) AS newest FROM tiles WHERE volume = $3 \
                    UNION ALL SELECT max(revision) FROM changes WHERE volume = $3) AS each_one), \
                 (SELECT count(*) FROM tiles WHERE volume = $3 AND deleted = 0)) ON CONFLICT DO NOTHING"
            }
        };
        let mut transaction = self.transaction(Durability::Durable).await?;
        let done = transaction.run(insert, &values).await;
        done.map_err(|e| self.failed(e))?;
        transaction.commit().await.map_err(|e| self.failed(e))
    }
}
