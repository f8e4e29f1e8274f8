//! What is in a folder that somebody points at.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use saccade_archive::acquisition::listed_images::Images;
use saccade_archive::acquisition::{AcquisitionError, AcquisitionInfo, is_inside, trakem2};

use super::acquisition::median_offset;
use super::lists::{self, List, Solution};
use super::{Acquisition, RawTile, ReplayError};
use crate::simulate::stack::{self, Stack, volume_name};

/// A text file larger than this is no tile list \[bytes\].
pub(crate) const LARGEST_LIST: u64 = 256 << 20;

/// Something to watch.
pub enum Input {
    /// A registered stack, for [`crate::simulate::run`].
    Stack {
        /// The stack.
        stack: Box<dyn Stack>,
        /// Where it is: the folder or file itself, or one below.
        path: PathBuf,
        /// A name for the volume, from what was pointed at, wherever below the sections lie.
        name: String,
    },
    /// A real acquisition, for [`super::run`].
    Acquisition(Acquisition),
}

impl std::fmt::Debug for Input {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Input({})", self.describe())
    }
}

impl Input {
    /// One line for people: what was found, and which files were chosen.
    pub fn describe(&self) -> String {
        match self {
            Self::Stack { stack, path, .. } => {
                let extent = stack.info().extent;
                format!(
                    "a stack of {} x {} x {} voxels: {}",
                    extent.x,
                    extent.y,
                    extent.z,
                    path.display()
                )
            }
            Self::Acquisition(acquisition) => {
                let (tiles, sections) = (acquisition.tiles.len(), acquisition.extent.z);
                let solved = acquisition
                    .tiles
                    .iter()
                    .filter(|tile| tile.aligned.is_some());
                let solution = match (&acquisition.solution, solved.count()) {
                    (Some(path), all) if all == tiles => {
                        format!("later moved by {}", path.display())
                    }
                    (Some(path), some) => {
                        format!("{some} of which are later moved by {}", path.display())
                    }
                    (None, _) => "without a later solution".to_owned(),
                };
                let list = acquisition.list.display();
                let bits = 8 * acquisition.dtype.bytes();
                let mixed = match acquisition.shallow {
                    0 => String::new(),
                    shallow => format!(" ({shallow} of 8, which are spread over the whole range)"),
                };
                format!(
                    "an acquisition of {tiles} tiles of {bits} bits{mixed} in {sections} sections: {list}, {solution}"
                )
            }
        }
    }
}

/// Looks for an acquisition in a folder and below, else for a stack.
///
/// - An acquisition has a list of tiles whose images lie anywhere below the folder: `file x y z` per
///   line, a tile configuration of Fiji, or Render's tile specifications. Of several such lists the
///   least deep counts, then the first by name, text before JSON. Its solution has a transform for
///   every tile and moves some of them: what comes with the list, or a TrakEM2 project; one with
///   more than translations counts first.
/// - A stack is the path itself if it can be read as one; else the folder below with section images
///   whose name speaks of raw images rather than of labels, then the one with most sections, then
///   the first by name.
///
/// A folder with a list is no stack: one that has a line that makes no sense, or that names images which are not
/// there, is an error, and so is a TrakEM2 project whose list is missing.
///
/// # Errors
///
/// [`ReplayError`]: what was found but cannot be used, or that nothing was found.
pub fn detect(path: &Path) -> Result<Input, ReplayError> {
    if !path.is_dir() || stack::is_zarr(path) {
        let stack = stack::open(path)?;
        return Ok(Input::Stack {
            stack,
            path: path.to_owned(),
            name: volume_name(path),
        });
    }
    if path.join(AcquisitionInfo::FILE).is_file() {
        return Err(ReplayError::AlreadyArchive {
            path: path.to_owned(),
        });
    }
    let tree = Tree::below(path)?;
    if let Some(acquisition) = find_acquisition(path, &tree)? {
        return Ok(Input::Acquisition(acquisition));
    }
    find_stack(path, &tree)
}

/// Files and folders below a folder, in a settled order: less deep first, then by name.
struct Tree {
    root: PathBuf,
    files: Vec<PathBuf>,
    folders: Vec<PathBuf>,
}

impl Tree {
    fn below(folder: &Path) -> Result<Self, ReplayError> {
        let (mut files, mut folders) = (Vec::new(), Vec::new());
        let mut open = vec![folder.to_owned()];
        while let Some(at) = open.pop() {
            let failed = |source| AcquisitionError::Read {
                source,
                path: at.clone(),
            };
            for entry in fs::read_dir(&at).map_err(failed)? {
                let entry = entry.map_err(failed)?;
                let kind = entry.file_type().map_err(failed)?;
                if kind.is_dir() && !stack::is_zarr(&entry.path()) {
                    open.push(entry.path());
                } else if kind.is_dir() {
                    folders.push(entry.path());
                } else {
                    files.push(entry.path());
                }
            }
            folders.push(at);
        }
        let settle = |paths: &mut Vec<PathBuf>| {
            paths.sort_by_cached_key(|path| (path.components().count(), path.clone()));
        };
        settle(&mut files);
        settle(&mut folders);
        let root = folder.to_owned();
        Ok(Self {
            root,
            files,
            folders,
        })
    }

    /// As of images: a link may lead to somewhere else in the folder.
    fn refuse_link_out(&self, file: &Path) -> Result<(), AcquisitionError> {
        match is_inside(file, &self.root, None) {
            true => Ok(()),
            false => Err(AcquisitionError::LeadsOut {
                path: file.to_owned(),
            }),
        }
    }

    fn with_extension<'a>(&'a self, extension: &'a str) -> impl Iterator<Item = &'a Path> {
        let files = self.files.iter().map(PathBuf::as_path);
        files.filter(move |path| has_extension(path, extension))
    }
}

/// The list of a folder's tiles, to be followed: the one that [`detect`] finds, also while images are missing, or else
/// a TrakEM2 project of images that are there.
///
/// # Errors
///
/// [`ReplayError`]: a list that cannot be read; a link that leads out of the folder, if nothing else may be one.
pub fn find_list(folder: &Path) -> Result<Option<PathBuf>, ReplayError> {
    let (tree, images) = (Tree::below(folder)?, Images::below(folder)?);
    if let Some((list, ..)) = chosen(&tree, &images)? {
        if let Some(other) = another(&tree, &images, &list) {
            log::warn!(
                "several lists say where tiles lie, such as {} and {}; name the one that is meant with --list",
                list.display(),
                other.display()
            );
        }
        return Ok(Some(list));
    }
    for path in projects(&tree) {
        let patches = trakem2::read(path)?;
        if patches.iter().any(|patch| images.has(&patch.file)) {
            return Ok(Some(path.to_owned()));
        }
    }
    let mut lists = ["txt", "json", "xml"]
        .into_iter()
        .flat_map(|e| tree.with_extension(e));
    match lists.find_map(|list| tree.refuse_link_out(list).err()) {
        Some(leads_out) => Err(leads_out.into()),
        None => Ok(None),
    }
}

fn find_acquisition(folder: &Path, tree: &Tree) -> Result<Option<Acquisition>, ReplayError> {
    let images = Images::below(folder)?;
    match chosen(tree, &images)? {
        Some((list, listed, true)) => {
            listed.say_notes();
            listed.say_several(&images, &list);
            with_solution(folder, tree, &images, &list, listed).map(Some)
        }
        // Says which images are missing.
        Some((list, listed, false)) => {
            Acquisition::new(folder, &images, &list, listed.of_all_channels(), None).map(Some)
        }
        None => refuse_project_alone(tree, &images).map(|()| None),
    }
}

/// The list that is meant, and whether all of its images are there.
fn chosen(tree: &Tree, images: &Images) -> Result<Option<(PathBuf, List, bool)>, ReplayError> {
    let (mut incomplete, mut unreadable) = (None, None);
    let text = tree.with_extension("txt");
    for list in text.chain(tree.with_extension("json")).filter(small) {
        if lists::is_registered(list) {
            continue;
        }
        // What whoever wrote the folder points at may be another's.
        if tree.refuse_link_out(list).is_err() {
            continue;
        }
        let listed = match lists::read(list) {
            Ok(listed) => listed,
            Err(error) if lists::is_meant(list, images) => {
                // Text is surely a list; of JSON, another file may be the one that is meant.
                if list
                    .extension()
                    .is_some_and(|e| e.eq_ignore_ascii_case("txt"))
                {
                    return Err(error.into());
                }
                unreadable.get_or_insert(error);
                continue;
            }
            // Most files are no lists; that is no error.
            Err(_) => continue,
        };
        let tiles = listed.of_all_channels();
        let here = images.of_list(lists::files(tiles));
        let found = here.iter().flatten().count();
        if found > 0 && found == tiles.len() {
            return Ok(Some((list.to_owned(), listed, true)));
        }
        let counts = found > 0 || lists::is_certain(list, tiles);
        if counts && incomplete.is_none() {
            incomplete = Some((list.to_owned(), listed, false));
        }
    }
    match unreadable {
        Some(error) => Err(error.into()),
        None => Ok(incomplete),
    }
}

/// Another list of images that are there.
fn another<'a>(tree: &'a Tree, images: &Images, list: &Path) -> Option<&'a Path> {
    /// Files besides the list that are read at most: some microscopes write one for each image.
    const MOST: usize = 1000;
    let text = tree.with_extension("txt");
    let others = text.chain(tree.with_extension("json"));
    let others = others.filter(|path| *path != list && small(path) && !lists::is_registered(path));
    let others = others.filter(|path| tree.refuse_link_out(path).is_ok());
    others.take(MOST).find(|path| {
        lists::read(path).is_ok_and(|listed| {
            let mut tiles = listed.of_all_channels().iter();
            tiles.any(|tile| images.has(&tile.file))
        })
    })
}

fn has_extension(path: &Path, extension: &str) -> bool {
    path.extension()
        .is_some_and(|e| e.eq_ignore_ascii_case(extension))
}

/// Where a project is, there was a list from which it was made.
fn refuse_project_alone(tree: &Tree, images: &Images) -> Result<(), ReplayError> {
    for path in projects(tree) {
        let patches = trakem2::read(path)?;
        let here = |patch: &&trakem2::Patch| images.has(&patch.file);
        let here = patches.iter().filter(here).count();
        if here > 0 {
            return Err(ReplayError::NoList {
                images: here,
                project: path.to_owned(),
            });
        }
    }
    Ok(())
}

/// Projects of TrakEM2.
fn projects(tree: &Tree) -> impl Iterator<Item = &Path> {
    let files = tree.with_extension("xml").filter(small);
    let files = files.filter(|path| tree.refuse_link_out(path).is_ok());
    files.filter(|path| lists::is_project(path))
}

fn small(path: &&Path) -> bool {
    fs::metadata(path).is_ok_and(|meta| meta.is_file() && meta.len() <= LARGEST_LIST)
}

fn with_solution(
    folder: &Path,
    tree: &Tree,
    images: &Images,
    list: &Path,
    listed: List,
) -> Result<Acquisition, ReplayError> {
    let tiles = listed.of_all_channels();
    let wanted: BTreeSet<&str> = tiles.iter().map(|tile| &*tile.known_as).collect();
    let unsolved = Acquisition::new(folder, images, list, tiles, None)?;
    if wanted.len() < tiles.len() {
        // Names that mean several tiles cannot be looked up in a solution.
        return Ok(unsolved);
    }
    let mut solutions = Vec::from_iter(listed.solution.clone());
    for project in projects(tree) {
        solutions.push(Solution::read(project)?);
    }
    match best(
        &wanted,
        &unsolved.tiles,
        solutions,
        listed.solution.as_ref(),
    ) {
        None => Ok(unsolved),
        Some(best) => Acquisition::new(folder, images, list, tiles, Some(&best)),
    }
}

/// The solution that counts for all these tiles, if there is one; else the list's `own`, if it knows some of them. Others
/// that know some only are about other tiles, which happen to have such names.
pub(crate) fn best(
    wanted: &BTreeSet<&str>,
    tiles: &[RawTile],
    solutions: Vec<Solution>,
    own: Option<&Solution>,
) -> Option<Solution> {
    let has = |solution: &Solution, name: &str| solution.transforms.contains_key(name);
    let mut best: Option<Solution> = None;
    for solution in solutions {
        let all = wanted.iter().all(|name| has(&solution, name));
        if !all || !refines(tiles, &solution) {
            continue;
        }
        if best
            .as_ref()
            .is_none_or(|best| solution.is_affine() && !best.is_affine())
        {
            best = Some(solution);
        }
    }
    let in_part = |own: &&Solution| wanted.iter().any(|name| has(own, name)) && refines(tiles, own);
    best.or_else(|| own.filter(in_part).cloned())
}

/// Whether a solution says anything that the stage did not.
fn refines(tiles: &[RawTile], solution: &Solution) -> bool {
    if solution.is_affine() {
        return true;
    }
    let mut tiles = tiles.to_vec();
    for tile in &mut tiles {
        tile.aligned = solution.transforms.get(&tile.known_as).copied();
    }
    let Some(offset) = median_offset(&tiles) else {
        return false;
    };
    tiles.iter().any(|tile| {
        let moved = tile
            .aligned
            .map(|aligned| aligned.shifted(-offset).elements());
        let stage = tile.stage.elements();
        moved.is_some_and(|moved| {
            let (x, y) = (moved[4] - stage[4], moved[5] - stage[5]);
            x.abs().max(y.abs()) > 1e-3
        })
    })
}

fn find_stack(path: &Path, tree: &Tree) -> Result<Input, ReplayError> {
    let mut candidates = Vec::new();
    for folder in &tree.folders {
        let sections = stack::count(folder);
        if sections > 0 {
            let inside = folder.strip_prefix(path).unwrap_or(folder);
            // What was pointed at counts before anything below it.
            let below = !inside.as_os_str().is_empty();
            let likely = likeness(&inside.to_string_lossy().to_lowercase());
            candidates.push(((below, -likely, -sections), folder));
        }
    }
    candidates.sort();
    let mut first_error = None;
    for (_, folder) in candidates {
        match stack::open(folder) {
            Ok(stack) => {
                return Ok(Input::Stack {
                    stack,
                    path: folder.clone(),
                    name: volume_name(path),
                });
            }
            Err(error) => _ = first_error.get_or_insert(error),
        }
    }
    let nothing = || stack::StackError::Empty {
        path: path.to_owned(),
    };
    Err(first_error.unwrap_or_else(nothing).into())
}

/// How much a folder's name speaks of images of tissue rather than of what was found in them.
fn likeness(name: &str) -> i64 {
    let has = |words: &[&str]| words.iter().any(|word| name.contains(word));
    let images = has(&["raw", "gray", "grey", "image", "section", "em"]);
    let found = has(&[
        "label", "seg", "mask", "truth", "membrane", "mito", "synapse", "body", "bodies",
    ]);
    i64::from(images && !found) - i64::from(found)
}
