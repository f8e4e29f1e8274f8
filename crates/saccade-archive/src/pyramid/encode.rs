//! An image's pyramid, made in one pass over its pixels.

use bytes::Bytes;
use glam::UVec2;
use rayon::prelude::*;

use super::codec::Encoder;
use super::filter::{EDGE, Filter, TASK_LEVEL, covered};
use super::layout::{Coded, Parts};
use super::mean::{Mean, mean};
use super::mode::Mode;
use super::morton::in_morton_order;
use super::voxel::pixel::Pixel;
use super::{
    EncodeError, Encoding, PyramidLevel, SUB_TILE_EDGE, SUB_TILE_VOXELS, SubTileEntry, Voxel,
    levels_of,
};
use crate::image::{Gray, MAX_EDGE};

/// Makes the pyramid of an image by averages, as the bytes of a TIFF file. Runs on rayon's threads.
///
/// # Errors
///
/// [`EncodeError`]; also for JPEG of 16 bits.
pub fn encode<T: Voxel>(image: &Gray<T>, encoding: &Encoding) -> Result<Bytes, EncodeError> {
    Ok(parts::<Mean<T>>(image, encoding)?.file())
}

/// Makes the pyramid of an image of labels: a coarser pixel has the label that most of the level-0
/// pixels it covers have; of several, the smallest. Every label comes back as it was.
///
/// # Errors
///
/// [`EncodeError`].
pub fn encode_labels<T: Voxel>(image: &Gray<T>) -> Result<Bytes, EncodeError> {
    Ok(parts::<Mode<T>>(image, &Encoding::Lossless)?.file())
}

pub(super) fn parts<F: Filter>(
    image: &Gray<F::Pixel>,
    encoding: &Encoding,
) -> Result<Parts, EncodeError> {
    let (width, height) = (image.width, image.height);
    let edges = 1..=MAX_EDGE;
    let voxels = u64::from(width) * u64::from(height);
    if !edges.contains(&width) || !edges.contains(&height) || voxels != image.voxels.len() as u64 {
        return Err(EncodeError::Size {
            width,
            height,
            voxels: image.voxels.len(),
        });
    }
    let dtype = F::Pixel::DTYPE;
    let levels = levels_of(width, height);
    let task_level = TASK_LEVEL.min(levels.len() - 1);
    let tasks = in_morton_order(levels[task_level].sub_tiles);
    let tasks = tasks.into_par_iter().map_init(
        || (None, nothing_of(&levels)),
        |(encoder, done), at| {
            let encoder = match encoder {
                Some(encoder) => encoder,
                None => encoder.insert(Encoder::new(encoding, dtype)?),
            };
            let mut task = Task::<F>::new(image, &levels, encoder, done);
            task.sub_tile(task_level, at)?;
            let block = task.blocks.pop();
            let done: Vec<_> = done.iter_mut().map(Coded::take).collect();
            Ok((at, block, done))
        },
    );
    let tasks = tasks.collect::<Result<Vec<_>, EncodeError>>()?;

    let mut coded: Vec<Vec<Coded>> = levels.iter().map(|_| Vec::new()).collect();
    let mut plane = levels
        .get(task_level + 1)
        .map(|l| F::plane(l.width, l.height));
    for (at, block, done) in tasks {
        for (coded, done) in coded.iter_mut().zip(done) {
            coded.push(done);
        }
        if let (Some(plane), Some(block)) = (&mut plane, block) {
            F::put(plane, at, block);
        }
    }

    // What is left is a 256th of the image.
    let mut encoder = Encoder::new(encoding, dtype)?;
    let mut done = nothing_of(&levels);
    let mut task = Task::<F>::new(image, &levels, &mut encoder, &mut done);
    for (level, size) in levels.iter().enumerate().skip(task_level + 1) {
        let Some(known) = plane.take() else { break };
        let pixels = F::plane_values(&known, level, (width, height));
        for at in in_morton_order(size.sub_tiles) {
            task.encode_part(level, at, &pixels, size.width as usize)?;
        }
        plane = Some(F::halved(known));
    }
    for (coded, done) in coded.iter_mut().zip(done).skip(task_level + 1) {
        coded.push(done);
    }
    let blank = encoder.blank::<F::Pixel>()?;
    Ok(Parts {
        levels,
        dtype,
        coded,
        blank,
        jpeg_tables: encoder.tables().map(Into::into),
    })
}

/// No sub-tiles of each level.
fn nothing_of(levels: &[PyramidLevel]) -> Vec<Coded> {
    levels.iter().map(|_| Coded::default()).collect()
}

/// Encodes sub-tiles and what they cover.
struct Task<'a, F: Filter> {
    image: &'a Gray<F::Pixel>,
    levels: &'a [PyramidLevel],
    encoder: &'a mut Encoder,
    /// What is known of the sub-tile at hand of levels 1 to the one above the task's.
    blocks: Vec<F::Block>,
    voxels: Box<[F::Pixel; SUB_TILE_VOXELS]>,
    /// Finished sub-tiles per level.
    done: &'a mut [Coded],
}

impl<'a, F: Filter> Task<'a, F> {
    fn new(
        image: &'a Gray<F::Pixel>,
        levels: &'a [PyramidLevel],
        encoder: &'a mut Encoder,
        done: &'a mut [Coded],
    ) -> Self {
        let blocks = (0..=TASK_LEVEL.min(levels.len() - 1)).map(|_| F::block());
        Self {
            image,
            levels,
            encoder,
            blocks: blocks.collect(),
            voxels: Box::new([F::Pixel::default(); SUB_TILE_VOXELS]),
            done,
        }
    }

    /// Encodes a sub-tile after all finer ones that it covers: the order of the curve, and each
    /// pixel is still in the cache when its sum is needed.
    fn sub_tile(&mut self, level: usize, at: UVec2) -> Result<(), EncodeError> {
        let (width, height) = self.size(level, at);
        let Some(finer) = level.checked_sub(1) else {
            let image = self.image;
            let pitch = image.width as usize;
            self.encode_part(0, at, &image.voxels, pitch)?;
            let corner = at.y as usize * EDGE * pitch + at.x as usize * EDGE;
            let pixels = &image.voxels[corner..];
            F::take_pixels(&mut self.blocks[0], at, pixels, pitch, (width, height));
            return Ok(());
        };
        F::clear(&mut self.blocks[finer]);
        for (x, y) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let at = at * 2 + UVec2::new(x, y);
            if at.cmplt(self.levels[finer].sub_tiles).all() {
                self.sub_tile(finer, at)?;
            }
        }
        let last = (self.levels[level].width - 1, self.levels[level].height - 1);
        let reaches = |at: u32, size: usize, last| at as usize * EDGE + size == last as usize + 1;
        let full = 1 << level;
        let columns = if reaches(at.x, width, last.0) {
            covered(last.0, level, self.image.width)
        } else {
            full
        };
        let rows = if reaches(at.y, height, last.1) {
            covered(last.1, level, self.image.height)
        } else {
            full
        };
        F::values(
            &self.blocks[finer],
            level,
            (width, height),
            (columns, rows),
            &mut self.voxels,
        );
        self.finish(level, at, (width, height))?;
        let (finer, coarser) = self.blocks.split_at_mut(level);
        F::take_block(&mut coarser[0], at, &finer[level - 1]);
        Ok(())
    }

    /// Pixels of a sub-tile that exist.
    fn size(&self, level: usize, at: UVec2) -> (usize, usize) {
        let level = self.levels[level];
        let size = |at: u32, len: u32| (len - at * SUB_TILE_EDGE).min(SUB_TILE_EDGE) as usize;
        (size(at.x, level.width), size(at.y, level.height))
    }

    /// Encodes the sub-tile of a level's pixels.
    fn encode_part(
        &mut self,
        level: usize,
        at: UVec2,
        pixels: &[F::Pixel],
        pitch: usize,
    ) -> Result<(), EncodeError> {
        let (width, height) = self.size(level, at);
        let pixels = &pixels[at.y as usize * EDGE * pitch + at.x as usize * EDGE..];
        if (width, height) == (EDGE, EDGE) {
            let Some(entry) = entry_of(pixels, pitch, (width, height)) else {
                self.done[level].push_blank(at);
                return Ok(());
            };
            let to = &mut self.done[level];
            let begin = to.bytes.len();
            self.encoder.encode(pixels, pitch, &mut to.bytes)?;
            to.push(at, begin, entry);
            return Ok(());
        }
        for (to, from) in self
            .voxels
            .chunks_exact_mut(EDGE)
            .zip(pixels.chunks(pitch))
            .take(height)
        {
            to[..width].copy_from_slice(&from[..width]);
        }
        self.finish(level, at, (width, height))
    }

    /// Encodes the sub-tile in `voxels`, of which so many columns and rows exist.
    fn finish(
        &mut self,
        level: usize,
        at: UVec2,
        (width, height): (usize, usize),
    ) -> Result<(), EncodeError> {
        let to = &mut self.done[level];
        let Some(entry) = entry_of(&*self.voxels, EDGE, (width, height)) else {
            to.push_blank(at);
            return Ok(());
        };
        pad(&mut self.voxels, width, height);
        let begin = to.bytes.len();
        self.encoder.encode(&*self.voxels, EDGE, &mut to.bytes)?;
        to.push(at, begin, entry);
        Ok(())
    }
}

/// Repeats the last column and row: the sharp edge of any other padding would ring through JPEG.
fn pad<T: Pixel>(voxels: &mut [T; SUB_TILE_VOXELS], width: usize, height: usize) {
    for row in voxels.chunks_exact_mut(EDGE).take(height) {
        let last = row[width - 1];
        row[width..].fill(last);
    }
    let (rows, below) = voxels.split_at_mut(height * EDGE);
    for row in below.chunks_exact_mut(EDGE) {
        row.copy_from_slice(&rows[rows.len() - EDGE..]);
    }
}

/// The values of `height` rows of `width` pixels; `None` if all are 0. The place is filled in later.
fn entry_of<T: Pixel>(
    pixels: &[T],
    pitch: usize,
    (width, height): (usize, usize),
) -> Option<SubTileEntry> {
    let (mut min, mut max, mut sum) = (pixels[0], pixels[0], 0_u32);
    for row in pixels.chunks(pitch).take(height) {
        let row = &row[..width];
        min = row.iter().fold(min, |a, &b| a.min(b));
        max = row.iter().fold(max, |a, &b| a.max(b));
        // 2^14 values of 16 bits.
        sum += row.iter().map(|&v| u32::from(v.value())).sum::<u32>();
    }
    let mean: T = mean(sum.into(), (width * height) as u64);
    (max > T::default()).then_some(SubTileEntry {
        offset: 0,
        len: 0,
        min: min.value(),
        max: max.value(),
        mean: mean.value(),
    })
}
