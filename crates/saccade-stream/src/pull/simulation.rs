//! The pull against a source that delays, fails and changes, and a renderer that forgets.
//!
//! Time is a number, so thousands of orders of events take no time.

use std::collections::BTreeMap;
use std::io;

use glam::{DVec3, IVec3, UVec3};
use proptest::prelude::*;
use saccade_source::VolumeSource;
use saccade_source::memory::ArraySource;

use super::*;

const EXTENT: UVec3 = UVec3::new(75, 50, 40);

/// How the source answers the nth request.
#[derive(Clone, Copy, Debug)]
enum Answer {
    After(u64),
    FailsAfter(u64),
    NotReady(u64),
}

#[derive(Clone, Debug)]
struct Script {
    answers: Vec<Answer>,
    /// Ticks at which a box gets a value, and ticks until the listener hears of it.
    changes: Vec<(u64, UVec3, UVec3, u8, u64)>,
    /// Chunk of level 0 that fails for good.
    broken: Option<UVec3>,
    in_flight: usize,
    host_kib: u64,
    resident: usize,
}

fn script() -> impl Strategy<Value = Script> {
    let answer = prop_oneof![
        4 => (0_u64..40).prop_map(Answer::After),
        1 => (0_u64..40).prop_map(Answer::FailsAfter),
        1 => (0_u64..40).prop_map(Answer::NotReady),
    ];
    let at = (0..EXTENT.x, 0..EXTENT.y, 0..EXTENT.z).prop_map(UVec3::from);
    let size = (1_u32..40, 1_u32..40, 1_u32..40).prop_map(UVec3::from);
    let change = (0_u64..150, at, size, 0_u8..=255, 0_u64..20);
    let broken = (0_u32..4, 0_u32..3, 0_u32..3).prop_map(UVec3::from);
    (
        prop::collection::vec(answer, 1..24),
        prop::collection::vec(change, 0..6),
        prop::option::weighted(0.3, broken),
        1_usize..12,
        0_u64..400,
        4_usize..20,
    )
        .prop_map(
            |(answers, changes, broken, in_flight, host_kib, resident)| Script {
                answers,
                changes,
                broken,
                in_flight,
                host_kib,
                resident,
            },
        )
}

/// What a chunk answers, as it was when the read began.
struct Pending {
    due: u64,
    request: Request,
    answer: Result<Chunk, ChunkError>,
}

struct World {
    script: Script,
    source: ArraySource,
    pull: Pull,
    pending: Vec<Pending>,
    asked: usize,
    /// Bricks the renderer holds, with their voxels.
    resident: BTreeMap<BrickId, Vec<u8>>,
    /// The array now, and as far as the pull was told.
    current: Vec<u8>,
    announced: Vec<u8>,
    /// What voxels became since then, in order: none of it is stale, for nobody was told.
    untold: BTreeMap<usize, Vec<u8>>,
    /// Every value that a voxel ever had.
    history: BTreeMap<usize, Vec<u8>>,
    /// Deliveries that were out of date, per brick.
    outdated: BTreeMap<BrickId, u32>,
    /// Whether the pull hears of changes. Where it does not, the test must fail.
    tells: bool,
}

fn index(at: UVec3) -> usize {
    ((at.z * EXTENT.y + at.y) * EXTENT.x + at.x) as usize
}

fn was(values: &BTreeMap<usize, Vec<u8>>, index: usize, value: u8) -> bool {
    values.get(&index).is_some_and(|v| v.contains(&value))
}

/// Where a brick's voxels are in the plain array: clamped at its ends.
fn indices_of(brick: BrickId) -> Vec<usize> {
    let first = brick.brick().as_ivec3() * 32 - 1;
    let mut indices = Vec::with_capacity(34 * 34 * 34);
    for z in 0..34 {
        for y in 0..34 {
            for x in 0..34 {
                let at = (first + IVec3::new(x, y, z)).clamp(IVec3::ZERO, EXTENT.as_ivec3() - 1);
                indices.push(index(at.as_uvec3()));
            }
        }
    }
    indices
}

/// A brick's voxels from the plain array.
fn voxels_of(brick: BrickId, array: &[u8]) -> Vec<u8> {
    indices_of(brick).into_iter().map(|i| array[i]).collect()
}

fn bricks() -> Vec<BrickId> {
    let all = saccade_core::brick::bricks_of(EXTENT);
    VoxelBox::of_size(all)
        .iter()
        .map(|b| BrickId::new(0, 0, b).unwrap())
        .collect()
}

const fn ticks(ticks: u64) -> Duration {
    Duration::from_millis(ticks)
}

impl World {
    fn new(script: Script, tells: bool) -> Self {
        let volume = Volume::new("v", EXTENT, DVec3::ONE).unwrap();
        let volume = Volume {
            chunk: UVec3::new(20, 24, 18),
            ..volume
        };
        let whole = VoxelBox::of_size(EXTENT);
        let array: Vec<u8> = whole
            .iter()
            .map(|at| u8::try_from((at.x * 3 + at.y * 5 + at.z * 7) % 256).unwrap() | 1)
            .collect();
        let source = ArraySource::new(volume, array.clone()).unwrap();
        let retry = crate::policy::Retry {
            first: ticks(4),
            longest: ticks(30),
        };
        let limits = Limits {
            host_bytes: script.host_kib << 10,
            in_flight: script.in_flight,
            grace: 1,
            delivery_bytes: 3 * 34 * 34 * 34,
            delivery_time: ticks(1),
            retry,
        };
        Self {
            pull: Pull::new(source.volume().clone(), limits),
            script,
            source,
            pending: Vec::new(),
            asked: 0,
            resident: BTreeMap::new(),
            current: array.clone(),
            announced: array,
            untold: BTreeMap::new(),
            history: BTreeMap::new(),
            outdated: BTreeMap::new(),
            tells,
        }
    }

    fn begin(&mut self, request: Request, now: u64) {
        let id = request.id;
        let snapshot = pollster::block_on(self.source.read(id));
        let failure = |transient| ChunkError::Failed {
            id,
            transient,
            source: Arc::new(io::Error::other("scripted")),
        };
        // Later requests succeed at once: everything ends.
        let scripted = self
            .script
            .answers
            .get(self.asked)
            .copied()
            .unwrap_or(Answer::After(1));
        self.asked += 1;
        let (delay, answer) = match scripted {
            Answer::After(delay) => (delay, snapshot),
            Answer::FailsAfter(delay) => (delay, Err(failure(true))),
            Answer::NotReady(delay) => (
                delay,
                Err(ChunkError::NotReady {
                    id,
                    retry_after: ticks(delay),
                }),
            ),
        };
        let broken = self.script.broken == Some(id.chunk) && id.level == 0;
        let answer = if broken { Err(failure(false)) } else { answer };
        self.pending.push(Pending {
            due: now + delay,
            request,
            answer,
        });
    }

    /// Changes what happens at this tick, and tells what is to be told at it.
    fn change(&mut self, now: u64) {
        for (at, min, size, value, lag) in self.script.changes.clone() {
            let voxels = VoxelBox::new(min, (min + size).min(EXTENT));
            let values = vec![value; usize::try_from(voxels.voxels()).unwrap()];
            if at == now {
                self.source.set(voxels, &values).unwrap();
                for v in voxels.iter() {
                    let before = self.current[index(v)];
                    self.history.entry(index(v)).or_default().push(before);
                    self.current[index(v)] = value;
                    self.untold.entry(index(v)).or_default().push(value);
                }
            }
            if at + lag == now {
                for v in voxels.iter() {
                    self.announced[index(v)] = self.current[index(v)];
                    self.untold.remove(&index(v));
                }
                if self.tells {
                    self.pull.change(voxels);
                }
                let near = |b: &BrickId| {
                    let level = &self.source.volume().levels[0];
                    crate::brick::stored_voxels(*b, level).intersects(voxels)
                };
                self.resident.retain(|b, _| !near(b));
            }
        }
    }

    /// One frame: some bricks are looked at, at most as many as fit.
    fn frame(&mut self, frame: u64, now: u64) -> Result<(), TestCaseError> {
        self.change(now);
        let (due, later) = std::mem::take(&mut self.pending)
            .into_iter()
            .partition(|p| p.due <= now);
        self.pending = later;
        let due: Vec<Pending> = due;
        for Pending {
            request, answer, ..
        } in due
        {
            self.pull.answer(request.ticket, answer, ticks(now));
        }
        let looked_at: Vec<BrickId> = bricks().into_iter().take(self.script.resident).collect();
        let missing = |b: &&BrickId| !self.resident.contains_key(*b);
        let misses: Vec<BrickId> = looked_at.iter().filter(missing).copied().collect();
        if frame.is_multiple_of(3) {
            self.pull.want(frame, &misses);
        }
        let actions = self.pull.plan(ticks(now));
        for ticket in actions.cancel {
            self.pending.retain(|p| p.request.ticket != ticket);
        }
        for request in actions.start {
            self.begin(request, now);
        }
        prop_assert!(self.pending.len() <= self.script.in_flight);
        let mut arrived = Vec::new();
        let clock = || ticks(now);
        self.pull
            .deliver(frame + 1, clock, |id, voxels, freshness| {
                let voxels = match voxels {
                    BrickVoxels::Voxels(voxels) => voxels.to_vec(),
                    BrickVoxels::Empty => vec![0; 34 * 34 * 34],
                };
                arrived.push((id, voxels, freshness));
            });
        for (id, voxels, freshness) in arrived {
            let is_right = |(i, got): (usize, &u8)| match freshness {
                Freshness::Current => *got == self.announced[i] || was(&self.untold, i, *got),
                // Old, but never made up.
                Freshness::Outdated => *got == self.current[i] || was(&self.history, i, *got),
            };
            let right = indices_of(id).into_iter().zip(&voxels).all(is_right);
            prop_assert!(right, "{id} is no {freshness:?} brick at tick {now}");
            match freshness {
                Freshness::Current => _ = self.resident.insert(id, voxels),
                // The renderer goes on missing it.
                Freshness::Outdated => *self.outdated.entry(id).or_default() += 1,
            }
        }
        Ok(())
    }

    fn run(mut self) -> Result<(), TestCaseError> {
        for tick in 0..1_500 {
            self.frame(tick, tick)?;
        }
        self.settled()
    }

    /// Whether everything looked at is there and right, or known to have failed.
    fn settled(&self) -> Result<(), TestCaseError> {
        let looked_at = bricks().into_iter().take(self.script.resident);
        for brick in looked_at {
            match self.resident.get(&brick) {
                Some(voxels) => {
                    prop_assert!(
                        *voxels == voxels_of(brick, &self.current),
                        "{brick} is wrong"
                    );
                }
                None => prop_assert_eq!(self.pull.state(brick), BrickState::Failed),
            }
        }
        prop_assert_eq!(self.pull.progress().wanted, 0);
        prop_assert!(self.pending.is_empty(), "requests nobody wants");
        Ok(())
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn every_wanted_brick_arrives_right_or_is_reported_failed(script in script()) {
        World::new(script, true).run()?;
    }
}

/// A chunk read between two changes of which nobody was told yet holds what was there between.
#[test]
fn what_nobody_was_told_of_is_not_stale() {
    let mut answers = vec![Answer::After(0); 9];
    answers[5] = Answer::After(39);
    answers[8] = Answer::NotReady(33);
    let script = Script {
        answers,
        changes: vec![
            (105, UVec3::new(0, 0, 22), UVec3::new(32, 7, 10), 0, 8),
            (110, UVec3::ZERO, UVec3::new(1, 1, 32), 1, 1),
        ],
        broken: None,
        in_flight: 7,
        host_kib: 89,
        resident: 7,
    };
    World::new(script, true).run().unwrap();
}

#[test]
fn the_simulation_notices_when_changes_go_unheard() {
    let change = (30, UVec3::ZERO, EXTENT, 200, 0);
    let script = Script {
        answers: Vec::new(),
        changes: vec![change],
        broken: None,
        in_flight: 4,
        host_kib: 4096,
        resident: 12,
    };
    assert!(World::new(script.clone(), true).run().is_ok());
    assert!(
        World::new(script, false).run().is_err(),
        "stale chunks were delivered unnoticed"
    );
}

/// Changes come faster than answers, as they do to coarse levels of a volume that grows.
#[test]
fn bricks_that_never_stop_changing_are_shown_all_the_same() {
    let changes = (0..200).map(|n: u8| (u64::from(n) * 5, UVec3::ZERO, EXTENT, n | 1, 0));
    let script = Script {
        answers: vec![Answer::After(20); 10_000],
        changes: changes.collect(),
        broken: None,
        in_flight: 64,
        host_kib: 4096,
        resident: 12,
    };
    let mut world = World::new(script, true);
    for tick in 0..1_000 {
        world.frame(tick, tick).unwrap();
    }
    assert!(world.resident.is_empty(), "nothing was ever up to date");
    for brick in bricks().into_iter().take(12) {
        let shown = world.outdated.get(&brick).copied().unwrap_or_default();
        assert!(
            (15..60).contains(&shown),
            "{brick} was shown {shown} times in fifty round trips"
        );
    }
    for tick in 1_000..1_500 {
        world.frame(tick, tick).unwrap();
    }
    world.settled().unwrap();
}

#[test]
fn without_changes_nothing_is_out_of_date() {
    let script = Script {
        answers: vec![Answer::After(7), Answer::FailsAfter(3), Answer::NotReady(9)],
        changes: Vec::new(),
        broken: None,
        in_flight: 4,
        host_kib: 200,
        resident: 12,
    };
    let mut world = World::new(script, true);
    for tick in 0..500 {
        world.frame(tick, tick).unwrap();
    }
    assert!(world.outdated.is_empty() && world.resident.len() == 12);
}
