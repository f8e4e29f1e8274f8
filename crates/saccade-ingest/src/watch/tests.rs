use std::cell::Cell;
use std::collections::BTreeMap;
use std::path::Path;
use std::rc::Rc;
use std::sync::{Arc, Mutex};
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

/// When a folder was changed, and what is in it.
type Listed = (u64, Vec<Entry>);

/// Of a file that was written then.
fn stamp(at: u64) -> Stamp {
    Stamp {
        bytes: 9,
        modified: Counted::at(at),
        changed: None,
        number: None,
    }
}

/// A file system of numbers, which counts what it is asked.
#[derive(Clone, Default)]
struct Counted {
    folders: Arc<Mutex<BTreeMap<PathBuf, Listed>>>,
    stamps: Arc<Mutex<BTreeMap<PathBuf, u64>>>,
    asked: Rc<Cell<usize>>,
    entries: Arc<std::sync::atomic::AtomicUsize>,
}

impl Counted {
    fn at(time: u64) -> SystemTime {
        SystemTime::UNIX_EPOCH + Duration::from_secs(time)
    }

    fn add(&self, folder: &str, name: &str, is_folder: bool, time: u64) {
        let mut folders = self.folders.lock().unwrap();
        let path = Path::new("/r").join(folder);
        let path = if folder.is_empty() {
            PathBuf::from("/r")
        } else {
            path
        };
        let (modified, entries) = folders.entry(path).or_default();
        *modified = time;
        let name = name.to_owned();
        entries.push(Entry {
            name,
            folder: is_folder,
        });
    }

    /// Questions and entries since the last time.
    fn take(&self) -> usize {
        self.asked.take() + self.entries.swap(0, std::sync::atomic::Ordering::Relaxed)
    }
}

impl Folders for Counted {
    fn modified(&self, folder: &Path) -> io::Result<SystemTime> {
        self.asked.set(self.asked.get() + 1);
        let folders = self.folders.lock().unwrap();
        let (modified, _) = folders.get(folder).ok_or(io::ErrorKind::NotFound)?;
        Ok(Self::at(*modified))
    }

    fn list(
        &self,
        folder: &Path,
    ) -> io::Result<Box<dyn Iterator<Item = io::Result<Entry>> + Send>> {
        self.asked.set(self.asked.get() + 1);
        let entries = self.folders.lock().unwrap()[folder].1.clone();
        let count = Arc::clone(&self.entries);
        Ok(Box::new(entries.into_iter().map(move |entry| {
            count.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
            Ok(entry)
        })))
    }

    fn stamp(&self, file: &Path) -> io::Result<Stamp> {
        self.asked.set(self.asked.get() + 1);
        let stamps = self.stamps.lock().unwrap();
        Ok(stamp(stamps.get(file).copied().unwrap_or(1)))
    }

    fn now(&self) -> SystemTime {
        Self::at(1_000_000)
    }
}

/// Sections of many tiles that were there for ever, listed out of thin air; of the first, one more file from a
/// certain time on.
#[derive(Clone)]
struct Vast {
    sections: usize,
    tiles: usize,
    asked: Rc<Cell<usize>>,
    entries: Arc<std::sync::atomic::AtomicUsize>,
    grown: Rc<Cell<bool>>,
}

impl Vast {
    fn take(&self) -> usize {
        self.asked.take() + self.entries.swap(0, std::sync::atomic::Ordering::Relaxed)
    }
}

impl Folders for Vast {
    fn modified(&self, folder: &Path) -> io::Result<SystemTime> {
        self.asked.set(self.asked.get() + 1);
        let grown = self.grown.get() && folder.ends_with("s0");
        Ok(Counted::at(if grown { 200 } else { 100 }))
    }

    fn list(
        &self,
        folder: &Path,
    ) -> io::Result<Box<dyn Iterator<Item = io::Result<Entry>> + Send>> {
        self.asked.set(self.asked.get() + 1);
        let root = folder == Path::new("/r");
        let more = usize::from(self.grown.get() && folder.ends_with("s0"));
        let count = if root {
            self.sections
        } else {
            self.tiles + more
        };
        let entries = Arc::clone(&self.entries);
        Ok(Box::new((0..count).map(move |n| {
            entries.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
            let name = if root {
                format!("s{n}")
            } else {
                format!("r{n}_c0.tif")
            };
            Ok(Entry { name, folder: root })
        })))
    }

    fn stamp(&self, _: &Path) -> io::Result<Stamp> {
        self.asked.set(self.asked.get() + 1);
        Ok(stamp(1))
    }

    fn now(&self) -> SystemTime {
        Counted::at(1_000_000)
    }
}

/// Resident memory of this process \[bytes\].
fn resident() -> u64 {
    let statm = fs::read_to_string("/proc/self/statm").unwrap();
    let pages: u64 = statm.split(' ').nth(1).unwrap().parse().unwrap();
    pages * 4096
}

/// 200,000 files, or as many as `SACCADE_TEST_FILES` says: no look asks more than its budget, however many
/// there are, also where an earlier process told of all of them; and what came is found by listing its folder
/// alone.
#[test]
fn work_per_look_does_not_grow_with_the_archive() {
    let files = std::env::var("SACCADE_TEST_FILES").map(|n| n.parse().unwrap());
    let (tiles, budget) = (500, WatchConfig::BUDGET);
    let sections = files.unwrap_or(200_000_usize).div_ceil(tiles);
    let disk = Vast {
        sections,
        tiles,
        asked: Rc::default(),
        entries: Arc::default(),
        grown: Rc::default(),
    };
    let pattern = pattern("s{section}/r{row}_c{column}.tif");
    let before = resident();
    for known in [false, true] {
        disk.grown.set(false);
        let mut scanner = Scanner::new(disk.clone(), Path::new("/r"), pattern.clone());
        if known {
            scanner.told_until(Counted::at(50));
            for n in 0..sections * tiles {
                scanner.remember(&format!("s{}/r{}_c0.tif", n / tiles, n % tiles));
            }
        }
        let (mut found, mut looks, mut longest) = (0, 0, Duration::ZERO);
        loop {
            let look = SystemTime::now();
            let (new, next) = scanner.look(budget).unwrap();
            longest = longest.max(SystemTime::now().duration_since(look).unwrap_or_default());
            let asked = disk.take();
            assert!(asked <= budget + 2, "{asked} questions");
            found += new.len();
            looks += 1;
            if next == Next::Rest {
                break;
            }
        }
        assert_eq!(found, if known { 0 } else { sections * tiles });
        assert!(looks >= 2 * sections * tiles / budget, "{looks} looks");
        // A file comes: it is found within one round, which asks each folder once, and lists one.
        disk.grown.set(true);
        let (mut new, mut asked) = (Vec::new(), 0);
        for _ in 0..sections / budget + 2 {
            new.extend(scanner.look(budget).unwrap().0);
            let now = disk.take();
            assert!(now <= budget + 2, "{now} questions");
            asked += now;
        }
        assert_eq!(new.len(), 1);
        assert_eq!(new[0].file, format!("s0/r{tiles}_c0.tif"));
        assert!(asked <= 2 * (sections + 2 * budget), "{asked} questions");
        let measured = format!(
            "{} files, told of before: {known}: {looks} looks, the longest {longest:?}; {} MB\n",
            sections * tiles,
            (resident() - before) >> 20
        );
        io::Write::write_all(&mut io::stdout(), measured.as_bytes()).unwrap();
    }
}

/// However much there is, a look asks so many questions; and once all is known, only folders are asked.
#[test]
fn a_look_at_a_large_archive_is_a_bounded_number_of_questions() {
    let (sections, tiles, budget) = (400, 250, 5_000);
    let disk = Counted::default();
    for section in 0..sections {
        disk.add("", &format!("s{section}"), true, 100);
        for tile in 0..tiles {
            disk.add(
                &format!("s{section}"),
                &format!("r{tile}_c0.tif"),
                false,
                100,
            );
        }
        disk.add(&format!("s{section}"), "notes.txt", false, 100);
    }
    let pattern = pattern("s{section}/r{row}_c{column}.tif");
    let mut scanner = Scanner::new(disk.clone(), Path::new("/r"), pattern);
    let (mut found, mut looks) = (0, 0);
    loop {
        let (new, next) = scanner.look(budget).unwrap();
        let asked = disk.take();
        assert!(asked <= budget + 2, "{asked} questions");
        found += new.len();
        looks += 1;
        assert!(looks < 100, "it comes to an end");
        if next == Next::Rest {
            break;
        }
    }
    assert_eq!(found, sections * tiles);
    assert!(looks >= sections * tiles / budget);

    // Nothing new: the folders, and nothing in them.
    let (new, next) = scanner.look(budget).unwrap();
    assert_eq!((new.len(), next), (0, Next::Rest));
    assert_eq!(disk.take(), sections + 1);
    // One new file: that folder alone is listed.
    disk.add("s77", "r900_c1.tif", false, 200);
    let (new, _) = scanner.look(budget).unwrap();
    assert_eq!(new[0].file, "s77/r900_c1.tif");
    assert_eq!((new[0].place.section, new[0].place.row), (77, 900));
    let asked = disk.take();
    assert!(asked <= sections + 1 + 2 * (tiles + 4), "{asked} questions");
    // A file put in the place of another.
    disk.stamps
        .lock()
        .unwrap()
        .insert("/r/s5/r7_c0.tif".into(), 300);
    disk.add("s5", ".other", false, 300);
    let (new, _) = scanner.look(budget).unwrap();
    assert_eq!(
        new.iter().map(|f| &*f.file).collect::<Vec<_>>(),
        ["s5/r7_c0.tif"]
    );
}

/// A folder that changes in the tick in which it is listed is listed again.
#[test]
fn a_file_that_comes_while_its_folder_is_listed_is_found() {
    let disk = Counted::default();
    disk.add("", "s1.tif", false, 1_000_000);
    let mut scanner = Scanner::new(disk.clone(), Path::new("/r"), pattern("s{section}.tif"));
    let (new, next) = scanner.look(100).unwrap();
    assert_eq!((new.len(), next), (1, Next::Again));
    disk.add("", "s2.tif", false, 1_000_000);
    let (new, _) = scanner.look(100).unwrap();
    assert_eq!(new.len(), 1);
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

/// Looks for so long, as often as it would.
fn look_for(watch: &mut Watch<Disk>, seconds: f64) {
    let end = SystemTime::now() + Duration::from_secs_f64(seconds);
    while SystemTime::now() < end {
        looks(watch);
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Copying programs set a file's space aside, and fill it.
#[test]
fn a_file_that_is_filled_after_it_was_told_of_is_told_of_again() {
    let folder = tempfile::tempdir().unwrap();
    let (scope, kept) = (folder.path().join("scope"), folder.path().join("kept"));
    let path = scope.join("s1/r1_c1_a.tif");
    image(&path, 32, 1);
    let mut watch = Watch::open(config(), Disk, &scope, &kept).unwrap();
    look_for(&mut watch, 0.5);
    assert_eq!(told(&kept).len(), 1);
    let bytes = fs::read(&path).unwrap();
    for n in 0..4 {
        // In place: its folder does not change.
        let file = fs::OpenOptions::new().write(true).open(&path).unwrap();
        std::os::unix::fs::FileExt::write_all_at(&file, &[n], bytes.len() as u64 - 1).unwrap();
        look_for(&mut watch, 0.6);
    }
    look_for(&mut watch, 2.5);
    // Not for each of its parts.
    assert_eq!(told(&kept).len(), 2);
    look_for(&mut watch, 1.5);
    drop(watch);
    look_for(
        &mut Watch::open(config(), Disk, &scope, &kept).unwrap(),
        1.5,
    );
    assert_eq!(told(&kept).len(), 2, "once is enough");
}

/// With the length and the time of the old one, as copying programs keep them: while it is watched, and while nobody
/// does.
#[test]
fn a_file_that_is_renamed_over_another_is_told_of() {
    let folder = tempfile::tempdir().unwrap();
    let (scope, kept) = (folder.path().join("scope"), folder.path().join("kept"));
    let path = scope.join("s1/r1_c1_a.tif");
    let long_ago = SystemTime::now() - Duration::from_secs(3600);
    let replace = |value| {
        image(&path, 32, value);
        let file = fs::OpenOptions::new().write(true).open(&path).unwrap();
        file.set_modified(long_ago).unwrap();
    };
    replace(1);
    let mut watch = Watch::open(config(), Disk, &scope, &kept).unwrap();
    look_for(&mut watch, 0.5);
    replace(2);
    look_for(&mut watch, 3.0);
    assert_eq!(told(&kept).len(), 2);
    drop(watch);
    replace(3);
    // Links and permissions are another matter.
    looks(&mut Watch::open(config(), Disk, &scope, &kept).unwrap());
    assert_eq!(told(&kept).len(), 3);
    fs::hard_link(&path, folder.path().join("link")).unwrap();
    looks(&mut Watch::open(config(), Disk, &scope, &kept).unwrap());
    assert_eq!(told(&kept).len(), 3);
    // As a process left it that died when it had told and not kept what the file looked like.
    let kept_stamps = fs::read(kept.join("stamps")).unwrap();
    fs::write(kept.join("stamps"), &kept_stamps[..kept_stamps.len() - 16]).unwrap();
    looks(&mut Watch::open(config(), Disk, &scope, &kept).unwrap());
    assert_eq!(told(&kept).len(), 3);
    // As an earlier version left it: times alone count, and nothing comes again.
    fs::remove_file(kept.join("stamps")).unwrap();
    looks(&mut Watch::open(config(), Disk, &scope, &kept).unwrap());
    assert_eq!(told(&kept).len(), 3);
}

/// Files are looked at again for half a minute, so many at a time, and each folder is listed no more for that.
#[test]
fn looks_at_young_files_are_a_part_of_the_budget_and_end() {
    let disk = Young::default();
    let mut scanner = Scanner::new(disk.clone(), Path::new("/r"), pattern("s{section}.tif"));
    let budget = 20;
    let mut asked = Vec::new();
    for tick in 0..400 {
        disk.now.set(tick);
        scanner.look(budget).unwrap();
        asked.push(disk.asked.take());
    }
    let most = asked.iter().max().unwrap();
    assert!(*most <= budget + 2, "{most} questions");
    // Ticks are a quarter of a second. At first all is listed; then each is asked each second.
    let sum = |ticks: std::ops::Range<usize>| asked[ticks].iter().sum::<usize>();
    let later = sum(60..100);
    assert!((300..=10 * Young::FILES + 50).contains(&later), "{later}");
    assert!(sum(360..400) <= 40, "only the folder");
}

/// Some files that have come just now, and time that passes.
#[derive(Clone, Default)]
struct Young {
    now: Rc<Cell<u64>>,
    asked: Rc<Cell<usize>>,
}

impl Young {
    const FILES: usize = 30;
    const BEGIN: u64 = 1_000_000;
}

impl Folders for Young {
    fn modified(&self, _: &Path) -> io::Result<SystemTime> {
        self.asked.set(self.asked.get() + 1);
        Ok(Counted::at(Self::BEGIN - 10))
    }

    fn list(&self, _: &Path) -> io::Result<Box<dyn Iterator<Item = io::Result<Entry>> + Send>> {
        self.asked.set(self.asked.get() + 1);
        let entry = |n| {
            Ok(Entry {
                name: format!("s{n}.tif"),
                folder: false,
            })
        };
        Ok(Box::new((0..Self::FILES).map(entry)))
    }

    fn stamp(&self, _: &Path) -> io::Result<Stamp> {
        self.asked.set(self.asked.get() + 1);
        Ok(stamp(Self::BEGIN - 10))
    }

    fn now(&self) -> SystemTime {
        Counted::at(Self::BEGIN)
            + Duration::from_millis(250) * u32::try_from(self.now.get()).unwrap()
    }
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
