//! Values on the command line.

use std::path::PathBuf;

use clap::Args;
use glam::{DVec2, DVec3, UVec2, UVec3};
use saccade_archive::{ArchiveLocation, CatalogLocation, LocationError, StorageLocation};
use saccade_core::volume::check_name;

/// The visualization archive that a command works on.
#[derive(Args)]
pub(crate) struct Archive {
    /// Folder of the visualization archive, or s3://bucket/prefix in an object store that the
    /// AWS_ environment variables describe; see --catalog
    #[arg(value_name = "ARCHIVE")]
    archive: StorageLocation,

    #[command(flatten)]
    catalog: CatalogArgument,
}

/// Where the catalog is, if it is not in the archive's folder.
#[derive(Args, Clone)]
pub(crate) struct CatalogArgument {
    /// The catalog: a file on a local disk, or a PostgreSQL database that several machines share, as
    /// postgres://USER:PASSWORD@HOST/DATABASE [default: catalog.sqlite in the archive's folder]
    #[arg(long, value_name = "FILE|URL")]
    catalog: Option<CatalogLocation>,
}

impl Archive {
    pub(crate) fn location(&self) -> Result<ArchiveLocation, LocationError> {
        self.catalog.location(self.archive.clone())
    }
}

impl CatalogArgument {
    pub(crate) fn location(
        &self,
        storage: StorageLocation,
    ) -> Result<ArchiveLocation, LocationError> {
        ArchiveLocation::new(storage, self.catalog.clone())
    }

    pub(crate) fn is_given(&self) -> bool {
        self.catalog.is_some()
    }
}

/// Three whole numbers above 0, as `x,y,z`.
pub(crate) fn extent(text: &str) -> Result<UVec3, String> {
    let [x, y, z] = numbers(text, ',').ok_or("give three whole numbers as x,y,z")?;
    positive(
        UVec3::new(x, y, z),
        UVec3::min_element,
        "every axis needs at least one voxel",
    )
}

/// Nanometres per voxel, as `x,y,z` or one number for all axes.
pub(crate) fn voxel_nm(text: &str) -> Result<DVec3, String> {
    let nm = match numbers(text, ',') {
        Some([x, y, z]) => DVec3::new(x, y, z),
        None => match text.trim().parse() {
            Ok(all) => DVec3::splat(all),
            Err(_) => return Err("give nanometres as x,y,z".into()),
        },
    };
    let sensible = nm.min_element() > 0.0 && nm.max_element() <= LARGEST_VOXEL;
    (nm.is_finite() && sensible)
        .then_some(nm)
        .ok_or_else(|| "voxel sizes must be above 0, and at most a metre".into())
}

/// A spread of rotations \[degrees\].
pub(crate) fn degrees(text: &str) -> Result<f64, String> {
    within(text, 45.0, "stages turn tiles by 0 to 45 degrees")
}

/// A spread of shifts \[pixels\].
pub(crate) fn pixels(text: &str) -> Result<f64, String> {
    within(text, 65_536.0, "stages shift tiles by 0 to 65536 pixels")
}

fn within(text: &str, most: f64, must: &str) -> Result<f64, String> {
    let value: Option<f64> = text.parse().ok();
    let value = value.filter(|value| (0.0..=most).contains(value));
    value.ok_or_else(|| must.to_owned())
}

/// Largest voxel \[nm\]: a metre.
const LARGEST_VOXEL: f64 = 1e9;

/// Distances above 0, as `x,y`.
pub(crate) fn pitch(text: &str) -> Result<DVec2, String> {
    let [x, y] = numbers(text, ',').ok_or("give two numbers of voxels as x,y")?;
    let pitch = DVec2::new(x, y);
    let sensible = pitch.is_finite() && pitch.min_element() > 0.0 && pitch.max_element() <= 1e6;
    sensible
        .then_some(pitch)
        .ok_or_else(|| "tiles lie more than 0 and at most a million voxels apart".into())
}

/// A place, as `x,y`.
pub(crate) fn corner(text: &str) -> Result<DVec2, String> {
    let [x, y] = numbers(text, ',').ok_or("give two numbers of pixels as x,y")?;
    let corner = DVec2::new(x, y);
    let sensible = corner.is_finite() && corner.abs().max_element() <= 1e9;
    sensible
        .then_some(corner)
        .ok_or_else(|| "tiles lie within a thousand million pixels of zero".into())
}

/// Voxels per pixel.
pub(crate) fn scale(text: &str) -> Result<f64, String> {
    let scale: f64 = text.parse().map_err(|_| "give a number, such as 4")?;
    let sensible = (1e-2..=1e3).contains(&scale);
    sensible
        .then_some(scale)
        .ok_or_else(|| "a pixel is 0.01 to 1000 voxels large".into())
}

/// Width and height above 0, as `WxH`.
pub(crate) fn size(text: &str) -> Result<UVec2, String> {
    let [x, y] = numbers(text, 'x').ok_or("give width and height as WxH, such as 1280x720")?;
    positive(
        UVec2::new(x, y),
        UVec2::min_element,
        "width and height must be above 0",
    )
}

/// Longest side of a picture [pixels].
const LONGEST_SIDE: u32 = 16_384;

/// Width and height of a picture, as `WxH`.
pub(crate) fn picture_size(text: &str) -> Result<UVec2, String> {
    let size = size(text)?;
    if size.max_element() > LONGEST_SIDE {
        return Err(format!("a side has {LONGEST_SIDE} pixels at most"));
    }
    Ok(size)
}

/// A name that a volume can have.
pub(crate) fn volume_name(text: &str) -> Result<String, String> {
    match check_name(text) {
        Ok(()) => Ok(text.to_owned()),
        Err(error) => Err(error.to_string()),
    }
}

/// The file of a picture.
pub(crate) fn picture(text: &str) -> Result<PathBuf, String> {
    if text.is_empty() {
        return Err("name the file, such as picture.png".into());
    }
    let path = PathBuf::from(text);
    let png = path
        .extension()
        .is_none_or(|extension| extension.eq_ignore_ascii_case("png"));
    if png {
        Ok(path)
    } else {
        Err("pictures are PNG only: name it .png".into())
    }
}

/// A time in seconds.
pub(crate) fn seconds(text: &str) -> Result<std::time::Duration, String> {
    let seconds: f64 = text
        .parse()
        .map_err(|_| "give seconds, such as 30 or 0.5")?;
    std::time::Duration::try_from_secs_f64(seconds)
        .map_err(|_| "give seconds from 0 on, such as 30 or 0.5".to_owned())
}

/// A rate in Mpixel/s above 0; `None` for `max`.
pub(crate) fn rate(text: &str) -> Result<Rate, String> {
    if text == "max" {
        return Ok(Rate(None));
    }
    let rate: f64 = text
        .parse()
        .map_err(|_| "give Mpixel/s, such as 10, or max")?;
    let sensible = rate.is_finite() && rate > 0.0;
    sensible
        .then_some(Rate(Some(rate)))
        .ok_or_else(|| "rates must be above 0, or max".into())
}

/// Mpixel/s; `None`: as fast as possible.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Rate(pub(crate) Option<f64>);

fn numbers<T: std::str::FromStr, const N: usize>(text: &str, separator: char) -> Option<[T; N]> {
    let parts: Result<Vec<T>, _> = text.split(separator).map(|n| n.trim().parse()).collect();
    parts.ok()?.try_into().ok()
}

fn positive<T: Copy>(value: T, smallest: fn(T) -> u32, must: &str) -> Result<T, String> {
    if smallest(value) > 0 {
        Ok(value)
    } else {
        Err(must.to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_read_or_refused() {
        assert_eq!(extent("3, 4,5"), Ok(UVec3::new(3, 4, 5)));
        assert_eq!(size("640x480"), Ok(UVec2::new(640, 480)));
        assert_eq!(voxel_nm("4,4,40"), Ok(DVec3::new(4.0, 4.0, 40.0)));
        assert_eq!(voxel_nm("8"), Ok(DVec3::splat(8.0)));
        assert_eq!(
            (rate("2.5"), rate("max")),
            (Ok(Rate(Some(2.5))), Ok(Rate(None)))
        );
        for bad in ["", "3,4", "3,4,5,6", "0,1,1", "-1,2,3", "1.5,1,1", "a,b,c"] {
            assert!(extent(bad).is_err(), "{bad}");
        }
        assert!(picture_size("16384x1").is_ok() && picture_size("1x16385").is_err());
        assert!(volume_name("fib25-medulla").is_ok() && volume_name("fib 25").is_err());
        assert!(picture("a/b.PNG").is_ok() && picture("/dev/stdout").is_ok());
        for bad in ["a.jpg", "b.png.tif"] {
            assert!(picture(bad).unwrap_err().contains(".png"), "{bad}");
        }
        assert!(size("0x4").is_err() && size("64").is_err() && size("64x64x64").is_err());
        assert!(voxel_nm("4,4,0").is_err() && voxel_nm("4,nan,4").is_err());
        assert!(voxel_nm("1e308").is_err() && degrees("400").is_err() && degrees("nan").is_err());
        assert!(pixels("1e300").is_err() && pixels("24").is_ok() && degrees("0.5").is_ok());
        assert!(pitch("10800,9000.5").is_ok() && pitch("0,1").is_err() && pitch("1").is_err());
        assert!(scale("4").is_ok() && scale("0").is_err() && scale("1e4").is_err());
        assert!(rate("0").is_err() && rate("-1").is_err() && rate("fast").is_err());
        assert!(seconds("-1").is_err() && seconds("soon").is_err() && seconds("0.5").is_ok());
    }
}
