//! A catalog in a PostgreSQL database: connecting, what the server must promise, which schema it has.

use std::cmp::Ordering;
use std::str::FromStr;
use std::time::Duration;

use sqlx::migrate::{MigrateError, Migrator};
use sqlx::postgres::{PgConnectOptions, PgListener, PgPoolOptions};
use sqlx::{ConnectOptions, Connection as _, PgConnection, PgPool};

use super::{CatalogError, CatalogLocation};

pub(super) static MIGRATOR: Migrator = sqlx::migrate!("migrations/postgres");

/// Tells of new revisions, as `REVISION VOLUME`.
pub(super) const CHANNEL: &str = "saccade";

/// How long a request waits for a connection, before it fails and its caller decides.
const PATIENCE: Duration = Duration::from_secs(4);

const CONNECTIONS: u32 = 8;

/// Connects to a database that has a catalog, or with `create` makes one in an empty database.
pub(super) async fn open(url: &str, create: bool) -> Result<PgPool, CatalogError> {
    let location = CatalogLocation::Postgres(url.into());
    let options = PgConnectOptions::from_str(url).map_err(|source| CatalogError::Address {
        source,
        location: location.clone(),
    })?;
    let options = options.disable_statement_logging();
    let failed = |e| CatalogError::sort(e, &location);
    let pool = PgPoolOptions::new()
        .max_connections(CONNECTIONS)
        .acquire_timeout(PATIENCE)
        .after_connect(|connection, _| {
            Box::pin(async move {
                // Whatever the server, the database or the role says: an acknowledged tile stays.
                let sync = "SELECT set_config('synchronous_commit', 'on', false) \
                            WHERE current_setting('synchronous_commit') = 'off'";
                sqlx::query(sync).execute(connection).await.map(drop)
            })
        })
        .connect_with(options.clone())
        .await
        .map_err(failed)?;
    let sync = sqlx::query_scalar::<_, String>("SELECT current_setting('fsync')");
    if sync.fetch_one(&pool).await.map_err(failed)? != "on" {
        return Err(CatalogError::NotDurable {
            setting: "fsync",
            location,
        });
    }
    let known = MIGRATOR.iter().map(|m| m.version).max().unwrap_or(0);
    let found = schema(&pool, &location, create).await?;
    match found.cmp(&known) {
        Ordering::Equal => {
            let tables = "SELECT relname::text FROM pg_class WHERE relkind = 'r' \
                          AND relnamespace = to_regnamespace(current_schema())";
            let there: Vec<String> = sqlx::query_scalar(tables)
                .fetch_all(&pool)
                .await
                .map_err(failed)?;
            CatalogError::refuse_without(&there, &location)?;
            Ok(pool)
        }
        Ordering::Greater => Err(CatalogError::NewerSchema {
            found,
            known,
            location,
        }),
        Ordering::Less => {
            // Its lock is the connection's, and goes with it whatever happens.
            let mut connection = options.connect().await.map_err(failed)?;
            migrate(&mut connection, &location).await?;
            connection.close().await.map_err(failed)?;
            Ok(pool)
        }
    }
}

/// The newest migration that the database has seen; 0 if it is empty.
async fn schema(
    pool: &PgPool,
    location: &CatalogLocation,
    create: bool,
) -> Result<i64, CatalogError> {
    let failed = |e| CatalogError::sort(e, location);
    let question = "SELECT to_regclass('_sqlx_migrations') IS NOT NULL, \
                    coalesce(obj_description(to_regclass('volumes'), 'pg_class') = 'Saccade catalog', false), \
                    (SELECT count(*) FROM pg_class WHERE relkind = 'r' \
                     AND relnamespace = to_regnamespace(current_schema()))";
    let question = sqlx::query_as::<_, (bool, bool, i64)>(question);
    let (migrated, ours, tables) = question.fetch_one(pool).await.map_err(failed)?;
    // Who makes a catalog begins with the table of migrations.
    if !ours && tables > i64::from(migrated) {
        return Err(CatalogError::NotACatalog {
            location: location.clone(),
        });
    }
    if !ours {
        return if create {
            Ok(0)
        } else {
            Err(CatalogError::NotFound {
                location: location.clone(),
            })
        };
    }
    let newest = "SELECT coalesce(max(version), 0) FROM _sqlx_migrations";
    let newest = sqlx::query_scalar(newest).fetch_one(pool).await;
    newest.map_err(failed)
}

async fn migrate(
    connection: &mut PgConnection,
    location: &CatalogLocation,
) -> Result<(), CatalogError> {
    let done = MIGRATOR.run_direct(None, connection, false).await;
    done.map_err(|e| match e {
        MigrateError::Execute(e) | MigrateError::ExecuteMigration(e, _) => {
            CatalogError::sort(e, location)
        }
        e => CatalogError::sort(sqlx::Error::Migrate(Box::new(e)), location),
    })
}

/// Hears of commits from here on.
pub(super) async fn listen(pool: &PgPool) -> Result<PgListener, sqlx::Error> {
    let mut listener = PgListener::connect_with(pool).await?;
    // What was told while the connection was lost is asked for anew, by whoever holds the listener.
    listener.eager_reconnect(false);
    listener.listen(CHANNEL).await?;
    Ok(listener)
}
