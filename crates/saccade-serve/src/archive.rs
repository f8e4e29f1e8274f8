//! The volumes of a visualization archive, on offer.

use std::sync::Arc;
use std::time::Duration;

use saccade_archive::VisualizationArchive;
use saccade_archive::catalog::{CatalogError, Listed};
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
/// Where another catalog took the place of the one that was open, volumes that are others in it are opened anew, and
/// those that it does not have are offered no more.
///
/// # Errors
///
/// If the catalog cannot be read.
pub async fn offer_archive(
    volumes: &Volumes,
    archive: &VisualizationArchive,
    options: StitchedOptions,
) -> Result<Offer, CatalogError> {
    archive.catalog().follow();
    let listed = archive.catalog().volumes().await?;
    if archive.catalog().times_replaced() > 0 {
        withdraw_others(volumes, &listed);
    }
    let offered = volumes.names();
    volumes.keep_failing(|name| listed.iter().any(|volume| volume.name == name));
    let mut offer = Offer::default();
    for Listed { name, .. } in listed {
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

/// Offers no more what an archive has not, or has as another.
fn withdraw_others(volumes: &Volumes, listed: &[Listed]) {
    for offered in volumes.all() {
        let volume = offered.volume();
        let is = |listed: &Listed| matches!(&listed.entry, Ok(entry) if entry.volume == **volume);
        let is_there = listed.iter().any(is);
        // What is not made of tiles is of no archive.
        if !is_there && offered.status.is_some() {
            let name = &volume.name;
            log::warn!(
                "volume {name:?} is not in the catalog that is there now, or is another in it: it is offered no more"
            );
            volumes.withdraw(name);
        }
    }
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
    let mut told = None;
    loop {
        tokio::time::sleep(poll).await;
        match offer_archive(volumes, archive, options.clone()).await {
            Ok(Offer { new, .. }) => {
                told = None;
                for name in new {
                    log::info!("volume {name:?} is offered now");
                }
            }
            Err(error) => {
                let error = error.to_string();
                if told.as_ref() != Some(&error) {
                    log::warn!("new volumes cannot be offered: {error}");
                    told = Some(error);
                }
            }
        }
    }
}
