//! The tree against plain arrays of voxels and a plain set of resident bricks.

mod truth;
mod world;

use glam::{DVec3, UVec3};
use proptest::prelude::*;
use saccade_core::brick::bricks_of;
use saccade_core::volume::Volume;

use self::truth::TRUTHS;
use self::world::{Op, SLOTS, World, bins};
use super::*;

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
