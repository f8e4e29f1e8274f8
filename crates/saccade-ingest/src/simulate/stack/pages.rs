//! A multi-page TIFF: one section per page.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use glam::{UVec2, UVec3};
use saccade_archive::image::{GrayImage, Image, ImageError, Pages, Wanted};

use super::{Stack, StackError, StackInfo, check_inside, cropped, files};

/// A multi-page TIFF of 8-bit grey pages. Keeps the last page decoded.
#[derive(Debug)]
pub struct TiffPages {
    info: StackInfo,
    path: PathBuf,
    pages: Mutex<Read>,
}

#[derive(Debug)]
struct Read {
    pages: Pages,
    last: Option<(u32, Arc<GrayImage>)>,
}

impl TiffPages {
    /// Opens a TIFF file and looks what its pages say of themselves; none is decoded.
    ///
    /// # Errors
    ///
    /// [`StackError::Image`] and, for later pages, [`StackError::Page`]; [`StackError::Size`].
    pub fn open(path: &Path) -> Result<Self, StackError> {
        let opened = Pages::open(path).map_err(|source| failed(path, 0, source));
        let mut pages = opened?;
        let mut want = UVec2::ZERO;
        for page in 0..pages.count() {
            let checked = pages.check(page, Wanted::GRAY_8);
            let got = UVec2::from_array(checked.map_err(|source| failed(path, page, source))?);
            if page == 0 {
                want = got;
            } else if got != want {
                return Err(StackError::Size {
                    got,
                    want,
                    path: path.to_owned(),
                });
            }
        }
        let info = StackInfo {
            name: files::volume_name(path),
            extent: want.extend(pages.count()),
            voxel_nm: None,
        };
        Ok(Self {
            info,
            path: path.to_owned(),
            pages: Mutex::new(Read { pages, last: None }),
        })
    }

    fn page(&self, section: u32) -> Result<Arc<GrayImage>, StackError> {
        let mut read = self.pages.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((known, image)) = &read.last
            && *known == section
        {
            return Ok(Arc::clone(image));
        }
        let UVec3 { x, y, .. } = self.info.extent;
        let wanted = Wanted {
            size: Some(UVec2::new(x, y)),
            ..Wanted::GRAY_8
        };
        let image = match read.pages.decode(section, wanted) {
            Ok(Image::Uint8(image)) => Arc::new(image),
            Ok(Image::Uint16(_)) => {
                let depth = ImageError::Depth {
                    bits: 16,
                    volume: 8,
                };
                return Err(failed(&self.path, section, depth));
            }
            Err(source) => return Err(failed(&self.path, section, source)),
        };
        read.last = Some((section, Arc::clone(&image)));
        Ok(image)
    }
}

/// The first page is what programs show of the file, so that people need no number to find it.
fn failed(path: &Path, page: u32, source: ImageError) -> StackError {
    let path = path.to_owned();
    match page {
        0 => StackError::Image { source, path },
        page => StackError::Page {
            source,
            page: page + 1,
            path,
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
