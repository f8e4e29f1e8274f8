//! Files that say where the tiles of an acquisition lie, whatever program wrote them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::DVec2;
use saccade_archive::acquisition::tile_list::{self, ListedTile};
use saccade_archive::acquisition::tile_specs::{self, TileSpec};
use saccade_archive::acquisition::trakem2::{self, Patch};
use saccade_archive::acquisition::{AcquisitionError, tile_configuration};
use saccade_core::transform::{SectionFromTile, TilePoint};

/// Where registration says that tiles lie.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Solution {
    /// The file that says so.
    pub(super) path: PathBuf,
    /// By the tiles' names.
    pub(super) transforms: BTreeMap<String, SectionFromTile>,
}

impl Solution {
    /// Of a TrakEM2 project.
    pub(super) fn read(path: &Path) -> Result<Self, AcquisitionError> {
        let patches = trakem2::read(path)?;
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
pub(super) struct List {
    pub(super) tiles: Vec<ListedTile>,
    pub(super) solution: Option<Solution>,
}

/// Whether a file is what Fiji made of the list beside it.
pub(super) fn is_registered(path: &Path) -> bool {
    let name = path.to_string_lossy();
    let of = name.strip_suffix(".registered.txt");
    of.is_some_and(|of| Path::new(&format!("{of}.txt")).is_file())
}

/// Reads a list, whose kind its name and content tell. Most files are no lists; that is an error
/// like any other.
pub(super) fn read(path: &Path) -> Result<List, AcquisitionError> {
    if path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("json"))
    {
        return Ok(of_specs(path, &tile_specs::read(path)?));
    }
    match tile_configuration::read(path) {
        Ok(tiles) => {
            let registered = tile_configuration::registered(path);
            let solution = match tile_configuration::read(&registered) {
                Ok(tiles) if path != registered => Some(of_corners(&registered, &tiles)),
                _ => None,
            };
            Ok(List { tiles, solution })
        }
        Err(_) => Ok(List {
            tiles: tile_list::read(path)?,
            solution: None,
        }),
    }
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

/// Of tiles that know no stage, the transform says roughly where it was.
fn of_specs(path: &Path, specs: &[TileSpec]) -> List {
    let tiles = specs.iter().map(|spec| ListedTile {
        file: spec.file.clone(),
        corner: spec
            .stage
            .unwrap_or_else(|| spec.transform.apply(TilePoint(DVec2::ZERO)).0),
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
