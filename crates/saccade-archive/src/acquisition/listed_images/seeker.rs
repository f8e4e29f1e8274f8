//! Which of the files it is.

use std::path::{Path, PathBuf};

use super::super::tile_list::{base, decoded};
use super::paths::{MOST_FOLDERS, folder_of, is_named, likeness, names, path_of, tail};
use super::{Files, Mentions, Sought};

/// Why an image that has the name is not taken for what a list calls so.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NotTaken {
    /// It is as much like another one that the list names.
    AsAnother,
    /// The folder that the list names is there, and it does not lie in that.
    Elsewhere,
    /// It shows another channel, by its name.
    Channel,
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

    /// Of what a list calls `file`, where that is missing: an image that has its name nevertheless, of several one that is most like
    /// it, and why it is not taken.
    pub fn not_taken(&self, file: &str) -> Option<(PathBuf, NotTaken)> {
        /// Of thousands that are called alike, few are looked at.
        const MOST_ASKED: usize = 64;
        let meant = decoded(file);
        let spellings = [Some(file), meant.as_deref()].into_iter().flatten();
        let why = |path: &Path, file: &str| match () {
            () if !self.files.can_be(path, file) => Some(NotTaken::Channel),
            () if likeness(path, file) < self.at_home(file) => Some(NotTaken::Elsewhere),
            () if !self.mentions.may_be(path, file) => Some(NotTaken::AsAnother),
            () => None,
        };
        let refused = spellings.filter_map(|file| {
            let mut called: Vec<_> = { self.files.called(base(file), "") }
                .map(|path| (likeness(&path, file), path))
                .collect();
            called.sort_by(|(one, path), (other, beside)| other.cmp(one).then(path.cmp(beside)));
            let mut paths = { called.into_iter() }
                .map(|(_, path)| path)
                .take(MOST_ASKED);
            let there = paths.find(|path| self.files.is_there(path))?;
            let why = why(&there, file)?;
            Some((there, why))
        });
        { refused }.next()
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
        let others = { self.mentions.beside(&folder) }
            .filter(|name| !names(name).any(|name| name == base(file)));
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
