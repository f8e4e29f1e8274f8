//! The resolution levels of a volume \[000 §4.1.1\].

use glam::{DVec3, UVec3};
use serde::{Deserialize, Serialize};

use crate::brick::{BRICK_EDGE, MAX_LEVELS};
use crate::voxel_box::VoxelBox;

/// One resolution of a volume.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Level {
    /// Size \[voxels of this level\].
    pub extent: UVec3,
    /// Level-0 voxels per voxel of this level and axis; at least 1, any ratio.
    pub downsampling: DVec3,
}

impl Level {
    /// The voxels of this level that a box of level-0 voxels touches.
    pub fn box_from_voxels(&self, level0: VoxelBox) -> VoxelBox {
        if level0.is_empty() {
            return VoxelBox::EMPTY;
        }
        let min = level0.min.as_dvec3() / self.downsampling;
        let max = level0.max.as_dvec3() / self.downsampling;
        VoxelBox::around(min, max).intersection(VoxelBox::of_size(self.extent))
    }

    /// The level-0 voxels that a box of this level's voxels touches.
    pub fn voxels_from_box(&self, of_level: VoxelBox) -> VoxelBox {
        let min = of_level.min.as_dvec3() * self.downsampling;
        let max = of_level.max.as_dvec3() * self.downsampling;
        VoxelBox::around(min, max)
    }
}

/// The levels of a volume whose every axis halves or stays from one level to the next.
///
/// An axis halves if its voxel size, doubled, does not exceed the largest; when no axis does, all
/// halve. Sizes round up. There are `ceil(log2(max_i(r_i s_i) / 32)) + 1` levels, where `r` is the
/// size in voxels and `s` the voxel size relative to the smallest \[000 §8.1.1\].
pub fn halving_levels(extent: UVec3, voxel_nm: DVec3) -> Vec<Level> {
    let relative = voxel_nm / voxel_nm.min_element();
    let longest = (extent.as_dvec3() * relative).max_element();
    let mut levels = vec![Level {
        extent,
        downsampling: DVec3::ONE,
    }];
    let mut bricks = longest / f64::from(BRICK_EDGE);
    let mut down = UVec3::ONE;
    while bricks > 1.0 && levels.len() < MAX_LEVELS {
        let size = relative * down.as_dvec3();
        let halve = (size * 2.0).cmple(DVec3::splat(size.max_element()));
        let halve = if halve.any() {
            halve
        } else {
            glam::BVec3::TRUE
        };
        down = UVec3::select(halve, down * 2, down);
        let extent = (extent.saturating_sub(UVec3::ONE) / down) + 1;
        levels.push(Level {
            extent,
            downsampling: down.as_dvec3(),
        });
        bricks /= 2.0;
    }
    levels
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The level counts of Table 1 in \[000\].
    #[test]
    fn level_counts_follow_the_paper() {
        for (xy, z, count) in [
            (32_768, 4_096, 11),
            (120_000, 15_000, 13),
            (512_000, 64_000, 15),
            (2_000_000, 250_000, 17),
        ] {
            let levels = halving_levels(UVec3::new(xy, xy, z), DVec3::new(5.0, 5.0, 40.0));
            assert_eq!(levels.len(), count, "{xy} x {xy} x {z}");
            let coarsest = levels.last().unwrap().extent;
            assert!(
                coarsest.max_element() <= BRICK_EDGE,
                "coarsest is {coarsest}"
            );
        }
    }

    #[test]
    fn anisotropy_shrinks_first() {
        let levels = halving_levels(UVec3::new(1025, 1024, 20), DVec3::new(4.6, 4.6, 45.0));
        let down: Vec<_> = levels
            .iter()
            .map(|l| l.downsampling.as_uvec3().to_array())
            .collect();
        assert_eq!(down[..4], [[1, 1, 1], [2, 2, 1], [4, 4, 1], [8, 8, 1]]);
        assert_eq!(down[4], [16, 16, 2]);
        assert_eq!(levels[1].extent, UVec3::new(513, 512, 20));
        assert_eq!(levels[4].extent, UVec3::new(65, 64, 10));
    }

    #[test]
    fn boxes_round_outwards() {
        let levels = halving_levels(UVec3::new(100, 100, 10), DVec3::new(1.0, 1.0, 10.0));
        let b = VoxelBox::new(UVec3::new(3, 4, 1), UVec3::new(5, 6, 2));
        let coarse = levels[1].box_from_voxels(b);
        assert_eq!(
            coarse,
            VoxelBox::new(UVec3::new(1, 2, 1), UVec3::new(3, 3, 2))
        );
        let back = levels[1].voxels_from_box(coarse);
        assert_eq!(back.intersection(b), b);
    }
}
