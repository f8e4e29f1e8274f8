//! Several workers on one volume. Time is what the test says it is.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use saccade_archive::acquisition::Cursor;
use saccade_archive::catalog::{Catalog, CatalogError, TileOutcome, Waiting};
use saccade_archive::clock::PretendClock;

use crate::place::Place;
use crate::suite::{SIZE, all_changes, at, tile, tiles, waiting};

const LEASE: Duration = Duration::from_secs(20);

async fn timed(place: &Place) -> (Catalog, Arc<PretendClock>) {
    let clock = Arc::new(PretendClock::default());
    (place.catalog().await.with_clock(clock.clone()), clock)
}

async fn enqueue(catalog: &Catalog, records: impl IntoIterator<Item = Waiting>) {
    let mut commit = catalog.begin("v").await.unwrap();
    for record in records {
        commit.enqueue(&record).await.unwrap();
    }
    commit.finish().await.unwrap();
}

fn record(n: u64) -> Waiting {
    waiting(
        &format!("t{n}"),
        (n % 6) as u32,
        at((n % 80) as f64, 0.0),
        n,
    )
}

pub(crate) async fn workers_share_what_is_to_be_done(place: &Place) {
    let catalog = place.catalog().await;
    enqueue(&catalog, (0..20).map(record)).await;
    assert_eq!(catalog.statistics("v").await.unwrap().queued, 20);
    // Each with a handle of its own, as in processes of their own, all at once.
    let mut tasks = Vec::new();
    for n in 0..4 {
        let catalog = Catalog::open(place.location()).await.unwrap();
        tasks.push(tokio::spawn(async move {
            let worker = catalog.register(&format!("w{n}"), LEASE).await.unwrap();
            let mut mine = Vec::new();
            while let claims = catalog.claim("v", &worker, 3).await.unwrap()
                && !claims.is_empty()
            {
                assert!(claims.len() <= 3);
                assert!(claims.iter().all(|c| (c.deaths, c.parked) == (0, false)));
                mine.extend(claims.into_iter().map(|c| c.waiting));
            }
            catalog.close().await;
            mine
        }));
    }
    let mut all = Vec::new();
    for task in tasks {
        all.extend(task.await.unwrap());
    }
    all.sort_by_key(|w| w.position);
    assert_eq!(all, (0..20).map(record).collect::<Vec<_>>());
    let worker = catalog.register("late", LEASE).await.unwrap();
    let unknown = catalog.claim("w", &worker, 1).await;
    assert!(matches!(unknown, Err(CatalogError::UnknownVolume { .. })));
}

pub(crate) async fn a_dead_workers_claims_return(place: &Place) {
    let (catalog, clock) = timed(place).await;
    enqueue(&catalog, (0..3).map(record)).await;
    let dead = catalog.register("dead", LEASE).await.unwrap();
    let heir = catalog.register("heir", LEASE).await.unwrap();
    assert_eq!(catalog.claim("v", &dead, 2).await.unwrap().len(), 2);
    // It dies with one in hand; the other waited.
    catalog.begin_record("v", &dead, 1).await.unwrap();
    clock.turn(LEASE);
    // To the last moment they are the other one's.
    let left = catalog.claim("v", &heir, 9).await.unwrap();
    assert_eq!(left.len(), 1);
    assert_eq!(left[0].waiting, record(2));
    clock.turn(Duration::from_millis(1));
    let inherited = catalog.claim("v", &heir, 9).await.unwrap();
    let seen: Vec<_> = inherited
        .iter()
        .map(|c| (c.waiting.position, c.deaths))
        .collect();
    assert_eq!(seen, [(0, 0), (1, 1)]);
    // What is another's is not begun.
    catalog.begin_record("v", &dead, 0).await.unwrap();
    for position in [0, 1] {
        catalog.begin_record("v", &heir, position).await.unwrap();
    }
    // Who comes back from the dead has nothing to say any more, and gets nothing back.
    let mut commit = catalog.begin("v").await.unwrap();
    assert!(!commit.holds(&dead, 0).await.unwrap());
    assert!(commit.holds(&heir, 0).await.unwrap());
    drop(commit);
    catalog.keep_alive(&dead).await.unwrap();
    assert_eq!(catalog.claim("v", &dead, 9).await.unwrap(), []);
    // Once it is known to do no harm, it counts from the start.
    let mut commit = catalog.begin("v").await.unwrap();
    commit.wait(&record(0)).await.unwrap();
    commit.finish().await.unwrap();
    clock.turn(LEASE * 2);
    let again = catalog.claim("v", &dead, 9).await.unwrap();
    let seen: Vec<_> = again
        .iter()
        .map(|c| (c.waiting.position, c.deaths, c.parked))
        .collect();
    assert_eq!(seen, [(0, 0, true), (1, 2, false), (2, 0, false)]);
}

pub(crate) async fn a_sign_of_life_keeps_claims(place: &Place) {
    let (catalog, clock) = timed(place).await;
    enqueue(&catalog, (0..4).map(record)).await;
    let busy = catalog.register("busy", LEASE).await.unwrap();
    let idle = catalog.register("idle", LEASE).await.unwrap();
    assert_eq!(catalog.claim("v", &busy, 2).await.unwrap().len(), 2);
    assert_eq!(catalog.claim("v", &idle, 2).await.unwrap().len(), 2);
    for _ in 0..5 {
        clock.turn(LEASE * 3 / 4);
        catalog.keep_alive(&busy).await.unwrap();
        // Asking is a sign of life as well.
        assert_eq!(catalog.claim("v", &idle, 9).await.unwrap(), []);
    }
}

pub(crate) async fn records_of_a_tile_are_worked_on_in_order(place: &Place) {
    let catalog = place.catalog().await;
    let again = |position| waiting("a", 0, at(1.0, 1.0), position);
    enqueue(
        &catalog,
        [again(1), again(3), waiting("b", 0, at(1.0, 1.0), 5)],
    )
    .await;
    let worker = catalog.register("w", LEASE).await.unwrap();
    let positions = async |max| {
        let claims = catalog.claim("v", &worker, max).await.unwrap();
        claims
            .iter()
            .map(|c| c.waiting.position)
            .collect::<Vec<_>>()
    };
    assert_eq!(positions(9).await, [1, 5]);
    assert!(positions(9).await.is_empty());
    // One whose file is not whole holds up nothing.
    let mut commit = catalog.begin("v").await.unwrap();
    commit.wait(&again(1)).await.unwrap();
    commit.finish().await.unwrap();
    assert_eq!(positions(9).await, [3]);
    assert_eq!(catalog.queued("v").await.unwrap(), (2, 1));
}

pub(crate) async fn who_leaves_gives_back(place: &Place) {
    let catalog = place.catalog().await;
    enqueue(&catalog, (0..3).map(record)).await;
    let leaving = catalog.register("leaving", LEASE).await.unwrap();
    let staying = catalog.register("staying", LEASE).await.unwrap();
    assert_eq!(catalog.claim("v", &staying, 1).await.unwrap().len(), 1);
    assert_eq!(catalog.claim("v", &leaving, 9).await.unwrap().len(), 2);
    catalog.begin_record("v", &leaving, 2).await.unwrap();
    catalog.release(&leaving).await.unwrap();
    let claims = catalog.claim("v", &staying, 9).await.unwrap();
    let seen: Vec<_> = claims
        .iter()
        .map(|c| (c.waiting.position, c.deaths))
        .collect();
    assert_eq!(seen, [(1, 0), (2, 0)]);
}

pub(crate) async fn what_the_dead_had_is_free_at_once(place: &Place) {
    let (catalog, clock) = timed(place).await;
    enqueue(&catalog, (0..4).map(record)).await;
    let nameless = catalog.register("nameless", LEASE).await.unwrap();
    let register = async |process| catalog.register_process("w", process, LEASE).await.unwrap();
    let (dead, alive) = (register("a").await, register("b").await);
    assert_eq!(catalog.claim("v", &dead, 2).await.unwrap().len(), 2);
    assert_eq!(catalog.claim("v", &nameless, 1).await.unwrap().len(), 1);
    catalog.begin_record("v", &dead, 0).await.unwrap();
    let mut processes = catalog.processes().await.unwrap();
    processes.sort();
    assert_eq!(processes, ["a", "b"]);
    assert_eq!(catalog.claim("v", &alive, 1).await.unwrap().len(), 1);
    catalog.bury("a").await.unwrap();
    assert_eq!(catalog.processes().await.unwrap(), ["b"]);
    let claims = catalog.claim("v", &alive, 9).await.unwrap();
    let seen: Vec<_> = { claims.iter() }
        .map(|c| (c.waiting.position, c.deaths))
        .collect();
    assert_eq!(seen, [(0, 1), (1, 0)], "what others have is theirs");
    // It was not dead: it gets what is free, and nothing back.
    catalog.keep_alive(&dead).await.unwrap();
    assert_eq!(catalog.processes().await.unwrap().len(), 2);
    let mut commit = catalog.begin("v").await.unwrap();
    assert!(!commit.holds(&dead, 0).await.unwrap());
    drop(commit);
    clock.turn(LEASE * 2);
    assert!(catalog.processes().await.unwrap().is_empty());
}

pub(crate) async fn records_are_read_once(place: &Place) {
    let catalog = place.catalog().await;
    let cursor = |line| Cursor {
        offset: line * 100,
        line,
        seen: (line > 0).then_some(line),
    };
    let advance = async |from, to| {
        let mut commit = catalog.begin("v").await.unwrap();
        let first = commit.advance(cursor(from), cursor(to)).await.unwrap();
        commit.finish().await.unwrap();
        first
    };
    assert!(advance(0, 4).await);
    assert!(!advance(0, 4).await, "somebody else read these");
    assert_eq!(catalog.cursor("v").await.unwrap(), cursor(4));
    let mut commit = catalog.begin("v").await.unwrap();
    let other = Cursor {
        seen: Some(5),
        ..cursor(4)
    };
    assert!(
        !commit.advance(other, cursor(7)).await.unwrap(),
        "other records"
    );
    drop(commit);
    assert!(advance(4, 7).await);
    assert_eq!(catalog.cursor("v").await.unwrap(), cursor(7));
}

pub(crate) async fn old_changes_are_forgotten_and_said_to_be(place: &Place) {
    let catalog = place.catalog().await.with_changes_kept(32);
    for n in 0..100 {
        let tile = tile(&format!("t{n}"), 0, at(1.0, 1.0), n);
        catalog.commit_tile("v", &tile).await.unwrap();
        let newest = catalog.changes_after("v", n).await.unwrap();
        assert_eq!(newest.len(), 1);
    }
    // Kept, and a sixteenth more at most.
    assert_eq!(catalog.changes_after("v", 68).await.unwrap().len(), 32);
    let missed = catalog.changes_after("v", 0).await.unwrap_err();
    let CatalogError::Missed {
        after: 0,
        kept_after,
        revision: 100,
        ..
    } = missed
    else {
        panic!("{missed}")
    };
    assert!((66..=68).contains(&kept_after), "{kept_after}");
    let kept = catalog.changes_after("v", kept_after).await.unwrap();
    assert_eq!(kept.len() as u64, 100 - kept_after);
    assert_eq!(catalog.changes_after("v", 100).await.unwrap(), []);
    // All else is as it was.
    assert_eq!(catalog.entry("v").await.unwrap().tiles, 100);
}

/// Workers that work, sleep past their lease and die, as chance has it: every tile is entered once,
/// and the volume is what one worker alone makes of it.
pub(crate) async fn workers_that_die_lose_nothing(place: &Place) {
    const TILES: u64 = 120;
    let (catalog, clock) = timed(place).await;
    enqueue(&catalog, (0..TILES).map(record)).await;
    let mut random = Random(0x5acc_ade5);
    let mut entered: BTreeMap<u64, u32> = BTreeMap::new();
    let mut expired = BTreeSet::new();
    let (mut deaths, mut refused) = (0, 0);
    let mut workers = Vec::new();
    for n in 0..4 {
        workers.push((
            catalog.register(&format!("w{n}"), LEASE).await.unwrap(),
            Vec::new(),
        ));
    }
    while catalog.statistics("v").await.unwrap().queued > 0 {
        let n = random.below(4) as usize;
        match random.below(10) {
            // It dies; another is started in its place.
            0 => {
                deaths += 1;
                let name = format!("w{n}.{deaths}");
                workers[n] = (catalog.register(&name, LEASE).await.unwrap(), Vec::new());
                clock.turn(LEASE / 3);
            }
            // The machine sleeps.
            1 => {
                clock.turn(LEASE + Duration::from_millis(1));
                expired.extend(workers.iter().flat_map(|(_, claims)| claims).copied());
            }
            2..6 => {
                let claims = catalog.claim("v", &workers[n].0, 3).await.unwrap();
                workers[n]
                    .1
                    .extend(claims.iter().map(|c| c.waiting.position));
            }
            _ => {
                let (worker, claims) = &mut workers[n];
                let Some(position) = claims.pop() else {
                    continue;
                };
                let mut commit = catalog.begin("v").await.unwrap();
                if commit.holds(worker, position).await.unwrap() {
                    let Waiting { record, .. } = record(position);
                    let new = tile(&record.tile, record.section, record.transform, position);
                    let outcome = commit.tile(&new, SystemTime::now()).await.unwrap();
                    assert_eq!(outcome, TileOutcome::New);
                    commit.wait_no_more(position).await.unwrap();
                    commit.finish().await.unwrap();
                    *entered.entry(position).or_default() += 1;
                } else {
                    refused += 1;
                    assert!(expired.contains(&position), "{position} was taken away");
                }
            }
        }
    }
    assert!(
        deaths > 10 && refused > 3,
        "{deaths} deaths, {refused} refused"
    );
    assert_eq!(entered, (0..TILES).map(|n| (n, 1)).collect());
    assert_eq!(all_changes(&catalog).await.len() as u64, TILES);
    let seen = tiles(&catalog).await;
    assert_eq!(seen.len() as u64, TILES);
    for n in 0..TILES {
        let Waiting { record, .. } = record(n);
        assert_eq!(record.size, SIZE);
        let want = (
            record.section,
            record.transform.elements(),
            format!("tiles/t{n}.{n}.tif"),
        );
        assert_eq!(seen[&format!("t{n}")], want);
    }
}

/// A small generator, so that a failing run can be repeated.
struct Random(u64);

impl Random {
    fn below(&mut self, n: u64) -> u64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % n
    }
}
