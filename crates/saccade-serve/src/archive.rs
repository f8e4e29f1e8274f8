//! The volumes of a visualization archive, on offer.

use std::sync::Arc;
use std::time::Duration;

use saccade_archive::VisualizationArchive;
use saccade_archive::catalog::CatalogError;
use saccade_source::SourceError;
use saccade_source::stitched::{StitchedOptions, StitchedSource};

use crate::http::cause;
use crate::pieces::chain;
use crate::status::CatalogStatus;
use crate::volumes::Volumes;

/// What became of the volumes of an archive that were not offered yet.
#[derive(Clone, Debug, Default)]
pub struct Offer {
    /// Names of those that are offered now.
    pub new: Vec<String>,
    /// Names of those that cannot be opened, and why. Clients are told so, and that they may ask again.
    pub failing: Vec<(String, SourceError)>,
}

/// Offers the volumes of an archive that are not offered yet. One that cannot be opened keeps no other from being offered.
///
/// # Errors
///
/// If the catalog cannot be read.
pub async fn offer_archive(
    volumes: &Volumes,
    archive: &VisualizationArchive,
    options: StitchedOptions,
) -> Result<Offer, CatalogError> {
    let offered = volumes.names();
    let entries = archive.catalog().volumes().await?;
    volumes.keep_failing(|name| entries.iter().any(|entry| entry.volume.name == name));
    let mut offer = Offer::default();
    for entry in entries {
        let name = entry.volume.name;
        if offered.contains(&name) {
            continue;
        }
        match StitchedSource::open(archive, &name, options.clone()).await {
            Ok(source) => {
                let status = CatalogStatus::new(archive.catalog().clone(), &name);
                volumes.publish(Arc::new(source), Some(Arc::new(status)));
                offer.new.push(name);
            }
            Err(error) => {
                if volumes.fail(&name, told(&error)) {
                    let why = chain(&error);
                    log::warn!("volume {name:?} cannot be offered, and is tried again: {why}");
                }
                offer.failing.push((name, error));
            }
        }
    }
    Ok(offer)
}

/// Why a volume cannot be opened, as far as clients may know.
fn told(error: &SourceError) -> String {
    match error {
        SourceError::Open { source, .. } => cause(&**source),
        other => other.to_string(),
    }
}

/// Offers volumes as they appear in an archive, and those that could not be opened, looking every `poll`. Ends when it is
/// dropped.
pub async fn follow_archive(
    volumes: &Volumes,
    archive: &VisualizationArchive,
    options: StitchedOptions,
    poll: Duration,
) {
    loop {
        tokio::time::sleep(poll).await;
        match offer_archive(volumes, archive, options.clone()).await {
            Ok(Offer { new, .. }) => new
                .iter()
                .for_each(|name| log::info!("volume {name:?} is offered now")),
            Err(error) => log::warn!("new volumes cannot be offered: {error}"),
        }
    }
}
