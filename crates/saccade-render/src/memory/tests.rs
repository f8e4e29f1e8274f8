//! The state machine against a plain list of what was delivered.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use glam::{DVec3, UVec3};
use proptest::prelude::*;
use saccade_core::levels::halving_levels;
use saccade_core::page_table::PageTableShape;

use super::*;

/// What a client may do, with numbers that any value makes sense of.
#[derive(Clone, Copy, Debug)]
enum Op {
    Place(u32),
    PlaceEmpty(u32),
    /// A frame that used the bricks of some ids and stumbled on the way to others.
    Report(u32),
    Invalidate(u32),
    InvalidateBrick(u32),
    Drop(u32),
}

/// What was said last about a brick.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Said {
    /// `None`: empty.
    content: Option<u32>,
    since_changed: bool,
}

struct World {
    memory: VirtualMemory,
    levels: Vec<Level>,
    ids: Vec<BrickId>,
    said: BTreeMap<BrickId, Said>,
    /// Bricks with a slot, as far as one was told.
    resident: BTreeSet<BrickId>,
    /// Content per brick slot, as the texture has it.
    texture: HashMap<u32, u32>,
    /// The arrays as the device has them.
    device: [Vec<Entry>; 2],
    /// Slots that the latest report used, and must stay.
    in_use: BTreeMap<BrickId, u32>,
    next_content: u32,
    refusals: u32,
}

impl World {
    fn new(depth: u32, blocks: u32, bricks: u32) -> Self {
        let levels = halving_levels(UVec3::new(700, 530, 610), DVec3::new(1.0, 1.0, 3.0));
        let shape = PageTableShape {
            depth,
            block_edge: 4,
        };
        let tables = PageTables::new(&levels, 2, shape).unwrap();
        let mut ids = Vec::new();
        for (level, table) in (0..).zip(tables.levels()) {
            for brick in VoxelBox::of_size(table.bricks).iter() {
                for channel in 0..2 {
                    ids.push(BrickId::new(channel, level, brick).unwrap());
                }
            }
        }
        let memory = VirtualMemory::new(tables, blocks, bricks);
        let device = [memory.directory.clone(), memory.entries.clone()];
        Self {
            memory,
            levels,
            ids,
            said: BTreeMap::new(),
            resident: BTreeSet::new(),
            texture: HashMap::new(),
            device,
            in_use: BTreeMap::new(),
            next_content: 0,
            refusals: 0,
        }
    }

    /// Nearby numbers give ids that are near, so that blocks fill up.
    fn id(&self, number: u32) -> BrickId {
        self.ids[(number as usize) % self.ids.len()]
    }

    fn apply(&mut self, op: Op) {
        match op {
            Op::Place(number) => {
                let id = self.id(number);
                match self.memory.place(id) {
                    Placement::Slot(slot) => {
                        self.next_content += 1;
                        self.texture.insert(slot, self.next_content);
                        self.take_evicted();
                        self.resident.insert(id);
                        let content = Some(self.next_content);
                        self.said.insert(
                            id,
                            Said {
                                content,
                                since_changed: false,
                            },
                        );
                        assert_eq!(self.memory.resolve(id), Entry::of_slot(slot));
                    }
                    Placement::NoRoom => self.refusals += 1,
                    Placement::Empty => panic!("voxels are not empty"),
                }
            }
            Op::PlaceEmpty(number) => {
                let id = self.id(number);
                if self.memory.place_empty(id) == Placement::Empty {
                    self.said.insert(
                        id,
                        Said {
                            content: None,
                            since_changed: false,
                        },
                    );
                    self.in_use.remove(&id);
                    assert_eq!(self.memory.resolve(id), Entry::EMPTY);
                } else {
                    self.refusals += 1;
                }
            }
            Op::Report(number) => self.report(number),
            Op::Invalidate(number) => {
                let min = UVec3::new(number % 700, number / 7 % 530, number / 13 % 610);
                let size = UVec3::new(1 + number % 90, 1 + number / 90 % 60, 1 + number / 50 % 40);
                let voxels = VoxelBox::new(min, min + size);
                self.memory.invalidate(&self.levels, voxels);
                for (id, said) in &mut self.said {
                    let level = &self.levels[id.level() as usize];
                    let stored = id.voxels(level).grown(BRICK_BORDER);
                    said.since_changed |= stored.intersects(level.box_from_voxels(voxels));
                }
            }
            Op::InvalidateBrick(number) => {
                let id = self.id(number);
                self.memory.invalidate_brick(id);
                if let Some(said) = self.said.get_mut(&id) {
                    said.since_changed = true;
                }
            }
            Op::Drop(number) => {
                let channel = self.id(number).channel();
                self.take_evicted();
                let resident: BTreeSet<_> = self.memory.resident(channel).collect();
                let in_channel = self.resident.iter().filter(|id| id.channel() == channel);
                assert_eq!(resident, in_channel.copied().collect());
                self.memory.drop_bricks(channel);
                self.in_use.retain(|id, _| id.channel() != channel);
                self.said
                    .retain(|id, said| said.content.is_none() || id.channel() != channel);
            }
        }
    }

    fn take_evicted(&mut self) {
        for id in self.memory.take_evicted() {
            assert!(self.resident.remove(&id), "{id} had no slot to lose");
        }
    }

    fn report(&mut self, number: u32) {
        let frame = self.memory.next_frame();
        self.memory.frame_submitted();
        let slots = self.memory.bricks().1 + self.memory.blocks().1;
        let mut usage = vec![0; slots.div_ceil(32) as usize];
        let mut missed = BTreeSet::new();
        self.in_use.clear();
        for n in 0..number % 40 {
            let id = self.id(number.wrapping_add(n * 7));
            let mut at = self.memory.tables.directory_index(id);
            for step in 1..self.memory.tables.shape().depth {
                let Some(block) = self.memory.get(at).slot() else {
                    break;
                };
                let bit = self.memory.bricks().1 + block;
                usage[bit as usize / 32] |= 1 << (bit % 32);
                at = self
                    .memory
                    .physical(block, self.memory.tables.entry_in_block(id, step));
            }
            if self.memory.get(at).is_wanted() {
                missed.insert(at);
            }
            if self.memory.resolve(id) == self.memory.get(at)
                && let Some(brick) = self.memory.get(at).slot()
            {
                usage[brick as usize / 32] |= 1 << (brick % 32);
                self.in_use.insert(id, brick);
            }
        }
        self.memory.note_usage(frame, &usage);
        for entry in missed {
            if let Want::Brick(id) = self.memory.want(frame, entry, true) {
                assert!(
                    self.memory.resolve(id).is_wanted(),
                    "{id} is there and up to date"
                );
            }
        }
        assert_eq!(self.memory.want(frame, u32::MAX, true), Want::Nothing);
    }

    /// Everything that must hold at any time.
    fn check(&mut self) {
        self.take_evicted();
        let owners: BTreeSet<_> = self.memory.bricks.iter().map(|(_, b)| b.id).collect();
        assert_eq!(self.resident, owners, "nobody was told of an eviction");
        let Self { memory, device, .. } = self;
        let [directory, tables] = device;
        memory.flush(|array, first, entries| {
            let array = match array {
                Array::Directory => &mut *directory,
                Array::Tables => &mut *tables,
            };
            array[first as usize..][..entries.len()].copy_from_slice(entries);
        });
        assert_eq!(
            directory, &memory.directory,
            "the device has another directory"
        );
        assert_eq!(tables, &memory.entries, "the device has other page tables");

        let mut named = 0;
        for (slot, block) in memory.blocks.iter() {
            assert_eq!(
                memory.get(block.parent).slot(),
                Some(slot),
                "block {slot} is lost"
            );
            let leaf = block.step + 1 == memory.tables.shape().depth;
            let mut empty = 0;
            for entry in 0..memory.tables.shape().block_entries() {
                let physical = memory.physical(slot, entry);
                let entry = memory.get(physical);
                let (origin, channel, level, step) = memory.locate(Frame::MAX, physical).unwrap();
                let id = BrickId::new(channel, level, origin).ok();
                let within = id.is_some_and(|id| memory.contains(id));
                empty += u32::from(within && entry == Entry::EMPTY);
                assert_eq!(step, block.step);
                if let (true, Some(below)) = (leaf, entry.slot()) {
                    named += 1;
                    let want = Brick {
                        entry: physical,
                        id: id.unwrap(),
                    };
                    assert_eq!(memory.bricks.owner(below), Some(&want), "slot mapped twice");
                }
            }
            assert!(
                empty == block.empty || block.empty > block.within,
                "block {slot}: {block:?}"
            );
        }
        assert_eq!(
            named,
            memory.bricks.len(),
            "every resident brick can be reached"
        );
        for &id in &self.ids {
            let entry = memory.resolve(id);
            match (self.said.get(&id), entry.slot()) {
                (Some(said), Some(slot)) => {
                    assert_eq!(
                        Some(self.texture[&slot]),
                        said.content,
                        "{id} shows another's voxels"
                    );
                    assert_eq!(entry.is_wanted(), said.since_changed, "{id} is out of date");
                }
                (None, Some(_)) => panic!("{id} was never delivered"),
                (said, None) if entry == Entry::EMPTY => {
                    assert_eq!(
                        said,
                        Some(&Said {
                            content: None,
                            since_changed: false
                        }),
                        "{id}"
                    );
                }
                _ => {}
            }
        }
        for (&id, &slot) in &self.in_use {
            assert_eq!(
                memory.resolve(id).slot(),
                Some(slot),
                "{id} was in use and is gone"
            );
        }
    }
}

fn op() -> impl Strategy<Value = Op> {
    prop_oneof![
        6 => (0..500_u32).prop_map(Op::Place),
        4 => (0..500_u32).prop_map(Op::PlaceEmpty),
        3 => any::<u32>().prop_map(|n| Op::Report(n % 500)),
        1 => any::<u32>().prop_map(Op::Invalidate),
        2 => (0..500_u32).prop_map(Op::InvalidateBrick),
        1 => any::<u32>().prop_map(Op::Drop),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn holds_in_any_order(depth in 2..=3_u32, ops in proptest::collection::vec(op(), 0..60)) {
        let mut world = World::new(depth, 9, 13);
        for op in ops {
            world.apply(op);
            world.check();
        }
    }
}

/// A million operations, a third of them on each of three shapes.
#[test]
fn holds_for_a_long_time() {
    const ROUNDS: u32 = 1_000_000_u32.div_ceil(3);
    for (depth, blocks, bricks) in [(2, 40, 300), (3, 70, 200), (3, 5, 3)] {
        let mut world = World::new(depth, blocks, bricks);
        let mut random = 12_345_u32;
        for round in 0..ROUNDS {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let number = random >> 8;
            // A window over the ids that moves on, as a view does.
            let near = round / 40 + number % 400;
            world.apply(match number % 97 {
                0..46 => Op::Place(near),
                46..50 => Op::InvalidateBrick(near),
                50..75 => Op::PlaceEmpty(near),
                75..94 => Op::Report(near),
                94..96 => Op::Invalidate(number),
                _ => Op::Drop(number),
            });
            if round % 500 == 0 {
                world.check();
            }
        }
        world.check();
        let tiny = bricks < 10;
        assert_eq!(
            world.refusals > 100,
            tiny,
            "only what is in use is kept at any price"
        );
    }
}

#[test]
fn a_stale_brick_is_drawn_until_its_replacement_comes() {
    let mut world = World::new(2, 9, 13);
    let id = BrickId::new(0, 0, UVec3::new(3, 3, 3)).unwrap();
    let Placement::Slot(slot) = world.memory.place(id) else {
        panic!("there is room")
    };
    world.memory.invalidate(
        &world.levels,
        VoxelBox::new(UVec3::splat(100), UVec3::splat(101)),
    );
    assert_eq!(world.memory.resolve(id), Entry::of_slot(slot).stale());
    assert_eq!(
        world.memory.place(id),
        Placement::Slot(slot),
        "in place, without a gap"
    );
    assert_eq!(world.memory.resolve(id), Entry::of_slot(slot));
    // The neighbour's border begins one voxel away: 95 touches bricks 2 and 3, 94 only brick 2.
    for (x, touched) in [(95, true), (94, false), (128, true), (129, false)] {
        world.memory.place(id);
        let at = UVec3::new(x, 100, 100);
        world
            .memory
            .invalidate(&world.levels, VoxelBox::new(at, at + 1));
        assert_eq!(world.memory.resolve(id).is_wanted(), touched, "voxel {x}");
    }
}

#[test]
fn regions_known_to_be_empty_take_no_table() {
    for depth in [2, 3] {
        let mut world = World::new(depth, 400, 10);
        let ids = world
            .ids
            .iter()
            .filter(|id| id.level() == 0 && id.channel() == 0);
        let ids: Vec<_> = ids.copied().collect();
        for &id in &ids {
            assert_eq!(world.memory.place_empty(id), Placement::Empty);
        }
        assert_eq!(world.memory.blocks().0, 0, "all folded into the directory");
        assert!(
            ids.iter()
                .all(|&id| world.memory.resolve(id) == Entry::EMPTY)
        );

        // One brick comes to life; its neighbours stay known.
        assert!(matches!(world.memory.place(ids[77]), Placement::Slot(_)));
        let known = |memory: &VirtualMemory| {
            ids.iter()
                .filter(|&&id| memory.resolve(id) == Entry::EMPTY)
                .count()
        };
        assert_eq!(known(&world.memory), ids.len() - 1);
        world
            .memory
            .invalidate(&world.levels, VoxelBox::of_size(UVec3::splat(1000)));
        assert_eq!(known(&world.memory), 0);
    }
}

/// Where all is in use, what is coarser than all that it shows comes in its place, and nothing else.
#[test]
fn what_only_stands_in_makes_room_for_what_is_coarser() {
    let fine = |x| BrickId::new(0, 0, UVec3::new(x, 0, 0)).unwrap();
    let coarse = |channel| BrickId::new(channel, 2, UVec3::ZERO).unwrap();
    // Too few bricks, and too few blocks.
    for (blocks, bricks) in [(8, 3), (1, 8)] {
        let World { mut memory, .. } = World::new(2, blocks, bricks);
        for x in 0..3 {
            assert!(matches!(memory.place(fine(x)), Placement::Slot(_)));
        }
        memory.frame_submitted();
        let use_all = |memory: &mut VirtualMemory, finest| {
            memory.frame_submitted();
            memory.note_usage(memory.next_frame() - 1, &[u32::MAX]);
            memory.note_finest(finest);
        };
        use_all(&mut memory, 0);
        assert_eq!(memory.place(coarse(0)), Placement::NoRoom, "all is wanted");
        use_all(&mut memory, 1);
        assert!(matches!(memory.place(coarse(0)), Placement::Slot(_)));
        let gone: Vec<BrickId> = memory.take_evicted().collect();
        assert_eq!(gone.len(), if blocks == 1 { 3 } else { 1 });
        assert_eq!(gone[0], fine(0), "the one used longest ago");
        assert_eq!(memory.resolve(gone[0]), Entry::UNMAPPED);
        use_all(&mut memory, 2);
        if blocks > 1 {
            assert_eq!(memory.place(fine(9)), Placement::NoRoom, "as fine as they");
        }
        use_all(&mut memory, 0);
        assert_eq!(memory.place(coarse(1)), Placement::NoRoom);
    }
}
