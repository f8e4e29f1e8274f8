//! A tree, what happened to it, and what must hold then.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DVec3, UVec3};
use saccade_core::brick::{BRICK_BORDER, BRICK_EDGE, bricks_of};

use super::super::*;
use super::truth::Truth;

/// What may happen, with numbers that any value makes sense of.
#[derive(Clone, Copy, Debug)]
pub(super) enum Op {
    /// A brick is delivered and finds a slot.
    Insert(u32),
    /// Arrives out of date.
    InsertUnknown(u32),
    /// The values of a brick are known to be between two numbers.
    Note(u32),
    Evict(u32),
    Change(u32),
    /// A channel is stored another way.
    Forget(u32),
    /// Other channels are seen.
    Exchange(u32),
    Advance(u32),
}

pub(super) struct World {
    pub(super) tree: ResidencyOctree,
    pub(super) truth: Truth,
    pub(super) ids: Vec<BrickId>,
    /// Resident bricks and what is known of bricks, when all events have been applied.
    pub(super) resident: BTreeSet<BrickId>,
    pub(super) known: BTreeSet<BrickId>,
    /// Resident bricks that were inserted with values, which still hold.
    pub(super) valued: BTreeSet<BrickId>,
    /// The nodes as the device has them.
    pub(super) device: Vec<([u32; 4], u32)>,
    pub(super) random: u32,
}

const CHANNELS: u32 = 3;
/// Channels that nodes know of at once.
pub(super) const SLOTS: u32 = 2;

pub(super) fn bins() -> Bins {
    Bins::of_bits(8)
}

impl World {
    pub(super) fn new(truth: &Truth, cell: UVec3, blocks: u32) -> Self {
        let mut ids = Vec::new();
        for (index, level) in (0..).zip(&truth.volume.levels) {
            for brick in VoxelBox::of_size(bricks_of(level.extent)).iter() {
                for channel in 0..CHANNELS {
                    ids.push(BrickId::new(channel, index, brick).unwrap());
                }
            }
        }
        let geometry = Geometry::new(&truth.volume, cell);
        let mut tree = ResidencyOctree::new(geometry, SLOTS, blocks);
        tree.assign(&[(0, bins()), (1, bins())]);
        Self {
            tree,
            truth: truth.clone(),
            ids,
            resident: BTreeSet::new(),
            known: BTreeSet::new(),
            valued: BTreeSet::new(),
            device: Vec::new(),
            random: 1,
        }
    }

    pub(super) fn random(&mut self) -> u32 {
        self.random = self
            .random
            .wrapping_mul(1_664_525)
            .wrapping_add(1_013_904_223);
        self.random >> 8
    }

    pub(super) fn apply(&mut self, op: Op) {
        match op {
            Op::Insert(number) => {
                let id = self.ids[number as usize % self.ids.len()];
                let values = self.values(id);
                if values.is_some() {
                    self.known.insert(id);
                    self.valued.insert(id);
                } else {
                    self.valued.remove(&id);
                }
                self.tree.insert(id, values);
                self.resident.insert(id);
            }
            Op::InsertUnknown(number) => {
                let id = self.ids[number as usize % self.ids.len()];
                self.tree.insert(id, None);
                self.resident.insert(id);
                self.valued.remove(&id);
            }
            Op::Note(number) => {
                let id = self.ids[number as usize % self.ids.len()];
                let brick = self.truth.brick(id);
                let [low, high] = brick
                    .iter()
                    .fold([255, 0], |[low, high], &v| [v.min(low), v.max(high)]);
                let values = Values::between(low.into(), high.into(), bins());
                self.tree.note(id, BrickValues::uniform(values));
                if self.tree.slot_of(id.channel()).is_some() {
                    self.known.insert(id);
                }
            }
            Op::Evict(number) => {
                let count = self.resident.len().max(1);
                let id = self.resident.iter().nth(number as usize % count).copied();
                if let Some(id) = id {
                    self.tree.remove(id);
                    self.resident.remove(&id);
                    self.valued.remove(&id);
                }
            }
            Op::Change(number) => {
                let min = UVec3::new(number % 130, number / 7 % 75, number / 13 % 50);
                let size = UVec3::new(1 + number % 40, 1 + number / 90 % 30, 1 + number / 50 % 9);
                let voxels = VoxelBox::new(min, (min + size).min(self.truth.volume.extent()));
                self.truth.change(voxels, number | 1);
                self.tree.invalidate(voxels);
                let levels = &self.truth.volume.levels;
                let holds = |id: &BrickId| {
                    let level = &levels[id.level() as usize];
                    let stored = id.voxels(level).grown(BRICK_BORDER);
                    !stored.intersects(level.box_from_voxels(voxels))
                };
                self.known.retain(holds);
                self.valued.retain(holds);
            }
            Op::Forget(number) => {
                let channel = number % CHANNELS;
                self.tree.forget_channel(channel);
                self.resident.retain(|id| id.channel() != channel);
                self.known.retain(|id| id.channel() != channel);
                self.valued.retain(|id| id.channel() != channel);
            }
            Op::Exchange(number) => {
                let first = number % CHANNELS;
                let second = (first + 1 + number / 7 % (CHANNELS - 1)) % CHANNELS;
                let wanted = [(first, bins()), (second, bins())];
                // One may be seen alone; the other keeps its slot while nobody needs it.
                let wanted = &wanted[..1 + (number / 5 % 2) as usize];
                for channel in self.tree.assign(wanted) {
                    self.known.retain(|id| id.channel() != channel);
                    for &id in self.resident.iter().filter(|id| id.channel() == channel) {
                        self.tree.insert_again(id);
                    }
                    // What is resident is known as it was.
                    let valued = self.valued.iter().filter(|id| id.channel() == channel);
                    self.known.extend(valued);
                }
                let tree = &self.tree;
                self.known.retain(|id| tree.slot_of(id.channel()).is_some());
            }
            Op::Advance(budget) => self.tree.advance(u64::from(budget)),
        }
    }

    pub(super) fn values(&self, id: BrickId) -> Option<BrickValues> {
        let voxels = self.truth.brick(id);
        self.tree.values_of(id, &StoredVoxels::Uint8(voxels.into()))
    }

    /// Channels of whose values nodes speak, with their slots.
    fn assigned(&self) -> Vec<(u32, u32)> {
        let channels = (0..CHANNELS).filter(|&channel| self.tree.is_assigned(channel));
        let with_slot = channels.map(|c| (c, self.tree.slot_of(c).unwrap()));
        with_slot.collect()
    }

    fn flush(&mut self) {
        let device = &mut self.device;
        self.tree.flush(|first, texels, resident| {
            let end = first as usize + texels.len();
            assert_eq!(texels.len(), resident.len());
            device.resize(device.len().max(end), ([0xdead_beef; 4], 0xdead_beef));
            let new = texels.iter().copied().zip(resident.iter().copied());
            for (device, new) in device[first as usize..end].iter_mut().zip(new) {
                *device = new;
            }
        });
        let (texels, resident) = self.tree.nodes.as_uploaded();
        let wanted = texels.iter().copied().zip(resident.iter().copied());
        assert!(
            device.iter().copied().eq(wanted),
            "the device has another tree"
        );
    }

    /// All nodes, with depth and position; each block is met once.
    pub(super) fn nodes(&self) -> Vec<(u32, u32, UVec3)> {
        let mut nodes = vec![(ROOT, 0, UVec3::ZERO)];
        let mut at = 0;
        let mut blocks = BTreeSet::from([0]);
        while let Some(&(node, depth, position)) = nodes.get(at) {
            at += 1;
            let Some(children) = self.tree.nodes.children(node) else {
                continue;
            };
            let block = children / SIBLINGS;
            assert!(blocks.insert(block), "block {block} has two parents");
            for index in 0..SIBLINGS {
                let child = self.tree.geometry.child(depth, position, index);
                nodes.push((children + index, depth + 1, child));
            }
        }
        let (used, capacity) = self.tree.blocks();
        assert_eq!(blocks.len(), used as usize, "a block is lost");
        assert!(used <= capacity);
        nodes
    }

    /// The nodes from the root down to the deepest around a level-0 position.
    fn path(&self, position: DVec3) -> Vec<(u32, u32)> {
        let geometry = &self.tree.geometry;
        let cell = (position / geometry.cell.as_dvec3()).floor().as_uvec3();
        let (mut node, mut depth) = (ROOT, 0);
        let mut path = vec![(ROOT, 0)];
        while let Some(children) = self.tree.nodes.children(node) {
            depth += 1;
            let here = cell >> geometry.depth(depth).shift;
            let above = cell >> geometry.depth(depth - 1).shift;
            let index = (0..SIBLINGS).find(|&i| geometry.child(depth - 1, above, i) == here);
            node = children + index.unwrap();
            path.push((node, depth));
        }
        path
    }

    /// Whatever nodes claim about the values of samples is true of the voxels there are now.
    pub(super) fn check_values(&mut self, samples: u32) -> u32 {
        let mut claims = 0;
        let assigned = self.assigned();
        for _ in 0..samples {
            let extent = self.truth.volume.extent().as_dvec3();
            let unit = |n: u32| f64::from(n % 100_003) / 100_003.0;
            let position = extent
                * DVec3::new(
                    unit(self.random()),
                    unit(self.random()),
                    unit(self.random()),
                );
            for level in 0..self.truth.levels.len() {
                for &(channel, slot) in &assigned {
                    let [low, high] = self.truth.around(channel, level, position);
                    for (node, depth) in self.path(position) {
                        let known = self.tree.nodes.known(node, slot);
                        if known.valid >> level & 1 == 0 {
                            continue;
                        }
                        claims += 1;
                        let holds = known.values.min <= low.into()
                            && u16::from(high) <= known.values.max
                            && bins().between(low.into(), high.into()) & !known.values.bins == 0;
                        assert!(
                            holds,
                            "{low}..{high} at {position}, level {level}, depth {depth}: {known:?}"
                        );
                    }
                }
            }
        }
        claims
    }

    /// Every sample of a brick that is known is known to some node, if nodes lie within bricks.
    fn check_nothing_is_forgotten(&mut self) {
        let levels = &self.truth.volume.levels;
        if levels
            .iter()
            .any(|level| level.downsampling.fract() != DVec3::ZERO)
        {
            return;
        }
        for id in self.known.clone() {
            let unit = f64::from(self.random() % 1000) / 1000.0;
            let level = &self.truth.volume.levels[id.level() as usize];
            let voxels = id.voxels(level);
            let position = voxels.min.as_dvec3() + voxels.size().as_dvec3() * unit;
            let position = position * level.downsampling;
            if position.cmpge(self.truth.volume.extent().as_dvec3()).any() {
                continue;
            }
            let slot = self.tree.slot_of(id.channel()).unwrap();
            let known = self.path(position).into_iter().any(|(node, _)| {
                let known = self.tree.nodes.known(node, slot);
                known.valid >> id.level() & 1 == 1
            });
            assert!(known, "{id} is not known at {position}");
        }
    }

    /// Exactly the resident bricks are noted, in every node they overlap.
    pub(super) fn check_residency(&self) {
        let extent = self.truth.volume.extent();
        let boxes: BTreeMap<BrickId, (DVec3, DVec3)> = self
            .resident
            .iter()
            .map(|&id| {
                let level = &self.truth.volume.levels[id.level() as usize];
                let low = (id.brick() * BRICK_EDGE).as_dvec3() * level.downsampling;
                let high = ((id.brick() + 1) * BRICK_EDGE).as_dvec3() * level.downsampling;
                let is_last = (id.brick() + 1).cmpge(bricks_of(level.extent));
                let end = extent.as_dvec3();
                (id, (low, DVec3::select(is_last, end, high.min(end))))
            })
            .collect();
        for (node, depth, at) in self.nodes() {
            let edge = self.tree.geometry.node_edge(depth).as_dvec3();
            let (low, high) = (at.as_dvec3() * edge, (at + 1).as_dvec3() * edge);
            for (channel, slot) in self.assigned() {
                let mut want = 0;
                for (id, (from, to)) in &boxes {
                    let overlaps = low.cmplt(*to).all() && from.cmplt(high).all();
                    let level = self.tree.geometry.levels[id.level() as usize];
                    if id.channel() == channel && overlaps && depth <= level.residency {
                        want |= 1_u32 << id.level();
                    }
                }
                let got = self.tree.nodes.known(node, slot).resident;
                assert_eq!(got, want, "depth {depth} at {at}, channel {channel}");
            }
        }
    }

    pub(super) fn check(&mut self, roomy: bool) {
        if self.tree.values_hold() {
            self.check_values(40);
        }
        while !self.tree.is_current() {
            self.tree.advance(100);
            self.flush();
            if self.tree.values_hold() {
                self.check_values(3);
            }
        }
        self.flush();
        self.tree.nodes.check_kept();
        let assigned = self.assigned().len();
        assert!(
            (1..=SLOTS as usize).contains(&assigned),
            "{assigned} channels"
        );
        self.check_values(100);
        if roomy {
            self.check_nothing_is_forgotten();
            assert!(self.tree.residency_is_complete());
        }
        if self.tree.residency_is_complete() {
            self.check_residency();
        } else {
            self.nodes();
        }
    }
}
