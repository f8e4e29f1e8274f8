//! How volumes of an archive are stitched, as the command line says it.

use std::path::PathBuf;

use anyhow::{Result, ensure};
use clap::{Args, ValueEnum};
use saccade_archive::ArchiveLocation;
use saccade_source::stitched::{
    AlongZ, DiskCache, DiskCacheError, Gaps, Interpolation, Overlaps, StitchedOptions,
};

use crate::folders::overlap;
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
    /// towards each tile's edges [default: nearest]
    #[arg(long, value_enum)]
    overlaps: Option<Overlapping>,

    /// What a voxel shows that spans several sections: the nearest one, or what lies between two [default: nearest]
    #[arg(long, value_enum)]
    along_z: Option<Sections>,

    /// Fill gaps of at most so many lost sections from those around them, see --along-z [default: 0]
    #[arg(long, value_name = "SECTIONS")]
    fill_gaps: Option<u32>,

    /// Folder, on a fast local disk, that keeps what was stitched over restarts [default: none]
    #[arg(long, value_name = "FOLDER")]
    disk_cache: Option<PathBuf>,

    /// What that folder may take [GB], or with another unit, such as 500MB or 1.5TB; 269MB at least
    #[arg(long, value_name = "GB", default_value = "20", value_parser = cache_size, requires = "disk_cache")]
    disk_cache_size: CacheSize,
}

/// Size of the cache on disk [bytes].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct CacheSize(u64);

fn cache_size(text: &str) -> Result<CacheSize, String> {
    let text = text.trim();
    let end = text.find(|c: char| c.is_ascii_alphabetic());
    let (number, unit) = text.split_at(end.unwrap_or(text.len()));
    let unit = match unit.to_ascii_uppercase().as_str() {
        "MB" => 1e6,
        "" | "GB" => 1e9,
        "TB" => 1e12,
        "MIB" => f64::from(1 << 20),
        "GIB" => f64::from(1 << 30),
        _ => return Err("sizes are in GB, or end with MB, GB or TB".to_owned()),
    };
    let number: f64 = { number.trim().parse() }
        .map_err(|_| "give a number of GB, such as 20 or 1.5, or with a unit, such as 500MB")?;
    let bytes = number * unit;
    let least = DiskCache::LEAST_BYTES;
    if bytes.is_nan() || bytes < least as f64 {
        let least = least.div_ceil(1_000_000);
        return Err(format!(
            "a cache on disk takes {least} MB at least; leave out --disk-cache for none"
        ));
    }
    let most = DiskCache::MOST_BYTES;
    if bytes > most as f64 {
        let most = most / 1_000_000_000;
        return Err(format!("a cache on disk takes {most} GB at most"));
    }
    #[expect(clippy::cast_possible_truncation, reason = "within bounds")]
    let bytes = bytes as u64;
    Ok(CacheSize(bytes))
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
    /// Refuses to be told how to stitch what is not stitched here, as in "an image is not stitched".
    pub(crate) fn refuse(&self, why: &str) -> Result<()> {
        let options = [
            ("--interpolation", self.interpolation.is_some()),
            ("--overlaps", self.overlaps.is_some()),
            ("--along-z", self.along_z.is_some()),
            ("--fill-gaps", self.fill_gaps.is_some()),
            ("--disk-cache", self.disk_cache.is_some()),
        ];
        let given = options.into_iter().filter(|(_, given)| *given);
        let given: Vec<&str> = given.map(|(option, _)| option).collect();
        ensure!(given.is_empty(), "{why}: leave out {}", given.join(", "));
        Ok(())
    }

    /// How volumes of this archive are stitched. Opens the cache on disk as well; where that fails, says so and
    /// goes on without.
    ///
    /// A folder that is something else is refused.
    pub(crate) async fn options(&self, archive: &ArchiveLocation) -> Result<StitchedOptions> {
        let disk_cache = match &self.disk_cache {
            None => None,
            Some(folder) => {
                if let Some(archive) = archive.folder() {
                    ensure!(
                        !overlap(folder, archive)?,
                        "the cache on disk can be neither in the archive's folder nor around it: name \
                         another folder with --disk-cache than {}",
                        folder.display()
                    );
                }
                match DiskCache::open(folder, self.disk_cache_size.0).await {
                    Ok(cache) => Some(cache),
                    Err(error @ DiskCacheError::Foreign { .. }) => return Err(error.into()),
                    Err(error) => {
                        let error = anyhow::Error::from(error);
                        say(&format!("without a cache on disk: {error:#}"));
                        None
                    }
                }
            }
        };
        Ok(StitchedOptions {
            interpolation: self.interpolation.map(|between| match between {
                Between::Nearest => Interpolation::Nearest,
                Between::Linear => Interpolation::Linear,
                Between::Cubic => Interpolation::Cubic,
            }),
            overlaps: match self.overlaps {
                None | Some(Overlapping::Nearest) => Overlaps::NearestCentre,
                Some(Overlapping::Blend) => Overlaps::Blend,
            },
            along_z: match self.along_z {
                None | Some(Sections::Nearest) => AlongZ::Nearest,
                Some(Sections::Linear) => AlongZ::Linear,
            },
            gaps: match (self.fill_gaps, self.along_z) {
                (None | Some(0), _) => Gaps::Empty,
                (Some(most), None | Some(Sections::Nearest)) => Gaps::Nearest(most),
                (Some(most), Some(Sections::Linear)) => Gaps::Linear(most),
            },
            disk_cache,
            ..StitchedOptions::default()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_fractions_and_units() {
        for (text, bytes) in [
            ("20", 20_000_000_000),
            ("1.5", 1_500_000_000),
            ("1.5GB", 1_500_000_000),
            ("500 MB", 500_000_000),
            ("2tb", 2_000_000_000_000),
            ("1GiB", 1 << 30),
        ] {
            assert_eq!(cache_size(text), Ok(CacheSize(bytes)), "{text}");
        }
        for bad in [
            "",
            "GB",
            "0",
            "0.1",
            "-3",
            "nan",
            "inf",
            "1e30",
            "3 potatoes",
        ] {
            assert!(cache_size(bad).is_err(), "{bad}");
        }
        // As the help says.
        assert!(cache_size("0").unwrap_err().contains("269 MB at least"));
        assert!(cache_size("269MB").is_ok() && cache_size("268MB").is_err());
        for large in ["3TB", "2200", "1000000TB"] {
            let told = cache_size(large).unwrap_err();
            assert!(told.contains("2199 GB at most"), "{large}: {told}");
        }
    }
}
