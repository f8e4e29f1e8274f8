//! How the memory ceiling is divided.

use glam::UVec3;
use saccade_core::brick::{BRICK_STORED_EDGE, BRICK_STORED_VOXELS};
use saccade_core::page_table::PageTables;

use crate::layout::{COUNTERS, MISSES, NODE_ROW, NODE_WORDS, SIBLINGS};

/// Readbacks in flight at once; each has a buffer of its own.
pub(crate) const READBACKS: u64 = 3;
/// Fewer bricks than this make no picture. Of the coarsest level, each channel that is seen gets all of them, up to so many.
const LEAST_BRICKS: u64 = 64;
/// Blocks that every volume gets, if it has so many, and each channel that is seen for its coarsest level.
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
    /// Channels that have to be complete together, in their coarsest level if need be.
    pub(crate) channels: u32,
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
    /// Channels that can be complete together, in their coarsest level if need be.
    pub(crate) channels: u32,
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

/// Bricks, and page table blocks on the way to them.
#[derive(Clone, Copy, Debug)]
struct Least {
    bricks: u64,
    blocks: u64,
}

/// What a ceiling is divided by.
struct Division<'a> {
    tables: &'a PageTables,
    needs: Needs,
    most_blocks: u64,
    most_node_blocks: u64,
    node_block_bytes: u64,
    /// Edge of the brick cache \[bricks\].
    edge: u32,
}

impl<'a> Division<'a> {
    fn new(tables: &'a PageTables, needs: Needs, limits: DeviceLimits) -> Result<Self, Misfit> {
        let directory = u64::from(tables.directory_entries()) * 4;
        if directory > limits.buffer {
            return Err(Misfit::Buffer(directory));
        }
        let octree = needs.octree;
        let block_texels = u64::from(octree.slots * SIBLINGS);
        Ok(Self {
            tables,
            needs,
            most_blocks: blocks_of(tables).min(limits.buffer / block_bytes(tables)),
            most_node_blocks: octree
                .blocks
                .min(limits.buffer / (block_texels * RESIDENT_BYTES))
                .min(u64::from(limits.rows) * u64::from(NODE_ROW) / block_texels)
                .max(2),
            node_block_bytes: block_texels * (TEXEL_BYTES + RESIDENT_BYTES),
            edge: limits.texture_edge / BRICK_STORED_EDGE,
        })
    }

    /// What so many channels need in their coarsest level. One that is large is not seen as a whole.
    fn least(&self, channels: u32) -> Least {
        let coarsest = self.tables.levels().last();
        let (bricks, blocks) = coarsest.map_or((0, 0), |level| {
            let blocks = blocks_under(self.tables, level.bricks);
            (product(level.bricks), blocks)
        });
        let channels = u64::from(channels);
        Least {
            bricks: (channels * bricks.min(LEAST_BRICKS))
                .max(LEAST_BRICKS)
                .min(bricks_of(self.tables)),
            blocks: (channels * blocks.min(LEAST_BLOCKS)).max(LEAST_BLOCKS),
        }
    }

    /// All but bricks.
    fn rest(&self, ceiling: u64, least: Least) -> Plan {
        let blocks = (ceiling / TABLE_SHARE / block_bytes(self.tables))
            .max(least.blocks)
            .min(self.most_blocks)
            .clamp(1, 1 << 16);
        let node_blocks = (ceiling / OCTREE_SHARE / self.node_block_bytes)
            .max(LEAST_NODE_BLOCKS)
            .min(self.most_node_blocks)
            .min(1 << 24);
        Plan {
            blocks: u32::try_from(blocks).expect("at most 2^16"),
            brick_grid: UVec3::ZERO,
            directory: self.tables.directory_entries(),
            node_blocks: u32::try_from(node_blocks).expect("at most 2^24"),
            channels: self.needs.channels,
            slots: self.needs.octree.slots,
            voxel_bytes: self.needs.voxel_bytes,
            block_entries: self.tables.shape().block_entries(),
        }
    }

    fn bytes_per_brick(&self) -> u64 {
        BRICK_STORED_VOXELS as u64 * u64::from(self.needs.voxel_bytes) + 4 + 1
    }

    /// Bricks that there is room for.
    fn room(&self, ceiling: u64, least: Least) -> u64 {
        ceiling.saturating_sub(self.rest(ceiling, least).total_bytes()) / self.bytes_per_brick()
    }

    /// Where so many bricks lie.
    fn grid(&self, room: u64) -> UVec3 {
        largest_grid(room, self.edge)
    }

    fn fits(&self, ceiling: u64, least: Least) -> bool {
        let room = self.room(ceiling, least);
        room >= least.bricks && product(self.grid(room)) >= least.bricks
    }

    /// A ceiling above another that does for so much.
    fn needed(&self, above: u64, least: Least) -> u64 {
        let rest = self.rest(0, least).total_bytes();
        let mut needed = (above + 1).max(rest + least.bricks * self.bytes_per_brick());
        // With the ceiling grows what tables and octree take of it.
        while !self.fits(needed, least) {
            needed += needed / 256 + 1;
        }
        needed
    }
}

impl Plan {
    /// Fills the ceiling, or less where the volume has no use for more; for as many channels as can be complete together.
    pub(crate) fn new(
        tables: &PageTables,
        needs: Needs,
        ceiling: u64,
        limits: DeviceLimits,
    ) -> Result<Self, Misfit> {
        let division = Division::new(tables, needs, limits)?;
        let most = needs.octree.slots.max(needs.channels);
        let mut channels = (needs.channels..=most).rev();
        let Some(channels) = channels.find(|&n| division.fits(ceiling, division.least(n))) else {
            let least = division.least(needs.channels);
            return Err(Misfit::Ceiling(division.needed(ceiling, least)));
        };
        let least = division.least(channels);
        let room = division.room(ceiling, least);
        let most_bricks = bricks_of(tables);
        let whole = covering_grid(most_bricks, division.edge);
        let fits = product(whole) >= most_bricks && product(whole) <= room;
        Ok(Self {
            brick_grid: if fits { whole } else { division.grid(room) },
            channels,
            ..division.rest(ceiling, least)
        })
    }

    /// A ceiling with which all bricks of these levels, one for each channel that is seen, have room together; `None` where the
    /// device has no room for them.
    pub(crate) fn needed_for(
        tables: &PageTables,
        needs: Needs,
        levels: impl Iterator<Item = u32>,
        limits: DeviceLimits,
    ) -> Option<u64> {
        let division = Division::new(tables, needs, limits).ok()?;
        let nothing = Least {
            bricks: LEAST_BRICKS,
            blocks: LEAST_BLOCKS,
        };
        let least = levels.fold(nothing, |least, level| {
            let bricks = tables.levels().get(level as usize).map(|l| l.bricks);
            let bricks = bricks.unwrap_or(UVec3::ZERO);
            Least {
                bricks: least.bricks + product(bricks),
                blocks: least.blocks + blocks_under(tables, bricks),
            }
        });
        // A block more than there are is none that is lacking.
        let least = Least {
            bricks: least.bricks.min(bricks_of(tables)),
            blocks: least.blocks.min(blocks_of(tables)),
        };
        let possible = least.bricks <= u64::from(division.edge).pow(3)
            && least.blocks <= division.most_blocks.min(1 << 16);
        possible.then(|| division.needed(0, least))
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

fn block_bytes(tables: &PageTables) -> u64 {
    u64::from(tables.shape().block_entries()) * 4
}

/// Page table blocks on the way to so many bricks of one level and channel, in all steps.
fn blocks_under(tables: &PageTables, bricks: UVec3) -> u64 {
    let shape = tables.shape();
    let blocks = (1..shape.depth).map(|step| {
        let edge = shape.block_edge.pow(shape.depth - step);
        product((bricks + (edge - 1)) / edge)
    });
    blocks.sum()
}

/// Page table blocks a volume has in all steps, all channels and levels.
fn blocks_of(tables: &PageTables) -> u64 {
    let channels = u64::from(tables.directory_entries() / tables.entries_per_channel().max(1));
    let levels = tables.levels().iter();
    channels * levels.map(|l| blocks_under(tables, l.bricks)).sum::<u64>()
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

/// A grid of at most `count` cells, and as many as can be, shaped like a cube as far as that goes.
fn largest_grid(count: u64, edge: u32) -> UVec3 {
    let edge = edge.max(1);
    let mut best = grid(count, edge, f64::floor);
    let all = count.min(u64::from(edge).pow(3));
    let shortest = best.min_element();
    for z in (1..=shortest).rev() {
        for y in (z..=edge).take_while(|y| u64::from(z * y * y) <= all) {
            let x = (count / u64::from(z * y)).min(u64::from(edge));
            let other = UVec3::new(u32::try_from(x).unwrap_or(edge), y, z);
            if product(other) > product(best) {
                best = other;
            }
        }
    }
    best
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
        channels: 1,
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

    /// Blocks and bricks of the coarsest level for each channel that is seen, not for those that could be.
    #[test]
    fn channels_are_counted() {
        let extent = UVec3::new(330, 290, 150);
        let levels = halving_levels(extent, DVec3::splat(4.0));
        for shape in [(2, 16), (3, 16), (3, 32)] {
            let (depth, block_edge) = shape;
            let shape = PageTableShape { depth, block_edge };
            let tables = PageTables::new(&levels, 40, shape).unwrap();
            let needs = |channels| {
                let octree = OctreeSize {
                    slots: 16,
                    ..NEEDS.octree
                };
                Needs {
                    octree,
                    channels,
                    ..NEEDS
                }
            };
            let needed = |channels| match Plan::new(&tables, needs(channels), 1, LIMITS) {
                Err(Misfit::Ceiling(needed)) => needed,
                other => panic!("{other:?}"),
            };
            for seen in [1, 5, 9, 16] {
                let bytes = needed(seen);
                let plan = Plan::new(&tables, needs(1), bytes, LIMITS).unwrap();
                assert!(plan.channels >= seen, "{plan:?}");
                assert!(plan.total_bytes() <= bytes);
                assert!(plan.blocks >= seen * (depth - 1) && plan.bricks() >= seen);
            }
            assert!(needed(1) < needed(16));
            let small = Plan::new(&tables, needs(1), needed(1), LIMITS).unwrap();
            assert!((1..16).contains(&small.channels), "{small:?}");
            assert!(Plan::new(&tables, needs(16), needed(1), LIMITS).is_err());
        }
    }

    /// Levels that are larger than a picture's least.
    #[test]
    fn a_ceiling_for_levels_has_room_for_all_their_bricks() {
        let levels = halving_levels(UVec3::new(700, 600, 500), DVec3::splat(4.0));
        let shape = PageTableShape::for_volume(&levels, 2);
        let tables = PageTables::new(&levels, 2, shape).unwrap();
        for chosen in [vec![0], vec![1, 1], vec![4, 0]] {
            let needed = Plan::needed_for(&tables, NEEDS, chosen.iter().copied(), LIMITS);
            let plan = Plan::new(&tables, NEEDS, needed.unwrap(), LIMITS).unwrap();
            let bricks = chosen
                .iter()
                .map(|&l| product(tables.levels()[l as usize].bricks));
            assert!(
                u64::from(plan.bricks()) >= bricks.sum::<u64>(),
                "{chosen:?}: {plan:?}"
            );
        }
        let huge = halving_levels(UVec3::splat(100_000), DVec3::splat(4.0));
        let shape = PageTableShape::for_volume(&huge, 1);
        let tables = PageTables::new(&huge, 1, shape).unwrap();
        let none = Plan::needed_for(&tables, NEEDS, std::iter::once(0), LIMITS);
        assert_eq!(none, None, "no device has so much");
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
