//! What is settled when a list is first read, and kept: which volume it is, and where in the list it lies.

use std::collections::{BTreeMap, HashSet};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use glam::{DVec2, UVec2, UVec3};
use saccade_archive::acquisition::AcquisitionInfo;
use saccade_archive::catalog::place;
use saccade_archive::image::{read_bits, read_size};
use saccade_core::transform::SectionFromTile;
use saccade_core::volume::{Dtype, MAX_EXTENT};

use super::super::{SETTINGS, WatchError, another, is_unused, moved};
use super::counted::Counted;
use super::index::{Index, Sought, base};
use super::source::{Adopted, Listing, adopt, line_of, raw};
use super::{ListConfig, ListError, MOST_ASKED};
use crate::replay::ReplayError;
use crate::replay::acquisition::spanned;
use crate::replay::lists::Solution;
use crate::simulate::settings::{Settings, volume_differences};

/// Name of the file that says which solution is used.
const SOLUTION: &str = "solution.json";

/// Name of the setting that says in which pixels the list counts.
const COUNTED: &str = "counted";

/// The volume, and where in the list it lies.
#[derive(Clone, Debug)]
pub(super) struct Frame {
    info: AcquisitionInfo,
    list: PathBuf,
    /// Where the list has the volume's corner \[pixels\].
    origin: DVec2,
    /// Number of the first section in the list.
    pub(super) first: u32,
    /// Size of a pixel \[voxels\].
    scale: f64,
    /// How the images' names say the channel.
    channel_in: Option<String>,
    /// In which pixels, where that is not certain.
    pub(super) counted: Option<Counted>,
}

/// A path as it is kept: below the folder, with which it moves, or elsewhere.
fn shown(path: &Path, folder: &Path) -> String {
    let below = path.strip_prefix(folder).unwrap_or(path);
    below.to_string_lossy().into_owned()
}

/// The list of a folder that was followed before, with its records kept in `kept`.
pub fn kept_list(folder: &Path, kept: &Path) -> Option<PathBuf> {
    let settings = Settings::read_from(kept.join(SETTINGS)).ok()??;
    let folder = folder.canonicalize().ok()?;
    settings.text("list").map(|list| folder.join(list))
}

impl Frame {
    /// What is kept, if it is what is asked for, or nothing yet.
    pub(super) fn open(
        config: &ListConfig,
        folder: &Path,
        kept: &Path,
    ) -> Result<Option<Self>, WatchError> {
        let info = AcquisitionInfo::read(kept).ok();
        let settings = Settings::read_from(kept.join(SETTINGS))?;
        let mut differences = Vec::new();
        let now = info.as_ref().map(|there| AcquisitionInfo {
            name: config.name.clone(),
            extent: config.extent.unwrap_or(there.extent),
            voxel_nm: config.voxel_nm,
            dtype: config.dtype.unwrap_or(there.dtype),
            channels: { config.channels.clone() }.unwrap_or_else(|| there.channels.clone()),
            ..there.clone()
        });
        if let Some((there, now)) = info.as_ref().zip(now.as_ref()) {
            differences.extend(volume_differences(there, now));
        }
        differences.extend(moved::still_there(folder, kept).map(|there| another(&there, folder)));
        let frame = settings.as_ref().zip(info).map(|(there, info)| {
            let origin = there.pair("origin").map(DVec2::from_array);
            Self {
                info,
                list: config.list.clone(),
                origin: config.origin.or(origin).unwrap_or_default(),
                first: config.first.or(there.number("first")).unwrap_or(0),
                scale: config.scale,
                channel_in: config.channel_in.as_ref().map(ToString::to_string),
                counted: there.text(COUNTED).and_then(Counted::parse),
            }
        });
        if let Some((frame, there)) = frame.as_ref().zip(settings.as_ref()) {
            differences.extend(frame.settings(folder).differences(there));
        }
        if differences.is_empty() {
            return Ok(frame);
        }
        if is_unused(kept)? {
            return Ok(None);
        }
        Err(WatchError::Other {
            differences: differences.join("; "),
            path: kept.to_owned(),
        })
    }

    fn settings(&self, folder: &Path) -> Settings {
        let list = shown(&self.list, folder);
        let settings = Settings::of_list(&list, self.origin.to_array(), self.first, self.scale);
        let settings = match self.counted {
            Some(counted) => settings.with(COUNTED, counted.text()),
            None => settings,
        };
        match &self.channel_in {
            Some(pattern) => settings.with("channel-in", pattern),
            None => settings,
        }
    }

    pub(super) fn keep(&self, folder: &Path, kept: &Path) -> Result<(), WatchError> {
        self.info.write(kept)?;
        self.settings(folder).write_to(kept.join(SETTINGS))?;
        Ok(())
    }

    /// In which pixels the list counts. Earlier versions, which kept nothing of it, took a stage of which nothing can be
    /// told for one that counts.
    pub(super) fn counted(&self) -> Counted {
        self.counted.unwrap_or(Counted::Stage)
    }

    /// Says that the volume's corner lies elsewhere in the list, by so much \[voxels\].
    pub(super) fn shift(&mut self, by: DVec2) {
        self.origin += by / self.scale;
    }

    /// Size of the volume \[voxels\].
    pub(super) fn extent(&self) -> UVec3 {
        self.info.extent
    }

    /// Whether the volume has channels with names.
    pub(super) fn has_channels(&self) -> bool {
        !self.info.channels.is_empty()
    }

    /// Whether a tile would lie in the volume.
    pub(super) fn holds(&self, section: u32, size: UVec2, transform: SectionFromTile) -> bool {
        place(self.info.extent, section, size, transform).is_some()
    }

    /// Where a tile lies in the volume, from where it lies in the list.
    pub(super) fn place(&self, listed: SectionFromTile) -> SectionFromTile {
        let moved = listed.shifted(-self.origin);
        if self.scale == 1.0 {
            return moved;
        }
        let scaled = moved.elements().map(|element| element * self.scale);
        SectionFromTile::new(scaled).unwrap_or(moved)
    }
}

/// The solution that was used before; what it says is not read yet.
pub(super) fn adopted(folder: &Path, kept: &Path) -> Option<Adopted> {
    let settings = Settings::read_from(kept.join(SOLUTION)).ok()??;
    Some(Adopted {
        solution: Solution {
            path: folder.join(settings.text("solution")?),
            transforms: BTreeMap::new(),
        },
        offset: DVec2::from_array(settings.pair("offset")?),
    })
}

/// Keeps which solution is used, or that none is.
pub(super) fn keep_adopted(
    adopted: Option<&Adopted>,
    folder: &Path,
    kept: &Path,
) -> Result<(), WatchError> {
    let Some(adopted) = adopted else {
        let path = kept.join(SOLUTION);
        return match fs::remove_file(&path) {
            Err(source) if source.kind() != io::ErrorKind::NotFound => {
                Err(WatchError::Write { source, path })
            }
            Ok(()) | Err(_) => Ok(()),
        };
    };
    let path = shown(&adopted.solution.path, folder);
    let settings = Settings::of_solution(&path, adopted.offset.to_array());
    settings.write_to(kept.join(SOLUTION))?;
    Ok(())
}

/// Settles the frame, from what is listed and from the images that are there. Those that are missing are as large as
/// the list says, or count as large as the largest of the others.
pub(super) fn begin(
    config: &ListConfig,
    folder: &Path,
    index: &mut Index,
    listing: &Listing,
    projects: &[PathBuf],
) -> Result<(Frame, Option<Adopted>), ListError> {
    let tiles = &listing.tiles;
    let mut sizes = vec![None; tiles.len()];
    let mut deep = false;
    let spans = config.extent.is_none() || config.origin.is_none();
    let asks = spans || config.dtype.is_none();
    for (tile, size) in tiles.iter().zip(&mut sizes).filter(|_| asks) {
        let Sought::There(image) = index.find(&tile.file) else {
            continue;
        };
        let image = folder.join(image);
        *size = read_size(&image).ok().map(UVec2::from_array);
        deep |= config.dtype.is_none() && read_bits(&image).is_ok_and(|bits| bits > 8);
    }
    let area = |size: &UVec2| u64::from(size.x) * u64::from(size.y);
    let largest = sizes.iter().flatten().copied().max_by_key(area);
    if asks && largest.is_none() {
        let mut told = tiles.iter().take(MOST_ASKED).filter_map(|tile| {
            let why = { index.blocked(&tile.file) }
                .or_else(|| index.not_taken(&tile.file).map(|(_, why)| why))?;
            Some(format!("{:?} ({why})", tile.file))
        });
        let first = tiles.first().map_or("", |tile| &tile.file);
        let listed: HashSet<&str> = tiles.iter().map(|tile| base(&tile.file)).collect();
        let nearly = || {
            let why = index.nearly(first, |name| listed.contains(name));
            why.map_or_else(|| format!("{first:?}"), |why| format!("{first:?} ({why})"))
        };
        let such_as = told.next().unwrap_or_else(nearly);
        let (unknown, options) = match (spans, config.dtype) {
            (true, None) => ("size and bits", "--extent, --origin and --bits"),
            (true, Some(_)) => ("size and place", "--extent and --origin"),
            (false, _) => ("bits", "--bits"),
        };
        return Err(ListError::NoImages {
            tiles: tiles.len(),
            such_as,
            unknown,
            options,
            folder: folder.to_owned(),
            list: config.list.clone(),
        });
    }
    let mut raw = raw(tiles, |n| {
        let size = sizes[n].or(tiles[n].size).or(largest);
        size.unwrap_or(UVec2::ONE)
    });
    let adopted = adopt(listing, projects, raw.clone());
    let adopted = adopted.map_err(|e| ListError::List { source: e.into() })?;
    if let Some(adopted) = &adopted {
        for (raw, tile) in raw.iter_mut().zip(tiles) {
            raw.aligned = adopted.place(tile);
        }
    }
    let first = tiles.iter().map(|tile| tile.section).min().unwrap_or(0);
    let first = config.first.unwrap_or(first);
    let (mut origin, mut extent) = (config.origin, config.extent);
    if spans {
        let (low, size) = spanned(&raw, &config.list)?;
        let corner = *origin.get_or_insert(low);
        let size = ((low + size - corner) * config.scale).ceil();
        let last = tiles.iter().max_by_key(|tile| tile.section);
        let sections = last.map_or(0, |tile| tile.section);
        let sections = sections.saturating_sub(first).saturating_add(1);
        if extent.is_none() && size.max_element() > f64::from(MAX_EXTENT) {
            let list = config.list.clone();
            let (width, height) = (size.x, size.y);
            return Err(ReplayError::Extent {
                width,
                height,
                list,
            }
            .into());
        }
        if let Some(tile) = last.filter(|_| extent.is_none() && sections > MAX_EXTENT) {
            return Err(ListError::Sections {
                line: line_of(&config.list, tile),
                file: tile.file.clone(),
                section: tile.section,
                first,
                most: MAX_EXTENT,
                list: config.list.clone(),
            });
        }
        extent.get_or_insert(size.max(DVec2::ONE).as_uvec2().extend(sections));
    }
    let mut info =
        AcquisitionInfo::new(&config.name, extent.unwrap_or(UVec3::ONE), config.voxel_nm);
    let told = if deep { Dtype::Uint16 } else { Dtype::Uint8 };
    info.dtype = config.dtype.unwrap_or(told);
    info.channels = { config.channels.clone() }.unwrap_or_else(|| listing.channels());
    let frame = Frame {
        info,
        list: config.list.clone(),
        origin: origin.unwrap_or_default(),
        first,
        scale: config.scale,
        channel_in: config.channel_in.as_ref().map(ToString::to_string),
        counted: listing.counts.map(Counted::of),
    };
    Ok((frame, adopted))
}
