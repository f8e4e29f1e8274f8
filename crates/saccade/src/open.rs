//! Volumes that the command line names: of a server, of an archive, or an image that somebody else wrote.

use std::error::Error;
use std::path::Path;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail, ensure};
use saccade_archive::catalog::{Catalog, CatalogError, Listed};
use saccade_archive::{
    ArchiveError, ArchiveLocation, CatalogLocation, StorageLocation, VisualizationArchive,
};
use saccade_serve::{CatalogStatus, StatusSource};
use saccade_source::export;
use saccade_source::images::{self, ImageOptions};
use saccade_source::objects::Location;
use saccade_source::remote::{Quarantined, RemoteError, RemoteSource, Status, volumes};
use saccade_source::stitched::StitchedSource;
use saccade_source::zarr::ZarrSource;
use saccade_source::{Damage, SourceError, VolumeSource};
use saccade_view::AcquisitionReader;

use crate::arguments::CatalogArgument;
use crate::report::say;
use crate::stitching::Stitching;

/// Between attempts to open an archive whose catalog's server, or object store, is away.
const TRY_AGAIN: Duration = Duration::from_secs(1);

/// Opens an archive for work that goes on for months. While the server of its catalog is away, or has no catalog
/// yet, or its object store is away, waits for it, and says so.
pub(crate) async fn waited_for<F>(mut open: impl FnMut() -> F) -> Result<VisualizationArchive>
where
    F: Future<Output = Result<VisualizationArchive, ArchiveError>>,
{
    let mut waits_for: Option<Missing> = None;
    loop {
        let missing = match open().await {
            Err(ArchiveError::Catalog(error)) if passes(&error) => Missing::new("catalog", &error),
            Err(ArchiveError::Storage(error)) if error.is_outage() => {
                Missing::new("storage", &error)
            }
            opened => {
                if let Some(Missing { part, .. }) = waits_for
                    && opened.is_ok()
                {
                    say(&format!("the {part} can be used now"));
                }
                return Ok(opened?);
            }
        };
        // Once for each reason.
        if waits_for.as_ref().map(|waits| &waits.what) != Some(&missing.what) {
            let Missing { what, reason, .. } = &missing;
            say(&format!(
                "{what}{reason}; trying again until it can be used"
            ));
        }
        waits_for = Some(missing);
        tokio::time::sleep(TRY_AGAIN).await;
    }
}

/// What an archive cannot be opened without.
struct Missing {
    part: &'static str,
    what: String,
    /// In brackets.
    reason: String,
}

impl Missing {
    fn new(part: &'static str, error: &dyn Error) -> Self {
        let reason = error.source().map_or(String::new(), |e| format!(" ({e})"));
        Self {
            part,
            what: error.to_string(),
            reason,
        }
    }
}

/// Whether the catalog will be there some time, without this command being given again. A database was made for
/// a catalog; a folder without one is rather the wrong folder.
fn passes(error: &CatalogError) -> bool {
    let empty = matches!(
        error,
        CatalogError::NotFound {
            location: CatalogLocation::Postgres(_)
        }
    );
    empty || error.is_outage()
}

/// By what opening an archive failed: where there is none, and none was asked for in particular, there is no image either.
pub(crate) fn neither(error: anyhow::Error, catalog: &CatalogArgument) -> anyhow::Error {
    match error.downcast_ref() {
        Some(ArchiveError::NotAnArchive { path }) if !catalog.is_given() => anyhow!(
            "there is no visualization archive ({}), which `saccade ingest` or `saccade demo` makes, and no image, neither \
             OME-Zarr (zarr.json, .zattrs) nor precomputed (info): {}",
            VisualizationArchive::CATALOG,
            path.parent().unwrap_or(path).display()
        ),
        _ => error,
    }
}

/// Refuses what an export has left that is not whole, which is neither an image nor an archive.
fn refuse_half_export(location: &ArchiveLocation) -> Result<()> {
    if let Some(folder) = location.folder().filter(|folder| is_half_export(folder)) {
        bail!(
            "an export to this folder was begun and is not whole yet: wait for it, or repeat the command, \
             which goes on with it: {}",
            folder.display()
        );
    }
    Ok(())
}

fn is_half_export(folder: &Path) -> bool {
    folder.join(export::UNFINISHED).is_file()
        && !folder.join(VisualizationArchive::CATALOG).exists()
}

/// Where a volume is.
#[derive(Clone, Debug)]
pub(crate) enum Place {
    /// An address: of a server, or of an image.
    Address(String),
    /// An image, which nothing else is.
    Image(Location),
    /// A bucket: an image, or, with a catalog, a visualization archive.
    Bucket(StorageLocation, Location),
    /// A visualization archive.
    Archive(StorageLocation),
}

impl FromStr for Place {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let location = || text.parse().map_err(|error| format!("{error}"));
        let kinds = ["precomputed://", "zarr://", "zarr2://", "zarr3://", "gs://"];
        if text.starts_with("http://") || text.starts_with("https://") {
            return Ok(Self::Address(text.to_owned()));
        }
        if kinds.iter().any(|kind| text.starts_with(kind)) || is_image(Path::new(text)) {
            return Ok(Self::Image(location()?));
        }
        let storage = text
            .parse::<StorageLocation>()
            .map_err(|error| error.to_string())?;
        Ok(match storage {
            StorageLocation::Folder(_) => Self::Archive(storage),
            bucket => Self::Bucket(bucket, location()?),
        })
    }
}

/// Whether an image that somebody else wrote is in a folder, or what they know as one (N5), or should be by the folder's name:
/// then what is missing is an image. Also a file, which is no archive either.
fn is_image(folder: &Path) -> bool {
    let has = |name: &str| folder.join(name).is_file();
    let is_archive = || has(VisualizationArchive::CATALOG) || is_half_export(folder);
    let named = folder
        .extension()
        .is_some_and(|extension| extension == "zarr" || extension == "n5");
    ZarrSource::is_zarr(folder)
        || has("info")
        || images::is_other(folder)
        || (named && !is_archive())
}

/// Opens an image, and tells what its user should know.
async fn open_image(location: &Location, options: ImageOptions) -> Result<Arc<dyn VolumeSource>> {
    let image = images::open_with(location, options).await?;
    for note in &image.notes {
        say(note);
    }
    Ok(image.source)
}

/// Whether somebody answered, though not as a Saccade server does.
fn is_no_server(error: &SourceError) -> bool {
    let SourceError::Open { source, .. } = error else {
        return false;
    };
    matches!(
        source.downcast_ref::<RemoteError>(),
        Some(RemoteError::Status { .. } | RemoteError::Answer { .. })
    )
}

/// Whether there is nobody to answer, neither as a server nor with an image.
fn is_nobody(error: &SourceError) -> bool {
    let SourceError::Open { source, .. } = error else {
        return false;
    };
    let error = source.downcast_ref::<RemoteError>();
    matches!(error, Some(RemoteError::Http { source, .. }) if source.is_connect())
}

/// By what an address failed that gave no answer as a server, and no image.
fn neither_there(no_server: SourceError, no_image: &anyhow::Error) -> anyhow::Error {
    let both = format!("no Saccade server answers, and no image opens ({no_image:#})");
    anyhow::Error::from(no_server).context(both)
}

/// The first volume of an archive that can be opened, and tells of those that cannot; the first where none can.
async fn first(archive: &VisualizationArchive) -> Result<Option<String>> {
    let mut first = None;
    for Listed { name, entry } in archive.catalog().volumes().await? {
        match entry {
            Ok(_) => return Ok(Some(name)),
            Err(error) => say(&error.to_string()),
        }
        first.get_or_insert(name);
    }
    Ok(first)
}

/// Why an image has no use for what is said of stitching.
pub(crate) const NOT_STITCHED: &str = "an image is not stitched, but read as it is";

/// An open volume, and who knows how its acquisition is coming along.
pub(crate) struct Opened {
    pub(crate) source: Arc<dyn VolumeSource>,
    /// The catalog, of an archive that is opened here.
    pub(crate) catalog: Option<Catalog>,
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
        let images = ImageOptions::default();
        self.open_with(catalog, name, stitching, images).await
    }

    /// The same; an image is read as told.
    pub(crate) async fn open_with(
        &self,
        catalog: &CatalogArgument,
        name: Option<&str>,
        stitching: &Stitching,
        images: ImageOptions,
    ) -> Result<Opened> {
        match self {
            Self::Address(address) => {
                ensure!(
                    !catalog.is_given(),
                    "what is behind an address has no catalog here: leave out --catalog"
                );
                let offered = match volumes(address).await {
                    Ok(offered) => offered,
                    Err(error) if is_nobody(&error) => return Err(error.into()),
                    Err(no_server) => {
                        stitching.refuse(NOT_STITCHED)?;
                        let opened = Self::image(&address.parse()?, name, images).await;
                        return opened.map_err(|error| match is_no_server(&no_server) {
                            true => error,
                            false => neither_there(no_server, &error),
                        });
                    }
                };
                let name = match name {
                    Some(name) => name.to_owned(),
                    None => match offered.into_iter().next() {
                        Some(name) => name,
                        None => bail!("the server offers no volumes yet: {address}"),
                    },
                };
                stitching.refuse("what is behind an address was stitched by its server")?;
                let source = RemoteSource::open(address, &name).await?;
                for note in source.notes() {
                    say(note);
                }
                let reader = source.status_reader();
                let acquisition: AcquisitionReader = Arc::new(move || {
                    let reader = reader.clone();
                    Box::pin(async move { reader.read().await.ok() })
                });
                Ok(Opened {
                    source: Arc::new(source),
                    catalog: None,
                    acquisition: Some(acquisition),
                })
            }
            Self::Image(location) => {
                ensure!(
                    !catalog.is_given(),
                    "an image has no catalog: leave out --catalog"
                );
                stitching.refuse(NOT_STITCHED)?;
                Self::image(location, name, images).await
            }
            Self::Bucket(_, location) if !catalog.is_given() => {
                let opened = Self::image(location, name, images).await;
                let opened = opened.context("a visualization archive in a bucket needs --catalog; without it, an image is looked for")?;
                stitching.refuse(NOT_STITCHED)?;
                Ok(opened)
            }
            Self::Bucket(storage, _) | Self::Archive(storage) => {
                let location = Self::archive(storage, catalog)?;
                let archive = VisualizationArchive::open(&location).await;
                let archive = archive.map_err(|error| neither(error.into(), catalog))?;
                let options = stitching.options(&location).await?;
                let name = match name {
                    Some(name) => name.to_owned(),
                    None => first(&archive).await?.with_context(|| {
                        format!("the archive holds no volumes yet; `saccade ingest` fills it: {location}")
                    })?,
                };
                let source = StitchedSource::open(&archive, &name, options)
                    .await
                    .with_context(|| format!("cannot open a volume of {location}"))?;
                let status = CatalogStatus::new(archive.catalog().clone(), &name);
                let source: Arc<dyn VolumeSource> = Arc::new(source);
                let acquisition: AcquisitionReader = Arc::new({
                    let source = source.clone();
                    move || {
                        let (status, source) = (status.clone(), source.clone());
                        Box::pin(async move {
                            let status = status.status().await.ok()?;
                            Some(told(status.with_damage(source.damage())))
                        })
                    }
                });
                Ok(Opened {
                    source,
                    catalog: Some(archive.catalog().clone()),
                    acquisition: Some(acquisition),
                })
            }
        }
    }

    /// Opens an image, which has the name that is asked for.
    async fn image(
        location: &Location,
        name: Option<&str>,
        options: ImageOptions,
    ) -> Result<Opened> {
        let source = open_image(location, options).await?;
        if let Some(name) = name {
            let own = &source.volume().name;
            ensure!(name == own, "the image is called {own:?}, not {name:?}");
        }
        Ok(Opened {
            source,
            catalog: None,
            acquisition: None,
        })
    }

    /// The source of an image, for those who offer it; `None` for an archive. A server's volumes are not offered
    /// again.
    pub(crate) async fn open_to_serve(
        &self,
        catalog: &CatalogArgument,
    ) -> Result<Option<Arc<dyn VolumeSource>>> {
        let images = ImageOptions::default();
        match self {
            Self::Address(address) => Ok(Some(open_image(&address.parse()?, images).await?)),
            Self::Image(location) => Ok(Some(open_image(location, images).await?)),
            Self::Bucket(_, location) if !catalog.is_given() => {
                let opened = open_image(location, images).await;
                let opened = opened.context("a visualization archive in a bucket needs --catalog; without it, an image is looked for");
                Ok(Some(opened?))
            }
            Self::Bucket(..) | Self::Archive(_) => Ok(None),
        }
    }

    /// Where an archive is.
    pub(crate) fn archive(
        storage: &StorageLocation,
        catalog: &CatalogArgument,
    ) -> Result<ArchiveLocation> {
        let location = catalog.location(storage.clone())?;
        refuse_half_export(&location)?;
        Ok(location)
    }

    /// What an archive is stored in.
    pub(crate) fn storage(&self) -> Option<&StorageLocation> {
        match self {
            Self::Bucket(storage, _) | Self::Archive(storage) => Some(storage),
            Self::Address(_) | Self::Image(_) => None,
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
    let tile = |tile: saccade_serve::DamagedTile| Damage {
        section: tile.section,
        object: tile.object,
        reason: tile.reason,
    };
    Status {
        revision: status.revision,
        tiles: status.tiles,
        sections: status.sections,
        set_aside: status.set_aside,
        quarantined: status.quarantined.into_iter().map(file).collect(),
        damaged: status.damaged,
        damaged_tiles: status.damaged_tiles.into_iter().map(tile).collect(),
    }
}
