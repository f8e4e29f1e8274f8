//! Something else where a folder of images should be: it is told, nothing waits for it for ever, and what comes in its place
//! is taken in.

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::sync::mpsc::channel;
use std::time::Duration;

use glam::{DVec2, DVec3, UVec2, UVec3};
use saccade_archive::acquisition::{AcquisitionInfo, Cursor, Record, RecordReader};
use saccade_ingest::ingest::{IngestOptions, run};
use saccade_ingest::watch::{self, Disk, ListConfig, ListWatch, Until, Watch, WatchConfig, follow};
use saccade_ingest::{Cancel, HeldUp};

use crate::scope::{Scope, VOLUME, archive, quick, seen, texture, tiff8, tile_record};

const SIZE: UVec2 = UVec2::new(60, 50);

/// A folder to look into, and what is kept beside it.
struct Beside(tempfile::TempDir);

impl Beside {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("scope")).unwrap();
        Self(folder)
    }

    fn at(&self, name: &str) -> PathBuf {
        self.0.path().join("scope").join(name)
    }

    fn kept(&self) -> PathBuf {
        self.0.path().join("kept")
    }

    /// A folder with an image, whole under its name at once.
    fn folder(&self, name: &str, image: &str, seed: u8) {
        let new = self.0.path().join("new");
        fs::create_dir(&new).unwrap();
        fs::write(new.join(image), tiff8(SIZE, &texture(SIZE, seed))).unwrap();
        fs::rename(new, self.at(name)).unwrap();
    }

    fn watch(&self) -> Watch<Disk> {
        let (extent, voxel_nm) = (UVec3::new(2000, 2000, 20), DVec3::new(4.0, 4.0, 40.0));
        let config = WatchConfig {
            pattern: "s{section}/r{row}_c{column}.tif".parse().unwrap(),
            info: AcquisitionInfo::new(VOLUME, extent, voxel_nm),
            pitch: DVec2::splat(50.0),
            scale: 1.0,
            first: 0,
            poll: Duration::from_millis(20),
            budget: 40,
            moved: false,
        };
        Watch::open(config, Disk, &self.at(""), &self.kept()).unwrap()
    }

    /// Tiles that were told of.
    fn told(&self) -> BTreeSet<String> {
        let lines = RecordReader::new(&self.kept(), Cursor::default()).read(9999);
        let tiles = lines.unwrap().into_iter().map(|line| match line.record {
            Ok(Record::Tile(tile)) => tile.tile,
            other => panic!("{other:?}"),
        });
        tiles.collect()
    }
}

fn pipe(at: &Path) {
    let made = std::process::Command::new("mkfifo").arg(at).status();
    assert!(made.unwrap().success());
}

fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    for _ in 0..1200 {
        if let Some(seen) = look() {
            return seen;
        }
        std::thread::sleep(Duration::from_millis(25));
    }
    panic!("{what} does not come");
}

/// Ends what looks on a thread of its own, also when a test fails.
struct Ended(Cancel);

impl Drop for Ended {
    fn drop(&mut self) {
        self.0.cancel();
    }
}

#[test]
fn what_lies_where_names_say_folders_is_told_until_one_is_there() {
    let beside = Beside::new();
    beside.folder("s0", "r0_c0.tif", 1);
    pipe(&beside.at("s1"));
    fs::write(beside.at("s2"), "none").unwrap();
    symlink(beside.at("s0"), beside.at("s3")).unwrap();
    fs::write(beside.at("notes.txt"), "of no section").unwrap();
    let (cancel, held_up) = (Cancel::new(), HeldUp::default());
    let _ended = Ended(cancel.clone());
    let mut watch = beside.watch().telling(held_up.clone());
    std::thread::spawn(move || watch::run(&mut watch, false, &cancel).unwrap());
    let why = || held_up.now().into_iter().map(|reason| reason.why).next();

    let said = until("why", why);
    for (kind, at) in [("a named pipe", "s1"), ("a file", "s2"), ("a link", "s3")] {
        let at = beside.at("").canonicalize().unwrap().join(at);
        let blocked = format!(
            "where {kind} lies; put the folder itself there: {}",
            at.display()
        );
        assert!(said.contains(&blocked), "{said}");
    }
    assert!(!said.contains("notes.txt"), "{said}");
    until("the first", || {
        beside.told().contains("s0_r0_c0").then_some(())
    });

    for (name, seed) in [("s1", 2), ("s2", 3), ("s3", 4)] {
        fs::remove_file(beside.at(name)).unwrap();
        beside.folder(name, "r0_c0.tif", seed);
    }
    until("the others", || (beside.told().len() == 4).then_some(()));
    until("nothing to wait for", || why().is_none().then_some(()));

    // One that was a folder before.
    fs::rename(beside.at("s0"), beside.0.path().join("gone")).unwrap();
    pipe(&beside.at("s0"));
    let said = until("why", why);
    assert!(said.contains("a named pipe"), "{said}");
    fs::remove_file(beside.at("s0")).unwrap();
    beside.folder("s0", "r0_c1.tif", 5);
    until("the last", || {
        beside.told().contains("s0_r0_c1").then_some(())
    });
    until("nothing to wait for", || why().is_none().then_some(()));
}

/// One to which nobody writes keeps nobody from anything.
#[tokio::test]
async fn a_pipe_where_names_say_an_image_is_set_aside() {
    let beside = Beside::new();
    beside.folder("s0", "r0_c0.tif", 1);
    pipe(&beside.at("s0/r0_c1.tif"));
    let (sender, ends) = channel();
    let mut watch = beside.watch();
    let once = move || {
        watch::run(&mut watch, true, &Cancel::new()).unwrap();
        sender.send(watch).unwrap();
    };
    std::thread::spawn(once);
    let mut watch = ends.recv_timeout(Duration::from_secs(30)).expect("it ends");
    let archive = archive(&beside.0.path().join("archive")).await;
    let options = IngestOptions {
        linked: Some(watch.folder().to_owned()),
        ..quick()
    };
    let (kept, cancel) = (beside.kept(), Cancel::new());
    let take_in = || run(&kept, &archive, &options, &(), &cancel);
    take_in().await.unwrap();
    let set_aside = archive.catalog().quarantined(VOLUME).await.unwrap();
    assert_eq!(set_aside.len(), 1);
    assert_eq!(set_aside[0].file, "s0/r0_c1.tif");
    assert!(
        set_aside[0].reason.contains("no regular file"),
        "{set_aside:?}"
    );

    let part = beside.at("s0/part");
    fs::write(&part, tiff8(SIZE, &texture(SIZE, 2))).unwrap();
    fs::rename(part, beside.at("s0/r0_c1.tif")).unwrap();
    watch::run(&mut watch, true, &Cancel::new()).unwrap();
    take_in().await.unwrap();
    let taken: Vec<_> = seen(&archive).await.into_keys().collect();
    assert_eq!(taken, ["s0_r0_c0", "s0_r0_c1"]);
}

/// Looks once, and ends.
fn look_once(beside: &Beside) -> Watch<Disk> {
    let (sender, ends) = channel();
    let mut watch = beside.watch();
    std::thread::spawn(move || {
        watch::run(&mut watch, true, &Cancel::new()).unwrap();
        sender.send(watch).unwrap();
    });
    ends.recv_timeout(Duration::from_secs(30)).expect("it ends")
}

/// What a link leads to may never come: who looks once does not wait for it.
#[test]
fn links_to_no_image_where_names_say_images_are_told_and_not_waited_for() {
    let beside = Beside::new();
    beside.folder("s0", "r0_c0.tif", 1);
    symlink("image", beside.at("s0/r0_c1.tif")).unwrap();
    symlink("r0_c2.tif", beside.at("s0/r0_c2.tif")).unwrap();
    let watch = look_once(&beside);
    assert_eq!(beside.told(), BTreeSet::from(["s0_r0_c0".to_owned()]));
    let missing = watch.missing().unwrap();
    let root = beside.at("").canonicalize().unwrap();
    for (kind, file) in [
        ("a link to nothing", "s0/r0_c1.tif"),
        ("a link that cannot be followed", "s0/r0_c2.tif"),
    ] {
        let at = root.join(file).display().to_string();
        let said = { missing.split("; ") }.any(|said| said.contains(kind));
        assert!(said && missing.contains(&at), "{missing}");
    }
    drop(watch);

    fs::write(beside.at("s0/image"), tiff8(SIZE, &texture(SIZE, 2))).unwrap();
    fs::remove_file(beside.at("s0/r0_c2.tif")).unwrap();
    let watch = look_once(&beside);
    assert_eq!(watch.missing(), None);
    assert_eq!(beside.told().len(), 2);
    drop(watch);

    // One that was taken in before.
    fs::remove_file(beside.at("s0/r0_c0.tif")).unwrap();
    symlink("none", beside.at("s0/r0_c0.tif")).unwrap();
    let missing = look_once(&beside).missing().unwrap();
    assert!(missing.contains("a link to nothing"), "{missing}");
    assert_eq!(beside.told().len(), 2);
}

/// A folder that is called as an image is none, nor is a file that is called as a folder of them.
#[test]
fn what_names_say_and_is_of_another_kind_is_missing_to_who_looks_once() {
    let beside = Beside::new();
    beside.folder("s0", "r0_c0.tif", 1);
    fs::create_dir(beside.at("s0/r0_c1.tif")).unwrap();
    fs::write(beside.at("s0/r0_c1.tif/0.tif"), "of another").unwrap();
    fs::write(beside.at("s1"), "no folder").unwrap();
    let watch = look_once(&beside);
    let missing = watch.missing().unwrap();
    let root = beside.at("").canonicalize().unwrap();
    for (why, file) in [
        ("a folder lies where an image should be", "s0/r0_c1.tif"),
        ("in a folder where a file lies", "s1"),
    ] {
        let at = root.join(file).display().to_string();
        let said = { missing.split("; ") }.any(|said| said.contains(why));
        assert!(said && missing.contains(&at), "{missing}");
    }
    assert_eq!(beside.told(), BTreeSet::from(["s0_r0_c0".to_owned()]));
    drop(watch);

    fs::remove_dir_all(beside.at("s0/r0_c1.tif")).unwrap();
    fs::write(beside.at("s0/r0_c1.tif"), tiff8(SIZE, &texture(SIZE, 2))).unwrap();
    fs::remove_file(beside.at("s1")).unwrap();
    beside.folder("s1", "r0_c0.tif", 3);
    assert_eq!(look_once(&beside).missing(), None);
    assert_eq!(beside.told().len(), 3);
}

/// Its folder does not change when what the link leads to comes.
#[test]
fn what_a_link_in_an_images_place_leads_to_is_told_of_once_it_comes() {
    let beside = Beside::new();
    beside.folder("s0", "r0_c0.tif", 1);
    let elsewhere = beside.0.path().join("elsewhere.tif");
    symlink(&elsewhere, beside.at("s0/r0_c1.tif")).unwrap();
    let (cancel, held_up) = (Cancel::new(), HeldUp::default());
    let _ended = Ended(cancel.clone());
    let mut watch = beside.watch().telling(held_up.clone());
    std::thread::spawn(move || watch::run(&mut watch, false, &cancel).unwrap());
    let why = || held_up.now().into_iter().map(|reason| reason.why).next();
    let said = until("why", why);
    assert!(said.starts_with("a link to nothing"), "{said}");
    // Until its folder's time counts.
    std::thread::sleep(Duration::from_secs(4));
    let part = beside.0.path().join("part");
    fs::write(&part, tiff8(SIZE, &texture(SIZE, 2))).unwrap();
    fs::rename(part, elsewhere).unwrap();
    until("the image", || {
        beside.told().contains("s0_r0_c1").then_some(())
    });
    until("nothing to wait for", || why().is_none().then_some(()));
}

/// Follows a list.
fn listed(beside: &Beside, lines: &str) -> ListWatch<Disk> {
    let list = beside.at("list.txt");
    fs::write(&list, lines).unwrap();
    let config = ListConfig {
        list,
        name: VOLUME.to_owned(),
        voxel_nm: DVec3::ONE,
        extent: None,
        dtype: None,
        channels: None,
        channel_in: None,
        origin: None,
        first: None,
        scale: 1.0,
        poll: Duration::from_millis(10),
        rest: Duration::ZERO,
        drop_after: Duration::ZERO,
        budget: 30,
        moved: false,
    };
    ListWatch::open(config, Disk, &beside.at(""), &beside.kept()).unwrap()
}

/// Also where other images are called alike, in two folders or in those that the list names.
#[test]
fn what_lies_where_a_list_says_folders_is_told_before_others_are_offered() {
    for lines in [
        "s0/a.tif 0 0 0\ns1/b.tif 0 0 1\n",
        "s0/a.tif 0 0 0\nzz/b.tif 0 0 0\ns1/b.tif 0 0 1\n",
    ] {
        let beside = Beside::new();
        beside.folder("s0", "a.tif", 1);
        for (folder, seed) in [("x0", 2), ("x1", 3)] {
            beside.folder(folder, "b.tif", seed);
        }
        pipe(&beside.at("s1"));
        let mut watch = listed(&beside, lines);
        follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
        let missing = watch.missing().unwrap();
        let blocked = "where a named pipe lies; put the folder itself there";
        for said in ["s1/b.tif", blocked] {
            assert!(missing.contains(said), "{missing}");
        }
        assert!(!missing.contains("name them"), "{missing}");
        fs::remove_file(beside.at("s1")).unwrap();
        beside.folder("s1", "b.tif", 2);
        follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
        let missing = watch.missing().unwrap_or_default();
        // The temporary folder itself may be called so without the image.
        assert!(!missing.contains("s1/b.tif"), "{missing}");
    }
}

#[test]
fn what_lies_where_a_list_says_folders_is_told() {
    let beside = Beside::new();
    beside.folder("s0", "a.tif", 1);
    pipe(&beside.at("s1"));
    let mut watch = listed(&beside, "s0/a.tif 0 0 0\ns1/b.tif 0 0 1\n");
    let mut once = || {
        follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
        watch.missing()
    };
    let missing = once().unwrap();
    let blocked = "where a named pipe lies; put the folder itself there";
    for said in ["1 of the 2 images", "s1/b.tif", blocked] {
        assert!(missing.contains(said), "{missing}");
    }
    fs::remove_file(beside.at("s1")).unwrap();
    beside.folder("s1", "b.tif", 2);
    assert_eq!(once(), None);
}

#[tokio::test]
async fn what_lies_where_records_say_folders_is_told() {
    let (scope, folder) = (Scope::new(), tempfile::tempdir().unwrap());
    let archive = archive(folder.path()).await;
    scope.tile("a", 0, SIZE, 1);
    let tiles = scope.path().join("tiles");
    let away = scope.path().join("away");
    fs::rename(&tiles, &away).unwrap();
    pipe(&tiles);
    scope.say(&tile_record("b", 1, SIZE));
    assert_eq!(scope.ingest(&archive).await.tiles, 0);
    let set_aside = archive.catalog().quarantined(VOLUME).await.unwrap();
    let why =
        "where a named pipe lies; put the folder itself there: the acquisition's folder/tiles";
    assert_eq!(set_aside.len(), 2);
    for one in &set_aside {
        assert!(one.reason.contains(why), "{set_aside:?}");
    }
    fs::remove_file(&tiles).unwrap();
    fs::rename(&away, &tiles).unwrap();
    scope.image("b", SIZE, 2);
    assert_eq!(scope.ingest(&archive).await.tiles, 2);
}
