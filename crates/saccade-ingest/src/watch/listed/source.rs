//! The list as it stands in its file, and what registration made of it.

use std::collections::{BTreeSet, HashSet};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use glam::{DVec2, UVec2};
use saccade_archive::acquisition::{
    AcquisitionError, refuse_link_out, tile_configuration, tile_list, trakem2,
};
use saccade_core::transform::{SectionFromTile, TilePoint};

use super::super::{Folders, Stamp};
use super::ListConfig;
use super::channels::Unfit;
use crate::replay::RawTile;
use crate::replay::acquisition::median_offset;
use crate::replay::detect::{LARGEST_LIST, best};
use crate::replay::lists::{self, Solution, Stage, is_project};

/// A tile that a list names.
#[derive(Clone, Debug)]
pub(super) struct Named {
    /// Its name in the volume.
    pub(super) name: String,
    /// What solutions call it.
    pub(super) known_as: String,
    /// The image as the list names it.
    pub(super) file: String,
    /// Section as the list counts them.
    pub(super) section: u32,
    /// Width and height \[pixels\], if the list says so.
    pub(super) size: Option<UVec2>,
    /// Where the list says that it lies \[pixels\].
    pub(super) stage: SectionFromTile,
    /// Its corner as the stage has it, whatever that counts in.
    pub(super) laid_out: Option<DVec2>,
    /// The channel that its image shows, if that is said.
    pub(super) channel: Option<String>,
    /// Which one of the list it is.
    pub(super) order: usize,
}

/// What the files say.
pub(super) struct Listing {
    /// By section, then as listed.
    pub(super) tiles: Vec<Named>,
    /// What the list's own program found.
    pub(super) own: Option<Solution>,
    /// What its stage counts, where that is not certain.
    pub(super) counts: Option<Stage>,
    /// Images that are left out, since their names do not say the channel.
    pub(super) unfit: Option<Unfit>,
    /// What of it does not count, or otherwise than it is written, in words.
    pub(super) notes: Vec<String>,
    /// The last line, if the list ends in a number of which more may be about to be written.
    pub(super) cut_at: Option<u64>,
}

impl Listing {
    /// Says of all tiles that they lie where the stage has them, or where the transforms do.
    pub(super) fn count_as(&mut self, stage: bool) {
        for tile in &mut self.tiles {
            let own = { self.own.as_ref() }.and_then(|own| own.transforms.get(&tile.known_as));
            let there = own.map(|own| own.apply(TilePoint(DVec2::ZERO)).0);
            let corner = tile.laid_out.filter(|_| stage).or(there);
            tile.stage = corner.map_or(tile.stage, SectionFromTile::translation);
        }
    }
}

/// Reads a list, or a TrakEM2 project as one; with the channels that its images show, or without.
pub(super) fn read(config: &ListConfig, channels: bool) -> Result<Listing, AcquisitionError> {
    let path = &*config.list;
    // A pipe would be waited for.
    if path.metadata().is_ok_and(|meta| !meta.is_file()) {
        return Err(AcquisitionError::Read {
            source: io::Error::other("it is no regular file"),
            path: path.to_owned(),
        });
    }
    let is_xml = path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("xml"));
    let mut taken = HashSet::new();
    let mut unique = |file: &str, channel: Option<&str>| {
        unique(tile_list::stem(file), file, channel, &mut taken)
    };
    let mut listing = if is_xml {
        let patches = trakem2::read(path)?;
        let note = trakem2::left_out(&patches, path);
        let named = patches.into_iter().enumerate().map(|(order, patch)| Named {
            name: unique(&patch.file, None),
            known_as: patch.name().to_owned(),
            section: patch.section,
            size: Some(patch.size),
            stage: patch.transform,
            laid_out: None,
            channel: None,
            order,
            file: patch.file,
        });
        Listing {
            tiles: named.collect(),
            own: None,
            counts: None,
            unfit: None,
            notes: Vec::from_iter(note),
            cut_at: None,
        }
    } else {
        let list = lists::read(path)?;
        let tiles = list.channels.filter(|_| channels).unwrap_or(list.tiles);
        let named = tiles.into_iter().enumerate().map(|(order, tile)| Named {
            name: unique(&tile.file, tile.channel.as_deref()),
            known_as: tile.known_as,
            section: tile.section,
            size: tile.size,
            stage: SectionFromTile::translation(tile.corner),
            laid_out: tile.laid_out,
            channel: tile.channel,
            order,
            file: tile.file,
        });
        Listing {
            tiles: named.collect(),
            own: list.solution,
            counts: list.stage,
            unfit: None,
            notes: list.notes,
            cut_at: list.cut_at,
        }
    };
    listing.tiles.sort_by_key(|tile| tile.section);
    if channels {
        listing.take_channels(config);
        listing.take_along();
    }
    Ok(listing)
}

/// The line of a list, counted from 1, that has a tile in its section; for messages.
pub(super) fn line_of(list: &Path, tile: &Named) -> Option<usize> {
    let text = fs::read(list).ok()?;
    let text = String::from_utf8_lossy(&text);
    let section = f64::from(tile.section);
    let mut lines = (1..).zip(text.lines()).filter(|(_, line)| {
        let words = line.split(|c: char| !(c.is_ascii_alphanumeric() || ".+-".contains(c)));
        let mut numbers = words.filter_map(|word| word.parse::<f64>().ok());
        numbers.any(|number| (number - section).abs() < 0.5)
    });
    let first = lines.next()?;
    let named = |(_, line): &(usize, &str)| line.contains(&tile.file);
    let best = [first].into_iter().chain(lines).find(named);
    Some(best.unwrap_or(first).0)
}

/// A name that no tile listed before has, so that what comes later in the list changes none.
fn unique(stem: &str, file: &str, channel: Option<&str>, taken: &mut HashSet<String>) -> String {
    let safe = |text: &str| -> String {
        let fit = |c: char| {
            if c.is_alphanumeric() || "-_.".contains(c) {
                c
            } else {
                '_'
            }
        };
        text.chars().map(fit).collect()
    };
    let whole = file.trim_start_matches(['/', '.', '\\']);
    let whole = whole.rsplit_once('.').map_or(whole, |(before, _)| before);
    let again = (2..).map(|n: u64| format!("{}-{n}", safe(whole)));
    let of_channel = channel.map(|channel| safe(&format!("{stem}_{channel}")));
    let names = [Some(safe(stem)), of_channel, Some(safe(whole))];
    let mut names = names.into_iter().flatten().chain(again);
    let name = names.find(|name| !name.is_empty() && !taken.contains(name));
    let name = name.unwrap_or_default();
    taken.insert(name.clone());
    name
}

/// The solution that is used.
#[derive(Debug)]
pub(super) struct Adopted {
    pub(super) solution: Solution,
    /// How far its frame is from the list's \[pixels\].
    pub(super) offset: DVec2,
}

impl Adopted {
    /// Where it says that a tile lies, in the list's frame.
    pub(super) fn place(&self, tile: &Named) -> Option<SectionFromTile> {
        let transform = self.solution.transforms.get(&tile.known_as)?;
        Some(transform.shifted(-self.offset))
    }
}

/// Tiles as replay knows them.
pub(super) fn raw(tiles: &[Named], size: impl Fn(usize) -> UVec2) -> Vec<RawTile> {
    let raw = tiles.iter().enumerate().map(|(n, tile)| RawTile {
        name: tile.name.clone(),
        known_as: tile.known_as.clone(),
        image: PathBuf::new(),
        section: tile.section,
        size: size(n),
        stage: tile.stage,
        aligned: None,
        channel: None,
    });
    raw.collect()
}

/// Chooses a solution as replay does: the list's own or that of a project. Its frame becomes that of the list, from
/// which it then refines.
pub(super) fn adopt(
    listing: &Listing,
    projects: &[PathBuf],
    raw: Vec<RawTile>,
) -> Result<Option<Adopted>, AcquisitionError> {
    let wanted: BTreeSet<&str> = listing.tiles.iter().map(|t| t.known_as.as_str()).collect();
    // Names that mean several tiles cannot be looked up.
    if wanted.len() < listing.tiles.len() || wanted.is_empty() {
        return Ok(None);
    }
    let mut solutions = Vec::from_iter(listing.own.clone());
    for project in readable(projects) {
        solutions.push(Solution::read(project)?);
    }
    let Some(solution) = best(&wanted, &raw, solutions, listing.own.as_ref()) else {
        return Ok(None);
    };
    let offset = offset(&solution, raw).unwrap_or_default();
    Ok(Some(Adopted { solution, offset }))
}

/// Those that are projects of TrakEM2.
fn readable(projects: &[PathBuf]) -> impl Iterator<Item = &PathBuf> {
    let small = |path: &&PathBuf| {
        let meta = path.metadata();
        meta.is_ok_and(|meta| meta.is_file() && meta.len() <= LARGEST_LIST)
            && refuse_link_out(path).is_ok()
    };
    projects
        .iter()
        .filter(small)
        .filter(|path| is_project(path))
}

/// Why a project that knows some of the tiles is not used.
pub(super) fn unused_project(listing: &Listing, projects: &[PathBuf]) -> Option<String> {
    let wanted: BTreeSet<&str> = listing.tiles.iter().map(|t| &*t.known_as).collect();
    readable(projects).find_map(|project| {
        let solution = Solution::read(project).ok()?;
        let knows = |name: &&&str| solution.transforms.contains_key(**name);
        let known = wanted.iter().filter(knows).count();
        let first = wanted.iter().find(|name| !knows(name))?;
        (known > 0).then(|| {
            format!(
                "a TrakEM2 project knows {known} of the {} tiles, and is not used, since it does not know the others, such as \
                 {first:?}: {}",
                wanted.len(),
                project.display()
            )
        })
    })
}

/// Why what the list's own program found is not used, where that is not plain to see.
pub(super) fn unused(listing: &Listing) -> Option<String> {
    let own = listing.own.as_ref()?;
    let mut known = HashSet::new();
    let path = own.path.display();
    if let Some(twice) = listing
        .tiles
        .iter()
        .find(|tile| !known.insert(&tile.known_as))
    {
        return Some(format!(
            "registration is not used: several tiles of the list are called {:?}, and it does not say which one it means; \
             give the images different names: {path}",
            twice.known_as
        ));
    }
    let none = !listing
        .tiles
        .iter()
        .any(|tile| own.transforms.contains_key(&tile.known_as));
    (none && !listing.tiles.is_empty())
        .then(|| format!("registration is not used: it names none of the list's images: {path}"))
}

/// How far a solution's frame is from the list's \[pixels\]; `None` if it has none of the tiles.
pub(super) fn offset(solution: &Solution, mut raw: Vec<RawTile>) -> Option<DVec2> {
    for tile in &mut raw {
        tile.aligned = solution.transforms.get(&tile.known_as).copied();
    }
    median_offset(&raw)
}

/// The solution in that file as it is now.
pub(super) fn solution_again(
    path: &Path,
    own: Option<&Solution>,
) -> Result<Solution, AcquisitionError> {
    match own.filter(|own| own.path == path) {
        Some(own) => Ok(own.clone()),
        None if path
            .extension()
            .is_some_and(|e| e.eq_ignore_ascii_case("xml")) =>
        {
            Solution::read(path)
        }
        None => Err(AcquisitionError::Read {
            source: io::ErrorKind::NotFound.into(),
            path: path.to_owned(),
        }),
    }
}

/// Tells when the files that make a list have changed, and rest.
#[derive(Debug)]
pub(super) struct Files {
    list: PathBuf,
    /// What they looked like when they were read.
    read: Option<Vec<Option<Stamp>>>,
    /// What they look like, and since when.
    now: (Vec<Option<Stamp>>, SystemTime),
}

/// How the files are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    /// As they were read.
    Same,
    /// Others than were read, for that long.
    Changed(Duration),
    /// The list is not there.
    Gone,
}

impl Files {
    pub(super) fn new(list: &Path) -> Self {
        Self {
            list: list.to_owned(),
            read: None,
            now: (Vec::new(), SystemTime::UNIX_EPOCH),
        }
    }

    /// Looks at the list, at what Fiji makes of it, and at others that count.
    pub(super) fn look(&mut self, disk: &impl Folders, others: &[PathBuf]) -> State {
        let registered = tile_configuration::registered(&self.list);
        let files = [&self.list, &registered].into_iter().chain(others);
        let looks: Vec<_> = files.map(|file| disk.stamp(file).ok()).collect();
        let now = disk.now();
        let Some(list) = looks[0] else {
            return State::Gone;
        };
        if self.now.0 != looks {
            // One that was there before anybody looked has rested since it was written.
            let last = looks.iter().flatten().map(Stamp::last).max();
            let since = match self.now.0.is_empty() {
                true => last.unwrap_or(list.modified).min(now),
                false => now,
            };
            self.now = (looks, since);
        }
        if self.read.as_ref() == Some(&self.now.0) {
            return State::Same;
        }
        State::Changed(self.age(now))
    }

    /// For how long they look as they do.
    pub(super) fn age(&self, now: SystemTime) -> Duration {
        now.duration_since(self.now.1).unwrap_or_default()
    }

    /// They are read as they looked last.
    pub(super) fn are_read(&mut self) {
        self.read = Some(self.now.0.clone());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_listed_later_changes_no_name() {
        let mut taken = HashSet::new();
        let mut name = |stem: &str, file: &str| unique(stem, file, None, &mut taken);
        let names = [
            name("a", "x/a.tif"),
            name("a", "y/a.tif"),
            name("a b", "/z/a b.tif"),
            name("a", "y/a.tif"),
            name("", "?"),
            name("a", "y/a.tif"),
        ];
        assert_eq!(names, ["a", "y_a", "a_b", "y_a-2", "_", "y_a-3"]);
        // Channels are told apart by their names.
        let names =
            [Some("SE"), Some("BSE")].map(|channel| unique("c", "z/c.tif", channel, &mut taken));
        assert_eq!(names, ["c", "c_BSE"]);
    }
}
