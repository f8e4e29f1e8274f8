//! How bricks come into the tree, and out of it.

use glam::UVec3;
use saccade_core::brick::BrickId;
use saccade_core::voxel_box::VoxelBox;

use super::ResidencyOctree;
use super::nodes::{Known, Own, ROOT};
use super::values::{BrickValues, Values};
use crate::layout::SIBLINGS;

/// Blocks looked at for one to forget that take about as long as a visit.
const SEARCHED_PER_VISIT: u64 = 64;

/// A brick on its way into the tree.
struct Painting {
    slot: u32,
    level: u32,
    /// Depth at which the brick counts as resident, if it is.
    residency: Option<u32>,
    /// Depth at which its values are noted.
    values: u32,
    /// Nodes it overlaps at `deepest`: first and last.
    deepest: u32,
    first: UVec3,
    last: UVec3,
    /// Of the nodes from first to last, x fastest, what is known; `None` where the brick is but a
    /// part of the node.
    regions: Vec<Option<Values>>,
    whole: Values,
}

impl ResidencyOctree {
    pub(super) fn paint(&mut self, id: BrickId, values: Option<&BrickValues>, resident: bool) {
        let Some(slot) = self.slot_of(id.channel()) else {
            return;
        };
        self.nodes.tick();
        let [x, y, z] = self.geometry.split(id);
        let level = self.geometry.levels[id.level() as usize];
        let first = UVec3::new(x.first, y.first, z.first);
        let count = [&x, &y, &z].map(|s| u32::try_from(s.gaps.len()).expect("a few nodes"));
        let last = first + UVec3::from_array(count) - 1;
        let mut inside = Vec::new();
        for z in &z.inside {
            for y in &y.inside {
                inside.extend(x.inside.iter().map(|x| *x && *y && *z));
            }
        }
        // Where all of a brick is alike, larger nodes can tell.
        let uniform = values.is_none_or(|v| v.regions.is_none());
        let aligned = inside.iter().all(|inside| *inside);
        let region = |(index, inside): (usize, &bool)| {
            let values = values?;
            let values = values.regions.as_ref().map_or(values.whole, |v| v[index]);
            inside.then_some(values)
        };
        let regions = inside.iter().enumerate().map(region).collect();
        let painting = Painting {
            slot,
            level: id.level(),
            residency: resident.then_some(level.residency),
            values: if uniform && aligned {
                level.residency
            } else {
                level.values
            },
            deepest: level.values,
            first,
            last,
            regions,
            whole: values.map_or(Values::NONE, |v| v.whole),
        };
        if resident {
            self.resident.insert(id);
        }
        let recorded = self.paint_node(&painting, ROOT, 0, UVec3::ZERO);
        if resident && !recorded {
            self.unrecorded.insert(id);
        } else if resident {
            self.unrecorded.remove(&id);
        }
    }

    /// Notes a brick in a node and below; whether its residency found room.
    fn paint_node(&mut self, brick: &Painting, node: u32, depth: u32, at: UVec3) -> bool {
        self.visited += 1;
        self.nodes.touch(node);
        if brick.residency == Some(depth) {
            let mut known = self.nodes.known(node, brick.slot);
            known.resident |= 1 << brick.level;
            self.nodes.set_known(node, brick.slot, known);
        }
        let mut recorded = brick.residency.is_none_or(|residency| depth >= residency);
        if depth == brick.values {
            if let Some(values) = self.painted(brick, depth, at) {
                self.note_values(node, brick.slot, brick.level, values);
            }
            self.pull_up(node, depth, brick.slot);
            return recorded;
        }
        let children = self.nodes.children(node).or_else(|| {
            let geometry = &self.geometry;
            self.nodes.split(node, |index| {
                let child = geometry.child(depth, at, index);
                match geometry.node_voxels(depth + 1, child).is_empty() {
                    true => Own::OUTSIDE,
                    false => Own::NOTHING,
                }
            })
        });
        // A search costs as much as a visit or a few.
        self.visited += self.nodes.take_searched().div_ceil(SEARCHED_PER_VISIT);
        if let Some(children) = children {
            let below =
                self.geometry.depth(depth + 1).shift - self.geometry.depth(brick.deepest).shift;
            let (first, last) = (brick.first >> below, brick.last >> below);
            let mut all = true;
            for index in 0..SIBLINGS {
                let child = self.geometry.child(depth, at, index);
                if child.cmpge(first).all() && child.cmple(last).all() {
                    all &= self.paint_node(brick, children + index, depth + 1, child);
                }
            }
            recorded |= all;
            self.join_if_alike(node);
        } else if self.painted(brick, depth, at).is_some() {
            // No room for detail: all of the brick in one.
            self.note_values(node, brick.slot, brick.level, brick.whole);
        }
        self.pull_up(node, depth, brick.slot);
        recorded
    }

    /// Values of a brick in a node, if all of the node lies in the brick.
    fn painted(&self, brick: &Painting, depth: u32, at: UVec3) -> Option<Values> {
        let below = self.geometry.depth(depth).shift - self.geometry.depth(brick.deepest).shift;
        let size = brick.last - brick.first + 1;
        let low = (at << below).max(brick.first) - brick.first;
        let high = (((at + 1) << below) - 1).min(brick.last) - brick.first;
        let mut values = Values::NONE;
        for z in low.z..=high.z {
            for y in low.y..=high.y {
                for x in low.x..=high.x {
                    let region = brick.regions[((z * size.y + y) * size.x + x) as usize];
                    values = values.or(region?);
                }
            }
        }
        // Part of the node may lie beyond the nodes that the brick overlaps.
        let edge = self.geometry.node_edge(brick.deepest);
        let covered = VoxelBox::new(brick.first * edge, (brick.last + 1) * edge);
        let node = self.geometry.node_voxels(depth, at);
        (node.intersection(covered) == node).then_some(values)
    }

    fn note_values(&mut self, node: u32, slot: u32, level: u32, values: Values) {
        let mut own = self.nodes.own(node, slot);
        let bit = 1 << level;
        own.values = if own.valid & !bit == 0 {
            values
        } else {
            own.values.or(values)
        };
        own.valid |= bit;
        self.nodes.set_own(node, slot, own);
    }

    /// What a node says follows from what was noted at it and from what its children say.
    fn pull_up(&mut self, node: u32, depth: u32, slot: u32) {
        let own = self.nodes.own(node, slot);
        let mut known = Known {
            values: own.values,
            valid: own.valid,
            resident: self.nodes.known(node, slot).resident & self.geometry.residency_at(depth),
        };
        if let Some(children) = self.nodes.children(node) {
            let (mut values, mut valid) = (Values::NONE, u32::MAX);
            for child in children..children + SIBLINGS {
                let child = self.nodes.known(child, slot);
                values = values.or(child.values);
                valid &= child.valid;
                known.resident |= child.resident;
            }
            if valid != 0 {
                // Children know better than what was noted at the node, for the levels they know.
                known.values = match own.valid & !valid {
                    0 => values,
                    _ => values.or(own.values),
                };
                known.valid |= valid;
            }
        }
        self.nodes.set_known(node, slot, known);
    }

    /// Children that all say the same are one node.
    fn join_if_alike(&mut self, node: u32) {
        let Some(children) = self.nodes.children(node) else {
            return;
        };
        let children = children..children + SIBLINGS;
        let nodes = &self.nodes;
        if children
            .clone()
            .any(|child| nodes.children(child).is_some())
        {
            return;
        }
        let mut alike = Vec::new();
        for channel in 0..nodes.channels() {
            let known = children.clone().map(|child| nodes.known(child, channel));
            let mut within = known.filter(|k| k.valid != u32::MAX);
            let Some(first) = within.next() else { return };
            if first.resident != 0 || !within.all(|other| other == first) {
                return;
            }
            alike.push(first);
        }
        for (channel, alike) in (0..).zip(alike) {
            let mut own = self.nodes.own(node, channel);
            own.values = match own.valid & !alike.valid {
                0 => alike.values,
                _ => own.values.or(alike.values),
            };
            own.valid |= alike.valid;
            self.nodes.set_own(node, channel, own);
        }
        self.nodes.join(node);
    }

    pub(super) fn evict(&mut self, id: BrickId) {
        let Some(slot) = self.slot_of(id.channel()) else {
            return;
        };
        self.resident.remove(&id);
        self.unrecorded.remove(&id);
        let [x, y, z] = self.geometry.split(id);
        let first = UVec3::new(x.first, y.first, z.first);
        let count = [&x, &y, &z].map(|s| u32::try_from(s.gaps.len()).expect("a few nodes"));
        let last = first + UVec3::from_array(count) - 1;
        self.evict_node((id, slot), (first, last), ROOT, 0, UVec3::ZERO);
    }

    fn evict_node(
        &mut self,
        (id, slot): (BrickId, u32),
        (first, last): (UVec3, UVec3),
        node: u32,
        depth: u32,
        at: UVec3,
    ) {
        self.visited += 1;
        let level = self.geometry.levels[id.level() as usize];
        if depth == level.residency {
            if !self.other_overlaps(id, depth, at) {
                let mut known = self.nodes.known(node, slot);
                known.resident &= !(1 << id.level());
                self.nodes.set_known(node, slot, known);
            }
            return;
        }
        let Some(children) = self.nodes.children(node) else {
            return;
        };
        let below = self.geometry.depth(depth + 1).shift - self.geometry.depth(level.values).shift;
        let (from, to) = (first >> below, last >> below);
        for index in 0..SIBLINGS {
            let child = self.geometry.child(depth, at, index);
            if child.cmpge(from).all() && child.cmple(to).all() {
                self.evict_node(
                    (id, slot),
                    (first, last),
                    children + index,
                    depth + 1,
                    child,
                );
            }
        }
        self.pull_up(node, depth, slot);
    }

    /// Whether another resident brick of the same level and channel overlaps a node.
    fn other_overlaps(&self, id: BrickId, depth: u32, at: UVec3) -> bool {
        let voxels = self.geometry.node_voxels(depth, at);
        let mut bricks = self.geometry.bricks_over(id.level(), voxels);
        bricks.any(|brick| {
            let other = BrickId::new(id.channel(), id.level(), brick);
            other.is_ok_and(|other| other != id && self.resident.contains(&other))
        })
    }
}
