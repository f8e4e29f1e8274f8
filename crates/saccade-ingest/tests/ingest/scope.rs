//! A microscope for tests, and eyes for what ingest made of its tiles.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::Duration;

use glam::{DVec2, DVec3, UVec2, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{
    AcquisitionInfo, Record, RecordWriter, TileRecord, TransformRecord,
};
use saccade_archive::pyramid::{Encoding, PyramidIndex, SUB_TILE_EDGE};
use saccade_archive::storage::{MemoryStorage, Storage as _, StorageError};
use saccade_core::transform::SectionFromTile;
use saccade_ingest::ingest::{IngestOptions, Summary, run};
use saccade_ingest::{Cancel, Progress, State};
use tiff::encoder::{TiffEncoder, colortype};

pub(crate) const VOLUME: &str = "cortex";
pub(crate) const EXTENT: UVec3 = UVec3::new(1000, 800, 20);

/// An acquisition archive in a folder of its own.
pub(crate) struct Scope {
    folder: tempfile::TempDir,
}

impl Scope {
    pub(crate) fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("tiles")).unwrap();
        info(EXTENT).write(folder.path()).unwrap();
        Self { folder }
    }

    pub(crate) fn path(&self) -> &Path {
        self.folder.path()
    }

    pub(crate) fn file(&self, name: &str) -> PathBuf {
        self.path().join(format!("tiles/{name}.tif"))
    }

    /// Writes an image.
    pub(crate) fn image(&self, name: &str, size: UVec2, seed: u8) -> Vec<u8> {
        let bytes = tiff8(size, &texture(size, seed));
        fs::write(self.file(name), &bytes).unwrap();
        bytes
    }

    pub(crate) fn say(&self, record: &Record) {
        RecordWriter::open(self.path())
            .unwrap()
            .append(record)
            .unwrap();
    }

    /// An image and its record.
    pub(crate) fn tile(&self, name: &str, section: u32, size: UVec2, seed: u8) {
        self.image(name, size, seed);
        self.say(&tile_record(name, section, size));
    }

    /// Ingests once, into `archive`.
    pub(crate) async fn ingest(&self, archive: &VisualizationArchive) -> Summary {
        run(self.path(), archive, &quick(), &(), &Cancel::new())
            .await
            .unwrap()
    }
}

pub(crate) fn info(extent: UVec3) -> AcquisitionInfo {
    AcquisitionInfo::new(VOLUME, extent, DVec3::new(4.0, 4.0, 40.0))
}

pub(crate) fn tile_record(name: &str, section: u32, size: UVec2) -> Record {
    Record::Tile(TileRecord {
        tile: name.to_owned(),
        file: format!("tiles/{name}.tif"),
        section,
        size,
        transform: at(10.0, 20.0),
        channel: None,
    })
}

pub(crate) fn move_record(name: &str, transform: SectionFromTile) -> Record {
    Record::Transform(TransformRecord {
        tile: name.to_owned(),
        transform,
    })
}

pub(crate) fn at(x: f64, y: f64) -> SectionFromTile {
    SectionFromTile::translation(DVec2::new(x, y))
}

/// Options for tests: everything that is there, without long pauses.
pub(crate) fn quick() -> IngestOptions {
    IngestOptions {
        encoding: Encoding::Lossless,
        poll: Duration::from_millis(2),
        once: true,
        patience: 5,
        retry: Duration::from_millis(2),
        lease: Duration::from_millis(300),
        ..IngestOptions::DEFAULT
    }
}

/// Values of an image, different for each seed.
pub(crate) fn texture(size: UVec2, seed: u8) -> Vec<u8> {
    let value = |x: u32, y: u32| {
        let wave = (x / 7 * 31 + y / 5 * 17 + u32::from(seed) * 53) % 251;
        u8::try_from(wave).unwrap() + 1
    };
    (0..size.y)
        .flat_map(|y| (0..size.x).map(move |x| value(x, y)))
        .collect()
}

pub(crate) fn tiff8(size: UVec2, values: &[u8]) -> Vec<u8> {
    let mut file = std::io::Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut file).unwrap();
    encoder
        .write_image::<colortype::Gray8>(size.x, size.y, values)
        .unwrap();
    file.into_inner()
}

pub(crate) fn tiff16(size: UVec2) -> Vec<u8> {
    let values = vec![1000; (size.x * size.y) as usize];
    let mut file = std::io::Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut file).unwrap();
    encoder
        .write_image::<colortype::Gray16>(size.x, size.y, &values)
        .unwrap();
    file.into_inner()
}

pub(crate) async fn archive(folder: &Path) -> VisualizationArchive {
    VisualizationArchive::create(folder).await.unwrap()
}

/// A tile as a reader sees it, without what depends on when it was entered.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Seen {
    pub(crate) section: u32,
    pub(crate) size: UVec2,
    pub(crate) transform: [f64; 6],
    pub(crate) pyramid: String,
    pub(crate) bytes: bytes::Bytes,
}

/// Everything in the volume.
pub(crate) async fn seen(archive: &VisualizationArchive) -> BTreeMap<String, Seen> {
    // A tile that is imaged again while it is read takes its old pyramid away: then look again.
    for _ in 0..50 {
        match seen_at_once(archive).await {
            Ok(tiles) => return tiles,
            Err(StorageError::NotFound { .. }) => {
                tokio::time::sleep(Duration::from_millis(20)).await
            }
            Err(error) => panic!("{error}"),
        }
    }
    panic!("a pyramid is missing for good")
}

async fn seen_at_once(
    archive: &VisualizationArchive,
) -> Result<BTreeMap<String, Seen>, StorageError> {
    let mut tiles = BTreeMap::new();
    for z in archive.catalog().sections(VOLUME).await.unwrap() {
        for tile in archive.catalog().section_tiles(VOLUME, z).await.unwrap() {
            let bytes = archive.storage().read(&tile.pyramid, None).await?;
            let (section, size, pyramid) = (tile.section, tile.size, tile.pyramid);
            let transform = tile.transform.elements();
            tiles.insert(
                tile.name,
                Seen {
                    section,
                    size,
                    transform,
                    pyramid,
                    bytes,
                },
            );
        }
    }
    Ok(tiles)
}

/// The finest level of a pyramid, as it was when the tile was seen.
pub(crate) async fn pixels(tile: &Seen) -> Vec<u8> {
    let storage = &MemoryStorage::new();
    let write = storage.write_durable(&tile.pyramid, tile.bytes.clone());
    write.await.unwrap();
    let index = PyramidIndex::open(storage, &tile.pyramid).await.unwrap();
    let level = &index.levels()[0];
    assert_eq!([level.width, level.height], tile.size.to_array());
    let mut pixels = vec![0; (level.width * level.height) as usize];
    for y in 0..level.sub_tiles.y {
        for x in 0..level.sub_tiles.x {
            let voxels = index.read_sub_tile(storage, 0, x, y).await.unwrap();
            for row in 0..SUB_TILE_EDGE.min(level.height - y * SUB_TILE_EDGE) {
                let width = SUB_TILE_EDGE.min(level.width - x * SUB_TILE_EDGE) as usize;
                let to = ((y * SUB_TILE_EDGE + row) * level.width + x * SUB_TILE_EDGE) as usize;
                let from = (row * SUB_TILE_EDGE) as usize;
                pixels[to..to + width].copy_from_slice(&voxels[from..from + width]);
            }
        }
    }
    pixels
}

/// Pyramids in the storage that neither a tile nor the list of retired ones names.
pub(crate) async fn orphans(archive: &VisualizationArchive) -> BTreeSet<String> {
    let mut names: BTreeSet<_> = archive
        .storage()
        .list("tiles/")
        .await
        .unwrap()
        .into_iter()
        .collect();
    for tile in seen(archive).await.values() {
        names.remove(&tile.pyramid);
    }
    let later = std::time::SystemTime::now() + Duration::from_secs(3600);
    for retired in archive
        .catalog()
        .retired(VOLUME, later, u32::MAX)
        .await
        .unwrap()
    {
        names.remove(&retired.pyramid);
    }
    names
}

/// Remembers what it is told.
#[derive(Debug, Default)]
pub(crate) struct Diary {
    notices: Mutex<Vec<String>>,
    states: Mutex<Vec<State>>,
    held_up: Mutex<Option<String>>,
}

impl Diary {
    pub(crate) fn notices(&self) -> Vec<String> {
        self.notices.lock().unwrap().clone()
    }

    pub(crate) fn held_up(&self) -> Option<String> {
        self.held_up.lock().unwrap().clone()
    }

    pub(crate) fn states(&self) -> Vec<State> {
        self.states.lock().unwrap().clone()
    }
}

impl Progress for Diary {
    fn update(&self, state: &State) {
        self.states.lock().unwrap().push(*state);
    }

    fn held_up(&self, why: Option<&str>) {
        *self.held_up.lock().unwrap() = why.map(str::to_owned);
    }

    fn notice(&self, text: &str) {
        self.notices.lock().unwrap().push(text.to_owned());
    }
}

/// A TIFF of one colour.
pub(crate) fn tiff_rgb(size: UVec2, color: [u8; 3]) -> Vec<u8> {
    let mut file = std::io::Cursor::new(Vec::new());
    let data = color.repeat((size.x * size.y) as usize);
    TiffEncoder::new(&mut file)
        .unwrap()
        .write_image::<colortype::RGB8>(size.x, size.y, &data)
        .unwrap();
    file.into_inner()
}
