//! Power cuts on a simulated disk, which may lose any part of what was not synced.
//!
//! Each history is an ingest whose power is cut at a random step; many states that this may leave
//! are looked at, and with one of them it goes on, until it comes to its end. The storage's own code
//! runs over the disk, and ingest's own order of storage and catalog; a commit of the catalog, which
//! is SQLite's matter, counts as kept whole.
//!
//! Times and identities come from the seed, too: time passes as much as is drawn with each write, and as long as leases
//! last with each power cut. So a seed says all that there is to be seen.
//!
//! `SACCADE_CRASH_SEED=SEED` repeats a run, `SACCADE_CRASH_SEED=SEED:HISTORY` one of its histories.

use std::collections::{BTreeMap, BTreeSet};
use std::hash::{BuildHasher, Hash};
use std::io::Write;
use std::path::Path;
use std::pin::pin;
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use futures::FutureExt as _;
use futures::future::{BoxFuture, Either, select};
use glam::UVec2;
use saccade_archive::catalog::{Catalog, Retired};
use saccade_archive::clock::{Clock as _, PretendClock};
use saccade_archive::randomness::{Randomness, SeededRandomness, SystemRandomness};
use saccade_archive::storage::{
    Crash, DirEntry, Disk, Entry, LocalStorage, Metadata, OpenFile, SimulatedDisk, Storage,
    StorageError,
};
use saccade_archive::{ArchiveLocation, IDENTITY, VisualizationArchive, read_identity};
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{IngestOptions, run};

use crate::scope::{Scope, VOLUME, at, move_record, orphans, quick, seen, tile_record};

const SIZE: UVec2 = UVec2::new(40, 30);
const HISTORIES: u64 = 40;
/// States looked at after each power cut.
const STATES: u64 = 120;
/// What one run of the test looks at, at least.
const AT_LEAST: usize = 10_000;
const ROOT: &str = "archive";
/// Longer than any life.
const LEASE: Duration = Duration::from_secs(3600);
/// What a write takes at most \[ms\].
const LONGEST_WRITE: u64 = 20;

#[tokio::test]
async fn no_power_cut_loses_what_was_acknowledged() {
    let (seed, only) = asked_for();
    let stderr = || std::io::stderr();
    let said = format!("\nsimulated power cuts, SACCADE_CRASH_SEED={seed} repeats them\n");
    stderr().write_all(said.as_bytes()).unwrap();
    let scene = Scene::new().await;
    let mut found = Found::default();
    for history in 0..HISTORIES {
        if only.is_none_or(|only| only == history) {
            let lived = scene.history(seed, history, &sound, &mut found).await;
            lived.unwrap_or_else(|wrong| {
                panic!(
                    "{wrong}\nrepeat it: SACCADE_CRASH_SEED={seed}:{history} \
                     cargo test -p saccade-ingest crashes"
                )
            });
        }
    }
    let said = format!(
        "{} states after {} power cuts, {} of them different, {} with acknowledged tiles; all in one number: {:016x}\n",
        found.states,
        found.cuts,
        found.different.len(),
        found.with_tiles,
        found.digest
    );
    stderr().write_all(said.as_bytes()).unwrap();
    if only.is_none() {
        assert!(found.states >= AT_LEAST, "{}", found.states);
        assert!(found.with_tiles > AT_LEAST / 4, "{}", found.with_tiles);
        assert!(found.different.len() > 500, "{}", found.different.len());
    }
}

/// A history that cannot be repeated helps nobody who looks for what went wrong in it.
#[tokio::test]
async fn a_seed_repeats_everything_that_is_seen() {
    const FEW: u64 = 4;
    let scene = Scene::new().await;
    let seen = async |seed| {
        let mut found = Found::default();
        for history in 0..FEW {
            let lived = scene.history(seed, history, &sound, &mut found).await;
            lived.unwrap_or_else(|wrong| panic!("{wrong}\nseed {seed}, history {history}"));
        }
        assert!(found.cuts > 4 && found.retired > 0, "{found:?}");
        found
    };
    let once = seen(5).await;
    assert_eq!(once, seen(5).await);
    assert_ne!(once.digest, seen(6).await.digest);
}

/// A suite that cannot fail proves nothing.
#[tokio::test]
async fn storages_that_leave_a_step_out_are_found_out() {
    let scene = Scene::new().await;
    let lax: [(&str, &Open); 4] = [
        ("files are not synced", &|disk, randomness| {
            let lax = Lax {
                disk,
                files: false,
                folders: true,
            };
            on(lax, randomness)
        }),
        ("folders are not synced", &|disk, randomness| {
            let lax = Lax {
                disk,
                files: true,
                folders: false,
            };
            on(lax, randomness)
        }),
        (
            "files are written under their own names",
            &|disk, randomness| on(Naming { disk }, randomness),
        ),
        (
            "writes are acknowledged before they are done",
            &|disk, randomness| {
                let inner = sound(disk, randomness)?;
                Ok(Arc::new(Hasty {
                    inner,
                    promised: Mutex::default(),
                }))
            },
        ),
    ];
    for (what, open) in lax {
        let mut found = Found::default();
        let mut wrong = None;
        for history in 0..HISTORIES {
            wrong = scene.history(1, history, open, &mut found).await.err();
            if wrong.is_some() {
                break;
            }
        }
        assert!(wrong.is_some(), "nobody noticed that {what}");
    }
}

/// The seed that is asked for, or another each time.
pub(crate) fn seed() -> u64 {
    asked_for().0
}

/// Seed, and the one history to repeat.
fn asked_for() -> (u64, Option<u64>) {
    let number = |text: &str| {
        text.parse()
            .expect("SACCADE_CRASH_SEED is SEED or SEED:HISTORY")
    };
    match std::env::var("SACCADE_CRASH_SEED") {
        Err(_) => (SystemRandomness.next() % 1_000_000_000, None),
        Ok(text) => match text.split_once(':') {
            None => (number(&text), None),
            Some((seed, history)) => (number(seed), Some(number(history))),
        },
    }
}

type Draws = Arc<dyn Randomness>;

type Open = dyn Fn(SimulatedDisk, Draws) -> Result<Arc<dyn Storage>, StorageError>;

fn on(disk: impl Disk + 'static, randomness: Draws) -> Result<Arc<dyn Storage>, StorageError> {
    let storage = LocalStorage::on(Arc::new(disk), ROOT)?;
    Ok(Arc::new(storage.with_randomness(randomness)))
}

fn sound(disk: SimulatedDisk, randomness: Draws) -> Result<Arc<dyn Storage>, StorageError> {
    on(disk, randomness)
}

/// What was looked at.
#[derive(Debug, Default, PartialEq)]
struct Found {
    states: usize,
    cuts: usize,
    /// States in which the catalog named something.
    with_tiles: usize,
    /// Trees of files.
    different: BTreeSet<u64>,
    /// Pyramids that were found on the list of those to be deleted.
    retired: usize,
    /// All that was seen.
    digest: u64,
}

impl Found {
    fn note(&mut self, seen: impl Hash) {
        self.digest = FIXED.hash_one((self.digest, seen));
    }
}

/// What is around a history, all of it from the seed.
struct World {
    clock: Arc<PretendClock>,
    randomness: Draws,
    /// What messages call the archive.
    location: ArchiveLocation,
}

/// An acquisition, and what becomes of it when nothing happens.
struct Scene {
    scope: Scope,
    options: IngestOptions,
    /// Of every name that a pyramid may have.
    pyramids: BTreeMap<String, Bytes>,
    /// What there is in the end.
    tiles: BTreeMap<String, String>,
}

impl Scene {
    async fn new() -> Self {
        let scope = Scope::new();
        for n in 0..6u8 {
            scope.tile(&format!("t{n}"), u32::from(n % 3), SIZE, n);
        }
        // Another image for a tile, whose old pyramid goes; and a tile that moves.
        scope.say(&tile_record("t1", 1, SIZE));
        scope.say(&move_record("t2", at(3.0, 4.0)));
        scope.tile("t6", 4, SIZE, 6);
        let options = IngestOptions {
            // One after another: the same steps in every run.
            batch: 1,
            workers: 1,
            keep_retired: Duration::ZERO,
            lease: LEASE,
            // No image is to blame for a power cut, however often it is the one in hand.
            attempts: u32::MAX,
            ..quick()
        };
        let folder = tempfile::tempdir().unwrap();
        let archive = VisualizationArchive::create(folder.path()).await.unwrap();
        let keep = IngestOptions {
            keep_retired: Duration::from_secs(3600),
            ..options.clone()
        };
        let summary = run(scope.path(), &archive, &keep, &(), &Cancel::new()).await;
        assert_eq!(summary.unwrap().tiles, 8);
        let mut pyramids = BTreeMap::new();
        for name in archive.storage().list("tiles/").await.unwrap() {
            let bytes = archive.storage().read(&name, None).await.unwrap();
            pyramids.insert(name, bytes);
        }
        assert_eq!(pyramids.len(), 8);
        let tiles = seen(&archive).await.into_iter();
        Self {
            scope,
            options,
            pyramids,
            tiles: tiles.map(|(name, tile)| (name, tile.pyramid)).collect(),
        }
    }

    /// Lives one history to its end, or says what went wrong.
    async fn history(
        &self,
        seed: u64,
        history: u64,
        open: &Open,
        found: &mut Found,
    ) -> Result<(), String> {
        let seed = seed.wrapping_mul(1_000_003).wrapping_add(history);
        let mut chance = Chance(seed);
        let folder = tempfile::tempdir().unwrap();
        let world = World {
            clock: Arc::default(),
            randomness: Arc::new(SeededRandomness::new(seed)),
            location: folder.path().into(),
        };
        let mut disk = SimulatedDisk::new();
        for life in 0.. {
            let path = folder.path().join("catalog.sqlite");
            let catalog = Catalog::create(path.as_path()).await;
            let catalog = catalog.map_err(|e| e.to_string())?;
            let catalog = catalog.with_clock(world.clock.clone());
            disk.cut_power_at(chance.below(if life < 6 { 45 } else { 1000 }));
            let ended = self.live(&world, &catalog, &disk, open).await;
            if let Some(ended) = ended {
                ended.map_err(|e| format!("life {life}: {e}"))?;
                disk.cut_power_at(1 << 40);
                let archive = VisualizationArchive::from_parts(
                    catalog,
                    open(disk.clone(), world.randomness.clone()).map_err(|e| e.to_string())?,
                );
                found.note((disk.tree(), world.clock.now()));
                return self.is_complete(&archive, &disk).await;
            }
            catalog.close().await;
            // The claims of the dead are free.
            world.clock.turn(2 * LEASE);
            let known = Known::of(folder.path()).await;
            found.cuts += 1;
            found.retired += known.retired.len();
            found.note((&known, disk.steps(), world.clock.now()));
            let mut next = None;
            for state in 0..STATES {
                let left = disk.after_crash(&mut Crash::new(chance.next()));
                found.states += 1;
                found.with_tiles += usize::from(!known.named.is_empty());
                let tree = FIXED.hash_one(left.tree());
                found.different.insert(tree);
                found.note(tree);
                known
                    .is_the_storages(&left)
                    .and_then(|()| self.is_whole(&known.named, &left))
                    .map_err(|e| format!("life {life}, state {state}: {e}"))?;
                next = Some(left);
            }
            disk = next.expect("some states");
        }
        Ok(())
    }

    /// Ingests until the end, or until the power is cut: then `None`.
    async fn live(
        &self,
        world: &World,
        catalog: &Catalog,
        disk: &SimulatedDisk,
        open: &Open,
    ) -> Option<Result<(), String>> {
        let work = async {
            let randomness = &world.randomness;
            let inner = open(disk.clone(), randomness.clone()).map_err(|e| e.to_string())?;
            let storage = Arc::new(Slow {
                inner,
                clock: world.clock.clone(),
                randomness: randomness.clone(),
            });
            let archive = VisualizationArchive::from_parts(catalog.clone(), storage)
                .with_randomness(randomness.clone());
            let made = archive.identify(&world.location).await;
            made.map_err(|e| format!("{e:?}"))?;
            let cancel = Cancel::new();
            let ingest = run(self.scope.path(), &archive, &self.options, &(), &cancel);
            ingest.await.map_err(|e| format!("{e:?}")).map(|_| ())
        };
        match select(pin!(disk.power_is_off()), pin!(work)).await {
            Either::Left(_) => None,
            // It may also end in the instant in which the power goes, before anybody looks.
            Either::Right((ended, off)) => match off.now_or_never() {
                Some(()) => None,
                None => Some(ended),
            },
        }
    }

    /// Every pyramid that the catalog names is there to the last byte.
    fn is_whole(&self, named: &[String], disk: &SimulatedDisk) -> Result<(), String> {
        for name in named {
            let read = disk.read(&Path::new(ROOT).join(name), None);
            match read {
                Ok(bytes) if bytes == self.pyramids[name] => {}
                Ok(bytes) => return Err(format!("{name} has {} wrong bytes", bytes.len())),
                Err(e) => return Err(format!("{name} is lost: {e}")),
            }
        }
        Ok(())
    }

    async fn is_complete(
        &self,
        archive: &VisualizationArchive,
        disk: &SimulatedDisk,
    ) -> Result<(), String> {
        let tiles = seen(archive).await.into_iter();
        let tiles: BTreeMap<_, _> = tiles.map(|(name, tile)| (name, tile.pyramid)).collect();
        if tiles != self.tiles {
            let set_aside = archive.catalog().quarantined(VOLUME).await;
            return Err(format!("not all arrived: {tiles:?}, {set_aside:?}"));
        }
        let named: Vec<_> = tiles.into_values().collect();
        self.is_whole(&named, disk)?;
        let left = orphans(archive).await;
        let incoming = disk.tree();
        let incoming: Vec<_> = incoming
            .iter()
            .filter(|n| n.contains(".incoming/"))
            .collect();
        if left.is_empty() && incoming.len() == 1 {
            Ok(())
        } else {
            Err(format!("left behind: {left:?}, {incoming:?}"))
        }
    }
}

/// Makes hashes that are the same each time.
const FIXED: std::hash::BuildHasherDefault<std::hash::DefaultHasher> =
    std::hash::BuildHasherDefault::new();

/// What a catalog says after a power cut.
#[derive(Debug, Hash)]
struct Known {
    identity: Option<String>,
    /// Pyramids that tiles name.
    named: Vec<String>,
    /// Those that are to be deleted, and since when nothing names them.
    retired: Vec<(String, SystemTime)>,
}

impl Known {
    /// That of the catalog in a folder.
    async fn of(folder: &Path) -> Self {
        let path = folder.join("catalog.sqlite");
        let catalog = Catalog::create(path.as_path()).await.unwrap();
        let mut known = Self {
            identity: catalog.identity().await.unwrap(),
            named: Vec::new(),
            retired: Vec::new(),
        };
        if catalog.volume(VOLUME).await.is_ok() {
            for z in catalog.sections(VOLUME).await.unwrap() {
                let tiles = catalog.section_tiles(VOLUME, z).await.unwrap();
                known
                    .named
                    .extend(tiles.into_iter().map(|tile| tile.pyramid));
            }
            let ever = SystemTime::UNIX_EPOCH + Duration::from_secs(1 << 32);
            let retired = catalog.retired(VOLUME, ever, 99).await.unwrap();
            let entry = |Retired { pyramid, at, .. }| (pyramid, at);
            known.retired.extend(retired.into_iter().map(entry));
        }
        catalog.close().await;
        known
    }

    /// The identity is the same in the storage, once there are tiles.
    fn is_the_storages(&self, disk: &SimulatedDisk) -> Result<(), String> {
        if self.named.is_empty() {
            return Ok(());
        }
        let read = disk.read(&Path::new(ROOT).join(IDENTITY), None);
        let read = read.map_err(|e| format!("the identity is lost: {e}"))?;
        if read_identity(&read) == self.identity && self.identity.is_some() {
            Ok(())
        } else {
            Err(format!("the identity is {read:?}, not {:?}", self.identity))
        }
    }
}

/// A small generator.
struct Chance(u64);

impl Chance {
    fn next(&mut self) -> u64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        self.0 ^ (self.0 >> 29)
    }

    fn below(&mut self, n: u64) -> u64 {
        (self.next() >> 20) % n
    }
}

/// A disk for storages that do not care: syncs that are not wanted are left out.
#[derive(Debug)]
struct Lax {
    disk: SimulatedDisk,
    files: bool,
    folders: bool,
}

struct LaxFile {
    file: Box<dyn OpenFile>,
    syncs: bool,
}

impl OpenFile for LaxFile {
    fn lock(&mut self) {
        self.file.lock();
    }
    fn write_all(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        self.file.write_all(bytes)
    }
    fn sync(&mut self) -> std::io::Result<()> {
        if self.syncs { self.file.sync() } else { Ok(()) }
    }
}

/// A disk for a storage that gives files their names before they are whole: it renames nothing, and
/// what was to be a temporary file lies under its own name from the first.
#[derive(Debug)]
struct Naming {
    disk: SimulatedDisk,
}

macro_rules! delegate_disk {
    ($kind:ty { $($own:item)* }) => {
        impl Disk for $kind {
            $($own)*
            fn remove_file(&self, path: &Path) -> std::io::Result<()> {
                self.disk.remove_file(path)
            }
            fn remove_if_unlocked(&self, path: &Path) -> std::io::Result<()> {
                self.disk.remove_if_unlocked(path)
            }
            fn create_dir(&self, path: &Path) -> std::io::Result<()> {
                self.disk.create_dir(path)
            }
            fn metadata(&self, path: &Path) -> std::io::Result<Metadata> {
                self.disk.metadata(path)
            }
            fn read_dir(&self, path: &Path) -> std::io::Result<Vec<DirEntry>> {
                self.disk.read_dir(path)
            }
            fn read(
                &self,
                path: &Path,
                range: Option<std::ops::Range<u64>>,
            ) -> std::io::Result<Bytes> {
                self.disk.read(path, range)
            }
        }
    };
}

delegate_disk!(Lax {
    fn create_new(&self, path: &Path) -> std::io::Result<Box<dyn OpenFile>> {
        let (file, syncs) = (self.disk.create_new(path)?, self.files);
        Ok(Box::new(LaxFile { file, syncs }))
    }
    fn rename(&self, from: &Path, to: &Path) -> std::io::Result<()> {
        self.disk.rename(from, to)
    }
    fn rename_new(&self, from: &Path, to: &Path) -> std::io::Result<()> {
        self.disk.rename_new(from, to)
    }
    fn sync_dir(&self, path: &Path) -> std::io::Result<()> {
        if self.folders { self.disk.sync_dir(path) } else { Ok(()) }
    }
});

delegate_disk!(Naming {
    fn create_new(&self, path: &Path) -> std::io::Result<Box<dyn OpenFile>> {
        let (file, syncs) = (self.disk.create_new(path)?, false);
        Ok(Box::new(LaxFile { file, syncs }))
    }
    fn rename(&self, from: &Path, to: &Path) -> std::io::Result<()> {
        // The name is durable, and the content is not yet.
        self.disk.rename(from, to)?;
        self.disk.sync_dir(to.parent().unwrap_or(Path::new("")))
    }
    fn rename_new(&self, from: &Path, to: &Path) -> std::io::Result<()> {
        self.disk.rename_new(from, to)?;
        self.disk.sync_dir(to.parent().unwrap_or(Path::new("")))
    }
    fn sync_dir(&self, path: &Path) -> std::io::Result<()> {
        self.disk.sync_dir(path)
    }
});

/// Takes a while for each write.
#[derive(Debug)]
struct Slow {
    inner: Arc<dyn Storage>,
    clock: Arc<PretendClock>,
    randomness: Draws,
}

impl Storage for Slow {
    fn read<'a>(
        &'a self,
        name: &'a str,
        range: Option<std::ops::Range<u64>>,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        self.inner.read(name, range)
    }

    fn write_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<(), StorageError>> {
        let millis = 1 + self.randomness.next() % LONGEST_WRITE;
        self.clock.turn(Duration::from_millis(millis));
        self.inner.write_durable(name, bytes)
    }

    fn create_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        let millis = 1 + self.randomness.next() % LONGEST_WRITE;
        self.clock.turn(Duration::from_millis(millis));
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

/// Does each write when the next one comes.
#[derive(Debug)]
struct Hasty {
    inner: Arc<dyn Storage>,
    promised: Mutex<Option<(String, Bytes)>>,
}

impl Storage for Hasty {
    fn read<'a>(
        &'a self,
        name: &'a str,
        range: Option<std::ops::Range<u64>>,
    ) -> BoxFuture<'a, Result<Bytes, StorageError>> {
        self.inner.read(name, range)
    }

    fn write_durable<'a>(
        &'a self,
        name: &'a str,
        bytes: Bytes,
    ) -> BoxFuture<'a, Result<(), StorageError>> {
        let promise = (name.to_owned(), bytes);
        let earlier = self.promised.lock().unwrap().replace(promise);
        Box::pin(async move {
            match earlier {
                Some((name, bytes)) => self.inner.write_durable(&name, bytes).await,
                None => Ok(()),
            }
        })
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
