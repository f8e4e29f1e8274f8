//! `kill -9` at random moments of a stream: of ingest workers, and of the catalog's server.
//!
//! The tests run themselves as child processes that follow an acquisition archive and never end on
//! their own. Each time one is killed while records are still to do, the catalog is looked at. In the
//! end, what came about in pieces is compared with an undisturbed run. How often is said by
//! `SACCADE_TEST_KILLS`, when by `SACCADE_TEST_SEED`; `./dev kills` says both.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use glam::UVec2;
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{DeleteRecord, Record, TileRecord};
use saccade_archive::catalog::{Catalog, CatalogError, CatalogLocation};
use saccade_archive::storage::LocalStorage;
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{IngestOptions, run};

use crate::postgres::Server;
use crate::scope::{Scope, VOLUME, archive, at, move_record, orphans, pixels, quick, seen, tiff16};

const SIZE: UVec2 = UVec2::new(300, 260);
/// Records that are still to do whenever something is killed.
const BACKLOG: u64 = 8;
const IMAGES: u64 = 8;
const ACQUISITION: &str = "SACCADE_TEST_KILL_ACQUISITION";
const ARCHIVE: &str = "SACCADE_TEST_KILL_ARCHIVE";
const CATALOG: &str = "SACCADE_TEST_KILL_CATALOG";
const WORKERS: usize = 2;

fn kills() -> u32 {
    let said = std::env::var("SACCADE_TEST_KILLS").ok();
    said.map_or(20, |n| n.parse().expect("SACCADE_TEST_KILLS is a number"))
}

/// The seed of a test, another one with each `SACCADE_TEST_SEED`.
fn drawn(seed: u64) -> u64 {
    let said = std::env::var("SACCADE_TEST_SEED").ok();
    let said = said.map_or(0, |n| n.parse().expect("SACCADE_TEST_SEED is a number"));
    seed ^ u64::wrapping_mul(said, 0x9e37_79b9_7f4a_7c15)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_ingest_loses_nothing_and_names_only_whole_pyramids() {
    const NAME: &str = "kill::a_killed_ingest_loses_nothing_and_names_only_whole_pyramids";
    if let Some(place) = Place::of_child() {
        return child(&place).await;
    }
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let place = Place::new(&scope, folder.path(), None);
    let late = prepare(&scope);
    let mut random = Random(drawn(0x5acc_ade5));
    let (mut said, mut done) = (0, 0);
    let (mut moved_on, mut in_the_middle) = (0, 0);
    let kills = kills();
    // Adapts, so that a kill lands after a few tiles, on slow machines as on fast ones.
    let mut longest = Duration::from_millis(40);
    for life in 0..kills {
        while said < done + BACKLOG {
            scope.say(&record(said));
            said += 1;
        }
        // Some die while they start: they make the catalog, or read where the last one was.
        let starting = life % 5 == 0;
        let mut worker = Worker::start(NAME, &place);
        if !starting {
            worker.begins();
        }
        std::thread::sleep(longest.mul_f64(random.unit()));
        worker.kill();

        let archive = archive(folder.path()).await;
        let now = records_done(&archive).await;
        check_whole(&archive, done).await;
        archive.catalog().close().await;
        assert!(now <= said && now >= done, "{now} of {said}, {done} before");
        in_the_middle += u32::from(now < said);
        moved_on += u32::from(now > done);
        if now == done && !starting {
            longest = longest.mul_f64(1.6);
        } else if now > done + BACKLOG / 2 {
            longest = longest.mul_f64(0.6);
        }
        done = now;
    }
    assert!(
        in_the_middle >= kills / 4,
        "only {in_the_middle} of {kills} kills found work undone"
    );
    assert!(
        moved_on >= kills / 5,
        "only {moved_on} of {kills} lives got anything done"
    );
    end_in_peace(&scope, &place, &late, said).await;
    say(&format!(
        "{kills} kills of a worker on SQLite, {in_the_middle} with work undone, {said} records"
    ));
}

/// Two workers share a volume through PostgreSQL; now one of them is killed, now the server.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn workers_and_server_can_be_killed() {
    const NAME: &str = "kill::workers_and_server_can_be_killed";
    if let Some(place) = Place::of_child() {
        return child(&place).await;
    }
    let Some(server) = Server::start(&[]) else {
        return;
    };
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let url = server.database().await;
    let place = Place::new(&scope, folder.path(), Some(url));
    let late = prepare(&scope);
    let mut random = Random(drawn(0xface_5acc));
    let kills = kills();
    let (mut said, mut done, mut in_the_middle, mut of_server) = (0, 0, 0, 0);
    let mut acknowledged = BTreeSet::new();
    let mut revision = 0;
    let mut workers: Vec<_> = (0..WORKERS).map(|_| Worker::start(NAME, &place)).collect();
    let mut longest = Duration::from_millis(150);
    for death in 0..kills {
        while said < done + 2 * BACKLOG {
            scope.say(&record(said));
            said += 1;
        }
        std::thread::sleep(longest.mul_f64(random.unit()));
        if death % 4 == 3 {
            of_server += 1;
            server.kill();
            std::thread::sleep(Duration::from_millis(100).mul_f64(random.unit()));
            server.run();
        } else {
            let unlucky = usize::from(random.unit() < 0.5);
            workers[unlucky].kill();
            workers[unlucky] = Worker::start(NAME, &place);
        }

        let archive = place.open().await;
        let now = records_done(&archive).await;
        check_whole(&archive, done).await;
        assert!(now <= said, "{now} of {said}");
        // Those that live go on while it is counted.
        let now = now.max(done);
        in_the_middle += u32::from(now < said);
        if now > done + BACKLOG {
            longest = longest.mul_f64(0.7);
        } else if now == done {
            longest = longest.mul_f64(1.4).min(Duration::from_secs(2));
        }
        done = now;
        // What was there once stays, whoever dies.
        if let Ok(entry) = archive.catalog().entry(VOLUME).await {
            assert!(
                entry.revision >= revision,
                "{} after {revision}",
                entry.revision
            );
            revision = entry.revision;
            let mut names: BTreeSet<_> = seen(&archive).await.into_keys().collect();
            // Sections are read one by one: a tile that is imaged again in another section meanwhile may be
            // met in neither.
            names.extend(seen(&archive).await.into_keys());
            let gone: Vec<_> = acknowledged.difference(&names).collect();
            assert!(
                gone.iter().all(|name| is_deleted(name)),
                "{gone:?} are gone"
            );
            acknowledged.extend(names);
        }
        archive.catalog().close().await;
    }
    assert!(
        in_the_middle >= kills / 4,
        "only {in_the_middle} of {kills} kills found work undone"
    );
    for mut worker in workers {
        worker.kill();
    }
    end_in_peace(&scope, &place, &late, said).await;
    say(&format!(
        "{} kills of workers and {of_server} of the server on PostgreSQL, {in_the_middle} with work \
         undone, {said} records",
        kills - of_server
    ));
}

fn say(text: &str) {
    let line = format!("{text}\n");
    std::io::stdout().write_all(line.as_bytes()).unwrap();
}

/// The file that was half, all the time, gets whole; the rest is done; and all is as if nothing had
/// happened.
async fn end_in_peace(scope: &Scope, place: &Place, late: &[u8], said: u64) {
    fs::write(scope.file("late"), late).unwrap();
    let resumed = place.open().await;
    // After so many deaths a record that was in hand at several of them is no poison.
    let patient = IngestOptions {
        attempts: u32::MAX,
        ..quick()
    };
    let done = run(&place.acquisition, &resumed, &patient, &(), &Cancel::new()).await;
    done.unwrap();
    assert_eq!(resumed.catalog().cursor(VOLUME).await.unwrap().line, said);
    assert_eq!(resumed.catalog().queued(VOLUME).await.unwrap(), (0, 0));

    let undisturbed_folder = tempfile::tempdir().unwrap();
    let undisturbed = archive(undisturbed_folder.path()).await;
    scope.ingest(&undisturbed).await;
    let (got, want) = (seen(&resumed).await, seen(&undisturbed).await);
    assert!(want.len() > 12, "a stream of {} tiles", want.len());
    assert_eq!(
        got.keys().collect::<Vec<_>>(),
        want.keys().collect::<Vec<_>>()
    );
    for (name, want) in &want {
        assert!(got[name] == *want, "tile {name} differs");
    }
    assert_eq!(reasons(&resumed).await, reasons(&undisturbed).await);
    // Who dies between entering that a pyramid is not needed and deleting it leaves it: nothing names
    // it, and nobody misses it. No other may be left.
    let needed: BTreeMap<_, _> = got.values().map(|tile| (&tile.pyramid, ())).collect();
    for orphan in orphans(&resumed).await {
        assert!(!needed.contains_key(&orphan), "{orphan}");
        assert!(
            // Of a worker that was late: another had entered the tile meanwhile.
            orphan.contains("-again") || orphan.contains("/late-") || is_deleted(name_of(&orphan)),
            "{orphan}"
        );
    }
    let leftovers = fs::read_dir(place.folder.join(".incoming"))
        .unwrap()
        .count();
    assert_eq!(leftovers, 0, "temporary files of the dead");
}

/// The tile's name in a pyramid's.
fn name_of(pyramid: &str) -> &str {
    let file = pyramid.rsplit('/').next().unwrap();
    file.rsplit_once('-').unwrap().0
}

/// Where a child works.
struct Place {
    acquisition: std::path::PathBuf,
    folder: std::path::PathBuf,
    catalog: Option<String>,
}

impl Place {
    fn new(scope: &Scope, folder: &Path, catalog: Option<String>) -> Self {
        Self {
            acquisition: scope.path().to_owned(),
            folder: folder.to_owned(),
            catalog,
        }
    }

    fn of_child() -> Option<Self> {
        Some(Self {
            acquisition: std::env::var_os(ACQUISITION)?.into(),
            folder: std::env::var_os(ARCHIVE)?.into(),
            catalog: std::env::var(CATALOG).ok(),
        })
    }

    async fn open(&self) -> VisualizationArchive {
        let Some(url) = &self.catalog else {
            return archive(&self.folder).await;
        };
        let location = CatalogLocation::parse(url);
        // The server may be away.
        let catalog = loop {
            match Catalog::create(&location).await {
                Err(CatalogError::Unreachable { .. }) => {
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
                catalog => break catalog.unwrap(),
            }
        };
        let storage = LocalStorage::new(&*self.folder).unwrap();
        VisualizationArchive::from_parts(catalog, Arc::new(storage))
    }
}

/// A child process.
struct Worker {
    child: Child,
    lines: std::io::Lines<BufReader<std::process::ChildStdout>>,
}

impl Worker {
    fn start(test: &str, place: &Place) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command
            .args(["--exact", test, "--nocapture"])
            .env(ACQUISITION, &place.acquisition)
            .env(ARCHIVE, &place.folder)
            .stdout(Stdio::piped());
        if let Some(url) = &place.catalog {
            command.env(CATALOG, url);
        }
        let mut child = command.spawn().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Self { child, lines }
    }

    /// Waits until it begins to work.
    fn begins(&mut self) {
        while self
            .lines
            .next()
            .expect("the child begins to work")
            .unwrap()
            != "at work"
        {}
    }

    /// Kills it, and makes sure that it did not end before.
    fn kill(&mut self) {
        self.child.kill().unwrap();
        let status = self.child.wait().unwrap();
        assert_eq!(
            status.signal(),
            Some(9),
            "the child ended on its own: {status}"
        );
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        drop(self.child.kill());
        drop(self.child.wait());
    }
}

async fn child(place: &Place) {
    let archive = place.open().await;
    let options = IngestOptions {
        once: false,
        patience: u32::MAX,
        attempts: u32::MAX,
        // Alone, a worker need not wait long for those that died.
        lease: Duration::from_millis(if place.catalog.is_some() { 300 } else { 20 }),
        ..quick()
    };
    std::io::stdout().write_all(b"\nat work\n").unwrap();
    loop {
        match run(&place.acquisition, &archive, &options, &(), &Cancel::new()).await {
            // Died while it began: whoever supervises it starts it again.
            Err(saccade_ingest::ingest::IngestError::Catalog(CatalogError::Unreachable {
                ..
            })) => tokio::time::sleep(Duration::from_millis(20)).await,
            done => {
                done.unwrap();
            }
        }
    }
}

/// Records that were read and are no longer to do.
async fn records_done(archive: &VisualizationArchive) -> u64 {
    let catalog = archive.catalog();
    let Ok(before) = catalog.cursor(VOLUME).await else {
        return 0;
    };
    // Another may read on in between: then less is counted, not more.
    let (queued, _) = catalog.queued(VOLUME).await.unwrap();
    before.line.saturating_sub(queued)
}

/// Every pyramid that the catalog names can be read to the last pixel.
async fn check_whole(archive: &VisualizationArchive, done: u64) {
    if archive.catalog().volume(VOLUME).await.is_err() {
        assert_eq!(done, 0, "the volume is gone");
        return;
    }
    for (name, tile) in seen(archive).await {
        let values = pixels(&tile).await;
        assert!(values.iter().all(|v| *v > 0), "tile {name} has holes");
    }
}

async fn reasons(archive: &VisualizationArchive) -> BTreeSet<(String, Option<String>, String)> {
    let all = archive.catalog().quarantined(VOLUME).await.unwrap();
    all.into_iter()
        .map(|q| (q.file, q.tile, q.reason))
        .collect()
}

/// Makes the images, and half of one; returns the whole of it.
fn prepare(scope: &Scope) -> Vec<u8> {
    for n in 0..IMAGES {
        scope.image(&format!("image{n}"), SIZE, u8::try_from(n).unwrap());
    }
    fs::write(scope.file("deep"), tiff16(SIZE)).unwrap();
    let late = scope.image("late", SIZE, 99);
    fs::write(scope.file("late"), &late[..late.len() / 3]).unwrap();
    late
}

/// The stream: mostly new tiles, some imaged again, some moved, early and late, some deleted, some bad.
fn record(n: u64) -> Record {
    let tile = |tile: String, file: &str| {
        let transform = at((n % 7) as f64 * 90.0, (n % 5) as f64 * 80.0);
        let section = u32::try_from(n % 3).unwrap();
        let file = format!("tiles/{file}.tif");
        Record::Tile(TileRecord {
            tile,
            file,
            section,
            size: SIZE,
            transform,
            channel: None,
        })
    };
    match n {
        2 => tile("late".to_owned(), "late"),
        11 => move_record("late", at(33.0, 44.0)),
        _ => match n % 10 {
            3 => tile(format!("deep{n}"), "deep"),
            5 => move_record(&format!("t{}", n + 2), at(1.0, (n % 500) as f64)),
            6 => move_record(&format!("t{}", n - 2), at(2.0, (n % 500) as f64)),
            8 => tile(format!("t{}", n - 1), &format!("image{}", n % IMAGES)),
            9 => Record::Delete(DeleteRecord {
                tile: format!("t{}", n - 5),
            }),
            _ => tile(format!("t{n}"), &format!("image{}", n % IMAGES)),
        },
    }
}

/// Whether the stream deletes a tile.
fn is_deleted(name: &str) -> bool {
    name.starts_with('t') && name.ends_with('4')
}

/// A small generator, so that a failing run can be repeated.
struct Random(u64);

impl Random {
    fn unit(&mut self) -> f64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }
}
