//! Disks that fill, fail and lie.

use std::fs;
use std::sync::Arc;
use std::time::Duration;

use glam::UVec2;
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::RecordReader;
use saccade_archive::catalog::{Catalog, CatalogError};
use saccade_archive::storage::{FaultyStorage, LocalStorage, MemoryStorage, Storage, WriteFault};
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{IngestError, IngestOptions, run};

use crate::scope::{Diary, Scope, VOLUME, archive, orphans, pixels, quick, seen, texture};

const SIZE: UVec2 = UVec2::new(140, 130);
const TILES: u8 = 6;

struct Bench {
    scope: Scope,
    storage: FaultyStorage,
    archive: VisualizationArchive,
    _folder: tempfile::TempDir,
}

impl Bench {
    async fn new() -> Self {
        let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
        for n in 0..TILES {
            scope.tile(&format!("t{n}"), u32::from(n), SIZE, n);
        }
        let catalog = Catalog::create(&folder.path().join("catalog.sqlite"))
            .await
            .unwrap();
        let storage = FaultyStorage::new(Arc::new(MemoryStorage::new()));
        let shared: Arc<dyn Storage> = Arc::new(storage.clone());
        let archive = VisualizationArchive::from_parts(catalog, shared);
        Self {
            scope,
            storage,
            archive,
            _folder: folder,
        }
    }

    /// Everything arrived, and nothing else.
    async fn is_complete(&self) {
        let tiles = seen(&self.archive).await;
        assert_eq!(tiles.len(), usize::from(TILES));
        for n in 0..TILES {
            let tile = &tiles[&format!("t{n}")];
            assert_eq!(pixels(tile).await, texture(SIZE, n));
        }
        assert!(orphans(&self.archive).await.is_empty());
        assert!(
            self.archive
                .catalog()
                .quarantined(VOLUME)
                .await
                .unwrap()
                .is_empty()
        );
    }
}

#[tokio::test]
async fn a_full_disk_is_waited_out() {
    let easy = Bench::new().await;
    easy.scope.ingest(&easy.archive).await;
    let needed: usize = seen(&easy.archive)
        .await
        .values()
        .map(|t| t.bytes.len())
        .sum();

    let bench = Bench::new().await;
    bench.storage.set_space(Some(needed as u64 / 2));
    let (diary, cancel) = (Diary::default(), Cancel::new());
    let free = async {
        while !diary.notices().iter().any(|n| n.contains("no space")) {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
        // Many attempts later: nothing was given up, and the reason is still told.
        tokio::time::sleep(Duration::from_millis(200)).await;
        let why = diary.held_up().expect("it waits");
        assert!(why.contains("no space is left to write"), "{why}");
        let tiles = seen(&bench.archive).await.len();
        assert!(
            tiles < usize::from(TILES),
            "all {tiles} tiles fit; the disk was not full"
        );
        bench.storage.set_space(None);
    };
    let options = quick();
    let ingest = run(
        bench.scope.path(),
        &bench.archive,
        &options,
        &diary,
        &cancel,
    );
    let both = async { tokio::join!(ingest, free) };
    let both = tokio::time::timeout(Duration::from_secs(60), both).await;
    assert_eq!(both.expect("it ends").0.unwrap().tiles, u64::from(TILES));
    assert_eq!(diary.held_up(), None, "it goes on");
    let notices = diary.notices();
    assert!(
        notices.iter().any(|n| n.contains("is written now"))
            && !notices.iter().any(|n| n.contains("catalog")),
        "the catalog had nothing to do with it: {notices:?}"
    );
    bench.is_complete().await;
}

/// Waits until it says why it waits.
async fn why_it_waits(diary: &Diary) -> String {
    loop {
        tokio::time::sleep(Duration::from_millis(100)).await;
        if let Some(why) = diary.held_up() {
            return why;
        }
    }
}

/// As where the archive's disk is unmounted: an empty folder is in its place, and the catalog is elsewhere.
#[tokio::test]
async fn an_archive_whose_disk_is_away_is_waited_for() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let [root, away] = ["root", "away"].map(|name| folder.path().join(name));
    let catalog = Catalog::create(&folder.path().join("catalog.sqlite")).await;
    let storage = Arc::new(LocalStorage::new(&root).unwrap());
    let archive = VisualizationArchive::from_parts(catalog.unwrap(), storage);
    scope.tile("t0", 0, SIZE, 0);
    assert_eq!(scope.ingest(&archive).await.tiles, 1);

    fs::rename(&root, &away).unwrap();
    fs::create_dir(&root).unwrap();
    scope.tile("t1", 1, SIZE, 1);
    let (diary, cancel, options) = (Diary::default(), Cancel::new(), quick());
    let ingest = run(scope.path(), &archive, &options, &diary, &cancel);
    let back = async {
        let why = why_it_waits(&diary).await;
        assert!(why.contains("is its disk mounted?"), "{why}");
        let entry = archive.catalog().entry(VOLUME).await.unwrap();
        assert_eq!(entry.tiles, 1, "nothing is acknowledged");
        assert_eq!(fs::read_dir(&root).unwrap().count(), 0);
        fs::remove_dir(&root).unwrap();
        fs::rename(&away, &root).unwrap();
    };
    let both = async { tokio::join!(ingest, back) };
    let both = tokio::time::timeout(Duration::from_secs(60), both).await;
    assert_eq!(both.expect("it goes on").0.unwrap().tiles, 1);
    assert_eq!(diary.held_up(), None);
    let tiles = seen(&archive).await;
    for n in 0..2 {
        let tile = &tiles[&format!("t{n}")];
        assert_eq!(pixels(tile).await, texture(SIZE, n));
    }
    assert!(orphans(&archive).await.is_empty());
}

/// As an object store does that comes back with nothing in it, or with another's: the catalog is still there.
#[tokio::test]
async fn nothing_is_entered_that_lies_elsewhere_than_the_rest() {
    for is_anothers in [false, true] {
        let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
        let at = |name: &str| folder.path().join(name);
        let archive = archive(folder.path()).await;
        scope.tile("t0", 0, SIZE, 0);
        assert_eq!(scope.ingest(&archive).await.tiles, 1);

        fs::create_dir(at("away")).unwrap();
        for name in ["tiles", "identity"] {
            fs::rename(at(name), at("away").join(name)).unwrap();
        }
        if is_anothers {
            fs::write(at("identity"), format!("{}\n", "a".repeat(32))).unwrap();
        }
        for n in 1..4 {
            scope.tile(&format!("t{n}"), u32::from(n), SIZE, n);
        }
        let (diary, cancel, options) = (Diary::default(), Cancel::new(), quick());
        let ingest = run(scope.path(), &archive, &options, &diary, &cancel);
        let back = async {
            let why = why_it_waits(&diary).await;
            assert!(
                why.contains("came back empty")
                    && why.contains(&folder.path().display().to_string()),
                "{why}"
            );
            tokio::time::sleep(options.retry * 50).await;
            let entry = archive.catalog().entry(VOLUME).await.unwrap();
            assert_eq!(entry.tiles, 1, "nothing is acknowledged");
            assert!(!at("tiles").exists(), "nothing is written");
            for name in ["tiles", "identity"] {
                fs::rename(at("away").join(name), at(name)).unwrap();
            }
        };
        let both = async { tokio::join!(ingest, back) };
        let both = tokio::time::timeout(Duration::from_secs(60), both).await;
        assert_eq!(both.expect("it goes on").0.unwrap().tiles, 3);
        assert_eq!(diary.held_up(), None);
        let tiles = seen(&archive).await;
        for n in 0..4 {
            let tile = &tiles[&format!("t{n}")];
            assert_eq!(pixels(tile).await, texture(SIZE, n));
        }
        assert!(orphans(&archive).await.is_empty());
    }
}

/// As long as nothing is acknowledged nothing is lost: it goes on, and what lies there has its identity again.
#[tokio::test]
async fn a_place_that_was_emptied_before_anything_was_acknowledged_is_used() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    let identity = folder.path().join("identity");
    let before = fs::read(&identity).unwrap();
    fs::remove_file(&identity).unwrap();
    scope.tile("t0", 0, SIZE, 0);
    assert_eq!(scope.ingest(&archive).await.tiles, 1);
    assert_eq!(fs::read(&identity).unwrap(), before);
    // And where that alone is lost.
    fs::remove_file(&identity).unwrap();
    scope.tile("t1", 1, SIZE, 1);
    assert_eq!(scope.ingest(&archive).await.tiles, 1);
    assert_eq!(fs::read(&identity).unwrap(), before);
}

/// A file whose space is set aside first, and then filled.
#[tokio::test]
async fn a_file_that_is_filled_while_it_is_read_is_waited_for() {
    // Reading it takes many times as long as its writer rests.
    const LARGE: UVec2 = UVec2::new(6000, 5000);
    const PART: usize = 120_000;
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    let bytes = scope.image("t", LARGE, 7);
    // The head, and none of the pixels.
    let mut half = bytes.clone();
    half[1000..29_999_000].fill(0);
    let path = scope.file("t");
    fs::write(&path, half).unwrap();
    scope.say(&crate::scope::tile_record("t", 0, LARGE));
    let fill = std::thread::spawn(move || {
        let file = fs::OpenOptions::new().write(true).open(path).unwrap();
        for (n, part) in bytes.chunks(PART).enumerate() {
            let at = u64::try_from(n * PART).unwrap();
            std::os::unix::fs::FileExt::write_all_at(&file, part, at).unwrap();
            std::thread::sleep(Duration::from_millis(5));
        }
    });
    let options = IngestOptions {
        patience: 1000,
        ..quick()
    };
    let done = run(scope.path(), &archive, &options, &(), &Cancel::new()).await;
    assert_eq!(done.unwrap().tiles, 1);
    fill.join().unwrap();
    let tile = seen(&archive).await.remove("t").unwrap();
    assert!(pixels(&tile).await == texture(LARGE, 7), "half of it");
}

/// It would be there for ever: nobody but a person can take it away.
#[tokio::test]
async fn a_folder_in_the_place_of_a_pyramid_is_told_and_holds_nothing_up() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    let position = fs::metadata(scope.path().join(RecordReader::FILE)).map_or(0, |meta| meta.len());
    let pyramid = format!("tiles/{VOLUME}/000000/a-{position:x}.tif");
    let occupied = folder.path().join(&pyramid);
    fs::create_dir_all(&occupied).unwrap();
    scope.tile("a", 0, SIZE, 1);
    scope.tile("b", 1, SIZE, 2);
    let summary = scope.ingest(&archive).await;
    assert_eq!((summary.tiles, summary.quarantined), (1, 1));
    let set_aside = archive.catalog().quarantined(VOLUME).await.unwrap();
    assert_eq!(set_aside[0].tile.as_deref(), Some("a"));
    let reason = &set_aside[0].reason;
    for part in ["a folder lies where", &pyramid, "append the record again"] {
        assert!(reason.contains(part), "{part:?} is not in: {reason}");
    }
    assert!(occupied.is_dir());
    assert_eq!(scope.ingest(&archive).await.quarantined, 0);
}

/// As `saccade serve` tells it, which may run on another machine.
#[tokio::test]
async fn what_holds_it_up_is_in_the_catalog_as_long_as_it_does() {
    let bench = Bench::new().await;
    bench.storage.set_space(Some(1));
    let (cancel, catalog) = (Cancel::new(), bench.archive.catalog());
    let options = IngestOptions {
        once: false,
        lease: Duration::from_secs(60),
        ..quick()
    };
    let ingest = run(bench.scope.path(), &bench.archive, &options, &(), &cancel);
    let look = async {
        let reasons = async |some: bool| {
            for _ in 0..2000 {
                tokio::time::sleep(Duration::from_millis(10)).await;
                let held_up = catalog.held_up(VOLUME).await.unwrap_or_default();
                if held_up.is_empty() != some {
                    return held_up;
                }
            }
            panic!("it does not wait, or not go on");
        };
        let reason = reasons(true).await.remove(0);
        assert!(
            reason.why.contains("no space is left to write"),
            "{}",
            reason.why
        );
        assert!(reason.worker.ends_with(&format!(":{}", std::process::id())));
        assert!(reason.since.elapsed().unwrap() < Duration::from_secs(60));
        bench.storage.set_space(None);
        reasons(false).await;
        // It is not that it ended.
        assert!(!catalog.processes().await.unwrap().is_empty());
        while seen(&bench.archive).await.len() < usize::from(TILES) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        cancel.cancel();
    };
    let both = async { tokio::join!(ingest, look) };
    let both = tokio::time::timeout(Duration::from_secs(120), both).await;
    both.expect("it ends").0.unwrap();
    bench.is_complete().await;
}

/// Who is killed while it waits waits no more.
#[tokio::test]
async fn the_dead_wait_for_nothing() {
    let bench = Bench::new().await;
    bench.scope.ingest(&bench.archive).await;
    let catalog = bench.archive.catalog();
    let lease = Duration::from_millis(300);
    let worker = catalog.register("scope:7", lease).await.unwrap();
    let reason = ("the share is away".to_owned(), std::time::SystemTime::now());
    catalog
        .tell_held_up(VOLUME, &worker, &[reason])
        .await
        .unwrap();
    assert_eq!(catalog.held_up(VOLUME).await.unwrap()[0].worker, "scope:7");
    tokio::time::sleep(2 * lease).await;
    assert_eq!(catalog.held_up(VOLUME).await.unwrap(), []);
}

/// What ends an ingest whose catalog is disturbed once a tile is in.
async fn ended_by(
    scope: &Scope,
    archive: &VisualizationArchive,
    disturb: impl FnOnce(),
) -> IngestError {
    let options = IngestOptions {
        once: false,
        ..quick()
    };
    let (cancel, diary) = (Cancel::new(), Diary::default());
    let ingest = run(scope.path(), archive, &options, &diary, &cancel);
    let disturb = async {
        while diary.states().last().is_none_or(|state| state.tiles < 1) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        disturb();
    };
    let both = async { tokio::join!(ingest, disturb) };
    let both = tokio::time::timeout(Duration::from_secs(60), both).await;
    let ended = both.expect("it ends").0.unwrap_err();
    archive.catalog().close().await;
    ended
}

/// SQLite would go on with a file that has lost its name, and all that was acknowledged would be lost with it.
#[tokio::test]
async fn a_catalog_that_is_taken_away_ends_it() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    let [file, away] = ["catalog.sqlite", "away"].map(|name| folder.path().join(name));
    scope.tile("t0", 0, SIZE, 0);
    let ended = ended_by(&scope, &archive, || {
        fs::rename(&file, &away).unwrap();
        scope.tile("t1", 1, SIZE, 1);
    });
    let ended = ended.await;
    assert!(
        matches!(ended, IngestError::Catalog(CatalogError::Moved { .. })),
        "{ended}"
    );
    fs::rename(&away, &file).unwrap();
    let archive = crate::scope::archive(folder.path()).await;
    scope.ingest(&archive).await;
    assert_eq!(seen(&archive).await.len(), 2);
}

/// What is acknowledged afterwards would be lost, or mixed with what the copy has.
#[tokio::test]
async fn an_older_copy_over_the_catalog_ends_it() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let [file, copy] = ["catalog.sqlite", "copy"].map(|name| folder.path().join(name));
    let taken_in = async |tile: u8| {
        let archive = archive(folder.path()).await;
        scope.tile(&format!("t{tile}"), tile.into(), SIZE, tile);
        scope.ingest(&archive).await;
        // Nothing is left in its log.
        archive.catalog().close().await;
    };
    taken_in(0).await;
    fs::copy(&file, &copy).unwrap();
    taken_in(1).await;
    let archive = archive(folder.path()).await;
    scope.tile("t2", 2, SIZE, 2);
    let ended = ended_by(&scope, &archive, || {
        fs::copy(&copy, &file).unwrap();
        scope.tile("t3", 3, SIZE, 3);
    });
    let ended = ended.await;
    assert!(
        matches!(ended, IngestError::Catalog(CatalogError::Older { .. })),
        "{ended}"
    );
    // As the message says.
    for beside in ["-wal", "-shm"] {
        let _what_is_there = fs::remove_file(format!("{}{beside}", file.display()));
    }
    fs::copy(&copy, &file).unwrap();
    let archive = crate::scope::archive(folder.path()).await;
    scope.ingest(&archive).await;
    assert_eq!(seen(&archive).await.len(), 4);
}

#[tokio::test]
async fn a_write_that_fails_is_repeated() {
    let bench = Bench::new().await;
    for nth in [0, 1, 4] {
        bench.storage.fail_write(nth, WriteFault::Fail);
    }
    let diary = Diary::default();
    let ended = run(
        bench.scope.path(),
        &bench.archive,
        &quick(),
        &diary,
        &Cancel::new(),
    )
    .await;
    assert_eq!(ended.unwrap().tiles, u64::from(TILES));
    assert!(bench.storage.writes() > u64::from(TILES));
    assert!(
        diary.notices().iter().any(|n| n.contains("trying again")),
        "{:?}",
        diary.notices()
    );
    bench.is_complete().await;
}

/// The process dies at each write in turn, before and after the pyramid is whole.
#[tokio::test]
async fn after_a_crash_at_any_write_nothing_is_lost() {
    for fault in [WriteFault::CrashBefore, WriteFault::CrashAfter] {
        for nth in 0..u64::from(TILES) {
            let bench = Bench::new().await;
            bench.storage.fail_write(nth, fault);
            let ended = run(
                bench.scope.path(),
                &bench.archive,
                &quick(),
                &(),
                &Cancel::new(),
            )
            .await;
            assert!(
                matches!(ended, Err(IngestError::Storage { .. })),
                "{ended:?}"
            );
            assert!(bench.storage.has_crashed());
            bench.storage.restart();
            let before = seen(&bench.archive).await.len();
            assert!(
                before <= usize::try_from(nth).unwrap() + 1,
                "{before} before write {nth}"
            );
            let rest = bench.scope.ingest(&bench.archive).await;
            assert_eq!(rest.tiles + before as u64, u64::from(TILES), "none twice");
            bench.is_complete().await;
        }
    }
}

/// As where the microscope's share is gone for a while: it takes longer than some attempts.
#[tokio::test]
async fn an_acquisition_that_is_away_is_waited_for() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    scope.tile("t0", 0, SIZE, 0);
    let away = folder.path().join("away");
    let options = IngestOptions {
        once: false,
        ..quick()
    };
    let (diary, cancel) = (Diary::default(), Cancel::new());
    let ingest = run(scope.path(), &archive, &options, &diary, &cancel);
    let entered = async |tiles: u64| {
        while archive
            .catalog()
            .entry(VOLUME)
            .await
            .map_or(0, |entry| entry.tiles)
            < tiles
        {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    let other = async {
        entered(1).await;
        fs::rename(scope.path(), &away).unwrap();
        // Far longer than pauses between attempts.
        tokio::time::sleep(options.retry * 500).await;
        let why = diary.held_up().expect("it says why it waits");
        assert!(why.contains("cannot read"), "{why}");
        fs::rename(&away, scope.path()).unwrap();
        scope.tile("t1", 1, SIZE, 1);
        entered(2).await;
        cancel.cancel();
    };
    let both = async { tokio::join!(ingest, other) };
    let both = tokio::time::timeout(Duration::from_secs(60), both).await;
    assert_eq!(both.expect("it goes on").0.unwrap().tiles, 2);
    assert_eq!(diary.held_up(), None);
}
