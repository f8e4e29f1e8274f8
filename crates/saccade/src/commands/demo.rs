//! `saccade demo`: the whole way in one process.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::{Context, Result};
use clap::Args;
use glam::UVec2;
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::AcquisitionInfo;
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{IngestOptions, run as ingest};
use saccade_ingest::simulate::SimulateConfig;
use saccade_serve::{Server, Volumes, offer_archive};
use saccade_source::stitched::StitchedOptions;
use tempfile::TempDir;

use super::ingest::Stored;
use super::serve::At;
use super::simulate::Microscope;
use super::subject::Subject;
use crate::arguments::seconds;
use crate::interrupt::cancel_when_interrupted;
use crate::progress::Shown;
use crate::report::{say, tell};

/// Watch a volume grow: a microscope is simulated or replayed, its tiles are taken in as they
/// arrive, and the volume is shown in the browser.
#[derive(Args)]
pub(crate) struct Demo {
    /// Real data instead of the phantom: a registered stack, or an acquisition as it came from the
    /// microscope [default: the phantom]
    #[arg(long, value_name = "DIR")]
    input: Option<PathBuf>,

    #[command(flatten)]
    microscope: Microscope,

    #[command(flatten)]
    stored: Stored,

    #[command(flatten)]
    at: At,

    /// Keep what is made in this folder, or go on with what is there [default: a temporary folder]
    #[arg(long, value_name = "DIR")]
    work: Option<PathBuf>,

    /// Do not open the browser
    #[arg(long)]
    no_open: bool,

    /// End once all tiles are in
    #[arg(long)]
    once: bool,

    /// End after this time [s] [default: at Ctrl-C]
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    duration: Option<Duration>,
}

/// How long the acquisition takes at most, unless a rate is asked for [s].
const SHOW: f64 = 90.0;

/// Fewer tiles than this would look stuck [1/s].
const TILES_PER_S: f64 = 4.0;

/// The edge of tiles that are many to a section, but not tiny [pixels].
fn tile_edge(section: UVec2) -> u32 {
    let longest = section.max_element();
    let fits = |edge: &u32| longest >= edge + edge / 2;
    [512, 256, 128, 64].into_iter().find(fits).unwrap_or(32)
}

/// A rate at which so many tiles keep coming and are soon in [Mpixel/s].
fn show_rate(tiles: u64, mpixel: f64) -> f64 {
    mpixel / (tiles as f64 / TILES_PER_S).min(SHOW)
}

impl Demo {
    pub(crate) async fn run(self) -> Result<()> {
        let server = Server::bind(self.at.address()).await?;
        let subject = self.subject()?;
        let work = Work::new(self.work.as_deref())?;
        // Before anything is shown: what is there may be something else.
        subject.check(&work.acquisition())?;
        let stop = cancel_when_interrupted();
        if let Some(duration) = self.duration {
            let stop = stop.clone();
            tokio::spawn(async move {
                tokio::time::sleep(duration).await;
                stop.cancel();
            });
        }
        let archive = VisualizationArchive::create(&work.archive()).await?;
        let done = self.show(server, subject, &work, &archive, &stop).await;
        // Also after an error: the microscope writes into a folder that is about to go.
        stop.cancel();
        archive.catalog().close().await;
        done
    }

    /// What is acquired, in tiles and at a pace that are worth watching.
    fn subject(&self) -> Result<Subject> {
        let other = SimulateConfig::default();
        let mut subject = self.microscope.subject(self.input.as_deref(), other)?;
        if let Subject::Tissue { stack, config } = &mut subject
            && !self.microscope.has_tile()
        {
            config.tile = UVec2::splat(tile_edge(stack.info().extent.truncate()));
        }
        if !self.microscope.has_rate() {
            subject.set_rate(Some(show_rate(subject.tiles()?, subject.mpixel()?)));
        }
        Ok(subject)
    }

    async fn show(
        &self,
        server: Server,
        subject: Subject,
        work: &Work,
        archive: &VisualizationArchive,
        stop: &Cancel,
    ) -> Result<()> {
        let total = subject.tiles()?;
        let acquisition = work.acquisition();
        let mut acquiring = tokio::task::spawn_blocking({
            let (out, stop) = (acquisition.clone(), stop.clone());
            move || subject.acquire(&out, &stop, &())
        });
        let info = tokio::select! {
            info = described(&acquisition) => info,
            early = &mut acquiring => { early??; AcquisitionInfo::read(&acquisition)? }
        };
        archive.catalog().create_volume(&info.volume()?).await?;
        let volumes = Volumes::new();
        let offer = offer_archive(&volumes, archive, StitchedOptions::default()).await?;
        if let Some((_, error)) = offer.failing.into_iter().next() {
            return Err(error.into());
        }
        let url = server.url();
        tell(&url);
        if !self.no_open {
            open_browser(&url);
        }

        // What earlier runs took in does not come again.
        let before = archive.catalog().entry(&info.name).await?.tiles;
        let shown = Shown::new("demo", Some(total.saturating_sub(before)));
        let working = async {
            let following = IngestOptions {
                folder: Some(work.archive()),
                encoding: self.stored.encoding(),
                ..Default::default()
            };
            let rest = IngestOptions {
                once: true,
                ..following.clone()
            };
            let acquired = Cancel::new();
            tokio::try_join!(
                async {
                    let done = acquiring.await;
                    acquired.cancel();
                    anyhow::Ok(done??)
                },
                async { Ok(ingest(&acquisition, archive, &following, &shown, &acquired).await?) },
            )?;
            // What was written last may not have been seen yet.
            shown.next_run();
            ingest(&acquisition, archive, &rest, &shown, stop).await?;
            shown.finish();
            if self.once {
                stop.cancel();
            } else if !stop.is_cancelled() {
                say("all tiles are in; Ctrl-C ends");
            }
            anyhow::Ok(())
        };
        let stopped = stop.clone();
        let serving = server.run(volumes.clone(), self.at.options(), async move {
            stopped.cancelled().await;
        });
        tokio::try_join!(working, async { Ok(serving.await?) })?;
        Ok(())
    }
}

/// Waits for an acquisition archive to say what it is.
async fn described(acquisition: &Path) -> AcquisitionInfo {
    loop {
        if let Ok(info) = AcquisitionInfo::read(acquisition) {
            return info;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

/// Where both archives are.
enum Work {
    Temporary(TempDir),
    Kept(PathBuf),
}

impl Work {
    fn new(kept: Option<&Path>) -> Result<Self> {
        Ok(match kept {
            Some(folder) => Self::Kept(folder.to_owned()),
            None => Self::Temporary(
                TempDir::with_prefix("saccade-demo-")
                    .context("cannot make a temporary folder; name one with --work")?,
            ),
        })
    }

    fn folder(&self) -> &Path {
        match self {
            Self::Temporary(folder) => folder.path(),
            Self::Kept(folder) => folder,
        }
    }

    fn acquisition(&self) -> PathBuf {
        self.folder().join("acquisition")
    }

    fn archive(&self) -> PathBuf {
        self.folder().join("archive")
    }
}

/// Opens the browser where there is a display.
fn open_browser(url: &str) {
    let display = ["DISPLAY", "WAYLAND_DISPLAY"]
        .iter()
        .any(|name| std::env::var_os(name).is_some_and(|value| !value.is_empty()));
    let opener = match std::env::consts::OS {
        "macos" => "open",
        _ if display => "xdg-open",
        _ => return,
    };
    let silent = Command::new(opener)
        .arg(url)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    if let Err(error) = silent {
        log::info!("no browser could be opened: {opener}: {error}");
    }
}

#[cfg(test)]
mod tests {
    use glam::UVec3;
    use saccade_ingest::simulate::Plan;
    use saccade_ingest::simulate::stack::StackInfo;

    use super::*;

    #[test]
    fn tiles_are_many_but_not_tiny() {
        for (section, want) in [
            ((21_494, 25_790), 512),
            ((1024, 1024), 512),
            ((700, 768), 512),
            ((767, 767), 256),
            ((250, 250), 128),
            ((200, 150), 128),
            ((100, 90), 64),
            ((1, 1), 32),
        ] {
            assert_eq!(tile_edge(section.into()), want, "{section:?}");
        }
    }

    /// Whatever the volume: soon something to see, and never a long wait between two tiles.
    #[test]
    fn no_demo_looks_stuck() {
        for extent in [
            (200, 150, 20),
            (1, 1, 1),
            (30, 30, 3),
            (250, 250, 250),
            (4096, 4096, 64),
        ] {
            let info = StackInfo {
                name: "s".to_owned(),
                extent: UVec3::from(extent),
                voxel_nm: None,
            };
            let tile = UVec2::splat(tile_edge(info.extent.truncate()));
            let config = SimulateConfig {
                tile,
                ..SimulateConfig::default()
            };
            let tiles = Plan::new(&config, &info).unwrap().tile_count();
            let each = tile.as_dvec2().element_product() / 1e6;
            let rate = show_rate(tiles, each * tiles as f64);
            let (first, all) = (each / rate, each * tiles as f64 / rate);
            assert!(first <= 0.2501, "{extent:?}: a tile every {first} s");
            assert!(all <= SHOW + 0.001, "{extent:?}: {all} s");
        }
        // Longer where there is enough to see for longer.
        assert!((show_rate(2250, 36.864) - 36.864 / SHOW).abs() < 1e-9);
        assert!((show_rate(80, 1.0) - 1.0 / 20.0).abs() < 1e-9);
    }
}
