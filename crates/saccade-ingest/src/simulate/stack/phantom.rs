//! The phantom as a stack.

use glam::{DVec3, UVec2, UVec3};
use rayon::prelude::*;
use saccade_archive::image::GrayImage;
use saccade_core::phantom::{Phantom, PhantomError};

use super::{Stack, StackError, StackInfo, check_inside};

/// A box of procedural tissue. Costs no memory, whatever its extent.
#[derive(Debug)]
pub struct PhantomStack {
    info: StackInfo,
    phantom: Phantom,
}

impl PhantomStack {
    /// The box at the origin of the tissue of `seed`.
    ///
    /// # Errors
    ///
    /// [`PhantomError`] on an impossible voxel size.
    ///
    /// # Panics
    ///
    /// If an axis of `extent` is 0.
    pub fn new(seed: u64, extent: UVec3, voxel_nm: DVec3) -> Result<Self, PhantomError> {
        assert!(
            extent.min_element() > 0,
            "a stack has voxels, but its extent is {extent}"
        );
        let phantom = Phantom::new(seed, voxel_nm)?;
        let info = StackInfo {
            name: "phantom".to_owned(),
            extent,
            voxel_nm: Some(voxel_nm),
        };
        Ok(Self { info, phantom })
    }

    /// The tissue itself, with its truth.
    pub fn phantom(&self) -> &Phantom {
        &self.phantom
    }
}

impl Stack for PhantomStack {
    fn info(&self) -> &StackInfo {
        &self.info
    }

    /// The rest of what makes it are settings.
    fn identity(&self) -> String {
        "phantom".to_owned()
    }

    fn region(&self, section: u32, min: UVec2, size: UVec2) -> Result<GrayImage, StackError> {
        check_inside(&self.info, section, min, size)?;
        let width = size.x as usize;
        let mut voxels = vec![0; width * size.y as usize];
        // Bands tall enough that neighbouring rows share what the sampler remembers.
        let band_rows: u32 = 64;
        let firsts: Vec<u32> = (min.y..min.y + size.y)
            .step_by(band_rows as usize)
            .collect();
        let bands = voxels
            .par_chunks_mut(band_rows as usize * width)
            .zip(firsts);
        bands.for_each(|(band, first)| {
            let mut sampler = self.phantom.sampler();
            for (y, row) in (first..).zip(band.chunks_exact_mut(width)) {
                sampler.row(min.x, y, section, row);
            }
        });
        Ok(GrayImage::new(size.x, size.y, voxels))
    }
}
