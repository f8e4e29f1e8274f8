//! All voxels of a volume in plain arrays.

use std::sync::LazyLock;

use glam::{DVec3, UVec3};
use saccade_core::brick::{BRICK_BORDER, BRICK_EDGE, BRICK_STORED_EDGE, BrickId};
use saccade_core::levels::Level;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;

/// All voxels of all levels, as they are now.
#[derive(Clone)]
pub(super) struct Truth {
    pub(super) volume: Volume,
    pub(super) levels: Vec<Vec<u8>>,
}

impl Truth {
    pub(super) fn new(volume: Volume) -> Self {
        let levels = volume.levels.iter().enumerate();
        let levels = levels.map(|(index, level)| {
            let voxels = VoxelBox::of_size(level.extent).iter();
            voxels.map(|v| blob(index, v, 0)).collect()
        });
        Self {
            levels: levels.collect(),
            volume,
        }
    }

    fn flat(&self, level: usize, voxel: UVec3) -> usize {
        let extent = self.volume.levels[level].extent;
        ((voxel.z * extent.y + voxel.y) * extent.x + voxel.x) as usize
    }

    /// Voxels outside repeat the nearest one inside. Channels differ from one another.
    pub(super) fn at(&self, channel: u32, level: usize, voxel: [i64; 3]) -> u8 {
        let extent = self.volume.levels[level].extent;
        let inside = UVec3::from_array(std::array::from_fn(|axis| {
            u32::try_from(voxel[axis].clamp(0, i64::from(extent[axis]) - 1)).unwrap()
        }));
        let value = self.levels[level][self.flat(level, inside)];
        value ^ u8::try_from(channel * 85).unwrap()
    }

    pub(super) fn brick(&self, id: BrickId) -> Vec<u8> {
        let low = (id.brick() * BRICK_EDGE).as_i64vec3() - i64::from(BRICK_BORDER);
        let cells = VoxelBox::of_size(UVec3::splat(BRICK_STORED_EDGE)).iter();
        let level = id.level() as usize;
        cells
            .map(|cell| self.at(id.channel(), level, (low + cell.as_i64vec3()).to_array()))
            .collect()
    }

    /// Smallest and largest of the voxels that a sample at a level-0 position is made of.
    pub(super) fn around(&self, channel: u32, level: usize, position: DVec3) -> [u8; 2] {
        let corner = (position / self.volume.levels[level].downsampling - 0.5).floor();
        let values = (0..8_u32).map(|i| {
            let offset = UVec3::new(i & 1, i >> 1 & 1, i >> 2).as_i64vec3();
            self.at(channel, level, (corner.as_i64vec3() + offset).to_array())
        });
        values.fold([255, 0], |[low, high], v| [low.min(v), high.max(v)])
    }

    pub(super) fn change(&mut self, voxels: VoxelBox, seed: u32) {
        for level in 0..self.levels.len() {
            for voxel in self.volume.levels[level].box_from_voxels(voxels).iter() {
                let at = self.flat(level, voxel);
                self.levels[level][at] = blob(level, voxel, seed);
            }
        }
    }
}

/// Values that vary little within blocks of some voxels, with empty blocks among them.
fn blob(level: usize, voxel: UVec3, seed: u32) -> u8 {
    let block = voxel / 12;
    let mut hash = block.x ^ block.y << 8 ^ block.z << 16 ^ seed.wrapping_mul(77_777);
    hash = (hash ^ hash >> 15).wrapping_mul(0x2c1b_3c6d);
    hash = (hash ^ hash >> 12).wrapping_mul(0x297a_2d39);
    hash ^= hash >> 15;
    let noise = (voxel.x * 7 + voxel.y * 5 + voxel.z * 3) % 4;
    match hash % 3 {
        0 => 0,
        _ => u8::try_from((hash >> 8) % 200 + noise).unwrap() + u8::try_from(level).unwrap(),
    }
}

/// Halving levels, and levels whose ratios fit neither bricks nor nodes.
pub(super) static TRUTHS: LazyLock<[Truth; 2]> = LazyLock::new(|| {
    let extent = UVec3::new(130, 75, 50);
    let halving = Volume::new("v", extent, DVec3::new(1.0, 1.0, 3.0)).unwrap();
    let level = |downsampling: DVec3| Level {
        extent: (extent.as_dvec3() / downsampling).ceil().as_uvec3(),
        downsampling,
    };
    let odd = Volume {
        levels: vec![
            level(DVec3::ONE),
            level(DVec3::new(1.5, 3.0, 1.0)),
            level(DVec3::new(5.0, 3.7, 2.2)),
        ],
        ..halving.clone()
    };
    [Truth::new(halving), Truth::new(odd)]
});
