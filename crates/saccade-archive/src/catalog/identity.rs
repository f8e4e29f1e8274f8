//! What tells the archive of a catalog from every other.

use super::database::Durability;
use super::{Catalog, CatalogError};

/// Pyramids that are looked for, where it is to be found out whether they are there.
const SAMPLE: u32 = 16;

impl Catalog {
    /// The archive's identity, as far as the catalog has one. Those of earlier versions have none.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn identity(&self) -> Result<Option<String>, CatalogError> {
        let question = "SELECT identity FROM archive WHERE part = 1";
        let found = self.ask(question, &[], |row| row.get("identity")).await?;
        Ok(found.into_iter().next())
    }

    /// Gives the archive an identity, unless it has one; returns the one it has now. Of several processes
    /// that do this at once, all get the same answer.
    ///
    /// # Errors
    ///
    /// [`CatalogError::ReadOnly`], or what the database says.
    pub async fn give_identity(&self, identity: &str) -> Result<String, CatalogError> {
        let mut transaction = self.transaction(Durability::Durable).await?;
        let give =
            "INSERT INTO archive (part, identity) VALUES (1, $1) ON CONFLICT (part) DO NOTHING";
        let given = transaction.run(give, &[identity.into()]).await;
        given.map_err(|e| self.failed(e))?;
        transaction.commit().await.map_err(|e| self.failed(e))?;
        let now = self.identity().await?;
        Ok(now.unwrap_or_else(|| identity.to_owned()))
    }

    /// As an earlier version left it.
    #[cfg(test)]
    pub(crate) async fn forget_identity(&self) -> Result<(), CatalogError> {
        let mut transaction = self.transaction(Durability::Durable).await?;
        let forgotten = transaction.run("DELETE FROM archive", &[]).await;
        forgotten.map_err(|e| self.failed(e))?;
        transaction.commit().await.map_err(|e| self.failed(e))
    }

    /// Name of a pyramid of a volume; none while it has no tiles.
    ///
    /// # Errors
    ///
    /// [`CatalogError::UnknownVolume`], or what the database says.
    pub async fn pyramid_of(&self, volume: &str) -> Result<Option<String>, CatalogError> {
        let id = self.volume_id(volume).await?;
        let question = "SELECT pyramid FROM tiles WHERE volume = $1 AND deleted = 0 LIMIT 1";
        let values = [id.into()];
        let found = self.ask(question, &values, |row| row.get("pyramid"));
        Ok(found.await?.into_iter().next())
    }

    /// Names of some pyramids of any volume; none while there are no tiles.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn some_pyramids(&self) -> Result<Vec<String>, CatalogError> {
        let question = "SELECT pyramid FROM tiles WHERE deleted = 0 LIMIT $1";
        let sample = [SAMPLE.into()];
        self.ask(question, &sample, |row| row.get("pyramid")).await
    }
}
