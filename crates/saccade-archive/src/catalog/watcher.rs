//! Tells subscribers of new revisions, from this process at once and from others by polling.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;

use sqlx::{ConnectOptions, SqliteConnection};
use tokio::sync::watch;

use super::{Inner, open, rows};

/// How often to look for commits of other processes. Reading the counter costs some microseconds.
const POLL: Duration = Duration::from_millis(150);

#[derive(Debug, Default)]
pub(super) struct Watcher {
    senders: Mutex<BTreeMap<String, watch::Sender<u64>>>,
    polling: AtomicBool,
}

impl Watcher {
    pub(super) fn subscribe(&self, catalog: &Arc<Inner>, volume: &str) -> watch::Receiver<u64> {
        let receiver = self
            .senders()
            .entry(volume.to_owned())
            .or_default()
            .subscribe();
        if !self.polling.swap(true, Ordering::AcqRel) {
            tokio::spawn(poll(Polling(Arc::downgrade(catalog))));
        }
        receiver
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

    fn senders(&self) -> MutexGuard<'_, BTreeMap<String, watch::Sender<u64>>> {
        self.senders.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The task's hold on the catalog, which does not keep it open. A task that ends with its runtime
/// makes room for the next one.
struct Polling(Weak<Inner>);

impl Drop for Polling {
    fn drop(&mut self) {
        if let Some(catalog) = self.0.upgrade() {
            catalog.watcher.polling.store(false, Ordering::Release);
        }
    }
}

async fn poll(polling: Polling) {
    let mut connection = None;
    let mut seen = None;
    let mut warned = false;
    while let Some(catalog) = polling.0.upgrade().filter(|c| !c.readers.is_closed()) {
        warn_of_writers(&catalog, &mut warned);
        match look(&catalog, &mut connection, &mut seen).await {
            Ok(()) => {}
            Err(e) => {
                log::warn!("cannot look for changes: {e}: {}", catalog.path.display());
                connection = None;
            }
        }
        drop(catalog);
        tokio::time::sleep(POLL).await;
    }
}

/// Says once that a file which nobody was writing when it was opened is being written now.
fn warn_of_writers(catalog: &Inner, warned: &mut bool) {
    let unchanging = catalog.access == open::Access::ReadUnchanging;
    if unchanging && !*warned && open::log_of(&catalog.path).exists() {
        *warned = true;
        let path = catalog.path.display();
        log::warn!("the catalog is being written again; open it anew to see what is new: {path}");
    }
}

async fn look(
    catalog: &Inner,
    connection: &mut Option<SqliteConnection>,
    seen: &mut Option<i64>,
) -> Result<(), sqlx::Error> {
    let connection = match connection {
        Some(connection) => connection,
        None => {
            // The counter only has meaning within one connection.
            *seen = None;
            connection.insert(
                open::options(&catalog.path, catalog.access)
                    .connect()
                    .await?,
            )
        }
    };
    let version: i64 = sqlx::query_scalar("PRAGMA data_version")
        .fetch_one(&mut *connection)
        .await?;
    if seen.replace(version) == Some(version) {
        return Ok(());
    }
    let volumes = sqlx::query("SELECT name, revision FROM volumes")
        .fetch_all(connection)
        .await?;
    for row in volumes {
        let name: &str = sqlx::Row::try_get(&row, "name")?;
        catalog
            .watcher
            .announce(name, rows::unsigned(&row, "revision")?);
    }
    Ok(())
}
