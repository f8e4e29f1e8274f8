//! How the memory ceiling is divided.

use glam::UVec3;
use saccade_core::brick::{BRICK_STORED_EDGE, BRICK_STORED_VOXELS};
use saccade_core::page_table::PageTables;

use crate::layout::{COUNTERS, MISSES, NODE_ROW, NODE_WORDS, SIBLINGS};

/// Readbacks in flight at once; each has a buffer of its own.
pub(crate) const READBACKS: u64 = 3;
/// Fewer bricks than this make no picture.
const LEAST_BRICKS: u64 = 64;
/// Blocks that every volume gets, if it has so many.
const LEAST_BLOCKS: u64 = 8;
/// The share of the ceiling that page table blocks may take.
const TABLE_SHARE: u64 = 16;

/// The share of the ceiling that the residency octree may take.
const OCTREE_SHARE: u64 = 16;
/// Blocks of nodes that every octree gets, if it has so many.
const LEAST_NODE_BLOCKS: u64 = 64;
/// What a node knows of the values of a channel.
const TEXEL_BYTES: u64 = 4 * NODE_WORDS as u64;
/// What it knows of the bricks of a channel.
const RESIDENT_BYTES: u64 = 4;

/// What a residency octree has use for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OctreeSize {
    /// Blocks of eight nodes, grown everywhere.
    pub(crate) blocks: u64,
    /// Channels that a node knows of.
    pub(crate) slots: u32,
}

/// What bricks and tables are for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Needs {
    /// What the residency octree has use for.
    pub(crate) octree: OctreeSize,
    /// Bytes of a voxel.
    pub(crate) voxel_bytes: u32,
}

/// What the device allows.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DeviceLimits {
    /// Edge of a 3D texture \[texels\].
    pub(crate) texture_edge: u32,
    /// Edge of a 2D texture \[texels\].
    pub(crate) rows: u32,
    /// Size of a storage buffer \[bytes\].
    pub(crate) buffer: u64,
}

/// How many of what.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Plan {
    /// Page table blocks.
    pub(crate) blocks: u32,
    /// Brick slots per axis of the brick cache.
    pub(crate) brick_grid: UVec3,
    /// Entries of the page directory.
    pub(crate) directory: u32,
    /// Blocks of eight nodes of the residency octree.
    pub(crate) node_blocks: u32,
    slots: u32,
    voxel_bytes: u32,
    block_entries: u32,
}

/// What would be needed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Misfit {
    /// A higher ceiling \[bytes\].
    Ceiling(u64),
    /// A larger storage buffer \[bytes\].
    Buffer(u64),
}

impl Plan {
    /// Fills the ceiling, or less where the volume has no use for more.
    pub(crate) fn new(
        tables: &PageTables,
        Needs {
            octree,
            voxel_bytes,
        }: Needs,
        ceiling: u64,
        limits: DeviceLimits,
    ) -> Result<Self, Misfit> {
        let directory = tables.directory_entries();
        let block_entries = tables.shape().block_entries();
        let block_bytes = u64::from(block_entries) * 4;
        if u64::from(directory) * 4 > limits.buffer {
            return Err(Misfit::Buffer(u64::from(directory) * 4));
        }
        let most_blocks = blocks_of(tables).min(limits.buffer / block_bytes);
        let block_texels = u64::from(octree.slots * SIBLINGS);
        let node_block_bytes = block_texels * (TEXEL_BYTES + RESIDENT_BYTES);
        let most_node_blocks = octree
            .blocks
            .min(limits.buffer / (block_texels * RESIDENT_BYTES))
            .min(u64::from(limits.rows) * u64::from(NODE_ROW) / block_texels)
            .max(2);
        // All but bricks.
        let rest = |ceiling: u64| {
            let blocks = (ceiling / TABLE_SHARE / block_bytes)
                .max(LEAST_BLOCKS)
                .min(most_blocks)
                .clamp(1, 1 << 16);
            let node_blocks = (ceiling / OCTREE_SHARE / node_block_bytes)
                .max(LEAST_NODE_BLOCKS)
                .min(most_node_blocks)
                .min(1 << 24);
            Self {
                blocks: u32::try_from(blocks).expect("at most 2^16"),
                brick_grid: UVec3::ZERO,
                directory,
                node_blocks: u32::try_from(node_blocks).expect("at most 2^24"),
                slots: octree.slots,
                voxel_bytes,
                block_entries,
            }
        };
        let most_bricks = bricks_of(tables);
        let least_bricks = LEAST_BRICKS.min(most_bricks);
        let per_brick = BRICK_STORED_VOXELS as u64 * u64::from(voxel_bytes) + 4 + 1;
        let room = |ceiling: u64| ceiling.saturating_sub(rest(ceiling).total_bytes()) / per_brick;
        if room(ceiling) < least_bricks {
            let mut needed = (ceiling + 1).max(rest(0).total_bytes() + least_bricks * per_brick);
            // With the ceiling grows what tables and octree take of it.
            while room(needed) < least_bricks {
                needed += needed / 256 + 1;
            }
            return Err(Misfit::Ceiling(needed));
        }
        let room = room(ceiling);
        let edge = limits.texture_edge / BRICK_STORED_EDGE;
        let whole = covering_grid(most_bricks, edge);
        let fits = product(whole) >= most_bricks && product(whole) <= room;
        Ok(Self {
            brick_grid: if fits {
                whole
            } else {
                largest_grid(room, edge)
            },
            ..rest(ceiling)
        })
    }

    /// Brick slots.
    pub(crate) fn bricks(&self) -> u32 {
        self.brick_grid.element_product()
    }

    /// Entries in the page table cache.
    pub(crate) fn table_entries(&self) -> u32 {
        self.blocks * self.block_entries
    }

    /// Words of the bitmask over all physical entries.
    pub(crate) fn mask_words(&self) -> u32 {
        (self.directory + self.table_entries()).div_ceil(32)
    }

    /// Words of the bitmask over brick slots, then blocks.
    pub(crate) fn usage_words(&self) -> u32 {
        (self.bricks() + self.blocks).div_ceil(32)
    }

    /// Size of a report \[bytes\].
    pub(crate) fn report_bytes(&self) -> u64 {
        4 * (u64::from(COUNTERS) + u64::from(self.usage_words()) + 2 * u64::from(MISSES))
    }

    /// The brick cache, with the value range of each slot \[bytes\].
    pub(crate) fn brick_bytes(&self) -> u64 {
        u64::from(self.bricks()) * (BRICK_STORED_VOXELS as u64 * u64::from(self.voxel_bytes) + 4)
    }

    /// Directory, page table cache, bitmask \[bytes\].
    pub(crate) fn table_bytes(&self) -> u64 {
        let entries = u64::from(self.directory) + u64::from(self.table_entries());
        4 * (entries + u64::from(self.mask_words()))
    }

    /// The report and its copies on the way back \[bytes\].
    pub(crate) fn readback_bytes(&self) -> u64 {
        self.report_bytes() * (1 + READBACKS)
    }

    /// Texels of the residency octree: one per node and channel.
    pub(crate) fn node_texels(&self) -> u32 {
        self.node_blocks * self.slots * SIBLINGS
    }

    /// Rows of them.
    pub(crate) fn node_rows(&self) -> u32 {
        self.node_texels().div_ceil(NODE_ROW)
    }

    /// The residency octree \[bytes\].
    pub(crate) fn octree_bytes(&self) -> u64 {
        let texels = u64::from(self.node_rows()) * u64::from(NODE_ROW);
        texels * TEXEL_BYTES + u64::from(self.node_texels()) * RESIDENT_BYTES
    }

    fn total_bytes(&self) -> u64 {
        self.brick_bytes() + self.table_bytes() + self.octree_bytes() + self.readback_bytes()
    }
}

/// Page table blocks a volume has in all steps, all channels and levels.
fn blocks_of(tables: &PageTables) -> u64 {
    let shape = tables.shape();
    let channels = u64::from(tables.directory_entries() / tables.entries_per_channel().max(1));
    let steps = 1..shape.depth;
    let per_level = |bricks: UVec3| -> u64 {
        let blocks = steps.clone().map(|step| {
            let edge = shape.block_edge.pow(shape.depth - step);
            product((bricks + (edge - 1)) / edge)
        });
        blocks.sum()
    };
    channels
        * tables
            .levels()
            .iter()
            .map(|l| per_level(l.bricks))
            .sum::<u64>()
}

fn bricks_of(tables: &PageTables) -> u64 {
    let channels = u64::from(tables.directory_entries() / tables.entries_per_channel().max(1));
    channels
        * tables
            .levels()
            .iter()
            .map(|l| product(l.bricks))
            .sum::<u64>()
}

fn product(v: UVec3) -> u64 {
    u64::from(v.x) * u64::from(v.y) * u64::from(v.z)
}

/// A grid of at most `count` cells, and nearly as many, shaped like a cube.
fn largest_grid(count: u64, edge: u32) -> UVec3 {
    grid(count, edge, f64::floor)
}

/// A grid of at least `count` cells, and few more, shaped like a cube.
fn covering_grid(count: u64, edge: u32) -> UVec3 {
    grid(count, edge, f64::ceil)
}

fn grid(count: u64, edge: u32, round: impl Fn(f64) -> f64) -> UVec3 {
    let edge = f64::from(edge.max(1));
    let count = count as f64;
    let z = round(count.cbrt()).clamp(1.0, edge);
    let y = round((count / z).sqrt()).clamp(1.0, edge);
    let x = round(count / z / y).clamp(1.0, edge);
    glam::DVec3::new(x, y, z).as_uvec3()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use saccade_core::levels::halving_levels;
    use saccade_core::page_table::PageTableShape;

    const NEEDS: Needs = Needs {
        octree: OctreeSize {
            blocks: 1 << 40,
            slots: 1,
        },
        voxel_bytes: 1,
    };
    const LIMITS: DeviceLimits = DeviceLimits {
        texture_edge: 2048,
        rows: 8192,
        buffer: 128 << 20,
    };

    fn tables(extent: UVec3) -> PageTables {
        let levels = halving_levels(extent, DVec3::new(5.0, 5.0, 40.0));
        PageTables::new(&levels, 1, PageTableShape::for_volume(&levels, 1)).unwrap()
    }

    #[test]
    fn the_ceiling_holds_and_is_used() {
        let extents = [[32_768, 32_768, 4_096], [2_000_000, 2_000_000, 250_000]];
        for extent in extents.map(UVec3::from_array) {
            for (ceiling, voxel_bytes) in [(64 << 20, 1), (256 << 20, 2), (3_000_000_019, 1)] {
                let needs = Needs {
                    voxel_bytes,
                    ..NEEDS
                };
                let plan = Plan::new(&tables(extent), needs, ceiling, LIMITS).unwrap();
                let total = plan.total_bytes();
                assert!(
                    total <= ceiling,
                    "{plan:?} takes {total} of {ceiling} bytes"
                );
                assert!(
                    total > ceiling / 10 * 9,
                    "{plan:?} leaves much of {ceiling} unused"
                );
                assert!((plan.brick_grid * BRICK_STORED_EDGE).max_element() <= 2048);
            }
        }
    }

    #[test]
    fn small_volumes_take_what_they_need() {
        let octree = OctreeSize {
            blocks: 99,
            ..NEEDS.octree
        };
        let needs = Needs { octree, ..NEEDS };
        let tables = tables(UVec3::new(61, 47, 33));
        let plan = Plan::new(&tables, needs, 1 << 30, LIMITS).unwrap();
        assert_eq!(plan.node_blocks, 99);
        assert!(plan.total_bytes() < 4 << 20, "{plan:?}");
        let all = 2 * 2 * 2 + 1;
        assert!(plan.bricks() >= all, "every brick has a slot");
    }

    #[test]
    fn too_low_a_ceiling_names_one_that_does() {
        let tables = tables(UVec3::new(32_768, 32_768, 4_096));
        let Err(Misfit::Ceiling(needed)) = Plan::new(&tables, NEEDS, 100_000, LIMITS) else {
            panic!("100 kB cannot hold a picture's bricks");
        };
        assert!(Plan::new(&tables, NEEDS, needed, LIMITS).is_ok());
        let less = needed - needed / 64;
        assert!(Plan::new(&tables, NEEDS, less, LIMITS).is_err());
        let small = DeviceLimits {
            buffer: 1000,
            ..LIMITS
        };
        assert!(matches!(
            Plan::new(&tables, NEEDS, 1 << 30, small),
            Err(Misfit::Buffer(_))
        ));
    }

    #[test]
    fn grids_waste_little() {
        for count in 1..300 {
            let [most, least] = [largest_grid(count, 60), covering_grid(count, 60)].map(product);
            assert!(most <= count && most * 2 >= count, "{count}: {most}");
            assert!(least >= count && least <= count * 2, "{count}: {least}");
        }
        assert_eq!(product(largest_grid(1 << 40, 60)), 60 * 60 * 60);
    }
}
