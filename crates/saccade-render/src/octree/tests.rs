//! The tree against plain arrays of voxels and a plain set of resident bricks.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::LazyLock;

use glam::{DVec3, UVec3};
use proptest::prelude::*;
use saccade_core::brick::{BRICK_BORDER, BRICK_EDGE, BRICK_STORED_EDGE, bricks_of};
use saccade_core::levels::Level;

use super::*;
use saccade_core::volume::Volume;

/// What may happen, with numbers that any value makes sense of.
#[derive(Clone, Copy, Debug)]
enum Op {
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

/// All voxels of all levels, as they are now.
#[derive(Clone)]
struct Truth {
    volume: Volume,
    levels: Vec<Vec<u8>>,
}

impl Truth {
    fn new(volume: Volume) -> Self {
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
    fn at(&self, channel: u32, level: usize, voxel: [i64; 3]) -> u8 {
        let extent = self.volume.levels[level].extent;
        let inside = UVec3::from_array(std::array::from_fn(|axis| {
            u32::try_from(voxel[axis].clamp(0, i64::from(extent[axis]) - 1)).unwrap()
        }));
        let value = self.levels[level][self.flat(level, inside)];
        value ^ u8::try_from(channel * 85).unwrap()
    }

    fn brick(&self, id: BrickId) -> Vec<u8> {
        let low = (id.brick() * BRICK_EDGE).as_i64vec3() - i64::from(BRICK_BORDER);
        let cells = VoxelBox::of_size(UVec3::splat(BRICK_STORED_EDGE)).iter();
        let level = id.level() as usize;
        cells
            .map(|cell| self.at(id.channel(), level, (low + cell.as_i64vec3()).to_array()))
            .collect()
    }

    /// Smallest and largest of the voxels that a sample at a level-0 position is made of.
    fn around(&self, channel: u32, level: usize, position: DVec3) -> [u8; 2] {
        let corner = (position / self.volume.levels[level].downsampling - 0.5).floor();
        let values = (0..8_u32).map(|i| {
            let offset = UVec3::new(i & 1, i >> 1 & 1, i >> 2).as_i64vec3();
            self.at(channel, level, (corner.as_i64vec3() + offset).to_array())
        });
        values.fold([255, 0], |[low, high], v| [low.min(v), high.max(v)])
    }

    fn change(&mut self, voxels: VoxelBox, seed: u32) {
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
static TRUTHS: LazyLock<[Truth; 2]> = LazyLock::new(|| {
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

struct World {
    tree: ResidencyOctree,
    truth: Truth,
    ids: Vec<BrickId>,
    /// Resident bricks and what is known of bricks, when all events have been applied.
    resident: BTreeSet<BrickId>,
    known: BTreeSet<BrickId>,
    /// Resident bricks that were inserted with values, which still hold.
    valued: BTreeSet<BrickId>,
    /// The nodes as the device has them.
    device: Vec<([u32; 4], u32)>,
    random: u32,
}

const CHANNELS: u32 = 3;
/// Channels that nodes know of at once.
const SLOTS: u32 = 2;

fn bins() -> Bins {
    Bins::of_bits(8)
}

impl World {
    fn new(truth: &Truth, cell: UVec3, blocks: u32) -> Self {
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

    fn random(&mut self) -> u32 {
        self.random = self
            .random
            .wrapping_mul(1_664_525)
            .wrapping_add(1_013_904_223);
        self.random >> 8
    }

    fn apply(&mut self, op: Op) {
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

    fn values(&self, id: BrickId) -> Option<BrickValues> {
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
    fn nodes(&self) -> Vec<(u32, u32, UVec3)> {
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
    fn check_values(&mut self, samples: u32) -> u32 {
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
    fn check_residency(&self) {
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

    fn check(&mut self, roomy: bool) {
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

fn op() -> impl Strategy<Value = Op> {
    prop_oneof![
        8 => (0..200_u32).prop_map(Op::Insert),
        2 => (0..200_u32).prop_map(Op::InsertUnknown),
        2 => (0..200_u32).prop_map(Op::Note),
        4 => any::<u32>().prop_map(Op::Evict),
        1 => any::<u32>().prop_map(Op::Change),
        1 => any::<u32>().prop_map(Op::Forget),
        2 => any::<u32>().prop_map(Op::Exchange),
        6 => (0..2000_u32).prop_map(Op::Advance),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn holds_in_any_order(
        odd in any::<bool>(),
        cell in prop_oneof![Just([8, 8, 8]), Just([8, 8, 4]), Just([16, 16, 16]), Just([32, 32, 32])],
        roomy in any::<bool>(),
        ops in proptest::collection::vec(op(), 0..50),
    ) {
        let truth = &TRUTHS[usize::from(odd)];
        let blocks = if roomy { 1 << 16 } else { 24 };
        let mut world = World::new(truth, cell.into(), blocks);
        for (index, op) in ops.into_iter().enumerate() {
            world.apply(op);
            if index % 5 == 4 {
                world.check(roomy);
            }
        }
        world.check(roomy);
    }
}

#[test]
fn holds_for_a_long_time() {
    for (truth, cell, blocks) in [
        (&TRUTHS[0], [8, 8, 8], 1 << 16),
        (&TRUTHS[0], [8, 8, 4], 200),
        (&TRUTHS[1], [8, 8, 8], 30),
    ] {
        let mut world = World::new(truth, cell.into(), blocks);
        for round in 0..6000 {
            let number = world.random();
            world.apply(match number % 100 {
                0..34 => Op::Insert(number / 100),
                34..40 => Op::InsertUnknown(number / 100),
                40..50 => Op::Note(number / 100),
                50..80 => Op::Evict(number),
                80..84 => Op::Change(number),
                84 => Op::Forget(number / 100),
                85 => Op::Exchange(number / 100),
                _ => Op::Advance(number % 3000),
            });
            if round % 250 == 0 {
                world.check(blocks == 1 << 16);
            }
        }
        world.check(blocks == 1 << 16);
    }
}

/// A check of values that cannot fail proves nothing: a change that the tree is not told of shows.
#[test]
#[should_panic(expected = "Known {")]
fn the_check_notices_values_that_do_not_hold() {
    let mut world = World::new(&TRUTHS[0], UVec3::splat(8), 1 << 16);
    for number in 0..200 {
        world.apply(Op::Insert(number));
    }
    world.check(true);
    let voxels = VoxelBox::new(UVec3::new(20, 20, 20), UVec3::new(60, 60, 40));
    world.truth.change(voxels, 5);
    world.check_values(2000);
}

#[test]
#[should_panic(expected = "channel 0")]
fn the_check_notices_bricks_that_are_not_there() {
    let mut world = World::new(&TRUTHS[0], UVec3::splat(8), 1 << 16);
    world.apply(Op::Insert(0));
    world.check(true);
    world.resident.clear();
    world.check_residency();
}

#[test]
fn what_is_alike_is_one_node() {
    let mut world = World::new(&TRUTHS[0], UVec3::splat(8), 1 << 16);
    let finest = world.ids.iter();
    let finest = finest.filter(|id| id.level() == 0 && id.channel() < SLOTS);
    let finest: Vec<_> = finest.copied().collect();
    for &id in &finest {
        let values = BrickValues::uniform(Values::ZERO);
        world.tree.note(id, values);
    }
    world.tree.advance(u64::MAX / 2);
    assert_eq!(world.tree.blocks().0, 1, "a root that knows all is enough");
    for channel in 0..SLOTS {
        let known = world.tree.nodes.known(ROOT, channel);
        assert_eq!((known.values, known.valid), (Values::ZERO, 1));
    }
    // One brick comes to life; the others stay known.
    let values = world.values(finest[7]);
    assert!(values.is_some());
    world.tree.insert(finest[7], values);
    world.tree.advance(u64::MAX / 2);
    assert!(world.tree.blocks().0 > 2);
}

/// What a tree costs that has no room for more: bricks come and go, and nothing that is noted may be forgotten.
#[test]
fn a_full_tree_is_as_cheap_as_one_with_room() {
    let volume = Volume::new(
        "v",
        UVec3::new(4_096, 4_096, 512),
        DVec3::new(5.0, 5.0, 40.0),
    )
    .unwrap();
    let stored: Vec<u8> = (0..34 * 34 * 34_u32).map(|i| (i % 251) as u8).collect();
    let stored = StoredVoxels::Uint8(stored.into());
    let cost = |blocks: u32| {
        let geometry = Geometry::new(&volume, UVec3::new(8, 8, 4));
        let mut tree = ResidencyOctree::new(geometry, 1, blocks);
        tree.assign(&[(0, bins())]);
        tree.advance(u64::MAX / 2);
        let before = tree.visited();
        for n in 0..400 {
            let at = UVec3::new(n % 20, n / 20, 3);
            let id = BrickId::new(0, 0, at).unwrap();
            let values = tree.values_of(id, &stored);
            tree.insert(id, values);
            tree.advance(u64::MAX / 2);
        }
        ((tree.visited() - before) / 400, tree.blocks())
    };
    let (roomy, (used, _)) = cost(1 << 18);
    let (full, (all, most)) = cost(512);
    assert!(used > 4 * 512, "{used} blocks are not many");
    assert_eq!(all, most, "the tree is not even full");
    assert!(
        full <= 2 * roomy,
        "{full} visits a brick instead of {roomy}"
    );
}

/// Work per brick does not depend on the size of the volume but through the depth of the tree.
#[test]
fn bricks_cost_the_same_in_any_volume() {
    let cost = |extent: UVec3| {
        let volume = Volume::new("v", extent, DVec3::new(5.0, 5.0, 40.0)).unwrap();
        let bricks = bricks_of(extent);
        let cell = default_cell(&volume);
        let geometry = Geometry::new(&volume, cell);
        let deepest = geometry.deepest();
        let mut tree = ResidencyOctree::new(geometry, 1, 1 << 16);
        tree.assign(&[(0, bins())]);
        let stored: Vec<u8> = (0..34 * 34 * 34_u32).map(|i| (i % 251) as u8).collect();
        let stored = StoredVoxels::Uint8(stored.into());
        for n in 0..50 {
            let at = UVec3::new(n % 4, n / 4 % 4, n / 16).min(bricks - 1);
            let id = BrickId::new(0, 0, bricks - 1 - at).unwrap();
            let values = tree.values_of(id, &stored);
            assert!(values.is_some());
            tree.insert(id, values);
        }
        tree.advance(u64::MAX / 2);
        (tree.visited() / 50, tree.blocks().0, deepest)
    };
    let small = cost(UVec3::new(2_048, 2_048, 256));
    let large = cost(UVec3::new(2_000_000, 2_000_000, 250_000));
    assert!(large.2 > small.2 + 8, "depths {} and {}", small.2, large.2);
    assert!(
        large.0 <= small.0 + u64::from(2 * (large.2 - small.2)),
        "visits: {small:?}, {large:?}"
    );
    assert!(large.1 < small.1 + 100, "blocks: {small:?}, {large:?}");
}
