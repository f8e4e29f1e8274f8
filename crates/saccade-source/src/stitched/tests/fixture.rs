//! An archive in memory (but for the catalog) and a list of what is in it.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::{DVec3, UVec2, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_archive::catalog::{Catalog, NewTile};
use saccade_archive::image::Gray;
use saccade_archive::pyramid::{Encoding, Voxel, encode, encode_labels};
use saccade_archive::storage::{MemoryStorage, Storage};
use saccade_core::transform::SectionFromTile;
use saccade_core::volume::{Dtype, Volume, VoxelKind};
use saccade_core::voxel_box::VoxelBox;

use super::oracle::{How, RawTile, stitch};
use crate::stitched::{StitchedOptions, StitchedSource};
use crate::{Chunk, ChunkId, VolumeSource};

pub(super) struct Fixture {
    pub(super) volume: Volume,
    pub(super) archive: VisualizationArchive,
    pub(super) storage: Arc<dyn Storage>,
    /// By id in the catalog.
    pub(super) tiles: BTreeMap<i64, RawTile>,
    changes: u64,
    folder: tempfile::TempDir,
}

/// Whole levels of a channel, as a source or the oracle has them.
pub(super) type Levels = Vec<Vec<u16>>;

impl Fixture {
    pub(super) async fn new(extent: UVec3, voxel_nm: DVec3) -> Self {
        Self::on(Arc::new(MemoryStorage::new()), extent, voxel_nm).await
    }

    pub(super) async fn on(storage: Arc<dyn Storage>, extent: UVec3, voxel_nm: DVec3) -> Self {
        let volume = Volume::new("v", extent, voxel_nm).unwrap();
        Self::of(storage, volume).await
    }

    /// Of a volume of the name `v`.
    pub(super) async fn of(storage: Arc<dyn Storage>, volume: Volume) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let catalog = Catalog::create(&folder.path().join("catalog.sqlite"))
            .await
            .unwrap();
        catalog.create_volume(&volume).await.unwrap();
        Self {
            volume,
            archive: VisualizationArchive::from_parts(catalog, storage.clone()),
            storage,
            tiles: BTreeMap::new(),
            changes: 0,
            folder,
        }
    }

    /// Puts the catalog of another in the place of this one's, and all that it says of tiles. Neither may write any more.
    pub(super) async fn take_catalog_of(&mut self, other: &Self) {
        other.archive.catalog().close().await;
        let file = |fixture: &Self, end| fixture.folder.path().join(format!("catalog.sqlite{end}"));
        for end in ["", "-wal", "-shm"] {
            let _what_there_is = std::fs::remove_file(file(self, end));
        }
        std::fs::copy(file(other, ""), file(self, "")).unwrap();
        self.tiles.clone_from(&other.tiles);
    }

    pub(super) async fn open(&self) -> StitchedSource {
        self.open_with(StitchedOptions::default()).await
    }

    pub(super) async fn open_with(&self, options: StitchedOptions) -> StitchedSource {
        StitchedSource::open(&self.archive, "v", options)
            .await
            .unwrap()
    }

    /// Enters a tile, new or again, as ingest does. Returns the name of its pyramid.
    pub(super) async fn put(&mut self, name: &str, tile: RawTile) -> String {
        self.put_at(name, tile, self.changes + 1).await
    }

    /// The same of the record at a position, however late it comes.
    pub(super) async fn put_at(&mut self, name: &str, mut tile: RawTile, position: u64) -> String {
        self.changes += 1;
        tile.age = position;
        let size = UVec2::new(tile.width as u32, tile.height as u32);
        let pyramid = format!("tiles/{name}-{}.tif", self.changes);
        let bytes = match self.volume.dtype {
            Dtype::Uint16 => encoded(self.volume.kind, size, tile.pixels.clone()),
            _ => {
                let pixels = tile.pixels.iter().map(|v| *v as u8).collect();
                encoded::<u8>(self.volume.kind, size, pixels)
            }
        };
        self.storage.write_durable(&pyramid, bytes).await.unwrap();
        let new = NewTile {
            name: name.into(),
            section: tile.section,
            channel: tile.channel,
            size,
            transform: SectionFromTile::new(tile.transform).unwrap(),
            pyramid: pyramid.clone(),
            position,
        };
        self.archive.catalog().commit_tile("v", &new).await.unwrap();
        let entered = self
            .archive
            .catalog()
            .tile("v", name)
            .await
            .unwrap()
            .unwrap();
        self.tiles.insert(entered.id.0, tile);
        pyramid
    }

    /// Moves a tile.
    pub(super) async fn transform(&mut self, name: &str, transform: [f64; 6]) {
        self.changes += 1;
        let catalog = self.archive.catalog();
        let moved = SectionFromTile::new(transform).unwrap();
        let mut commit = catalog.begin("v").await.unwrap();
        commit
            .transform(name, moved, Some(self.changes))
            .await
            .unwrap();
        commit.finish().await.unwrap();
        let id = catalog.tile("v", name).await.unwrap().unwrap().id.0;
        let tile = self.tiles.get_mut(&id).unwrap();
        tile.transform = transform;
    }

    /// Moves all tiles of a section by as much, at once.
    pub(super) async fn shift(&mut self, section: u32, by: (f64, f64)) {
        self.changes += 1;
        let catalog = self.archive.catalog();
        let tiles = catalog.section_tiles("v", section).await.unwrap();
        let mut commit = catalog.begin("v").await.unwrap();
        for tile in tiles {
            let moved = tile.transform.shifted(by.into());
            let name = &tile.name;
            { commit.transform(name, moved, Some(self.changes)).await }.unwrap();
            let known = self.tiles.get_mut(&tile.id.0).unwrap();
            known.transform = moved.elements();
        }
        commit.finish().await.unwrap();
    }

    /// Deletes a tile, if there is one of that name.
    pub(super) async fn delete(&mut self, name: &str) -> bool {
        self.changes += 1;
        let catalog = self.archive.catalog();
        let Some(tile) = catalog.tile("v", name).await.unwrap() else {
            return false;
        };
        { catalog.delete_tile("v", name, self.changes).await }.unwrap();
        self.tiles.remove(&tile.id.0).is_some()
    }

    /// All voxels as they should be.
    pub(super) fn expected(&self) -> Levels {
        expected(&self.volume, &self.tiles)
    }
}

fn encoded<T: Voxel>(kind: VoxelKind, size: UVec2, pixels: Vec<T>) -> bytes::Bytes {
    let image = Gray::new(size.x, size.y, pixels);
    let encoded = match kind {
        VoxelKind::Intensity => encode(&image, &Encoding::Lossless),
        VoxelKind::Labels => encode_labels(&image),
    };
    encoded.unwrap()
}

pub(super) fn expected(volume: &Volume, tiles: &BTreeMap<i64, RawTile>) -> Levels {
    expected_as(volume, tiles, How::PLAIN)
}

pub(super) fn expected_as(volume: &Volume, tiles: &BTreeMap<i64, RawTile>, how: How) -> Levels {
    let levels = volume.levels.iter();
    let level = |extent: UVec3, step: DVec3| stitch(tiles, extent.to_array(), step.to_array(), how);
    levels.map(|l| level(l.extent, l.downsampling)).collect()
}

/// All voxels of the first channel as a source delivers them.
pub(super) async fn read_all(source: &StitchedSource) -> Levels {
    read_channel(source, 0).await
}

/// All voxels of a channel as a source delivers them.
pub(super) async fn read_channel(source: &StitchedSource, channel: u32) -> Levels {
    let volume = source.volume().clone();
    let mut levels = Vec::new();
    for (number, level) in (0..).zip(&volume.levels) {
        let extent = level.extent.as_usizevec3();
        let mut values = vec![0; extent.element_product()];
        for chunk in VoxelBox::of_size(volume.chunks(number as usize)).iter() {
            let id = ChunkId {
                channel,
                level: number,
                chunk,
            };
            let Chunk::Voxels(bytes) = source.read(id).await.unwrap() else {
                continue;
            };
            let chunk = numbers(&volume, &bytes);
            let voxels = id.voxels(&volume).unwrap();
            for voxel in voxels.iter() {
                let from = (voxel - voxels.min).as_usizevec3();
                let size = volume.chunk.as_usizevec3();
                let from = (from.z * size.y + from.y) * size.x + from.x;
                let to = voxel.as_usizevec3();
                let to = (to.z * extent.y + to.y) * extent.x + to.x;
                values[to] = chunk[from];
            }
        }
        levels.push(values);
    }
    levels
}

/// Values of little-endian voxels.
pub(super) fn numbers(volume: &Volume, bytes: &[u8]) -> Vec<u16> {
    match volume.dtype {
        Dtype::Uint16 => bytes
            .chunks_exact(2)
            .map(|v| u16::from_le_bytes([v[0], v[1]]))
            .collect(),
        _ => bytes.iter().map(|v| u16::from(*v)).collect(),
    }
}

/// A chunk cut out of whole levels.
pub(super) fn chunk_of(volume: &Volume, levels: &Levels, id: ChunkId) -> Vec<u8> {
    let extent = volume.levels[id.level as usize].extent;
    let voxels = VoxelBox::of_size(volume.chunk).iter();
    let value = |offset: UVec3| {
        let v = id.chunk * volume.chunk + offset;
        if v.cmpge(extent).any() {
            return 0;
        }
        let (v, extent) = (v.as_usizevec3(), extent.as_usizevec3());
        levels[id.level as usize][(v.z * extent.y + v.y) * extent.x + v.x]
    };
    let bytes = volume.dtype.bytes();
    let values = voxels.map(|offset| value(offset).to_le_bytes());
    values.flat_map(|v| v.into_iter().take(bytes)).collect()
}

/// How two volumes differ: voxels of which one is 0 and the other is not, and the largest
/// difference of all others.
pub(super) fn difference(got: &Levels, want: &Levels) -> (usize, u16) {
    let pairs = || got.iter().flatten().zip(want.iter().flatten());
    assert_eq!(pairs().count(), want.iter().flatten().count());
    let coverage = pairs().filter(|(a, b)| (**a == 0) != (**b == 0)).count();
    let both = pairs().filter(|(a, b)| **a != 0 && **b != 0);
    (
        coverage,
        both.map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0),
    )
}

/// Pixels that no shift leaves alike; from a seed.
pub(in crate::stitched) fn noise(width: usize, height: usize, seed: u64) -> Vec<u8> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let pixels = (0..width * height).map(|_| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 56) as u8
    });
    pixels.collect()
}

/// A tile of noise turned about its centre, with its low corner moved to (x, y) before turning.
pub(super) fn tile(
    size: (usize, usize),
    section: u32,
    corner: (f64, f64),
    degrees: f64,
    scale: f64,
    seed: u64,
) -> RawTile {
    let (s, c) = degrees.to_radians().sin_cos();
    let (s, c) = (s * scale, c * scale);
    let (w, h) = (size.0 as f64 / 2.0, size.1 as f64 / 2.0);
    let (cx, cy) = (corner.0 + w, corner.1 + h);
    RawTile {
        width: size.0,
        height: size.1,
        pixels: noise(size.0, size.1, seed)
            .into_iter()
            .map(u16::from)
            .collect(),
        transform: [c, s, -s, c, cx - (c * w - s * h), cy - (s * w + c * h)],
        section,
        channel: 0,
        age: 0,
    }
}

/// Low and high corner of a tile in its section.
pub(super) fn bounds(tile: &RawTile) -> (f64, f64, f64, f64) {
    let [a, b, c, d, tx, ty] = tile.transform;
    let (w, h) = (tile.width as f64, tile.height as f64);
    let corners = [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)];
    let corners = corners.map(|(x, y)| (a * x + c * y + tx, b * x + d * y + ty));
    corners
        .iter()
        .fold((f64::MAX, f64::MAX, f64::MIN, f64::MIN), |m, p| {
            (m.0.min(p.0), m.1.min(p.1), m.2.max(p.0), m.3.max(p.1))
        })
}
