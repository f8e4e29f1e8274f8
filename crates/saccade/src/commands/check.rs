//! `saccade check`: whether an archive is whole.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Result, bail};
use clap::Args;
use indicatif::ProgressBar;
use saccade_archive::acquisition::RecordReader;
use saccade_archive::catalog::{Catalog, CatalogError};
use saccade_archive::check::{
    CheckOptions, CheckReport, Finding, FindingKind, Repair, check, count,
};

use saccade_archive::{ArchiveError, VisualizationArchive};

use crate::arguments::Archive;
use crate::report::{say, tell};

/// What the command ends with when tiles are damaged.
const DAMAGE: u8 = 3;

/// Check that every tile of an archive is there and whole. Ends with 0 if so, also if it is mended, or will be by `saccade
/// ingest`, which takes in what is still to be taken in then; with 3 if not, and with 1 if it cannot be looked at. Images that
/// were set aside are none of its tiles: how many there are is told, and changes nothing of that.
#[derive(Args)]
pub(crate) struct Check {
    #[command(flatten)]
    archive: Archive,

    /// Look at descriptions and lengths only, and read no voxels [default: read all]
    #[arg(long)]
    quick: bool,

    /// Delete pyramids that nothing has named for an hour; move tiles that lie outside of the volume, or where nothing says
    /// that they do, to where their records say; bring back tiles that are called deleted and that no deletion took, and
    /// take those away that one did; have tiles name their own pyramids; make tables anew that the catalog has lost; give tiles that are damaged, or name another's pyramid, back to
    /// `saccade ingest`, or set them aside if --acquisition does not help [default: change nothing]
    #[arg(long)]
    repair: bool,

    /// Folder that the microscope wrote to: its records tell whether the catalog has every tile as it should be, and with
    /// --repair damaged and lost tiles are made anew from them [default: of volumes from --pattern or a list what is kept of
    /// them, else none]
    #[arg(long, value_name = "FOLDER")]
    acquisition: Option<PathBuf>,

    /// Print the report as JSON [default: as text]
    #[arg(long)]
    json: bool,
}

impl Check {
    pub(crate) async fn run(self) -> Result<ExitCode> {
        let location = self.archive.location()?;
        let (archive, made) = match VisualizationArchive::open(&location).await {
            Err(ArchiveError::Catalog(CatalogError::NoTable { .. })) if self.repair => {
                let made = Catalog::make_tables_anew(location.catalog()).await?;
                for table in &made {
                    say(&format!(
                        "the catalog had no table {table:?}; made anew, empty: {}",
                        location.catalog()
                    ));
                }
                (VisualizationArchive::open(&location).await?, made.len())
            }
            archive => (archive?, 0),
        };
        let watched = super::ingest::beside(&location);
        let is_read = |folder: &PathBuf| folder.join(RecordReader::FILE).is_file();
        if let Some(folder) = self.acquisition.as_ref().filter(|folder| !is_read(folder))
            && !watched.as_ref().is_some_and(|watched| watched.is_dir())
        {
            // Who asks for it would take what is told otherwise for the result of it.
            bail!(
                "no records ({}) to compare the archive with are in the folder that --acquisition names: {}; give the folder that the \
                 microscope wrote to, or leave --acquisition out",
                RecordReader::FILE,
                folder.display()
            );
        }
        let options = CheckOptions {
            quick: self.quick,
            repair: self.repair,
            acquisition: self.acquisition,
            watched,
            ..CheckOptions::default()
        };
        // Draws nothing where there is no terminal.
        let bar = ProgressBar::new(0);
        let done = check(&archive, &options, &|done, total| {
            bar.set_length(total);
            bar.set_position(done);
        })
        .await;
        bar.finish_and_clear();
        let report = done?;
        archive.catalog().close().await;
        if self.json {
            tell(&serde_json::to_string_pretty(&report)?);
        } else {
            for finding in &report.findings {
                tell(&line(finding));
            }
        }
        let again = |f: &&Finding| f.kind == FindingKind::Lost && f.repair == Some(Repair::Queued);
        let again = report.findings.iter().filter(again).count();
        if again > 0 {
            say(&format!(
                "{again} tiles that the catalog had lost are taken in again, as their records have them; what `saccade update` had \
                 said of them nothing tells any more: move and delete them once more"
            ));
        }
        say(&format!("{}: {location}", summary(&report)));
        Ok(if report.damage() > 0 || made > 0 {
            ExitCode::from(DAMAGE)
        } else {
            ExitCode::SUCCESS
        })
    }
}

fn name(kind: FindingKind) -> &'static str {
    match kind {
        FindingKind::Unsound => "unsound",
        FindingKind::Missing => "missing",
        FindingKind::Damaged => "damaged",
        FindingKind::Mistaken => "mistaken",
        FindingKind::Misplaced => "misplaced",
        FindingKind::Shared => "shared",
        FindingKind::Spoilt => "spoilt",
        FindingKind::Lost => "lost",
        FindingKind::Miscounted => "miscounted",
        FindingKind::Orphan => "orphan",
        _ => "wrong",
    }
}

fn line(finding: &Finding) -> String {
    let mut whose = String::new();
    if let Some(tile) = &finding.tile {
        whose.push_str(&format!(" tile {tile}"));
    }
    if let Some(volume) = &finding.volume {
        whose.push_str(&format!(" of {volume}"));
    }
    if let Some(object) = &finding.object {
        whose.push_str(&format!(" ({object})"));
    }
    if !whose.is_empty() {
        whose.push(':');
    }
    let mut line = format!("{}:{whose} {}", name(finding.kind), finding.reason);
    line.push_str(match finding.repair {
        Some(Repair::Deleted) => "; deleted",
        Some(Repair::Recounted) => "; counted anew",
        Some(Repair::Kept) => "; it is kept",
        Some(Repair::Restored) => "; it is brought back",
        Some(Repair::Renumbered) => "; its record is mended, and nothing is lost",
        Some(Repair::Confirmed) => "; it stays there",
        Some(Repair::Renamed) => "; its name is mended, and nothing is lost",
        Some(Repair::TakenAway) => "; taken away",
        Some(Repair::Reindexed) => "; its indexes are made anew, and it is sound",
        Some(Repair::Reread) => "; `saccade ingest` goes on from what it has",
        Some(Repair::Moved) => "; moved to where its records say",
        Some(Repair::Queued) => "; `saccade ingest` makes it anew",
        Some(Repair::Quarantined) => "; set aside",
        _ => "",
    });
    line
}

fn summary(report: &CheckReport) -> String {
    let mut parts = vec![format!(
        "{} tiles, {} MB",
        report.tiles,
        report.bytes / 1_000_000
    )];
    for (kind, found) in count(&report.findings) {
        parts.push(format!("{found} {}", name(kind)));
    }
    if report.findings.is_empty() {
        parts.push("all whole".to_owned());
    }
    if report.retired > 0 {
        parts.push(format!("{} replaced and soon deleted", report.retired));
    }
    if report.young > 0 {
        parts.push(format!("{} not entered yet", report.young));
    }
    if report.queued > 0 {
        parts.push(format!("{} still to be taken in", report.queued));
    }
    if report.set_aside > 0 {
        parts.push(format!("{} set aside", report.set_aside));
    }
    if report.without_checksums > 0 {
        parts.push(format!("{} without checksums", report.without_checksums));
    }
    parts.join(", ")
}
