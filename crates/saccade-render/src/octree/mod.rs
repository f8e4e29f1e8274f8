//! The residency octree \[001 ch. 6\], without a full tree: what is where, and what values it has.
//!
//! A node is a box of the volume, cut as [`geometry`] says and independent of levels and bricks. It
//! says, per channel, which levels have a resident brick that overlaps it, and which values
//! samples in it may have. The second holds for some levels only, and says for which: what is known of
//! coarse voxels bounds no finer ones. Neither depends on the transfer function.
//!
//! The tree lives in main memory; [`ResidencyOctree::flush`] hands out what the device lacks.
//! Events are queued and applied in order, as many per frame as the budget allows. Until then
//! the device has an older tree, which is safe but for one case: values of voxels that have changed since.
//! [`ResidencyOctree::values_hold`] says so, and rays that are told leave the tree alone.

mod geometry;
mod nodes;
#[cfg(test)]
mod tests;
mod values;

use std::collections::{HashSet, VecDeque};

use glam::UVec3;
use saccade_core::brick::BrickId;
use saccade_core::voxel_box::VoxelBox;

pub(crate) use geometry::{Geometry, default_cell};
use nodes::{Known, Nodes, Own, ROOT};
pub(crate) use values::{Bins, BrickValues, Values};

use crate::layout::SIBLINGS;
use crate::stored_brick::StoredVoxels;

/// Blocks looked at for one to forget that take about as long as a visit.
const SEARCHED_PER_VISIT: u64 = 64;

/// Blocks that wait for [`ResidencyOctree::flush`] at most, give or take one event.
const MOST_DIRTY: usize = 4096;

#[derive(Debug)]
enum Event {
    /// A brick's values are known, if any; it may be resident from now on.
    Brick {
        id: BrickId,
        values: Option<BrickValues>,
        resident: bool,
    },
    /// A brick is no longer resident.
    Evicted(BrickId),
    /// A slot has another channel from here on: nothing is known of it. Next block to visit.
    Assigned { slot: u32, block: u32 },
    /// Voxels changed: per level, what that reaches \[level-0 voxels\], and nodes yet to visit.
    Changed {
        reached: Vec<VoxelBox>,
        nodes: Vec<(u32, u32, UVec3)>,
    },
}

/// The tree of one volume.
#[derive(Debug)]
pub(crate) struct ResidencyOctree {
    geometry: Geometry,
    nodes: Nodes,
    events: VecDeque<Event>,
    /// Changes of voxels among them.
    changes: usize,
    /// The channel of each slot; a node knows of these.
    slots: Vec<Option<Slot>>,
    resident: HashSet<BrickId>,
    /// Resident bricks that found no room in the tree.
    unrecorded: HashSet<BrickId>,
    visited: u64,
}

/// A channel that nodes know of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Slot {
    channel: u32,
    bins: Bins,
    /// Events that still have to reach all nodes before what they say of the channel holds.
    assignments: u32,
}

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
    /// Nothing is known, of no channel yet: as many as there are `slots` can be known of at once.
    /// Takes at most `blocks` blocks of eight nodes.
    pub(crate) fn new(geometry: Geometry, slots: u32, blocks: u32) -> Self {
        Self {
            geometry,
            slots: vec![None; slots as usize],
            nodes: Nodes::new(slots, blocks),
            events: VecDeque::new(),
            changes: 0,
            resident: HashSet::new(),
            unrecorded: HashSet::new(),
            visited: 0,
        }
    }

    pub(crate) fn geometry(&self) -> &Geometry {
        &self.geometry
    }

    /// Channels that nodes know of at once.
    pub(crate) fn slots(&self) -> u32 {
        self.nodes.channels()
    }

    /// `(in use, capacity)` \[blocks of eight nodes\].
    pub(crate) fn blocks(&self) -> (u32, u32) {
        self.nodes.blocks()
    }

    /// Nodes visited by updates so far.
    #[cfg(test)]
    pub(crate) fn visited(&self) -> u64 {
        self.visited
    }

    /// The slot of a channel, if it has one.
    pub(crate) fn slot_of(&self, channel: u32) -> Option<u32> {
        let is = |slot: &Option<Slot>| slot.is_some_and(|slot| slot.channel == channel);
        let slot = self.slots.iter().position(is)?;
        u32::try_from(slot).ok()
    }

    /// How a channel's values are divided among bins.
    pub(crate) fn bins_of(&self, channel: u32) -> Option<Bins> {
        let slot = self.slot_of(channel)?;
        self.slots[slot as usize].map(|slot| slot.bins)
    }

    /// Lets nodes know of these channels, each with its bins, from now on. Returns those that had no slot
    /// or other bins: nothing is known of them, and what is resident is to be [inserted](Self::insert)
    /// again. Channels that are not named lose their slot only where another needs it.
    ///
    /// There are at most as many as slots.
    pub(crate) fn assign(&mut self, channels: &[(u32, Bins)]) -> Vec<u32> {
        let mut fresh = Vec::new();
        for &(channel, bins) in channels {
            let is_named = |slot: &Slot| channels.iter().any(|(c, _)| *c == slot.channel);
            let slot = match self.slot_of(channel) {
                Some(slot) => slot,
                None => {
                    let slots = || self.slots.iter();
                    let free = slots().position(Option::is_none);
                    let free =
                        free.or_else(|| slots().position(|s| !s.is_some_and(|s| is_named(&s))));
                    let Some(free) = free else { continue };
                    u32::try_from(free).expect("a few slots")
                }
            };
            let old = self.slots[slot as usize];
            if old.is_some_and(|old| old.channel == channel && old.bins == bins) {
                continue;
            }
            self.slots[slot as usize] = Some(Slot {
                channel,
                bins,
                assignments: old.map_or(0, |old| old.assignments) + 1,
            });
            self.events.push_back(Event::Assigned { slot, block: 0 });
            fresh.push(channel);
        }
        fresh
    }

    /// Whether what nodes say of the values of a channel is of that channel.
    pub(crate) fn is_assigned(&self, channel: u32) -> bool {
        let slot = self.slot_of(channel);
        let slot = slot.and_then(|slot| self.slots[slot as usize]);
        slot.is_some_and(|slot| slot.assignments == 0)
    }

    /// What samples of a brick with these stored voxels may be, by region. `None` for channels without
    /// a slot.
    pub(crate) fn values_of(&self, id: BrickId, stored: &StoredVoxels<'_>) -> Option<BrickValues> {
        let bins = self.bins_of(id.channel())?;
        let [x, y, z] = self.geometry.split(id);
        let regions: [&[_]; 3] = [&x.gaps, &y.gaps, &z.gaps];
        Some(match stored {
            StoredVoxels::Uint8(voxels) => BrickValues::of_voxels(voxels, bins, regions),
            StoredVoxels::Uint16(voxels) => BrickValues::of_voxels(voxels, bins, regions),
        })
    }

    /// A brick has become resident. Without values, what is known of it stays as it is.
    pub(crate) fn insert(&mut self, id: BrickId, values: Option<BrickValues>) {
        self.events.push_back(Event::Brick {
            id,
            values,
            resident: true,
        });
    }

    /// A brick's values are known, though it is not resident.
    pub(crate) fn note(&mut self, id: BrickId, values: BrickValues) {
        self.events.push_back(Event::Brick {
            id,
            values: Some(values),
            resident: false,
        });
    }

    /// A brick has left the cache. Its values stay known.
    pub(crate) fn remove(&mut self, id: BrickId) {
        self.events.push_back(Event::Evicted(id));
    }

    /// Level-0 voxels changed: what was known of them is forgotten.
    pub(crate) fn invalidate(&mut self, voxels: VoxelBox) {
        self.changes += 1;
        self.events.push_back(Event::Changed {
            reached: self.geometry.reached_by(voxels),
            nodes: vec![(ROOT, 0, UVec3::ZERO)],
        });
    }

    /// Forgets all that is known of a channel. What is resident is to be inserted again.
    pub(crate) fn forget_channel(&mut self, channel: u32) {
        if let Some(slot) = self.slot_of(channel) {
            if let Some(of) = &mut self.slots[slot as usize] {
                of.assignments += 1;
            }
            self.events.push_back(Event::Assigned { slot, block: 0 });
        }
    }

    /// Applies queued events until about `budget` nodes were visited.
    pub(crate) fn advance(&mut self, budget: u64) {
        let end = self.visited + budget;
        while self.visited < end && self.nodes.dirty() < MOST_DIRTY {
            let Some(event) = self.events.front_mut() else {
                return;
            };
            if let Event::Changed { reached, nodes } = event {
                let (reached, mut stack) = (std::mem::take(reached), std::mem::take(nodes));
                self.forget(&reached, &mut stack, end);
                if stack.is_empty() {
                    self.events.pop_front();
                    self.changes -= 1;
                } else if let Some(Event::Changed { reached: r, nodes }) = self.events.front_mut() {
                    (*r, *nodes) = (reached, stack);
                }
                continue;
            }
            if let Event::Assigned { slot, block } = event {
                let (slot, from) = (*slot, *block);
                match self.clear_slot(slot, from, end) {
                    Some(next) => {
                        if let Some(Event::Assigned { block, .. }) = self.events.front_mut() {
                            *block = next;
                        }
                    }
                    None => {
                        self.events.pop_front();
                        if let Some(of) = &mut self.slots[slot as usize] {
                            of.assignments -= 1;
                        }
                    }
                }
                continue;
            }
            match self.events.pop_front() {
                Some(Event::Brick {
                    id,
                    values,
                    resident,
                }) => self.paint(id, values.as_ref(), resident),
                Some(Event::Evicted(id)) => self.evict(id),
                Some(Event::Changed { .. } | Event::Assigned { .. }) | None => {}
            }
        }
    }

    /// Forgets what nodes from a block on know of a slot's channel; the block to go on with.
    fn clear_slot(&mut self, slot: u32, from: u32, end: u64) -> Option<u32> {
        if from == 0 {
            // What was noted of the slot's former channel, or of this one before, is forgotten.
            let tracked: Vec<_> = self.slots.iter().flatten().map(|s| s.channel).collect();
            let channel = self.slots[slot as usize].map(|slot| slot.channel);
            let keep =
                |id: &BrickId| Some(id.channel()) != channel && tracked.contains(&id.channel());
            self.resident.retain(keep);
            self.unrecorded.retain(keep);
        }
        for block in from.. {
            if self.visited >= end || self.nodes.dirty() >= MOST_DIRTY {
                return Some(block);
            }
            self.visited += u64::from(SIBLINGS);
            if !self.nodes.clear(block, slot) {
                return None;
            }
        }
        None
    }

    /// Whether all events are applied.
    #[cfg(test)]
    pub(crate) fn is_current(&self) -> bool {
        self.events.is_empty()
    }

    /// Bricks that are noted as resident, in order.
    #[cfg(test)]
    pub(crate) fn noted(&self) -> Vec<BrickId> {
        let mut noted: Vec<_> = self.resident.iter().copied().collect();
        noted.sort_unstable();
        noted
    }

    /// Whether no values are in the tree that changes have made wrong.
    pub(crate) fn values_hold(&self) -> bool {
        self.changes == 0
    }

    /// Whether every resident brick is noted, so that what is not noted is not there.
    pub(crate) fn residency_is_complete(&self) -> bool {
        self.events.is_empty() && self.unrecorded.is_empty()
    }

    /// Hands out what changed since the last call: first texel, texels, and levels that are resident there.
    pub(crate) fn flush(&mut self, upload: impl FnMut(u32, &[[u32; 4]], &[u32])) {
        self.nodes.flush(upload);
    }

    fn paint(&mut self, id: BrickId, values: Option<&BrickValues>, resident: bool) {
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

    fn evict(&mut self, id: BrickId) {
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

    /// Takes levels from what nodes say, where a change reaches them.
    fn forget(&mut self, reached: &[VoxelBox], stack: &mut Vec<(u32, u32, UVec3)>, end: u64) {
        while let Some((node, depth, at)) = stack.pop() {
            self.visited += 1;
            let voxels = self.geometry.node_voxels(depth, at);
            let bits = (0..).zip(reached);
            let touched = bits
                .filter(|(_, reached)| reached.intersects(voxels))
                .fold(0, |bits, (level, _)| bits | 1_u32 << level);
            for channel in 0..self.nodes.channels() {
                let mut own = self.nodes.own(node, channel);
                own.valid &= !touched;
                if own.valid == 0 {
                    own = Own::NOTHING;
                }
                self.nodes.set_own(node, channel, own);
                let mut known = self.nodes.known(node, channel);
                known.valid &= !touched;
                if known.valid == 0 {
                    known.values = Values::NONE;
                }
                self.nodes.set_known(node, channel, known);
            }
            if touched & self.geometry.values_below(depth) != 0
                && let Some(children) = self.nodes.children(node)
            {
                for index in 0..SIBLINGS {
                    let child = self.geometry.child(depth, at, index);
                    if !self.geometry.node_voxels(depth + 1, child).is_empty() {
                        stack.push((children + index, depth + 1, child));
                    }
                }
            }
            if self.visited >= end || self.nodes.dirty() >= MOST_DIRTY {
                return;
            }
        }
    }
}
