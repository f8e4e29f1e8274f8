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
mod painting;
#[cfg(test)]
mod tests;
mod values;

use std::collections::{HashMap, HashSet, VecDeque};

use glam::UVec3;
use saccade_core::brick::BrickId;
use saccade_core::voxel_box::VoxelBox;

pub(crate) use geometry::{Geometry, default_cell};
use nodes::{Nodes, Own, ROOT};
pub(crate) use values::{Bins, BrickValues, Values};

use crate::layout::SIBLINGS;
use crate::stored_brick::StoredVoxels;

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
    /// Values of the bricks that were inserted, with their bins, for when their channel has a slot again or other
    /// bins; about a fiftieth of the bricks themselves.
    kept: HashMap<BrickId, (Bins, BrickValues)>,
    /// Whether that may happen.
    keeps: bool,
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
            kept: HashMap::new(),
            keeps: true,
            visited: 0,
        }
    }

    /// The same for channels that all have a slot for good, and bins that stay.
    pub(crate) fn of_the_same_channels(self) -> Self {
        Self {
            keeps: false,
            ..self
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
    /// or other bins: nothing is known of them, and what is resident is to be inserted
    /// [again](Self::insert_again). Channels that are not named lose their slot only where another needs it.
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
        match (&values, self.bins_of(id.channel())) {
            (Some(values), Some(bins)) if self.keeps => {
                self.kept.insert(id, (bins, values.clone()))
            }
            _ => self.kept.remove(&id),
        };
        self.insert_with(id, values);
    }

    /// A brick is resident whose channel has a slot, or other bins, from now on. Its values are those that it was
    /// inserted with.
    pub(crate) fn insert_again(&mut self, id: BrickId) {
        let kept = self.kept.get(&id).zip(self.bins_of(id.channel()));
        let values = kept.map(|((from, values), to)| values.rebinned(*from, to));
        self.insert_with(id, values);
    }

    fn insert_with(&mut self, id: BrickId, values: Option<BrickValues>) {
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

    /// A brick has left the cache. Its values stay known while its channel has its slot.
    pub(crate) fn remove(&mut self, id: BrickId) {
        self.kept.remove(&id);
        self.events.push_back(Event::Evicted(id));
    }

    /// Level-0 voxels changed: what was known of them is forgotten.
    pub(crate) fn invalidate(&mut self, voxels: VoxelBox) {
        self.changes += 1;
        let geometry = &self.geometry;
        self.kept.retain(|id, _| !geometry.is_reached(*id, voxels));
        self.events.push_back(Event::Changed {
            reached: self.geometry.reached_by(voxels),
            nodes: vec![(ROOT, 0, UVec3::ZERO)],
        });
    }

    /// Forgets all that is known of a channel. What is resident is to be inserted again.
    pub(crate) fn forget_channel(&mut self, channel: u32) {
        self.kept.retain(|id, _| id.channel() != channel);
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
