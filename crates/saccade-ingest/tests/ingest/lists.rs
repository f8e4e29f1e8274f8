//! Folders whose tiles a list names: every kind of list, lists that change, and processes that are killed meanwhile.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

use glam::{DVec2, DVec3, UVec2, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{Cursor, Record, RecordReader, tile_specs};
use saccade_core::volume::Dtype;
use saccade_ingest::Cancel;
use saccade_ingest::ingest::{IngestOptions, run};
use saccade_ingest::replay::{self, Input, ReplayConfig, detect, find_list};
use saccade_ingest::simulate::clock::SystemClock;
use saccade_ingest::watch::{
    Disk, ListConfig, ListError, ListWatch, Until, WatchError, follow, kept_list,
};

use crate::bare::{FOLDER, Worker};
use crate::scope::{VOLUME, archive, orphans, pixels, quick, seen, texture, tiff8, tiff16};

const SIZE: UVec2 = UVec2::new(60, 50);
const VOXEL: DVec3 = DVec3::new(4.0, 4.0, 40.0);

fn config(list: &Path) -> ListConfig {
    ListConfig {
        list: list.to_owned(),
        name: VOLUME.to_owned(),
        voxel_nm: VOXEL,
        extent: None,
        dtype: None,
        origin: None,
        first: None,
        scale: 1.0,
        poll: Duration::from_millis(10),
        rest: Duration::from_millis(60),
        budget: 30,
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
        ListWatch::open(config, Disk, &self.path(), &self.kept()).unwrap()
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

/// Takes a folder in by its list, and by a replay: both show the same. How many tiles there are.
async fn is_as_replayed(folder: &Path) -> usize {
    let beside = tempfile::tempdir().unwrap();
    let Input::Acquisition(acquisition) = detect(folder).unwrap() else {
        panic!("{} holds no list", folder.display())
    };
    let replayed = ReplayConfig {
        name: Some(VOLUME.to_owned()),
        voxel_nm: VOXEL,
        rate_mpixel_s: None,
        solution_after: Duration::ZERO,
    };
    let (cancel, clock) = (Cancel::new(), SystemClock::default());
    let second = beside.path().join("replayed");
    replay::run(&replayed, &acquisition, &second, &clock, &cancel, &()).unwrap();
    let want = archive(&beside.path().join("want")).await;
    run(&second, &want, &quick(), &(), &cancel).await.unwrap();

    let list = find_list(folder).unwrap().unwrap();
    assert_eq!(list, acquisition.list);
    let kept = beside.path().join("kept");
    let mut watch = ListWatch::open(config(&list), Disk, folder, &kept).unwrap();
    follow(&mut watch, Until::End, true, &cancel).unwrap();
    assert_eq!(watch.missing(), None);
    let got = archive(&beside.path().join("got")).await;
    let options = IngestOptions {
        linked: Some(watch.folder().to_owned()),
        ..quick()
    };
    run(&kept, &got, &options, &(), &cancel).await.unwrap();

    let volume = |archive: &VisualizationArchive| archive.catalog().clone();
    assert_eq!(
        volume(&got).volume(VOLUME).await.unwrap(),
        volume(&want).volume(VOLUME).await.unwrap()
    );
    let (got, want) = (seen(&got).await, seen(&want).await);
    assert!(got.keys().eq(want.keys()));
    for (name, want) in &want {
        let got = &got[name];
        assert_eq!((got.section, got.size), (want.section, want.size), "{name}");
        let apart = got.transform.iter().zip(want.transform);
        let apart = apart.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(
            apart < 1e-9,
            "{name}: {:?}, {:?}",
            got.transform,
            want.transform
        );
        let depth = acquisition.dtype;
        if depth == Dtype::Uint8 {
            assert_eq!(pixels(got).await, pixels(want).await, "{name}");
        }
    }
    want.len()
}

fn patch(file: &str, matrix: &str) -> String {
    format!(
        r#"<t2_patch width="60" height="50" transform="matrix({matrix})" file_path="/far/{file}.tif"/>"#
    )
}

fn project(layers: &[&[(&str, &str)]]) -> String {
    let layers = layers.iter().enumerate().map(|(z, patches)| {
        let patches: String = patches
            .iter()
            .map(|(file, matrix)| patch(file, matrix))
            .collect();
        format!(r#"<t2_layer z="{z}">{patches}</t2_layer>"#)
    });
    format!("<trakem2>{}</trakem2>", layers.collect::<String>())
}

fn spec(file: &str, z: u32, stage: [f64; 2], affine: &str) -> String {
    let [x, y] = stage;
    format!(
        r#"{{"tileId": "{file}.{z}", "z": {z}, "width": 60, "height": 50,
            "layout": {{"stageX": {x}, "stageY": {y}}},
            "mipmapLevels": {{"0": {{"imageUrl": "file:///scope/{file}.tif"}}}},
            "transforms": {{"type": "list", "specList": [
                {{"className": "mpicbg.trakem2.transform.AffineModel2D", "dataString": "{affine}"}}]}}}}"#
    )
}

#[tokio::test]
async fn each_kind_of_list_shows_what_its_replay_shows() {
    let names = ["a", "b", "c", "d"];
    let scope = || {
        let scope = Scope::new();
        for (seed, name) in (0..).zip(names) {
            scope.image(name, seed);
        }
        scope
    };
    let plain = "x/a.tif -13.5 7 4\nx/b.tif 40 0 4\nx/c.tif 0 0 5\nx/d.tif 44 1 6\n";

    let with_list = scope();
    write(&with_list.file("list.txt"), plain);
    assert_eq!(is_as_replayed(&with_list.path()).await, 4);

    let with_project = scope();
    write(&with_project.file("list.txt"), plain);
    let refined = project(&[
        &[("a", "1,0,0,1,97,50"), ("b", "1,0.02,0,1,150.5,41")],
        &[("c", "1,0,0.01,1,100,50")],
        &[("d", "0.9,0.01,-0.01,1,144,51")],
    ]);
    write(&with_project.file("work/affine.xml"), refined);
    assert_eq!(is_as_replayed(&with_project.path()).await, 4);

    let of_fiji = scope();
    let tiles = |x: f64| {
        format!(
            "dim = 2\na.tif; ; ({x}, 0)\nb.tif; ; (41.25, -2)\nc.tif; ; (3, 44)\nd.tif; ; (47, 45)\n"
        )
    };
    write(&of_fiji.file("pictures/TileConfiguration.txt"), tiles(0.0));
    assert_eq!(is_as_replayed(&of_fiji.path()).await, 4);
    write(
        &of_fiji.file("pictures/TileConfiguration.registered.txt"),
        tiles(1.75),
    );
    assert_eq!(is_as_replayed(&of_fiji.path()).await, 4);

    let of_render = scope();
    let specs = [
        spec("a", 7, [0.0, 0.0], "1 0.01 -0.01 1 1000 2000"),
        spec("b", 7, [45.0, 0.0], "1 0 0 1 1046 2001"),
        spec("c", 8, [0.0, 1.0], "1 0 0 0.98 1000 2000"),
        spec("d", 8, [45.0, 2.0], "1 0 0 1 1044 1999"),
    ];
    write(
        &of_render.file("specs.json"),
        format!("[{}]", specs.join(",")),
    );
    assert_eq!(is_as_replayed(&of_render.path()).await, 4);

    let deep = scope();
    write(&deep.file("list.txt"), plain);
    write(&deep.file("pictures/c.tif"), tiff16(SIZE));
    assert_eq!(is_as_replayed(&deep.path()).await, 4);
}

/// Real ones, where they are at hand.
#[tokio::test]
#[expect(clippy::print_stderr, reason = "a skipped test says so")]
async fn real_lists_show_what_their_replays_show() {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared");
    let shared = std::env::var_os("SACCADE_SHARED").map_or(beside, PathBuf::from);
    let (tutorial, montage) = (
        shared.join("data/at-tutorial-tiles"),
        shared.join("data/asap-em-montage-json"),
    );
    if !tutorial.is_dir() || !montage.is_dir() {
        eprintln!(
            "skipped: no {}; set SACCADE_SHARED",
            shared.join("data").display()
        );
        return;
    }
    assert_eq!(is_as_replayed(&tutorial).await, 42);

    // The specifications came without their images: others, that are smaller, stand for them.
    let scope = Scope::new();
    let specs = montage.join("em_montage_qc_post_tilespecs.json");
    fs::copy(&specs, scope.file("specs.json")).unwrap();
    for (seed, tile) in (0..).zip(tile_specs::read(&specs).unwrap()) {
        scope.image(tile.name(), seed);
    }
    assert_eq!(is_as_replayed(&scope.path()).await, 46);

    // The same tiles as a list of Fiji's, and by a project alone.
    let scope = Scope::new();
    let list = fs::read_to_string(tutorial.join("DEMO_post_mongo/rick0.txt")).unwrap();
    let mut fiji = "dim = 3\n".to_owned();
    for (seed, line) in (0..).zip(list.lines().filter(|line| !line.trim().is_empty())) {
        let words: Vec<_> = line.split_whitespace().collect();
        let [file, x, y, z] = words[..] else {
            panic!("{line}")
        };
        fiji.push_str(&format!("{file}; ; ({x}, {y}, {z})\n"));
        scope.image(Path::new(file).file_stem().unwrap().to_str().unwrap(), seed);
    }
    write(&scope.file("TileConfiguration.txt"), fiji);
    assert_eq!(is_as_replayed(&scope.path()).await, 42);
    fs::remove_file(scope.file("TileConfiguration.txt")).unwrap();
    let affine = tutorial.join("temp0_final/stack/Affine.xml");
    fs::copy(affine, scope.file("Affine.xml")).unwrap();
    let project = find_list(&scope.path()).unwrap().unwrap();
    let archive = archive(&scope.0.path().join("archive")).await;
    scope.once(config(&project), &archive).await;
    assert_eq!(seen(&archive).await.len(), 42);
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

/// Registration that comes later moves what is there, as far as it refines the list, whose frame stays.
#[tokio::test]
async fn a_solution_that_comes_later_moves_tiles() {
    let scope = Scope::new();
    let list = scope.file("TileConfiguration.txt");
    let registered = scope.file("TileConfiguration.registered.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    let tiles = |far: f64, b: f64| {
        let b = far + b;
        format!(
            "dim = 2\na.tif; ; ({far}, 0)\nb.tif; ; ({b}, 0)\nc.tif; ; ({}, 0)\n",
            far + 90.0
        )
    };
    for (seed, name) in (0..).zip(["a", "b", "c"]) {
        scope.image(name, seed);
    }
    let places = || async {
        let tiles = seen(&archive).await;
        tiles
            .values()
            .map(|tile| tile.transform[4])
            .collect::<Vec<_>>()
    };
    write(&list, tiles(0.0, 45.0));
    scope.once(config(&list), &archive).await;
    assert_eq!(places().await, [0.0, 45.0, 90.0]);
    write(&registered, tiles(1000.0, 46.5));
    scope.once(config(&list), &archive).await;
    assert_eq!(places().await, [0.0, 46.5, 90.0]);
    write(&registered, tiles(1000.0, 44.0));
    scope.once(config(&list), &archive).await;
    assert_eq!(places().await, [0.0, 44.0, 90.0]);
    let records = scope.records();
    assert_eq!(records.len(), 5, "{records:?}");
    // Without it, it is not known where they lie.
    fs::remove_file(&registered).unwrap();
    let mut watch = scope.watch(config(&list));
    let error = follow(&mut watch, Until::End, true, &Cancel::new()).unwrap_err();
    assert!(matches!(error, ListError::List { .. }), "{error}");
    assert_eq!(scope.records(), records);
}

/// Fiji begins wherever the first tile is: what counts is how its places differ from the list's.
#[tokio::test]
async fn registration_that_begins_elsewhere_is_the_same() {
    let scope = Scope::new();
    let list = scope.file("TileConfiguration.txt");
    let registered = scope.file("TileConfiguration.registered.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    let tiles = |at: [f64; 2], places: &[f64]| {
        let [x, y] = at;
        let names = ["a", "b", "c", "d"].iter().zip(places);
        let lines = names.map(|(name, place)| format!("{name}.tif; ; ({}, {y})\n", x + place));
        format!("dim = 2\n{}", lines.collect::<String>())
    };
    for (seed, name) in (0..).zip(["a", "b", "c", "d"]) {
        scope.image(name, seed);
    }
    let places = || async {
        let tiles = seen(&archive).await;
        let places = tiles.values().map(|tile| tile.transform[4..].to_vec());
        places.collect::<Vec<_>>()
    };
    // The list's own corner of the volume stays, whatever registration counts from.
    let config = || ListConfig {
        origin: Some(DVec2::new(5.0, 2.0)),
        ..roomy(&list)
    };
    write(&list, tiles([100.0, 50.0], &[0.0, 45.0, 90.0]));
    write(&registered, tiles([1000.0, 1000.0], &[0.0, 46.5, 90.0]));
    let want = vec![vec![95.0, 48.0], vec![141.5, 48.0], vec![185.0, 48.0]];
    scope.once(config(), &archive).await;
    assert_eq!(places().await, want);
    let told = scope.records().len();
    for corner in [[0.0, 0.0], [-700.25, 3e4], [1000.0, 1000.0]] {
        write(&registered, tiles(corner, &[0.0, 46.5, 90.0]));
        scope.once(config(), &archive).await;
        assert_eq!(places().await, want, "{corner:?}");
    }
    assert_eq!(scope.records().len(), told, "nothing moved");

    // Others, from elsewhere; and the same while somebody follows.
    write(&registered, tiles([0.0, 0.0], &[0.0, 44.0, 90.0]));
    scope.once(config(), &archive).await;
    let other = vec![vec![95.0, 48.0], vec![139.0, 48.0], vec![185.0, 48.0]];
    assert_eq!(places().await, other);
    // One that only knows more moves nothing that is there.
    write(&list, tiles([100.0, 50.0], &[0.0, 45.0, 90.0, 135.0]));
    write(&registered, tiles([0.0, 0.0], &[0.0, 44.0, 90.0, 139.0]));
    scope.once(config(), &archive).await;
    let all = places().await;
    assert_eq!((&all[..3], &all[3][..]), (&other[..], &[234.0, 48.0][..]));
}

/// Of what is nothing to read, nothing is opened, and the rest is taken in.
#[cfg(unix)]
#[tokio::test]
async fn what_is_no_file_is_missing() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    let names = ["a", "b", "c", "d", "e", "f"];
    let lines = names.map(|name| format!("far/{name}.tif 0 0 0\n"));
    write(&list, lines.concat());
    scope.image("a", 1);
    let link = |to: &Path, name: &str| std::os::unix::fs::symlink(to, scope.file(name)).unwrap();
    link(&scope.file("nowhere.tif"), "pictures/b.tif");
    for pipe in ["pictures/c.tif", "piped.txt", "piped.xml", "early/f.tif"] {
        let path = scope.file(pipe);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        let made = std::process::Command::new("mkfifo").arg(&path).status();
        assert!(made.unwrap().success());
    }
    link(Path::new("/dev/zero"), "pictures/d.tif");
    // Of two that have its name, the one that is a file.
    scope.image("f", 6);
    assert_eq!(find_list(&scope.path()).unwrap().as_ref(), Some(&list));
    let watch = scope.once(roomy(&list), &archive).await;
    let missing = watch.missing().unwrap();
    drop(watch);
    let said = [
        "3 of the 6 images that the list names cannot be read",
        r#""pictures/b.tif" is a link to nothing"#,
        r#""pictures/c.tif" is no regular file"#,
        r#""pictures/d.tif" is no regular file"#,
        "1 of the 6 images that the list names are not below",
        r#"such as "far/e.tif""#,
    ];
    for said in said {
        assert!(missing.contains(said), "{missing}");
    }
    let taken: Vec<_> = seen(&archive).await.into_keys().collect();
    assert_eq!(taken, ["a", "f"]);

    // A link may lead to something later, while its folder stays as it is.
    let mut watch = scope.watch(roomy(&list));
    follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
    fs::write(scope.file("nowhere.tif"), tiff8(SIZE, &texture(SIZE, 2))).unwrap();
    follow(&mut watch, Until::End, true, &Cancel::new()).unwrap();
    let missing = watch.missing().unwrap();
    assert!(missing.contains("2 of the 6 images"), "{missing}");
    assert!(!missing.contains("b.tif"), "{missing}");
}

/// A slip in a number binds nobody.
#[tokio::test]
async fn sections_that_no_volume_holds_are_refused_before_anything_is_kept() {
    let scope = Scope::new();
    let archive = archive(&scope.0.path().join("archive")).await;
    scope.image("a", 1);
    scope.image("b", 2);
    let kinds = [
        ("list.txt", "a.tif 0 0 Z\nb.tif 40 0 Y\n", 2),
        (
            "TileConfiguration.txt",
            "dim = 3\na.tif; ; (0, 0, Z)\nb.tif; ; (40, 0, Y)\n",
            3,
        ),
    ];
    for (name, text, line) in kinds {
        let list = scope.file(name);
        let text = text.replace('Z', "7");
        write(&list, text.replace('Y', "2000000000"));
        let mut watch = scope.watch(config(&list));
        let refused = follow(&mut watch, Until::End, true, &Cancel::new()).unwrap_err();
        assert!(
            matches!(refused, ListError::Sections { first: 7, .. }),
            "{refused}"
        );
        let refused = refused.to_string();
        let line = format!("line {line}: ");
        let limit = saccade_core::volume::MAX_EXTENT.to_string();
        for said in [&line, "b.tif", "2000000000", &limit, name] {
            assert!(refused.contains(said), "{refused}");
        }
        drop(watch);
        assert!(!scope.kept().join("volume.json").exists());
        assert!(!scope.kept().join("watched.json").exists());
        fs::remove_file(list).unwrap();
    }
    let list = scope.file("list.txt");
    write(&list, "a.tif 0 0 7\nb.tif 40 0 8\n");
    scope.once(config(&list), &archive).await;
    assert_eq!(seen(&archive).await.len(), 2);
}

#[tokio::test]
async fn it_goes_on_as_it_was_begun_or_not_at_all() {
    let scope = Scope::new();
    let list = scope.file("list.txt");
    let archive = archive(&scope.0.path().join("archive")).await;
    write(&list, "a.tif 100 50 3\nb.tif 140 50 3\n");
    scope.image("a", 1);
    let watch = scope.once(config(&list), &archive).await;
    let missing = watch.missing().unwrap();
    assert!(
        missing.contains("1 of the 2 images") && missing.contains("b.tif"),
        "{missing}"
    );
    drop(watch);
    assert_eq!(
        kept_list(&scope.path(), &scope.kept()),
        Some(list.canonicalize().unwrap())
    );

    // What is listed later lies in the frame that was settled at first.
    scope.image("b", 2);
    scope.image("c", 3);
    write(&list, "a.tif 100 50 3\nb.tif 140 50 3\nc.tif 120 70 3\n");
    let watch = scope.once(config(&list), &archive).await;
    assert_eq!(watch.missing(), None);
    drop(watch);
    let places: Vec<_> = seen(&archive)
        .await
        .values()
        .map(|t| t.transform[4..].to_vec())
        .collect();
    assert_eq!(places, [[0.0, 0.0], [40.0, 0.0], [20.0, 20.0]]);
    let told = scope.records().len();
    // What is said to be as it was settled is so.
    let same = ListConfig {
        origin: Some(DVec2::new(100.0, 50.0)),
        first: Some(3),
        extent: Some(UVec3::new(100, 50, 1)),
        dtype: Some(Dtype::Uint8),
        ..config(&list)
    };
    drop(scope.once(same, &archive).await);
    assert_eq!(scope.records().len(), told, "nothing is told again");

    let other = scope.file("other.txt");
    fs::copy(&list, &other).unwrap();
    for (config, differs) in [
        (
            ListConfig {
                voxel_nm: DVec3::ONE,
                ..config(&list)
            },
            "voxel-nm is 4 x 4 x 40 there",
        ),
        (
            ListConfig {
                scale: 2.0,
                ..config(&list)
            },
            "pixel is 1.0 there, 2.0 now",
        ),
        (
            ListConfig {
                first: Some(2),
                ..config(&list)
            },
            "first is 3 there, 2 now",
        ),
        (
            ListConfig {
                origin: Some(DVec2::ZERO),
                ..config(&list)
            },
            "origin is 100.0 x 50.0 there",
        ),
        (
            ListConfig {
                dtype: Some(Dtype::Uint16),
                ..config(&list)
            },
            "8 bits there, 16 bits now",
        ),
        (roomy(&list), "extent is 100 x 50 x 1 there"),
        (config(&other), "list is list.txt there, other.txt now"),
    ] {
        let refused = ListWatch::open(config, Disk, &scope.path(), &scope.kept());
        let Err(ListError::Watch(WatchError::Other { differences, .. })) = refused.map(|_| ())
        else {
            panic!("{differs}")
        };
        assert!(differences.contains(differs), "{differences}");
    }
    assert!(scope.watch(config(&list)).leads());
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
