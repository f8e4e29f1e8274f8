//! How the tree is cut, and where levels and bricks lie in it.

use std::ops::Range;

use glam::{DVec3, UVec3};
use saccade_core::brick::{BRICK_BORDER, BRICK_EDGE, BrickId, bricks_of};
use saccade_core::levels::Level;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;

use crate::layout::MOST_DEPTHS;

/// Halvings from one depth to the next: eight children, whichever axes are halved.
const HALVINGS: u32 = 3;

/// Edge of a cell on the axes that are not much coarser than the finest \[level-0 voxels\].
const CELL: u32 = 8;

/// Nodes of one depth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Depth {
    /// Edge of a node \[log2 of cells\].
    pub(crate) shift: UVec3,
    /// How often each axis was halved since the depth above.
    pub(crate) bits: UVec3,
}

/// Where the bricks of a level lie in the tree.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct LevelDepths {
    /// Residency is noted in nodes of this depth, the first that are no larger than a brick.
    /// Deeper nodes lie within one of them and share its fate.
    pub(crate) residency: u32,
    /// Values are noted in nodes of this depth or above, never below.
    pub(crate) values: u32,
    extent: UVec3,
    bricks: UVec3,
    downsampling: DVec3,
}

/// The subdivision of a volume, the same for all channels.
///
/// Space is counted in *cells*, boxes of a few level-0 voxels, of which the deepest nodes consist.
/// Nodes lie on a grid of powers of two of cells; the root may reach past the volume's end.
#[derive(Clone, Debug)]
pub(crate) struct Geometry {
    /// Edge of a cell \[level-0 voxels\].
    pub(crate) cell: UVec3,
    /// Cells that the volume touches, per axis.
    pub(crate) cells: UVec3,
    /// Root first.
    pub(crate) depths: Vec<Depth>,
    pub(crate) levels: Vec<LevelDepths>,
    extent: UVec3,
    /// Per depth, levels whose residency is noted there, as bits.
    residency_at: Vec<u32>,
    /// Per depth, levels whose values may be noted below, as bits.
    values_below: Vec<u32>,
}

/// The nodes that a brick overlaps along one axis, at the depth of its level's values.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Split {
    /// First of them \[nodes\].
    pub(crate) first: u32,
    /// Gaps between the brick's stored voxels in which samples of each node lie.
    pub(crate) gaps: Vec<Range<usize>>,
    /// Whether each lies entirely in the brick.
    pub(crate) inside: Vec<bool>,
}

/// The cell that suits a volume: nearly a cube, 8 voxels of the finest axes.
pub(crate) fn default_cell(volume: &Volume) -> UVec3 {
    let relative = volume.voxel_nm / volume.voxel_nm.min_element();
    UVec3::select(
        relative.cmpge(DVec3::splat(2.0)),
        UVec3::splat(CELL / 2),
        UVec3::splat(CELL),
    )
}

impl Geometry {
    /// A tree with cells of about `cell` voxels: rounded to powers of two, no larger than a brick.
    pub(crate) fn new(volume: &Volume, cell: UVec3) -> Self {
        let round = |edge: u32| edge.clamp(2, BRICK_EDGE).next_power_of_two();
        let cell = UVec3::from_array(cell.to_array().map(round));
        let extent = volume.extent();
        let cells = (extent - 1) / cell + 1;
        let depths = depths(cells, cell.as_dvec3() * volume.voxel_nm);
        let levels = volume.levels.iter();
        let levels: Vec<_> = levels.map(|l| level_depths(l, cell, &depths)).collect();
        let each = |holds: fn(&LevelDepths, u32) -> bool| {
            let depths = (0..).zip(&depths);
            let bits = depths.map(|(depth, _)| {
                let levels = (0..).zip(&levels).filter(|(_, level)| holds(level, depth));
                levels.fold(0, |bits, (index, _)| bits | 1_u32 << index)
            });
            bits.collect()
        };
        Self {
            cell,
            cells,
            residency_at: each(|level, depth| level.residency == depth),
            values_below: each(|level, depth| level.values > depth),
            levels,
            depths,
            extent,
        }
    }

    /// The deepest nodes' depth.
    pub(crate) fn deepest(&self) -> u32 {
        u32::try_from(self.depths.len() - 1).expect("a few depths")
    }

    pub(crate) fn depth(&self, depth: u32) -> Depth {
        self.depths[depth as usize]
    }

    /// Level-0 voxels of a node, cut at the volume's end: empty for one that lies beyond.
    pub(crate) fn node_voxels(&self, depth: u32, at: UVec3) -> VoxelBox {
        let edge = self.node_edge(depth);
        let min = at * edge;
        VoxelBox::new(min, (min + edge).min(self.extent))
    }

    /// Edge of a node \[level-0 voxels\].
    pub(crate) fn node_edge(&self, depth: u32) -> UVec3 {
        self.cell << self.depth(depth).shift
    }

    /// The `index`-th child, 0 to 7, of the node `at`, in nodes of the children's depth.
    pub(crate) fn child(&self, depth: u32, at: UVec3, index: u32) -> UVec3 {
        let bits = self.depth(depth + 1).bits;
        let part = |shift: u32, bits: u32| (index >> shift) & ((1 << bits) - 1);
        let offset = UVec3::new(
            part(0, bits.x),
            part(bits.x, bits.y),
            part(bits.x + bits.y, bits.z),
        );
        (at << bits) + offset
    }

    /// Where a brick lies among the nodes that its values are noted in.
    pub(crate) fn split(&self, id: BrickId) -> [Split; 3] {
        let level = &self.levels[id.level() as usize];
        let edge = self.node_edge(level.values).as_dvec3();
        let extent = self.extent.as_dvec3();
        let brick = id.brick();
        std::array::from_fn(|axis| {
            let down = level.downsampling[axis];
            // In voxels of the level.
            let low = f64::from(brick[axis]) * f64::from(BRICK_EDGE);
            let high = low + f64::from(BRICK_EDGE);
            let node = edge[axis] / down;
            let end = extent[axis] / down;
            let is_last = brick[axis] + 1 >= level.bricks[axis];
            let first = whole((low / node).floor());
            let mut split = Split {
                first,
                gaps: Vec::new(),
                inside: Vec::new(),
            };
            for at in first.. {
                let (from, to) = (f64::from(at) * node, f64::from(at + 1) * node);
                // Space past the last voxel of a level is drawn from its last brick.
                if at > first && (from >= end || from >= high && !is_last) {
                    break;
                }
                // Gap i holds the samples from i - 0.5 to i + 0.5.
                let begin = (from.max(low) - low).min(high - low - 0.5);
                let until = to.min(high) - low;
                let gaps = whole((begin + 0.5).floor())..whole((until + 0.5).ceil());
                split.gaps.push(gaps.start as usize..gaps.end as usize);
                let inside = from >= low - 1e-6 && (to.min(end) <= high + 1e-6 || is_last);
                split.inside.push(inside);
            }
            split
        })
    }

    /// Per level, the level-0 voxels within reach of whose samples some voxels of `changed` are.
    pub(crate) fn reached_by(&self, changed: VoxelBox) -> Vec<VoxelBox> {
        let levels = self.levels.iter();
        let reached = levels.map(|depths| {
            let level = Level {
                extent: depths.extent,
                downsampling: depths.downsampling,
            };
            let whole = VoxelBox::of_size(level.extent);
            let touched = level.box_from_voxels(changed).grown(BRICK_BORDER);
            let touched = touched.intersection(whole);
            let mut reached = level.voxels_from_box(touched);
            // Space past the last voxel of a level is drawn from it.
            let at_end = touched.max.cmpge(level.extent);
            reached.max = UVec3::select(at_end, self.extent, reached.max);
            reached.intersection(VoxelBox::of_size(self.extent))
        });
        reached.collect()
    }

    /// Whether any of a brick's voxels, its border's included, is made of level-0 voxels that changed.
    pub(crate) fn is_reached(&self, id: BrickId, changed: VoxelBox) -> bool {
        let depths = &self.levels[id.level() as usize];
        let level = Level {
            extent: depths.extent,
            downsampling: depths.downsampling,
        };
        let touched = level.box_from_voxels(changed).grown(BRICK_BORDER);
        id.voxels(&level).intersects(touched)
    }

    /// Levels whose residency is noted at a depth, as bits.
    pub(crate) fn residency_at(&self, depth: u32) -> u32 {
        self.residency_at[depth as usize]
    }

    /// Levels of which nodes deeper than `depth` may know values, as bits.
    pub(crate) fn values_below(&self, depth: u32) -> u32 {
        self.values_below[depth as usize]
    }

    /// Bricks of a level that overlap level-0 voxels within the volume.
    pub(crate) fn bricks_over(
        &self,
        level: u32,
        voxels: VoxelBox,
    ) -> impl Iterator<Item = UVec3> + use<> {
        let level = &self.levels[level as usize];
        let brick = level.downsampling * f64::from(BRICK_EDGE);
        let over = VoxelBox::around(voxels.min.as_dvec3() / brick, voxels.max.as_dvec3() / brick);
        // Space past the last voxel of a level is drawn from its last brick.
        let last = level.bricks - 1;
        VoxelBox::new(over.min.min(last), over.max.min(level.bricks)).iter()
    }

    /// Blocks of eight siblings in a tree that is grown everywhere, the root's own included.
    pub(crate) fn all_blocks(&self) -> u64 {
        let inner = &self.depths[..self.depths.len() - 1];
        let nodes = inner.iter().map(|depth| {
            let nodes = ((self.cells - 1) >> depth.shift) + 1;
            nodes.to_array().into_iter().map(u64::from).product::<u64>()
        });
        1 + nodes.sum::<u64>()
    }
}

/// Node edges from the root down: of the nodes' axes, the longest is always the next to be halved.
fn depths(cells: UVec3, cell_nm: DVec3) -> Vec<Depth> {
    let enough = cells.map(|n| n.next_power_of_two().ilog2());
    let mut shift = UVec3::ZERO;
    let mut depths = Vec::new();
    // From the deepest nodes up: the shortest axis is doubled, unless it spans the volume.
    while shift.cmplt(enough).any() && depths.len() + 1 < MOST_DEPTHS {
        let mut bits = UVec3::ZERO;
        for _ in 0..HALVINGS {
            let edge = |axis: &usize| {
                let spans = shift[*axis] >= enough[*axis];
                (spans, cell_nm[*axis] * f64::from(shift[*axis]).exp2())
            };
            let shorter = |a: &usize, b: &usize| {
                let ((a_spans, a), (b_spans, b)) = (edge(a), edge(b));
                a_spans.cmp(&b_spans).then(a.total_cmp(&b))
            };
            let axis = (0..3).min_by(shorter).expect("three axes");
            shift[axis] += 1;
            bits[axis] += 1;
        }
        depths.push(Depth {
            shift: shift - bits,
            bits,
        });
    }
    depths.push(Depth {
        shift,
        bits: UVec3::ZERO,
    });
    depths.reverse();
    depths
}

fn level_depths(level: &Level, cell: UVec3, depths: &[Depth]) -> LevelDepths {
    let nodes = || {
        (0..)
            .zip(depths)
            .map(|(depth, d)| (depth, (cell << d.shift).as_dvec3()))
    };
    let deepest = u32::try_from(depths.len() - 1).expect("a few depths");
    let brick = level.downsampling * f64::from(BRICK_EDGE);
    let residency = nodes().find(|(_, edge)| edge.cmple(brick).all());
    let residency = residency.map_or(deepest, |(depth, _)| depth);
    let region = (level.downsampling * cell.as_dvec3()).element_product();
    let values = nodes().find(|(_, edge)| edge.element_product() <= 2.0 * region);
    let values = values.map_or(deepest, |(depth, _)| depth);
    LevelDepths {
        residency,
        values: values.max(residency),
        extent: level.extent,
        bricks: bricks_of(level.extent),
        downsampling: level.downsampling,
    }
}

/// A whole number that is not negative.
#[expect(
    clippy::cast_possible_truncation,
    reason = "saturates, and volumes have at most 2^21 voxels along an axis"
)]
fn whole(number: f64) -> u32 {
    number as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    fn volumes() -> Vec<Volume> {
        let new = |x, y, z, nm| Volume::new("v", UVec3::new(x, y, z), nm).unwrap();
        vec![
            new(61, 47, 33, DVec3::new(4.0, 4.0, 20.0)),
            new(1024, 1024, 795, DVec3::ONE),
            new(32_768, 32_768, 4_096, DVec3::new(5.0, 5.0, 40.0)),
            new(2_000_000, 2_000_000, 250_000, DVec3::new(5.0, 5.0, 40.0)),
            new(1, 1, 1, DVec3::ONE),
            new(3, 200_000, 7, DVec3::new(9.0, 1.0, 2.0)),
        ]
    }

    #[test]
    fn every_depth_has_eight_children_and_the_root_holds_everything() {
        for volume in volumes() {
            let geometry = Geometry::new(&volume, default_cell(&volume));
            let depths = &geometry.depths;
            assert!(depths.len() <= MOST_DEPTHS);
            assert_eq!(depths.last().unwrap().shift, UVec3::ZERO);
            let root = geometry.node_edge(0);
            assert!(root.cmpge(volume.extent()).all(), "{root}");
            for (above, below) in depths.iter().zip(&depths[1..]) {
                assert_eq!(above.shift - below.shift, below.bits);
                assert_eq!(below.bits.element_sum(), HALVINGS);
            }
            for depth in 0..geometry.deepest() {
                let mut children: Vec<_> = (0..8)
                    .map(|i| geometry.child(depth, UVec3::ZERO, i).to_array())
                    .collect();
                children.sort_unstable();
                children.dedup();
                assert_eq!(children.len(), 8);
            }
        }
    }

    /// No axis of a node is much longer than another, unless the volume is as thin.
    #[test]
    fn nodes_are_nearly_cubes() {
        let volume = &volumes()[3];
        let geometry = Geometry::new(volume, default_cell(volume));
        for depth in 0..=geometry.deepest() {
            let nm = geometry.node_edge(depth).as_dvec3() * volume.voxel_nm;
            let ratio = nm.max_element() / nm.min_element();
            assert!(ratio <= 8.0, "depth {depth}: {nm} nm");
        }
    }

    #[test]
    fn regions_of_a_brick_are_about_as_many_at_every_level() {
        for volume in &volumes()[1..4] {
            for cell in [default_cell(volume), UVec3::splat(16), UVec3::splat(32)] {
                let geometry = Geometry::new(volume, cell);
                for (level, depths) in (0..).zip(&geometry.levels) {
                    assert!(depths.residency <= depths.values);
                    let id = BrickId::new(0, level, UVec3::ZERO).unwrap();
                    let regions = geometry.split(id).map(|split| split.gaps.len());
                    let regions: usize = regions.into_iter().product();
                    assert!(regions <= 512, "level {level}, cell {cell}: {regions}");
                }
            }
        }
    }

    #[test]
    fn a_brick_is_cut_where_its_nodes_are() {
        let volume = &volumes()[1];
        let geometry = Geometry::new(volume, UVec3::new(8, 8, 4));
        assert_eq!(geometry.cell, UVec3::new(8, 8, 4));
        let id = BrickId::new(0, 0, UVec3::new(3, 0, 24)).unwrap();
        let [x, y, z] = geometry.split(id);
        assert_eq!((x.first, y.first, z.first), (12, 0, 192));
        assert_eq!(x.gaps, [0..9, 8..17, 16..25, 24..33]);
        assert_eq!(x.inside, [true; 4]);
        // The last brick along z holds 27 voxels, of which the seventh node has three.
        assert_eq!(z.gaps.len(), 7);
        assert_eq!(z.inside, [true; 7]);
        let coarsest = u32::try_from(volume.levels.len() - 1).unwrap();
        let whole = BrickId::new(0, coarsest, UVec3::ZERO).unwrap();
        for split in geometry.split(whole) {
            assert!(split.inside.iter().all(|inside| *inside));
        }
    }

    #[test]
    fn a_change_reaches_one_voxel_further_at_every_level() {
        let volume = &volumes()[1];
        let geometry = Geometry::new(volume, UVec3::splat(8));
        let at = UVec3::new(100, 100, 700);
        let reached = geometry.reached_by(VoxelBox::new(at, at + 1));
        assert_eq!(reached[0], VoxelBox::new(at - 1, at + 2));
        let level_3 = VoxelBox::new(UVec3::new(88, 88, 688), UVec3::new(112, 112, 712));
        assert_eq!(reached[3], level_3);
        let end = UVec3::new(0, 0, 794);
        let reached = geometry.reached_by(VoxelBox::new(end, end + 1));
        let last = VoxelBox::new(UVec3::new(0, 0, 736), UVec3::new(64, 64, 795));
        assert_eq!(reached.last(), Some(&last), "past the last whole voxel");
    }
}
