//! What a list names.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::path::Path;

use super::super::tile_list::{base, decoded};
use super::paths::{MOST_FOLDERS, folder_of, key, likeness, tail};

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
    pub(super) fn several(&self, tail: &str) -> bool {
        self.ends.get(&key(tail)).is_some_and(|count| *count > 1)
    }

    /// Whether an image that lies elsewhere may be what the list calls `file`: not, if it is as much like another one that the
    /// list names, or more.
    pub(super) fn may_be(&self, path: &Path, file: &str) -> bool {
        let tail = tail(file, likeness(path, file).min(MOST_FOLDERS));
        tail.is_none_or(|tail| !self.several(&tail))
    }

    /// Some images of a folder that the list names.
    pub(super) fn beside(&self, folder: &str) -> impl Iterator<Item = &String> {
        self.folders.get(&key(folder)).into_iter().flatten()
    }
}
