//! A catalog in a file of SQLite's: what it may be, how it is used, which schema it has.

use std::cmp::Ordering;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU32};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, SystemTime};

use sqlx::migrate::{MigrateError, Migrator};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{ConnectOptions, Connection as _, SqliteConnection, SqlitePool};

use super::CatalogError;
use crate::clock::{Clock as _, SystemClock};
use crate::storage::open_regular;

mod alone;
mod replaced;

pub(super) use alone::Alone;
use replaced::Replaced;
pub(super) use replaced::{Away, Place};

pub(super) static MIGRATOR: Migrator = sqlx::migrate!("migrations/sqlite");

/// "Sacc": marks the file as ours, whatever tables it has.
const APPLICATION_ID: i64 = 0x5361_6363;

/// How long to wait for another process' transaction.
const BUSY: Duration = Duration::from_secs(20);

/// What may be done with the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Access {
    /// Everything.
    Write,
    /// Looking, while others may write.
    Read,
    /// Looking. Nobody was writing when it was opened, and there is no place for the shared memory
    /// through which a writer would tell of himself.
    ReadUnchanging,
}

pub(super) fn options(path: &Path, access: Access) -> SqliteConnectOptions {
    let options = SqliteConnectOptions::new()
        .filename(path)
        .busy_timeout(BUSY)
        .disable_statement_logging();
    match access {
        Access::Write => options
            .journal_mode(SqliteJournalMode::Wal)
            // NORMAL would lose acknowledged tiles at a power cut.
            .synchronous(SqliteSynchronous::Full)
            // By `Opened::tidy`, since SQLite keeps to itself how its own ended.
            .pragma("wal_autocheckpoint", "0")
            .foreign_keys(true),
        Access::Read => options.read_only(true),
        Access::ReadUnchanging => options.read_only(true).immutable(true),
    }
}

/// The connections to an open file.
#[derive(Debug)]
pub(super) struct Opened {
    pub(super) path: PathBuf,
    pub(super) access: Access,
    /// One connection, since SQLite lets one write at a time and waiting here costs no time-out;
    /// none if the file may only be read.
    pub(super) writer: Option<SqlitePool>,
    readers: SqlitePool,
    /// What took the place of the file since, for those who read.
    replaced: Box<Replaced>,
    closed: AtomicBool,
    /// Which file it was when it was opened; `None` if the system did not tell.
    id: Option<FileId>,
    /// Transactions in the write-ahead log, about.
    logged: AtomicU32,
    /// Why nothing may be written any more: a sync failed.
    stopped: OnceLock<String>,
    /// What the file looked like, and had, when it was last known whose it is.
    known: Mutex<Known>,
}

/// Length, and when it was written.
pub(super) type Stamp = (u64, SystemTime);

/// A file as it was when it was last known to be the right one.
#[derive(Debug, Default)]
struct Known {
    stamp: Option<Stamp>,
    alone: Alone,
}

/// Transactions in the write-ahead log from which on it is emptied: some megabytes.
const MOST_LOGGED: u32 = 100;

impl Opened {
    fn new(path: &Path, access: Access, writer: Option<SqlitePool>, readers: SqlitePool) -> Self {
        Self {
            path: path.to_owned(),
            access,
            id: FileId::of(path).ok(),
            writer,
            readers,
            replaced: Box::default(),
            closed: AtomicBool::new(false),
            // What is there from before is not known.
            logged: AtomicU32::new(MOST_LOGGED),
            stopped: OnceLock::new(),
            known: Mutex::default(),
        }
    }

    /// Lets nothing be written any more, since a sync failed.
    pub(super) fn stop(&self, reason: &str) {
        let _first_reason_stays = self.stopped.set(reason.to_owned());
    }

    /// Why nothing may be written any more, if so.
    pub(super) fn stopped(&self) -> Option<&str> {
        self.stopped.get().map(String::as_str)
    }

    /// What the file looks like, if that is not as it was kept: what was in the log was moved to it, or another
    /// was copied over it.
    pub(super) fn new_stamp(&self) -> Option<Stamp> {
        let now = self.stamp()?;
        (self.known().stamp != Some(now)).then_some(now)
    }

    fn stamp(&self) -> Option<Stamp> {
        let meta = std::fs::metadata(&self.path).ok()?;
        Some((meta.len(), meta.modified().ok()?))
    }

    /// The file that looks so, and has that if it could be read, is the right one.
    pub(super) fn keep(&self, stamp: Stamp, alone: Option<Alone>) {
        let mut known = self.known();
        known.stamp = Some(stamp);
        if let Some(alone) = alone {
            known.alone = alone;
        }
    }

    /// What the file itself has that looks so; `None` if it cannot be told now.
    pub(super) async fn alone(&self, stamp: Stamp) -> Option<Alone> {
        let alone = Alone::read(&self.path).await.ok()?;
        (self.stamp() == Some(stamp)).then_some(alone)
    }

    /// Whether that is what the file had at an earlier time.
    pub(super) fn is_older(&self, alone: &Alone) -> bool {
        alone.is_older_than(&self.known().alone)
    }

    /// Another file has its place.
    fn forget(&self) {
        *self.known() = Known::default();
    }

    fn known(&self) -> MutexGuard<'_, Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether the name is another file's by now, or nobody's. A disk that cannot be asked tells by itself.
    pub(super) fn is_elsewhere(&self) -> bool {
        match (self.id, FileId::of(&self.path)) {
            (Some(id), Ok(now)) => id != now,
            (Some(_), Err(e)) => e.kind() == std::io::ErrorKind::NotFound,
            (None, _) => false,
        }
    }

    /// Before a transaction: moves what is in the log to the file once it is long. Where a sync of that
    /// fails, all is still in the log, and is moved anew when the file is opened the next time.
    pub(super) async fn tidy(&self, connection: &mut SqliteConnection) -> Result<(), sqlx::Error> {
        if self.logged.fetch_add(1, Relaxed) >= MOST_LOGGED {
            let checkpoint = sqlx::query("PRAGMA wal_checkpoint(PASSIVE)");
            checkpoint.fetch_all(connection).await?;
            self.logged.store(0, Relaxed);
        }
        Ok(())
    }

    pub(super) async fn close(&self) {
        self.closed.store(true, Relaxed);
        self.close_connections().await;
    }

    pub(super) fn is_closed(&self) -> bool {
        self.closed.load(Relaxed)
    }

    async fn close_connections(&self) {
        self.readers().close().await;
        self.readers.close().await;
        if let Some(writer) = &self.writer {
            writer.close().await;
        }
    }
}

/// Opens the file: for writing if that is allowed, and then makes it if it is missing; else for
/// reading.
pub(super) async fn open(path: &Path) -> Result<Opened, CatalogError> {
    refuse_foreign_file(path)?;
    if is_write_protected(path) {
        open_to_read(path).await
    } else {
        open_to_write(path).await
    }
}

async fn open_to_write(path: &Path) -> Result<Opened, CatalogError> {
    refuse_network(path)?;
    let access = Access::Write;
    let writer = SqlitePoolOptions::new()
        .max_connections(1)
        // On a full disk SQLite may end a transaction by itself, and the connection then takes it
        // for open for ever: such a one is replaced.
        .before_acquire(|connection, _| {
            let usable = !connection.is_in_transaction();
            Box::pin(async move { Ok(usable) })
        });
    let options = options(path, access).create_if_missing(true);
    let writer = connect(writer, options, path).await?;
    migrate(&writer, path).await?;
    refuse_without_tables(&writer, path).await?;
    let readers = open_readers(path, access).await?;
    Ok(Opened::new(path, access, Some(writer), readers))
}

pub(super) async fn open_to_read(path: &Path) -> Result<Opened, CatalogError> {
    // SQLite removes the log when the last writer is done.
    let access = if log_of(path).exists() {
        refuse_network(path)?;
        Access::Read
    } else {
        Access::ReadUnchanging
    };
    let readers = open_readers(path, access).await?;
    refuse_other_schema(&readers, path).await?;
    refuse_without_tables(&readers, path).await?;
    Ok(Opened::new(path, access, None, readers))
}

async fn open_readers(path: &Path, access: Access) -> Result<SqlitePool, CatalogError> {
    let readers = SqlitePoolOptions::new().max_connections(4);
    connect(readers, options(path, access), path).await
}

/// Opens a pool. Where two processes open a new file at once, the switch to the write-ahead log is
/// refused to one of them, whatever the time-out: that one tries again.
async fn connect(
    pool: SqlitePoolOptions,
    options: SqliteConnectOptions,
    path: &Path,
) -> Result<SqlitePool, CatalogError> {
    const TRIES: u32 = 100;
    let pool = pool.acquire_timeout(BUSY);
    let mut tries = 0;
    loop {
        match pool.clone().connect_with(options.clone()).await {
            Ok(pool) => return Ok(pool),
            Err(e) => {
                let error = CatalogError::sort(e, &path.into());
                tries += 1;
                if !error.is_busy() || tries == TRIES {
                    return Err(error);
                }
                SystemClock.sleep(BUSY / TRIES).await;
            }
        }
    }
}

/// Opens for reading what has come to the place of a file that was open: what it holds is nobody's to change.
async fn open_again(path: &Path) -> Result<Opened, CatalogError> {
    refuse_foreign_file(path)?;
    if is_write_protected(path) {
        return open_to_read(path).await;
    }
    refuse_network(path)?;
    let access = Access::Write;
    let readers = open_readers(path, access).await?;
    refuse_other_schema(&readers, path).await?;
    refuse_without_tables(&readers, path).await?;
    Ok(Opened::new(path, access, None, readers))
}

/// Whether the file is there, but may not be changed: permissions, or a read-only file system.
fn is_write_protected(path: &Path) -> bool {
    use std::io::ErrorKind::{PermissionDenied, ReadOnlyFilesystem};
    let opened = File::options().write(true).open(path);
    opened.is_err_and(|e| matches!(e.kind(), PermissionDenied | ReadOnlyFilesystem))
}

/// SQLite's write-ahead log.
pub(super) fn log_of(path: &Path) -> PathBuf {
    beside(path, "-wal")
}

/// What SQLite's processes share of the log.
pub(super) fn shared_memory_of(path: &Path) -> PathBuf {
    beside(path, "-shm")
}

fn beside(path: &Path, end: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(end);
    name.into()
}

/// Tells a file from every other of its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FileId {
    device: u64,
    pub(super) inode: u64,
}

impl FileId {
    /// Of the file that has that name now.
    #[cfg(unix)]
    pub(super) fn of(path: &Path) -> std::io::Result<Self> {
        use std::os::unix::fs::MetadataExt as _;
        let meta = std::fs::metadata(path)?;
        Ok(Self {
            device: meta.dev(),
            inode: meta.ino(),
        })
    }

    /// Of the file that has that name now.
    #[cfg(not(unix))]
    pub(super) fn of(_: &Path) -> std::io::Result<Self> {
        Err(std::io::ErrorKind::Unsupported.into())
    }
}

/// A file that is not SQLite's is refused before SQLite touches it.
fn refuse_foreign_file(path: &Path) -> Result<(), CatalogError> {
    let mut head = Vec::new();
    let read = open_regular(path).and_then(|f| f.take(16).read_to_end(&mut head));
    let foreign = match read {
        Ok(_) => !head.is_empty() && head != b"SQLite format 3\0",
        // A pipe, of which nobody knows who would answer.
        Err(error) => error.kind() == std::io::ErrorKind::NotSeekable,
    };
    if foreign {
        Err(CatalogError::NotACatalog {
            location: path.into(),
        })
    } else {
        Ok(())
    }
}

/// Refuses what is no catalog.
pub(super) async fn refuse_foreign(path: &Path) -> Result<(), CatalogError> {
    refuse_foreign_file(path)?;
    let failed = |e| CatalogError::sort(e, &path.into());
    let options = options(path, Access::Write);
    let mut connection = options.connect().await.map_err(failed)?;
    refuse_foreign_database(&mut connection, path).await?;
    connection.close().await.map_err(failed)
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
            location: path.into(),
        }),
        None => Ok(()),
    }
}

#[cfg(not(target_os = "linux"))]
fn refuse_network(_: &Path) -> Result<(), CatalogError> {
    Ok(())
}

async fn migrate(pool: &SqlitePool, path: &Path) -> Result<(), CatalogError> {
    let failed = |e| CatalogError::sort(e, &path.into());
    let mut connection = pool.acquire().await.map_err(failed)?;
    // Two processes may make the same catalog at once: the one that loses looks again.
    let mut attempts = 0;
    loop {
        refuse_foreign_database(&mut connection, path).await?;
        refuse_without_schema(&mut connection, path).await?;
        match MIGRATOR.run_direct(None, &mut *connection, false).await {
            Ok(()) => return Ok(()),
            Err(MigrateError::VersionMissing(found) | MigrateError::VersionTooNew(found, _)) => {
                return Err(newer_schema(found, path));
            }
            Err(MigrateError::Execute(e) | MigrateError::ExecuteMigration(e, _)) => {
                let error = failed(e);
                // Nothing that was written before a failed sync is sure to be there.
                let lasts = matches!(error, CatalogError::NotSynced { .. });
                if lasts || attempts == 20 {
                    return Err(error);
                }
                log::debug!("another process is making the catalog: {error}");
                attempts += 1;
                SystemClock.sleep(Duration::from_millis(50)).await;
            }
            Err(e) => return Err(failed(sqlx::Error::Migrate(Box::new(e)))),
        }
    }
}

fn known_schema() -> i64 {
    MIGRATOR.iter().map(|m| m.version).max().unwrap_or(0)
}

fn newer_schema(found: i64, path: &Path) -> CatalogError {
    CatalogError::NewerSchema {
        found,
        known: known_schema(),
        location: path.into(),
    }
}

/// A file that may only be read must have this program's schema already.
async fn refuse_other_schema(pool: &SqlitePool, path: &Path) -> Result<(), CatalogError> {
    let failed = |e| CatalogError::sort(e, &path.into());
    let mut connection = pool.acquire().await.map_err(failed)?;
    refuse_foreign_database(&mut connection, path).await?;
    refuse_without_schema(&mut connection, path).await?;
    let query = sqlx::query_scalar("SELECT coalesce(max(version), 0) FROM _sqlx_migrations");
    let found: i64 = query.fetch_one(&mut *connection).await.map_err(failed)?;
    match found.cmp(&known_schema()) {
        Ordering::Equal => Ok(()),
        Ordering::Greater => Err(newer_schema(found, path)),
        Ordering::Less => Err(CatalogError::OlderSchema {
            found,
            known: known_schema(),
            location: path.into(),
        }),
    }
}

/// Where a catalog does not say which schema it has, its tables would be made once more.
async fn refuse_without_schema(
    connection: &mut SqliteConnection,
    path: &Path,
) -> Result<(), CatalogError> {
    let failed = |e| CatalogError::sort(e, &path.into());
    // In this order: who makes the catalog at the same time enters its schema with its tables.
    let question = "SELECT (SELECT count(*) FROM sqlite_schema WHERE type = 'table' AND name = 'volumes'), \
                    (SELECT count(*) FROM sqlite_schema WHERE type = 'table' AND name = '_sqlx_migrations')";
    let (volumes, schema): (i64, i64) = sqlx::query_as(question)
        .fetch_one(&mut *connection)
        .await
        .map_err(failed)?;
    if volumes == 0 {
        return Ok(());
    }
    let says = if schema == 0 {
        false
    } else {
        let question = "SELECT EXISTS (SELECT 1 FROM _sqlx_migrations)";
        let asked = sqlx::query_scalar(question).fetch_one(connection);
        asked.await.map_err(failed)?
    };
    if says {
        Ok(())
    } else {
        Err(CatalogError::NoTable {
            table: "_sqlx_migrations".to_owned(),
            location: path.into(),
        })
    }
}

/// Of a file that was damaged, or that somebody has changed, tables may be gone; that is told before anything is done.
async fn refuse_without_tables(pool: &SqlitePool, path: &Path) -> Result<(), CatalogError> {
    let question = "SELECT name FROM sqlite_schema WHERE type = 'table'";
    let there: Vec<String> = sqlx::query_scalar(question)
        .fetch_all(pool)
        .await
        .map_err(|e| CatalogError::sort(e, &path.into()))?;
    CatalogError::refuse_without(&there, &path.into())
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
        .map_err(|e| CatalogError::sort(e, &path.into()))?;
    let foreign = tables > 0 && id != APPLICATION_ID;
    if foreign {
        Err(CatalogError::NotACatalog {
            location: path.into(),
        })
    } else {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec3, UVec2, UVec3};
    use saccade_core::transform::SectionFromTile;
    use saccade_core::volume::Volume;

    use super::*;
    use crate::catalog::database::Database;
    use crate::catalog::{Catalog, NewTile};

    #[tokio::test]
    async fn a_transaction_that_sqlite_ended_holds_up_no_other() {
        let folder = tempfile::tempdir().unwrap();
        let opened = open(&folder.path().join("catalog.sqlite")).await.unwrap();
        let writer = opened.writer.unwrap();
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

    #[tokio::test(flavor = "multi_thread", worker_threads = 4)]
    async fn a_new_file_may_be_opened_by_many_at_once() {
        for _ in 0..60 {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("catalog.sqlite");
            let open = || {
                tokio::spawn({
                    let path = path.clone();
                    async move { open(&path).await.map(|opened| opened.access) }
                })
            };
            for opening in [open(), open(), open(), open(), open()] {
                assert_eq!(opening.await.unwrap().unwrap(), Access::Write);
            }
        }
    }

    async fn written() -> (tempfile::TempDir, PathBuf, Catalog) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("catalog.sqlite");
        let catalog = Catalog::create(&path).await.unwrap();
        let volume = Volume::new("v", UVec3::new(64, 64, 4), DVec3::ONE).unwrap();
        catalog.create_volume(&volume).await.unwrap();
        catalog.commit_tile("v", &tile("a")).await.unwrap();
        (folder, path, catalog)
    }

    fn tile(name: &str) -> NewTile {
        NewTile {
            name: name.to_owned(),
            section: 0,
            channel: 0,
            size: UVec2::splat(8),
            transform: SectionFromTile::translation(glam::DVec2::ZERO),
            pyramid: format!("tiles/{name}"),
            position: 0,
        }
    }

    #[tokio::test]
    async fn a_full_catalog_is_as_it_was_and_goes_on() {
        let (_folder, _, catalog) = written().await;
        let Database::Sqlite(opened) = &catalog.inner.database else {
            panic!("a file")
        };
        // The only connection that writes: what it is told holds for all.
        let writer = opened.writer.as_ref().unwrap();
        let pages: i64 = {
            sqlx::query_scalar("PRAGMA page_count")
                .fetch_one(writer)
                .await
        }
        .unwrap();
        let room = |pages: i64| sqlx::AssertSqlSafe(format!("PRAGMA max_page_count = {pages}"));
        sqlx::query(room(pages)).execute(writer).await.unwrap();
        let mut entered = 1;
        let full = loop {
            match catalog
                .commit_tile("v", &tile(&format!("t{entered}")))
                .await
            {
                Ok(_) => entered += 1,
                Err(error) => break error,
            }
            assert!(entered < 10_000, "it never fills");
        };
        assert!(matches!(full, CatalogError::Full { .. }), "{full}");
        assert!(
            full.is_outage() && full.to_string().contains("free some"),
            "{full}"
        );
        let count = async || catalog.entry("v").await.unwrap().tiles;
        assert_eq!(count().await, entered);
        sqlx::query(room(1 << 30)).execute(writer).await.unwrap();
        catalog.commit_tile("v", &tile("again")).await.unwrap();
        assert_eq!(count().await, entered + 1);
    }

    /// SQLite goes on with a file that has lost its name, whose content is lost when it is closed.
    #[tokio::test]
    async fn what_is_moved_deleted_or_replaced_is_written_to_no_more() {
        let (folder, path, catalog) = written().await;
        let away = folder.path().join("away.sqlite");
        let moved = |error: &CatalogError| matches!(error, CatalogError::Moved { .. });
        std::fs::rename(&path, &away).unwrap();
        let refused = catalog.commit_tile("v", &tile("b")).await.unwrap_err();
        assert!(moved(&refused) && !refused.is_transient(), "{refused}");
        // Another in its place is not it either.
        std::fs::copy(&away, &path).unwrap();
        let refused = catalog.commit_tile("v", &tile("b")).await.unwrap_err();
        assert!(moved(&refused), "{refused}");
        assert_eq!(catalog.entry("v").await.unwrap().tiles, 1);
        std::fs::rename(&away, &path).unwrap();
        catalog.commit_tile("v", &tile("b")).await.unwrap();

        // Taken away in the middle of a transaction.
        let mut commit = catalog.begin("v").await.unwrap();
        commit.tile(&tile("c"), SystemTime::now()).await.unwrap();
        std::fs::remove_file(&path).unwrap();
        let refused = commit.finish().await.unwrap_err();
        assert!(moved(&refused), "{refused}");
        let said = refused.to_string();
        assert!(
            said.contains("moved, deleted or replaced") && said.contains("put it back"),
            "{said}"
        );
    }

    /// As another program would, such as a backup: this one, once more.
    #[tokio::test]
    async fn who_has_locked_it_is_told() {
        const LOCKS: &str = "SACCADE_TEST_LOCKS_CATALOG";
        const NAME: &str = "catalog::sqlite::tests::who_has_locked_it_is_told";
        if let Some(path) = std::env::var_os(LOCKS) {
            let mut other = options(Path::new(&path), Access::Write)
                .connect()
                .await
                .unwrap();
            sqlx::query("BEGIN IMMEDIATE")
                .execute(&mut other)
                .await
                .unwrap();
            std::io::Write::write_all(&mut std::io::stdout(), b"\nlocked\n").unwrap();
            let _until_it_is_closed = std::io::stdin().read_to_end(&mut Vec::new());
            return;
        }
        let (_folder, path, catalog) = written().await;
        catalog.close().await;
        let mut other = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", NAME, "--nocapture"])
            .env(LOCKS, &path)
            .stdin(std::process::Stdio::piped())
            .stdout(std::process::Stdio::piped())
            .spawn()
            .unwrap();
        let said = std::io::BufReader::new(other.stdout.take().unwrap());
        let mut said = std::io::BufRead::lines(said).map_while(Result::ok);
        assert!(said.any(|line| line == "locked"));
        let holders = super::super::holders::of(&path);
        let id = format!("(process {})", other.id());
        drop(other.stdin.take());
        other.wait().unwrap();
        assert!(
            holders.len() == 1 && holders[0].ends_with(&id),
            "{holders:?}"
        );
        let locked = CatalogError::Locked {
            source: sqlx::Error::PoolTimedOut,
            holders,
            location: path.as_path().into(),
        };
        let said = locked.to_string();
        assert!(
            locked.is_transient() && said.contains("is locked by ") && said.contains(&id),
            "{said}"
        );
        assert!(super::super::holders::of(&path).is_empty());
    }

    #[tokio::test]
    async fn a_damaged_file_is_named_with_the_way_out() {
        let (_folder, path, catalog) = written().await;
        catalog.close().await;
        let mut bytes = std::fs::read(&path).unwrap();
        let page = 4096;
        bytes[page..].fill(0x5a);
        std::fs::write(&path, bytes).unwrap();
        let refused = Catalog::create(&path).await.err().unwrap();
        let said = refused.to_string();
        assert!(matches!(refused, CatalogError::Damaged { .. }), "{said}");
        assert!(
            said.contains("copy") && said.contains("saccade check"),
            "{said}"
        );
    }

    async fn to_read(path: &Path) -> Catalog {
        let opened = Database::Sqlite(open_to_read(path).await.unwrap());
        Catalog::of(path.into(), opened)
    }

    fn access(catalog: &Catalog) -> Access {
        match &catalog.inner.database {
            Database::Sqlite(opened) => opened.access,
            Database::Postgres(_) => panic!("a file"),
        }
    }

    #[tokio::test]
    async fn who_may_only_read_follows_who_writes() {
        let (_folder, path, writing) = written().await;
        let reading = to_read(&path).await;
        assert_eq!(access(&reading), Access::Read);
        let mut heard = reading.subscribe("v").await.unwrap();
        assert_eq!(*heard.borrow_and_update(), 1);
        writing.commit_tile("v", &tile("b")).await.unwrap();
        let hear = heard.wait_for(|revision| *revision == 2);
        tokio::time::timeout(BUSY, hear).await.unwrap().unwrap();
        assert_eq!(reading.section_tiles("v", 0).await.unwrap().len(), 2);
        let refused = reading.commit_tile("v", &tile("c")).await.unwrap_err();
        assert!(
            matches!(refused, CatalogError::ReadOnly { .. }),
            "{refused}"
        );
    }

    #[tokio::test]
    async fn a_finished_file_can_be_read_without_writing_beside_it() {
        let (folder, path, writing) = written().await;
        writing.close().await;
        let reading = to_read(&path).await;
        assert_eq!(access(&reading), Access::ReadUnchanging);
        assert_eq!(reading.entry("v").await.unwrap().tiles, 1);
        let files = std::fs::read_dir(folder.path()).unwrap().count();
        assert_eq!(files, 1, "neither log nor shared memory");
    }

    #[tokio::test]
    async fn other_schemas_cannot_be_read() {
        let (_folder, path, writing) = written().await;
        for (version, older) in [(known_schema() + 1, false), (known_schema() - 1, true)] {
            let Database::Sqlite(Opened {
                writer: Some(writer),
                ..
            }) = &writing.inner.database
            else {
                panic!("a file that may be written")
            };
            // Of all migrations that would be there, only the last counts.
            let forget = "DELETE FROM _sqlx_migrations \
                          WHERE version < (SELECT max(version) FROM _sqlx_migrations)";
            sqlx::query(forget).execute(writer).await.unwrap();
            let query = sqlx::query("UPDATE _sqlx_migrations SET version = ?").bind(version);
            query.execute(writer).await.unwrap();
            match open_to_read(&path).await.err().unwrap() {
                CatalogError::OlderSchema { .. } => assert!(older),
                CatalogError::NewerSchema { .. } => assert!(!older),
                other => panic!("{other}"),
            }
        }
    }
}
