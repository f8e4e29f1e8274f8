//! A folder of sections: one PNG or TIFF file each.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use glam::{UVec2, UVec3};
use saccade_archive::image::{GrayImage, decode_file};

use super::{Stack, StackError, StackInfo, check_inside, cropped, files};

/// A folder of section images in natural order. Keeps the last section decoded.
#[derive(Debug)]
pub struct SectionFolder {
    info: StackInfo,
    sections: Vec<PathBuf>,
    last: Mutex<Option<(u32, Arc<GrayImage>)>>,
}

impl SectionFolder {
    /// Opens a folder; reads its first section.
    ///
    /// # Errors
    ///
    /// [`StackError::Read`], [`StackError::Empty`], [`StackError::Image`].
    pub fn open(folder: &Path) -> Result<Self, StackError> {
        let sections = files::sections_of(folder)?;
        let empty = || StackError::Empty {
            path: folder.to_owned(),
        };
        let first = decoded(sections.first().ok_or_else(empty)?)?;
        let count = u32::try_from(sections.len()).expect("no folder holds four billion files");
        let info = StackInfo {
            name: files::volume_name(folder),
            extent: UVec3::new(first.width, first.height, count),
            voxel_nm: None,
        };
        Ok(Self {
            info,
            sections,
            last: Mutex::new(Some((0, Arc::new(first)))),
        })
    }

    fn section(&self, section: u32) -> Result<Arc<GrayImage>, StackError> {
        // Held while decoding: whoever asks meanwhile most likely asks for the same section.
        let mut last = self
            .last
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner());
        if let Some((known, image)) = &*last
            && *known == section
        {
            return Ok(Arc::clone(image));
        }
        let path = &self.sections[section as usize];
        let image = decoded(path)?;
        let (got, want) = (
            UVec2::new(image.width, image.height),
            self.info.extent.truncate(),
        );
        if got != want {
            return Err(StackError::Size {
                got,
                want,
                path: path.clone(),
            });
        }
        let image = Arc::new(image);
        *last = Some((section, Arc::clone(&image)));
        Ok(image)
    }
}

fn decoded(path: &Path) -> Result<GrayImage, StackError> {
    let image = decode_file(path);
    image.map_err(|source| StackError::Image {
        source,
        path: path.to_owned(),
    })
}

impl Stack for SectionFolder {
    fn info(&self) -> &StackInfo {
        &self.info
    }

    fn region(&self, section: u32, min: UVec2, size: UVec2) -> Result<GrayImage, StackError> {
        check_inside(&self.info, section, min, size)?;
        Ok(cropped(&*self.section(section)?, min, size))
    }
}
