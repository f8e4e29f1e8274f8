//! What there is to know before anything is worked on.

use std::path::Path;

use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{AcquisitionInfo, RecordReader};
use saccade_archive::catalog::Worker;
use saccade_core::volume::Volume;

use super::earlier::Earlier;
use super::enter::retry;
use super::records::patiently;
use super::{IngestError, IngestOptions, process};
use crate::progress::Progress;

/// A worker that has begun.
pub(super) struct Begun {
    pub(super) volume: Volume,
    /// Where the records are read on.
    pub(super) reader: RecordReader,
    pub(super) earlier: Option<Earlier>,
    pub(super) worker: Worker,
}

/// Makes the volume if there is none, finds out whether the records are those that were read before, and registers a worker. A full
/// disk and a server that is away are waited out.
pub(super) async fn begin(
    acquisition: &Path,
    archive: &VisualizationArchive,
    options: &IngestOptions,
    progress: &dyn Progress,
) -> Result<Begun, IngestError> {
    let volume = AcquisitionInfo::read_volume(acquisition, options.volume.as_deref())?;
    let catalog = archive.catalog();
    let clock = catalog.clock();
    retry(clock, options, progress, || catalog.create_volume(&volume)).await?;
    // Before anything is worked on: what is in the queue may be of another acquisition.
    let cursor = retry(clock, options, progress, || catalog.cursor(&volume.name)).await?;
    let mut reader = RecordReader::new(acquisition, cursor);
    let known = patiently(clock, options, progress, || reader.recognize()).await?;
    if known != cursor {
        let learn = async || {
            let mut commit = catalog.begin(&volume.name).await?;
            // If another has read on, it has learned it as well.
            commit.advance(cursor, known).await?;
            commit.finish().await
        };
        retry(clock, options, progress, learn).await?;
    }
    let set_aside = || catalog.quarantined(&volume.name);
    let set_aside = retry(clock, options, progress, set_aside).await?;
    let earlier = Earlier::new(acquisition, cursor, &set_aside);
    let (name, process) = (worker_name(), process::this().unwrap_or_default());
    let register = || catalog.register_process(&name, &process, options.lease);
    let worker = retry(clock, options, progress, register).await?;
    Ok(Begun {
        volume,
        reader,
        earlier,
        worker,
    })
}

/// What people call this worker.
pub(super) fn worker_name() -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    format!("{}:{}", host.trim(), std::process::id())
}
