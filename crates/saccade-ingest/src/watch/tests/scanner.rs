//! Of the scanner alone, on file systems of numbers.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::rc::Rc;
use std::sync::{Arc, Mutex};

use super::*;

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
    /// Seconds that have passed.
    passed: Rc<Cell<u64>>,
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
        let folders = self.folders.lock().unwrap();
        let (_, entries) = folders.get(folder).ok_or(io::ErrorKind::NotFound)?;
        let entries = entries.clone();
        let count = Arc::clone(&self.entries);
        Ok(Box::new(entries.into_iter().map(move |entry| {
            count.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
            Ok(entry)
        })))
    }

    fn stamp(&self, file: &Path) -> io::Result<Stamp> {
        self.asked.set(self.asked.get() + 1);
        let folders = self.folders.lock().unwrap();
        let listed = file.parent().and_then(|folder| folders.get(folder));
        let is_there =
            listed.is_some_and(|(_, all)| all.iter().any(|entry| file.ends_with(&entry.name)));
        if !is_there {
            return Err(io::ErrorKind::NotFound.into());
        }
        let stamps = self.stamps.lock().unwrap();
        Ok(stamp(stamps.get(file).copied().unwrap_or(1)))
    }

    fn now(&self) -> SystemTime {
        Self::at(1_000_000 + self.passed.get())
    }
}

#[test]
fn the_file_system_of_numbers_conforms() {
    let disk = Counted::default();
    disk.folders
        .lock()
        .unwrap()
        .insert("/r".into(), (1, Vec::new()));
    let add = |path: &str, is_folder: bool| {
        let (folder, name) = path.rsplit_once('/').unwrap_or(("", path));
        disk.add(folder, name, is_folder, 1);
        if is_folder {
            let path = Path::new("/r").join(path);
            disk.folders.lock().unwrap().insert(path, (1, Vec::new()));
        }
    };
    conformance::conforms(&disk, Path::new("/r"), add);
}

/// One that is not whole is told of after a while; whoever writes it may still go on, and its folder does not change.
#[test]
fn a_file_of_which_more_is_expected_is_looked_at_again() {
    let disk = Counted::default();
    disk.add("", "s1.tif", false, 1);
    let pattern = "s{section}.tif".parse().unwrap();
    let mut scanner = Scanner::new(disk.clone(), Path::new("/r"), pattern);
    let after = |seconds: u64, scanner: &mut Scanner<Counted>| {
        let mut all = Vec::new();
        for _ in 0..seconds {
            disk.passed.set(disk.passed.get() + 1);
            all.extend(scanner.look(9).unwrap().0);
        }
        all
    };
    let [found] = after(4, &mut scanner).try_into().unwrap();
    scanner.tells(&found.file, stamp(1));
    let fill = |at: u64| {
        let path = PathBuf::from("/r/s1.tif");
        disk.stamps.lock().unwrap().insert(path, at);
    };
    fill(2);
    assert!(
        after(9, &mut scanner).is_empty(),
        "nobody looks at what is told of"
    );
    scanner.expects_more_of(&found);
    assert_eq!(after(9, &mut scanner).len(), 1);
    fill(3);
    assert_eq!(after(9, &mut scanner).len(), 1);
    // Not for ever.
    after(60, &mut scanner);
    fill(4);
    assert!(after(9, &mut scanner).is_empty());
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
            // Other tests of this process give memory back meanwhile.
            resident().saturating_sub(before) >> 20
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

/// Numbers may be written with zeros before them, and what does not matter may differ.
#[test]
fn files_of_one_folder_that_mean_one_place_are_told_once() {
    let disk = Counted::default();
    for name in ["r1_a.tif", "r2_a.tif", "r01_a.tif", "r1_b.tif"] {
        disk.add("s1", name, false, 1);
    }
    disk.add("s2", "r1_a.tif", false, 1);
    for folder in ["s1", "s2"] {
        disk.add("", folder, true, 1);
    }
    let pattern: Pattern = "s{section}/r{row}_{}.tif".parse().unwrap();
    let mut scanner = Scanner::new(disk.clone(), Path::new("/r"), pattern);
    let mut look = || {
        scanner.look(99).unwrap();
        let Doubles { such_as, files } = scanner.doubles();
        (such_as.map(|found| found.file), files)
    };
    assert_eq!(look(), (Some("s1/r01_a.tif".to_owned()), 2));
    assert_eq!(look(), (None, 0));
    // The folder is listed again, and what was told is not told again.
    disk.add("s1", "r002_c.tif", false, 2);
    assert_eq!(look(), (Some("s1/r002_c.tif".to_owned()), 1));
    disk.add("s2", "r7_c.tif", false, 3);
    assert_eq!(look(), (None, 0));
}

/// What of a folder's name does not matter, or how its number is written, tells no places apart.
#[test]
fn files_of_folders_that_say_the_same_and_mean_one_place_are_told_once() {
    for (pattern, folders) in [
        ("s{section}/r{row}.tif", ["s1", "s01", "s2"]),
        ("s{section}_{}/r{row}.tif", ["s1_a", "s1_b", "s2_a"]),
    ] {
        let [one, other, apart] = folders;
        let disk = Counted::default();
        disk.add("", one, true, 1);
        disk.add(one, "r1.tif", false, 1);
        disk.add(one, "r3.tif", false, 1);
        disk.add("", apart, true, 1);
        disk.add(apart, "r1.tif", false, 1);
        let pattern: Pattern = pattern.parse().unwrap();
        let mut scanner = Scanner::new(disk.clone(), Path::new("/r"), pattern);
        let mut look = || {
            let (found, _) = scanner.look(99).unwrap();
            scanner.look(99).unwrap();
            let Doubles { such_as, files } = scanner.doubles();
            let such_as = such_as.map(|found| found.place);
            (
                found.len(),
                such_as.map(|place| (place.section, place.row)),
                files,
            )
        };
        assert_eq!(look(), (3, None, 0));
        // The second of them comes later than what is in the first.
        disk.add("", other, true, 2);
        disk.add(other, "r1.tif", false, 2);
        disk.add(other, "r2.tif", false, 2);
        assert_eq!(look(), (2, Some((1, 1)), 1), "{folders:?}");
        assert_eq!(look(), (0, None, 0));
        disk.add(one, "r2.tif", false, 3);
        assert_eq!(look(), (1, Some((1, 2)), 1));
        disk.add(apart, "r2.tif", false, 3);
        assert_eq!(look(), (1, None, 0));
    }
}
