//! Folders whose tiles a list names: every kind of list, lists that change, and processes that are killed meanwhile.

mod channels;
mod encoded;
mod growing;
mod late;
mod moved;
mod power_cuts;
mod refused;
mod registration;
mod replaced;
mod replayed;
mod shared;
mod stage;
mod twice;

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

use glam::{DVec2, DVec3, UVec2, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{Cursor, Record, RecordReader};
use saccade_core::volume::Dtype;
use saccade_ingest::ingest::{IngestOptions, run};
use saccade_ingest::watch::{Disk, ListConfig, ListWatch, Until, follow};
use saccade_ingest::{Cancel, HeldUp};

use crate::bare::{FOLDER, Worker};
use crate::scope::{VOLUME, archive, orphans, pixels, quick, seen, texture, tiff8};

const SIZE: UVec2 = UVec2::new(60, 50);
const VOXEL: DVec3 = DVec3::new(4.0, 4.0, 40.0);

fn config(list: &Path) -> ListConfig {
    ListConfig {
        list: list.to_owned(),
        name: VOLUME.to_owned(),
        voxel_nm: VOXEL,
        extent: None,
        dtype: None,
        channels: None,
        channel_in: None,
        origin: None,
        first: None,
        scale: 1.0,
        poll: Duration::from_millis(10),
        rest: Duration::from_millis(60),
        drop_after: Duration::from_millis(240),
        budget: 30,
        moved: false,
    }
}

/// One with room for what is listed later.
fn roomy(list: &Path) -> ListConfig {
    ListConfig {
        extent: Some(UVec3::new(2000, 2000, 20)),
        dtype: Some(Dtype::Uint8),
        origin: Some(DVec2::ZERO),
        first: Some(0),
        ..config(list)
    }
}

fn write(path: &Path, bytes: impl AsRef<[u8]>) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    // Whole under its name at once.
    let part = path.with_extension("part");
    fs::write(&part, bytes).unwrap();
    fs::rename(part, path).unwrap();
}

/// A folder with images and a list, and what Saccade makes of it beside.
struct Scope(tempfile::TempDir);

impl Scope {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("scope")).unwrap();
        Self(folder)
    }

    fn path(&self) -> PathBuf {
        self.0.path().join("scope")
    }

    fn kept(&self) -> PathBuf {
        self.0.path().join("kept")
    }

    fn file(&self, name: &str) -> PathBuf {
        self.path().join(name)
    }

    fn image(&self, name: &str, seed: u8) {
        write(
            &self.file(&format!("pictures/{name}.tif")),
            tiff8(SIZE, &texture(SIZE, seed)),
        );
    }

    fn watch(&self, config: ListConfig) -> ListWatch<Disk> {
        let open = || ListWatch::open(config.clone(), Disk, &self.path(), &self.kept()).unwrap();
        let mut watch = open();
        // A process that another test starts holds whatever is locked, for the moment until it is another program.
        for _ in 0..50 {
            if watch.leads() {
                break;
            }
            std::thread::sleep(Duration::from_millis(10));
            drop(watch);
            watch = open();
        }
        watch
    }

    /// Follows the list to its end, and takes in what is there.
    async fn once(&self, config: ListConfig, archive: &VisualizationArchive) -> ListWatch<Disk> {
        let mut watch = self.watch(config);
        follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
        let options = IngestOptions {
            linked: Some(watch.folder().to_owned()),
            ..quick()
        };
        run(&self.kept(), archive, &options, &(), &Cancel::new())
            .await
            .unwrap();
        watch
    }

    fn records(&self) -> Vec<Record> {
        let lines = RecordReader::new(&self.kept(), Cursor::default()).read(usize::MAX);
        let lines = lines.unwrap().into_iter();
        lines.map(|line| line.record.unwrap()).collect()
    }
}

/// What counts of a tile.
async fn shown(archive: &VisualizationArchive) -> BTreeMap<String, (u32, [f64; 6], Vec<u8>)> {
    let mut shown = BTreeMap::new();
    for (name, tile) in seen(archive).await {
        let pixels = pixels(&tile).await;
        shown.insert(name, (tile.section, tile.transform, pixels));
    }
    shown
}

/// What the volume should show, tile by tile.
#[derive(Clone, Default)]
struct Want(BTreeMap<String, (u32, [f64; 2], u8)>);

impl Want {
    fn list(&self) -> String {
        let line = |(name, (z, [x, y], _)): (&String, &(u32, [f64; 2], u8))| {
            format!("scope/{name}.tif {x} {y} {z}\n")
        };
        self.0.iter().map(line).collect()
    }

    async fn is_shown(&self, archive: &VisualizationArchive) -> bool {
        let want = self.0.iter().map(|(name, (z, [x, y], seed))| {
            let transform = [1.0, 0.0, 0.0, 1.0, *x, *y];
            (name.clone(), (*z, transform, texture(SIZE, *seed)))
        });
        shown(archive).await == want.collect()
    }

    async fn comes(&self, archive: &VisualizationArchive, what: &str) {
        for _ in 0..600 {
            if self.is_shown(archive).await {
                return;
            }
            tokio::time::sleep(Duration::from_millis(25)).await;
        }
        let there = shown(archive).await;
        let there: Vec<_> = there
            .iter()
            .map(|(name, tile)| (name, tile.0, tile.1))
            .collect();
        panic!("{what} does not come: {there:?}");
    }
}

/// Follows a list and takes its tiles in, until it is dropped.
struct Following(Cancel);

impl Drop for Following {
    fn drop(&mut self) {
        self.0.cancel();
    }
}

impl Following {
    async fn start(scope: &Scope, config: ListConfig, archive: &VisualizationArchive) -> Self {
        let cancel = Cancel::new();
        let mut watch = scope.watch(config);
        let ends = cancel.clone();
        let begin = move || {
            follow(&mut watch, Until::Known, false, &ends).unwrap();
            watch
        };
        let mut watch = tokio::task::spawn_blocking(begin).await.unwrap();
        let options = IngestOptions {
            linked: Some(watch.folder().to_owned()),
            once: false,
            patience: 100_000,
            ..quick()
        };
        let ends = cancel.clone();
        tokio::task::spawn_blocking(move || follow(&mut watch, Until::End, false, &ends).unwrap());
        let (kept, to, ends) = (scope.kept(), archive.clone(), cancel.clone());
        tokio::spawn(async move { run(&kept, &to, &options, &(), &ends).await.unwrap() });
        while archive.catalog().volume(VOLUME).await.is_err() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        Self(cancel)
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_list_that_changes_is_followed() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    let mut want = Want::default();
    let archive = archive(&scope.0.path().join("archive")).await;
    scope.image("a", 1);
    want.0.insert("a".to_owned(), (0, [0.0, 0.0], 1));
    write(&list, want.list());
    let _following = Following::start(&scope, roomy(&list), &archive).await;
    want.comes(&archive, "the first").await;

    // Tiles that are listed before their image is there, or half of it.
    let ahead = want.clone();
    want.0.insert("b".to_owned(), (0, [50.0, 0.5], 2));
    want.0.insert("c".to_owned(), (1, [3.0, 4.0], 3));
    write(&list, want.list());
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert!(ahead.is_shown(&archive).await, "nothing but what is there");
    let whole = tiff8(SIZE, &texture(SIZE, 2));
    let b = scope.file("pictures/deep/b.tif");
    fs::create_dir_all(b.parent().unwrap()).unwrap();
    for part in [5, 300, whole.len()] {
        assert!(!want.is_shown(&archive).await);
        fs::write(&b, &whole[..part]).unwrap();
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    scope.image("c", 3);
    want.comes(&archive, "what is listed ahead of its image")
        .await;

    // An image that comes before its line.
    scope.image("d", 4);
    tokio::time::sleep(Duration::from_millis(100)).await;
    want.0.insert("d".to_owned(), (1, [60.0, 4.0], 4));
    write(&list, want.list());
    want.comes(&archive, "a new line").await;

    // One moves, one goes to another section, one goes.
    want.0.get_mut("a").unwrap().1 = [7.25, 2.0];
    want.0.get_mut("c").unwrap().0 = 2;
    want.0.remove("d");
    write(&list, want.list());
    want.comes(&archive, "what moved and what went").await;
    let told = scope.records();
    let count = |is: fn(&Record) -> bool| told.iter().filter(|record| is(record)).count();
    assert_eq!(count(|r| matches!(r, Record::Transform(_))), 1);
    assert_eq!(count(|r| matches!(r, Record::Delete(_))), 1);
    // Five for new tiles and the section of one; a file that grew may be told of more often.
    assert!((5..=8).contains(&count(|r| matches!(r, Record::Tile(_)))));

    // Nothing is taken out because a list is about to be written, is gone, or makes no sense.
    for half in [Some(""), Some("scope/a.tif 0"), None] {
        match half {
            Some(half) => fs::write(&list, half).unwrap(),
            None => fs::remove_file(&list).unwrap(),
        }
        tokio::time::sleep(Duration::from_millis(400)).await;
        assert!(want.is_shown(&archive).await, "{half:?}");
    }

    // One is imaged again, and what went comes back.
    scope.image("a", 9);
    want.0.get_mut("a").unwrap().2 = 9;
    want.0.insert("d".to_owned(), (3, [1.0, 1.0], 4));
    write(&list, want.list());
    want.comes(&archive, "what is imaged again, and what comes back")
        .await;
    let quarantined = archive.catalog().quarantined(VOLUME).await.unwrap();
    assert_eq!(quarantined, []);
}

/// Who writes a list anew may rest in the middle of it.
#[tokio::test]
async fn half_a_list_that_rests_takes_nothing_out() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    for (seed, name) in (0..).zip(["a", "b", "c"]) {
        scope.image(name, seed);
    }
    let whole = "a.tif 0 0 0\nb.tif 50 0 0\nc.tif 0 50 0\n";
    write(&list, whole);
    let patient = || ListConfig {
        drop_after: Duration::from_secs(2),
        ..roomy(&list)
    };
    let archive = archive(&scope.0.path().join("archive")).await;
    scope.once(patient(), &archive).await;
    let told = scope.records().len();
    let held_up = HeldUp::default();
    let mut watch = scope.watch(patient()).telling(held_up.clone());
    let cancel = Cancel::new();
    let (ends, _ends_with_this) = (cancel.clone(), Following(cancel.clone()));
    let following =
        tokio::task::spawn_blocking(move || follow(&mut watch, Until::End, false, &ends));
    fs::write(&list, "a.tif 0 0 0\nb.tif 57 0 0\n").unwrap();
    // Many times as long as it takes to read one that is whole.
    tokio::time::sleep(Duration::from_millis(1000)).await;
    assert_eq!(scope.records().len(), told, "{:?}", scope.records());
    let why = held_up.now();
    assert!(
        why.len() == 1 && why[0].why.contains("names 1 tiles no more"),
        "{why:?}"
    );
    assert!(
        why[0].why.contains("\"c\"") && why[0].why.contains("2 s"),
        "{why:?}"
    );
    fs::write(&list, whole).unwrap();
    tokio::time::sleep(Duration::from_millis(1500)).await;
    assert_eq!(scope.records().len(), told, "nothing is told again");
    assert_eq!(held_up.now(), []);
    // One that stays so is whole.
    fs::write(&list, "a.tif 0 0 0\nb.tif 57 0 0\n").unwrap();
    tokio::time::sleep(Duration::from_millis(3500)).await;
    cancel.cancel();
    following.await.unwrap().unwrap();
    let more = scope.records().split_off(told);
    assert!(
        matches!(&more[..], [Record::Transform(_), Record::Delete(gone)] if gone.tile == "c"),
        "{more:?}"
    );
}

/// What lay outside of the volume was not taken in, or stayed where it was.
#[tokio::test]
async fn a_list_that_is_mended_leaves_nothing_set_aside() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    scope.image("a", 1);
    scope.image("b", 2);
    let set_aside = async || archive.catalog().quarantined(VOLUME).await.unwrap();
    let mut want = Want::default();
    want.0.insert("a".to_owned(), (0, [0.0, 0.0], 1));
    want.0.insert("b".to_owned(), (0, [5e5, 0.0], 2));
    write(&list, want.list());
    scope.once(roomy(&list), &archive).await;
    assert_eq!(set_aside().await.len(), 1);
    want.0.get_mut("b").unwrap().1 = [50.0, 0.0];
    write(&list, want.list());
    scope.once(roomy(&list), &archive).await;
    assert!(want.is_shown(&archive).await, "one that was never inside");
    assert_eq!(set_aside().await, []);

    want.0.get_mut("a").unwrap().1 = [-7e5, 0.0];
    write(&list, want.list());
    scope.once(roomy(&list), &archive).await;
    let entry = set_aside().await.remove(0);
    assert_eq!(entry.tile.as_deref(), Some("a"));
    want.0.get_mut("a").unwrap().1 = [3.0, 4.0];
    write(&list, want.list());
    scope.once(roomy(&list), &archive).await;
    assert!(want.is_shown(&archive).await, "one that was moved out");
    assert_eq!(set_aside().await, []);
}

/// A disk that is taken away and put back shows the same files.
#[tokio::test]
async fn an_image_that_was_away_while_it_was_to_be_read_is_taken_in_once_it_is_back() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    let mut want = Want::default();
    for (seed, name) in (1..).zip(["a", "b"]) {
        scope.image(name, seed);
        want.0
            .insert(name.to_owned(), (0, [f64::from(seed), 0.0], seed));
    }
    write(&list, want.list());
    let mut watch = scope.watch(roomy(&list));
    follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
    drop(watch);
    let (image, away) = (scope.file("pictures/b.tif"), scope.0.path().join("b.tif"));
    fs::rename(&image, &away).unwrap();
    scope.once(roomy(&list), &archive).await;
    let set_aside = async || archive.catalog().quarantined(VOLUME).await.unwrap().len();
    assert_eq!((seen(&archive).await.len(), set_aside().await), (1, 1));
    let told = scope.records().len();
    fs::rename(&away, &image).unwrap();
    scope.once(roomy(&list), &archive).await;
    assert_eq!(scope.records().len(), told, "it is the same file");
    assert!(want.is_shown(&archive).await);
    assert_eq!(set_aside().await, 0);
}

/// Follows a list and is killed, again and again, while the list changes: in the end all is as the list has it, and
/// what did not change was not told of again.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_is_killed_goes_on() {
    const NAME: &str = "lists::who_is_killed_goes_on";
    if let Some(folder) = std::env::var_os(FOLDER) {
        return child(Path::new(&folder)).await;
    }
    let scope = Scope::new();
    let list = scope.file("list.txt");
    let mut want = Want::default();
    let add = |want: &mut Want, n: u32| {
        let name = format!("t{n:03}");
        let seed = u8::try_from(n % 200).unwrap();
        scope.image(&name, seed);
        let place = [f64::from(n % 30) * 50.0, f64::from(n % 7) * 9.5];
        want.0.insert(name, (n / 20, place, seed));
    };
    add(&mut want, 0);
    write(&list, want.list());
    let mut worker = Worker::start(NAME, scope.0.path());
    worker.begins();
    let (mut moved, mut dropped) = (0, 0);
    for death in 0..10_u32 {
        for n in 0..6 {
            add(&mut want, 1 + death * 6 + n);
            write(&list, want.list());
            std::thread::sleep(Duration::from_millis(u64::from(death * 13 % 40)));
        }
        let name = format!("t{:03}", death * 5);
        if death % 3 == 1 && want.0.remove(&name).is_some() {
            dropped += 1;
        } else if let Some((_, place, _)) = want.0.get_mut(&name) {
            place[1] += 30.0;
            moved += 1;
        }
        write(&list, want.list());
        std::thread::sleep(Duration::from_millis(u64::from(death * 37 % 150)));
        worker.kill();
        worker = Worker::start(NAME, scope.0.path());
    }
    let archive = archive(&scope.0.path().join("archive")).await;
    let all = want.comes(&archive, "what the list has");
    tokio::time::timeout(Duration::from_secs(100), all)
        .await
        .unwrap();
    drop(worker);
    let (mut tiles, mut others) = (BTreeMap::new(), 0);
    for record in scope.records() {
        match record {
            Record::Tile(tile) => *tiles.entry(tile.tile).or_insert(0) += 1,
            Record::Transform(_) | Record::Delete(_) => others += 1,
        }
    }
    assert!(
        others <= moved + dropped,
        "{others} of {moved} and {dropped}"
    );
    // One that was told of just before a kill may be told of again.
    let again: u32 = tiles.values().map(|times| times - 1).sum();
    assert!(again <= 10, "{tiles:?}");
    let quarantined = archive.catalog().quarantined(VOLUME).await.unwrap();
    assert_eq!(quarantined, []);
    assert!(orphans(&archive).await.is_empty());
}

async fn child(folder: &Path) {
    let archive = archive(&folder.join("archive")).await;
    let (scope, kept) = (folder.join("scope"), folder.join("kept"));
    let config = roomy(&scope.join("list.txt"));
    let mut watch = ListWatch::open(config, Disk, &scope, &kept).unwrap();
    std::io::stdout().write_all(b"\nat work\n").unwrap();
    let cancel = Cancel::new();
    follow(&mut watch, Until::Known, false, &cancel).unwrap();
    let linked = Some(watch.folder().to_owned());
    let looks = tokio::task::spawn_blocking(move || follow(&mut watch, Until::End, false, &cancel));
    let options = IngestOptions {
        linked,
        once: false,
        patience: 100_000,
        attempts: u32::MAX,
        lease: Duration::from_secs(600),
        keep_retired: Duration::ZERO,
        ..quick()
    };
    run(&kept, &archive, &options, &(), &Cancel::new())
        .await
        .unwrap();
    looks.await.unwrap().unwrap();
}
