//! Which files are new, found with few questions to the file system.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque};
use std::fs;
use std::hash::{BuildHasher, BuildHasherDefault, DefaultHasher};
use std::io;
use std::ops::Bound;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use saccade_archive::clock::{Clock as _, SystemClock};

use super::again::Again;
use super::stamp::Seen;
use super::{Pattern, Place, Stamp, no_folder, no_image};

/// What a folder holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Name.
    pub name: String,
    /// Whether it is a folder.
    pub folder: bool,
}

/// A file system, as far as watching asks it. Every call is one question, and every entry another.
pub trait Folders {
    /// When something was last added to a folder, or taken away.
    ///
    /// # Errors
    ///
    /// What the system says.
    fn modified(&self, folder: &Path) -> io::Result<SystemTime>;

    /// What is in a folder, one after another.
    ///
    /// # Errors
    ///
    /// What the system says.
    fn list(&self, folder: &Path)
    -> io::Result<Box<dyn Iterator<Item = io::Result<Entry>> + Send>>;

    /// What a file looks like.
    ///
    /// # Errors
    ///
    /// What the system says.
    fn stamp(&self, file: &Path) -> io::Result<Stamp>;

    /// Now, by the clock that stamps files.
    fn now(&self) -> SystemTime;
}

/// The file system itself.
#[derive(Clone, Copy, Debug, Default)]
pub struct Disk;

impl Folders for Disk {
    fn modified(&self, folder: &Path) -> io::Result<SystemTime> {
        fs::metadata(folder)?.modified()
    }

    fn list(
        &self,
        folder: &Path,
    ) -> io::Result<Box<dyn Iterator<Item = io::Result<Entry>> + Send>> {
        let entries = fs::read_dir(folder)?.filter_map(|entry| {
            let entry = match entry {
                Ok(entry) => entry,
                Err(e) => return Some(Err(e)),
            };
            // A name that is no text fits no pattern.
            let name = entry.file_name().into_string().ok()?;
            // It may be gone by now.
            let folder = entry.file_type().is_ok_and(|kind| kind.is_dir());
            Some(Ok(Entry { name, folder }))
        });
        Ok(Box::new(entries))
    }

    fn stamp(&self, file: &Path) -> io::Result<Stamp> {
        Stamp::of(&fs::metadata(file)?)
    }

    fn now(&self) -> SystemTime {
        SystemClock.now()
    }
}

/// A file that is new, or another than before.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Found {
    /// Below the watched folder.
    pub file: String,
    /// What its name says.
    pub place: Place,
}

/// What to do after a look.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// Look again at once: the budget ended before the round did.
    More,
    /// Look again later: something changed, and may change again before its time shows it.
    Again,
    /// Look again later: nothing changed.
    Rest,
}

/// What a scanner has met.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Files, of whatever name, when their folders were first listed.
    pub files: u64,
    /// Folders, of whatever name.
    pub folders: u64,
    /// Files whose path fits the pattern.
    pub fit: u64,
    /// One that does not fit, below the watched folder, and whether it is a folder: rather a file as deep as the
    /// pattern, and rather none that is hidden.
    pub other: Option<(String, bool)>,
}

/// A folder's time counts only once it is this old: file systems stamp coarsely, and a file may have been
/// added in the same tick after the folder was listed.
const SETTLED: Duration = Duration::from_secs(3);

/// Of what lies where folders should be, the first so many are told: they are asked for at each look.
const MOST_BLOCKED: usize = 16;

/// Of images that cannot be looked at, so many are told, and so many are asked for per look.
const MOST_LOST: usize = 16;
const LOST_PER_LOOK: usize = 64;

/// So many files are remembered of which it was said that they mean what another one means.
const MOST_DOUBLES: usize = 1 << 16;

/// An image that cannot be looked at though its name is there.
struct Lost {
    place: Place,
    since: SystemTime,
}

struct Known {
    /// Below the watched folder; empty for itself.
    path: PathBuf,
    depth: usize,
    place: Place,
    /// Its time when it was last listed whole; `None` if it must be listed again.
    listed: Option<SystemTime>,
    /// Whether what is in it was counted.
    counted: bool,
}

struct Listing {
    folder: usize,
    /// Its time before it was listed.
    modified: Option<SystemTime>,
    entries: Box<dyn Iterator<Item = io::Result<Entry>> + Send>,
    /// Hashes of the places that its files mean.
    places: HashSet<u64>,
}

/// Files that mean a place which another file means as well.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Doubles {
    /// One of them.
    pub(super) such_as: Option<Found>,
    /// How many.
    pub(super) files: usize,
}

/// Folders whose names say the same, so that their files may mean the same places.
#[derive(Debug, Default)]
struct Alike {
    /// The first folder whose name says so, by the hash of that.
    first: HashMap<u64, usize>,
    /// In which folder a file of a place was met first, by the hash of the place: of those of which there are several.
    files: HashMap<u64, HashMap<u64, usize>>,
}

impl Alike {
    /// A folder whose name says something; the only one so far whose name says the same, if there is one.
    fn comes(&mut self, folder: usize, said: u64) -> Option<usize> {
        let first = *self.first.entry(said).or_insert(folder);
        if first == folder || self.files.contains_key(&said) {
            return None;
        }
        self.files.insert(said, HashMap::new());
        Some(first)
    }

    /// Whether a file in another folder than this one, whose name says the same, means a place, or meant it.
    fn is_elsewhere(&mut self, folder: usize, said: u64, place: u64) -> bool {
        let files = self.files.get_mut(&said);
        files.is_some_and(|files| *files.entry(place).or_insert(folder) != folder)
    }
}

/// Goes round the folders, a bounded number of questions at a time.
pub struct Scanner<F> {
    folders: F,
    root: PathBuf,
    pattern: Pattern,
    known: Vec<Known>,
    /// Which folders come next.
    round: VecDeque<usize>,
    /// Folders left of this round, those included that it finds.
    to_ask: usize,
    /// Whether this round found a folder that changed.
    changed: bool,
    /// Folders by path, so that none is known twice.
    paths: HashMap<PathBuf, usize>,
    listing: Option<Listing>,
    /// What each file looked like, by the hash of its path.
    files: HashMap<u64, Seen>,
    /// Files told of before this process, and not met yet by this one, with what they looked like, if that was
    /// kept.
    told: HashMap<u64, Option<Seen>>,
    /// What was not known of them, or not all.
    learned: Vec<(u64, Seen)>,
    /// Files that somebody may still be writing to.
    again: Again,
    /// Whether all folders were gone through once.
    went_round: bool,
    /// Folders that could not be looked into, and why.
    closed: HashMap<usize, io::ErrorKind>,
    /// What lies where folders should be, below the watched folder.
    blocked: BTreeSet<PathBuf>,
    /// Images that cannot be looked at, such as links to nothing, below the watched folder: what they lead to comes
    /// without a change of their folders.
    lost: BTreeMap<PathBuf, Lost>,
    /// The last of them that was asked for.
    lost_at: PathBuf,
    /// Files that mean a place which another file means, by the hashes of their paths, and those of them that were not asked for
    /// yet.
    doubles: (HashSet<u64>, Doubles),
    alike: Alike,
    /// When the last of them was told of.
    told_until: SystemTime,
    hasher: BuildHasherDefault<DefaultHasher>,
    counts: Counts,
    /// How well what [`Counts::other`] names shows what is wrong.
    telling: u32,
}

impl<F: Folders> Scanner<F> {
    /// A scanner of everything below `root` that fits the pattern.
    pub fn new(folders: F, root: &Path, pattern: Pattern) -> Self {
        let known = Known {
            path: PathBuf::new(),
            depth: 0,
            place: Place::default(),
            listed: None,
            counted: false,
        };
        Self {
            folders,
            root: root.to_owned(),
            pattern,
            known: vec![known],
            round: VecDeque::from([0]),
            to_ask: 1,
            changed: false,
            paths: HashMap::from([(PathBuf::new(), 0)]),
            listing: None,
            files: HashMap::new(),
            told: HashMap::new(),
            again: Again::default(),
            learned: Vec::new(),
            went_round: false,
            closed: HashMap::new(),
            blocked: BTreeSet::new(),
            lost: BTreeMap::new(),
            lost_at: PathBuf::new(),
            doubles: (HashSet::new(), Doubles::default()),
            alike: Alike::default(),
            told_until: SystemTime::UNIX_EPOCH,
            hasher: BuildHasherDefault::default(),
            counts: Counts::default(),
            telling: 0,
        }
    }

    /// Now, by the clock that stamps files.
    pub(super) fn now(&self) -> SystemTime {
        self.folders.now()
    }

    /// What a file looks like; `None` if it cannot be asked.
    pub(super) fn stamp(&self, file: &str) -> Option<Stamp> {
        self.folders.stamp(&self.root.join(file)).ok()
    }

    /// What was met so far.
    pub fn counts(&self) -> &Counts {
        &self.counts
    }

    /// Why there are no images where the pattern has folders of them: of what was met there and is none, and is so still.
    pub(super) fn blocked(&mut self) -> Vec<String> {
        let (mut said, root) = (Vec::new(), &self.root);
        self.blocked.retain(|path| {
            let why = no_folder::why(&root.join(path));
            let is_blocked = why.is_some();
            said.extend(why);
            is_blocked
        });
        said
    }

    /// Why images whose names fit cannot be looked at: of the first ones, and how many more there are.
    pub(super) fn lost(&self) -> (Vec<String>, usize) {
        let first = self.lost.keys().take(MOST_LOST);
        let said = first.filter_map(|path| no_image::why(&self.root.join(path)));
        let more = self.lost.len().saturating_sub(MOST_LOST);
        (said.collect(), more)
    }

    /// Files that were met since this was asked last, and mean what another one means, or one that was there: each once.
    pub(super) fn doubles(&mut self) -> Doubles {
        std::mem::take(&mut self.doubles.1)
    }

    /// Looks again at some of those.
    fn look_at_lost(&mut self, found: &mut Vec<Found>) {
        let after = (Bound::Excluded(self.lost_at.clone()), Bound::Unbounded);
        let some = self.lost.range(after).take(LOST_PER_LOOK);
        let some: Vec<_> = some.map(|(path, _)| path.clone()).collect();
        self.lost_at = match some.last() {
            Some(last) if some.len() == LOST_PER_LOOK => last.clone(),
            _ => PathBuf::new(),
        };
        for path in some {
            let whole = self.root.join(&path);
            let stamp = self.folders.stamp(&whole);
            if no_image::why(&whole).is_some() {
                continue;
            }
            // Of one that is gone the folder tells when it comes back.
            let lost = self.lost.remove(&path);
            if let (Ok(stamp), Some(lost)) = (stamp, lost) {
                self.meet(&path, lost.place, stamp, found);
                self.changed = true;
            }
        }
    }

    /// Whether one of them was met only just: what it leads to may be about to come.
    fn has_lost_just_now(&self) -> bool {
        let now = self.folders.now();
        let age = |lost: &Lost| now.duration_since(lost.since);
        { self.lost.values() }.any(|lost| age(lost).is_ok_and(|age| age < SETTLED))
    }

    /// Notes what lies where an image should be and cannot be looked at.
    fn lose(&mut self, below: PathBuf, place: Place) {
        let since = self.folders.now();
        self.lost.entry(below).or_insert(Lost { place, since });
    }

    /// Notes what lies where a folder should be.
    fn block(&mut self, path: PathBuf) {
        if self.blocked.len() < MOST_BLOCKED {
            self.blocked.insert(path);
        }
    }

    /// Notes one that does not fit.
    fn misfit(&mut self, path: &Path, folder: bool, as_deep: bool) {
        let hidden = path
            .file_name()
            .is_none_or(|name| name.as_encoded_bytes().starts_with(b"."));
        let telling = match (hidden, folder, as_deep) {
            (true, ..) => 1,
            (_, true, _) => 2,
            (_, false, false) => 3,
            (_, false, true) => 4,
        };
        if telling > self.telling {
            self.telling = telling;
            self.counts.other = Some((path.to_string_lossy().into_owned(), folder));
        }
    }

    /// Says that a file was told of by an earlier process, no later than [`Self::told_until`] says.
    pub fn remember(&mut self, file: &str) {
        self.told_key(file);
    }

    /// By what a file is remembered.
    pub(super) fn key(&self, file: &str) -> u64 {
        self.hasher.hash_one(file)
    }

    pub(super) fn folders(&self) -> &F {
        &self.folders
    }

    /// Says that a file was told of by an earlier process; by which it is remembered.
    pub(super) fn told_key(&mut self, file: &str) -> u64 {
        let key = self.key(file);
        self.told.insert(key, None);
        key
    }

    /// Says that it is not known what a file looked like when an earlier process told of it last.
    pub(super) fn remember_nothing_of(&mut self, key: u64) {
        if let Some(told) = self.told.get_mut(&key) {
            *told = None;
        }
    }

    /// Says what a file looked like when an earlier process told of it.
    pub(super) fn remember_as(&mut self, key: u64, seen: Seen) {
        if let Some(told) = self.told.get_mut(&key) {
            *told = seen.known();
        }
    }

    /// What files look like of which that was not known, or not all, and that are the same by what is: since it was asked last.
    pub(super) fn learned(&mut self) -> Vec<(u64, Seen)> {
        std::mem::take(&mut self.learned)
    }

    /// Says that a file is told of as it looks now; what to remember it by.
    pub(super) fn tells(&mut self, file: &str, stamp: Stamp) -> (u64, Seen) {
        let (key, seen) = (self.hasher.hash_one(file), Seen::of(&stamp));
        self.files.insert(key, seen);
        (key, seen)
    }

    /// Says that a file which is told of is not whole yet: whoever writes it may still go on.
    pub(super) fn expects_more_of(&mut self, found: &Found) {
        let (key, now) = (self.hasher.hash_one(&*found.file), self.folders.now());
        self.again.add(key, found, now);
    }

    /// Says when earlier processes told of the last file.
    pub fn told_until(&mut self, at: SystemTime) {
        self.told_until = at;
    }

    /// Goes on with the round of the folders, to its end or with at most `budget` questions; what was found, and what to do next.
    ///
    /// # Errors
    ///
    /// If the watched folder itself cannot be asked. One below that cannot is passed over until the next
    /// round.
    pub fn look(&mut self, budget: usize) -> io::Result<(Vec<Found>, Next)> {
        let mut found = Vec::new();
        let mut left = budget.max(1);
        self.look_again(&mut found, &mut left);
        self.look_at_lost(&mut found);
        loop {
            if left == 0 {
                return Ok((found, Next::More));
            }
            if self.listing.is_some() {
                let before = self.known.len();
                left -= 1;
                self.step(&mut found, &mut left);
                self.to_ask += self.known.len() - before;
                self.changed = true;
                continue;
            }
            if self.to_ask == 0 {
                self.to_ask = self.known.len();
                self.went_round = true;
                let changed = std::mem::take(&mut self.changed);
                let waits = changed || self.again.waits() || self.has_lost_just_now();
                return Ok((found, if waits { Next::Again } else { Next::Rest }));
            }
            self.round.rotate_left(1);
            let Some(&folder) = self.round.back() else {
                return Ok((found, Next::Rest));
            };
            self.to_ask -= 1;
            left -= 1;
            let Known { path, listed, .. } = &self.known[folder];
            let whole = path.as_os_str().is_empty();
            let path = self.root.join(path);
            let asked = self.folders.modified(&path).and_then(|modified| {
                let changed = *listed != Some(modified);
                let entries = changed.then(|| self.folders.list(&path)).transpose()?;
                Ok((modified, entries))
            });
            if asked.is_ok() && self.closed.remove(&folder).is_some() {
                log::info!("{} can be looked into again", path.display());
            }
            match asked {
                Ok((modified, Some(entries))) => {
                    let age = self.folders.now().duration_since(modified);
                    let settled = age.is_ok_and(|age| age > SETTLED);
                    self.listing = Some(Listing {
                        folder,
                        modified: settled.then_some(modified),
                        entries,
                        places: HashSet::new(),
                    });
                }
                Ok((_, None)) => {}
                Err(e) if whole => {
                    // It is asked first by the next look, and what was found is told before.
                    self.round.rotate_right(1);
                    self.to_ask += 1;
                    return match found.is_empty() {
                        true => Err(e),
                        false => Ok((found, Next::Again)),
                    };
                }
                Err(e) => {
                    let is_new = self.closed.insert(folder, e.kind()) != Some(e.kind());
                    if e.kind() == io::ErrorKind::NotADirectory {
                        self.block(self.known[folder].path.clone());
                    } else if is_new {
                        // Once for each reason.
                        log::warn!("cannot look into {}: {e}", path.display());
                    }
                }
            }
        }
    }

    /// One entry of the folder that is being listed.
    fn step(&mut self, found: &mut Vec<Found>, left: &mut usize) {
        let Some(listing) = &mut self.listing else {
            return;
        };
        let folder = listing.folder;
        let entry = match listing.entries.next() {
            Some(Ok(entry)) => entry,
            end => {
                // One that broke off is listed again.
                let known = &mut self.known[folder];
                known.listed = listing.modified.filter(|_| end.is_none());
                known.counted |= end.is_none();
                self.listing = None;
                return;
            }
        };
        let Known {
            path,
            depth,
            place,
            counted,
            ..
        } = &self.known[folder];
        let below = path.join(&entry.name);
        let as_deep = *depth == self.pattern.depth();
        let count = u64::from(!counted);
        if entry.folder {
            self.counts.folders += count;
            let as_image = self.pattern.file(&entry.name, place).filter(|_| as_deep);
            if let Some(place) = as_image {
                self.counts.fit += 1;
                self.lose(below, place);
                return;
            }
            let Some(place) = self.pattern.folder(*depth, &entry.name, place) else {
                self.misfit(&below, true, as_deep);
                return;
            };
            if !self.paths.contains_key(&below) {
                let depth = depth + 1;
                let index = self.known.len();
                self.paths.insert(below.clone(), index);
                if depth == self.pattern.depth() {
                    let first = self.alike.comes(index, self.hasher.hash_one(&place));
                    // What is in it was not kept so far.
                    if let Some(first) = first {
                        self.known[first].listed = None;
                    }
                }
                self.known.push(Known {
                    path: below,
                    depth,
                    place,
                    listed: None,
                    counted: false,
                });
                self.round.push_front(index);
            }
            return;
        }
        self.counts.files += count;
        let place = self.pattern.file(&entry.name, place).filter(|_| as_deep);
        let Some(place) = place else {
            let in_the_way = self.pattern.is_a_folder(*depth, &entry.name);
            self.misfit(&below, false, as_deep);
            if in_the_way {
                self.block(below);
            }
            return;
        };
        self.counts.fit += 1;
        let said = self.hasher.hash_one(&self.known[folder].place);
        let means = self.hasher.hash_one(&place);
        let is_elsewhere = self.alike.is_elsewhere(folder, said, means);
        if !listing.places.insert(means) || is_elsewhere {
            let file = below.to_string_lossy().into_owned();
            let (known, new) = &mut self.doubles;
            if known.len() < MOST_DOUBLES && known.insert(self.hasher.hash_one(&file)) {
                new.files += 1;
                let place = place.clone();
                new.such_as.get_or_insert(Found { file, place });
            }
        }
        *left = left.saturating_sub(1);
        let whole = self.root.join(&below);
        match self.folders.stamp(&whole) {
            Ok(stamp) => {
                self.lost.remove(&below);
                self.meet(&below, place, stamp, found);
            }
            Err(_) if no_image::why(&whole).is_some() => self.lose(below, place),
            // Gone: the folder is looked through again.
            Err(_) => listing.modified = None,
        }
    }

    /// An image, as it looks now.
    fn meet(&mut self, below: &Path, place: Place, stamp: Stamp, found: &mut Vec<Found>) {
        // The pattern is text, so the path is.
        let file = below.to_string_lossy().into_owned();
        let (key, seen) = (self.hasher.hash_one(&file), Seen::of(&stamp));
        if self.again.holds(key) {
            return;
        }
        let before = self.files.insert(key, seen);
        let told = self.told.remove(&key);
        let known = before.map(Some).or(told);
        let same = match known {
            Some(Some(before)) => !before.is_replaced_by(seen),
            Some(None) => stamp.modified <= self.told_until,
            None => false,
        };
        if same && known.flatten().is_none_or(Seen::is_of_any_file) {
            self.learned.push((key, seen));
        }
        let found_now = Found { file, place };
        // By the clock that stamps files, which may be another than this one: what comes later is new in any case.
        let now = self.folders.now();
        if stamp.is_young(now) || (!same && self.went_round) {
            self.again.add(key, &found_now, now);
        }
        if !same {
            found.push(found_now);
        }
    }

    /// Looks at files again that somebody may still be writing to, with half of the questions at most.
    fn look_again(&mut self, found: &mut Vec<Found>, left: &mut usize) {
        let now = self.folders.now();
        let mut most = left.div_ceil(2);
        while most > 0
            && let Some(mut file) = self.again.due(now)
        {
            most -= 1;
            *left = left.saturating_sub(1);
            let stamp = self.folders.stamp(&self.root.join(&file.found.file));
            let known = self.files.get(&file.key).copied();
            // One that is gone may be on its way to be another.
            if let (Ok(stamp), Some(known)) = (stamp, known) {
                let seen = Seen::of(&stamp);
                if file.is_whole_again(known, seen, now) {
                    self.files.insert(file.key, seen);
                    found.push(file.found.clone());
                }
            }
            self.again.put_back(file, now);
        }
    }
}
