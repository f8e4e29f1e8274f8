//! The volumes of a visualization archive, on offer.

use std::sync::Arc;
use std::time::Duration;

use saccade_archive::VisualizationArchive;
use saccade_archive::catalog::CatalogError;
use saccade_source::SourceError;
use saccade_source::stitched::{StitchedOptions, StitchedSource};

use crate::status::CatalogStatus;
use crate::volumes::Volumes;

/// Why the volumes of an archive cannot be offered.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OfferError {
    /// The catalog cannot be read.
    #[error(transparent)]
    Catalog(#[from] CatalogError),
    /// A volume cannot be opened.
    #[error(transparent)]
    Source(#[from] SourceError),
}

/// Offers the volumes of an archive that are not offered yet, and returns their names.
///
/// # Errors
///
/// [`OfferError`]; the volumes before the one that failed are offered.
pub async fn offer_archive(
    volumes: &Volumes,
    archive: &VisualizationArchive,
    options: StitchedOptions,
) -> Result<Vec<String>, OfferError> {
    let offered = volumes.names();
    let mut new = Vec::new();
    for entry in archive.catalog().volumes().await? {
        let name = entry.volume.name;
        if offered.contains(&name) {
            continue;
        }
        let source = StitchedSource::open(archive, &name, options.clone()).await?;
        let status = CatalogStatus::new(archive.catalog().clone(), &name);
        volumes.publish(Arc::new(source), Some(Arc::new(status)));
        new.push(name);
    }
    Ok(new)
}

/// Offers volumes as they appear in an archive, looking every `poll`. Ends when it is dropped.
pub async fn follow_archive(
    volumes: &Volumes,
    archive: &VisualizationArchive,
    options: StitchedOptions,
    poll: Duration,
) {
    loop {
        tokio::time::sleep(poll).await;
        match offer_archive(volumes, archive, options.clone()).await {
            Ok(new) => new
                .iter()
                .for_each(|name| log::info!("volume {name:?} is offered now")),
            Err(error) => log::warn!("new volumes cannot be offered: {error}"),
        }
    }
}
