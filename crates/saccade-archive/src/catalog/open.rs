//! Opening the file: what it may be, how it is used, which schema it has.

use std::fs::File;
use std::io::Read;
use std::path::Path;
use std::time::Duration;

use sqlx::migrate::{MigrateError, Migrator};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{ConnectOptions, Connection as _, SqliteConnection, SqlitePool};

use super::CatalogError;

static MIGRATOR: Migrator = sqlx::migrate!();

/// "Sacc": marks the file as ours, whatever tables it has.
const APPLICATION_ID: i64 = 0x5361_6363;

/// How long to wait for another process' transaction.
const BUSY: Duration = Duration::from_secs(20);

pub(super) fn options(path: &Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new()
        .filename(path)
        .journal_mode(SqliteJournalMode::Wal)
        // NORMAL would lose acknowledged tiles at a power cut.
        .synchronous(SqliteSynchronous::Full)
        .busy_timeout(BUSY)
        .foreign_keys(true)
        .disable_statement_logging()
}

/// Opens the file for writing and for reading, makes it if it is missing.
pub(super) async fn open(path: &Path) -> Result<(SqlitePool, SqlitePool), CatalogError> {
    refuse_foreign_file(path)?;
    refuse_network(path)?;
    let failed = |e| CatalogError::from_sqlite(e, path);
    let writer = SqlitePoolOptions::new()
        .max_connections(1)
        .acquire_timeout(BUSY)
        // On a full disk SQLite may end a transaction by itself, and the connection then takes it
        // for open for ever: such a one is replaced.
        .before_acquire(|connection, _| {
            let usable = !connection.is_in_transaction();
            Box::pin(async move { Ok(usable) })
        })
        .connect_with(options(path).create_if_missing(true))
        .await
        .map_err(failed)?;
    migrate(&writer, path).await?;
    let readers = SqlitePoolOptions::new()
        .max_connections(4)
        .acquire_timeout(BUSY);
    let readers = readers.connect_with(options(path)).await.map_err(failed)?;
    Ok((writer, readers))
}

/// A file that is not SQLite's is refused before SQLite touches it.
fn refuse_foreign_file(path: &Path) -> Result<(), CatalogError> {
    let mut head = Vec::new();
    let read = File::open(path).and_then(|f| f.take(16).read_to_end(&mut head));
    let foreign = read.is_ok() && !head.is_empty() && head != b"SQLite format 3\0";
    if foreign {
        Err(CatalogError::NotACatalog {
            path: path.to_owned(),
        })
    } else {
        Ok(())
    }
}

#[cfg(target_os = "linux")]
fn refuse_network(path: &Path) -> Result<(), CatalogError> {
    // Magic numbers of statfs(2).
    const KINDS: [(u64, &str); 8] = [
        (0x6969, "NFS"),
        (0x517b, "SMB"),
        (0xff53_4d42, "CIFS"),
        (0xfe53_4d42, "SMB2"),
        (0x0bd0_0bd0, "Lustre"),
        (0x00c3_6400, "Ceph"),
        (0x5346_414f, "AFS"),
        (0x4750_4653, "GPFS"),
    ];
    let folder = path
        .parent()
        .filter(|p| !p.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    // A folder that cannot be asked about fails to open a moment later, with a better message.
    let Ok(stat) = rustix::fs::statfs(folder) else {
        return Ok(());
    };
    let magic = (stat.f_type as u64) & 0xffff_ffff;
    match KINDS.iter().find(|(number, _)| *number == magic) {
        Some((_, kind)) => Err(CatalogError::NetworkFilesystem {
            kind,
            path: path.to_owned(),
        }),
        None => Ok(()),
    }
}

#[cfg(not(target_os = "linux"))]
fn refuse_network(_: &Path) -> Result<(), CatalogError> {
    Ok(())
}

async fn migrate(pool: &SqlitePool, path: &Path) -> Result<(), CatalogError> {
    let failed = |e| CatalogError::from_sqlite(e, path);
    let mut connection = pool.acquire().await.map_err(failed)?;
    // Two processes may make the same catalog at once: the one that loses looks again.
    let mut attempts = 0;
    loop {
        refuse_foreign_database(&mut connection, path).await?;
        match MIGRATOR.run_direct(None, &mut *connection, false).await {
            Ok(()) => return Ok(()),
            Err(MigrateError::VersionMissing(found) | MigrateError::VersionTooNew(found, _)) => {
                let known = MIGRATOR.iter().map(|m| m.version).max().unwrap_or(0);
                return Err(CatalogError::NewerSchema {
                    found,
                    known,
                    path: path.to_owned(),
                });
            }
            Err(e @ (MigrateError::Execute(_) | MigrateError::ExecuteMigration(..)))
                if attempts < 20 =>
            {
                log::debug!("another process is making the catalog: {e}");
                attempts += 1;
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
            Err(e) => return Err(failed(sqlx::Error::Migrate(Box::new(e)))),
        }
    }
}

async fn refuse_foreign_database(
    connection: &mut SqliteConnection,
    path: &Path,
) -> Result<(), CatalogError> {
    let query = "SELECT (SELECT application_id FROM pragma_application_id), \
                 (SELECT count(*) FROM sqlite_schema WHERE name NOT LIKE '\\_sqlx%' ESCAPE '\\' \
                  AND name NOT LIKE 'sqlite\\_%' ESCAPE '\\')";
    let (id, tables): (i64, i64) = sqlx::query_as(query)
        .fetch_one(connection)
        .await
        .map_err(|e| CatalogError::from_sqlite(e, path))?;
    let foreign = tables > 0 && id != APPLICATION_ID;
    if foreign {
        Err(CatalogError::NotACatalog {
            path: path.to_owned(),
        })
    } else {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_transaction_that_sqlite_ended_holds_up_no_other() {
        let folder = tempfile::tempdir().unwrap();
        let (writer, _readers) = open(&folder.path().join("catalog.sqlite")).await.unwrap();
        for _ in 0..3 {
            let mut transaction = writer.begin_with("BEGIN IMMEDIATE").await.unwrap();
            // What SQLite does when the disk is full.
            sqlx::raw_sql("ROLLBACK")
                .execute(&mut *transaction)
                .await
                .unwrap();
            drop(transaction);
        }
        let transaction = writer.begin_with("BEGIN IMMEDIATE").await.unwrap();
        transaction.commit().await.unwrap();
    }
}
