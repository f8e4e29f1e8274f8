//! `kill -9` at random moments of a stream.
//!
//! The test runs itself as a child process that follows an acquisition archive and never ends on
//! its own. Twenty times the child is killed while records are still to do; each time the catalog
//! is looked at. In the end, what came about in pieces is compared with an undisturbed run.

use std::collections::BTreeSet;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use glam::UVec2;
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{Record, TileRecord};
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{IngestOptions, run};

use crate::scope::{Scope, VOLUME, archive, at, move_record, orphans, pixels, quick, seen, tiff16};

const SIZE: UVec2 = UVec2::new(300, 260);
const KILLS: u32 = 20;
/// Records that are still to do whenever a child starts.
const BACKLOG: u64 = 8;
const IMAGES: u64 = 8;
const ACQUISITION: &str = "SACCADE_TEST_KILL_ACQUISITION";
const ARCHIVE: &str = "SACCADE_TEST_KILL_ARCHIVE";

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_ingest_loses_nothing_and_names_only_whole_pyramids() {
    if let (Ok(acquisition), Ok(folder)) = (std::env::var(ACQUISITION), std::env::var(ARCHIVE)) {
        return child(Path::new(&acquisition), Path::new(&folder)).await;
    }
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let late = prepare(&scope);
    let mut random = Random(0x5acc_ade5);
    let (mut said, mut done) = (0, 0);
    let (mut moved_on, mut in_the_middle) = (0, 0);
    // Adapts, so that a kill lands after a few tiles, on slow machines as on fast ones.
    let mut longest = Duration::from_millis(40);
    for life in 0..KILLS {
        while said < done + BACKLOG {
            scope.say(&record(said));
            said += 1;
        }
        // Some die while they start: they make the catalog, or read where the last one was.
        let starting = life % 5 == 0;
        live_and_die(
            &scope,
            folder.path(),
            starting,
            longest.mul_f64(random.unit()),
        );

        let archive = archive(folder.path()).await;
        let line = archive.catalog().cursor(VOLUME).await.map_or(0, |c| c.line);
        check_whole(&archive, done).await;
        archive.catalog().close().await;
        assert!(
            line <= said && line >= done,
            "{line} of {said} records, {done} before"
        );
        in_the_middle += u32::from(line < said);
        moved_on += u32::from(line > done);
        if line == done && !starting {
            longest = longest.mul_f64(1.6);
        } else if line > done + BACKLOG / 2 {
            longest = longest.mul_f64(0.6);
        }
        done = line;
    }
    assert!(
        in_the_middle >= 5,
        "only {in_the_middle} of {KILLS} kills found work undone"
    );
    assert!(
        moved_on >= 5,
        "only {moved_on} of {KILLS} lives got anything done"
    );

    // The file that was half, all the time, gets whole; and the rest is done in peace.
    fs::write(scope.file("late"), late).unwrap();
    let resumed = archive(folder.path()).await;
    scope.ingest(&resumed).await;
    assert_eq!(resumed.catalog().cursor(VOLUME).await.unwrap().line, said);

    let undisturbed_folder = tempfile::tempdir().unwrap();
    let undisturbed = archive(undisturbed_folder.path()).await;
    scope.ingest(&undisturbed).await;
    let (got, want) = (seen(&resumed).await, seen(&undisturbed).await);
    assert!(want.len() > 20, "a stream of {} tiles", want.len());
    assert_eq!(
        got.keys().collect::<Vec<_>>(),
        want.keys().collect::<Vec<_>>()
    );
    for (name, want) in &want {
        assert!(got[name] == *want, "tile {name} differs");
    }
    assert_eq!(reasons(&resumed).await, reasons(&undisturbed).await);
    assert!(
        orphans(&resumed).await.is_empty(),
        "{:?}",
        orphans(&resumed).await
    );
    let leftovers = fs::read_dir(folder.path().join(".incoming"))
        .unwrap()
        .count();
    assert_eq!(leftovers, 0, "temporary files of the dead");
}

/// Starts a child, kills it, makes sure that it did not end before.
fn live_and_die(scope: &Scope, folder: &Path, starting: bool, life: Duration) {
    let name = "kill::a_killed_ingest_loses_nothing_and_names_only_whole_pyramids";
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", name, "--nocapture"])
        .env(ACQUISITION, scope.path())
        .env(ARCHIVE, folder)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    if !starting {
        while lines.next().expect("the child begins to work").unwrap() != "at work" {}
    }
    std::thread::sleep(life);
    child.kill().unwrap();
    let status = child.wait().unwrap();
    assert_eq!(
        status.signal(),
        Some(9),
        "the child ended on its own: {status}"
    );
}

async fn child(acquisition: &Path, folder: &Path) {
    let archive = archive(folder).await;
    let options = IngestOptions {
        once: false,
        patience: u32::MAX,
        ..quick()
    };
    std::io::stdout().write_all(b"\nat work\n").unwrap();
    run(acquisition, &archive, &options, &(), &Cancel::new())
        .await
        .unwrap();
}

/// Every pyramid that the catalog names can be read to the last pixel.
async fn check_whole(archive: &VisualizationArchive, done: u64) {
    if archive.catalog().volume(VOLUME).await.is_err() {
        assert_eq!(done, 0, "the volume is gone");
        return;
    }
    for (name, tile) in seen(archive).await {
        let values = pixels(archive, &tile).await;
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

/// The stream: mostly new tiles, some imaged again, some moved, early and late, some bad.
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
            5 => move_record(&format!("t{}", n + 2), at(1.0, n as f64)),
            6 => move_record(&format!("t{}", n - 2), at(2.0, n as f64)),
            8 => tile(format!("t{}", n - 1), &format!("image{}", n % IMAGES)),
            _ => tile(format!("t{n}"), &format!("image{}", n % IMAGES)),
        },
    }
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
