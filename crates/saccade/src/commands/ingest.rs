//! `saccade ingest`: from what a microscope writes to what can be looked at.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Result;
use clap::Args;
use glam::{DVec2, DVec3, UVec3};
use saccade_archive::acquisition::AcquisitionInfo;
use saccade_archive::catalog::Catalog;
use saccade_archive::pyramid::Encoding;
use saccade_archive::{CatalogLocation, VisualizationArchive};
use saccade_core::volume::{Dtype, check_name};
use saccade_ingest::ingest::{IngestOptions, Summary, run};
use saccade_ingest::watch::{self, Disk, Pattern, Watch, WatchConfig};

use crate::arguments::{Archive, extent, pitch, scale, volume_name, voxel_nm};
use crate::folders::overlap;
use crate::interrupt::cancel_when_interrupted;
use crate::open::waited_for;
use crate::progress::Shown;
use crate::report::say;

/// Follow an acquisition archive and make each tile's pyramid and catalog entry as it arrives.
#[derive(Args)]
pub(crate) struct Ingest {
    /// Folder that the microscope writes to
    acquisition: PathBuf,

    #[command(flatten)]
    archive: Archive,

    /// End once everything that is there is done, instead of following; with 3 if anything was set aside
    #[arg(long)]
    once: bool,

    #[command(flatten)]
    stored: Stored,

    /// Name of the volume [default: as the acquisition archive says]
    #[arg(long, value_parser = volume_name)]
    volume: Option<String>,

    #[command(flatten)]
    bare: Bare,

    /// Tiles in work at the same time [default: 2]
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u16).range(1..))]
    workers: Option<u16>,
}

/// A folder without records: file names say what lies where.
#[derive(Args)]
#[group(id = "bare")]
pub(crate) struct Bare {
    /// The folder holds no records: its file names are like this, such as
    /// 's{section}/r{row}_c{column}_{channel}.tif'; {channel} and folders as needed, {} is anything
    /// [default: tiles.jsonl names the files]
    #[arg(long, value_name = "PATTERN", requires_all = ["extent", "voxel", "pitch"])]
    pattern: Option<Pattern>,

    /// Size of the volume [voxels], with --pattern [default: as volume.json says]
    #[arg(long, value_name = "X,Y,Z", value_parser = extent, requires = "pattern")]
    extent: Option<UVec3>,

    /// Voxel size [nm], with --pattern [default: as volume.json says]
    #[arg(long, value_name = "X,Y,Z", value_parser = voxel_nm, requires = "pattern")]
    voxel: Option<DVec3>,

    /// From a tile's corner to the next column's and the next row's [voxels], with --pattern [default: as
    /// tiles.jsonl says]
    #[arg(long, value_name = "X,Y", value_parser = pitch, requires = "pattern")]
    pitch: Option<DVec2>,

    /// Size of a pixel [voxels] [default: 1]
    #[arg(long, value_name = "NUMBER", value_parser = scale, requires = "pattern")]
    pixel: Option<f64>,

    /// Number of the first section, row and column [default: 0]
    #[arg(long, value_name = "NUMBER", requires = "pattern")]
    first: Option<u32>,

    /// Names of the channels, in order [default: one without a name]
    #[arg(
        long,
        value_name = "NAME,...",
        value_delimiter = ',',
        requires = "pattern"
    )]
    channels: Vec<String>,

    /// Bits of a voxel, 8 or 16 [default: 8]
    #[arg(long, value_name = "NUMBER", value_parser = clap::value_parser!(u8).range(8..=16), requires = "pattern")]
    bits: Option<u8>,
}

impl Bare {
    /// What to watch, if the folder has no records; `name` is the volume's.
    fn config(&self, name: &str) -> Result<Option<WatchConfig>> {
        let (Some(pattern), Some(extent), Some(voxel_nm), Some(pitch)) =
            (&self.pattern, self.extent, self.voxel, self.pitch)
        else {
            return Ok(None);
        };
        let mut info = AcquisitionInfo::new(name, extent, voxel_nm);
        info.channels.clone_from(&self.channels);
        info.dtype = match self.bits {
            None | Some(8) => Dtype::Uint8,
            Some(16) => Dtype::Uint16,
            Some(bits) => anyhow::bail!("voxels have 8 or 16 bits, not {bits}"),
        };
        if let Some(mistake) = info.channel_mistake() {
            anyhow::bail!("{mistake}; name each once with --channels");
        }
        Ok(Some(WatchConfig {
            pattern: pattern.clone(),
            info,
            pitch,
            scale: self.pixel.unwrap_or(1.0),
            first: self.first.unwrap_or(0),
            poll: IngestOptions::DEFAULT.poll,
            budget: WatchConfig::BUDGET,
        }))
    }
}

/// How pyramids are stored.
#[derive(Args)]
#[group(multiple = false)]
pub(crate) struct Stored {
    /// Store as JPEG of this quality, 1 to 100 [default: 85]
    #[arg(long, value_name = "NUMBER", value_parser = clap::value_parser!(u8).range(1..=100))]
    quality: Option<u8>,

    /// Store every voxel as it is
    #[arg(long)]
    lossless: bool,
}

impl Stored {
    pub(crate) fn encoding(&self) -> Encoding {
        match self.quality {
            _ if self.lossless => Encoding::Lossless,
            Some(quality) => Encoding::Jpeg { quality },
            None => IngestOptions::DEFAULT.encoding,
        }
    }
}

/// The acquisition archive is only read: nothing is made in or around it.
fn refuse_same_folder(acquisition: &Path, archive: &Path) -> Result<()> {
    anyhow::ensure!(
        !overlap(acquisition, archive)?,
        "the microscope's folder is only read: name another folder for the archive than {}",
        archive.display()
    );
    Ok(())
}

/// A volume's name from a folder's.
fn named_after(folder: &Path) -> String {
    let name = folder
        .file_name()
        .map(|name| name.to_string_lossy().into_owned());
    let name = name.filter(|name| check_name(name).is_ok());
    name.unwrap_or_else(|| "volume".to_owned())
}

/// What the command ends with when all was done once, but not all could be taken in.
const SET_ASIDE: u8 = 3;

/// The first of many, and how many more.
fn first<T>(all: &[T], say: impl Fn(&T) -> String) -> String {
    const SHOWN: usize = 3;
    let mut words: Vec<_> = all.iter().take(SHOWN).map(say).collect();
    if all.len() > SHOWN {
        words.push(format!("and {} more", all.len() - SHOWN));
    }
    words.join("; ")
}

/// What was set aside by this run, and what still waits.
async fn say_what_is_left(
    catalog: &Catalog,
    volume: &str,
    quarantined: u64,
    watched: bool,
) -> Result<()> {
    if quarantined > 0 {
        let all = catalog.quarantined(volume).await?;
        let before = all.len().saturating_sub(usize::try_from(quarantined)?);
        let named = first(&all[before..], |one| match &one.tile {
            Some(tile) => format!("{} (tile {tile})", one.file),
            None => one.file.clone(),
        });
        if !named.is_empty() {
            say(&format!(
                "set aside, for reasons told above and by /v/{volume}/status.json of `saccade serve`: {named}"
            ));
        }
    }
    let waiting = catalog.waiting(volume).await?;
    if !waiting.is_empty() {
        let named = first(&waiting, |one| {
            let (record, reason) = (&one.record, &one.reason);
            let file = match watched {
                true => watch::file_name(&record.file),
                false => &record.file,
            };
            format!("{file} (tile {}): {reason}", record.tile)
        });
        let count = waiting.len();
        say(&format!(
            "{count} unfinished, taken up when it is started again: {named}"
        ));
    }
    Ok(())
}

impl Ingest {
    pub(crate) async fn run(self) -> Result<ExitCode> {
        // Before the archive is made: a wrong first folder should not leave a second one behind.
        let name = self
            .volume
            .clone()
            .unwrap_or_else(|| named_after(&self.acquisition));
        let bare = self.bare.config(&name)?;
        if bare.is_none() {
            AcquisitionInfo::read(&self.acquisition)?;
        }
        let location = self.archive.location()?;
        if let Some(folder) = location.folder() {
            refuse_same_folder(&self.acquisition, folder)?;
        }
        let cancel = cancel_when_interrupted();
        let opened = waited_for(|| VisualizationArchive::create(&location));
        let archive = tokio::select! {
            archive = opened => archive?,
            () = cancel.cancelled() => return Ok(ExitCode::SUCCESS),
        };
        let mut options = IngestOptions {
            volume: self.volume,
            encoding: self.stored.encoding(),
            once: self.once,
            workers: self
                .workers
                .map_or(IngestOptions::DEFAULT.workers, usize::from),
            ..IngestOptions::DEFAULT
        };
        let mut acquisition = self.acquisition.clone();
        let mut watching = None;
        if let Some(config) = bare {
            let beside = match (location.catalog(), location.folder()) {
                (CatalogLocation::File(file), _) => file.with_file_name("watched"),
                (CatalogLocation::Postgres(_), Some(folder)) => folder.join("watched"),
                (CatalogLocation::Postgres(_), None) => anyhow::bail!(
                    "what is found in a bare folder is kept beside the pyramids or the catalog, which \
                     are both elsewhere: name a file with --catalog, or a folder as archive"
                ),
            };
            let kept = beside.join(&name);
            let mut watch = Watch::open(config, Disk, &self.acquisition, &kept)?;
            if !watch.leads() {
                say(
                    "another process watches this folder; what it finds is shared, and should it end, this one goes on",
                );
            }
            acquisition = kept;
            options.linked = Some(watch.folder().to_owned());
            if self.once {
                watch::run(&mut watch, true, &cancel)?;
                if let Some(why) = watch.unmatched() {
                    anyhow::bail!("{why}; give --pattern as the files are named");
                }
            } else {
                let cancel = cancel.clone();
                let looks = move || watch::run(&mut watch, false, &cancel);
                watching = Some(tokio::task::spawn_blocking(looks));
            }
        }
        let shown = Shown::new("ingest", None);
        let taken_in = run(&acquisition, &archive, &options, &shown, &cancel);
        let done = match &mut watching {
            None => taken_in.await,
            // Whichever fails first is told; both end when they are cancelled.
            Some(watching) => tokio::select! {
                done = taken_in => done,
                failed = watching => {
                    failed??;
                    return Ok(ExitCode::SUCCESS);
                }
            },
        };
        cancel.cancel();
        shown.finish();
        let Summary {
            tiles,
            moved,
            deleted,
            quarantined,
            early,
            ..
        } = done?;
        let volume = match options.volume {
            Some(name) => Some(name),
            None => AcquisitionInfo::read(&acquisition)
                .ok()
                .map(|info| info.name),
        };
        if let Some(volume) = volume
            && let watched = options.linked.is_some()
            && let Err(e) = say_what_is_left(archive.catalog(), &volume, quarantined, watched).await
        {
            log::warn!("what is left cannot be told: {e}");
        }
        archive.catalog().close().await;
        let mut done = format!("{tiles} tiles taken in, {moved} moved, {quarantined} set aside");
        if deleted > 0 {
            done.push_str(&format!(", {deleted} deleted"));
        }
        if early > 0 {
            done.push_str(&format!(", {early} transforms of tiles that have not come"));
        }
        say(&format!("{done}: {location}"));
        let all = !self.once || quarantined == 0;
        Ok(if all {
            ExitCode::SUCCESS
        } else {
            ExitCode::from(SET_ASIDE)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Those that the help names.
    #[test]
    fn defaults_are_as_told() {
        let default = IngestOptions::DEFAULT;
        assert_eq!(default.workers, 2);
        assert_eq!(default.encoding, Encoding::Jpeg { quality: 85 });
    }

    #[test]
    fn the_microscope_keeps_its_folder() {
        let folder = tempfile::tempdir().unwrap();
        let acquisition = folder.path().join("acquisition");
        std::fs::create_dir(&acquisition).unwrap();
        let inside = acquisition.join("a/b");
        let around = acquisition.join("../acquisition");
        for bad in [acquisition.as_path(), &inside, &around, folder.path()] {
            assert!(
                refuse_same_folder(&acquisition, bad).is_err(),
                "{}",
                bad.display()
            );
        }
        for good in ["archive", "acquisition2", "deep/archive"] {
            assert!(
                refuse_same_folder(&acquisition, &folder.path().join(good)).is_ok(),
                "{good}"
            );
        }
    }
}
