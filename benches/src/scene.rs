//! What is measured on: tissue cut into tiles, in a temporary acquisition archive.

use std::fs::{self, File};
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use glam::{DVec2, DVec3, UVec2, UVec3};
use rustix::fs::Advice;
use saccade_archive::acquisition::{AcquisitionInfo, Record, RecordWriter, TileRecord};
use saccade_core::phantom::Phantom;
use saccade_core::transform::SectionFromTile;
use tiff::encoder::{TiffEncoder, colortype::Gray8};

/// Serial sections, as the paper's.
pub(crate) const VOXEL_NM: DVec3 = DVec3::new(4.0, 4.0, 40.0);

/// Name of every volume here.
pub(crate) const NAME: &str = "bench";

/// Edge of the piece of tissue that larger images repeat, mirrored at its borders \[pixels\].
const TISSUE_EDGE: u32 = 1024;

/// An image of tissue with the noise of a fast scan, which is what encoders find hard.
pub(crate) fn tissue(edge: u32, section: u32) -> Result<Vec<u8>> {
    let phantom = Phantom::new(1, VOXEL_NM)?;
    let mut sampler = phantom.sampler();
    let mut piece = vec![0; (TISSUE_EDGE * TISSUE_EDGE) as usize];
    for (y, row) in (0..).zip(piece.chunks_exact_mut(TISSUE_EDGE as usize)) {
        sampler.row(0, y, section, row);
    }
    let mirrored = |at: u32| {
        let within = at % (2 * TISSUE_EDGE);
        within.min(2 * TISSUE_EDGE - 1 - within)
    };
    let mut random = u64::from(section) | 1 << 40;
    let mut image = Vec::with_capacity(edge as usize * edge as usize);
    for y in 0..edge {
        let row = &piece[(mirrored(y) * TISSUE_EDGE) as usize..][..TISSUE_EDGE as usize];
        image.extend((0..edge).map(|x| noisy(row[mirrored(x) as usize], &mut random)));
    }
    Ok(image)
}

/// Adds roughly normal noise with a standard deviation of 9; values stay within 1 to 255.
fn noisy(value: u8, random: &mut u64) -> u8 {
    // A xorshift.
    *random ^= *random << 13;
    *random ^= *random >> 7;
    *random ^= *random << 17;
    let sum: i16 = random.to_le_bytes()[..4]
        .iter()
        .map(|b| i16::from(b % 16))
        .sum();
    let noisy = i16::from(value) + sum - 30;
    u8::try_from(noisy.clamp(1, 255)).unwrap_or(u8::MAX)
}

/// Writes a square image as an uncompressed TIFF.
pub(crate) fn write_image(path: &Path, edge: u32, pixels: &[u8]) -> Result<()> {
    let out = File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
    TiffEncoder::new(BufWriter::new(out))?.write_image::<Gray8>(edge, edge, pixels)?;
    Ok(())
}

/// The microscope's side of an acquisition archive.
pub(crate) struct Microscope {
    folder: PathBuf,
    records: RecordWriter,
}

impl Microscope {
    pub(crate) fn start(folder: &Path, extent: UVec3) -> Result<Self> {
        AcquisitionInfo::new(NAME, extent, VOXEL_NM).write(folder)?;
        fs::create_dir_all(folder.join("tiles"))?;
        Ok(Self {
            folder: folder.to_owned(),
            records: RecordWriter::open(folder)?,
        })
    }

    /// Writes an image; nobody knows of it before [`Self::announce`].
    pub(crate) fn write_image(&self, tile: &str, edge: u32, pixels: &[u8]) -> Result<()> {
        write_image(&self.folder.join(file(tile)), edge, pixels)
    }

    /// Appends the record of a tile: from here on it has arrived.
    pub(crate) fn announce(
        &mut self,
        tile: &str,
        section: u32,
        edge: u32,
        transform: SectionFromTile,
    ) -> Result<()> {
        self.announce_as(tile, tile, section, edge, transform)
    }

    /// The same of a tile whose image was written as another's.
    pub(crate) fn announce_as(
        &mut self,
        tile: &str,
        image: &str,
        section: u32,
        edge: u32,
        transform: SectionFromTile,
    ) -> Result<()> {
        let record = TileRecord {
            tile: tile.to_owned(),
            file: file(image),
            section,
            size: UVec2::splat(edge),
            transform,
            channel: None,
        };
        Ok(self.records.append(&Record::Tile(record))?)
    }
}

fn file(tile: &str) -> String {
    format!("tiles/{tile}.tif")
}

/// Sections of overlapping, slightly turned tiles.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Mosaic {
    /// Edge of a tile \[pixels\].
    pub(crate) edge: u32,
    /// Tiles along x and y.
    pub(crate) side: u32,
    /// Sections.
    pub(crate) sections: u32,
}

impl Mosaic {
    pub(crate) fn tiles(self) -> u64 {
        u64::from(self.side).pow(2) * u64::from(self.sections)
    }

    /// Extent that is covered everywhere \[voxels\].
    pub(crate) fn extent(self) -> UVec3 {
        let side = self.side * self.pitch();
        UVec3::new(side, side, self.sections)
    }

    /// Distance of neighbouring tiles: they overlap by a tenth.
    fn pitch(self) -> u32 {
        self.edge * 9 / 10
    }

    /// Acquires all of it.
    pub(crate) fn acquire(self, folder: &Path) -> Result<()> {
        let mut microscope = Microscope::start(folder, self.extent())?;
        for section in 0..self.sections {
            let pixels = tissue(self.edge, section)?;
            for y in 0..self.side {
                for x in 0..self.side {
                    let tile = format!("s{section}y{y}x{x}");
                    microscope.write_image(&tile, self.edge, &pixels)?;
                    let corner = DVec2::new(f64::from(x), f64::from(y)) * f64::from(self.pitch())
                        - f64::from(self.edge) / 20.0;
                    // By up to 3 degrees: turned further, they would leave corners out.
                    let turned = 0.01 * (f64::from(x + 2 * y + section % 4) - 1.5);
                    let size = DVec2::splat(f64::from(self.edge));
                    let transform = SectionFromTile::rotated(size, turned, corner);
                    microscope.announce(&tile, section, self.edge, transform)?;
                }
            }
        }
        Ok(())
    }
}

/// A small generator of random numbers: a xorshift.
#[derive(Clone, Debug)]
pub(crate) struct Random(pub(crate) u64);

impl Random {
    /// Below `end`.
    pub(crate) fn below(&mut self, end: u32) -> u32 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        u32::try_from((self.0 >> 32) % u64::from(end.max(1))).unwrap_or(0)
    }
}

/// Drops the files of a folder from the system's cache.
pub(crate) fn drop_from_cache(folder: &Path) -> Result<()> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            drop_from_cache(&path)?;
        } else {
            rustix::fs::fadvise(&File::open(&path)?, 0, None, Advice::DontNeed)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_stays_in_range_and_is_centred() {
        let mut random = 7;
        assert!((0..1000).all(|_| noisy(0, &mut random) >= 1));
        let sum: u32 = (0..10_000)
            .map(|_| u32::from(noisy(100, &mut random)))
            .sum();
        assert!((990_000..1_010_000).contains(&sum), "{sum}");
    }
}
