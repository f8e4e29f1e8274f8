//! Replays a real acquisition into an acquisition archive.
//!
//! [`detect`] looks into a folder; [`Acquisition`] is a microscope's tiles with their stage positions
//! and, if there is one, the solution that registration found; [`run`] writes them as they would
//! have come from the microscope, the solution as a later update.
//!
//! # Spaces and units
//!
//! Lists and solutions are in pixels, each in its own frame. Both are moved to one frame whose
//! origin is the low corner of all tiles; 1 pixel is 1 level-0 voxel.
//!
//! # Failure
//!
//! As the simulator's: nothing is overwritten, an interrupted replay goes on, files appear whole.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use glam::DVec3;
use saccade_archive::acquisition::{
    AcquisitionError, AcquisitionInfo, ChannelRef, Record, TileRecord, TransformRecord,
};
use saccade_archive::image::ImageError;
use saccade_core::volume::check_name;

use crate::simulate::archive::Archive;
use crate::simulate::clock::{Clock, Pace};
use crate::simulate::settings::Settings;
use crate::simulate::stack::StackError;
use crate::simulate::write::part_of;
use crate::simulate::{SimulateError, SimulateSummary};
use crate::{Cancel, Meter, Progress, State};

pub(crate) mod acquisition;
pub(crate) mod detect;
pub(crate) mod lists;

pub use acquisition::{Acquisition, RawTile};
pub use detect::{Input, detect, find_list};

/// How an acquisition is replayed.
#[derive(Clone, Debug, PartialEq)]
pub struct ReplayConfig {
    /// Name of the volume; the acquisition's if `None`.
    pub name: Option<String>,
    /// Voxel size \[nm\]: pixel size of the images and thickness of the sections.
    pub voxel_nm: DVec3,
    /// Tiles written per second \[Mpixel/s\]; as fast as possible if `None`.
    pub rate_mpixel_s: Option<f64>,
    /// Time from the last tile to the solution's transforms.
    pub solution_after: Duration,
}

impl Default for ReplayConfig {
    fn default() -> Self {
        Self {
            name: None,
            // Light microscopy of thin sections, as array tomography makes them.
            voxel_nm: DVec3::new(73.0, 73.0, 200.0),
            rate_mpixel_s: Some(10.0),
            solution_after: Duration::from_secs(2),
        }
    }
}

/// Why an acquisition could not be understood or replayed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReplayError {
    /// A list or solution could not be read.
    #[error("the acquisition cannot be read")]
    Acquisition {
        /// Why.
        #[from]
        source: AcquisitionError,
    },
    /// The folder is read as a stack, and is none.
    #[error("the folder holds neither an acquisition (a tile list and its images) nor a stack")]
    Stack {
        /// Why it is no stack.
        #[from]
        source: StackError,
    },
    /// An image is of no use.
    #[error("an image of the acquisition cannot be used: {}", path.display())]
    Image {
        /// What is wrong, and how to mend it.
        source: ImageError,
        /// The image.
        path: PathBuf,
    },
    /// A list names images that are not there.
    #[error(
        "{missing} of {tiles} images of the tile list are nowhere below {}, the first is {first:?}; \
         copy them there, or take their lines out of the list: {}",
        folder.display(), list.display()
    )]
    MissingImages {
        /// How many are missing.
        missing: usize,
        /// How many the list has.
        tiles: usize,
        /// The first missing one, as the list names it.
        first: String,
        /// Where they were looked for.
        folder: PathBuf,
        /// The list.
        list: PathBuf,
    },
    /// Registration is there, but not what was registered.
    #[error(
        "this TrakEM2 project says where registration put {images} images that are here, but there is no list of \
         where the stage had them; put the list from which it was made (`file x y z` per line) into the folder, or \
         take the project out of it to see the images as a stack: {}",
        project.display()
    )]
    NoList {
        /// How many of its images are there.
        images: usize,
        /// The project.
        project: PathBuf,
    },
    /// The folder is what replay and simulator write.
    #[error("this already is an acquisition archive; use `saccade ingest` on it: {}", path.display())]
    AlreadyArchive {
        /// The folder.
        path: PathBuf,
    },
    /// Tiles so far apart that no volume can hold them.
    #[error("the tiles span {width} x {height} pixels, which no volume can hold; check the tile list: {}", list.display())]
    Extent {
        /// Along x \[pixels\].
        width: f64,
        /// Along y \[pixels\].
        height: f64,
        /// The list.
        list: PathBuf,
    },
    /// A setting that makes no sense, or an archive that cannot be written.
    #[error("the acquisition archive cannot be written")]
    Archive {
        /// Why.
        #[from]
        source: SimulateError,
    },
}

/// Replays `acquisition` into the archive `folder`. Blocks; cancelling ends it after the current
/// tile, and a later run goes on.
///
/// # Errors
///
/// [`ReplayError`].
pub fn run(
    config: &ReplayConfig,
    acquisition: &Acquisition,
    folder: &Path,
    clock: &dyn Clock,
    cancel: &Cancel,
    progress: &dyn Progress,
) -> Result<SimulateSummary, ReplayError> {
    let (info, settings) = described(config, acquisition)?;
    let mut archive = Archive::open(folder, &info, &settings)?;
    let mut pace = Pace::new(config.rate_mpixel_s);
    let mut summary = SimulateSummary::default();
    let mut meter = Meter::new(clock.monotonic());
    let written = |tile: &RawTile| archive.written.contains(&tile.name);
    let todo: Vec<&RawTile> = acquisition
        .tiles
        .iter()
        .filter(|tile| !written(tile))
        .collect();
    let mut queued = todo.len() as u64;
    progress.update(&State {
        queued,
        ..State::default()
    });
    for tile in todo {
        let pixels = u64::from(tile.size.x) * u64::from(tile.size.y);
        let extension = tile
            .image
            .extension()
            .and_then(|e| e.to_str())
            .unwrap_or("tif");
        let file = format!("tiles/{}.{extension}", tile.name);
        let path = folder.join(&file);
        let failed = |source| SimulateError::Write {
            source,
            path: path.clone(),
        };
        let part = part_of(&path);
        link_or_copy(&tile.image, &part).map_err(failed)?;
        if !pace.wait(clock, pixels, cancel) {
            fs::remove_file(&part).map_err(failed)?;
            return Ok(summary);
        }
        fs::rename(&part, &path).map_err(failed)?;
        archive.records.append(&Record::Tile(TileRecord {
            tile: tile.name.clone(),
            file,
            section: tile.section,
            size: tile.size,
            transform: tile.stage,
            channel: tile.channel.clone().map(ChannelRef::Name),
        }))?;
        summary.tiles += 1;
        summary.pixels += pixels;
        queued -= 1;
        meter.add(clock.monotonic(), pixels);
        progress.update(&State {
            tiles: summary.tiles,
            pixels: summary.pixels,
            queued,
            mpixel_per_s: meter.mpixel_per_s(clock.monotonic()),
            ..State::default()
        });
    }
    let solved = |tile: &RawTile| tile.aligned.map(|transform| (tile.name.clone(), transform));
    let solution: Vec<_> = acquisition.tiles.iter().filter_map(solved).collect();
    if solution
        .iter()
        .any(|(tile, _)| !archive.corrected.contains(tile))
    {
        if !pace.pause(clock, config.solution_after, cancel) {
            return Ok(summary);
        }
        for (tile, transform) in solution {
            if !archive.corrected.contains(&tile) {
                archive
                    .records
                    .append(&Record::Transform(TransformRecord { tile, transform }))?;
                summary.corrections += 1;
            }
        }
    }
    summary.complete = true;
    Ok(summary)
}

/// Checks that [`run`] could begin, or go on, in the archive `folder`. Changes nothing.
///
/// # Errors
///
/// [`ReplayError`].
pub fn check(
    config: &ReplayConfig,
    acquisition: &Acquisition,
    folder: &Path,
) -> Result<(), ReplayError> {
    let (info, settings) = described(config, acquisition)?;
    Archive::is_there(folder, &info, &settings)?;
    Ok(())
}

fn described(
    config: &ReplayConfig,
    acquisition: &Acquisition,
) -> Result<(AcquisitionInfo, Settings), SimulateError> {
    let name = config.name.as_ref().unwrap_or(&acquisition.name);
    check_name(name)?;
    crate::simulate::check_rate_and_voxel(config.rate_mpixel_s, config.voxel_nm)?;
    let mut info = AcquisitionInfo::new(name, acquisition.extent, config.voxel_nm);
    info.dtype = acquisition.dtype;
    info.channels.clone_from(&acquisition.channels);
    Ok((info, Settings::of_replay(&acquisition.identity())))
}

/// A second name for the image where the disk allows it, else a second image.
fn link_or_copy(from: &Path, to: &Path) -> io::Result<()> {
    // Left behind by a run that was killed.
    match fs::remove_file(to) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    fs::hard_link(from, to).or_else(|_| fs::copy(from, to).map(|_| ()))
}

#[cfg(test)]
mod tests;
