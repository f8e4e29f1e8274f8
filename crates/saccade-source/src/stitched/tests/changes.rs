//! What was built before a change is never delivered to whoever reads after it.

use std::cell::RefCell;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use bytes::Bytes;
use futures::StreamExt;
use futures::future::{BoxFuture, Either, FutureExt, select};
use glam::{DVec3, UVec2, UVec3};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestError, TestRng, TestRunner};
use saccade_archive::catalog::{Tile, place as place_of};
use saccade_archive::storage::{Entry, MemoryStorage, Storage, StorageError};
use saccade_core::transform::SectionFromTile;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use tokio::sync::watch;

use super::fixture::{Fixture, Levels, bounds, chunk_of, difference, expected_as, read_all, tile};
use super::oracle::{How, RawTile};
use super::run;
use crate::conformance::check_changes;
use crate::stitched::{AlongZ, DiskCache, Gaps, Overlaps, StitchedOptions, StitchedSource};
use crate::{Chunk, ChunkId, VolumeSource};

const FIRST: ChunkId = ChunkId {
    channel: 0,
    level: 0,
    chunk: UVec3::ZERO,
};

async fn small(storage: Arc<dyn Storage>) -> Fixture {
    let extent = UVec3::new(140, 100, 5);
    let mut fixture = Fixture::on(storage, extent, DVec3::new(4.0, 4.0, 30.0)).await;
    for (n, section) in (0..).zip([0, 0, 2]) {
        let corner = (f64::from(n % 2) * 60.0 - 5.0, -8.0);
        let tile = tile((80, 130), section, corner, 2.0, 1.0, u64::from(section) + 7);
        fixture.put(&format!("t{n}"), tile).await;
    }
    fixture
}

/// The level-0 voxels that a tile touches.
fn place(fixture: &Fixture, tile: &RawTile) -> VoxelBox {
    let (x0, y0, x1, y1) = bounds(tile);
    let z = f64::from(tile.section);
    let place = VoxelBox::around(DVec3::new(x0, y0, z), DVec3::new(x1, y1, z + 1.0));
    place.intersection(VoxelBox::of_size(fixture.volume.extent()))
}

#[test]
fn every_kind_of_change_is_told_and_seen() {
    run(async {
        let mut fixture = small(Arc::new(MemoryStorage::new())).await;
        let source = fixture.open().await;
        let volume = fixture.volume.clone();
        let now: RefCell<Levels> = RefCell::new(fixture.expected());
        let mut n = 0;
        let change = async || {
            n += 1;
            let seed = 100 + n;
            let near = tile((80, 130), 0, (-5.0, -8.0), 2.0, 1.0, seed);
            let moved = |corner, degrees| tile((80, 130), 0, corner, degrees, 1.0, 0).transform;
            let touched = match n {
                // Imaged again: same place, other pixels; then another size and section.
                1 => ("t0", Ok(near)),
                2 => ("t0", Ok(tile((60, 135), 3, (10.0, 5.0), -9.0, 1.0, seed))),
                // New, in a section that had none.
                3 => ("t7", Ok(tile((90, 140), 4, (30.0, 20.0), 50.0, 1.0, seed))),
                // Moved a little, and far.
                4 => ("t1", Err(moved((56.0, -7.5), 2.5))),
                5 => ("t1", Err(moved((-30.0, 40.0), 95.0))),
                _ => ("t2", Err(moved((61.0, -20.0), 0.0))),
            };
            let touched = match touched {
                (name, Ok(tile)) => {
                    let place = place(&fixture, &tile);
                    fixture.put(name, tile).await;
                    place
                }
                (name, Err(transform)) => {
                    fixture.transform(name, transform).await;
                    let moved = fixture.tiles.values().find(|t| t.transform == transform);
                    place(&fixture, moved.unwrap())
                }
            };
            *now.borrow_mut() = fixture.expected();
            touched
        };
        let oracle = |id| chunk_of(&volume, &now.borrow(), id);
        check_changes(&source, 6, change, oracle, 1).await.unwrap();
    });
}

/// What is told is the old and the new place, nothing between; and of four blocks in a row only those are built
/// again that lie there.
#[test]
fn only_what_a_change_touches_is_built_again() {
    run(async {
        let extent = UVec3::new(2048, 140, 2);
        let storage = Arc::new(MemoryStorage::new());
        let mut fixture = Fixture::on(storage, extent, DVec3::new(4.0, 4.0, 30.0)).await;
        let at = |x: f64| tile((200, 130), 0, (x, 4.0), 1.0, 1.0, 3);
        for n in 0..4 {
            let corner = f64::from(n) * 512.0 + 100.0;
            fixture.put(&format!("t{n}"), at(corner)).await;
        }
        let source = fixture.open().await;
        let mut changes = source.changes();
        let read_finest = async || {
            for x in (0..4).map(|block| block * 8 + 3) {
                let chunk = UVec3::new(x, 0, 0);
                source.read(ChunkId { chunk, ..FIRST }).await.unwrap();
            }
            source.statistics().blocks_built
        };
        let mut built = read_finest().await;
        assert_eq!(built, 4);
        let mut old = at(612.0);
        // Within its block; to another; over the border of two.
        for (to, again) in [(660.0, 1), (1700.0, 2), (1450.0, 2), (1950.0, 2)] {
            let new = at(to);
            fixture.transform("t1", new.transform).await;
            let (from, to) = (place(&fixture, &old), place(&fixture, &new));
            let want = if from.intersects(to) {
                vec![from.union(to)]
            } else {
                vec![from, to]
            };
            for want in want {
                assert_eq!(changes.next().await.unwrap().voxels, want);
            }
            let now = read_finest().await;
            assert_eq!(now - built, again, "to {}", to.min.x);
            (old, built) = (new, now);
        }
    });
}

/// Where a tile's line begins to be drawn, and how finely a voxel is sampled, must not depend on tiles
/// that are elsewhere.
#[test]
fn a_neighbour_changes_nothing_outside_of_its_box() {
    run(async {
        // As large as they are, smaller, far smaller, coarser and finer; one over a corner of both.
        let news = [
            tile((330, 290), 0, (180.0, 160.0), -7.0, 1.0, 9),
            tile((90, 70), 0, (180.0, 160.0), -7.0, 1.0, 9),
            tile((20, 9), 0, (640.0, 270.0), 30.0, 1.0, 9),
            tile((60, 50), 0, (560.0, 100.0), 4.0, 2.9, 9),
            tile((430, 390), 0, (10.0, 30.0), 4.0, 0.21, 9),
        ];
        for (n, new) in news.into_iter().enumerate() {
            let extent = UVec3::new(700, 300, 1);
            let mut fixture = Fixture::new(extent, DVec3::new(4.0, 4.0, 30.0)).await;
            for (n, x) in [(1_u32, -20.0), (2, 250.0)] {
                let tile = tile((330, 290), 0, (x, 8.0), 2.0 + f64::from(n), 1.003, n.into());
                fixture.put(&format!("t{n}"), tile).await;
            }
            let source = fixture.open().await;
            let mut changes = source.changes();
            let before = read_all(&source).await;
            let place = place(&fixture, &new);
            fixture.put("new", new).await;
            assert_eq!(changes.next().await.unwrap().voxels, place);
            let after = read_all(&source).await;
            let (coverage, most) = difference(&after, &fixture.expected());
            assert!(coverage == 0 && most <= 1, "{n}: {coverage} {most}");
            for (level, (before, after)) in before.iter().zip(&after).enumerate() {
                let level = fixture.volume.levels[level];
                let touched = level.box_from_voxels(place);
                let all = VoxelBox::of_size(level.extent).iter();
                let (mut inside, mut outside) = (0, 0);
                for ((at, before), after) in all.zip(before).zip(after) {
                    match touched.contains(at) {
                        true => inside += u32::from(before != after),
                        false => outside += u32::from(before != after),
                    }
                }
                assert!(inside > 0 || level.extent.x < 99, "{n}: it is not seen");
                assert_eq!(outside, 0, "{n}: voxels of a level of {}", level.extent);
            }
        }
    });
}

/// Of the sections that a coarse voxel spans the nearest count, wherever in them their tiles lie: one that comes may take the
/// place of another, or of its share, where it has none itself.
#[test]
fn a_section_that_outranks_another_leaves_nothing_stale() {
    run(async {
        for (along_z, left, right) in [
            (AlongZ::Nearest, &[1][..], &[4, 2, 5][..]),
            (AlongZ::Linear, &[1, 6], &[]),
        ] {
            let extent = UVec3::new(8800, 64, 16);
            let mut fixture = Fixture::new(extent, DVec3::splat(4.0)).await;
            let at = |section, x| tile((64, 64), section, (x, 0.0), 0.0, 1.0, u64::from(section));
            for section in left {
                fixture
                    .put(&format!("l{section}"), at(*section, 100.0))
                    .await;
            }
            for section in right {
                fixture
                    .put(&format!("r{section}"), at(*section, 8000.0))
                    .await;
            }
            let options = options_of((Overlaps::NearestCentre, along_z, Gaps::Empty));
            let source = fixture.open_with(options.clone()).await;
            assert_eq!(fixture.volume.levels[3].downsampling, DVec3::splat(8.0));
            let coarse = ChunkId { level: 3, ..FIRST };
            let before = source.read(coarse).await.unwrap();
            let since = source.revision();
            let mut changes = source.changes();
            fixture.put("new", at(3, 8000.0)).await;
            let plane = VoxelBox::new(UVec3::new(0, 0, 3), extent.with_z(4));
            assert_eq!(changes.next().await.unwrap().voxels, plane);
            let told = source.changes_after(since).await.unwrap();
            assert_eq!(
                told.iter().map(|told| told.voxels).collect::<Vec<_>>(),
                [plane]
            );
            let after = source.read(coarse).await.unwrap();
            let fresh = fixture.open_with(options).await;
            assert_eq!(after, fresh.read(coarse).await.unwrap(), "{along_z:?}");
            assert_ne!(
                before, after,
                "{along_z:?}: it is seen where it has no tile"
            );
            // Once it has one, others lie where they lie.
            fixture.put("next", at(3, 7900.0)).await;
            let next = changes.next().await.unwrap().voxels;
            assert_eq!((next.min.x, next.max.x), (7900, 7964));
        }
    });
}

#[derive(Clone, Debug)]
enum Step {
    Put(usize, u32, (f64, f64), f64, u64, (usize, usize), f64),
    Move(usize, (f64, f64), f64, f64),
    /// A whole section, in one commit.
    Shift(u32, (f64, f64)),
    Delete(usize),
    /// As after a restart, with the same cache on disk.
    Reopen,
    Read(usize),
    /// Begins to read and gives up.
    Drop(usize),
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let corner = || (-60.0..120.0, -70.0..90.0);
    let scale = || prop_oneof![4 => Just(1.0), 1 => Just(0.45), 1 => Just(2.2)];
    let size = || prop_oneof![Just((80, 130)), Just((31, 17)), Just((270, 140))];
    let step = prop_oneof![
        (
            0..5_usize,
            0..5_u32,
            corner(),
            -40.0..40.0,
            any::<u64>(),
            size(),
            scale()
        )
            .prop_map(|(n, z, at, turn, seed, size, by)| Step::Put(n, z, at, turn, seed, size, by)),
        (0..5_usize, corner(), -40.0..40.0, scale())
            .prop_map(|(n, at, turn, by)| Step::Move(n, at, turn, by)),
        (0..3_u32, (-9.0..9.0, -9.0..9.0)).prop_map(|(z, by)| Step::Shift(z, by)),
        (0..5_usize).prop_map(Step::Delete),
        Just(Step::Reopen),
        (0..64_usize).prop_map(Step::Read),
        (0..64_usize).prop_map(Step::Drop),
    ];
    prop::collection::vec(step, 4..24)
}

/// Whether the catalog would take such a tile.
fn lies_in(volume: &Volume, section: u32, size: UVec2, transform: [f64; 6]) -> bool {
    let transform = SectionFromTile::new(transform).unwrap();
    place_of(volume.extent(), section, size, transform).is_some()
}

type Rules = (Overlaps, AlongZ, Gaps);

fn rules() -> impl Strategy<Value = Rules> {
    (
        prop_oneof![3 => Just(Overlaps::NearestCentre), 1 => Just(Overlaps::Blend)],
        prop_oneof![3 => Just(AlongZ::Nearest), 1 => Just(AlongZ::Linear)],
        prop_oneof![3 => Just(Gaps::Empty), 1 => Just(Gaps::Nearest(2)), 1 => Just(Gaps::Linear(2))],
    )
}

fn options_of((overlaps, along_z, gaps): Rules) -> StitchedOptions {
    StitchedOptions {
        overlaps,
        along_z,
        gaps,
        ..StitchedOptions::default()
    }
}

/// With a cache on disk that no series of steps fills: each time that it is opened, a unit is begun.
async fn cached(folder: &Path, rules: Rules) -> StitchedOptions {
    StitchedOptions {
        disk_cache: Some(DiskCache::open(folder, 2 << 30).await.unwrap()),
        ..options_of(rules)
    }
}

/// Waits until the source knows all that the catalog does.
async fn caught_up(
    fixture: &Fixture,
    changes: &mut crate::maybe_send::BoxStream<'_, crate::Change>,
) {
    let newest = fixture.archive.catalog().revision("v").await.unwrap();
    while changes.next().await.unwrap().revision < newest {}
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 32, ..ProptestConfig::default() })]
    #[test]
    fn nothing_stale_remains(steps in steps(), rules in rules()) {
        run(after(steps, rules, None))?;
    }
}

/// What a wrong source leaves out when something changes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::stitched) enum Wrong {
    /// Keeps blocks that show what changed.
    Blocks,
    /// Tells and forgets only where it lies, not what it fills: here a level is one block, so that [`super::gaps`] has to find it.
    Filled,
    /// Finds blocks on disk by their place alone.
    Disk,
}

impl StitchedSource {
    pub(super) fn go_wrong(&self, wrong: Option<Wrong>) {
        if let Some(wrong) = wrong {
            self.inner.wrong.set(wrong).unwrap();
        }
    }
}

/// Negative controls: what a source leaves out is found by the test of the right one.
#[test]
fn what_stays_stale_is_found() {
    for wrong in [Wrong::Blocks, Wrong::Disk] {
        let config = Config {
            cases: 32,
            max_shrink_iters: 0,
            failure_persistence: None,
            ..Config::default()
        };
        let rng = TestRng::deterministic_rng(config.rng_algorithm);
        let mut runner = TestRunner::new_with_rng(config, rng);
        let found = runner.run(&(steps(), rules()), |(steps, rules)| {
            run(after(steps, rules, Some(wrong)))
        });
        match found {
            Err(TestError::Fail(reason, _)) => {
                assert!(
                    reason.message().starts_with("stale voxels"),
                    "{wrong:?}: {reason}"
                );
            }
            other => panic!("{wrong:?}: {other:?}"),
        }
    }
}

/// Does all steps to sources that stitch by these rules, one of which may be a wrong one, and looks whether they are like new.
async fn after(steps: Vec<Step>, rules: Rules, wrong: Option<Wrong>) -> Result<(), TestCaseError> {
    let mut fixture = small(Arc::new(MemoryStorage::new())).await;
    let folder = tempfile::tempdir().unwrap();
    let mut options = cached(folder.path(), rules).await;
    let mut source = fixture.open_with(options.clone()).await;
    source.go_wrong(wrong);
    let mut changes = source.changes();
    // Keeps nothing of what was built, and what it was built from as long as it may.
    let keeping = StitchedOptions {
        block_bytes: 0,
        sub_tile_bytes: 0,
        ..options_of(rules)
    };
    let keeping = fixture.open_with(keeping).await;
    read_all(&keeping).await;
    let mut kept_changes = keeping.changes();
    let opened_at = keeping.revision();
    let volume = fixture.volume.clone();
    let ids: Vec<_> = (0..)
        .zip(&volume.levels)
        .flat_map(|(level, _)| {
            let chunks = VoxelBox::of_size(volume.chunks(level as usize));
            chunks.iter().map(move |chunk| ChunkId {
                channel: 0,
                level,
                chunk,
            })
        })
        .collect();
    read_all(&source).await;
    let mut changed = false;
    for step in steps {
        match step {
            Step::Put(n, z, at, turn, seed, size, by) => {
                let tile = tile(size, z, at, turn, by, seed);
                let size = UVec2::new(size.0 as u32, size.1 as u32);
                if !lies_in(&volume, z, size, tile.transform) {
                    continue;
                }
                fixture.put(&format!("t{n}"), tile).await;
                changed = true;
            }
            Step::Move(n, at, turn, by) => {
                let name = format!("t{n}");
                let catalog = fixture.archive.catalog();
                if let Some(there) = catalog.tile("v", &name).await.unwrap() {
                    let to = tile((80, 130), 0, at, turn, by, 0).transform;
                    if !lies_in(&volume, there.section, there.size, to) {
                        continue;
                    }
                    fixture.transform(&name, to).await;
                    changed = true;
                }
            }
            Step::Shift(z, by) => {
                let catalog = fixture.archive.catalog();
                let tiles = catalog.section_tiles("v", z).await.unwrap();
                let stays = |tile: &Tile| {
                    let to = tile.transform.shifted(by.into()).elements();
                    lies_in(&volume, z, tile.size, to)
                };
                if tiles.iter().all(stays) {
                    changed |= !tiles.is_empty();
                    fixture.shift(z, by).await;
                }
            }
            Step::Delete(n) => changed |= fixture.delete(&format!("t{n}")).await,
            Step::Reopen => {
                drop((source, changes));
                options.disk_cache.take().unwrap().close().await;
                options = cached(folder.path(), rules).await;
                source = fixture.open_with(options.clone()).await;
                source.go_wrong(wrong);
                (changes, changed) = (source.changes(), false);
            }
            Step::Read(n) => drop(source.read(ids[n % ids.len()]).await.unwrap()),
            Step::Drop(n) => drop(source.read(ids[n % ids.len()]).now_or_never()),
        }
    }
    if changed {
        caught_up(&fixture, &mut changes).await;
    }
    let newest = fixture.archive.catalog().revision("v").await.unwrap();
    // By what is told, not by the number beside it, which may be a moment behind or ahead.
    if newest > opened_at {
        while kept_changes.next().await.unwrap().revision < newest {}
    }
    let thumbnails = keeping.statistics().thumbnail_bytes;
    prop_assert!(thumbnails > 0, "the coarse levels are made of them");
    let (old, fresh) = (
        read_all(&source).await,
        read_all(&fixture.open_with(options_of(rules)).await).await,
    );
    prop_assert!(old == fresh, "stale voxels");
    prop_assert!(read_all(&keeping).await == fresh, "stale thumbnails");
    // What the disk has now is what will be.
    drop(source);
    options.disk_cache.take().unwrap().close().await;
    let mut options = cached(folder.path(), rules).await;
    let again = fixture.open_with(options.clone()).await;
    again.go_wrong(wrong);
    prop_assert!(read_all(&again).await == fresh, "stale voxels on disk");
    let found = again.statistics().blocks_from_disk;
    let any = fresh.iter().flatten().any(|v| *v != 0);
    prop_assert_eq!(found > 0, any, "{} blocks found", found);
    // A level is one block here; one without voxels is not worth keeping.
    let empty = fresh
        .iter()
        .filter(|level| level.iter().all(|v| *v == 0))
        .count();
    let built = again.statistics().blocks_built;
    prop_assert!(
        built <= empty as u64,
        "{} built, {} are empty",
        built,
        empty
    );
    drop(again);
    options.disk_cache.take().unwrap().close().await;
    let how = How {
        blend: rules.0 == Overlaps::Blend,
        along_z: rules.1 == AlongZ::Linear,
        gaps: rules.2.longest(),
        gaps_mix: matches!(rules.2, Gaps::Linear(_)),
        ..How::PLAIN
    };
    let want = expected_as(&volume, &fixture.tiles, how);
    let (coverage, most) = difference(&fresh, &want);
    prop_assert_eq!(
        (coverage, most <= 1),
        (0, true),
        "{} voxels, {}",
        coverage,
        most
    );
    Ok(())
}

#[test]
fn changes_that_are_no_longer_kept_leave_nothing_stale() {
    run(async {
        let mut fixture = small(Arc::new(MemoryStorage::new())).await;
        let tile = |n: u64| tile((80, 130), 1, (4.0, 5.0), 0.0, 1.0, n);
        fixture.put("t0", tile(0)).await;
        let source = fixture.open().await;
        let mut changes = source.changes();
        read_all(&source).await;
        let catalog = fixture.archive.catalog().clone().with_changes_kept(2);
        let mut commit = catalog.begin("v").await.unwrap();
        for n in 0..20 {
            let to = SectionFromTile::translation(glam::DVec2::splat(f64::from(n)));
            commit.transform("t0", to, None).await.unwrap();
        }
        let newest = commit.finish().await.unwrap();
        let missed = changes.next().await.unwrap();
        let all = VoxelBox::of_size(fixture.volume.extent());
        let want = (newest, all, crate::ChangeReason::Missed);
        assert_eq!((missed.revision, missed.voxels, missed.reason), want);
        let fresh = fixture.open().await;
        assert!(read_all(&source).await == read_all(&fresh).await);
        // And it goes on from there.
        fixture.put("t1", tile(1)).await;
        caught_up(&fixture, &mut changes).await;
        let fresh = fixture.open().await;
        assert!(read_all(&source).await == read_all(&fresh).await);
    });
}

/// Holds reads back until it is opened.
#[derive(Debug)]
struct Gate {
    inner: MemoryStorage,
    open: watch::Sender<bool>,
    waiting: AtomicUsize,
}

impl Gate {
    fn new() -> Arc<Self> {
        Arc::new(Self {
            inner: MemoryStorage::new(),
            open: watch::Sender::new(true),
            waiting: AtomicUsize::new(0),
        })
    }

    /// Waits until somebody waits.
    async fn approached(&self, by: usize) {
        while self.waiting.load(Ordering::SeqCst) < by {
            tokio::time::sleep(std::time::Duration::from_millis(2)).await;
        }
    }
}

impl Storage for Gate {
    fn read<'a>(
        &'a self,
        name: &'a str,
        range: Option<Range<u64>>,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        Box::pin(async move {
            let mut open = self.open.subscribe();
            if !*open.borrow_and_update() {
                self.waiting.fetch_add(1, Ordering::SeqCst);
                open.wait_for(|open| *open).await.unwrap();
            }
            self.inner.read(name, range).await
        })
    }

    fn write_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<(), StorageError>> {
        self.inner.write_durable(name, bytes)
    }

    fn create_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        self.inner.create_durable(name, bytes)
    }

    fn entries<'a>(&'a self, prefix: &'a str) -> BoxFuture<'a, Result<Vec<Entry>, StorageError>> {
        self.inner.entries(prefix)
    }

    fn delete<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<(), StorageError>> {
        self.inner.delete(name)
    }

    fn size<'a>(&'a self, name: &'a str) -> BoxFuture<'a, Result<u64, StorageError>> {
        self.inner.size(name)
    }
}

async fn read_first(source: &StitchedSource) -> Vec<u8> {
    match source.read(FIRST).await.unwrap() {
        Chunk::Voxels(bytes) => bytes.to_vec(),
        Chunk::Empty => Vec::new(),
    }
}

#[test]
fn a_build_from_before_a_change_serves_only_those_who_asked_before() {
    run(async {
        let gate = Gate::new();
        let mut fixture = small(gate.clone()).await;
        let source = Arc::new(fixture.open().await);
        let mut changes = source.changes();
        let before = chunk_of(&fixture.volume, &fixture.expected(), FIRST);
        gate.open.send_replace(false);
        let ask = || {
            let source = source.clone();
            tokio::spawn(async move { read_first(&source).await })
        };
        let asked_before = ask();
        // Each of the three tiles reads once: by then it is known which tiles each section has.
        gate.approached(3).await;
        let other = tile((80, 130), 0, (-5.0, -8.0), 2.0, 1.0, 99);
        fixture.put("t0", other).await;
        caught_up(&fixture, &mut changes).await;
        let after = chunk_of(&fixture.volume, &fixture.expected(), FIRST);
        let asked_after = ask();
        gate.approached(4).await;
        gate.open.send_replace(true);

        let close = |got: &[u8], want: &[u8]| {
            got.iter().zip(want).all(|(a, b)| a.abs_diff(*b) <= 1) && got.len() == want.len()
        };
        assert!(close(&asked_before.await.unwrap(), &before));
        assert!(close(&asked_after.await.unwrap(), &after));
        assert!(
            close(&read_first(&source).await, &after),
            "the older build was not kept"
        );
        assert!(!close(&before, &after), "the change can be seen");
        assert_eq!(source.statistics().blocks_built, 2);
    });
}

#[test]
fn a_build_that_nobody_waits_for_ends() {
    run(async {
        let gate = Gate::new();
        let fixture = small(gate.clone()).await;
        let source = fixture.open().await;
        gate.open.send_replace(false);
        let (one, other) = (source.read(FIRST), source.read(FIRST));
        let both = futures::future::join(one, other);
        let waiting = std::pin::pin!(gate.approached(1));
        match select(both, waiting).await {
            Either::Left(_) => panic!("read through a closed gate"),
            Either::Right(((), both)) => drop(both),
        }
        gate.open.send_replace(true);
        let want = chunk_of(&fixture.volume, &fixture.expected(), FIRST);
        let got = read_first(&source).await;
        assert!(got.iter().zip(&want).all(|(a, b)| a.abs_diff(*b) <= 1));
        assert_eq!(
            source.statistics().blocks_built,
            1,
            "the first build was given up"
        );
    });
}
