//! Images that several tiles of a list show while they are still being written.

use std::collections::BTreeMap;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use saccade_archive::acquisition::Record;
use saccade_ingest::watch::{Disk, Entry, Folders, ListConfig, ListWatch, Stamp};

use super::{Scope, roomy, write};

const TILES: usize = 5;

/// The file system while somebody writes the image, which is another each time that it is looked at: a clock that goes on
/// when it is told to, and begins an hour later, when all that is there has rested.
#[derive(Clone, Default)]
struct Writing {
    seconds: Arc<AtomicU64>,
    writes: Arc<AtomicBool>,
    written: Arc<AtomicU64>,
    /// When it was written last \[s\].
    last: Arc<AtomicU64>,
}

impl Writing {
    fn at(seconds: u64) -> SystemTime {
        SystemTime::UNIX_EPOCH + Duration::from_secs(4_000_000_000 + seconds)
    }
}

impl Folders for Writing {
    fn modified(&self, folder: &Path) -> io::Result<SystemTime> {
        Disk.modified(folder)
    }

    fn list(
        &self,
        folder: &Path,
    ) -> io::Result<Box<dyn Iterator<Item = io::Result<Entry>> + Send>> {
        Disk.list(folder)
    }

    fn stamp(&self, file: &Path) -> io::Result<Stamp> {
        let there = Disk.stamp(file)?;
        if file.extension().is_none_or(|extension| extension != "tif") {
            return Ok(there);
        }
        if self.writes.load(Ordering::Relaxed) {
            self.written.fetch_add(1, Ordering::Relaxed);
            let now = self.seconds.load(Ordering::Relaxed);
            self.last.store(now, Ordering::Relaxed);
        }
        Ok(Stamp {
            bytes: self.written.load(Ordering::Relaxed),
            modified: Self::at(self.last.load(Ordering::Relaxed)),
            changed: None,
            ..there
        })
    }

    fn now(&self) -> SystemTime {
        Self::at(self.seconds.load(Ordering::Relaxed))
    }
}

/// How often each tile was told of.
fn told(scope: &Scope) -> BTreeMap<String, usize> {
    let mut told = BTreeMap::new();
    for record in scope.records() {
        let Record::Tile(tile) = record else {
            panic!("{record:?}");
        };
        *told.entry(tile.tile).or_default() += 1;
    }
    told
}

fn watch(scope: &Scope, disk: &Writing) -> ListWatch<Writing> {
    let config = ListConfig {
        rest: Duration::ZERO,
        drop_after: Duration::ZERO,
        ..roomy(&scope.file("list.txt"))
    };
    let open = || ListWatch::open(config.clone(), disk.clone(), &scope.path(), &scope.kept());
    let mut watch = open().unwrap();
    // As `Scope::watch`.
    for _ in 0..50 {
        if watch.leads() {
            break;
        }
        std::thread::sleep(Duration::from_millis(10));
        drop(watch);
        watch = open().unwrap();
    }
    assert!(watch.leads());
    watch
}

fn looks(watch: &mut ListWatch<Writing>, disk: &Writing, count: u32) {
    for _ in 0..count {
        disk.seconds.fetch_add(1, Ordering::Relaxed);
        watch.look().unwrap();
    }
}

/// One that is being written when it is found.
fn begun() -> (Scope, Writing) {
    let (scope, disk) = (Scope::new(), Writing::default());
    scope.image("a", 1);
    let line = |n: usize| format!("a.tif {} 0 {n}\n", 10 * n);
    write(
        &scope.file("list.txt"),
        (0..TILES).map(line).collect::<String>(),
    );
    disk.writes.store(true, Ordering::Relaxed);
    (scope, disk)
}

fn each(scope: &Scope) -> Vec<usize> {
    told(scope).into_values().collect()
}

#[test]
fn an_image_that_is_being_written_is_told_of_once_for_each_of_its_tiles_and_once_it_rests() {
    let (scope, disk) = begun();
    let mut watch = watch(&scope, &disk);
    looks(&mut watch, &disk, 90);
    assert_eq!(each(&scope), [1; TILES], "{:?}", told(&scope));
    disk.writes.store(false, Ordering::Relaxed);
    looks(&mut watch, &disk, 90);
    assert_eq!(each(&scope), [2; TILES], "{:?}", told(&scope));
    // Written anew later, it is told of again, as often.
    disk.writes.store(true, Ordering::Relaxed);
    scope.image("a", 2);
    looks(&mut watch, &disk, 60);
    disk.writes.store(false, Ordering::Relaxed);
    looks(&mut watch, &disk, 90);
    assert_eq!(each(&scope), [4; TILES], "{:?}", told(&scope));
}

/// Whoever goes on knows that what was told of was not whole.
#[test]
fn an_image_that_rests_while_nobody_looks_is_told_of_again() {
    let (scope, disk) = begun();
    let mut before = watch(&scope, &disk);
    looks(&mut before, &disk, 9);
    drop(before);
    disk.writes.store(false, Ordering::Relaxed);
    disk.seconds.fetch_add(3600, Ordering::Relaxed);
    let mut after = watch(&scope, &disk);
    looks(&mut after, &disk, 60);
    assert_eq!(each(&scope), [2; TILES], "{:?}", told(&scope));
}
