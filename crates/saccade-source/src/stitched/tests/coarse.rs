//! Coarse levels of more than a thousand tiles: each pyramid is opened once, whatever comes, moves or restarts.

use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

use bytes::Bytes;
use futures::StreamExt;
use glam::{DVec3, UVec2, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_archive::catalog::{Catalog, NewTile};
use saccade_archive::image::Gray;
use saccade_archive::pyramid::{Encoding, encode};
use saccade_archive::storage::{MemoryStorage, Storage};
use saccade_core::transform::SectionFromTile;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;

use super::fixture::noise;
use super::oracle::{How, RawTile, stitch};
use super::run;
use crate::stitched::{DiskCache, StitchedOptions, StitchedSource};
use crate::{Chunk, ChunkId, VolumeSource};

/// Tiles of the section.
const GRID: UVec2 = UVec2::new(40, 30);
/// Pixels of a tile, two levels; they overlap by ten.
const SIZE: UVec2 = UVec2::new(150, 140);
/// Images: tiles share them, so that a thousand are made in a moment.
const IMAGES: u64 = 7;

struct Mosaic {
    archive: VisualizationArchive,
    storage: Arc<MemoryStorage>,
    volume: Volume,
    /// Pyramids, by their seeds.
    images: Vec<Bytes>,
    tiles: Vec<RawTile>,
    /// Of the newest change.
    age: u64,
    _folder: tempfile::TempDir,
}

fn image(seed: u64) -> Vec<u8> {
    let mut pixels = noise(SIZE.x as usize, SIZE.y as usize, seed);
    // Pictures that coarse levels can tell apart.
    let level = (seed * 31 % 200) as u8;
    pixels.iter_mut().for_each(|p| *p = level + *p % 50 + 1);
    pixels
}

fn encoded(seed: u64) -> Bytes {
    let image = Gray::new(SIZE.x, SIZE.y, image(seed));
    encode(&image, &Encoding::Lossless).unwrap()
}

impl Mosaic {
    fn raw(n: usize) -> RawTile {
        let at = n as u32;
        let corner = UVec2::new(at % GRID.x, at / GRID.x) * (SIZE - 10);
        let seed = n as u64 % IMAGES;
        RawTile {
            width: SIZE.x as usize,
            height: SIZE.y as usize,
            pixels: image(seed).into_iter().map(u16::from).collect(),
            transform: [1.0, 0.0, 0.0, 1.0, corner.x.into(), corner.y.into()],
            section: 0,
            channel: 0,
            age: n as u64,
        }
    }

    fn new_tile(n: usize, tile: &RawTile, image: u64, position: u64) -> NewTile {
        NewTile {
            name: format!("t{n}"),
            section: tile.section,
            channel: 0,
            size: SIZE,
            transform: SectionFromTile::new(tile.transform).unwrap(),
            pyramid: format!("tiles/{n}-{image}.tif"),
            position,
        }
    }

    async fn new() -> Self {
        let extent = (GRID * (SIZE - 10) + 10).extend(2);
        let volume = Volume::new("v", extent, DVec3::new(4.0, 4.0, 40.0)).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("catalog.sqlite");
        let catalog = Catalog::create(&file);
        let catalog = catalog.await.unwrap();
        catalog.create_volume(&volume).await.unwrap();
        let storage = Arc::new(MemoryStorage::new());
        let mut mosaic = Self {
            archive: VisualizationArchive::from_parts(catalog, storage.clone()),
            storage,
            volume,
            images: (0..IMAGES).map(encoded).collect(),
            tiles: (0..(GRID.x * GRID.y) as usize).map(Self::raw).collect(),
            age: 1_000_000,
            _folder: folder,
        };
        for n in 0..mosaic.tiles.len() {
            mosaic.write(n, n as u64 % IMAGES).await;
        }
        let catalog = mosaic.archive.catalog();
        let mut commit = catalog.begin("v").await.unwrap();
        for (n, tile) in mosaic.tiles.iter().enumerate() {
            let new = Self::new_tile(n, tile, n as u64 % IMAGES, n as u64);
            commit.tile(&new, SystemTime::now()).await.unwrap();
        }
        commit.finish().await.unwrap();
        mosaic.tiles.shrink_to_fit();
        mosaic
    }

    async fn write(&self, n: usize, seed: u64) {
        let bytes = self.images[seed as usize].clone();
        let name = format!("tiles/{n}-{seed}.tif");
        self.storage.write_durable(&name, bytes).await.unwrap();
    }

    async fn image_again(&mut self, n: usize, seed: u64) {
        self.write(n, seed).await;
        self.tiles[n].pixels = image(seed).into_iter().map(u16::from).collect();
        self.age += 1;
        self.tiles[n].age = self.age;
        let new = Self::new_tile(n, &self.tiles[n], seed, self.age);
        self.archive.catalog().commit_tile("v", &new).await.unwrap();
    }

    /// Moves tiles, in one commit.
    async fn shift(&mut self, tiles: &[usize], by: f64) {
        let mut commit = self.archive.catalog().begin("v").await.unwrap();
        for n in tiles {
            self.age += 1;
            let tile = &mut self.tiles[*n];
            tile.age = self.age;
            let [a, b, c, d, x, y] = tile.transform;
            tile.transform = [a, b, c, d, x + by, y - by];
            let to = SectionFromTile::new(tile.transform).unwrap();
            commit.transform(&format!("t{n}"), to, None).await.unwrap();
        }
        commit.finish().await.unwrap();
    }

    /// Little memory for indices: of thousands of large pyramids few remain open.
    async fn open(&self, thumbnail_bytes: u64, disk: Option<&Path>) -> StitchedSource {
        let mut disk_cache = None;
        if let Some(folder) = disk {
            disk_cache = Some(DiskCache::open(folder, 0).await.unwrap());
        }
        let options = StitchedOptions {
            index_bytes: 64 << 10,
            sub_tile_bytes: 256 << 10,
            thumbnail_bytes,
            disk_cache,
            ..StitchedOptions::default()
        };
        let source = StitchedSource::open(&self.archive, "v", options);
        source.await.unwrap()
    }

    /// The coarsest level by brute force.
    fn expected(&self) -> Vec<u16> {
        let tiles = (0..).zip(self.tiles.iter().cloned()).collect();
        let level = self.volume.levels.last().unwrap();
        let (extent, step) = (level.extent.to_array(), level.downsampling.to_array());
        stitch(&tiles, extent, step, How::PLAIN)
    }
}

/// All chunks of a level.
async fn read(source: &StitchedSource, level: u32) -> Vec<Chunk> {
    let chunks = VoxelBox::of_size(source.volume().chunks(level as usize));
    let read = chunks.iter().map(|chunk| {
        let channel = 0;
        source.read(ChunkId {
            channel,
            level,
            chunk,
        })
    });
    futures::future::try_join_all(read).await.unwrap()
}

/// The coarsest level, which is one chunk, without its padding.
fn cropped(chunk: &Chunk, volume: &Volume) -> Vec<u8> {
    let Chunk::Voxels(voxels) = chunk else {
        panic!("it is empty");
    };
    let extent = volume.levels.last().unwrap().extent;
    let at = |v: UVec3| (v.z * volume.chunk.y + v.y) * volume.chunk.x + v.x;
    let all = VoxelBox::of_size(extent).iter();
    all.map(|v| voxels[at(v) as usize]).collect()
}

/// Pyramids opened for the coarsest level when it is built, when the next finer one is, and when a tile moves, a
/// section moves and a tile is imaged again. Where that is `compared`, it is as it should be.
async fn opened(mosaic: &mut Mosaic, source: &StitchedSource, compared: bool) -> Vec<u64> {
    let mut changes = source.changes();
    let coarsest = mosaic.volume.levels.len() as u32 - 1;
    let mut opened = Vec::new();
    let mut before = 0;
    for step in 0..5 {
        match step {
            0 => {}
            1 => drop(read(source, coarsest - 1).await),
            2 => mosaic.shift(&[15 * GRID.x as usize + 20], 40.0).await,
            3 => {
                let section: Vec<usize> = (0..(GRID.x * GRID.y) as usize).collect();
                // Forth and back: it stays in the volume.
                let back = mosaic.tiles[0].transform[4] < -50.0;
                let by = if back { 64.0 } else { -64.0 };
                mosaic.shift(&section, by).await;
            }
            _ => {
                let dark = mosaic.tiles[400].pixels[0] % IMAGES as u16 + 1;
                mosaic.image_again(400, u64::from(dark) % IMAGES).await;
            }
        }
        let newest = mosaic.archive.catalog().revision("v").await.unwrap();
        while source.revision() < newest {
            changes.next().await.unwrap();
        }
        let chunks = read(source, coarsest).await;
        let now = source.statistics().pyramids_opened;
        opened.push(now - before);
        before = now;
        if !compared || step % 4 != 0 {
            continue;
        }
        assert_eq!(chunks.len(), 1);
        let got = cropped(&chunks[0], &mosaic.volume);
        let want = mosaic.expected();
        let off = got
            .iter()
            .zip(&want)
            .map(|(a, b)| u16::from(*a).abs_diff(*b));
        assert!(off.max().unwrap() <= 1, "step {step}");
    }
    opened
}

#[test]
fn each_pyramid_is_opened_once() {
    run(async {
        let mut mosaic = Mosaic::new().await;
        let section = u64::from(GRID.x * GRID.y);
        let folder = tempfile::tempdir().unwrap();
        let source = mosaic.open(128 << 20, Some(folder.path())).await;
        let with = opened(&mut mosaic, &source, true).await;
        assert_eq!(with, [section, 0, 0, 0, 1]);
        let kept = source.statistics().thumbnail_bytes;
        assert!(kept <= section * 17_000, "{kept}");
        source.inner.disk.as_ref().unwrap().0.close().await;
        drop(source);

        // A level of which no block was built before, after a restart.
        let source = mosaic.open(128 << 20, Some(folder.path())).await;
        let level = mosaic.volume.levels.len() as u32 - 3;
        read(&source, level).await;
        let statistics = source.statistics();
        assert_eq!(statistics.blocks_from_disk, 0);
        assert_eq!(statistics.pyramids_opened, 0);
        assert_eq!(statistics.thumbnails_from_disk, section);

        // The control keeps none, and one keeps few.
        for bytes in [0, 1 << 20] {
            let source = mosaic.open(bytes, None).await;
            let other = mosaic.open(128 << 20, None).await;
            assert!(read(&source, level).await == read(&other, level).await);
            let without = opened(&mut mosaic, &source, false).await;
            let most = without.iter().filter(|opened| **opened + 200 > section);
            assert_eq!(
                most.count(),
                5,
                "with {bytes} bytes {without:?}, not {with:?}"
            );
            assert!(source.statistics().thumbnail_bytes <= bytes);
        }
    });
}
