//! Files that say where the tiles of an acquisition lie, whatever program wrote them.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use glam::DVec2;
use saccade_archive::acquisition::tile_list::{self, Images, ListedTile};
use saccade_archive::acquisition::tile_specs::{self, TileSpec};
use saccade_archive::acquisition::trakem2::{self, Patch};
use saccade_archive::acquisition::{
    AcquisitionError, readable, refuse_link_out, tile_configuration,
};
use saccade_core::transform::{SectionFromTile, TilePoint};

/// Where registration says that tiles lie.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Solution {
    /// The file that says so.
    pub(crate) path: PathBuf,
    /// By the tiles' names.
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

/// Tiles with the places that the stage had for them, and what the same program says of them.
pub(crate) struct List {
    pub(crate) tiles: Vec<ListedTile>,
    pub(crate) solution: Option<Solution>,
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
        return Ok(of_specs(path, &tile_specs::read(path)?));
    }
    match tile_configuration::read(path) {
        Ok(tiles) => {
            let registered = tile_configuration::registered(path);
            // A pipe would be waited for.
            if path == registered || (registered.exists() && !registered.is_file()) {
                return Ok(List {
                    tiles,
                    solution: None,
                });
            }
            refuse_link_out(&registered)?;
            let solution = match tile_configuration::read(&registered) {
                Ok(tiles) => Some(of_corners(&registered, &tiles)),
                Err(AcquisitionError::Read { source, .. })
                    if source.kind() == io::ErrorKind::NotFound =>
                {
                    None
                }
                Err(error) => return Err(error),
            };
            Ok(List { tiles, solution })
        }
        Err(wrong) => match tile_list::read(path) {
            // An empty one is a list of no tiles, but no configuration.
            Ok(tiles) if !tiles.is_empty() || !is_configuration(path) => Ok(List {
                tiles,
                solution: None,
            }),
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
    let is_there = |file: &str| !file.is_empty() && images.find(file).is_some();
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
pub(super) fn is_certain(path: &Path, tiles: &[ListedTile]) -> bool {
    let image = |tile: &ListedTile| {
        let name = tile.file.to_lowercase();
        let kinds = [".tif", ".tiff", ".png", ".jpg", ".jpeg"];
        kinds.iter().any(|kind| name.ends_with(kind))
    };
    !tiles.is_empty() && (tiles.iter().all(image) || is_configuration(path))
}

/// Whether a file is a project of TrakEM2 with images, readable or not.
pub(crate) fn is_project(path: &Path) -> bool {
    let text = fs::read(path).unwrap_or_default();
    readable(&text).contains("t2_patch")
}

/// Where the transform of a tile puts its corner.
fn transformed_corner(spec: &TileSpec) -> DVec2 {
    spec.transform.apply(TilePoint(DVec2::ZERO)).0
}

/// Whether the stage's places are like the transforms', but for where both begin: within a tile's size for three tiles of four. Some
/// microscopes write nanometers, or steps of a motor, which would make of a section one that is many times as large.
fn stage_counts_pixels(specs: &[TileSpec]) -> bool {
    let apart = |spec: &TileSpec| Some(transformed_corner(spec) - spec.stage?);
    let apart: Vec<DVec2> = specs.iter().filter_map(apart).collect();
    let middle = |axis: usize| {
        let mut all: Vec<f64> = apart.iter().map(|apart| apart[axis]).collect();
        let middle = all.len() / 2;
        match middle < all.len() {
            true => *all.select_nth_unstable_by(middle, f64::total_cmp).1,
            false => 0.0,
        }
    };
    let middle = DVec2::new(middle(0), middle(1));
    let tile = { specs.iter() }.fold(0, |most, spec| most.max(spec.size.max_element()));
    let near = |apart: &&DVec2| (**apart - middle).abs().max_element() <= f64::from(tile);
    4 * apart.iter().filter(near).count() >= 3 * apart.len()
}

fn of_corners(path: &Path, tiles: &[ListedTile]) -> Solution {
    let transforms = tiles.iter().map(|tile| {
        let transform = SectionFromTile::translation(tile.corner);
        (tile.name().to_owned(), transform)
    });
    Solution {
        path: path.to_owned(),
        transforms: transforms.collect(),
    }
}

/// Of tiles that know no stage, or one that does not count pixels, the transform says roughly where it was.
fn of_specs(path: &Path, specs: &[TileSpec]) -> List {
    let counts = stage_counts_pixels(specs);
    if !counts {
        log::warn!(
            "the stage's places (layout) are not in pixels, or other than the transforms', and are passed over: {}",
            path.display()
        );
    }
    let tiles = specs.iter().map(|spec| ListedTile {
        file: spec.file.clone(),
        corner: { spec.stage.filter(|_| counts) }.unwrap_or_else(|| transformed_corner(spec)),
        section: spec.section,
    });
    let transforms = specs
        .iter()
        .map(|spec| (spec.name().to_owned(), spec.transform));
    let mut left_out: Vec<&str> = specs
        .iter()
        .flat_map(|s| &s.left_out)
        .map(String::as_str)
        .collect();
    left_out.sort_unstable();
    left_out.dedup();
    if !left_out.is_empty() {
        let (kinds, path) = (left_out.join(", "), path.display());
        log::warn!("only affine transforms are used; left out: {kinds}: {path}");
    }
    List {
        tiles: tiles.collect(),
        solution: Some(Solution {
            path: path.to_owned(),
            transforms: transforms.collect(),
        }),
    }
}
