mod again;
mod conformance;
mod moved;
mod scanner;

use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

use glam::{DVec3, UVec3};
use saccade_archive::image::GrayImage;

use super::*;
use crate::simulate::write::write_part;

fn pattern(text: &str) -> Pattern {
    let pattern: Pattern = text.parse().unwrap();
    assert_eq!(pattern.to_string(), text);
    pattern
}

/// What follows a field may begin within what looks like it, and what many fields can end in is not gone through for each.
#[test]
fn all_ways_in_which_a_name_fits_are_tried_and_each_once() {
    let overlapping = pattern("{}_0_{row}.tif{section}");
    let place = overlapping.file("x_0_0_5.tif1", &Place::default());
    assert_eq!(place.map(|place| place.row), Some(5));
    let fields = "{}a".repeat(40);
    let many = pattern(&format!("{fields}{{section}}"));
    let name = "a".repeat(250);
    // One by one, it would be no end of them.
    assert_eq!(many.file(&format!("{name}x"), &Place::default()), None);
    let place = many.file(&format!("{name}7"), &Place::default());
    assert_eq!(place.map(|place| place.section), Some(7));
    let why = many.mismatch(&format!("{name}x"), false);
    assert!(why.is_some_and(|why| why.contains("a number for {section}")));
}

#[test]
fn names_say_where() {
    let place = |section, row, column, channel: Option<&str>| Place {
        section,
        row,
        column,
        channel: channel.map(str::to_owned),
    };
    let flat = pattern("s{section}_r{row}_c{column}.tif");
    let none = Place::default();
    assert_eq!(flat.depth(), 0);
    assert_eq!(
        flat.file("s012_r3_c10.tif", &none),
        Some(place(12, 3, 10, None))
    );
    for other in [
        "s_r3_c1.tif",
        "s1_r3_c1.tiff",
        "xs1_r3_c1.tif",
        "s1_r3_c1",
        "",
        "s1_r3_c99999999999.tif",
    ] {
        assert_eq!(flat.file(other, &none), None, "{other}");
    }
    let deep = pattern("run{}/Sec{section}/{row}-{column}_{channel}_{}.png");
    assert_eq!(deep.depth(), 2);
    let run = deep.folder(0, "run of May", &none).unwrap();
    let section = deep.folder(1, "Sec7", &run).unwrap();
    assert_eq!(deep.folder(1, "Section7", &run), None);
    assert_eq!(deep.folder(2, "Sec7", &section), None, "a file's place");
    let seen = deep.file("4-5_SE_2_x.png", &section);
    assert_eq!(seen, Some(place(7, 4, 5, Some("SE"))));
    assert_eq!(
        deep.file("4-5__x.png", &section),
        None,
        "a channel has a name"
    );
    for bad in [
        "r{row}.tif",
        "{section}{row}",
        "s{section",
        "{section}{depth}",
        "{section}_{section}",
        "a//{section}",
        "../{section}",
    ] {
        assert!(bad.parse::<Pattern>().is_err(), "{bad}");
    }
}

fn image(path: &Path, size: u32, value: u8) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let voxels = vec![value; (size * size) as usize];
    let part = write_part(path, &GrayImage::new(size, size, voxels)).unwrap();
    fs::rename(part, path).unwrap();
}

fn config() -> WatchConfig {
    let mut info = AcquisitionInfo::new("v", UVec3::new(500, 500, 9), DVec3::ONE);
    info.channels = vec!["a".to_owned(), "b".to_owned()];
    WatchConfig {
        pattern: "s{section}/r{row}_c{column}_{channel}.tif".parse().unwrap(),
        info,
        pitch: DVec2::new(90.0, 80.0),
        scale: 2.0,
        first: 1,
        poll: Duration::from_millis(500),
        budget: 7,
        moved: false,
    }
}

fn told(kept: &Path) -> Vec<TileRecord> {
    let mut reader = RecordReader::new(kept, Cursor::default());
    let lines = reader.read(999).unwrap();
    let tile = |record| match record {
        Record::Tile(tile) => tile,
        other => panic!("{other:?}"),
    };
    lines
        .into_iter()
        .map(|line| tile(line.record.unwrap()))
        .collect()
}

/// All looks until there is nothing to do at once.
fn looks(watch: &mut Watch<Disk>) {
    while watch.look().unwrap().1 == Next::More {}
}

/// What is recorded last is seen where two are equally near, and of files that mean one tile: the same for who comes late.
#[test]
fn files_that_are_found_at_once_are_told_in_the_order_in_which_they_were_written() {
    let folder = tempfile::tempdir().unwrap();
    let (scope, kept) = (folder.path().join("scope"), folder.path().join("kept"));
    let order = [
        "s3/r2_c1_b.tif",
        "s1/r9_c9_a.tif",
        "s3/r1_c4_b.tif",
        "s2/r1_c1_a.tif",
    ];
    for (file, age) in order.iter().rev().zip(1..) {
        let path = scope.join(file);
        image(&path, 40, 9);
        let written = SystemTime::now() - Duration::from_secs(100 * age);
        let file = fs::File::options().write(true).open(&path).unwrap();
        file.set_modified(written).unwrap();
    }
    let config = WatchConfig {
        budget: 99,
        ..config()
    };
    let mut watch = Watch::open(config, Disk, &scope, &kept).unwrap();
    looks(&mut watch);
    let told = told(&kept);
    let files: Vec<_> = told.iter().map(|tile| file_name(&tile.file)).collect();
    assert_eq!(files, order);
}

#[test]
fn records_are_written_once_also_by_another_process() {
    let folder = tempfile::tempdir().unwrap();
    let (scope, kept) = (folder.path().join("scope"), folder.path().join("kept"));
    for column in 1..4 {
        image(&scope.join(format!("s3/r2_c{column}_b.tif")), 40, 9);
    }
    let mut watch = Watch::open(config(), Disk, &scope, &kept).unwrap();
    looks(&mut watch);
    looks(&mut watch);
    let mut tiles = told(&kept);
    tiles.sort_by(|a, b| a.tile.cmp(&b.tile));
    assert_eq!(tiles.len(), 3);
    assert_eq!(
        (&*tiles[0].tile, tiles[0].section, tiles[0].size),
        ("s3_r2_c1_b", 2, UVec2::splat(40))
    );
    assert_eq!(
        tiles[2].transform.elements(),
        [2.0, 0.0, 0.0, 2.0, 180.0, 80.0]
    );
    assert_eq!(tiles[0].channel_among(&config().info.channels), Some(1));
    let path = saccade_archive::acquisition::image_path(&kept, &tiles[1].file).unwrap();
    assert!(path.is_file(), "ingest finds it through the link");
    drop(watch);

    // Another process, after one more came and one was imaged again.
    image(&scope.join("s4/r1_c1_a.tif"), 40, 9);
    std::thread::sleep(Duration::from_millis(20));
    image(&scope.join("s3/r2_c2_b.tif"), 48, 10);
    let mut watch = Watch::open(config(), Disk, &scope, &kept).unwrap();
    looks(&mut watch);
    let names: Vec<_> = told(&kept)[3..]
        .iter()
        .map(|t| (t.tile.clone(), t.size.x))
        .collect();
    let want = [("s3_r2_c2_b", 48), ("s4_r1_c1_a", 40)].map(|(name, size)| (name.to_owned(), size));
    let mut sorted = names.clone();
    sorted.sort();
    assert_eq!(sorted, want);

    // Another folder is not mixed in.
    let refused = Watch::open(config(), Disk, folder.path(), &kept)
        .err()
        .unwrap();
    assert!(refused.to_string().contains("folder is "), "{refused}");
}

/// A change of an option, and what is said of it.
type Otherwise = (fn(&mut WatchConfig), &'static str);

#[test]
fn a_folder_is_watched_on_with_the_same_options_alone() {
    let folder = tempfile::tempdir().unwrap();
    let (scope, kept) = (folder.path().join("scope"), folder.path().join("kept"));
    image(&scope.join("s3/r2_c1_b.tif"), 40, 9);
    looks(&mut Watch::open(config(), Disk, &scope, &kept).unwrap());
    let others: [Otherwise; 8] = [
        (
            |c| c.pitch.y = 81.0,
            "pitch is 90.0 x 80.0 there, 90.0 x 81.0 now",
        ),
        (|c| c.scale = 1.0, "pixel is 2.0 there, 1.0 now"),
        (|c| c.first = 0, "first is 1 there, 0 now"),
        (
            |c| c.pattern = "s{section}/r{column}_c{row}_{channel}.tif".parse().unwrap(),
            "pattern is s{section}/r{row}_c{column}_{channel}.tif there, \
             s{section}/r{column}_c{row}_{channel}.tif now",
        ),
        (
            |c| c.info.extent.x = 1,
            "extent is 500 x 500 x 9 there, 1 x 500 x 9 now",
        ),
        (
            |c| c.info.voxel_nm.z = 2.0,
            "voxel-nm is 1 x 1 x 1 there, 1 x 1 x 2 now",
        ),
        (
            |c| c.info.channels.reverse(),
            "channels is a,b there, b,a now",
        ),
        (
            |c| c.info.dtype = saccade_core::volume::Dtype::Uint16,
            "voxel is 8 bits there, 16 bits now",
        ),
    ];
    for known in [true, false] {
        for (change, said) in others {
            let mut other = config();
            change(&mut other);
            let opened = Watch::open(other, Disk, &scope, &kept).map(|_| ());
            let told = opened.map_err(|e| e.to_string()).err().unwrap();
            let end = "; give the same options";
            assert!(told.contains(&format!(": {said}{end}")), "{told}");
            assert!(told.contains("--volume NAME"), "{told}");
        }
        // What looks and rates are like may change.
        let mut same = config();
        (same.budget, same.poll) = (99, Duration::ZERO);
        if known {
            // As an earlier version left it: it is asked once more.
            fs::remove_file(kept.join(SETTINGS)).unwrap();
        }
        looks(&mut Watch::open(same, Disk, &scope, &kept).unwrap());
        assert_eq!(told(&kept).len(), 1);
    }
}

#[test]
fn a_folder_that_moved_is_watched_on_and_another_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let (scope, kept) = (folder.path().join("scope"), folder.path().join("kept"));
    image(&scope.join("s3/r2_c1_b.tif"), 40, 9);
    looks(&mut Watch::open(config(), Disk, &scope, &kept).unwrap());
    assert_eq!(told(&kept).len(), 1);
    let other = folder.path().join("other");
    fs::create_dir_all(&other).unwrap();
    let opened = Watch::open(config(), Disk, &other, &kept).map(|_| ());
    let refused = opened.unwrap_err().to_string();
    assert!(refused.contains("folder is"), "{refused}");
    let moved = folder.path().join("moved");
    fs::rename(&scope, &moved).unwrap();
    looks(&mut Watch::open(config(), Disk, &moved, &kept).unwrap());
    assert_eq!(told(&kept).len(), 1, "what was told is known");
    image(&moved.join("s3/r2_c2_b.tif"), 40, 11);
    looks(&mut Watch::open(config(), Disk, &moved, &kept).unwrap());
    assert_eq!(told(&kept).len(), 2);
}

#[test]
fn a_mistake_that_took_nothing_in_binds_nobody() {
    let folder = tempfile::tempdir().unwrap();
    let (scope, kept) = (folder.path().join("scope"), folder.path().join("kept"));
    let other = folder.path().join("other");
    fs::create_dir_all(&other).unwrap();
    image(&scope.join("s3/r2_c1_b.tif"), 40, 9);
    let mut wrong = config();
    wrong.pattern = "x{section}.tif".parse().unwrap();
    wrong.info.extent.x = 7;
    let watch = Watch::open(wrong, Disk, &other, &kept).unwrap();
    let busy = Watch::open(config(), Disk, &scope, &kept).map(drop);
    assert!(matches!(busy, Err(WatchError::Other { .. })), "it is at it");
    drop(watch);
    let mut watch = Watch::open(config(), Disk, &scope, &kept).unwrap();
    looks(&mut watch);
    assert_eq!(told(&kept).len(), 1);
    assert_eq!(AcquisitionInfo::read(&kept).unwrap(), config().info);
    let file = told(&kept)[0].file.clone();
    assert!(
        kept.join(file).is_file(),
        "the link leads to the right folder"
    );
}

#[test]
fn a_pattern_that_fits_nothing_is_explained() {
    let deep = pattern("s{section}/r{row}_c{column}_{channel}.tif");
    let why = |path: &str| deep.mismatch(path, false).unwrap();
    for (path, said) in [
        (
            "x1/r2_c3_a.tif",
            r#""x1" begins otherwise where "s" should be"#,
        ),
        (
            "sx/r2_c3_a.tif",
            r#"after "s" comes "x" where a number for {section} should be"#,
        ),
        (
            "s1x/r2_c3_a.tif",
            r#"after "s1" comes "x" where nothing more should be"#,
        ),
        (
            "s1/r2-c3_a.tif",
            r#"after "r2" comes "-c3_a.tif" where "_c" should be"#,
        ),
        (
            "s1/r2_c3_a.tiff",
            r#"after "r2_c3_a.tif" comes "f" where nothing more should be"#,
        ),
        (
            "s1/r2_c3_a.png",
            r#"after "r2_c3_" comes "a.png" where ".tif" should be"#,
        ),
        (
            "s1/r2_c3_.tif",
            r#"after "r2_c3_" comes ".tif" where a name for {channel} should be"#,
        ),
        ("s1/r2_c3", r#""r2_c3" ends where "_" should be"#),
        ("s1", "it lies 0 folders deep, the pattern's files 1"),
    ] {
        assert_eq!(why(path), said, "{path}");
    }
    assert_eq!(deep.mismatch("s1/r2_c3_a.tif", false), None);
    assert_eq!(deep.mismatch("s1", true), None);

    let folder = tempfile::tempdir().unwrap();
    let (scope, kept) = (folder.path().join("scope"), folder.path().join("kept"));
    fs::create_dir_all(scope.join("s4")).unwrap();
    let mut watch = Watch::open(config(), Disk, &scope, &kept).unwrap();
    looks(&mut watch);
    assert_eq!(watch.unmatched(), None, "nothing is there yet");
    fs::create_dir(scope.join("section 1")).unwrap();
    looks(&mut watch);
    let said = watch.unmatched().unwrap();
    assert!(
        said.contains(r#"such as "section 1": after "s" comes"#),
        "{said}"
    );
    fs::write(scope.join("s4/r1.tif"), "").unwrap();
    fs::write(scope.join("s4/.hidden"), "").unwrap();
    drop(watch);
    let mut watch = Watch::open(config(), Disk, &scope, &kept).unwrap();
    looks(&mut watch);
    let said = watch.unmatched().unwrap();
    for part in [
        "s{section}/r{row}_c{column}_{channel}.tif",
        "2 files and 2 folders",
        r#"such as "s4/r1.tif": after "r1" comes ".tif" where "_c" should be"#,
    ] {
        assert!(said.contains(part), "{part:?} is not in: {said}");
    }
    image(&scope.join("s4/r1_c1_a.tif"), 32, 1);
    looks(&mut watch);
    assert_eq!(watch.unmatched(), None);
}

#[test]
fn a_file_without_its_head_is_looked_at_again() {
    let folder = tempfile::tempdir().unwrap();
    let (scope, kept) = (folder.path().join("scope"), folder.path().join("kept"));
    fs::create_dir_all(scope.join("s1")).unwrap();
    let path = scope.join("s1/r1_c1_a.tif");
    fs::write(&path, b"II").unwrap();
    let mut watch = Watch::open(config(), Disk, &scope, &kept).unwrap();
    looks(&mut watch);
    assert_eq!(told(&kept), []);
    image(&path, 32, 1);
    looks(&mut watch);
    assert_eq!(told(&kept)[0].size, UVec2::splat(32));
    // What never becomes an image is told as well: ingest says what is wrong with it. But not while it grows.
    let other = scope.join("s1/r1_c2_a.tif");
    fs::write(&other, b"GIF89a, not a TIFF").unwrap();
    watch.config.poll = Duration::from_millis(2);
    for n in 0..10 {
        looks(&mut watch);
        std::thread::sleep(Duration::from_millis(60));
        fs::write(&other, vec![b'G'; n + 20]).unwrap();
    }
    assert_eq!(told(&kept).len(), 1, "it has not rested for long enough");
    looks(&mut watch);
    std::thread::sleep(Duration::from_millis(300));
    looks(&mut watch);
    assert!(told(&kept).iter().any(|t| t.tile == "s1_r1_c2_a"));
}

/// A list that takes so many records, and no more until there is room.
struct Full {
    to: saccade_archive::acquisition::RecordWriter,
    room: Arc<std::sync::atomic::AtomicUsize>,
}

impl list::Append for Full {
    fn append(&mut self, record: &Record) -> Result<(), AcquisitionError> {
        use std::sync::atomic::Ordering::SeqCst;
        let took = |room: usize| room.checked_sub(1);
        if self.room.fetch_update(SeqCst, SeqCst, took).is_err() {
            return Err(AcquisitionError::Write {
                source: io::ErrorKind::StorageFull.into(),
                path: "list".into(),
            });
        }
        self.to.append(record)
    }

    fn sync(&self) -> Result<(), AcquisitionError> {
        self.to.sync()
    }
}

/// What cannot be written is kept, and nothing more is looked for; then it is told, once.
#[test]
fn a_list_that_cannot_grow_is_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let (scope, kept) = (folder.path().join("scope"), folder.path().join("kept"));
    for column in 1..10 {
        image(&scope.join(format!("s3/r2_c{column}_b.tif")), 16, 9);
    }
    let mut watch = Watch::open(config(), Disk, &scope, &kept).unwrap();
    let room = Arc::new(std::sync::atomic::AtomicUsize::new(2));
    let to = saccade_archive::acquisition::RecordWriter::open(&kept).unwrap();
    let full = Full {
        to,
        room: room.clone(),
    };
    watch.list.as_mut().unwrap().replace(Box::new(full));
    let mut failed = 0;
    while failed < 5 {
        match watch.look() {
            Ok(_) => {}
            Err(e) => {
                assert!(e.is_full(), "{e}");
                failed += 1;
            }
        }
    }
    assert_eq!(told(&kept).len(), 2);
    assert!(watch.untold.len() <= config().budget, "it went on");
    let cancel = Cancel::new();
    std::thread::scope(|s| {
        s.spawn(|| {
            std::thread::sleep(Duration::from_millis(50));
            room.store(100, std::sync::atomic::Ordering::SeqCst);
        });
        run(&mut watch, true, &cancel).unwrap();
    });
    let mut names: Vec<_> = told(&kept).into_iter().map(|t| t.tile).collect();
    names.sort();
    let want: Vec<_> = (1..10).map(|c| format!("s3_r2_c{c}_b")).collect();
    assert_eq!(names, want);
}

/// Of two that watch the same folder one writes; when it ends, the other goes on where it was.
#[test]
fn one_of_two_watchers_writes() {
    let folder = tempfile::tempdir().unwrap();
    let (scope, kept) = (folder.path().join("scope"), folder.path().join("kept"));
    image(&scope.join("s1/r1_c1_a.tif"), 16, 1);
    let mut first = Watch::open(config(), Disk, &scope, &kept).unwrap();
    let mut second = Watch::open(config(), Disk, &scope, &kept).unwrap();
    assert_eq!((first.leads(), second.leads()), (true, false));
    looks(&mut second);
    assert_eq!(told(&kept), []);
    looks(&mut first);
    image(&scope.join("s1/r1_c2_a.tif"), 16, 2);
    looks(&mut second);
    assert_eq!(told(&kept).len(), 1);
    // It ends in the middle of a line.
    drop(first);
    let mut list = fs::OpenOptions::new();
    let mut list = list
        .append(true)
        .open(kept.join(RecordReader::FILE))
        .unwrap();
    io::Write::write_all(&mut list, b"{\"record\":\"ti").unwrap();
    looks(&mut second);
    assert!(second.leads());
    let names: Vec<_> = told(&kept).into_iter().map(|t| t.tile).collect();
    assert_eq!(names, ["s1_r1_c1_a", "s1_r1_c2_a"]);
}

/// The disk, which is away for some looks.
struct Away {
    looks: std::sync::atomic::AtomicUsize,
}

impl Away {
    fn ask<T>(&self, ask: impl FnOnce() -> io::Result<T>) -> io::Result<T> {
        use std::sync::atomic::Ordering::SeqCst;
        let one_less = |looks: usize| looks.checked_sub(1);
        match self.looks.fetch_update(SeqCst, SeqCst, one_less) {
            Ok(_) => Err(io::ErrorKind::StaleNetworkFileHandle.into()),
            Err(_) => ask(),
        }
    }
}

impl Folders for Away {
    fn modified(&self, folder: &Path) -> io::Result<SystemTime> {
        self.ask(|| Disk.modified(folder))
    }

    fn list(
        &self,
        folder: &Path,
    ) -> io::Result<Box<dyn Iterator<Item = io::Result<Entry>> + Send>> {
        self.ask(|| Disk.list(folder))
    }

    fn stamp(&self, file: &Path) -> io::Result<Stamp> {
        Disk.stamp(file)
    }

    fn now(&self) -> SystemTime {
        Disk.now()
    }
}

/// A stream waits for its share as long as it takes; who waits for the end is told.
#[test]
fn a_folder_that_is_away_is_waited_for() {
    for once in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let (scope, kept) = (folder.path().join("scope"), folder.path().join("kept"));
        image(&scope.join("s3/r2_c1_b.tif"), 16, 9);
        let quick = WatchConfig {
            poll: Duration::from_millis(2),
            ..config()
        };
        let looks = std::sync::atomic::AtomicUsize::new(60);
        let mut watch = Watch::open(quick, Away { looks }, &scope, &kept).unwrap();
        let cancel = Cancel::new();
        let ended = std::thread::scope(|s| {
            s.spawn(|| {
                let end = SystemTime::now() + Duration::from_secs(30);
                while told(&kept).is_empty() && SystemTime::now() < end {
                    std::thread::sleep(Duration::from_millis(10));
                    if once {
                        return;
                    }
                }
                cancel.cancel();
            });
            run(&mut watch, once, &cancel)
        });
        match ended {
            Ok(found) => assert!(!once && found == 1, "{found} found"),
            Err(e) => assert!(once && matches!(e, WatchError::Look { .. }), "{e}"),
        }
    }
}

/// Workers that are started together.
#[test]
fn of_several_that_link_a_folder_at_once_all_succeed() {
    let folder = tempfile::tempdir().unwrap();
    let watched = folder.path().canonicalize().unwrap();
    let turns = std::sync::Barrier::new(4);
    for turn in 0..50 {
        let kept = folder.path().join(turn.to_string());
        fs::create_dir(&kept).unwrap();
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    turns.wait();
                    assert!(!link(&watched, &kept).unwrap());
                });
            }
        });
        assert_eq!(fs::read_link(kept.join(LINK)).unwrap(), watched);
    }
}
