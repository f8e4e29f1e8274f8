//! `saccade ingest`: from what a microscope writes to what can be looked at.

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Args;
use saccade_archive::VisualizationArchive;
use saccade_archive::pyramid::Encoding;
use saccade_ingest::ingest::{IngestOptions, Summary, run};

use crate::arguments::{Archive, volume_name};
use crate::interrupt::cancel_when_interrupted;
use crate::progress::Shown;
use crate::report::say;

/// Follow an acquisition archive and make each tile's pyramid and catalog entry as it arrives.
#[derive(Args)]
pub(crate) struct Ingest {
    /// Folder that the microscope writes to
    acquisition: PathBuf,

    #[command(flatten)]
    archive: Archive,

    /// End once everything that is there is done, instead of following
    #[arg(long)]
    once: bool,

    #[command(flatten)]
    stored: Stored,

    /// Name of the volume [default: as the acquisition archive says]
    #[arg(long, value_parser = volume_name)]
    volume: Option<String>,

    /// Tiles in work at the same time [default: 2]
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u16).range(1..))]
    workers: Option<u16>,
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
    let Ok(theirs) = acquisition.canonicalize() else {
        return Ok(());
    };
    // The archive may not exist yet; its nearest parent that does tells where it would be.
    let mut existing = std::path::absolute(archive)?;
    let mut missing = PathBuf::new();
    while !existing.exists() {
        let name = existing.file_name().unwrap_or_default().to_owned();
        missing = Path::new(&name).join(missing);
        if !existing.pop() {
            break;
        }
    }
    let ours = existing.canonicalize()?.join(missing);
    let within = ours.starts_with(&theirs) || (ours.exists() && theirs.starts_with(&ours));
    anyhow::ensure!(
        !within,
        "the microscope's folder is only read: name another folder for the archive than {}",
        archive.display()
    );
    Ok(())
}

impl Ingest {
    pub(crate) async fn run(self) -> Result<()> {
        // Before the archive is made: a wrong first folder should not leave a second one behind.
        saccade_archive::acquisition::AcquisitionInfo::read(&self.acquisition)?;
        let location = self.archive.location()?;
        if let Some(folder) = location.folder() {
            refuse_same_folder(&self.acquisition, folder)?;
        }
        let archive = VisualizationArchive::create(&location).await?;
        let options = IngestOptions {
            volume: self.volume,
            encoding: self.stored.encoding(),
            once: self.once,
            workers: self
                .workers
                .map_or(IngestOptions::DEFAULT.workers, usize::from),
            ..IngestOptions::DEFAULT
        };
        let cancel = cancel_when_interrupted();
        let shown = Shown::new("ingest", None);
        let done = run(&self.acquisition, &archive, &options, &shown, &cancel).await;
        shown.finish();
        let Summary {
            tiles,
            moved,
            deleted,
            quarantined,
            early,
            ..
        } = done?;
        archive.catalog().close().await;
        let mut done = format!("{tiles} tiles taken in, {moved} moved, {quarantined} set aside");
        if deleted > 0 {
            done.push_str(&format!(", {deleted} deleted"));
        }
        if early > 0 {
            done.push_str(&format!(", {early} transforms of tiles that have not come"));
        }
        say(&format!("{done}: {location}"));
        Ok(())
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
