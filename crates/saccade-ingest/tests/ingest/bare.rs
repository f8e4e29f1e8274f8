//! Bare folders, watched and ingested at once: growing, half written, on a full disk, by processes that are
//! killed, by several at a time.

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use glam::{DVec2, DVec3, UVec2, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{AcquisitionInfo, Cursor, Record, RecordReader};
use saccade_archive::catalog::Catalog;
use saccade_archive::storage::{FaultyStorage, MemoryStorage, Storage};
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{IngestOptions, run};
use saccade_ingest::watch::{self, Disk, Watch, WatchConfig};

use crate::scope::{
    Diary, VOLUME, archive, orphans, pixels, quick, seen, texture, tiff_rgb, tiff8, tiff16,
};

const SIZE: UVec2 = UVec2::new(140, 130);
pub(crate) const FOLDER: &str = "SACCADE_TEST_BARE_FOLDER";

fn config() -> WatchConfig {
    WatchConfig {
        pattern: "s{section}/r{row}_c{column}.tif".parse().unwrap(),
        info: AcquisitionInfo::new(
            VOLUME,
            UVec3::new(2000, 2000, 20),
            DVec3::new(4.0, 4.0, 40.0),
        ),
        pitch: DVec2::new(130.0, 120.0),
        scale: 1.0,
        first: 0,
        poll: Duration::from_millis(20),
        budget: 40,
        moved: false,
    }
}

/// A microscope that writes files and no records.
struct Bare {
    folder: tempfile::TempDir,
    /// What each tile should show in the end.
    images: BTreeMap<String, u8>,
}

impl Bare {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("scope")).unwrap();
        let images = BTreeMap::new();
        Self { folder, images }
    }

    fn scope(&self) -> PathBuf {
        self.folder.path().join("scope")
    }

    fn kept(&self) -> PathBuf {
        self.folder.path().join("kept")
    }

    fn file(&mut self, n: u64, seed: u8) -> (PathBuf, Vec<u8>) {
        let (section, row, column) = (n / 9, n / 3 % 3, n % 3);
        let name = format!("s{section}_r{row}_c{column}");
        self.images.insert(name, seed);
        let path = self
            .scope()
            .join(format!("s{section}/r{row}_c{column}.tif"));
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        (path, tiff8(SIZE, &texture(SIZE, seed)))
    }

    /// A whole file under its name at once, in the place of an earlier one if there is one.
    fn put(&mut self, n: u64, seed: u8) {
        let (path, bytes) = self.file(n, seed);
        let part = path.with_extension("part");
        fs::write(&part, bytes).unwrap();
        fs::rename(part, path).unwrap();
    }

    fn watch(&self) -> Watch<Disk> {
        Watch::open(config(), Disk, &self.scope(), &self.kept()).unwrap()
    }

    /// Whether the archive has all that there is to be, as it should be.
    async fn has_all(&self, archive: &VisualizationArchive) -> bool {
        let tiles = seen(archive).await;
        if !tiles.keys().eq(self.images.keys()) {
            return false;
        }
        for (name, seed) in &self.images {
            if pixels(&tiles[name]).await != texture(SIZE, *seed) {
                return false;
            }
        }
        true
    }

    /// Every file was told of once, and once more when it was replaced; nothing is set aside or left.
    async fn is_clean(&self, archive: &VisualizationArchive, replaced: usize) {
        let lines = RecordReader::new(&self.kept(), Cursor::default()).read(99_999);
        let mut told: BTreeMap<String, usize> = BTreeMap::new();
        for line in lines.unwrap() {
            let Ok(Record::Tile(tile)) = line.record else {
                panic!("{line:?}")
            };
            *told.entry(tile.tile).or_default() += 1;
        }
        assert!(told.keys().eq(self.images.keys()));
        let twice = told.values().map(|times| times - 1).sum::<usize>();
        assert!(twice <= replaced, "{twice} told again, {replaced} replaced");
        let set_aside = archive.catalog().quarantined(VOLUME).await.unwrap();
        assert_eq!(set_aside, []);
        assert!(orphans(archive).await.is_empty());
    }
}

/// Ends what looks on a thread of its own, also when a test fails.
struct Ended(Cancel);

impl Drop for Ended {
    fn drop(&mut self) {
        self.0.cancel();
    }
}

/// Watches and ingests until all is there.
async fn follow(
    bare: &Bare,
    archive: &VisualizationArchive,
    diary: &Diary,
    wait: impl Future<Output = ()>,
) {
    let cancel = Cancel::new();
    let _ended = Ended(cancel.clone());
    let mut watch = bare.watch();
    let options = IngestOptions {
        linked: Some(watch.folder().to_owned()),
        once: false,
        patience: 100_000,
        keep_retired: Duration::ZERO,
        ..quick()
    };
    let looks = tokio::task::spawn_blocking({
        let cancel = cancel.clone();
        move || watch::run(&mut watch, false, &cancel)
    });
    let kept = bare.kept();
    let work = run(&kept, archive, &options, diary, &cancel);
    let end = async {
        wait.await;
        // Pyramids that were replaced are deleted by the next look.
        tokio::time::sleep(Duration::from_millis(300)).await;
        cancel.cancel();
    };
    let both = async { tokio::join!(work, end) };
    let both = tokio::time::timeout(Duration::from_secs(100), both).await;
    both.expect("all comes in time").0.unwrap();
    looks.await.unwrap().unwrap();
}

async fn until_all_is_there(bare: &Bare, archive: &VisualizationArchive) {
    loop {
        // The volume is made by ingest.
        let there = archive.catalog().volume(VOLUME).await.is_ok();
        if there && bare.has_all(archive).await {
            return;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

/// Files come while the folder is watched: whole ones, some in two halves under their final name, some twice.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_growing_folder_is_followed() {
    let mut bare = Bare::new();
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path()).await;
    let mut halves = Vec::new();
    for n in 0..60 {
        if n % 5 == 2 {
            let (path, bytes) = bare.file(n, (n % 200) as u8);
            halves.push((path, bytes));
        } else {
            bare.images.insert(
                format!("s{}_r{}_c{}", n / 9, n / 3 % 3, n % 3),
                (n % 200) as u8,
            );
        }
    }
    let mut writer = Bare {
        folder: tempfile::tempdir().unwrap(),
        images: BTreeMap::new(),
    };
    // Writes where `bare` looks.
    std::os::unix::fs::symlink(bare.scope(), writer.folder.path().join("scope")).unwrap();
    let write = std::thread::spawn(move || {
        for (n, (path, bytes)) in (0..60).zip(halves.iter().cycle()) {
            if n % 5 != 2 {
                writer.put(n, if n % 7 == 0 { 250 } else { (n % 200) as u8 });
            }
            if n < halves.len() as u64 {
                // Without its head, with half its pixels, whole.
                let head = if n % 2 == 0 { 3 } else { bytes.len() / 2 };
                fs::write(path, &bytes[..head]).unwrap();
            }
            std::thread::sleep(Duration::from_millis(4));
        }
        for (path, bytes) in halves {
            fs::write(path, bytes).unwrap();
            std::thread::sleep(Duration::from_millis(4));
        }
        for n in (0..60).filter(|n| n % 5 != 2 && n % 7 == 0) {
            writer.put(n, (n % 200) as u8);
        }
    });
    follow(
        &bare,
        &archive,
        &Diary::default(),
        until_all_is_there(&bare, &archive),
    )
    .await;
    write.join().unwrap();
    // A file that grew has another length, and may be told of again.
    bare.is_clean(&archive, 60).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_full_disk_is_waited_out() {
    let mut bare = Bare::new();
    for n in 0..30 {
        bare.put(n, u8::try_from(n).unwrap());
    }
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("catalog.sqlite");
    let catalog = Catalog::create(&file);
    let storage = FaultyStorage::new(Arc::new(MemoryStorage::new()));
    storage.set_space(Some(20_000));
    let shared: Arc<dyn Storage> = Arc::new(storage.clone());
    let archive = VisualizationArchive::from_parts(catalog.await.unwrap(), shared);
    let diary = Diary::default();
    follow(&bare, &archive, &diary, async {
        while !diary.notices().iter().any(|n| n.contains("no space")) {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
        assert!(seen(&archive).await.len() < 30, "it was not full");
        storage.set_space(None);
        until_all_is_there(&bare, &archive).await;
    })
    .await;
    bare.is_clean(&archive, 0).await;
}

/// Whoever wrote the images knows neither of the records nor of where they are kept.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_said_of_an_image_is_of_the_folder_that_people_know() {
    let mut bare = Bare::new();
    let put = |bare: &mut Bare, n, bytes: &[u8]| {
        let (path, _) = bare.file(n, 0);
        let part = path.with_extension("part");
        fs::write(&part, bytes).unwrap();
        fs::rename(part, path).unwrap();
    };
    let whole = tiff8(SIZE, &texture(SIZE, 0));
    put(&mut bare, 0, &whole[..whole.len() / 2]);
    put(&mut bare, 1, &tiff_rgb(SIZE, [10, 200, 30]));
    put(&mut bare, 2, &tiff16(SIZE));
    bare.put(3, 7);
    let gone = bare.file(4, 0).0;
    bare.put(4, 0);
    let far = bare.scope().join("s99/r0_c0.tif");
    fs::create_dir(far.parent().unwrap()).unwrap();
    fs::write(&far, &whole).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path()).await;
    let diary = Diary::default();
    let ingest = async |bare: &Bare, remove: bool| {
        let mut watch = bare.watch();
        watch::run(&mut watch, true, &Cancel::new()).unwrap();
        if remove {
            fs::remove_file(&gone).unwrap();
        }
        let options = IngestOptions {
            linked: Some(watch.folder().to_owned()),
            ..quick()
        };
        let (kept, cancel) = (bare.kept(), Cancel::new());
        let done = run(&kept, &archive, &options, &diary, &cancel).await;
        done.unwrap()
    };
    let done = ingest(&bare, true).await;
    assert_eq!((done.tiles, done.quarantined), (1, 5));
    let set_aside = archive.catalog().quarantined(VOLUME).await.unwrap();
    let of = |file: &str| {
        let one = set_aside.iter().find(|one| one.file == file);
        &*one
            .unwrap_or_else(|| panic!("{file}: {set_aside:?}"))
            .reason
    };
    let (scope, gone) = (bare.scope(), "the acquisition's folder/s0/r1_c1.tif");
    for (file, parts) in [
        ("s0/r0_c0.tif", &["rename it over this file"][..]),
        ("s0/r0_c1.tif", &["colour"]),
        ("s0/r0_c2.tif", &["16 bits", "--bits"]),
        ("s0/r1_c1.tif", &[gone, "rename it over this file"]),
        ("s99/r0_c0.tif", &["outside", "--first", "--extent"]),
    ] {
        for part in parts {
            assert!(of(file).contains(part), "{part:?} is not in: {}", of(file));
        }
    }
    let waited = "s0/r0_c0.tif (tile s0_r0_c0) is waited for";
    let notices = diary.notices();
    assert!(notices.iter().any(|n| n.starts_with(waited)), "{notices:?}");
    let kept = bare.kept();
    let reasons = || set_aside.iter().map(|one| &one.reason);
    for word in ["files/", "record", "volume.json", kept.to_str().unwrap()] {
        for told in notices.iter().chain(reasons()) {
            assert!(!told.contains(word), "{word:?} is in: {told}");
        }
    }
    // Those who look from elsewhere are told the reasons.
    let machines = scope.to_str().unwrap();
    assert!(
        reasons().all(|told| !told.contains(machines)),
        "{set_aside:?}"
    );
    // As it was told to.
    put(&mut bare, 0, &whole);
    assert_eq!(ingest(&bare, false).await.tiles, 1);
}

/// Two processes watch the same folder and ingest it into one archive; now one is killed, now the other, while
/// files come and are replaced. Who is left goes on.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_watchers_that_are_killed_tell_all_once() {
    const NAME: &str = "bare::two_watchers_that_are_killed_tell_all_once";
    if let Some(folder) = std::env::var_os(FOLDER) {
        return child(Path::new(&folder)).await;
    }
    let mut bare = Bare::new();
    let place = bare.folder.path().to_owned();
    let mut workers: Vec<_> = (0..2).map(|_| Worker::start(NAME, &place)).collect();
    for worker in &mut workers {
        worker.begins();
    }
    let (mut n, mut replaced) = (0, 0);
    for death in 0..12 {
        for _ in 0..9 {
            bare.put(n, (n % 200) as u8);
            n += 1;
            std::thread::sleep(Duration::from_millis(3));
        }
        if death % 3 == 2 {
            bare.put(n - 4, 251);
            replaced += 1;
        }
        std::thread::sleep(Duration::from_millis(17 * death % 60));
        let unlucky = (death * 7 / 3 % 2) as usize;
        workers[unlucky].kill();
        workers[unlucky] = Worker::start(NAME, &place);
    }
    let archive = archive(&place.join("archive")).await;
    let all = until_all_is_there(&bare, &archive);
    let all = tokio::time::timeout(Duration::from_secs(100), all).await;
    all.expect("who is left goes on");
    // One that was replaced before it was read is there already, and told of again once it rests.
    tokio::time::sleep(Duration::from_secs(4)).await;
    drop(workers);
    // What they left is whole, and there is nothing to be done.
    let mut watch = bare.watch();
    assert!(watch.leads(), "the dead keep nothing");
    watch::run(&mut watch, true, &Cancel::new()).unwrap();
    let last = IngestOptions {
        linked: Some(watch.folder().to_owned()),
        attempts: u32::MAX,
        keep_retired: Duration::ZERO,
        ..quick()
    };
    let done = run(&bare.kept(), &archive, &last, &(), &Cancel::new()).await;
    assert_eq!(done.unwrap().tiles, 0);
    assert!(bare.has_all(&archive).await);
    bare.is_clean(&archive, replaced).await;
}

async fn child(folder: &Path) {
    let archive = archive(&folder.join("archive")).await;
    let (scope, kept) = (folder.join("scope"), folder.join("kept"));
    let mut watch = Watch::open(config(), Disk, &scope, &kept).unwrap();
    let cancel = Cancel::new();
    std::io::stdout().write_all(b"\nat work\n").unwrap();
    let linked = Some(watch.folder().to_owned());
    let looks = tokio::task::spawn_blocking(move || watch::run(&mut watch, false, &cancel));
    let options = IngestOptions {
        linked,
        once: false,
        patience: 100_000,
        attempts: u32::MAX,
        // What a killed one had need not be waited for: it was of this machine.
        lease: Duration::from_secs(600),
        ..quick()
    };
    run(&kept, &archive, &options, &(), &Cancel::new())
        .await
        .unwrap();
    looks.await.unwrap().unwrap();
}

/// A child process, that must not end on its own.
pub(crate) struct Worker {
    child: Child,
    lines: std::io::Lines<BufReader<std::process::ChildStdout>>,
}

impl Worker {
    pub(crate) fn start(test: &str, folder: &Path) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command
            .args(["--exact", test, "--nocapture"])
            .env(FOLDER, folder)
            .stdout(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Self { child, lines }
    }

    pub(crate) fn begins(&mut self) {
        let mut lines = self.lines.by_ref().map(Result::unwrap);
        assert!(lines.any(|line| line == "at work"), "it ended");
    }

    pub(crate) fn kill(&mut self) {
        self.child.kill().unwrap();
        let status = self.child.wait().unwrap();
        assert_eq!(status.signal(), Some(9), "it ended on its own: {status}");
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        drop(self.child.kill());
        drop(self.child.wait());
    }
}
