//! Which bricks there are, as page tables and as the nodes of an octree.

use std::collections::HashMap;
use std::sync::Arc;

use glam::UVec3;
use saccade_core::brick::{BrickId, bricks_of};
use saccade_core::page_table::{PageTableShape, PageTables};
use saccade_core::volume::Volume;

/// As the shaders have them.
const EMPTY: u32 = 1;
const FIRST_SLOT: u32 = 2;

/// Two steps of page tables with blocks of 32³ entries, as the paper suggests for its volumes.
const SHAPE: PageTableShape = PageTableShape {
    depth: 2,
    block_edge: 32,
};

/// A node: a brick's place, for all channels.
#[derive(Clone, Debug)]
struct Node {
    level: u32,
    /// First of its children; 0 is none.
    children: u32,
    /// Per channel: 0 when the brick is not there.
    entries: Vec<u32>,
    /// Per channel: smallest and largest value of the brick, if it is there.
    own: Vec<Option<[u16; 2]>>,
    /// Whether it lies in the volume.
    inside: bool,
}

/// Bricks that are there.
#[derive(Debug)]
pub(crate) struct Paged {
    volume: Arc<Volume>,
    tables: PageTables,
    channels: usize,
    pub(crate) directory: Vec<u32>,
    pub(crate) blocks: Vec<u32>,
    nodes: Vec<Node>,
    start_level: u32,
    /// Smallest and largest value by slot.
    pub(crate) ranges: Vec<u32>,
    entries: HashMap<BrickId, u32>,
    octree: bool,
}

impl Paged {
    /// Nothing is there. An octree is entered at `start_level`.
    pub(crate) fn new(
        volume: &Arc<Volume>,
        channels: usize,
        octree: bool,
        start_level: u32,
    ) -> anyhow::Result<Self> {
        let tables = PageTables::new(&volume.levels, u32::try_from(channels)?, SHAPE)?;
        let top = bricks_of(volume.levels[start_level as usize].extent);
        let node = |level| Node {
            level,
            children: 0,
            entries: vec![0; channels],
            own: vec![None; channels],
            inside: true,
        };
        Ok(Self {
            directory: vec![0; tables.directory_entries() as usize],
            tables,
            volume: volume.clone(),
            channels,
            blocks: Vec::new(),
            nodes: vec![node(start_level); top.element_product() as usize],
            start_level,
            ranges: Vec::new(),
            entries: HashMap::new(),
            octree,
        })
    }

    pub(crate) fn tables(&self) -> &PageTables {
        &self.tables
    }

    pub(crate) fn contains(&self, id: BrickId) -> bool {
        self.entries.contains_key(&id)
    }

    /// Page table blocks, or nodes, that there are.
    pub(crate) fn parts(&self) -> usize {
        if self.octree {
            let held = |node: &&Node| node.entries.iter().any(|e| *e > 0);
            self.nodes.iter().filter(held).count()
        } else {
            self.blocks.len() / SHAPE.block_entries() as usize
        }
    }

    /// Makes a brick known: in which slot it is, and between which values; or that there is nothing.
    pub(crate) fn insert(&mut self, id: BrickId, slot: Option<(u32, [u16; 2])>) {
        let entry = slot.map_or(EMPTY, |(slot, _)| FIRST_SLOT + slot);
        let range = slot.map_or([0, 0], |(_, range)| range);
        if let Some((slot, [low, high])) = slot {
            debug_assert_eq!(slot as usize, self.ranges.len());
            self.ranges.push(u32::from(low) | u32::from(high) << 16);
        }
        self.entries.insert(id, entry);
        if self.octree {
            let node = self.node(id);
            let channel = id.channel() as usize;
            self.nodes[node].entries[channel] = entry;
            self.nodes[node].own[channel] = Some(range);
        } else {
            let table = self.tables.levels()[id.level() as usize];
            let cell = id.brick() / SHAPE.block_edge;
            let of_channel = id.channel() * self.tables.entries_per_channel();
            let at = (of_channel + table.directory_base + flat(cell, table.directory)) as usize;
            if self.directory[at] == 0 {
                let block = self.blocks.len() / SHAPE.block_entries() as usize;
                self.directory[at] = FIRST_SLOT + u32::try_from(block).expect("a few blocks");
                self.blocks
                    .resize(self.blocks.len() + SHAPE.block_entries() as usize, 0);
            }
            let first = (self.directory[at] - FIRST_SLOT) * SHAPE.block_entries();
            let inside = id.brick() % SHAPE.block_edge;
            let entry_at = first + flat(inside, UVec3::splat(SHAPE.block_edge));
            self.blocks[entry_at as usize] = entry;
        }
    }

    /// The node of a brick; what is lacking on the way is made.
    fn node(&mut self, id: BrickId) -> usize {
        let down = |level: u32| self.volume.levels[level as usize].downsampling.as_uvec3();
        let at = |level: u32| id.brick() * down(id.level()) / down(level);
        let mut level = self.start_level;
        let top = bricks_of(self.volume.levels[level as usize].extent);
        let mut node = flat(at(level), top) as usize;
        while level > id.level() {
            let ratio = down(level) / down(level - 1);
            if self.nodes[node].children == 0 {
                let first = u32::try_from(self.nodes.len()).expect("nodes of a few views");
                self.nodes[node].children = first;
                let end = bricks_of(self.volume.levels[level as usize - 1].extent);
                let corner = at(level) * ratio;
                for child in 0..ratio.element_product() {
                    let offset = UVec3::new(
                        child % ratio.x,
                        child / ratio.x % ratio.y,
                        child / (ratio.x * ratio.y),
                    );
                    self.nodes.push(Node {
                        level: level - 1,
                        children: 0,
                        entries: vec![0; self.channels],
                        own: vec![None; self.channels],
                        inside: (corner + offset).cmplt(end).all(),
                    });
                }
            }
            let inside = at(level - 1) % ratio;
            let child = inside.x + ratio.x * (inside.y + ratio.y * inside.z);
            node = (self.nodes[node].children + child) as usize;
            level -= 1;
        }
        node
    }

    /// Whether bricks are nodes.
    pub(crate) fn is_octree(&self) -> bool {
        self.octree
    }

    /// Nodes, where bricks are: per node and channel the first child, the brick's entry, and between which values everything is.
    pub(crate) fn nodes(&self, first_level: u32) -> Option<Vec<[u32; 4]>> {
        if !self.octree {
            return None;
        }
        let ranges = self.subtree_ranges(first_level);
        let of_nodes = self.nodes.iter().zip(&ranges).flat_map(|(node, ranges)| {
            node.entries.iter().zip(ranges).map(|(entry, range)| {
                let [low, high] = range.unwrap_or([0, u16::MAX]);
                let range = u32::from(low) | u32::from(high) << 16;
                [node.children, *entry, range, 0]
            })
        });
        Some(of_nodes.collect())
    }

    /// Between which values everything in a node is, down to the finest level that is drawn; `None` where
    /// that is not known.
    fn subtree_ranges(&self, first_level: u32) -> Vec<Vec<Option<[u16; 2]>>> {
        let mut ranges: Vec<_> = self.nodes.iter().map(|node| node.own.clone()).collect();
        // Children come after their parents.
        for (index, node) in self.nodes.iter().enumerate().rev() {
            if node.level <= first_level {
                continue;
            }
            let down = |level: u32| self.volume.levels[level as usize].downsampling.as_uvec3();
            let count = (down(node.level) / down(node.level - 1)).element_product();
            let first = node.children as usize;
            let children = if node.children == 0 {
                0
            } else {
                count as usize
            };
            let (above, below) = ranges.split_at_mut(index + 1);
            for (channel, all) in above[index].iter_mut().enumerate() {
                *all = all.filter(|_| children > 0);
                for child in first..first + children {
                    if self.nodes[child].inside {
                        let both = all.zip(below[child - index - 1][channel]);
                        *all = both.map(|([a, b], [c, d])| [a.min(c), b.max(d)]);
                    }
                }
            }
        }
        ranges
    }
}

fn flat(at: UVec3, size: UVec3) -> u32 {
    (at.z * size.y + at.y) * size.x + at.x
}
