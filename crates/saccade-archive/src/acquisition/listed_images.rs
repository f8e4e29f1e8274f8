//! Which image a list means: lists name folders of other machines, or none.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::fs;
use std::hash::{BuildHasher, BuildHasherDefault, DefaultHasher};
use std::path::{Component, Path, PathBuf};

use super::AcquisitionError;
use super::image_path;
use super::tile_list::{base, decoded};

/// Folders before an image's name that are compared at most. What differs only before them is not told apart.
const MOST_FOLDERS: usize = 8;

/// What is found under a name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Sought {
    /// The image, below the root.
    There(PathBuf),
    /// Images in several folders, of which the list does not say which one it means; two of them.
    Several([PathBuf; 2]),
    /// No image.
    Missing,
}

/// The files below a root.
pub trait Files {
    /// Whether a file lies at a path below the root.
    fn is_there(&self, path: &Path) -> bool;

    /// Where files of a name may lie, below the root: at least all that lie in folders whose last parts are `folders`, such as
    /// `s01/raw`; all of them where that is empty.
    fn called(&self, name: &str, folders: &str) -> impl Iterator<Item = PathBuf>;

    /// Whether a folder lies at a path below the root.
    fn is_folder(&self, path: &Path) -> bool;

    /// Whether an image that lies elsewhere can be what a list calls `file`, as far as its path alone tells.
    fn can_be(&self, _path: &Path, _file: &str) -> bool {
        true
    }
}

/// Which images a list names, as far as that tells whether one that lies elsewhere can be another one's.
#[derive(Clone, Debug, Default)]
pub struct Mentions {
    /// How many images end in a name, or in a name with folders before it, by the hash of that. With folders only where several
    /// have the name.
    ends: HashMap<u64, u32>,
    /// Some images of each folder that the list names, by the folder's hash.
    folders: HashMap<u64, Vec<String>>,
}

/// Images of a folder that are looked for, to know which one it is.
const MOST_SIBLINGS: usize = 8;

/// The hash by which a name or path is known.
pub fn key(name: &str) -> u64 {
    BuildHasherDefault::<DefaultHasher>::default().hash_one(name)
}

/// A path's parts from its end on, however they are separated, without those that mean nothing.
fn parts(file: &str) -> impl Iterator<Item = &str> {
    let parts = file.rsplit(['/', '\\']);
    parts.filter(|part| !matches!(*part, "" | "."))
}

/// A path's last part and so many folders before it; `None` if there are not so many.
fn tail(file: &str, folders: usize) -> Option<String> {
    let mut parts: Vec<_> = parts(file).take(folders + 1).collect();
    parts.reverse();
    (parts.len() > folders).then(|| parts.join("/"))
}

/// Paths in the order of their ends, so that those which end alike lie beside one another.
#[derive(Clone, Debug, Default)]
pub struct Ends<T>(BTreeMap<String, Vec<T>>);

impl<T> Ends<T> {
    /// Adds what has a path, with slashes.
    pub fn insert(&mut self, path: &str, value: T) {
        self.0.entry(from_its_end(path)).or_default().push(value);
    }

    /// Those that end so: in these last parts, such as `s01/raw`.
    pub fn ending<'a>(&'a self, end: &str) -> impl Iterator<Item = &'a T> + use<'a, T> {
        let end = from_its_end(end);
        let from = self.0.range(end.clone()..);
        let alike = from.take_while(move |(path, _)| path.starts_with(&end));
        alike.flat_map(|(_, values)| values)
    }
}

/// Each part is ended by a slash, so that none is the beginning of another.
fn from_its_end(path: &str) -> String {
    let parts = path.rsplit('/').filter(|part| !part.is_empty());
    parts.flat_map(|part| [part, "/"]).collect()
}

/// The folder that a list names for an image, in one spelling; `None` if it names none.
fn folder_of(file: &str) -> Option<String> {
    let mut folders: Vec<_> = parts(file).skip(1).collect();
    folders.reverse();
    (!folders.is_empty()).then(|| folders.join("/"))
}

/// How many folders two paths have in common from their ends on.
fn likeness(path: &Path, file: &str) -> usize {
    let folders = path.components().rev().skip(1);
    let both = folders.zip(parts(file).skip(1));
    both.take_while(|(folder, named)| folder.as_os_str() == *named)
        .count()
}

/// The path below the root that a list names, in one spelling; `None` if it leads out.
fn path_of(file: &str) -> Option<PathBuf> {
    let path = image_path(Path::new(""), file)?;
    let parts = { path.components() }.filter(|part| !matches!(part, Component::CurDir));
    Some(parts.collect())
}

fn is_named(path: &Path, file: &str) -> bool {
    path.file_name().is_some_and(|name| name == base(file))
}

/// The names that the image may have which a list calls `file`: as it is written, and as it is meant if that is part of a
/// URL.
pub fn names(file: &str) -> impl Iterator<Item = String> {
    let meant = decoded(file).map(|decoded| base(&decoded).to_owned());
    let meant = meant.filter(|name| name != base(file));
    [base(file).to_owned()].into_iter().chain(meant)
}

impl Mentions {
    /// Of a list's images, as it calls them.
    pub fn of<'a>(files: impl Iterator<Item = &'a str>) -> Self {
        let spellings = |file: &str| [Some(file.to_owned()), decoded(file)].into_iter().flatten();
        let mut known = HashSet::new();
        let mut is_new =
            |file: &&str| known.insert(key(&decoded(file).unwrap_or((*file).to_owned())));
        let files: Vec<&str> = files.filter(&mut is_new).collect();
        let mut ends: HashMap<u64, u32> = HashMap::new();
        for file in &files {
            let names: BTreeSet<u64> = spellings(file).map(|file| key(base(&file))).collect();
            for name in names {
                *ends.entry(name).or_default() += 1;
            }
        }
        let names = ends.iter().filter(|(_, count)| **count > 1);
        let shared: HashSet<u64> = names.map(|(name, _)| *name).collect();
        let is_shared = |file: &str| shared.contains(&key(base(file)));
        for file in &files {
            let mut tails = BTreeSet::new();
            for spelling in spellings(file).filter(|file| is_shared(file)) {
                let of = (1..=MOST_FOLDERS).map_while(|folders| tail(&spelling, folders));
                tails.extend(of.map(|tail| key(&tail)));
            }
            for tail in tails {
                *ends.entry(tail).or_default() += 1;
            }
        }
        let mut folders: HashMap<u64, Vec<String>> = HashMap::new();
        for file in &files {
            let of = spellings(file).filter_map(|spelling| folder_of(&spelling));
            for folder in of.collect::<BTreeSet<_>>() {
                let siblings = folders.entry(key(&folder)).or_default();
                if siblings.len() < MOST_SIBLINGS {
                    siblings.push(base(file).to_owned());
                }
            }
        }
        Self { ends, folders }
    }

    /// Whether several images end so.
    fn several(&self, tail: &str) -> bool {
        self.ends.get(&key(tail)).is_some_and(|count| *count > 1)
    }

    /// Whether an image that lies elsewhere may be what the list calls `file`: not, if it is as much like another one that the
    /// list names, or more.
    fn may_be(&self, path: &Path, file: &str) -> bool {
        let tail = tail(file, likeness(path, file).min(MOST_FOLDERS));
        tail.is_none_or(|tail| !self.several(&tail))
    }
}

/// Finds what a list means among files.
#[derive(Debug)]
pub struct Seeker<'a, F> {
    /// What there is.
    pub files: &'a F,
    /// What else the list names.
    pub mentions: &'a Mentions,
}

impl<F: Files> Seeker<'_, F> {
    /// The image that a list calls `file`: at that path, else by its name. Of several of that name the one whose
    /// folders are most like those that the list names; none, if that could be several, if it is as much like another one that the
    /// list names, or if it is [stray](Self::is_stray). If there is none, the same of what `file` means [`decoded`].
    pub fn sought(&self, file: &str) -> Sought {
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
        if let Some(path) = self.exactly(file) {
            return Sought::There(path);
        }
        let name = base(file);
        if matches!(name, "" | "." | "..") {
            return Sought::Missing;
        }
        let most = (1..=MOST_FOLDERS).take_while(|folders| tail(file, *folders).is_some());
        for folders in (self.at_home(file)..=most.last().unwrap_or(0)).rev() {
            let Some(end) = tail(file, folders).filter(|end| !self.mentions.several(end)) else {
                continue;
            };
            let before = end.rsplit_once('/').map_or("", |(before, _)| before);
            let called = self.files.called(name, before);
            let alike = called.map(|path| (likeness(&path, file), path));
            let mut paths: Vec<(usize, PathBuf)> = alike
                .filter(|(like, path)| *like >= folders && self.mentions.may_be(path, file))
                .filter(|(_, path)| self.files.can_be(path, file))
                .filter(|(_, path)| self.files.is_there(path))
                .collect();
            // Those that are more alike were none, unless there are more folders than are compared.
            let best = paths.iter().map(|(like, _)| *like).max();
            paths.retain(|(like, _)| Some(*like) == best);
            paths.sort();
            match &paths[..] {
                [] => {}
                [(_, path)] => return Sought::There(path.clone()),
                [(_, one), (_, other), ..] => {
                    return Sought::Several([one.clone(), other.clone()]);
                }
            }
        }
        Sought::Missing
    }

    /// How many folders an image that lies elsewhere has in common at least with what a list calls `file`: as many as are
    /// sure to be its own, since there is a folder at that path, or others of the list lie in it. What is in none such is late.
    fn at_home(&self, file: &str) -> usize {
        let Some(folder) = folder_of(file) else {
            return 0;
        };
        let count = folder.split('/').count().min(MOST_FOLDERS);
        let named = path_of(file);
        let named = named.as_deref().and_then(Path::parent);
        let named = named.filter(|named| !named.as_os_str().is_empty());
        if named.is_some_and(|named| self.files.is_folder(named)) {
            return count;
        }
        let siblings = self.mentions.folders.get(&key(&folder));
        let siblings = siblings.into_iter().flatten();
        let others = siblings.filter(|name| !names(name).any(|name| name == base(file)));
        let siblings: Vec<String> = others.flat_map(|name| names(name)).collect();
        let are_there = |folders: &usize| {
            let end = tail(&folder, folders - 1).unwrap_or_default();
            siblings.iter().any(|name| {
                let sibling = format!("{folder}/{name}");
                let mut called = self.files.called(name, &end);
                called
                    .any(|path| likeness(&path, &sibling) >= *folders && self.files.is_there(&path))
            })
        };
        (1..=count).rev().find(are_there).unwrap_or(0)
    }

    /// The image at the path that a list calls `file`.
    fn exactly(&self, file: &str) -> Option<PathBuf> {
        path_of(file).filter(|named| self.files.is_there(named))
    }

    /// Whether an image can be what a list calls `file`, as far as that can be told without looking at any file.
    pub fn may_be(&self, path: &Path, file: &str) -> bool {
        let may_be = |file: &str| {
            let is_exact = path_of(file).is_some_and(|named| named == path);
            let can_be = || self.mentions.may_be(path, file) && self.files.can_be(path, file);
            is_named(path, file) && (is_exact || can_be())
        };
        may_be(file) || decoded(file).is_some_and(|meant| may_be(&meant))
    }

    /// Whether an image that has come fits what a list calls `file` better than the one that was found.
    pub fn fits_better(&self, come: &Path, found: &Path, file: &str) -> bool {
        let fit = |path: &Path| {
            let like = |file: &str| likeness(path, file);
            let as_meant = decoded(file).map_or(0, |meant| like(&meant));
            (like(file).max(as_meant), is_named(path, file))
        };
        // The file system is asked of few.
        come != found
            && fit(come) > fit(found)
            && self.sought(file) == Sought::There(come.to_owned())
    }

    /// Whether the image that was found is the one that a list calls `file`: as long as it is called so, none fits better, and
    /// it does not fit another one as well.
    pub fn is_still(&self, found: &Path, file: &str) -> bool {
        self.is_called(found, file)
            && match self.sought(file) {
                Sought::There(path) => !self.fits_better(&path, found, file),
                Sought::Several(_) | Sought::Missing => {
                    self.may_be(found, file) && !self.is_stray(found, file)
                }
            }
    }

    /// Whether an image is surely none that a list calls `file`: its path says so, or it is not in the folder that the list names,
    /// and that is there.
    pub fn is_stray(&self, path: &Path, file: &str) -> bool {
        let is_stray = |file: &str| {
            likeness(path, file) < self.at_home(file) || !self.files.can_be(path, file)
        };
        is_stray(file) && decoded(file).is_none_or(|meant| is_stray(&meant))
    }

    /// Whether an image has the name of what a list calls `file`, and there is none at that path; or the name that is meant, and there
    /// is none of the one that is written.
    fn is_called(&self, found: &Path, file: &str) -> bool {
        let another_at = |file: &str| self.exactly(file).is_some_and(|path| path != found);
        let is_called = |file: &str| is_named(found, file) && !another_at(file);
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
}

/// The images below a folder, as they lay when it was looked through.
#[derive(Clone, Debug)]
pub struct Images {
    root: PathBuf,
    /// Below the root.
    paths: Ends<PathBuf>,
}

impl Images {
    /// Looks through a folder and the folders in it.
    ///
    /// # Errors
    ///
    /// [`AcquisitionError::Read`] for a folder that cannot be listed.
    pub fn below(folder: &Path) -> Result<Self, AcquisitionError> {
        let mut paths = Ends::default();
        let mut open = vec![PathBuf::new()];
        while let Some(at) = open.pop() {
            let here = folder.join(&at);
            let failed = |source| AcquisitionError::Read {
                source,
                path: here.clone(),
            };
            for entry in fs::read_dir(&here).map_err(failed)? {
                let entry = entry.map_err(failed)?;
                let kind = entry.file_type().map_err(failed)?;
                let path = at.join(entry.file_name());
                if kind.is_dir() {
                    open.push(path);
                } else if entry.file_name().to_str().is_some() {
                    paths.insert(&path.to_string_lossy(), path.clone());
                }
            }
        }
        Ok(Self {
            root: folder.to_owned(),
            paths,
        })
    }

    /// Of a list's images: the path of each that it calls so, in the list's order, or none. Of several that may be meant the
    /// smallest is taken; [`Self::several`] says so.
    pub fn of_list<'a>(
        &self,
        files: impl Iterator<Item = &'a str> + Clone,
    ) -> Vec<Option<PathBuf>> {
        let mentions = Mentions::of(files.clone());
        let seeker = self.seeker(&mentions);
        files
            .map(|file| match seeker.sought(file) {
                Sought::There(path) => Some(self.root.join(path)),
                Sought::Several([one, _]) => Some(self.root.join(one)),
                Sought::Missing => None,
            })
            .collect()
    }

    /// Two images that may be meant as well by what a list calls one, for each such.
    pub fn several<'a>(&self, files: impl Iterator<Item = &'a str> + Clone) -> Vec<[PathBuf; 2]> {
        let mentions = Mentions::of(files.clone());
        let seeker = self.seeker(&mentions);
        files
            .filter_map(|file| match seeker.sought(file) {
                Sought::Several(both) => Some(both.map(|path| self.root.join(path))),
                Sought::There(_) | Sought::Missing => None,
            })
            .collect()
    }

    /// Whether any image may be what a list calls `file`, whatever else it names.
    pub fn has(&self, file: &str) -> bool {
        let alone = Mentions::default();
        self.seeker(&alone).sought(file) != Sought::Missing
    }

    fn seeker<'a>(&'a self, mentions: &'a Mentions) -> Seeker<'a, Self> {
        Seeker {
            files: self,
            mentions,
        }
    }
}

impl Files for Images {
    fn is_there(&self, path: &Path) -> bool {
        self.root.join(path).is_file()
    }

    fn is_folder(&self, path: &Path) -> bool {
        self.root.join(path).is_dir()
    }

    fn called(&self, name: &str, folders: &str) -> impl Iterator<Item = PathBuf> {
        let found = self.paths.ending(&format!("{folders}/{name}"));
        found.cloned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is found below a root for a list of this image alone.
    fn alone(images: &Images, file: &str, root: &Path) -> Option<PathBuf> {
        let [found] = images.of_list([file].into_iter()).try_into().unwrap();
        assert_eq!(images.has(file), found.is_some());
        Some(found?.strip_prefix(root).unwrap().to_owned())
    }

    fn several(images: &Images, file: &str) -> Option<[PathBuf; 2]> {
        images.several([file].into_iter()).pop()
    }

    /// A name's twin in another section's folder is no reason to take that one's.
    #[test]
    fn an_image_that_is_as_much_like_another_is_none() {
        let folder = tempfile::tempdir().unwrap();
        for file in [
            "s00/raw/r.tif",
            "s02/raw/r.tif",
            "deep/s03/raw/r.tif",
            "raw/one.tif",
        ] {
            let path = folder.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        }
        let images = Images::below(folder.path()).unwrap();
        for (before, slash) in [
            ("", "/"),
            ("/scope/", "//"),
            ("C:\\scope\\", "\\"),
            ("./", "/./"),
        ] {
            let listed = [0, 1, 2, 3].map(|z| format!("{before}s{z:02}{slash}raw{slash}r.tif"));
            let files = listed.iter().map(String::as_str).chain(["x/one.tif"]);
            let found = images.of_list(files.clone());
            let below = |path: &PathBuf| path.strip_prefix(folder.path()).unwrap().to_owned();
            let found: Vec<_> = { found.iter() }
                .map(|path| path.as_ref().map(below))
                .collect();
            let there = |path: &str| Some(PathBuf::from(path));
            assert_eq!(
                found,
                [
                    there("s00/raw/r.tif"),
                    None,
                    there("s02/raw/r.tif"),
                    there("deep/s03/raw/r.tif"),
                    there("raw/one.tif"),
                ],
                "{before}"
            );
            assert!(images.several(files).is_empty());
        }
        // The only one of a name may be anywhere; of others so may none that is as much like another.
        let files = [
            "r.tif",
            "s00/r.tif",
            "/far/s01/r.tif",
            "s%202/r.tif",
            "x/one.tif",
        ];
        let mentions = Mentions::of(files.into_iter());
        let seeker = images.seeker(&mentions);
        let may_be = |path: &str| {
            let path = Path::new(path);
            files.map(|file| seeker.may_be(path, file))
        };
        assert_eq!(may_be("r.tif"), [true, false, false, false, false]);
        assert_eq!(may_be("s00/r.tif"), [false, true, false, false, false]);
        assert_eq!(may_be("deep/s01/r.tif"), [false, false, true, false, false]);
        assert_eq!(may_be("s 2/r.tif"), [false, false, false, true, false]);
        assert_eq!(may_be("raw/r.tif"), [false; 5]);
        assert_eq!(may_be("raw/one.tif"), [false, false, false, false, true]);
        // Alone it may be any.
        assert!(several(&images, "/scope/s01/raw/r.tif").is_some());
    }

    #[test]
    fn paths_that_end_alike_are_found_by_their_ends() {
        let mut ends = Ends::default();
        for (n, path) in [
            "a/raw", "b/raw", "b/xraw", "c/b/raw", "raw", "raw/b", "é/raw",
        ]
        .iter()
        .enumerate()
        {
            ends.insert(path, n);
        }
        let found = |end: &str| {
            let mut found: Vec<_> = ends.ending(end).copied().collect();
            found.sort_unstable();
            found
        };
        assert_eq!(found("raw"), [0, 1, 3, 4, 6]);
        assert_eq!(found("b/raw"), [1, 3]);
        assert_eq!(found("/b//raw"), [1, 3]);
        assert_eq!(found("c/b/raw"), [3]);
        assert_eq!(found("xraw"), [2]);
        assert_eq!(found("b"), [5]);
        assert!(found("aw").is_empty() && found("d/raw").is_empty());
        assert_eq!(found("").len(), 7);
    }

    #[test]
    fn images_are_found_by_name() {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir_all(folder.path().join("deep/er")).unwrap();
        fs::create_dir_all(folder.path().join("other")).unwrap();
        for file in ["deep/er/a.tif", "other/a.tif", "b.tif"] {
            fs::write(folder.path().join(file), "").unwrap();
        }
        let images = Images::below(folder.path()).unwrap();
        let found = |file| alone(&images, file, folder.path());
        assert_eq!(found("other/a.tif").unwrap(), Path::new("other/a.tif"));
        assert_eq!(found("editme/a.tif").unwrap(), Path::new("deep/er/a.tif"));
        assert_eq!(found("C:\\scope\\b.tif").unwrap(), Path::new("b.tif"));
        assert_eq!(found("none.tif"), None);
        let [taken, other] = several(&images, "editme/a.tif").unwrap();
        assert!(taken.ends_with("deep/er/a.tif") && other.ends_with("other/a.tif"));
        for clear in ["other/a.tif", "b.tif", "none.tif"] {
            assert_eq!(several(&images, clear), None, "{clear}");
        }
    }

    #[test]
    fn names_of_urls_are_found_decoded_where_no_file_has_them_as_they_are() {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir_all(folder.path().join("in/a b")).unwrap();
        fs::create_dir_all(folder.path().join("other")).unwrap();
        let files = [
            "in/t#1.tif",
            "in/ü.tif",
            "in/both 1.tif",
            "other/both%201.tif",
            "in/50%.tif",
            "in/100%2525.tif",
            "in/a b/same.tif",
            "in/same.tif",
            "x.tif",
        ];
        for file in files {
            fs::write(folder.path().join(file), "").unwrap();
        }
        // What lies beside the folder is out of reach.
        let inner = folder.path().join("in");
        let all = Images::below(folder.path()).unwrap();
        let inside = Images::below(&inner).unwrap();
        let found = |images: &Images, file| alone(images, file, folder.path());
        for (listed, there) in [
            ("/scope/a%20b/t%231.tif", "in/t#1.tif"),
            ("in/t%231.tif", "in/t#1.tif"),
            ("/scope/%C3%BC.tif", "in/ü.tif"),
            ("/scope/50%25.tif", "in/50%.tif"),
            // As it is, also elsewhere, before what it means; but not where the folder that is named is there.
            ("/scope/in/both%201.tif", "other/both%201.tif"),
            ("in/both%201.tif", "in/both 1.tif"),
            ("/scope/100%2525.tif", "in/100%2525.tif"),
            // Where only the folder is encoded, it tells which one is meant.
            ("in/a%20b/same.tif", "in/a b/same.tif"),
        ] {
            assert_eq!(
                found(&all, listed).as_deref(),
                Some(Path::new(there)),
                "{listed}"
            );
        }
        assert_eq!(several(&all, "in/a%20b/same.tif"), None);
        assert!(several(&all, "/scope/s%61me.tif").is_some());
        for nothing in [
            "%2e%2e%2fx.tif",
            "%2E%2E/x.tif",
            "a%20b%2Fsame.tif",
            "..%5cx.tif",
            "%2e%2e",
            "%2e",
            "x%00.tif",
            "%ff.tif",
            "t%2.tif",
            "t%zz1.tif",
        ] {
            assert_eq!(found(&inside, nothing), None, "{nothing}");
        }
    }
}
