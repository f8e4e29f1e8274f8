//! Which files lie below a folder, found with few questions to the file system.
//!
//! A look asks so many folders and entries, lists only folders that changed since they were last listed, and goes on
//! where the last one stopped. Sixteen bytes are kept per file.

use std::collections::{BTreeSet, HashMap};
use std::fs;
use std::io;
use std::ops::Bound;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use saccade_archive::acquisition::image_path;
use saccade_archive::acquisition::listed_images::{Ends, Files, Mentions, NotTaken, Seeker};
pub(super) use saccade_archive::acquisition::listed_images::{Sought, key, names};
pub(super) use saccade_archive::acquisition::tile_list::base;
use saccade_archive::acquisition::tile_list::{decoded, stem};

use super::super::{Entry, Folders, Next, Pattern, no_folder};
use super::channels::channel_of;
use crate::replay::lists::is_image_name;

/// A folder's time counts only once it is this old: file systems stamp coarsely.
const SETTLED: Duration = Duration::from_secs(3);

struct Folder {
    /// Below the root; empty for itself.
    path: PathBuf,
    /// Its time when it was last listed whole; `None` if it must be listed again.
    listed: Option<SystemTime>,
    /// Why it could not be looked into, when that was said.
    closed: Option<io::ErrorKind>,
}

struct Listing {
    folder: usize,
    /// Its time before it was listed.
    modified: Option<SystemTime>,
    entries: Box<dyn Iterator<Item = io::Result<Entry>> + Send>,
}

pub(super) struct Index {
    root: PathBuf,
    folders: Vec<Folder>,
    paths: HashMap<PathBuf, usize>,
    /// The folders in the order of their ends.
    ends: Ends<usize>,
    /// The folder that is asked next.
    at: usize,
    listing: Option<Listing>,
    /// A folder of each file, by the hash of the file's name.
    files: HashMap<u64, usize>,
    /// All folders of names that are in several.
    several: HashMap<u64, BTreeSet<usize>>,
    /// Files that may be projects of TrakEM2, below the root.
    projects: BTreeSet<PathBuf>,
    mentions: Mentions,
    /// How names say the channel, if they do.
    channel_in: Option<Pattern>,
    /// What was looked for and is nothing to read, below the root.
    odd: BTreeSet<PathBuf>,
    /// Which of them was looked at again last.
    odd_at: PathBuf,
    changed: bool,
    went_round: bool,
}

/// Why what lies there is nothing to read; `None` if it is a file, or if nothing is there. Nothing is opened.
fn oddity(path: &Path) -> Option<&'static str> {
    let is_gone = |e: &io::Error| e.kind() == io::ErrorKind::NotFound;
    match (fs::metadata(path), fs::symlink_metadata(path)) {
        (Ok(to), _) if to.is_file() => None,
        (Ok(_), _) => Some("no regular file"),
        (Err(e), Ok(_)) if is_gone(&e) => Some("a link to nothing"),
        (Err(_), Ok(_)) => Some("a link that cannot be followed"),
        (_, Err(e)) if is_gone(&e) => None,
        (_, Err(_)) => Some("not to be looked at"),
    }
}

impl Index {
    pub(super) fn new(root: &Path) -> Self {
        let whole = Folder {
            path: PathBuf::new(),
            listed: None,
            closed: None,
        };
        Self {
            root: root.to_owned(),
            folders: vec![whole],
            paths: HashMap::from([(PathBuf::new(), 0)]),
            ends: Ends::default(),
            at: 0,
            listing: None,
            files: HashMap::new(),
            several: HashMap::new(),
            projects: BTreeSet::new(),
            mentions: Mentions::default(),
            channel_in: None,
            odd: BTreeSet::new(),
            odd_at: PathBuf::new(),
            changed: false,
            went_round: false,
        }
    }

    /// Takes images only for those that show the same channel, as far as names say so.
    pub(super) fn of_channels(self, pattern: Option<Pattern>) -> Self {
        Self {
            channel_in: pattern,
            ..self
        }
    }

    /// Whether all was looked through once.
    pub(super) fn is_whole(&self) -> bool {
        self.went_round
    }

    pub(super) fn projects(&self) -> impl Iterator<Item = &Path> {
        self.projects.iter().map(PathBuf::as_path)
    }

    /// Takes over which images a list names.
    pub(super) fn know<'a>(&mut self, files: impl Iterator<Item = &'a str>) {
        self.mentions = Mentions::of(files);
    }

    fn seeker(&self) -> Seeker<'_, Self> {
        Seeker {
            files: self,
            mentions: &self.mentions,
        }
    }

    /// The image that a list calls `file`, see [`Seeker::sought`].
    pub(super) fn sought(&self, file: &str) -> Sought {
        match self.seeker().sought(file) {
            Sought::There(path) if path.to_str().is_none() => Sought::Missing,
            sought => sought,
        }
    }

    /// The same; what is not where it was is looked for anew.
    pub(super) fn find(&mut self, file: &str) -> Sought {
        let found = self.sought(file);
        if found == Sought::Missing {
            for name in names(file) {
                // Those that are there may be others that the list names.
                if !self
                    .called(&name, "")
                    .any(|path| self.root.join(path).is_file())
                {
                    self.forget(&name);
                }
            }
        }
        found
    }

    /// What had that name is gone, or nothing to read; another of its name may be there.
    fn forget(&mut self, name: &str) {
        let hash = key(name);
        let Some(folder) = self.files.remove(&hash) else {
            return;
        };
        self.several.remove(&hash);
        let path = self.folders[folder].path.join(name);
        if oddity(&self.root.join(&path)).is_some() {
            self.odd.insert(path);
        }
        for folder in &mut self.folders {
            folder.listed = None;
        }
    }

    /// See [`Seeker::is_stray`].
    pub(super) fn is_stray(&self, path: &str, file: &str) -> bool {
        self.seeker().is_stray(Path::new(path), file)
    }

    /// See [`Seeker::may_be`].
    pub(super) fn may_be(&self, path: &str, file: &str) -> bool {
        self.seeker().may_be(Path::new(path), file)
    }

    /// See [`Seeker::fits_better`].
    pub(super) fn fits_better(&self, come: &str, found: &str, file: &str) -> bool {
        let [come, found] = [come, found].map(Path::new);
        self.seeker().fits_better(come, found, file)
    }

    /// See [`Seeker::is_still`].
    pub(super) fn is_still(&self, found: &str, file: &str) -> bool {
        self.seeker().is_still(Path::new(found), file)
    }

    /// What was looked for and is nothing to read, by its name.
    pub(super) fn odd(&self) -> HashMap<&str, &Path> {
        let all = self.odd.iter().map(PathBuf::as_path);
        all.filter_map(|path| Some((path.file_name()?.to_str()?, path)))
            .collect()
    }

    /// Why what lies at a path below the root is nothing to read.
    pub(super) fn why(&self, path: &Path) -> &'static str {
        oddity(&self.root.join(path)).unwrap_or("only just a file")
    }

    /// The folder that a list calls `file`, as if it were an image.
    pub(super) fn folder(&self, file: &str) -> Option<&Path> {
        let folder = |file: &str| {
            let path = image_path(Path::new(""), file)?;
            let (path, _) = self.paths.get_key_value(&path)?;
            Some(path.as_path())
        };
        folder(file).or_else(|| folder(&decoded(file)?))
    }

    /// Why what a list calls `file` cannot be there, where something else lies in the place of its folder.
    pub(super) fn blocked(&self, file: &str) -> Option<String> {
        let blocked = |file: &str| no_folder::why_on_the_way(&image_path(&self.root, file)?);
        blocked(file).or_else(|| blocked(&decoded(file)?))
    }

    /// Of what is missing: an image that is called so and is not taken for it, and why, in words.
    pub(super) fn not_taken(&self, file: &str) -> Option<(PathBuf, String)> {
        let (path, why) = self.seeker().not_taken(file)?;
        let why = match why {
            NotTaken::AsAnother => format!(
                "{path:?} fits other images of the list as well; name it with its folders there"
            ),
            NotTaken::Elsewhere => format!("{path:?} is not in the folder that the list names"),
            NotTaken::Channel => format!("{path:?} is of another channel, as paths say"),
        };
        Some((path, why))
    }

    /// Of what is missing: an image that is called so but for its end or the case of letters, in words. Few folders are looked
    /// through for it.
    pub(super) fn nearly(&self, file: &str, is_listed: impl Fn(&str) -> bool) -> Option<String> {
        /// Entries that are looked at, at most.
        const MOST_LOOKED_AT: usize = 4096;
        let plain = |name: &str| stem(name).to_lowercase();
        let wanted: Vec<_> = names(file).map(|name| plain(&name)).collect();
        let entries = { self.folders.iter() }
            .filter_map(|folder| fs::read_dir(self.root.join(&folder.path)).ok())
            .flatten();
        let mut names = { entries.take(MOST_LOOKED_AT) }.filter_map(|entry| {
            entry
                .ok()?
                .path()
                .strip_prefix(&self.root)
                .ok()
                .map(Path::to_owned)
        });
        let near = names.find(|path| {
            let name = path
                .file_name()
                .and_then(|name| name.to_str())
                .unwrap_or_default();
            is_image_name(name)
                && !is_listed(name)
                && wanted.contains(&plain(name))
                && may_be_in(path, file)
        })?;
        Some(format!(
            "{near:?} is called so but for its end or the case of letters; if that is meant, have the list name it"
        ))
    }

    /// Looks again at some of what is nothing to read: links may lead to something later.
    fn look_at_odd(&mut self) {
        const AT_ONCE: usize = 64;
        let after = (Bound::Excluded(self.odd_at.clone()), Bound::Unbounded);
        let some: Vec<_> = self.odd.range(after).take(AT_ONCE).cloned().collect();
        self.odd_at = match some.last() {
            Some(last) if some.len() == AT_ONCE => last.clone(),
            _ => PathBuf::new(),
        };
        for path in some {
            if oddity(&self.root.join(&path)).is_some() {
                continue;
            }
            let folder = path.parent().and_then(|folder| self.paths.get(folder));
            if let Some(folder) = folder {
                self.folders[*folder].listed = None;
                self.changed = true;
            }
            self.odd.remove(&path);
        }
    }

    /// Goes on with the round of the folders, to its end or with so many questions: the files of folders that
    /// changed, below the root, and what to do next.
    pub(super) fn look(
        &mut self,
        disk: &impl Folders,
        budget: usize,
    ) -> io::Result<(Vec<String>, Next)> {
        let mut met = Vec::new();
        for _ in 0..budget.max(1) {
            if self.listing.is_some() {
                self.step(&mut met);
                continue;
            }
            let Some(folder) = self.folders.get(self.at) else {
                self.at = 0;
                self.went_round = true;
                self.look_at_odd();
                let next = match std::mem::take(&mut self.changed) {
                    true => Next::Again,
                    false => Next::Rest,
                };
                return Ok((met, next));
            };
            let path = self.root.join(&folder.path);
            let listed = folder.listed;
            let asked = disk.modified(&path).and_then(|modified| {
                let changed = listed != Some(modified);
                let entries = changed.then(|| disk.list(&path)).transpose()?;
                Ok((modified, entries))
            });
            let closed = match asked {
                Ok((modified, entries)) => {
                    if let Some(entries) = entries {
                        let age = disk.now().duration_since(modified);
                        let settled = age.is_ok_and(|age| age > SETTLED);
                        self.changed = true;
                        self.listing = Some(Listing {
                            folder: self.at,
                            modified: settled.then_some(modified),
                            entries,
                        });
                    }
                    None
                }
                Err(e) if self.at == 0 => return Err(e),
                Err(e) => {
                    // Once for each reason.
                    if self.folders[self.at].closed != Some(e.kind()) {
                        let blocked = no_folder::why(&path);
                        let cannot = || format!("cannot look into {}: {e}", path.display());
                        log::warn!("{}", blocked.unwrap_or_else(cannot));
                    }
                    Some(e.kind())
                }
            };
            self.folders[self.at].closed = closed;
            self.at += 1;
        }
        Ok((met, Next::More))
    }

    /// One entry of the folder that is being listed.
    fn step(&mut self, met: &mut Vec<String>) {
        let Some(listing) = &mut self.listing else {
            return;
        };
        let at = listing.folder;
        let Entry { name, folder } = match listing.entries.next() {
            Some(Ok(entry)) => entry,
            end => {
                // One that broke off is listed again.
                self.folders[at].listed = listing.modified.filter(|_| end.is_none());
                self.listing = None;
                return;
            }
        };
        let path = self.folders[at].path.join(&name);
        if folder {
            if !self.paths.contains_key(&path) {
                self.ends
                    .insert(&path.to_string_lossy(), self.folders.len());
                self.paths.insert(path.clone(), self.folders.len());
                self.folders.push(Folder {
                    path,
                    listed: None,
                    closed: None,
                });
            }
            return;
        }
        if self.odd.contains(&path) {
            if oddity(&self.root.join(&path)).is_some() {
                return;
            }
            self.odd.remove(&path);
        }
        let known = *self.files.entry(key(&name)).or_insert(at);
        if known != at {
            let several = self.several.entry(key(&name)).or_default();
            several.extend([known, at]);
        }
        if path
            .extension()
            .is_some_and(|e| e.eq_ignore_ascii_case("xml"))
        {
            self.projects.insert(path.clone());
        }
        // Folders whose names are text hold only such.
        met.extend(path.to_str().map(ToOwned::to_owned));
    }
}

/// Whether an image may be in the folders that a list names for it, as far as both say and but for the case of letters.
fn may_be_in(path: &Path, file: &str) -> bool {
    let named = file.rsplit(['/', '\\']).skip(1);
    let named = named.filter(|folder| !matches!(*folder, "" | "."));
    let folders = path.components().rev().skip(1);
    { folders.zip(named) }.all(|(folder, named)| {
        let folder = folder.as_os_str().to_string_lossy();
        folder.to_lowercase() == named.to_lowercase()
    })
}

impl Files for Index {
    fn is_folder(&self, path: &Path) -> bool {
        self.paths.contains_key(path) && self.root.join(path).is_dir()
    }

    /// Where names say the channel, an image does not show another one.
    fn can_be(&self, path: &Path, file: &str) -> bool {
        let Some(pattern) = &self.channel_in else {
            return true;
        };
        let of = |file: &str| channel_of(pattern, file);
        let channels = of(&path.to_string_lossy()).ok().zip(of(file).ok());
        channels.is_none_or(|(one, other)| one == other)
    }

    fn is_there(&self, path: &Path) -> bool {
        self.root.join(path).is_file()
    }

    fn called(&self, name: &str, folders: &str) -> impl Iterator<Item = PathBuf> {
        let hash = key(name);
        let (first, several) = (self.files.get(&hash), self.several.get(&hash));
        let whole = several.filter(|_| folders.is_empty());
        let alike = several.filter(|_| !folders.is_empty()).map(|several| {
            let ending = self.ends.ending(folders);
            ending.filter(|folder| several.contains(folder))
        });
        let in_folders = { whole.into_iter().flatten() }.chain(alike.into_iter().flatten());
        let in_folders = in_folders.chain(first.filter(|_| several.is_none()));
        in_folders.map(move |folder| self.folders[*folder].path.join(name))
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use saccade_archive::acquisition::listed_images;

    use super::super::super::Disk;
    use super::*;

    #[test]
    fn is_files() {
        let root = tempfile::tempdir().unwrap();
        listed_images::conformance::check(root.path(), |root| {
            let mut index = Index::new(root);
            while index.look(&Disk, 2).unwrap().1 == Next::More {}
            index
        });
    }

    #[test]
    fn files_are_found_at_their_path_or_by_name_wherever_they_are() {
        let folder = tempfile::tempdir().unwrap();
        let write = |file: &str| {
            let path = folder.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        };
        for file in ["z/a.tif", "deep/er/a.tif", "b.tif", "deep/p.XML"] {
            write(file);
        }
        let mut index = Index::new(folder.path());
        let round = |index: &mut Index| {
            let mut all = Vec::new();
            loop {
                let (met, next) = index.look(&Disk, 2).unwrap();
                assert!(met.len() <= 2);
                all.extend(met);
                if next != Next::More {
                    all.sort();
                    return all;
                }
            }
        };
        assert_eq!(
            round(&mut index),
            ["b.tif", "deep/er/a.tif", "deep/p.XML", "z/a.tif"]
        );
        assert!(index.is_whole());
        let mut find = |file: &str| index.find(file);
        let there = |path: &str| Sought::There(path.into());
        // Which of two is meant, only their folders can say.
        let several = Sought::Several(["deep/er/a.tif", "z/a.tif"].map(PathBuf::from));
        assert_eq!(find("z/a.tif"), there("z/a.tif"));
        for unclear in ["a.tif", "./z/../a.tif", "/scope/x/a.tif", "x\\a.tif"] {
            assert_eq!(find(unclear), several, "{unclear}");
        }
        assert_eq!(find("/scope/z/a.tif"), there("z/a.tif"));
        assert_eq!(find("C:\\scope\\deep\\er\\a.tif"), there("deep/er/a.tif"));
        assert_eq!(find("/scope/er/a.tif"), there("deep/er/a.tif"));
        assert_eq!(find("C:\\x\\b.tif"), there("b.tif"));
        assert_eq!(find("c.tif"), Sought::Missing);
        assert_eq!(
            index.projects().collect::<Vec<_>>(),
            [Path::new("deep/p.XML")]
        );

        // One that goes away uncovers the next; one that comes is met.
        fs::remove_file(folder.path().join("deep/er/a.tif")).unwrap();
        write("new/c.tif");
        assert_eq!(index.find("a.tif"), there("z/a.tif"));
        assert!(round(&mut index).contains(&"new/c.tif".to_owned()));
        assert_eq!(index.find("a.tif"), there("z/a.tif"));
        assert_eq!(index.find("c.tif"), there("new/c.tif"));
        fs::remove_file(folder.path().join("z/a.tif")).unwrap();
        write("new/a.tif");
        assert_eq!(index.find("a.tif"), Sought::Missing);
        round(&mut index);
        assert_eq!(index.find("a.tif"), there("new/a.tif"));
    }

    #[test]
    fn an_image_that_is_more_like_another_that_is_listed_is_that_one() {
        let folder = tempfile::tempdir().unwrap();
        let write = |file: &str| {
            let path = folder.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        };
        let mut index = Index::new(folder.path());
        let round = |index: &mut Index| while index.look(&Disk, 99).unwrap().1 == Next::More {};
        let there = |path: &str| Sought::There(path.into());
        let listed = ["/scope/s00/r.tif", "/scope/s01/r.tif", "/scope/s%202/r.tif"];
        index.know(
            listed
                .iter()
                .copied()
                .chain(["/scope/s00/r.tif", "/scope/x/one.tif"]),
        );
        // Stray ones may be any of them, or the only one of a name.
        for file in ["old/r.tif", "old/one.tif", "s00/r.tif"] {
            write(file);
        }
        round(&mut index);
        assert_eq!(index.find(listed[0]), there("s00/r.tif"));
        assert_eq!(index.find(listed[1]), Sought::Missing);
        assert_eq!(index.find(listed[2]), Sought::Missing);
        assert_eq!(index.find("/scope/x/one.tif"), there("old/one.tif"));
        assert!(index.is_still("s00/r.tif", listed[0]));
        assert!(!index.is_still("s00/r.tif", listed[1]), "it is the other's");
        for file in ["s01/r.tif", "s 2/r.tif", "x/one.tif"] {
            write(file);
        }
        round(&mut index);
        assert_eq!(index.find(listed[1]), there("s01/r.tif"));
        assert_eq!(index.find(listed[2]), there("s 2/r.tif"));
        // What fits better takes its place.
        assert!(index.fits_better("x/one.tif", "old/one.tif", "/scope/x/one.tif"));
        assert!(!index.is_still("old/one.tif", "/scope/x/one.tif"));
        assert!(!index.fits_better("old/one.tif", "x/one.tif", "/scope/x/one.tif"));
    }

    #[test]
    fn what_is_meant_by_a_url_is_found_where_nothing_is_called_as_it_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let write = |file: &str| {
            let path = folder.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        };
        let mut index = Index::new(folder.path());
        let round = |index: &mut Index| while index.look(&Disk, 99).unwrap().1 == Next::More {};
        for file in ["in/t#1.tif", "a b/same.tif", "c d/same.tif", "x.tif"] {
            write(file);
        }
        round(&mut index);
        let there = |path: &str| Sought::There(path.into());
        for (listed, path) in [
            ("/scope/in/t%231.tif", "in/t#1.tif"),
            ("in/t%231.tif", "in/t#1.tif"),
            ("/scope/a%20b/same.tif", "a b/same.tif"),
            ("c%20d/same.tif", "c d/same.tif"),
            ("a%20b/%73ame.tif", "a b/same.tif"),
        ] {
            assert_eq!(index.find(listed), there(path), "{listed}");
            assert!(index.is_still(path, listed), "{listed}");
        }
        for nothing in [
            "a%20b%2Fsame.tif",
            "in/t%231%00.tif",
            "%2e%2e",
            "..%2fx.tif",
        ] {
            assert_eq!(index.find(nothing), Sought::Missing, "{nothing}");
        }
        assert!(matches!(index.find("/e/same.tif"), Sought::Several(_)));
        assert!(!index.is_still("a b/same.tif", "c%20d/same.tif"));

        // One that is called as it is written comes later, and wherever it is.
        write("far/t%231.tif");
        round(&mut index);
        let listed = "/scope/in/t%231.tif";
        assert_eq!(index.find(listed), there("far/t%231.tif"));
        assert!(index.is_still("far/t%231.tif", listed));
        assert!(!index.is_still("in/t#1.tif", listed));
        // Where the folder that is named is there, it is that one's.
        assert_eq!(index.find("in/t%231.tif"), there("in/t#1.tif"));
        assert!(index.is_still("in/t#1.tif", "in/t%231.tif"));
        assert!(!index.is_still("far/t%231.tif", "in/t%231.tif"));
        // What it means is found again when that is gone, and what becomes of either is noticed.
        fs::remove_file(folder.path().join("far/t%231.tif")).unwrap();
        assert_eq!(index.find(listed), there("in/t#1.tif"));
        fs::rename(
            folder.path().join("in/t#1.tif"),
            folder.path().join("t#1.tif"),
        )
        .unwrap();
        assert_eq!(index.find(listed), Sought::Missing);
        round(&mut index);
        assert_eq!(index.find(listed), there("t#1.tif"));
        assert_eq!(index.find("in/t%231.tif"), Sought::Missing);
    }
}
