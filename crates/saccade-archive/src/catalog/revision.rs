//! A volume's revision against the revisions that its changes and its tiles have.

use super::database::{Durability, Row};
use super::{Catalog, CatalogError, rows};

/// The largest revision that is believed: browsers count no further one by one.
const LARGEST: i64 = 1 << 53;

/// A volume whose revision cannot be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WrongRevision {
    /// The volume's name, or what can be read of it.
    pub volume: String,
    /// What the catalog says.
    pub says: i64,
    /// The largest of its changes and its tiles.
    pub reached: u64,
    id: i64,
}

impl Catalog {
    /// Volumes whose revision is smaller than that of a change or a tile of theirs, so that nothing can be written, or larger
    /// than any can be. Looks at all tiles.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn wrong_revisions(&self) -> Result<Vec<WrongRevision>, CatalogError> {
        let question = "SELECT v.id AS id, v.name AS name, v.revision AS revision, \
                        coalesce((SELECT max(c.revision) FROM changes c WHERE c.volume = v.id \
                         AND c.revision BETWEEN 0 AND 9007199254740992), 0) AS changed, \
                        coalesce((SELECT max(t.revision) FROM tiles t WHERE t.volume = v.id \
                         AND t.revision BETWEEN 0 AND 9007199254740992), 0) AS entered \
                        FROM volumes v ORDER BY v.name";
        let wrong = |row: &Row| {
            let reached = rows::unsigned(row, "changed")?.max(rows::unsigned(row, "entered")?);
            let says: i64 = row.get("revision")?;
            let is_wrong =
                says > LARGEST || u64::try_from(says).map_or(true, |says| says < reached);
            let id = row.get("id")?;
            Ok(is_wrong.then(|| WrongRevision {
                volume: rows::legible(row, "name"),
                says,
                reached,
                id,
            }))
        };
        let wrong = self.ask(question, &[], wrong).await?;
        Ok(wrong.into_iter().flatten().collect())
    }

    /// Sets a volume's revision to the largest of its changes and its tiles, if it is still the one that was found.
    ///
    /// # Errors
    ///
    /// [`CatalogError::ReadOnly`], or what the database says.
    pub async fn mend_revision(&self, wrong: &WrongRevision) -> Result<(), CatalogError> {
        let mut transaction = self.transaction(Durability::Durable).await?;
        let update = "UPDATE volumes SET revision = $3 WHERE id = $1 AND revision = $2";
        let values = [wrong.id.into(), wrong.says.into(), wrong.reached.into()];
        let done = transaction.run(update, &values).await;
        done.map_err(|e| self.failed(e))?;
        transaction.commit().await.map_err(|e| self.failed(e))
    }
}
