//! `saccade ingest`: from what a microscope writes to what can be looked at.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use saccade_archive::VisualizationArchive;
use saccade_archive::pyramid::Encoding;
use saccade_ingest::ingest::{IngestOptions, Summary, run};

use crate::interrupt::cancel_when_interrupted;
use crate::progress::Shown;
use crate::report::say;

/// Follow an acquisition archive and make each tile's pyramid and catalog entry as it arrives.
#[derive(Args)]
pub(crate) struct Ingest {
    /// Folder that the microscope writes to
    acquisition: PathBuf,

    /// Folder of the visualization archive; made if it is not there
    archive: PathBuf,

    /// End once everything that is there is done, instead of following
    #[arg(long)]
    once: bool,

    #[command(flatten)]
    stored: Stored,

    /// Name of the volume; as the acquisition archive says otherwise
    #[arg(long)]
    volume: Option<String>,

    /// Tiles in work at the same time
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

impl Ingest {
    pub(crate) async fn run(self) -> Result<()> {
        // Before the archive is made: a wrong first folder should not leave a second one behind.
        saccade_archive::acquisition::AcquisitionInfo::read(&self.acquisition)?;
        let archive = VisualizationArchive::create(&self.archive).await?;
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
            quarantined,
            ..
        } = done?;
        archive.catalog().close().await;
        say(&format!(
            "{tiles} tiles taken in, {moved} moved, {quarantined} set aside: {}",
            self.archive.display()
        ));
        Ok(())
    }
}
