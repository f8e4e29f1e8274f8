//! Which files lie below a folder, found with few questions to the file system.
//!
//! A look asks so many folders and entries, lists only folders that changed since they were last listed, and goes on
//! where the last one stopped. Sixteen bytes are kept per file.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::fs;
use std::hash::{BuildHasher, BuildHasherDefault, DefaultHasher};
use std::io;
use std::ops::Bound;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use saccade_archive::acquisition::image_path;
pub(super) use saccade_archive::acquisition::tile_list::base;
use saccade_archive::acquisition::tile_list::decoded;

use super::super::{Entry, Folders, Next, no_folder};

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
    /// The folder that is asked next.
    at: usize,
    listing: Option<Listing>,
    /// A folder of each file, by the hash of the file's name.
    files: HashMap<u64, usize>,
    /// All folders of names that are in several.
    several: HashMap<u64, BTreeSet<usize>>,
    /// Files that may be projects of TrakEM2, below the root.
    projects: BTreeSet<PathBuf>,
    /// How many images that the list names end in a name, or in a name with folders before it, by the hash of that. With folders
    /// only where several have the name.
    listed: HashMap<u64, u32>,
    /// What was looked for and is nothing to read, below the root.
    odd: BTreeSet<PathBuf>,
    /// Which of them was looked at again last.
    odd_at: PathBuf,
    changed: bool,
    went_round: bool,
}

/// What is found under a name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Sought {
    /// The image, below the root.
    There(String),
    /// Images in several folders, of which the list does not say which one it means; two of them.
    Several([PathBuf; 2]),
    Missing,
}

/// The hash by which a name or path is known.
pub(super) fn key(name: &str) -> u64 {
    BuildHasherDefault::<DefaultHasher>::default().hash_one(name)
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

/// A path's last part and so many folders before it, however they are separated; `None` if there are not so many.
fn tail(file: &str, folders: usize) -> Option<String> {
    let parts = file.rsplit(['/', '\\']);
    let parts = parts.filter(|part| !matches!(*part, "" | "."));
    let parts: Vec<_> = parts.take(folders + 1).collect();
    (parts.len() > folders).then(|| parts.join("/"))
}

/// How many folders two paths have in common from their ends on.
fn likeness(path: &Path, file: &str) -> usize {
    let folders = path.components().rev().skip(1);
    let named = file.rsplit(['/', '\\']).skip(1);
    let both = folders.zip(named);
    both.take_while(|(folder, named)| folder.as_os_str() == *named)
        .count()
}

/// The names that the image may have which a list calls `file`: as it is written, and as it is meant if that is part of a
/// URL.
pub(super) fn names(file: &str) -> impl Iterator<Item = String> {
    let meant = decoded(file).map(|decoded| base(&decoded).to_owned());
    let meant = meant.filter(|name| name != base(file));
    [base(file).to_owned()].into_iter().chain(meant)
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
            at: 0,
            listing: None,
            files: HashMap::new(),
            several: HashMap::new(),
            projects: BTreeSet::new(),
            listed: HashMap::new(),
            odd: BTreeSet::new(),
            odd_at: PathBuf::new(),
            changed: false,
            went_round: false,
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
        // Folders in common beyond these are not told apart.
        const MOST_FOLDERS: usize = 8;
        let spellings = |file: &str| [Some(file.to_owned()), decoded(file)].into_iter().flatten();
        let mut known = HashSet::new();
        let mut is_new =
            |file: &&str| known.insert(key(&decoded(file).unwrap_or((*file).to_owned())));
        let files: Vec<&str> = files.filter(&mut is_new).collect();
        self.listed.clear();
        for file in &files {
            let names: BTreeSet<u64> = spellings(file).map(|file| key(base(&file))).collect();
            for name in names {
                *self.listed.entry(name).or_default() += 1;
            }
        }
        let names = self.listed.iter().filter(|(_, count)| **count > 1);
        let shared: HashSet<u64> = names.map(|(name, _)| *name).collect();
        let is_shared = |file: &str| shared.contains(&key(base(file)));
        for file in &files {
            let mut tails = BTreeSet::new();
            for spelling in spellings(file).filter(|file| is_shared(file)) {
                let of = (1..=MOST_FOLDERS).map_while(|folders| tail(&spelling, folders));
                tails.extend(of.map(|tail| key(&tail)));
            }
            for tail in tails {
                *self.listed.entry(tail).or_default() += 1;
            }
        }
    }

    /// Whether an image that lies elsewhere may be what a list calls `file`: not, if it is as much like another one that the
    /// list names, or more.
    fn may_be(&self, path: &Path, file: &str) -> bool {
        let tail = tail(file, likeness(path, file));
        let count = tail.and_then(|tail| self.listed.get(&key(&tail)).copied());
        count.unwrap_or(0) <= 1
    }

    /// The image at the path that a list calls `file`.
    fn exactly(&self, file: &str) -> Option<PathBuf> {
        let named = image_path(Path::new(""), file)?;
        let is_there = self.root.join(&named).is_file();
        is_there.then(|| named.components().collect())
    }

    /// The image that a list calls `file`: at that path, else by name alone. Of several of that name the one whose
    /// folders are most like those that the list names; none, if that could be several, or if it is as much like another one that the
    /// list names. If there is none, the same of what `file` means [`decoded`].
    pub(super) fn sought(&self, file: &str) -> Sought {
        let as_written = self.sought_as(file);
        let Some(decoded) = decoded(file) else {
            return as_written;
        };
        match as_written {
            Sought::There(_) => as_written,
            Sought::Missing => self.sought_as(&decoded),
            // Where only folders are encoded, they may tell which one is meant.
            Sought::Several(_) if base(&decoded) == base(file) => match self.sought_as(&decoded) {
                there @ Sought::There(_) => there,
                Sought::Several(_) | Sought::Missing => as_written,
            },
            Sought::Several(_) => as_written,
        }
    }

    fn sought_as(&self, file: &str) -> Sought {
        let there = |path: &Path| match path.to_str() {
            Some(path) => Sought::There(path.to_owned()),
            None => Sought::Missing,
        };
        if let Some(path) = self.exactly(file) {
            return there(&path);
        }
        let paths = self.called(base(file));
        let paths = paths.filter(|path| self.may_be(path, file));
        let paths = paths.filter(|path| self.root.join(path).is_file());
        let mut paths: Vec<(usize, PathBuf)> =
            paths.map(|path| (likeness(&path, file), path)).collect();
        let best = paths.iter().map(|(like, _)| *like).max().unwrap_or(0);
        paths.retain(|(like, _)| *like == best);
        paths.sort();
        match &paths[..] {
            [] => Sought::Missing,
            [(_, path)] => there(path),
            [(_, one), (_, other), ..] => Sought::Several([one.clone(), other.clone()]),
        }
    }

    /// Where files of a name were seen, below the root.
    fn called(&self, name: &str) -> impl Iterator<Item = PathBuf> {
        let hash = key(name);
        let (first, several) = (self.files.get(&hash), self.several.get(&hash));
        let folders = several.into_iter().flatten();
        let folders = folders.chain(first.filter(|_| several.is_none()));
        folders.map(move |folder| self.folders[*folder].path.join(name))
    }

    /// The same; what is not where it was is looked for anew.
    pub(super) fn find(&mut self, file: &str) -> Sought {
        let found = self.sought(file);
        if found == Sought::Missing {
            for name in names(file) {
                // Those that are there may be others that the list names.
                if !self
                    .called(&name)
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

    /// Whether an image that has come fits what a list calls `file` better than the one that was found.
    pub(super) fn fits_better(&self, come: &str, found: &str, file: &str) -> bool {
        let fit = |path: &str| {
            let like = |file: &str| likeness(Path::new(path), file);
            let as_meant = decoded(file).map_or(0, |meant| like(&meant));
            (like(file).max(as_meant), base(path) == base(file))
        };
        // The file system is asked of few.
        come != found
            && fit(come) > fit(found)
            && self.sought(file) == Sought::There(come.to_owned())
    }

    /// Whether the image that was found is the one that a list calls `file`: as long as it is called so, none fits better, and
    /// it does not fit another one as well.
    pub(super) fn is_still(&self, found: &str, file: &str) -> bool {
        let is_anothers = || {
            let found = Path::new(found);
            let meant = decoded(file);
            !self.may_be(found, file) && meant.is_none_or(|meant| !self.may_be(found, &meant))
        };
        self.is_called(found, file)
            && match self.sought(file) {
                Sought::There(path) => !self.fits_better(&path, found, file),
                Sought::Several(_) | Sought::Missing => !is_anothers(),
            }
    }

    /// Whether an image has the name of what a list calls `file`, and there is none at that path; or the name that is meant, and there
    /// is none of the one that is written.
    fn is_called(&self, found: &str, file: &str) -> bool {
        let another_at = |file: &str| {
            let named = image_path(Path::new(""), file);
            let named = named.map(|path| path.components().collect::<PathBuf>());
            named.is_some_and(|named| named != Path::new(found) && self.root.join(named).is_file())
        };
        let is_called = |file: &str| base(found) == base(file) && !another_at(file);
        match decoded(file) {
            Some(meant) if base(&meant) != base(file) => {
                let as_meant = || is_called(&meant) && self.sought_as(file) == Sought::Missing;
                is_called(file) || as_meant()
            }
            Some(meant) if another_at(&meant) => {
                self.sought(file) == Sought::There(found.to_owned())
            }
            Some(_) | None => is_called(file),
        }
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

#[cfg(test)]
mod tests {
    use std::fs;

    use super::super::super::Disk;
    use super::*;

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
        let there = |path: &str| Sought::There(path.to_owned());
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
        let there = |path: &str| Sought::There(path.to_owned());
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
        let there = |path: &str| Sought::There(path.to_owned());
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
        for listed in ["in/t%231.tif", "/scope/in/t%231.tif"] {
            assert_eq!(index.find(listed), there("far/t%231.tif"));
            assert!(index.is_still("far/t%231.tif", listed));
            assert!(!index.is_still("in/t#1.tif", listed));
        }
        // What it means is found again when that is gone, and what becomes of either is noticed.
        fs::remove_file(folder.path().join("far/t%231.tif")).unwrap();
        assert_eq!(index.find("in/t%231.tif"), there("in/t#1.tif"));
        fs::rename(
            folder.path().join("in/t#1.tif"),
            folder.path().join("t#1.tif"),
        )
        .unwrap();
        assert_eq!(index.find("in/t%231.tif"), Sought::Missing);
        round(&mut index);
        assert_eq!(index.find("in/t%231.tif"), there("t#1.tif"));
    }
}
