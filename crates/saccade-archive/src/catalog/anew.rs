//! Tables that are gone, made anew.

use std::path::Path;
use std::str::FromStr as _;

use sqlx::migrate::MigrateError;
use sqlx::postgres::PgConnectOptions;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{AssertSqlSafe, ConnectOptions as _, Connection as _, PgConnection, SqliteConnection};

use super::{Catalog, CatalogError, CatalogLocation, TABLES, postgres, sqlite};

/// Where PostgreSQL's tables are made, before those that are wanted are moved to the catalog.
const PATTERN: &str = "saccade_anew";

impl Catalog {
    /// Makes the tables that a catalog lacks, empty, and returns their names. What was in them is lost: `saccade check
    /// --repair` finds it out from the records, and `saccade ingest` takes it in again. The table of volumes is not made
    /// anew, without which nothing else means anything.
    ///
    /// # Errors
    ///
    /// [`CatalogError::NoTable`] if the table of volumes is gone, [`CatalogError::NotACatalog`], or what the database says.
    pub async fn make_tables_anew(
        location: &CatalogLocation,
    ) -> Result<Vec<&'static str>, CatalogError> {
        let made = match location {
            CatalogLocation::File(path) => {
                sqlite::refuse_foreign(path).await?;
                in_file(path, location).await
            }
            CatalogLocation::Postgres(url) => in_database(url, location).await,
        };
        match made {
            Ok(Some(made)) => Ok(made),
            Ok(None) => Err(CatalogError::NoTable {
                table: TABLES[0].to_owned(),
                location: location.clone(),
            }),
            Err(e) => Err(CatalogError::sort(e, location)),
        }
    }
}

/// Tables that are not among these; `None` if that of volumes is not.
fn lacking(there: &[String]) -> Option<Vec<&'static str>> {
    let lacks = |table: &&str| there.iter().all(|name| name != *table);
    let lacking: Vec<_> = TABLES.into_iter().filter(lacks).collect();
    (lacking.first() != Some(&TABLES[0])).then_some(lacking)
}

fn failed(error: MigrateError) -> sqlx::Error {
    match error {
        MigrateError::Execute(e) | MigrateError::ExecuteMigration(e, _) => e,
        e => sqlx::Error::Migrate(Box::new(e)),
    }
}

/// A catalog in memory, as it should be.
async fn pattern() -> Result<SqliteConnection, sqlx::Error> {
    let mut pattern = SqliteConnectOptions::new()
        .in_memory(true)
        .connect()
        .await?;
    let migrated = sqlite::MIGRATOR.run_direct(None, &mut pattern, false).await;
    migrated.map_err(failed)?;
    Ok(pattern)
}

/// Names of the indexes that a catalog's file should have, and what makes them.
pub(super) async fn indexes() -> Result<Vec<(String, String)>, sqlx::Error> {
    let question = "SELECT name, sql FROM sqlite_schema WHERE type = 'index' AND sql IS NOT NULL ORDER BY name";
    sqlx::query_as(question)
        .fetch_all(&mut pattern().await?)
        .await
}

async fn in_file(
    path: &Path,
    location: &CatalogLocation,
) -> Result<Option<Vec<&'static str>>, sqlx::Error> {
    let mut pattern = pattern().await?;
    let mut connection = sqlite::options(path, sqlite::Access::Write)
        .connect()
        .await?;
    let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
    let names = "SELECT name FROM sqlite_schema WHERE type = 'table'";
    let there: Vec<String> = sqlx::query_scalar(names)
        .fetch_all(&mut *transaction)
        .await?;
    let Some(lacking) = lacking(&there) else {
        return Ok(None);
    };
    for table in &lacking {
        for statement in statements(&mut pattern, table).await? {
            // It is one of our own migrations', as SQLite keeps it.
            let made = sqlx::query(AssertSqlSafe(statement));
            made.execute(&mut *transaction).await?;
        }
        log::info!("the table {table} is made anew: {location}");
    }
    transaction.commit().await?;
    connection.close().await?;
    Ok(Some(lacking))
}

/// What makes a table and its indices.
async fn statements(
    pattern: &mut SqliteConnection,
    table: &str,
) -> Result<Vec<String>, sqlx::Error> {
    // "table" comes after "index".
    let question = "SELECT sql FROM sqlite_schema WHERE tbl_name = ? AND sql IS NOT NULL \
                    ORDER BY type DESC, name";
    let query = sqlx::query_scalar(question).bind(table);
    query.fetch_all(pattern).await
}

async fn in_database(
    url: &str,
    location: &CatalogLocation,
) -> Result<Option<Vec<&'static str>>, sqlx::Error> {
    let options = PgConnectOptions::from_str(url)?.disable_statement_logging();
    let mut connection = options.connect().await?;
    let mut transaction = connection.begin().await?;
    let (own, names) = (
        "SELECT current_schema()::text",
        "SELECT relname::text FROM pg_class WHERE relkind = 'r' \
         AND relnamespace = to_regnamespace(current_schema())",
    );
    let own: String = sqlx::query_scalar(own).fetch_one(&mut *transaction).await?;
    let there: Vec<String> = sqlx::query_scalar(names)
        .fetch_all(&mut *transaction)
        .await?;
    let ours = "SELECT coalesce(obj_description(to_regclass('volumes'), 'pg_class') = 'Saccade catalog', false)";
    let ours: bool = sqlx::query_scalar(ours)
        .fetch_one(&mut *transaction)
        .await?;
    let Some(lacking) = lacking(&there).filter(|_| ours) else {
        return Ok(None);
    };
    // Nobody else sees the pattern: it is gone when the transaction ends.
    run(&mut transaction, format!("CREATE SCHEMA {PATTERN}")).await?;
    run(
        &mut transaction,
        format!("SET LOCAL search_path = {PATTERN}"),
    )
    .await?;
    for migration in postgres::MIGRATOR.iter() {
        sqlx::raw_sql(migration.sql.clone())
            .execute(&mut *transaction)
            .await?;
    }
    for table in &lacking {
        // Names of volumes are the pattern's, not the catalog's.
        let question = "SELECT conname::text, pg_get_constraintdef(oid) FROM pg_constraint \
                        WHERE contype = 'f' AND conrelid = to_regclass($1)";
        let foreign: Vec<(String, String)> = sqlx::query_as(question)
            .bind(format!("{PATTERN}.{table}"))
            .fetch_all(&mut *transaction)
            .await?;
        // With its indices, under their names.
        let move_it = format!("ALTER TABLE {PATTERN}.{table} SET SCHEMA \"{own}\"");
        run(&mut transaction, move_it).await?;
        for (name, key) in foreign {
            let key = key.replace("REFERENCES ", &format!("REFERENCES \"{own}\"."));
            let change = format!(
                "ALTER TABLE \"{own}\".{table} DROP CONSTRAINT {name}, ADD CONSTRAINT {name} {key}"
            );
            run(&mut transaction, change).await?;
        }
        log::info!("the table {table} is made anew: {location}");
    }
    run(&mut transaction, format!("DROP SCHEMA {PATTERN} CASCADE")).await?;
    transaction.commit().await?;
    connection.close().await?;
    Ok(Some(lacking))
}

/// Of names that are our own, and the schema's.
async fn run(transaction: &mut PgConnection, statement: String) -> Result<(), sqlx::Error> {
    let done = sqlx::query(AssertSqlSafe(statement)).execute(transaction);
    done.await.map(drop)
}
