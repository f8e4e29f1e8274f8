//! Files that say where the tiles of an acquisition lie, whatever program wrote them.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use glam::{DVec2, UVec2};
use saccade_archive::acquisition::listed_images::Images;
use saccade_archive::acquisition::tile_list::{self, ListedTile};
use saccade_archive::acquisition::tile_specs::{self, TileSpec};
use saccade_archive::acquisition::trakem2::{self, Patch};
use saccade_archive::acquisition::{
    AcquisitionError, readable, refuse_link_out, tile_configuration,
};
use saccade_core::transform::SectionFromTile;

mod stage;
mod twice;

pub(crate) use stage::Stage;
use stage::transformed_corner;

/// Where registration says that tiles lie.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Solution {
    /// The file that says so.
    pub(crate) path: PathBuf,
    /// By what it calls the tiles.
    pub(crate) transforms: BTreeMap<String, SectionFromTile>,
}

impl Solution {
    /// Of a TrakEM2 project.
    pub(crate) fn read(path: &Path) -> Result<Self, AcquisitionError> {
        let patches = trakem2::read(path)?;
        if let Some(left_out) = trakem2::left_out(&patches, path) {
            log::warn!("{left_out}");
        }
        let named = patches
            .iter()
            .map(|p: &Patch| (p.name().to_owned(), p.transform));
        Ok(Self {
            path: path.to_owned(),
            transforms: named.collect(),
        })
    }

    /// Whether any transform does more than move.
    pub(super) fn is_affine(&self) -> bool {
        let mut all = self.transforms.values();
        all.any(|transform| transform.elements()[..4] != [1.0, 0.0, 0.0, 1.0])
    }
}

/// A tile that a list names.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Listed {
    /// The image as the list names it.
    pub(crate) file: String,
    /// What solutions call it: the image's name without folder and extension; where several have that name, what the list has
    /// instead, its tile's id or the image with its folders.
    pub(crate) known_as: String,
    /// Low corner in its section \[pixels\].
    pub(crate) corner: DVec2,
    /// The same as the stage has it, whatever that counts in.
    pub(crate) laid_out: Option<DVec2>,
    /// Section: z index, possibly not starting at 0.
    pub(crate) section: u32,
    /// Width and height \[pixels\], if the list says so.
    pub(crate) size: Option<UVec2>,
    /// The channel that it shows, if the list says so.
    pub(crate) channel: Option<String>,
}

impl Listed {
    /// The image's name without folder and extension.
    pub(crate) fn stem(&self) -> &str {
        tile_list::stem(&self.file)
    }
}

impl From<ListedTile> for Listed {
    fn from(tile: ListedTile) -> Self {
        Self {
            known_as: tile.name().to_owned(),
            file: tile.file,
            corner: tile.corner,
            laid_out: None,
            section: tile.section,
            size: None,
            channel: None,
        }
    }
}

/// Tiles with the places that the stage had for them, and what the same program says of them.
pub(crate) struct List {
    /// Without a channel each.
    pub(crate) tiles: Vec<Listed>,
    /// The same, or others, for each channel that they show, if the list says so.
    pub(crate) channels: Option<Vec<Listed>>,
    pub(crate) solution: Option<Solution>,
    /// What its stage counts, where that is not certain.
    pub(crate) stage: Option<Stage>,
    /// What of it does not count, or otherwise than it is written, in words.
    pub(crate) notes: Vec<String>,
    /// The last line, if the list ends in a number of which more may be about to be written.
    pub(crate) cut_at: Option<u64>,
}

impl List {
    /// Of lines, and of those that registration made of them, in a file of its own.
    fn of_lines(
        tiles: Vec<ListedTile>,
        registered: Option<(PathBuf, Vec<ListedTile>)>,
        path: &Path,
    ) -> Self {
        let cut_at = tiles.last().filter(|tile| tile.may_be_cut);
        let cut_at = cut_at.map(|tile| tile.line);
        let (tiles, note) = twice::lines_once(tiles, path);
        let mut tiles: Vec<_> = tiles.into_iter().map(Listed::from).collect();
        let names = counted(tiles.iter().map(Listed::stem));
        for tile in &mut tiles {
            if names[tile.stem()] > 1 {
                tile.known_as.clone_from(&tile.file);
            }
        }
        let solution = registered.map(|(path, lines)| of_corners(path, &lines, &tiles));
        Self {
            tiles,
            channels: None,
            solution,
            stage: None,
            notes: note.into_iter().collect(),
            cut_at,
        }
    }

    /// The tiles, for each channel that they show.
    pub(crate) fn of_all_channels(&self) -> &[Listed] {
        self.channels.as_ref().unwrap_or(&self.tiles)
    }

    /// Says which of several images of one name are taken.
    pub(crate) fn say_several(&self, images: &Images, list: &Path) {
        let several = images.several(files(self.of_all_channels()));
        if let Some([taken, other]) = several.first() {
            let all = several.len();
            log::warn!(
                "the names of {all} images of the list are in several folders: taken is {}, for one, and not {}; name them with \
                 their folders in the list: {}",
                taken.display(),
                other.display(),
                list.display()
            );
        }
    }

    /// Says what of it does not count.
    pub(crate) fn say_notes(&self) {
        for note in &self.notes {
            log::warn!("{note}");
        }
    }
}

/// The images of tiles, as the list names them.
pub(super) fn files(tiles: &[Listed]) -> impl Iterator<Item = &str> + Clone {
    tiles.iter().map(|tile| &*tile.file)
}

/// Each name once, in the order in which they come.
pub(crate) fn channel_names<'a>(all: impl Iterator<Item = Option<&'a str>>) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for name in all.flatten() {
        if !names.iter().any(|known| known == name) {
            names.push(name.to_owned());
        }
    }
    names
}

/// Whether a file is what Fiji made of the list beside it.
pub(super) fn is_registered(path: &Path) -> bool {
    let name = path.to_string_lossy();
    let of = name.strip_suffix(".registered.txt");
    of.is_some_and(|of| Path::new(&format!("{of}.txt")).is_file())
}

/// Reads a list, whose kind its name and content tell. Most files are no lists; that is an error
/// like any other.
pub(crate) fn read(path: &Path) -> Result<List, AcquisitionError> {
    if path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("json"))
    {
        return Ok(of_specs(path, tile_specs::read(path)?));
    }
    match tile_configuration::read(path) {
        Ok(tiles) => {
            let registered = tile_configuration::registered(path);
            // A pipe would be waited for.
            if path == registered || (registered.exists() && !registered.is_file()) {
                return Ok(List::of_lines(tiles, None, path));
            }
            refuse_link_out(&registered)?;
            let solution = match tile_configuration::read(&registered) {
                Ok(lines) => Some((registered, lines)),
                Err(AcquisitionError::Read { source, .. })
                    if source.kind() == io::ErrorKind::NotFound =>
                {
                    None
                }
                Err(error) => return Err(error),
            };
            Ok(List::of_lines(tiles, solution, path))
        }
        Err(wrong) => match tile_list::read(path) {
            // An empty one is a list of no tiles, but no configuration.
            Ok(tiles) if !tiles.is_empty() || !is_configuration(path) => {
                Ok(List::of_lines(tiles, None, path))
            }
            Ok(_) => Err(wrong),
            Err(_) if is_configuration(path) => Err(wrong),
            Err(error) => Err(error),
        },
    }
}

/// Whether Fiji's plugins call a file so, or it holds lines like theirs.
fn is_configuration(path: &Path) -> bool {
    let text = fs::read(path).unwrap_or_default();
    let text = readable(&text);
    is_called_configuration(path) || text.lines().any(|line| configured(line).is_some())
}

fn is_called_configuration(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.to_lowercase().starts_with("tileconfiguration")
}

/// The image that a line of a tile configuration names, however wrong its place is.
fn configured(line: &str) -> Option<&str> {
    let (file, place) = line.split_once(';')?;
    let place = place.trim_end();
    (place.contains('(') && place.ends_with(')')).then(|| file.trim())
}

/// Whether a file that cannot be read is meant to be a list: it has a line like a list's, about an image that is
/// there. Prose and tables of other things have none.
pub(super) fn is_meant(path: &Path, images: &Images) -> bool {
    let text = fs::read(path).unwrap_or_default();
    let text = readable(&text);
    if path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("json"))
    {
        let has = |word| text.contains(word);
        return text.trim_start().starts_with('[') && has("\"tileId\"") && has("\"mipmapLevels\"");
    }
    let is_there = |file: &str| !file.is_empty() && images.has(file);
    let listed = |line: &str| {
        // One number may be wrong, or missing.
        [2, 3].into_iter().any(|columns| {
            let mut rest = line.trim();
            let mut numbers = 0;
            for _ in 0..columns {
                let Some((before, last)) = rest.rsplit_once(char::is_whitespace) else {
                    return false;
                };
                numbers += usize::from(last.parse::<f64>().is_ok());
                rest = before.trim_end();
            }
            numbers >= 2 && is_there(rest)
        })
    };
    let about = |line| configured(line).is_some_and(is_there) || listed(line);
    is_called_configuration(path) || text.lines().any(about)
}

/// Whether a list that names no image that is there is one nevertheless, of images that were renamed or left
/// behind.
pub(super) fn is_certain(path: &Path, tiles: &[Listed]) -> bool {
    let are_images = files(tiles).all(is_image_name);
    !tiles.is_empty() && (are_images || is_configuration(path))
}

/// Whether a name ends as those of images do that can be read.
pub(crate) fn is_image_name(name: &str) -> bool {
    let name = name.to_lowercase();
    let kinds = [".tif", ".tiff", ".png", ".jpg", ".jpeg"];
    kinds.iter().any(|kind| name.ends_with(kind))
}

/// Whether a file is a project of TrakEM2 with images, readable or not.
pub(crate) fn is_project(path: &Path) -> bool {
    let text = fs::read(path).unwrap_or_default();
    readable(&text).contains("t2_patch")
}

/// How often each name comes.
fn counted<'a>(names: impl Iterator<Item = &'a str>) -> HashMap<String, usize> {
    let mut counts = HashMap::new();
    for name in names {
        *counts.entry(name.to_owned()).or_default() += 1;
    }
    counts
}

/// Of the lines of a registered list, by the names of the list's tiles. An image that is written alike in both is the same one; so
/// is the only one of its name, unless both say in which folder it lies, and say so differently.
fn of_corners(path: PathBuf, lines: &[ListedTile], tiles: &[Listed]) -> Solution {
    let corner = |line: &ListedTile| SectionFromTile::translation(line.corner);
    let written: HashMap<&str, _> = lines.iter().map(|l| (&*l.file, corner(l))).collect();
    let names = counted({ written.keys() }.map(|file| tile_list::stem(file)));
    let only: HashMap<_, _> = { written.keys() }
        .map(|file| (tile_list::stem(file), *file))
        .filter(|(name, _)| names[*name] == 1)
        .collect();
    let known = tiles.iter().filter_map(|tile| {
        let alone = || {
            let file = only
                .get(tile.stem())
                .filter(|_| tile.known_as == tile.stem())?;
            may_be_one(file, &tile.file).then(|| &written[file])
        };
        let place = written.get(&*tile.file).or_else(alone)?;
        Some((tile.known_as.clone(), *place))
    });
    let transforms = known.collect();
    Solution { path, transforms }
}

/// Whether two paths of one name may mean one image: as far as both say in which folders it lies, they say the same.
fn may_be_one(one: &str, other: &str) -> bool {
    let folders = |file: &str| -> Vec<String> {
        let parts = file.split(['/', '\\']).rev().skip(1);
        let parts = parts.filter(|part| !part.is_empty() && *part != ".");
        parts.map(str::to_owned).collect()
    };
    folders(one)
        .into_iter()
        .zip(folders(other))
        .all(|(a, b)| a == b)
}

/// Tells apart what solutions call tiles: by their images, but by other words where several tiles have images of one name.
/// Such words may be what another image is called, of all those in `images`, and are then made others.
fn tell_apart(tiles: &mut [Listed], otherwise: &[String], images: &HashSet<String>) {
    let of_name = counted(tiles.iter().map(Listed::stem));
    let mut taken = images.clone();
    for (tile, otherwise) in tiles.iter_mut().zip(otherwise) {
        let stem = tile.stem();
        tile.known_as = match of_name[stem] {
            1 => stem.to_owned(),
            _ => {
                let mut name = otherwise.clone();
                while !taken.insert(name.clone()) {
                    name = format!("{name} ({stem})");
                }
                name
            }
        };
    }
}

/// Of tiles that know no stage, or one that does not count pixels as far as can be told, the transform says roughly where it was.
fn of_specs(path: &Path, specs: Vec<TileSpec>) -> List {
    let (specs, note) = twice::specs_once(specs, path);
    let mut notes = Vec::from_iter(note);
    let stage = Stage::of(&specs);
    if stage == Stage::Other {
        notes.push(format!(
            "the stage's places (layout) are not in pixels, or other than the transforms', and are passed over: {}",
            path.display()
        ));
    }
    let listed = |spec: &TileSpec, file: &str, channel: Option<&str>| Listed {
        file: file.to_owned(),
        known_as: String::new(),
        corner: { spec.stage.filter(|_| stage == Stage::Pixels) }
            .unwrap_or_else(|| transformed_corner(spec)),
        laid_out: spec.stage,
        section: spec.section,
        size: Some(spec.size),
        channel: channel.map(ToOwned::to_owned),
    };
    let mut tiles: Vec<_> = specs
        .iter()
        .map(|spec| listed(spec, &spec.file, None))
        .collect();
    let ids: Vec<_> = specs.iter().map(|spec| spec.id.clone()).collect();
    let of_spec = |spec: &TileSpec| {
        let channels = spec.channels.iter().map(|channel| &channel.file);
        let files = [&spec.file].into_iter().chain(channels);
        files
            .map(|file| tile_list::stem(file).to_owned())
            .collect::<Vec<_>>()
    };
    let images: HashSet<_> = specs.iter().flat_map(of_spec).collect();
    tell_apart(&mut tiles, &ids, &images);
    let places = tiles
        .iter()
        .zip(&specs)
        .map(|(tile, spec)| (tile.known_as.clone(), spec.transform));
    let mut transforms: BTreeMap<_, _> = places.collect();
    let channels = specs.iter().any(|spec| !spec.channels.is_empty()).then(|| {
        let (mut tiles, mut ids, mut places) = (Vec::new(), Vec::new(), Vec::new());
        for spec in &specs {
            for channel in &spec.channels {
                tiles.push(listed(spec, &channel.file, Some(&channel.name)));
                ids.push(format!("{} {}", spec.id, channel.name));
            }
            if spec.channels.is_empty() {
                tiles.push(listed(spec, &spec.file, None));
                ids.push(spec.id.clone());
            }
            places.resize(tiles.len(), spec.transform);
        }
        let none = specs.iter().filter(|spec| spec.channels.is_empty()).count();
        if none > 0 {
            notes.push(format!(
                "{none} tiles name no channel, as others do, and show the first: {}",
                path.display()
            ));
        }
        tell_apart(&mut tiles, &ids, &images);
        let names = tiles.iter().map(|tile| tile.known_as.clone());
        transforms.extend(names.zip(places));
        tiles
    });
    let mut left_out: Vec<&str> = specs
        .iter()
        .flat_map(|s| &s.left_out)
        .map(String::as_str)
        .collect();
    left_out.sort_unstable();
    left_out.dedup();
    if !left_out.is_empty() {
        let (kinds, path) = (left_out.join(", "), path.display());
        notes.push(format!(
            "only affine transforms are used; left out: {kinds}: {path}"
        ));
    }
    List {
        tiles,
        channels,
        solution: Some(Solution {
            path: path.to_owned(),
            transforms,
        }),
        stage: Some(stage),
        notes,
        cut_at: None,
    }
}
