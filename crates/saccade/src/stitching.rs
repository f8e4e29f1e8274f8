//! How volumes of an archive are stitched, as the command line says it.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use saccade_source::stitched::{AlongZ, DiskCache, Gaps, Interpolation, Overlaps, StitchedOptions};

use crate::report::say;

/// How volumes of an archive are stitched.
#[derive(Args)]
#[command(next_help_heading = "Stitching (of an archive)")]
pub(crate) struct Stitching {
    /// What lies between pixels; labels are never mixed, whatever is chosen here and below [default: linear, and
    /// nearest of labels]
    #[arg(long, value_enum)]
    interpolation: Option<Between>,

    /// What is seen where tiles overlap: the tile whose centre is nearest, or a mean that fades
    /// towards each tile's edges
    #[arg(long, value_enum, default_value_t = Overlapping::Nearest)]
    overlaps: Overlapping,

    /// What a voxel shows that spans several sections: the nearest one, or what lies between two
    #[arg(long, value_enum, default_value_t = Sections::Nearest)]
    along_z: Sections,

    /// Fill gaps of at most so many lost sections from those around them, see --along-z
    #[arg(long, value_name = "SECTIONS", default_value_t = 0)]
    fill_gaps: u32,

    /// Folder, on a fast local disk, that keeps what was stitched over restarts [default: none]
    #[arg(long, value_name = "FOLDER")]
    disk_cache: Option<PathBuf>,

    /// What that folder may take [GB]
    #[arg(long, value_name = "GB", default_value_t = 20, requires = "disk_cache")]
    disk_cache_size: u64,
}

#[derive(Clone, Copy, ValueEnum)]
enum Between {
    /// The value of the nearest pixel
    Nearest,
    /// In proportion between four pixels
    Linear,
    /// On cubic curves through sixteen pixels: sharper, and slower
    Cubic,
}

#[derive(Clone, Copy, ValueEnum)]
enum Overlapping {
    /// As it was imaged, with seams
    Nearest,
    /// Without seams, for light microscopy
    Blend,
}

#[derive(Clone, Copy, ValueEnum)]
enum Sections {
    /// As it was imaged
    Nearest,
    /// In proportion
    Linear,
}

impl Stitching {
    /// Opens the cache on disk as well; where that fails, says so and goes on without.
    pub(crate) async fn options(&self) -> StitchedOptions {
        let disk_cache = match &self.disk_cache {
            None => None,
            Some(folder) => {
                let bytes = self.disk_cache_size.saturating_mul(1_000_000_000);
                let opened = DiskCache::open(folder, bytes).await;
                if let Err(error) = &opened {
                    say(&format!("without a cache on disk: {error}"));
                }
                opened.ok()
            }
        };
        StitchedOptions {
            interpolation: self.interpolation.map(|between| match between {
                Between::Nearest => Interpolation::Nearest,
                Between::Linear => Interpolation::Linear,
                Between::Cubic => Interpolation::Cubic,
            }),
            overlaps: match self.overlaps {
                Overlapping::Nearest => Overlaps::NearestCentre,
                Overlapping::Blend => Overlaps::Blend,
            },
            along_z: match self.along_z {
                Sections::Nearest => AlongZ::Nearest,
                Sections::Linear => AlongZ::Linear,
            },
            gaps: match (self.fill_gaps, self.along_z) {
                (0, _) => Gaps::Empty,
                (most, Sections::Nearest) => Gaps::Nearest(most),
                (most, Sections::Linear) => Gaps::Linear(most),
            },
            disk_cache,
            ..StitchedOptions::default()
        }
    }
}
