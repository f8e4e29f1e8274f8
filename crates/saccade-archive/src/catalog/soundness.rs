//! Whether a catalog's file is as SQLite wrote it, and its indexes made anew.
//!
//! An index that lacks rows of its table makes tiles look gone that are there: who deletes what nothing names, or counts
//! tiles, looks at the file first.

use sqlx::{AssertSqlSafe, SqliteConnection};

use super::database::{Database, Durability, Transaction};
use super::{Catalog, CatalogError, anew, rows};

/// So much SQLite tells at most, which is more than anybody reads.
const LOOK: &str = "PRAGMA integrity_check(10000)";

impl Catalog {
    /// What SQLite finds wrong with the catalog's file, pages and indexes, in its words; nothing if it is sound. Pages that are
    /// lost to use harm nothing, and what is wrong with single rows is found with these: neither is told here. Reads all of the
    /// file. PostgreSQL has no such question: of a database nothing is told.
    ///
    /// # Errors
    ///
    /// [`CatalogError::Damaged`] if it cannot even be looked at, or what else the database says.
    pub async fn unsound(&self) -> Result<Vec<String>, CatalogError> {
        match &self.inner.database {
            Database::Postgres(_) => Ok(Vec::new()),
            Database::Sqlite(_) => {
                let said = |row: &_| Ok(rows::legible(row, "integrity_check"));
                Ok(of_the_file(&self.ask(LOOK, &[], said).await?))
            }
        }
    }

    /// Indexes that the catalog's file should have and has not, or has otherwise, as it is only after somebody else's hand: what
    /// they find is looked for row by row then, and nothing keeps two tiles from having one name. Of a PostgreSQL database nothing
    /// is told.
    ///
    /// # Errors
    ///
    /// What the database says.
    pub async fn lacking_indexes(&self) -> Result<Vec<String>, CatalogError> {
        let Database::Sqlite(_) = &self.inner.database else {
            return Ok(Vec::new());
        };
        let names = "SELECT name, sql FROM sqlite_schema WHERE type = 'index' AND sql IS NOT NULL";
        let there = |row: &_| Ok((rows::legible(row, "name"), rows::legible(row, "sql")));
        let there: Vec<(String, String)> = self.ask(names, &[], there).await?;
        let should = anew::indexes().await.map_err(|e| self.failed(e))?;
        let lacking = should.into_iter().filter(|index| !there.contains(index));
        Ok(lacking.map(|(name, _)| name).collect())
    }

    /// Makes an index that the catalog's file lacks, or has otherwise. `false` if its rows do not allow it: two tiles have one name.
    ///
    /// # Errors
    ///
    /// [`CatalogError::ReadOnly`], or what the database says.
    pub async fn make_index(&self, name: &str) -> Result<bool, CatalogError> {
        let should = anew::indexes().await.map_err(|e| self.failed(e))?;
        let mut transaction = self.transaction(Durability::Durable).await?;
        let Transaction::Sqlite(connection) = &mut transaction else {
            return Ok(false);
        };
        let Some((_, statement)) = should.into_iter().find(|(index, _)| index == name) else {
            return Ok(false);
        };
        // Both are of our own migrations, as SQLite keeps them.
        let drop = format!("DROP INDEX IF EXISTS {name}");
        let dropped = sqlx::query(AssertSqlSafe(drop)).execute(&mut **connection);
        dropped.await.map_err(|e| self.failed(e))?;
        let made = sqlx::query(AssertSqlSafe(statement)).execute(&mut **connection);
        match made.await {
            Ok(_) => {}
            Err(sqlx::Error::Database(said)) if primary(&*said) == Some(19) => return Ok(false),
            Err(other) => return Err(self.failed(other)),
        }
        transaction.commit().await.map_err(|e| self.failed(e))?;
        log::info!("the index {name} is made anew: {}", self.location());
        Ok(true)
    }

    /// Makes all indexes of a file anew from their tables, if that makes it sound; else it is left as it is, and what is wrong
    /// then is returned. It is also left where an index has more rows than its table: these are lost, and the index is all that
    /// tells of them.
    ///
    /// # Errors
    ///
    /// [`CatalogError::ReadOnly`], or what the database says.
    pub async fn make_indexes_anew(&self) -> Result<Vec<String>, CatalogError> {
        let mut transaction = self.transaction(Durability::Durable).await?;
        let Transaction::Sqlite(connection) = &mut transaction else {
            return Ok(Vec::new());
        };
        let left = match remade(connection).await {
            Ok(left) => left,
            // Rows that are there twice, or pages that mean nothing.
            Err(sqlx::Error::Database(said)) if matches!(primary(&*said), Some(11 | 19)) => {
                vec![said.message().to_owned()]
            }
            Err(other) => return Err(self.failed(other)),
        };
        if left.is_empty() {
            transaction.commit().await.map_err(|e| self.failed(e))?;
            log::info!("indexes are made anew: {}", self.location());
        }
        Ok(left)
    }
}

/// SQLite's result code without its extension.
fn primary(error: &dyn sqlx::error::DatabaseError) -> Option<u32> {
    Some(error.code()?.parse::<u32>().ok()? & 0xff)
}

async fn remade(connection: &mut SqliteConnection) -> Result<Vec<String>, sqlx::Error> {
    let lost = lost_rows(connection).await?;
    if !lost.is_empty() {
        return Ok(lost);
    }
    sqlx::query("REINDEX").execute(&mut *connection).await?;
    let said: Vec<String> = sqlx::query_scalar(LOOK).fetch_all(connection).await?;
    Ok(of_the_file(&said))
}

/// Tables with fewer rows than an index of theirs.
async fn lost_rows(connection: &mut SqliteConnection) -> Result<Vec<String>, sqlx::Error> {
    let question = "SELECT t.name, i.name FROM pragma_table_list AS t, pragma_index_list(t.name) AS i \
                    WHERE t.schema = 'main' AND t.type = 'table' AND t.wr = 0 AND i.partial = 0";
    let indexes: Vec<(String, String)> =
        sqlx::query_as(question).fetch_all(&mut *connection).await?;
    let mut lost = Vec::new();
    for (table, index) in indexes {
        // Not `count(*)`, which SQLite counts in whichever index it likes.
        let rows = async |connection: &mut SqliteConnection, how: String| {
            let count = format!("SELECT coalesce(sum(1), 0) FROM \"{table}\" {how}");
            let count = sqlx::query_scalar(AssertSqlSafe(count)).fetch_one(connection);
            count.await as Result<i64, sqlx::Error>
        };
        let in_table = rows(connection, "NOT INDEXED".to_owned()).await?;
        // One that cannot be read tells nothing.
        let in_index = rows(connection, format!("INDEXED BY \"{index}\"")).await;
        let gone = in_index.map_or(0, |in_index| in_index - in_table);
        if gone > 0 {
            lost.push(format!(
                "table {table} lacks {gone} rows that its index {index} has"
            ));
        }
    }
    Ok(lost)
}

/// What is said of pages and indexes.
fn of_the_file(said: &[String]) -> Vec<String> {
    let lines = said.iter().flat_map(|said| said.lines());
    let of_the_file = |line: &&str| {
        let of_a_row = line.starts_with("CHECK constraint failed in ")
            || ["NULL value in ", "NUMERIC value in ", "TEXT value in "]
                .iter()
                .any(|of| line.starts_with(of))
            || (line.starts_with("non-") && line.contains(" value in "));
        let is_lost_page = line.starts_with("Page ") && line.ends_with(": never used");
        // Heads of lists.
        let is_nothing = *line == "ok" || line.starts_with("***") || line.trim().is_empty();
        !of_a_row && !is_lost_page && !is_nothing
    };
    let lines = lines.filter(of_the_file).map(str::to_owned);
    lines.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_said_of_rows_and_of_lost_pages_is_not_of_the_file() {
        let said = [
            "*** in database main ***\nTree 5 page 5 cell 0: Rowid 1 out of order\nPage 7: never used",
            "CHECK constraint failed in changes",
            "non-INTEGER value in tiles.section",
            "NULL value in tiles.name",
            "row 1 missing from index tiles_by_section",
        ];
        assert_eq!(
            of_the_file(&said.map(str::to_owned)),
            [
                "Tree 5 page 5 cell 0: Rowid 1 out of order",
                "row 1 missing from index tiles_by_section"
            ]
        );
        assert!(of_the_file(&["ok".to_owned()]).is_empty());
    }
}
