//! Volumes that the command line names: of a server, of an archive, or an image in a folder.

use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;

use anyhow::{Context, Result, bail, ensure};
use saccade_archive::{LocationError, StorageLocation, VisualizationArchive};
use saccade_serve::{CatalogStatus, StatusSource};
use saccade_source::VolumeSource;
use saccade_source::remote::{Quarantined, RemoteSource, Status, volumes};
use saccade_source::stitched::StitchedSource;
use saccade_source::zarr::ZarrSource;
use saccade_view::AcquisitionReader;

use crate::arguments::CatalogArgument;
use crate::stitching::Stitching;

/// Where a volume is.
#[derive(Clone, Debug)]
pub(crate) enum Place {
    /// The address of a server.
    Server(String),
    /// An OME-Zarr image in a folder.
    Zarr(PathBuf),
    /// A visualization archive.
    Archive(StorageLocation),
}

impl FromStr for Place {
    type Err = LocationError;
    fn from_str(text: &str) -> Result<Self, LocationError> {
        let server = text.starts_with("http://") || text.starts_with("https://");
        Ok(if server {
            Self::Server(text.to_owned())
        } else if ZarrSource::is_zarr(Path::new(text)) {
            Self::Zarr(text.into())
        } else {
            Self::Archive(text.parse()?)
        })
    }
}

/// An open volume, and who knows how its acquisition is coming along.
pub(crate) struct Opened {
    pub(crate) source: Arc<dyn VolumeSource>,
    pub(crate) acquisition: Option<AcquisitionReader>,
}

impl Place {
    /// Opens the volume of that name, or the first; one of an archive is stitched as told.
    pub(crate) async fn open(
        &self,
        catalog: &CatalogArgument,
        name: Option<&str>,
        stitching: &Stitching,
    ) -> Result<Opened> {
        match self {
            Self::Server(address) => {
                ensure!(
                    !catalog.is_given(),
                    "a server has its own catalog: leave out --catalog"
                );
                let name = match name {
                    Some(name) => name.to_owned(),
                    None => match volumes(address).await?.into_iter().next() {
                        Some(name) => name,
                        None => bail!("the server offers no volumes yet: {address}"),
                    },
                };
                let source = RemoteSource::open(address, &name).await?;
                let reader = source.status_reader();
                let acquisition: AcquisitionReader = Arc::new(move || {
                    let reader = reader.clone();
                    Box::pin(async move { reader.read().await.ok() })
                });
                Ok(Opened {
                    source: Arc::new(source),
                    acquisition: Some(acquisition),
                })
            }
            Self::Zarr(folder) => {
                ensure!(
                    !catalog.is_given(),
                    "an OME-Zarr image has no catalog: leave out --catalog"
                );
                let source = ZarrSource::open(folder).await?;
                if let Some(name) = name {
                    let own = &source.volume().name;
                    ensure!(name == own, "the image is called {own:?}, not {name:?}");
                }
                Ok(Opened {
                    source: Arc::new(source),
                    acquisition: None,
                })
            }
            Self::Archive(storage) => {
                let location = catalog.location(storage.clone())?;
                let archive = VisualizationArchive::open(&location).await?;
                let name = match name {
                    Some(name) => name.to_owned(),
                    None => match archive.catalog().volumes().await?.into_iter().next() {
                        Some(entry) => entry.volume.name,
                        None => bail!(
                            "the archive holds no volumes yet; `saccade ingest` fills it: {location}"
                        ),
                    },
                };
                let options = stitching.options().await;
                let source = StitchedSource::open(&archive, &name, options)
                    .await
                    .with_context(|| format!("cannot open a volume of {location}"))?;
                let status = CatalogStatus::new(archive.catalog().clone(), &name);
                let acquisition: AcquisitionReader = Arc::new(move || {
                    let status = status.clone();
                    Box::pin(async move { status.status().await.ok().map(told) })
                });
                Ok(Opened {
                    source: Arc::new(source),
                    acquisition: Some(acquisition),
                })
            }
        }
    }
}

/// What a server would have told.
fn told(status: saccade_serve::Status) -> Status {
    let file = |q: saccade_serve::Quarantined| Quarantined {
        file: q.file,
        tile: q.tile,
        reason: q.reason,
    };
    Status {
        revision: status.revision,
        tiles: status.tiles,
        sections: status.sections,
        quarantined: status.quarantined.into_iter().map(file).collect(),
    }
}
