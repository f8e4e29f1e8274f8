//! Registered stacks: sections that already fit each other, as the simulator's tissue.

use std::path::{Path, PathBuf};

use glam::{DVec3, UVec2, UVec3};
use saccade_archive::image::{GrayImage, ImageError};

pub mod conformance;
mod files;
mod pages;
mod phantom;
mod sections;
mod zarr;

pub use pages::TiffPages;
pub use phantom::PhantomStack;
pub use sections::SectionFolder;
pub use zarr::{Window, ZarrStack};

pub(crate) use files::volume_name;

use super::settings::Fingerprint;

/// Whatever else can go wrong in a library.
pub type BoxError = Box<dyn std::error::Error + Send + Sync>;

/// What a stack is.
#[derive(Clone, Debug, PartialEq)]
pub struct StackInfo {
    /// A name for the volume: letters, digits, `-` and `_`.
    pub name: String,
    /// Size \[voxels\]; no axis is 0.
    pub extent: UVec3,
    /// Voxel size \[nm\], if the stack says it.
    pub voxel_nm: Option<DVec3>,
}

impl StackInfo {
    /// The voxel size \[nm\], or what is common where the stack does not say: 4 x 4 x 40 nm for a few
    /// wide sections, as cut with a knife; 8 nm along each axis for a cube, as milled with a beam.
    pub fn voxel_nm_or_assumed(&self) -> DVec3 {
        let wide = self.extent.x.max(self.extent.y) > self.extent.z.saturating_mul(4);
        let assumed = if wide {
            DVec3::new(4.0, 4.0, 40.0)
        } else {
            DVec3::splat(8.0)
        };
        self.voxel_nm.unwrap_or(assumed)
    }
}

/// Sections of one size, 8-bit grey.
///
/// Every implementation passes [`conformance::check`].
pub trait Stack: Send + Sync {
    /// What the stack is; never changes.
    fn info(&self) -> &StackInfo;

    /// The voxels `min .. min + size` of a section, x fastest. May be called from any thread.
    ///
    /// # Errors
    ///
    /// [`StackError`]; [`StackError::Outside`] for what the stack does not hold.
    fn region(&self, section: u32, min: UVec2, size: UVec2) -> Result<GrayImage, StackError>;

    /// Which tissue it is: the same for the same stack, wherever it lies, and another for another.
    /// By default a fingerprint of the middle of two sections.
    fn identity(&self) -> String {
        let extent = self.info().extent;
        let size = extent.truncate().min(UVec2::splat(64));
        let min = (extent.truncate() - size) / 2;
        let mut fingerprint = Fingerprint::new();
        for section in [extent.z / 2, 0] {
            // Whoever cuts the section will say what is wrong with it.
            if let Ok(image) = self.region(section, min, size) {
                fingerprint.add(&image.voxels);
            }
        }
        format!("stack {fingerprint}")
    }
}

/// Why a stack, or a section of it, could not be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StackError {
    /// A file or folder could not be read.
    #[error("cannot read; check that it exists and that you may read it: {}", path.display())]
    Read {
        /// What the system says.
        source: std::io::Error,
        /// File or folder.
        path: PathBuf,
    },
    /// A section is no 8-bit grey image.
    #[error("a section of the stack is no usable image: {}", path.display())]
    Image {
        /// What is wrong, and how to mend it.
        source: ImageError,
        /// The section's file.
        path: PathBuf,
    },
    /// A page of a file, after its first, is no 8-bit grey image.
    #[error("page {page} of the stack is no usable image: {}", path.display())]
    Page {
        /// What is wrong, and how to mend it.
        source: ImageError,
        /// The page, from 1.
        page: u32,
        /// The file.
        path: PathBuf,
    },
    /// A section differs in size from the first.
    #[error(
        "a section has {got} pixels, but the first has {want}; a registered stack has sections of \
         one size, so crop them or take the file away: {}",
        path.display()
    )]
    Size {
        /// Its size.
        got: UVec2,
        /// The size of the first section.
        want: UVec2,
        /// The section's file.
        path: PathBuf,
    },
    /// Nothing there that could be a section.
    #[error("the folder holds no sections; put 8-bit grey PNG or TIFF files into it: {}", path.display())]
    Empty {
        /// The folder.
        path: PathBuf,
    },
    /// Neither folder nor a known kind of file.
    #[error(
        "this is no stack; give a folder of PNG or TIFF sections, a multi-page TIFF or an OME-Zarr: {}",
        path.display()
    )]
    Unknown {
        /// File or folder.
        path: PathBuf,
    },
    /// An OME-Zarr that cannot be read as a stack.
    #[error("the OME-Zarr cannot be read as a stack: {}", path.display())]
    Zarr {
        /// Why.
        source: BoxError,
        /// The group or array.
        path: PathBuf,
    },
    /// More was asked for than there is.
    #[error("the stack has {extent} voxels; section {section} at {min} with {size} is not in it")]
    Outside {
        /// What the stack holds \[voxels\].
        extent: UVec3,
        /// Section asked for.
        section: u32,
        /// Low corner asked for.
        min: UVec2,
        /// Size asked for.
        size: UVec2,
    },
}

/// Opens a stack: a folder of sections, a multi-page TIFF or an OME-Zarr of 8 bit.
///
/// # Errors
///
/// [`StackError`], naming the file and the fix.
pub fn open(path: &Path) -> Result<Box<dyn Stack>, StackError> {
    let failed = |source| StackError::Read {
        source,
        path: path.to_owned(),
    };
    let meta = std::fs::metadata(path).map_err(failed)?;
    if is_zarr(path) {
        return Ok(Box::new(ZarrStack::open(path, None)?));
    }
    if meta.is_dir() {
        let sections = files::sections_of(path)?;
        return match &sections[..] {
            [] => Err(StackError::Empty {
                path: path.to_owned(),
            }),
            // A single TIFF in a folder is most likely all pages in one file.
            [only] if files::is_tiff(only) => Ok(Box::new(TiffPages::open(only)?)),
            _ => Ok(Box::new(SectionFolder::open(path)?)),
        };
    }
    if files::is_tiff(path) {
        return Ok(Box::new(TiffPages::open(path)?));
    }
    Err(StackError::Unknown {
        path: path.to_owned(),
    })
}

/// Sections that a folder seems to hold: image files by name, or 1 for an OME-Zarr.
pub(crate) fn count(folder: &Path) -> i64 {
    if is_zarr(folder) {
        return 1;
    }
    files::sections_of(folder).map_or(0, |sections| {
        i64::try_from(sections.len()).unwrap_or(i64::MAX)
    })
}

/// Whether a folder is a Zarr hierarchy.
pub(crate) fn is_zarr(folder: &Path) -> bool {
    [".zattrs", ".zgroup", "zarr.json"]
        .iter()
        .any(|file| folder.join(file).is_file())
}

/// Refuses what lies outside; implementations call it first.
fn check_inside(info: &StackInfo, section: u32, min: UVec2, size: UVec2) -> Result<(), StackError> {
    let extent = info.extent;
    let inside = section < extent.z
        && size.min_element() > 0
        && min.cmplt(extent.truncate()).all()
        && size.cmple(extent.truncate().saturating_sub(min)).all();
    if inside {
        Ok(())
    } else {
        Err(StackError::Outside {
            extent,
            section,
            min,
            size,
        })
    }
}

/// Cuts a region out of a whole section.
fn cropped(section: &GrayImage, min: UVec2, size: UVec2) -> GrayImage {
    let width = section.width as usize;
    let mut voxels = Vec::with_capacity(size.x as usize * size.y as usize);
    for line in section
        .voxels
        .chunks_exact(width)
        .skip(min.y as usize)
        .take(size.y as usize)
    {
        voxels.extend_from_slice(&line[min.x as usize..][..size.x as usize]);
    }
    GrayImage::new(size.x, size.y, voxels)
}

#[cfg(test)]
mod tests;
