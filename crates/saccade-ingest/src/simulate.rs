//! The EM simulator \[000 §7\]: a registered stack becomes a microscope's stream of tiles.
//!
//! [`run`] follows a [`Plan`]: section by section it cuts tiles that overlap, are shifted and turned
//! at random, and writes each into an acquisition archive with its record, at a settable rate. The
//! record carries the transform that the stage believes in; [`Corrections`] say when the true one
//! follows. The plan is pure, so a test knows the truth without reading anything back.
//!
//! # Spaces and units
//!
//! One pixel of a tile has the size of one voxel of the section. Positions are tile pixels and
//! level-0 voxels, rates Mpixel/s (10^6 pixels), angles degrees.
//!
//! # Failure
//!
//! Nothing is overwritten: an archive that was simulated with the same settings, which
//! `simulation.json` keeps beside `volume.json`, is continued after the last tile recorded. One of
//! other settings is refused, and so is a microscope's. Rate and corrections may change. A tile is visible whole or not at all, and before its record.

use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::{fs, io};

use glam::{DVec3, UVec2};
use saccade_archive::acquisition::{AcquisitionError, Record, TileRecord, TransformRecord};
use saccade_archive::image::GrayImage;
use saccade_core::volume::VolumeError;

pub(crate) mod archive;
pub mod clock;
mod cut;
mod plan;
pub(crate) mod settings;
pub mod stack;
pub(crate) mod write;

pub use cut::cut;
pub use plan::{Plan, PlannedTile};

use crate::{Cancel, Meter, Progress, State};
use archive::Archive;
use clock::{Clock, Pace};
use settings::Settings;
use stack::{Stack, StackError};

/// When the true transforms follow the stage's approximate ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Corrections {
    /// Never.
    #[default]
    Never,
    /// For all tiles of a section, after its last tile.
    AfterSection,
    /// For all tiles, after the last one.
    AtEnd,
}

/// What the simulated microscope does.
#[derive(Clone, Debug, PartialEq)]
pub struct SimulateConfig {
    /// Name of the volume; the stack's if `None`.
    pub name: Option<String>,
    /// Voxel size \[nm\]; the stack's, or an assumption, if `None`.
    pub voxel_nm: Option<DVec3>,
    /// Randomness. Equal seeds give equal archives.
    pub seed: u64,
    /// Width and height of a tile \[pixels\].
    pub tile: UVec2,
    /// Share of a tile's width and height that it has in common with its neighbour.
    pub overlap: f64,
    /// Standard deviation of a tile's shift along x and y \[pixels\]. The overlap absorbs every shift:
    /// where it is small, shifts are smaller than asked for.
    pub jitter_px: f64,
    /// Standard deviation of a tile's rotation \[degrees\]; cut at 5 and at what the overlap absorbs.
    pub rotation_deg: f64,
    /// Standard deviation of what the stage gets wrong along x and y \[pixels\].
    pub stage_error_px: f64,
    /// When corrected transforms are sent.
    pub corrections: Corrections,
    /// Tiles written per second \[Mpixel/s\]; as fast as possible if `None`.
    pub rate_mpixel_s: Option<f64>,
    /// Sections in random order instead of ascending.
    pub shuffle: bool,
}

impl Default for SimulateConfig {
    fn default() -> Self {
        Self {
            name: None,
            voxel_nm: None,
            seed: 1,
            tile: UVec2::splat(1024),
            overlap: 0.1,
            jitter_px: 24.0,
            rotation_deg: 0.5,
            stage_error_px: 0.0,
            corrections: Corrections::Never,
            rate_mpixel_s: Some(10.0),
            shuffle: false,
        }
    }
}

/// Why a simulation ended early.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SimulateError {
    /// A setting that makes no sense.
    #[error("{setting} is {value}, but must be {must}")]
    Setting {
        /// Which.
        setting: &'static str,
        /// As given.
        value: String,
        /// What would make sense.
        must: &'static str,
    },
    /// A name that no volume can have.
    #[error(transparent)]
    Name(#[from] VolumeError),
    /// The stack could not be read.
    #[error("the stack cannot be read")]
    Stack {
        /// Why.
        #[from]
        source: StackError,
    },
    /// The archive's description or records could not be written or read.
    #[error("the acquisition archive cannot be used")]
    Archive {
        /// Why.
        #[from]
        source: AcquisitionError,
    },
    /// A tile could not be written.
    #[error("cannot write a tile; check the folder's permissions and its free space: {}", path.display())]
    Write {
        /// What the system says.
        source: io::Error,
        /// The tile's file.
        path: PathBuf,
    },
    /// The folder holds another acquisition.
    #[error(
        "the folder holds another acquisition: {differences}. Give the same options to go on with \
         it, or choose an empty folder: {}",
        path.display()
    )]
    OtherArchive {
        /// Which settings differ, and how.
        differences: String,
        /// The folder.
        path: PathBuf,
    },
    /// The folder holds what a microscope wrote.
    #[error(
        "the folder holds an acquisition that was not simulated (it has no readable {}), and other \
         tiles do not belong into it; choose an empty folder: {}",
        Settings::FILE, path.display()
    )]
    NotSimulated {
        /// The folder.
        path: PathBuf,
    },
}

/// What a run did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SimulateSummary {
    /// Tiles written.
    pub tiles: u64,
    /// Their pixels.
    pub pixels: u64,
    /// Transforms corrected.
    pub corrections: u64,
    /// Whether everything planned is written: `false` if cancelled.
    pub complete: bool,
}

/// Acquires `stack` into the archive `folder`. Blocks; cancelling ends it after the current tile.
///
/// Uses rayon for the pixels. `progress` is told of every tile.
///
/// # Errors
///
/// [`SimulateError`].
pub fn run(
    config: &SimulateConfig,
    stack: &dyn Stack,
    folder: &Path,
    clock: &dyn Clock,
    cancel: &Cancel,
    progress: &dyn Progress,
) -> Result<SimulateSummary, SimulateError> {
    let plan = Plan::new(config, stack.info())?;
    let settings = Settings::of_simulation(config, &stack.identity());
    let archive = Archive::open(folder, plan.info(), &settings)?;
    let sections = plan.sections();
    let skip = archive.written.clone();
    // One thread cuts, this one writes and waits; at most one finished tile lies between them.
    let (send, receive) = mpsc::sync_channel(1);
    std::thread::scope(|scope| {
        let (plan, sections) = (&plan, &sections);
        scope.spawn(move || {
            let tiles = sections.iter().flat_map(|&section| plan.tiles(section));
            for tile in tiles.filter(|tile| !skip.contains(&tile.name)) {
                if cancel.is_cancelled() {
                    return;
                }
                let image = cut(stack, &tile);
                // Nobody listens any more once writing has failed.
                if send.send((tile, image)).is_err() {
                    return;
                }
            }
        });
        let mut run = Run {
            archive,
            pace: Pace::new(config.rate_mpixel_s),
            clock,
            cancel,
            progress,
            meter: Meter::new(clock.monotonic()),
            left: 0,
            summary: SimulateSummary::default(),
        };
        run.left = plan
            .tile_count()
            .saturating_sub(run.archive.written.len() as u64);
        run.summary.complete = run.follow(config.corrections, plan, sections, receive)?;
        Ok(run.summary)
    })
}

/// Checks that [`run`] could begin, or go on, in the archive `folder`. Changes nothing.
///
/// # Errors
///
/// [`SimulateError`].
pub fn check(
    config: &SimulateConfig,
    stack: &dyn Stack,
    folder: &Path,
) -> Result<(), SimulateError> {
    let plan = Plan::new(config, stack.info())?;
    let settings = Settings::of_simulation(config, &stack.identity());
    Archive::is_there(folder, plan.info(), &settings).map(|_| ())
}

type CutTile = (PlannedTile, Result<GrayImage, StackError>);

/// Refuses what neither simulator nor replay can do.
pub(crate) fn check_rate_and_voxel(
    rate_mpixel_s: Option<f64>,
    voxel_nm: DVec3,
) -> Result<(), SimulateError> {
    let wrong = |setting, value: &dyn std::fmt::Display, must| {
        let value = value.to_string();
        Err(SimulateError::Setting {
            setting,
            value,
            must,
        })
    };
    if let Some(rate) = rate_mpixel_s
        && !(rate.is_finite() && rate >= 1e-6)
    {
        return wrong("the rate", &rate, "more than 0 Mpixel/s");
    }
    if !(voxel_nm.is_finite() && voxel_nm.min_element() > 0.0) {
        return wrong(
            "the voxel size",
            &voxel_nm,
            "positive, in nanometres as x,y,z",
        );
    }
    Ok(())
}

/// The writing half of a run.
struct Run<'a> {
    archive: Archive,
    pace: Pace,
    clock: &'a dyn Clock,
    cancel: &'a Cancel,
    progress: &'a dyn Progress,
    meter: Meter,
    /// Tiles still to write.
    left: u64,
    summary: SimulateSummary,
}

impl Run<'_> {
    /// Writes tiles as they come, and corrections when they are due. `false` if cancelled.
    fn follow(
        &mut self,
        corrections: Corrections,
        plan: &Plan,
        sections: &[u32],
        tiles: mpsc::Receiver<CutTile>,
    ) -> Result<bool, SimulateError> {
        self.tell();
        for &section in sections {
            for planned in plan.tiles(section) {
                if self.archive.written.contains(&planned.name) {
                    continue;
                }
                let Ok((tile, image)) = tiles.recv() else {
                    return Ok(false);
                };
                debug_assert_eq!(
                    tile.name, planned.name,
                    "tiles come in the order of the plan"
                );
                if !self.write(tile, &image?)? {
                    return Ok(false);
                }
            }
            if corrections == Corrections::AfterSection {
                self.correct(plan, &[section])?;
            }
        }
        if corrections == Corrections::AtEnd {
            self.correct(plan, sections)?;
        }
        Ok(true)
    }

    fn write(&mut self, tile: PlannedTile, image: &GrayImage) -> Result<bool, SimulateError> {
        let pixels = u64::from(tile.size.x) * u64::from(tile.size.y);
        let file = format!("tiles/{}.tif", tile.name);
        let path = self.archive.folder.join(&file);
        let failed = |source| SimulateError::Write {
            source,
            path: path.clone(),
        };
        let part = write::write_part(&path, image).map_err(failed)?;
        if !self.pace.wait(self.clock, pixels, self.cancel) {
            // Nothing half-written stays behind.
            fs::remove_file(&part).map_err(failed)?;
            return Ok(false);
        }
        fs::rename(&part, &path).map_err(failed)?;
        let PlannedTile {
            name: tile,
            section,
            size,
            stage: transform,
            ..
        } = tile;
        let record = TileRecord {
            tile,
            file,
            section,
            size,
            transform,
            channel: None,
        };
        self.archive.records.append(&Record::Tile(record))?;
        self.summary.tiles += 1;
        self.summary.pixels += pixels;
        self.left = self.left.saturating_sub(1);
        self.meter.add(self.clock.monotonic(), pixels);
        self.tell();
        Ok(true)
    }

    fn correct(&mut self, plan: &Plan, sections: &[u32]) -> Result<(), SimulateError> {
        for tile in sections.iter().flat_map(|&section| plan.tiles(section)) {
            if !self.archive.corrected.contains(&tile.name) {
                let (tile, transform) = (tile.name, tile.truth);
                let record = TransformRecord { tile, transform };
                self.archive.records.append(&Record::Transform(record))?;
                self.summary.corrections += 1;
            }
        }
        Ok(())
    }

    fn tell(&self) {
        self.progress.update(&State {
            tiles: self.summary.tiles,
            pixels: self.summary.pixels,
            queued: self.left,
            mpixel_per_s: self.meter.mpixel_per_s(self.clock.monotonic()),
            ..State::default()
        });
    }
}

#[cfg(test)]
mod tests;
