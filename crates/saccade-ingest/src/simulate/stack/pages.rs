//! A multi-page TIFF: one section per page.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use glam::{UVec2, UVec3};
use saccade_archive::image::{GrayImage, ImageError};
use tiff::ColorType;
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::{TiffError, TiffResult};

use super::{Stack, StackError, StackInfo, check_inside, cropped, files};

/// A multi-page TIFF of 8-bit grey pages. Keeps the last page decoded.
pub struct TiffPages {
    info: StackInfo,
    path: PathBuf,
    pages: Mutex<Pages>,
}

type Tiff = Decoder<BufReader<File>>;

struct Pages {
    tiff: Tiff,
    last: Option<(u32, Arc<GrayImage>)>,
}

impl std::fmt::Debug for TiffPages {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TiffPages")
            .field("info", &self.info)
            .finish_non_exhaustive()
    }
}

impl TiffPages {
    /// Opens a TIFF file and counts its pages.
    ///
    /// # Errors
    ///
    /// [`StackError::Read`], [`StackError::Image`], [`StackError::Size`].
    pub fn open(path: &Path) -> Result<Self, StackError> {
        let image = |source| StackError::Image {
            source,
            path: path.to_owned(),
        };
        let failed = |error| image(image_error(error));
        let file = File::open(path);
        let file = file.map_err(|source| StackError::Read {
            source,
            path: path.to_owned(),
        })?;
        let open = || -> TiffResult<Tiff> {
            Ok(Decoder::new(BufReader::new(file))?.with_limits(Limits::unlimited()))
        };
        let mut tiff = open().map_err(failed)?;
        let mut want = None;
        let mut count: u32 = 0;
        loop {
            let (width, height) = tiff.dimensions().map_err(failed)?;
            let color = tiff.colortype().map_err(failed)?;
            check_color(color).map_err(image)?;
            let got = UVec2::new(width, height);
            let want = *want.get_or_insert(got);
            if got != want {
                return Err(StackError::Size {
                    got,
                    want,
                    path: path.to_owned(),
                });
            }
            count += 1;
            if !tiff.more_images() {
                break;
            }
            tiff.next_image().map_err(failed)?;
        }
        let extent = want.unwrap_or_default();
        if extent.min_element() == 0 {
            return Err(image(ImageError::Broken {
                reason: "it has no pixels".to_owned(),
            }));
        }
        let extent = UVec3::new(extent.x, extent.y, count);
        let info = StackInfo {
            name: files::volume_name(path),
            extent,
            voxel_nm: None,
        };
        Ok(Self {
            info,
            path: path.to_owned(),
            pages: Mutex::new(Pages { tiff, last: None }),
        })
    }

    fn page(&self, section: u32) -> Result<Arc<GrayImage>, StackError> {
        let mut pages = self
            .pages
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner());
        if let Some((known, image)) = &pages.last
            && *known == section
        {
            return Ok(Arc::clone(image));
        }
        let mut read = || -> TiffResult<DecodingResult> {
            pages.tiff.seek_to_image(section as usize)?;
            pages.tiff.read_image()
        };
        let image = |source| StackError::Image {
            source,
            path: self.path.clone(),
        };
        let voxels = read().map_err(|error| image(image_error(error)))?;
        let DecodingResult::U8(voxels) = voxels else {
            return Err(image(ImageError::Unsupported {
                what: "samples that are not 8 bit".to_owned(),
            }));
        };
        let extent = self.info.extent;
        if voxels.len() as u64 != u64::from(extent.x) * u64::from(extent.y) {
            let reason = format!("page {section} has {} values", voxels.len());
            return Err(image(ImageError::Broken { reason }));
        }
        let image = Arc::new(GrayImage::new(extent.x, extent.y, voxels));
        pages.last = Some((section, Arc::clone(&image)));
        Ok(image)
    }
}

fn check_color(color: ColorType) -> Result<(), ImageError> {
    match color {
        ColorType::Gray(8) => Ok(()),
        ColorType::Gray(bits) => Err(ImageError::Depth {
            bits: bits.into(),
            volume: 8,
        }),
        other => Err(ImageError::Unsupported {
            what: format!("{other:?}"),
        }),
    }
}

fn image_error(error: TiffError) -> ImageError {
    match error {
        TiffError::IoError(error) => ImageError::Incomplete {
            reason: error.to_string(),
        },
        TiffError::UnsupportedError(error) => ImageError::Unsupported {
            what: error.to_string(),
        },
        error => ImageError::Broken {
            reason: error.to_string(),
        },
    }
}

impl Stack for TiffPages {
    fn info(&self) -> &StackInfo {
        &self.info
    }

    fn region(&self, section: u32, min: UVec2, size: UVec2) -> Result<GrayImage, StackError> {
        check_inside(&self.info, section, min, size)?;
        Ok(cropped(&*self.page(section)?, min, size))
    }
}
