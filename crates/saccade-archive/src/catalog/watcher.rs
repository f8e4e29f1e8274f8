//! Tells subscribers of new revisions, from this process at once and from others as soon as they are
//! heard of: a file is looked at, a server tells.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;

use sqlx::{ConnectOptions, Connection as _, PgPool, SqliteConnection};
use tokio::sync::watch;

use super::database::Database;
use super::identity::File;
use super::sqlite::{Away, Place};
use super::{CatalogError, Inner, postgres, rows, sqlite};
use crate::clock::{Clock as _, SystemClock};

/// How often to look for commits of other processes. Reading the counter costs some microseconds.
const POLL: Duration = Duration::from_millis(150);

/// Pause before a server that did not answer is asked again.
const TRY_AGAIN: Duration = Duration::from_millis(300);

/// A listener that hears nothing for so long asks: a connection can die without a word.
const SILENCE: Duration = Duration::from_secs(5);

#[derive(Debug, Default)]
pub(super) struct Watcher {
    senders: Mutex<BTreeMap<String, watch::Sender<u64>>>,
    following: AtomicBool,
}

impl Watcher {
    pub(super) fn subscribe(&self, catalog: &Arc<Inner>, volume: &str) -> watch::Receiver<u64> {
        let receiver = self
            .senders()
            .entry(volume.to_owned())
            .or_default()
            .subscribe();
        self.follow(catalog);
        receiver
    }

    /// Looks and listens from now on, until the catalog is closed.
    pub(super) fn follow(&self, catalog: &Arc<Inner>) {
        if !self.following.swap(true, Ordering::AcqRel) {
            tokio::spawn(follow(Following(Arc::downgrade(catalog))));
        }
    }

    /// Wakes the subscribers of a volume, if the revision is new to them.
    pub(super) fn announce(&self, volume: &str, revision: u64) {
        if let Some(sender) = self.senders().get(volume) {
            sender.send_if_modified(|known| {
                let newer = revision > *known;
                *known = revision.max(*known);
                newer
            });
        }
    }

    /// Wakes all subscribers: revisions count anew.
    pub(super) fn begin_anew(&self) {
        for sender in self.senders().values() {
            sender.send_replace(0);
        }
    }

    fn senders(&self) -> MutexGuard<'_, BTreeMap<String, watch::Sender<u64>>> {
        self.senders.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The task's hold on the catalog, which does not keep it open. A task that ends with its runtime
/// makes room for the next one.
struct Following(Weak<Inner>);

impl Following {
    /// The catalog, while somebody has it open.
    fn catalog(&self) -> Option<Arc<Inner>> {
        self.0.upgrade().filter(|c| !c.database.is_closed())
    }
}

impl Drop for Following {
    fn drop(&mut self) {
        if let Some(catalog) = self.0.upgrade() {
            catalog.watcher.following.store(false, Ordering::Release);
        }
    }
}

async fn follow(following: Following) {
    let pool = match following.catalog() {
        Some(catalog) => match &catalog.database {
            Database::Sqlite(_) => None,
            Database::Postgres(pool) => Some(pool.clone()),
        },
        None => return,
    };
    match pool {
        Some(pool) => listen(&following, &pool).await,
        None => poll(&following).await,
    }
}

/// Tells of all volumes, whatever was missed.
async fn announce_all(catalog: &Inner) -> Result<(), sqlx::Error> {
    let volumes = "SELECT name, revision FROM volumes";
    for row in catalog.database.all(volumes, &[]).await? {
        // One that is spoilt keeps no other from being told of.
        let name = rows::legible(&row, "name");
        if let Ok(revision) = rows::unsigned(&row, "revision") {
            catalog.watcher.announce(&name, revision);
        }
    }
    Ok(())
}

async fn listen(following: &Following, pool: &PgPool) {
    let mut lost = false;
    while let Some(catalog) = following.catalog() {
        let location = catalog.location.to_string();
        drop(catalog);
        match hear(following, pool, &mut lost).await {
            Ok(()) => return,
            Err(e) => {
                if !std::mem::replace(&mut lost, true) {
                    log::warn!("changes are not heard, trying again: {e}: {location}");
                }
                SystemClock.sleep(TRY_AGAIN).await;
            }
        }
    }
}

/// Hears until the catalog is closed.
async fn hear(following: &Following, pool: &PgPool, lost: &mut bool) -> Result<(), sqlx::Error> {
    let mut listener = postgres::listen(pool).await?;
    let mut ask = true;
    loop {
        if ask {
            let Some(catalog) = following.catalog() else {
                return Ok(());
            };
            if catalog.look_whose().await? {
                announce_all(&catalog).await?;
            }
            if std::mem::take(lost) {
                log::warn!("changes are heard again: {}", catalog.location);
            }
        }
        // A catalog that nobody has open any more is noticed as well.
        let heard = tokio::time::timeout(SILENCE, listener.try_recv()).await;
        ask = heard.is_err();
        match heard {
            Err(_) => {}
            Ok(Ok(Some(told))) => {
                let Some(catalog) = following.catalog() else {
                    return Ok(());
                };
                if let Some((revision, volume)) = told.payload().split_once(' ')
                    && let Ok(revision) = revision.parse()
                    && catalog.look_whose().await?
                {
                    catalog.watcher.announce(volume, revision);
                }
            }
            Ok(Ok(None)) => return Err(sqlx::Error::Protocol("the connection was lost".into())),
            Ok(Err(e)) => return Err(e),
        }
    }
}

async fn poll(following: &Following) {
    let mut connection = None;
    let mut seen = None;
    let mut warned = false;
    while let Some(catalog) = following.catalog() {
        let Database::Sqlite(file) = &catalog.database else {
            return;
        };
        if is_in_place(&catalog, file, &mut connection).await {
            warn_of_writers(file, &mut warned);
            match look(&catalog, file, &mut connection, &mut seen).await {
                Ok(()) => {}
                Err(e) => {
                    log::warn!("cannot look for changes: {e}: {}", catalog.location);
                    connection = None;
                }
            }
        }
        drop(catalog);
        SystemClock.sleep(POLL).await;
    }
}

/// Whether the file that is read still has its name; else nothing is read until one has, and another is opened anew.
async fn is_in_place(
    catalog: &Inner,
    file: &sqlite::Opened,
    connection: &mut Option<SqliteConnection>,
) -> bool {
    let (place, location) = (file.place(), &catalog.location);
    let tell_away = |why| {
        if file.set_away(Some(Away { why })) {
            log::warn!("{}", catalog.away().expect("it was said just now"));
        }
        false
    };
    match place {
        // Connections are closed where something else was there meanwhile that could not be opened.
        Place::Same if !file.readers().is_closed() => {
            if file.set_away(None) {
                log::warn!("the catalog's file is there again: {location}");
            }
            true
        }
        Place::Nobody => tell_away(None),
        Place::Same | Place::Another => {
            if file.away().is_none() {
                tell_away(None);
            }
            if let Some(connection) = connection.take() {
                let _it_is_of_no_use_any_more = connection.close().await;
            }
            if let Err(error) = file.open_again().await {
                return tell_away(Some(error.without_place()));
            }
            let right = match catalog.look_whose().await {
                Ok(right) => right,
                Err(e) => {
                    let error = CatalogError::sort(e, location);
                    return tell_away(Some(error.without_place()));
                }
            };
            file.set_away(None);
            if right {
                log::warn!(
                    "another file has taken the catalog's place, and is read from now on: {location}"
                );
            }
            catalog.watcher.begin_anew();
            true
        }
    }
}

/// Says once that a file which nobody was writing when it was opened is being written now.
fn warn_of_writers(file: &sqlite::Opened, warned: &mut bool) {
    let unchanging = file.reading() == sqlite::Access::ReadUnchanging;
    if unchanging && !*warned && sqlite::log_of(&file.path).exists() {
        *warned = true;
        let path = file.path.display();
        log::warn!("the catalog is being written again; open it anew to see what is new: {path}");
    }
}

async fn look(
    catalog: &Inner,
    file: &sqlite::Opened,
    connection: &mut Option<SqliteConnection>,
    seen: &mut Option<i64>,
) -> Result<(), CatalogError> {
    let failed = |e| CatalogError::sort(e, &catalog.location);
    match catalog.look_at_file().await.map_err(failed)? {
        File::Another => return Ok(()),
        // What is open knows nothing of what was copied over it.
        File::Right if catalog.owner.is_another() => {
            *connection = None;
            file.open_again().await?;
        }
        File::Older => {
            let location = catalog.location.clone();
            log::warn!("{}", CatalogError::Older { location });
            *connection = None;
            file.open_again().await?;
            catalog.watcher.begin_anew();
        }
        File::Right | File::Unchanged => {}
    }
    let connection = match connection {
        Some(connection) => connection,
        None => {
            // The counter only has meaning within one connection.
            *seen = None;
            let options = sqlite::options(&file.path, file.reading());
            connection.insert(options.connect().await.map_err(failed)?)
        }
    };
    let version: i64 = sqlx::query_scalar("PRAGMA data_version")
        .fetch_one(&mut *connection)
        .await
        .map_err(failed)?;
    if seen.replace(version) == Some(version) && !catalog.owner.is_another() {
        return Ok(());
    }
    if catalog.look_whose().await.map_err(failed)? {
        announce_all(catalog).await.map_err(failed)?;
    }
    Ok(())
}
