//! `saccade update`: registration and deletions from others than the microscope.

use std::fs::File;
use std::io::{BufReader, stdin};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use clap::Args;
use saccade_archive::VisualizationArchive;
use saccade_archive::catalog::Catalog;
use saccade_ingest::update::{Line, Summary, apply, read};

use crate::arguments::{Archive, volume_name};
use crate::interrupt::{INTERRUPTED, cancel_when_interrupted};
use crate::report::say;

/// What the command ends with when not all could be applied.
const NOT_ALL: u8 = 3;

/// Move or delete tiles of a volume: what registration found, or what should not be seen. Views that are open show it.
/// Ends with 3 if some lines could not be applied.
#[derive(Args)]
pub(crate) struct Update {
    #[command(flatten)]
    archive: Archive,

    /// One JSON object per line, or - for standard input: {"record": "transform", "tile": NAME, "transform":
    /// [a, b, c, d, tx, ty]} leads from pixels of the tile to voxels of its section, {"record": "delete", "tile":
    /// NAME} takes the tile out
    #[arg(value_name = "FILE")]
    changes: PathBuf,

    /// Name of the volume [default: the only one]
    #[arg(long, value_parser = volume_name)]
    volume: Option<String>,
}

/// All lines of a file, or of standard input.
fn lines(path: &Path) -> Result<Vec<Line>> {
    if path == Path::new("-") {
        return Ok(read(stdin().lock(), "standard input")?);
    }
    let name = path.display().to_string();
    let file = File::open(path);
    let file = file.with_context(|| {
        format!("cannot read {name}; check that it exists and that you may read it")
    })?;
    Ok(read(BufReader::new(file), &name)?)
}

/// The only volume.
async fn only(catalog: &Catalog) -> Result<String> {
    let volumes = catalog.volumes().await?;
    let mut names: Vec<_> = volumes.into_iter().map(|volume| volume.name).collect();
    match &names[..] {
        [_] => Ok(names.remove(0)),
        [] => bail!("the archive holds no volumes yet; `saccade ingest` fills it"),
        _ => bail!("say which volume with --volume: {}", names.join(", ")),
    }
}

fn told(summary: &Summary) -> String {
    let counts = [
        (summary.moved, "moved"),
        (summary.unchanged, "unchanged"),
        (summary.deleted, "deleted"),
        (summary.unknown, "unknown"),
        (summary.refused, "refused"),
        (summary.left, "lines left"),
    ];
    let always = 2;
    let counts = counts.iter().enumerate();
    let shown = counts.filter(|(n, (count, _))| *n < always || *count > 0);
    let words: Vec<_> = shown
        .map(|(_, (count, what))| format!("{count} {what}"))
        .collect();
    words.join(", ")
}

impl Update {
    pub(crate) async fn run(self) -> Result<ExitCode> {
        // Before anything is opened: a wrong file changes nothing.
        let path = self.changes;
        let lines = tokio::task::spawn_blocking(move || lines(&path)).await??;
        let location = self.archive.location()?;
        let archive = VisualizationArchive::open(&location).await?;
        let catalog = archive.catalog();
        let volume = match self.volume {
            Some(volume) => volume,
            None => only(catalog).await?,
        };
        catalog.volume(&volume).await?;
        let cancel = cancel_when_interrupted();
        let summary = apply(catalog, &volume, &lines, &cancel).await?;
        catalog.close().await;
        for what in &summary.not_applied {
            say(&format!("not applied: {what}"));
        }
        say(&format!(
            "{} of volume {volume}: {location}",
            told(&summary)
        ));
        Ok(match summary {
            Summary { left, .. } if left > 0 => ExitCode::from(INTERRUPTED),
            summary if summary.is_all() => ExitCode::SUCCESS,
            _ => ExitCode::from(NOT_ALL),
        })
    }
}
