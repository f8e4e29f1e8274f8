//! Shape of the page table hierarchy \[000 §4.1.2, §8.1.1\].
//!
//! A brick is found in `depth` steps: one entry of the page directory, which is always resident and
//! holds all channels and levels one after another, names a block of page table entries; an entry
//! there names the next block or, at the last step, the brick.

use glam::UVec3;
use serde::{Deserialize, Serialize};

use crate::brick::{BrickId, BrickIdError, bricks_of};
use crate::levels::Level;

/// How the hierarchy is cut: `t` and `b_pt` of \[000 §8.1.1\].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PageTableShape {
    /// Steps from directory to brick, the directory included: 2 or 3.
    pub depth: u32,
    /// Edge of a page table block \[entries\]: 16 or 32.
    pub block_edge: u32,
}

/// Directory entries up to which two steps are preferred; about 4 MB.
const SMALL_DIRECTORY: u64 = 1 << 20;

impl PageTableShape {
    /// Entries in a page table block.
    pub const fn block_entries(self) -> u32 {
        self.block_edge.pow(3)
    }

    /// Bricks per axis under one directory entry.
    pub const fn bricks_per_entry(self) -> u32 {
        self.block_edge.pow(self.depth - 1)
    }

    /// The shape with the fewest steps whose directory stays small.
    pub fn for_volume(levels: &[Level], channels: u32) -> Self {
        let shapes = [(2, 16), (2, 32), (3, 16), (3, 32)];
        let shapes = shapes.map(|(depth, block_edge)| Self { depth, block_edge });
        let entries = |shape: &Self| {
            let per_channel: u64 = levels.iter().map(|l| volume_of(shape.directory(l))).sum();
            per_channel * u64::from(channels)
        };
        shapes
            .into_iter()
            .find(|s| entries(s) <= SMALL_DIRECTORY)
            .unwrap_or(shapes[3])
    }

    /// Directory entries per axis of a level.
    pub fn directory(self, level: &Level) -> UVec3 {
        (bricks_of(level.extent) + (self.bricks_per_entry() - 1)) / self.bricks_per_entry()
    }
}

fn volume_of(v: UVec3) -> u64 {
    u64::from(v.x) * u64::from(v.y) * u64::from(v.z)
}

/// Where one level's entries are in the directory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LevelTable {
    /// Bricks per axis.
    pub bricks: UVec3,
    /// Directory entries per axis.
    pub directory: UVec3,
    /// First directory entry of the level in channel 0.
    pub directory_base: u32,
}

/// The hierarchy of a volume.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PageTables {
    shape: PageTableShape,
    channels: u32,
    levels: Vec<LevelTable>,
    entries_per_channel: u32,
}

/// The volume does not fit the hierarchy.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PageTableError {
    /// Bricks beyond what an id can name.
    #[error("volume too large to address")]
    Address {
        /// Which part does not fit.
        #[from]
        source: BrickIdError,
    },
    /// The directory would need more than 2^31 entries.
    #[error("page directory of {entries} entries is too large: use depth 3 or larger blocks")]
    Directory {
        /// Entries over all channels and levels.
        entries: u64,
    },
}

impl PageTables {
    /// Lays out the directory: channel after channel, level after level, x fastest.
    ///
    /// # Errors
    ///
    /// [`PageTableError`] when bricks or directory entries cannot be addressed.
    pub fn new(
        levels: &[Level],
        channels: u32,
        shape: PageTableShape,
    ) -> Result<Self, PageTableError> {
        let mut base = 0;
        let mut tables = Vec::with_capacity(levels.len());
        for (index, level) in (0..).zip(levels) {
            let bricks = bricks_of(level.extent);
            BrickId::new(
                channels.saturating_sub(1),
                index,
                bricks.saturating_sub(UVec3::ONE),
            )?;
            let directory = shape.directory(level);
            let directory_base = u32::try_from(base).unwrap_or(u32::MAX);
            tables.push(LevelTable {
                bricks,
                directory,
                directory_base,
            });
            base += volume_of(directory);
        }
        let entries = base * u64::from(channels);
        if entries > 1 << 31 {
            return Err(PageTableError::Directory { entries });
        }
        let entries_per_channel = u32::try_from(base).unwrap_or(u32::MAX);
        Ok(Self {
            shape,
            channels,
            levels: tables,
            entries_per_channel,
        })
    }

    /// `t` and `b_pt`.
    pub fn shape(&self) -> PageTableShape {
        self.shape
    }

    /// The levels, finest first.
    pub fn levels(&self) -> &[LevelTable] {
        &self.levels
    }

    /// Directory entries of one channel.
    pub fn entries_per_channel(&self) -> u32 {
        self.entries_per_channel
    }

    /// Directory entries of all channels.
    pub fn directory_entries(&self) -> u32 {
        self.entries_per_channel * self.channels
    }

    /// The directory entry above a brick.
    pub fn directory_index(&self, id: BrickId) -> u32 {
        let table = &self.levels[id.level() as usize];
        let at = id.brick() / self.shape.bricks_per_entry();
        let flat = (at.z * table.directory.y + at.y) * table.directory.x + at.x;
        id.channel() * self.entries_per_channel + table.directory_base + flat
    }

    /// The entry within the page table block at `step` (1 is the one below the directory) on the
    /// way to a brick.
    pub fn entry_in_block(&self, id: BrickId, step: u32) -> u32 {
        let edge = self.shape.block_edge;
        let per_entry = edge.pow(self.shape.depth - 1 - step);
        let at = id.brick() / per_entry % edge;
        (at.z * edge + at.y) * edge + at.x
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levels::halving_levels;
    use glam::DVec3;

    /// Table 1 of \[000\], every cell.
    #[test]
    fn directory_sizes_follow_the_paper() {
        let rows = [
            (32_768, 4_096, [64, 32, 4, 1]),
            (120_000, 15_000, [235, 118, 15, 4]),
            (512_000, 64_000, [1_000, 500, 63, 16]),
            (2_000_000, 250_000, [3_907, 1_954, 245, 62]),
        ];
        let shapes = [(2, 16), (2, 32), (3, 16), (3, 32)];
        for (xy, z, sizes) in rows {
            let levels = halving_levels(UVec3::new(xy, xy, z), DVec3::new(5.0, 5.0, 40.0));
            for ((depth, block_edge), size) in shapes.into_iter().zip(sizes) {
                let directory = PageTableShape { depth, block_edge }.directory(&levels[0]);
                assert_eq!(
                    directory.x, size,
                    "{xy}^2 x {z}, t = {depth}, b_pt = {block_edge}"
                );
            }
        }
    }

    #[test]
    fn every_brick_has_its_own_path() {
        let levels = halving_levels(UVec3::new(700, 530, 610), DVec3::new(1.0, 1.0, 3.0));
        for depth in [2, 3] {
            // Blocks of 4 are smaller than any in use, so that many blocks and edges are met.
            let shape = PageTableShape {
                depth,
                block_edge: 4,
            };
            let tables = PageTables::new(&levels, 2, shape).unwrap();
            let mut seen = std::collections::HashSet::new();
            for (level, table) in (0..).zip(tables.levels()) {
                for brick in crate::voxel_box::VoxelBox::of_size(table.bricks).iter() {
                    for channel in 0..2 {
                        let id = BrickId::new(channel, level, brick).unwrap();
                        let steps = (1..depth).map(|step| tables.entry_in_block(id, step));
                        let steps: Vec<_> = steps.collect();
                        assert!(steps.iter().all(|&e| e < shape.block_entries()));
                        let directory = tables.directory_index(id);
                        assert!(directory < tables.directory_entries());
                        assert!(seen.insert((directory, steps)), "{id} shares its path");
                    }
                }
            }
        }
    }

    #[test]
    fn small_volumes_take_two_steps_and_large_ones_three() {
        let nm = DVec3::new(5.0, 5.0, 40.0);
        let shape = |x, z| PageTableShape::for_volume(&halving_levels(UVec3::new(x, x, z), nm), 1);
        assert_eq!(
            shape(32_768, 4_096),
            PageTableShape {
                depth: 2,
                block_edge: 16
            }
        );
        assert_eq!(shape(2_000_000, 250_000).depth, 3);
    }
}
