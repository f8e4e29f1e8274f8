//! What the catalog tells of volumes and tiles.

use std::time::SystemTime;

use glam::{DVec3, UVec2, UVec3};
use saccade_core::transform::SectionFromTile;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use serde::{Deserialize, Serialize};

use crate::acquisition::{RecordReader, TileRecord};

/// Names a tile within its catalog, for good.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(transparent)]
pub struct TileId(pub i64);

/// A tile whose pyramid is in the visualization archive.
#[derive(Clone, Debug, PartialEq)]
pub struct Tile {
    /// Its id; stays when it is imaged again.
    pub id: TileId,
    /// Its name, unique in the volume.
    pub name: String,
    /// Section: z index of the volume.
    pub section: u32,
    /// Channel: index in the volume's channels.
    pub channel: u32,
    /// Width and height \[pixels\].
    pub size: UVec2,
    /// Where it lies: to level-0 voxels from pixels.
    pub transform: SectionFromTile,
    /// Name of its pyramid in the storage. Another image gets another name.
    pub pyramid: String,
    /// The volume's revision when the tile last changed.
    pub revision: u64,
    /// Position of the record that brought its image: of two images, the later one's is larger, whoever enters them in which
    /// order. 0 where the catalog's row says none that can be.
    pub position: u64,
}

/// A tile to be entered.
#[derive(Clone, Debug, PartialEq)]
pub struct NewTile {
    /// Its name. If the volume has a tile of that name, the newer position wins.
    pub name: String,
    /// Section: z index of the volume.
    pub section: u32,
    /// Channel: index in the volume's channels.
    pub channel: u32,
    /// Width and height \[pixels\].
    pub size: UVec2,
    /// To level-0 voxels from pixels.
    pub transform: SectionFromTile,
    /// Name of its pyramid, already durable in the storage.
    pub pyramid: String,
    /// Position of its record: a larger one is newer, the same one is the same record.
    pub position: u64,
}

/// Why voxels changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ChangeReason {
    /// A tile arrived, or arrived again.
    Tile,
    /// A tile moved.
    Transform,
    /// A tile was deleted.
    Deleted,
}

/// Voxels that are no longer what they were.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CatalogChange {
    /// The volume's revision after it.
    pub revision: u64,
    /// The tile.
    pub tile: TileId,
    /// Its section.
    pub section: u32,
    /// Where, inside the volume \[level-0 voxels\].
    pub voxels: VoxelBox,
    /// Why.
    pub reason: ChangeReason,
}

/// A file or record that could not become a tile.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Quarantined {
    /// The file, relative to the acquisition archive.
    pub file: String,
    /// The tile it was to become, if known. A good record of that tile ends its quarantine, but for an image that is awaited
    /// and announced later.
    pub tile: Option<String>,
    /// What is wrong and how to mend it.
    pub reason: String,
    /// The file's size \[bytes\], if it exists.
    pub bytes: Option<u64>,
    /// When.
    pub at: SystemTime,
    /// Position of its record, if only its image did not come: once it is there, it is taken in.
    pub awaited: Option<u64>,
}

impl Quarantined {
    /// Whether an image could not become a tile, for which its record is to come once more. Other records are past: they changed
    /// nothing.
    pub fn is_of_an_image(&self) -> bool {
        // Of what waited and cannot be understood, the image is not known any more.
        self.file != RecordReader::FILE || self.bytes == Some(0)
    }
}

/// A record whose file is not whole yet.
#[derive(Clone, Debug, PartialEq)]
pub struct Waiting {
    /// Position of the record.
    pub position: u64,
    /// The record.
    pub record: TileRecord,
    /// What it waits for.
    pub reason: String,
}

/// A pyramid that no tile names any more.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Retired {
    /// Its name in the storage.
    pub pyramid: String,
    /// Since when.
    pub at: SystemTime,
}

/// A volume and how far it is.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeEntry {
    /// What it is.
    pub volume: Volume,
    /// Its newest revision; 0 while empty.
    pub revision: u64,
    /// Tiles it has.
    pub tiles: u64,
}

/// Counts of a volume.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Statistics {
    /// Newest revision.
    pub revision: u64,
    /// Tiles.
    pub tiles: u64,
    /// Sections that have a tile.
    pub sections: u64,
    /// Files in quarantine.
    pub quarantined: u64,
    /// Tiles whose file is not whole yet.
    pub waiting: u64,
    /// Tiles that were announced and are still to be worked on, or are being worked on.
    pub queued: u64,
    /// Transforms whose tile has not come yet.
    pub early: u64,
}

/// In what two volumes differ of what tells one from another: what it is, and what each has.
pub(crate) fn differences(one: &Volume, other: &Volume) -> Vec<(&'static str, String, String)> {
    let of = |v: &Volume| {
        [
            ("extent", format!("{} voxels", v.extent())),
            ("voxel size", format!("{} nm", v.voxel_nm)),
            ("voxel type", format!("{:?}", v.dtype).to_lowercase()),
            ("kind", format!("{:?}", v.kind).to_lowercase()),
            ("channels", v.channels.join(", ")),
        ]
    };
    let pairs = of(one).into_iter().zip(of(other));
    let pairs = pairs.map(|((what, one), (_, other))| (what, one, other));
    pairs.filter(|(_, one, other)| one != other).collect()
}

/// Where a tile lies in a volume of `extent` \[level-0 voxels\], cut at the volume's faces; `None`
/// if it is wholly outside.
pub fn place(
    extent: UVec3,
    section: u32,
    size: UVec2,
    transform: SectionFromTile,
) -> Option<VoxelBox> {
    let (min, max) = transform.bounds(size.as_dvec2());
    let z = f64::from(section);
    let tile = VoxelBox::around(
        DVec3::new(min.0.x, min.0.y, z),
        DVec3::new(max.0.x, max.0.y, z + 1.0),
    );
    let inside = tile.intersection(VoxelBox::of_size(extent));
    (!inside.is_empty()).then_some(inside)
}
