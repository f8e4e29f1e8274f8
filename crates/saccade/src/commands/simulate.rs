//! `saccade simulate`: a microscope's stream of tiles, without a microscope.

use std::path::{Path, PathBuf};

use anyhow::{Result, ensure};
use clap::{Args, ValueEnum};
use glam::{DVec3, UVec2, UVec3};
use saccade_ingest::replay::{Input, ReplayConfig, detect};
use saccade_ingest::simulate::stack::PhantomStack;
use saccade_ingest::simulate::{Corrections, SimulateConfig};

use super::subject::Subject;
use crate::arguments::{Rate, degrees, extent, pixels, rate, size, volume_name, voxel_nm};
use crate::interrupt::cancel_when_interrupted;
use crate::progress::Shown;
use crate::report::say;

/// Simulate a microscope: cut a stack, or a procedural phantom, into overlapping tiles and write
/// them into an acquisition archive as a microscope would.
#[derive(Args)]
pub(crate) struct Simulate {
    /// Folder of the acquisition archive; continued if it is there and of the same settings
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
    /// OME-Zarr), or replay a real acquisition (its images, and a list of `file x y z`, a Fiji
    /// tile configuration or Render tile specifications)
    #[arg(long, value_name = "DIR")]
    input: Option<PathBuf>,
}

/// What is simulated, and how.
#[derive(Args)]
pub(crate) struct Microscope {
    /// Size of the phantom [voxels] [default: 1024,1024,96]
    #[arg(long, value_name = "X,Y,Z", value_parser = extent, conflicts_with = "input")]
    extent: Option<UVec3>,

    /// Voxel size [nm] [default: 8,8,40 for the phantom; for an input what it says, else an
    /// assumption that is told]
    #[arg(long, value_name = "X,Y,Z", value_parser = voxel_nm)]
    voxel_nm: Option<DVec3>,

    /// Size of a tile [pixels] [default: 1024x1024; demo: 512x512, less for small volumes]
    #[arg(long, value_name = "WxH", value_parser = size)]
    tile: Option<UVec2>,

    /// Share of a tile that it has in common with its neighbour, 0.02 to 0.5 [default: 0.1]
    #[arg(long, value_name = "SHARE")]
    overlap: Option<f64>,

    /// Standard deviation of a tile's shift [pixels] [default: 24]
    #[arg(long, value_name = "PIXELS", value_parser = pixels)]
    jitter: Option<f64>,

    /// Standard deviation of a tile's rotation [degrees] [default: 0.5]
    #[arg(long, value_name = "DEGREES", value_parser = degrees)]
    rotation: Option<f64>,

    /// Standard deviation of what the stage gets wrong [pixels] [default: 0]
    #[arg(long, value_name = "PIXELS", value_parser = pixels)]
    stage_error: Option<f64>,

    /// When the true transforms follow the stage's [default: never]
    #[arg(long, value_name = "WHEN")]
    corrections: Option<When>,

    /// Tiles written per second [Mpixel/s], or max [default: 10; demo: all in 90 s at most]
    #[arg(long, value_name = "RATE", value_parser = rate)]
    rate: Option<Rate>,

    /// Acquire sections in random order
    #[arg(long)]
    shuffle: bool,

    /// Equal seeds give equal archives [default: 1]
    #[arg(long, value_name = "NUMBER")]
    seed: Option<u64>,

    /// Name of the volume [default: phantom, or that of the input]
    #[arg(long, value_parser = volume_name)]
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

    /// The options given that mean nothing for tiles which are there already.
    fn of_tissue_alone(&self) -> Vec<&'static str> {
        let given = [
            ("--tile", self.tile.is_some()),
            ("--overlap", self.overlap.is_some()),
            ("--jitter", self.jitter.is_some()),
            ("--rotation", self.rotation.is_some()),
            ("--stage-error", self.stage_error.is_some()),
            ("--corrections", self.corrections.is_some()),
            ("--shuffle", self.shuffle),
            ("--seed", self.seed.is_some()),
        ];
        let given = given.into_iter().filter(|(_, given)| *given);
        given.map(|(option, _)| option).collect()
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
        let found = detect(input)?;
        say(&found.describe());
        Ok(match found {
            Input::Stack { stack, name, .. } => {
                let info = stack.info();
                if config.voxel_nm.is_none() && info.voxel_nm.is_none() {
                    say_assumed(info.voxel_nm_or_assumed());
                }
                let name = config.name.or(Some(name));
                let config = SimulateConfig { name, ..config };
                Subject::Tissue { stack, config }
            }
            Input::Acquisition(acquisition) => {
                let foreign = self.of_tissue_alone();
                ensure!(
                    foreign.is_empty(),
                    "the input is an acquisition, which is replayed as it is; leave out what is for \
                     the phantom and for stacks, {}: {}",
                    foreign.join(", "),
                    input.display()
                );
                let other = ReplayConfig::default();
                if self.voxel_nm.is_none() {
                    say_assumed(other.voxel_nm);
                }
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

fn say_assumed(nm: DVec3) {
    say(&format!(
        "voxel size assumed: {} x {} x {} nm; --voxel-nm sets it",
        nm.x, nm.y, nm.z
    ));
}

impl Simulate {
    pub(crate) async fn run(self) -> Result<()> {
        let input = self.tissue.input.as_deref();
        let subject = self.microscope.subject(input, SimulateConfig::default())?;
        let cancel = cancel_when_interrupted();
        let out = self.out.clone();
        let acquiring = tokio::task::spawn_blocking(move || {
            let shown = Shown::new("simulate", None);
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

#[cfg(test)]
mod tests {
    use clap::{Command, FromArgMatches};

    use super::*;

    fn microscope(arguments: &[&str]) -> Microscope {
        // Other options that it refers to.
        let command = Command::new("simulate").arg(clap::Arg::new("input").long("input"));
        let command = Microscope::augment_args(command);
        let matches = command.try_get_matches_from(["simulate"].iter().chain(arguments));
        Microscope::from_arg_matches(&matches.unwrap()).unwrap()
    }

    /// The help says what happens without an option; this holds it to that.
    #[test]
    fn the_help_names_the_defaults() {
        let default = SimulateConfig::default();
        let mut command = Microscope::augment_args(
            Command::new("simulate").arg(clap::Arg::new("input").long("input")),
        );
        command.build();
        let help = |option: &str| {
            let all: Vec<_> = command.get_arguments().collect();
            let found = all.into_iter().find(|arg| arg.get_long() == Some(option));
            found.unwrap().get_help().unwrap().to_string()
        };
        let by = |separator: &str, numbers: &[f64]| {
            let numbers: Vec<_> = numbers.iter().map(ToString::to_string).collect();
            numbers.join(separator)
        };
        let tile = default.tile.as_dvec2();
        for (option, value) in [
            ("extent", by(",", &PHANTOM.as_dvec3().to_array())),
            ("voxel-nm", by(",", &PHANTOM_NM.to_array())),
            ("tile", by("x", &tile.to_array())),
            ("overlap", default.overlap.to_string()),
            ("jitter", default.jitter_px.to_string()),
            ("rotation", default.rotation_deg.to_string()),
            ("stage-error", default.stage_error_px.to_string()),
            ("rate", default.rate_mpixel_s.unwrap().to_string()),
            ("seed", default.seed.to_string()),
        ] {
            let help = help(option);
            let said = help.split("[default: ").nth(1).unwrap_or_default();
            let said: String = said.split([';', ']']).next().unwrap_or_default().into();
            assert!(
                said.starts_with(&value),
                "{option}: {value} is not {said:?}"
            );
        }
        assert_eq!(default.corrections, Corrections::Never);
    }

    #[test]
    fn what_an_acquisition_cannot_use_is_named() {
        assert_eq!(microscope(&[]).of_tissue_alone(), Vec::<&str>::new());
        let of_use = ["--rate", "max", "--voxel-nm", "4", "--name", "v"];
        assert_eq!(microscope(&of_use).of_tissue_alone(), Vec::<&str>::new());
        let given = ["--overlap", "0.2", "--seed", "4", "--shuffle"];
        let named = microscope(&given).of_tissue_alone();
        assert_eq!(named, ["--overlap", "--shuffle", "--seed"]);
    }
}
