//! `saccade simulate`: a microscope's stream of tiles, without a microscope.

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::{Args, ValueEnum};
use glam::{DVec3, UVec2, UVec3};
use saccade_ingest::replay::{Input, ReplayConfig, detect};
use saccade_ingest::simulate::stack::PhantomStack;
use saccade_ingest::simulate::{Corrections, SimulateConfig};

use super::subject::Subject;
use crate::arguments::{Rate, extent, rate, size, voxel_nm};
use crate::interrupt::cancel_when_interrupted;
use crate::progress::Shown;
use crate::report::say;

/// Simulate a microscope: cut a stack, or a procedural phantom, into overlapping tiles and write
/// them into an acquisition archive as a microscope would.
#[derive(Args)]
pub(crate) struct Simulate {
    /// Folder of the acquisition archive; continued if it is there
    out: PathBuf,

    #[command(flatten)]
    tissue: Tissue,

    #[command(flatten)]
    microscope: Microscope,
}

#[derive(Args)]
#[group(required = true, multiple = false)]
struct Tissue {
    /// Simulate procedural tissue
    #[arg(long)]
    phantom: bool,

    /// Simulate from a registered stack (a folder of PNG or TIFF sections, a multi-page TIFF, an
    /// OME-Zarr), or replay a real acquisition (a tile list and its images)
    #[arg(long, value_name = "DIR")]
    input: Option<PathBuf>,
}

/// What is simulated, and how.
#[derive(Args)]
pub(crate) struct Microscope {
    /// Size of the phantom [voxels]
    #[arg(long, value_name = "X,Y,Z", value_parser = extent)]
    extent: Option<UVec3>,

    /// Voxel size [nm]
    #[arg(long, value_name = "X,Y,Z", value_parser = voxel_nm)]
    voxel_nm: Option<DVec3>,

    /// Size of a tile [pixels]
    #[arg(long, value_name = "WxH", value_parser = size)]
    tile: Option<UVec2>,

    /// Share of a tile that it has in common with its neighbour, 0.02 to 0.5
    #[arg(long, value_name = "SHARE")]
    overlap: Option<f64>,

    /// Standard deviation of a tile's shift [pixels]
    #[arg(long, value_name = "PIXELS")]
    jitter: Option<f64>,

    /// Standard deviation of a tile's rotation [degrees]
    #[arg(long, value_name = "DEGREES")]
    rotation: Option<f64>,

    /// Standard deviation of what the stage gets wrong [pixels]
    #[arg(long, value_name = "PIXELS")]
    stage_error: Option<f64>,

    /// When the true transforms follow the stage's
    #[arg(long, value_name = "WHEN")]
    corrections: Option<When>,

    /// Tiles written per second [Mpixel/s], or max
    #[arg(long, value_name = "RATE", value_parser = rate)]
    rate: Option<Rate>,

    /// Acquire sections in random order
    #[arg(long)]
    shuffle: bool,

    /// Equal seeds give equal archives
    #[arg(long, value_name = "NUMBER")]
    seed: Option<u64>,

    /// Name of the volume
    #[arg(long)]
    name: Option<String>,
}

#[derive(Clone, Copy, ValueEnum)]
enum When {
    Never,
    AfterSection,
    AtEnd,
}

/// Size of a phantom unless another is asked for [voxels].
const PHANTOM: UVec3 = UVec3::new(1024, 1024, 96);
/// Its voxels [nm].
const PHANTOM_NM: DVec3 = DVec3::new(8.0, 8.0, 40.0);

impl Microscope {
    /// Whether a tile size was asked for.
    pub(crate) fn has_tile(&self) -> bool {
        self.tile.is_some()
    }

    /// Whether a rate was asked for.
    pub(crate) fn has_rate(&self) -> bool {
        self.rate.is_some()
    }

    /// The settings, on top of others.
    fn config(&self, other: SimulateConfig) -> SimulateConfig {
        let corrections = |when| match when {
            When::Never => Corrections::Never,
            When::AfterSection => Corrections::AfterSection,
            When::AtEnd => Corrections::AtEnd,
        };
        SimulateConfig {
            name: self.name.clone().or(other.name),
            voxel_nm: self.voxel_nm.or(other.voxel_nm),
            seed: self.seed.unwrap_or(other.seed),
            tile: self.tile.unwrap_or(other.tile),
            overlap: self.overlap.unwrap_or(other.overlap),
            jitter_px: self.jitter.unwrap_or(other.jitter_px),
            rotation_deg: self.rotation.unwrap_or(other.rotation_deg),
            stage_error_px: self.stage_error.unwrap_or(other.stage_error_px),
            corrections: self.corrections.map_or(other.corrections, corrections),
            rate_mpixel_s: self.rate.map_or(other.rate_mpixel_s, |rate| rate.0),
            shuffle: self.shuffle || other.shuffle,
        }
    }

    /// What the settings ask for: the input, or else the phantom.
    pub(crate) fn subject(&self, input: Option<&Path>, other: SimulateConfig) -> Result<Subject> {
        let config = self.config(other);
        let Some(input) = input else {
            let voxel_nm = self.voxel_nm.unwrap_or(PHANTOM_NM);
            let extent = self.extent.unwrap_or(PHANTOM);
            let stack = Box::new(PhantomStack::new(config.seed, extent, voxel_nm)?);
            return Ok(Subject::Tissue { stack, config });
        };
        let input = detect(input)?;
        say(&input.describe());
        Ok(match input {
            Input::Stack { stack, .. } => Subject::Tissue { stack, config },
            Input::Acquisition(acquisition) => {
                let other = ReplayConfig::default();
                let config = ReplayConfig {
                    name: self.name.clone(),
                    voxel_nm: self.voxel_nm.unwrap_or(other.voxel_nm),
                    rate_mpixel_s: config.rate_mpixel_s,
                    ..other
                };
                Subject::Tiles {
                    acquisition,
                    config,
                }
            }
        })
    }
}

impl Simulate {
    pub(crate) async fn run(self) -> Result<()> {
        let input = self.tissue.input.as_deref();
        let subject = self.microscope.subject(input, SimulateConfig::default())?;
        let total = subject.tiles()?;
        let cancel = cancel_when_interrupted();
        let out = self.out.clone();
        let acquiring = tokio::task::spawn_blocking(move || {
            let shown = Shown::new("simulate", Some(total));
            let done = subject.acquire(&out, &cancel, &shown);
            shown.finish();
            done
        });
        let summary = acquiring.await??;
        let outcome = if summary.complete {
            "complete"
        } else {
            "interrupted; run it again to go on"
        };
        say(&format!(
            "{} tiles written, {outcome}: {}",
            summary.tiles,
            self.out.display()
        ));
        Ok(())
    }
}
