//! Several workers on one volume, in this process.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use glam::UVec2;
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{Cursor, Record, RecordReader};
use saccade_archive::catalog::{Catalog, CatalogLocation, ChangeReason, Waiting};
use saccade_archive::storage::LocalStorage;
use saccade_ingest::ingest::{IngestOptions, Summary, run};
use saccade_ingest::{Cancel, Progress, State};

use crate::postgres::Server;
use crate::scope::{
    Diary, Scope, VOLUME, archive, at, move_record, orphans, quick, seen, tile_record,
};

const SIZE: UVec2 = UVec2::new(140, 90);
const TILES: u64 = 60;
/// With those that are moved.
const RECORDS: u64 = TILES + TILES / 5;

/// A stream of tiles, some imaged again, some moved.
fn scope() -> Scope {
    let scope = Scope::new();
    for n in 0..TILES {
        let name = format!("t{}", n - n / 7 % 2);
        scope.image(&format!("image{n}"), SIZE, u8::try_from(n).unwrap());
        let Record::Tile(mut record) = tile_record(&name, u32::try_from(n % 4).unwrap(), SIZE)
        else {
            panic!("a tile")
        };
        record.file = format!("tiles/image{n}.tif");
        scope.say(&Record::Tile(record));
        if n % 5 == 0 {
            scope.say(&move_record(&format!("t{}", n + 3), at(n as f64, 7.0)));
        }
    }
    scope
}

/// An archive at a folder, opened anew, as another process would.
async fn opened(folder: &std::path::Path, url: Option<&str>) -> VisualizationArchive {
    match url {
        None => archive(folder).await,
        Some(url) => {
            let catalog = Catalog::create(&CatalogLocation::parse(url)).await.unwrap();
            let storage = LocalStorage::new(folder).unwrap();
            VisualizationArchive::from_parts(catalog, Arc::new(storage))
        }
    }
}

/// Four workers at once, none of which dies: what they make is what one makes, and each record is
/// worked on by one of them.
async fn share(url: Option<&str>) {
    let (scope, folder) = (Arc::new(scope()), tempfile::tempdir().unwrap());
    let mut tasks = Vec::new();
    for _ in 0..4 {
        let archive = opened(folder.path(), url).await;
        let scope = scope.clone();
        tasks.push(tokio::spawn(async move {
            let options = IngestOptions {
                lease: Duration::from_secs(60),
                ..quick()
            };
            let diary = Diary::default();
            let done = run(scope.path(), &archive, &options, &diary, &Cancel::new()).await;
            archive.catalog().close().await;
            (done.unwrap(), diary.states())
        }));
    }
    let mut all = Summary::default();
    let mut busy = 0;
    for task in tasks {
        let (one, states) = task.await.unwrap();
        // What one has put into the queue the others do not count as what is still to be read; how much that is is estimated.
        let most = states.iter().map(|state| state.queued).max();
        assert!(most < Some(RECORDS * 3 / 2), "{most:?} are left");
        busy += u32::from(one.tiles > 0);
        all.tiles += one.tiles;
        all.quarantined += one.quarantined;
    }
    assert_eq!((all.tiles, all.quarantined), (TILES, 0));
    assert!(busy > 1, "{busy} of them did anything");
    let shared = opened(folder.path(), url).await;
    let changes = shared.catalog().changes_after(VOLUME, 0).await.unwrap();
    let came = changes.iter().filter(|c| c.reason == ChangeReason::Tile);
    assert!(came.count() as u64 >= TILES);
    let alone_folder = tempfile::tempdir().unwrap();
    let alone = archive(alone_folder.path()).await;
    scope.ingest(&alone).await;
    assert!(seen(&shared).await == seen(&alone).await);
    assert!(orphans(&shared).await.is_empty());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn workers_share_a_volume_on_sqlite() {
    share(None).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn workers_share_a_volume_on_postgres() {
    if let Some(server) = Server::shared() {
        share(Some(&server.database().await)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_away_is_waited_for() {
    let Some(server) = Server::start(&[]) else {
        return;
    };
    let (scope, folder) = (scope(), tempfile::tempdir().unwrap());
    let url = server.database().await;
    let archive = opened(folder.path(), Some(&url)).await;
    let diary = Diary::default();
    let options = quick();
    let cancel = Cancel::new();
    let work = run(scope.path(), &archive, &options, &diary, &cancel);
    let disturb = async {
        let mut tiles = 0;
        for _ in 0..2 {
            while diary.states().last().is_none_or(|s| s.tiles <= tiles) {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
            tiles = diary.states().last().unwrap().tiles;
            let before = diary.notices().len();
            tokio::task::block_in_place(|| server.kill());
            // Until it is missed: a busy machine may be long at the tile in hand.
            let missed = async {
                while diary.notices().len() == before {
                    tokio::time::sleep(Duration::from_millis(5)).await;
                }
            };
            let missed = tokio::time::timeout(Duration::from_secs(20), missed).await;
            missed.expect("nobody misses the server");
            tokio::time::sleep(Duration::from_millis(400)).await;
            tokio::task::block_in_place(|| server.run());
        }
    };
    let (done, ()) = tokio::join!(work, disturb);
    done.unwrap();
    let notices = diary.notices();
    assert!(
        notices.iter().any(|n| n.contains("server does not answer")),
        "{notices:?}"
    );
    assert!(
        notices.iter().any(|n| n == "the catalog can be used again"),
        "{notices:?}"
    );
    let alone_folder = tempfile::tempdir().unwrap();
    let alone = crate::scope::archive(alone_folder.path()).await;
    scope.ingest(&alone).await;
    assert!(seen(&archive).await == seen(&alone).await);
}

/// Says another tile whenever one was entered: there is always more to do.
struct Busy<'a> {
    scope: &'a Scope,
    said: AtomicU32,
    catalog_has: AtomicBool,
}

impl Busy<'_> {
    fn say_more(&self) {
        for _ in 0..4 {
            let n = self.said.fetch_add(1, Ordering::Relaxed);
            let Record::Tile(mut record) = tile_record(&format!("more{n}"), n % 4, SIZE) else {
                panic!("a tile")
            };
            record.file = "tiles/first.tif".to_owned();
            self.scope.say(&Record::Tile(record));
        }
    }
}

impl Progress for Busy<'_> {
    fn update(&self, _: &State) {
        if !self.catalog_has.load(Ordering::Relaxed) {
            self.say_more();
        }
    }

    fn notice(&self, _: &str) {}
}

/// What a killed worker of this machine had is taken up by one that has enough to do, long before the lease ends.
#[cfg(target_os = "linux")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_busy_worker_takes_up_what_a_killed_one_had() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    scope.tile("first", 0, SIZE, 1);
    let archive = archive(folder.path()).await;
    scope.ingest(&archive).await;
    let catalog = archive.catalog();
    let mut reader = RecordReader::new(scope.path(), catalog.cursor(VOLUME).await.unwrap());
    scope.tile("claimed", 0, SIZE, 2);
    let from = reader.cursor();
    let line = reader.read(1).unwrap().remove(0);
    let Ok(Record::Tile(record)) = line.record else {
        panic!("a tile")
    };
    let waiting = Waiting {
        position: line.offset,
        record,
        reason: "its turn has not come".to_owned(),
    };
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    commit.advance(from, line.next).await.unwrap();
    commit.enqueue(&waiting).await.unwrap();
    commit.finish().await.unwrap();
    // One that had this process's number when the machine was started.
    let boot = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap();
    let space = std::fs::read_link("/proc/self/ns/pid").unwrap();
    let (boot, space, number) = (boot.trim(), space.display(), std::process::id());
    let process = format!("{boot} {space}/{number}/1");
    let lease = Duration::from_secs(3600);
    let killed = catalog.register_process("killed", &process, lease);
    let killed = killed.await.unwrap();
    assert_eq!(catalog.claim(VOLUME, &killed, 9).await.unwrap().len(), 1);

    let busy = Busy {
        scope: &scope,
        said: AtomicU32::new(0),
        catalog_has: AtomicBool::new(false),
    };
    busy.say_more();
    let options = IngestOptions {
        once: false,
        lease,
        batch: 1 << 20,
        ..quick()
    };
    let cancel = Cancel::new();
    let work = run(scope.path(), &archive, &options, &busy, &cancel);
    let watch = async {
        // What it does besides is done, too.
        for tile in ["claimed", "more0"] {
            while catalog.tile(VOLUME, tile).await.unwrap().is_none() {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        }
        busy.catalog_has.store(true, Ordering::Relaxed);
        cancel.cancel();
    };
    let both = async { tokio::join!(work, watch) };
    let (done, ()) = tokio::time::timeout(Duration::from_secs(40), both)
        .await
        .expect("it is left to the killed worker");
    done.unwrap();
}

/// A record that ended worker after worker is set aside, and the others are done.
#[tokio::test]
async fn a_record_that_ends_its_workers_is_set_aside() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    scope.tile("poison", 0, SIZE, 1);
    scope.tile("good", 1, SIZE, 2);
    let archive = archive(folder.path()).await;
    let catalog = archive.catalog();
    let info = crate::scope::info(crate::scope::EXTENT);
    catalog
        .create_volume(&info.volume().unwrap())
        .await
        .unwrap();
    let mut reader = RecordReader::new(scope.path(), Cursor::default());
    let line = reader.read(1).unwrap().remove(0);
    let Ok(Record::Tile(record)) = line.record else {
        panic!("a tile")
    };
    let mut commit = catalog.begin(VOLUME).await.unwrap();
    commit.advance(Cursor::default(), line.next).await.unwrap();
    let poison = Waiting {
        position: line.offset,
        record,
        reason: "its turn has not come".to_owned(),
    };
    commit.enqueue(&poison).await.unwrap();
    commit.finish().await.unwrap();
    for n in 0..3 {
        // Each is dead at once.
        let dead = catalog.register("dead", Duration::ZERO).await.unwrap();
        tokio::time::sleep(Duration::from_millis(2)).await;
        let claims = catalog.claim(VOLUME, &dead, 9).await.unwrap();
        assert_eq!((claims.len(), claims[0].deaths), (1, n));
        let position = claims[0].waiting.position;
        catalog.begin_record(VOLUME, &dead, position).await.unwrap();
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    let options = IngestOptions {
        attempts: 3,
        ..quick()
    };
    let done = run(scope.path(), &archive, &options, &(), &Cancel::new()).await;
    let done = done.unwrap();
    assert_eq!((done.tiles, done.quarantined), (1, 1));
    let quarantined = catalog.quarantined(VOLUME).await.unwrap();
    assert_eq!(quarantined[0].tile.as_deref(), Some("poison"));
    let reason = &quarantined[0].reason;
    assert!(reason.starts_with("3 workers ended"), "{reason}");
    // Said again, it gets another chance.
    scope.tile("poison", 0, SIZE, 1);
    assert_eq!(scope.ingest(&archive).await.tiles, 1);
}
