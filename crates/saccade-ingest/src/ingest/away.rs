//! What was followed before and is away when work begins.

use std::time::Duration;

use saccade_archive::VisualizationArchive;
use saccade_archive::catalog::{CatalogError, Worker};

use super::IngestOptions;
use super::begin::worker_name;
use super::process;
use crate::Cancel;

/// Between looks.
const LOOKS: Duration = Duration::from_millis(500);

/// Waits until what a volume is taken in from is there again, or that is cancelled. Those who look at the volume are told
/// `why` it does not grow.
pub async fn wait_until_there(
    archive: &VisualizationArchive,
    volume: &str,
    why: &str,
    options: &IngestOptions,
    is_there: impl Fn() -> bool,
    cancel: &Cancel,
) {
    let worker = match tell(archive, volume, why, options).await {
        Ok(worker) => Some(worker),
        Err(e) => {
            log::debug!("why nothing goes on could not be told: {e}");
            None
        }
    };
    let clock = archive.catalog().clock();
    let mut sign = clock.monotonic();
    while !is_there() && !cancel.is_cancelled() {
        clock.sleep(LOOKS).await;
        if let Some(worker) = &worker
            && clock.monotonic() - sign > options.lease / 4
        {
            sign = clock.monotonic();
            if let Err(e) = archive.catalog().keep_alive(worker).await {
                log::debug!("no sign of life could be given: {e}");
            }
        }
    }
    if let Some(worker) = worker
        && let Err(e) = archive.catalog().release(&worker).await
    {
        log::debug!("why nothing went on is told until the lease is over: {e}");
    }
}

async fn tell(
    archive: &VisualizationArchive,
    volume: &str,
    why: &str,
    options: &IngestOptions,
) -> Result<Worker, CatalogError> {
    let catalog = archive.catalog();
    catalog.volume(volume).await?;
    let process = process::this().unwrap_or_default();
    let worker = catalog
        .register_process(&worker_name(), &process, options.lease)
        .await?;
    let reasons = [(why.to_owned(), catalog.clock().now())];
    catalog.tell_held_up(volume, &worker, &reasons).await?;
    Ok(worker)
}
