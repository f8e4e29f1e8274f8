//! A microscope's tiles in one frame: where the stage said, and where registration says.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::BufReader;
use std::path::{Path, PathBuf};

use glam::{DVec2, UVec2, UVec3};
use saccade_archive::acquisition::listed_images::Images;
use saccade_archive::image::{Wanted, decode_file_as, read_bits};
use saccade_core::transform::{SectionFromTile, TilePoint};
use saccade_core::volume::Dtype;
use tiff::decoder::Decoder;

use super::ReplayError;
use super::lists::{self, Listed, Solution};
use crate::simulate::settings::Fingerprint;
use crate::simulate::stack::volume_name;

/// A tile as it came from the microscope.
#[derive(Clone, Debug, PartialEq)]
pub struct RawTile {
    /// Name, unique in the acquisition.
    pub name: String,
    /// What solutions call it.
    pub known_as: String,
    /// Its file.
    pub image: PathBuf,
    /// Section: z index, from 0.
    pub section: u32,
    /// Width and height \[pixels\].
    pub size: UVec2,
    /// Where the stage says it lies.
    pub stage: SectionFromTile,
    /// Where the solution says it lies.
    pub aligned: Option<SectionFromTile>,
    /// The channel that it shows, if the list says so.
    pub channel: Option<String>,
}

/// Tiles with stage positions, and a solution if there is one.
#[derive(Clone, Debug, PartialEq)]
pub struct Acquisition {
    /// A name for the volume.
    pub name: String,
    /// The tile list that was used.
    pub list: PathBuf,
    /// The solution that was used.
    pub solution: Option<PathBuf>,
    /// Size that holds every tile, where the stage and where the solution says \[voxels\].
    pub extent: UVec3,
    /// Type of voxels that holds what the images show.
    pub dtype: Dtype,
    /// How many images have 8 bits or fewer, where others have 16: those are spread over all 16.
    pub shallow: usize,
    /// Names of the channels that the list names, in the order in which it does.
    pub channels: Vec<String>,
    /// In the order of acquisition: by section, then as listed.
    pub tiles: Vec<RawTile>,
}

impl Acquisition {
    /// Reads a list of tiles, the sizes of its images, which lie anywhere below `folder`, and a
    /// solution: the TrakEM2 project that is named, else what comes with the list.
    ///
    /// A list is `file x y z` per line, a tile configuration of Fiji, whose registered twin is its
    /// solution, or Render's tile specifications, which hold both.
    ///
    /// The two frames differ by a translation, for a stage's zero means nothing to a solver. The
    /// median offset is taken out of the solution, so that the update refines rather than jumps.
    ///
    /// # Errors
    ///
    /// [`ReplayError`].
    pub fn open(folder: &Path, list: &Path, solution: Option<&Path>) -> Result<Self, ReplayError> {
        let listed = lists::read(list)?;
        listed.say_notes();
        let images = Images::below(folder)?;
        listed.say_several(&images, list);
        let named = solution.map(Solution::read).transpose()?;
        let solution = named.or_else(|| listed.solution.clone());
        Self::new(
            folder,
            &images,
            list,
            listed.of_all_channels(),
            solution.as_ref(),
        )
    }

    pub(super) fn new(
        folder: &Path,
        images: &Images,
        list: &Path,
        listed: &[Listed],
        solution: Option<&Solution>,
    ) -> Result<Self, ReplayError> {
        let names = unique_names(listed);
        let first_section = listed.iter().map(|tile| tile.section).min().unwrap_or(0);
        let found = images.of_list(lists::files(listed));
        let missing = { listed.iter().zip(&found) }.filter(|(_, image)| image.is_none());
        let missing: Vec<_> = missing.map(|(tile, _)| tile).collect();
        if let Some(first) = missing.first() {
            return Err(ReplayError::MissingImages {
                missing: missing.len(),
                tiles: listed.len(),
                first: first.file.clone(),
                folder: folder.to_owned(),
                list: list.to_owned(),
            });
        }
        let mut tiles = Vec::new();
        let (mut deep, mut shallow) = (0, 0);
        for ((tile, name), image) in listed.iter().zip(names).zip(found) {
            let Some(image) = image else {
                continue;
            };
            let size = image_size(&image)?;
            match read_bits(&image) {
                Ok(..=8) => shallow += 1,
                Ok(_) => deep += 1,
                // Ingest finds out what is wrong, and says so.
                Err(_) => {}
            }
            tiles.push(RawTile {
                name,
                known_as: tile.known_as.clone(),
                size,
                image,
                section: tile.section - first_section,
                stage: SectionFromTile::translation(tile.corner),
                aligned: solution.and_then(|s| s.transforms.get(&tile.known_as).copied()),
                channel: tile.channel.clone(),
            });
        }
        tiles.sort_by_key(|tile| tile.section);
        remove_median_offset(&mut tiles);
        let extent = move_to_origin(&mut tiles, list)?;
        Ok(Self {
            name: volume_name(folder),
            list: list.to_owned(),
            solution: solution.map(|solution| solution.path.clone()),
            extent,
            dtype: if deep > 0 {
                Dtype::Uint16
            } else {
                Dtype::Uint8
            },
            shallow: if deep > 0 { shallow } else { 0 },
            channels: lists::channel_names(listed.iter().map(|tile| tile.channel.as_deref())),
            tiles,
        })
    }
}

impl Acquisition {
    /// Which acquisition it is: the same for the same tiles, wherever they lie, and another for
    /// others, or for another solution.
    pub(super) fn identity(&self) -> String {
        let mut fingerprint = Fingerprint::new();
        for tile in &self.tiles {
            // A zero byte ends the name, so that no two lists of tiles make the same bytes.
            fingerprint.add(tile.name.as_bytes());
            fingerprint.add(&[0, u8::from(tile.aligned.is_some())]);
            if let Some(channel) = &tile.channel {
                fingerprint.add(channel.as_bytes());
                fingerprint.add(&[0]);
            }
            for number in [tile.section, tile.size.x, tile.size.y] {
                fingerprint.add(&number.to_le_bytes());
            }
            let bytes = fs::metadata(&tile.image).map_or(0, |meta| meta.len());
            fingerprint.add(&bytes.to_le_bytes());
            for transform in [Some(tile.stage), tile.aligned].into_iter().flatten() {
                for element in transform.elements() {
                    fingerprint.add(&element.to_le_bytes());
                }
            }
        }
        format!("acquisition {fingerprint}")
    }
}

/// The files' names without folders, or with them where that is ambiguous.
fn unique_names(listed: &[Listed]) -> Vec<String> {
    let distinct: BTreeSet<&str> = listed.iter().map(Listed::stem).collect();
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
    if distinct.len() == listed.len() {
        return listed.iter().map(|tile| safe(tile.stem())).collect();
    }
    // The place in the list tells those of one name apart.
    listed
        .iter()
        .enumerate()
        .map(|(n, tile)| format!("{n:05}_{}", safe(tile.stem())))
        .collect()
}

/// Width and height of an image, from its head where the format allows it.
fn image_size(path: &Path) -> Result<UVec2, ReplayError> {
    let head = || {
        let mut tiff = Decoder::new(BufReader::new(File::open(path).ok()?)).ok()?;
        tiff.dimensions().ok()
    };
    if let Some((width, height)) = head() {
        return Ok(UVec2::new(width, height));
    }
    match decode_file_as(path, Wanted::GRAY_16) {
        Ok(image) => Ok(UVec2::from_array(image.size())),
        Err(source) => Err(ReplayError::Image {
            source,
            path: path.to_owned(),
        }),
    }
}

fn centre(transform: SectionFromTile, size: UVec2) -> DVec2 {
    transform.apply(TilePoint(size.as_dvec2() / 2.0)).0
}

/// The median offset of solution from stage, per axis.
pub(crate) fn median_offset(tiles: &[RawTile]) -> Option<DVec2> {
    let offset =
        |tile: &RawTile| Some(centre(tile.aligned?, tile.size) - centre(tile.stage, tile.size));
    let offsets: Vec<DVec2> = tiles.iter().filter_map(offset).collect();
    let median = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied()
    };
    let x = median(offsets.iter().map(|o| o.x).collect())?;
    let y = median(offsets.iter().map(|o| o.y).collect())?;
    Some(DVec2::new(x, y))
}

fn remove_median_offset(tiles: &mut [RawTile]) {
    if let Some(offset) = median_offset(tiles) {
        for tile in tiles {
            tile.aligned = tile.aligned.map(|aligned| aligned.shifted(-offset));
        }
    }
}

/// The low corner of everything, on whole pixels, and how much there is from it on.
pub(crate) fn spanned(tiles: &[RawTile], list: &Path) -> Result<(DVec2, DVec2), ReplayError> {
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for tile in tiles {
        for transform in [Some(tile.stage), tile.aligned].into_iter().flatten() {
            let (min, max) = transform.bounds(tile.size.as_dvec2());
            (low, high) = (low.min(min.0), high.max(max.0));
        }
    }
    let low = low.floor();
    let size = (high - low).ceil();
    // Also catches an empty list, whose size is not a number.
    if !(size.cmpge(DVec2::ONE).all() && size.cmple(DVec2::splat(f64::from(1 << 21))).all()) {
        let list = list.to_owned();
        return Err(ReplayError::Extent {
            width: size.x,
            height: size.y,
            list,
        });
    }
    Ok((low, size))
}

/// Moves all tiles so that the low corner of everything is the origin; the extent that holds them.
fn move_to_origin(tiles: &mut [RawTile], list: &Path) -> Result<UVec3, ReplayError> {
    let (low, size) = spanned(tiles, list)?;
    for tile in &mut *tiles {
        tile.stage = tile.stage.shifted(-low);
        tile.aligned = tile.aligned.map(|aligned| aligned.shifted(-low));
    }
    let sections = tiles
        .iter()
        .map(|tile| tile.section)
        .max()
        .unwrap_or(0)
        .saturating_add(1);
    Ok(size.as_uvec2().extend(sections))
}
