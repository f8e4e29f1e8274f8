//! A small picture of a volume: one section of a coarse level.

use std::sync::Arc;
use std::time::Duration;

use axum::http::HeaderValue;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE, ETAG, HeaderMap};
use axum::response::{IntoResponse, Response};
use futures::FutureExt;
use futures::future::try_join_all;
use glam::{UVec2, UVec3};
use saccade_core::volume::{Dtype, Volume};
use saccade_core::voxel_box::VoxelBox;
use saccade_source::{Chunk, ChunkError, ChunkId};

use crate::http::{Tag, not_found, try_again};
use crate::lingering::Lingers;
use crate::pieces::failed;
use crate::volumes::Published;

/// Longest side, where the volume has a level that small \[pixels\].
const SIDE: u32 = 256;
/// Rows of chunks in which tissue is looked for, from the middle outwards.
const TRIES: usize = 16;
/// Part of the values that may be too dark, and too bright, to tell apart.
const CLIPPED: f64 = 0.01;

/// Draws the section nearest to the middle in which anything was acquired.
pub(crate) async fn thumbnail(
    published: &Arc<Published>,
    headers: &HeaderMap,
    patience: Duration,
) -> Response {
    let tag = Tag::new(&published.version());
    if let Some(answer) = tag.precondition(headers) {
        return answer;
    }
    let mut drawing = Box::pin(section(published.clone()));
    let section = match tokio::time::timeout(patience, &mut drawing).await {
        Ok(Ok(Some(section))) => section,
        Ok(Ok(None)) => return not_found("nothing was acquired yet", Vec::new()),
        Ok(Err(error)) => return failed(published, &error),
        Err(_) => {
            published
                .lingering
                .go_on(Lingers::Thumbnail, drawing.map(drop));
            return try_again("the picture takes long", Duration::from_secs(1));
        }
    };
    let headers = [
        (CONTENT_TYPE, HeaderValue::from_static("image/png")),
        (CACHE_CONTROL, HeaderValue::from_static("no-cache")),
        (ETAG, tag.header()),
    ];
    (headers, png(&section)).into_response()
}

/// Voxels of one section; 0 where nothing was acquired.
struct Section {
    size: UVec2,
    values: Vec<u16>,
}

async fn section(published: Arc<Published>) -> Result<Option<Section>, ChunkError> {
    let (published, volume) = (&published, published.volume());
    let level = level(volume);
    let chunks = volume.chunks(level);
    let middle = volume.levels[level].extent.z / 2;
    for z in outwards(middle / volume.chunk.z, chunks.z).take(TRIES) {
        let row = VoxelBox::new(UVec3::new(0, 0, z), UVec3::new(chunks.x, chunks.y, z + 1));
        let reads = row.iter().map(|chunk| async move {
            let id = ChunkId {
                channel: 0,
                // At most a few dozen levels.
                level: u32::try_from(level).unwrap_or(u32::MAX),
                chunk,
            };
            Ok((chunk, published.source.read(id).await?))
        });
        let read = try_join_all(reads).await?;
        let inside = volume
            .chunk
            .z
            .min(volume.levels[level].extent.z - z * volume.chunk.z);
        let start = middle.saturating_sub(z * volume.chunk.z).min(inside - 1);
        for z in outwards(start, inside) {
            let section = assembled(volume, level, z, &read);
            if section.values.iter().any(|value| *value != 0) {
                return Ok(Some(section));
            }
        }
    }
    Ok(None)
}

/// The finest level that fits, or the coarsest.
fn level(volume: &Volume) -> usize {
    let fits = |level: &saccade_core::levels::Level| level.extent.truncate().max_element() <= SIDE;
    let last = volume.levels.len() - 1;
    volume.levels.iter().position(fits).unwrap_or(last)
}

/// `0..count`, those nearest to `start` first.
fn outwards(start: u32, count: u32) -> impl Iterator<Item = u32> {
    let steps = (0..count).flat_map(move |step| [start.checked_add(step), start.checked_sub(step)]);
    let inside = steps.flatten().filter(move |at| *at < count);
    // `start` itself comes from both sides.
    inside.skip(usize::from(start < count))
}

/// Section `z` of a row of chunks \[voxels of the chunk\].
fn assembled(volume: &Volume, level: usize, z: u32, chunks: &[(UVec3, Chunk)]) -> Section {
    let size = volume.levels[level].extent.truncate();
    let mut values = vec![0; size.x as usize * size.y as usize];
    let width = volume.dtype.bytes();
    for (at, chunk) in chunks {
        let Chunk::Voxels(bytes) = chunk else {
            continue;
        };
        let first = (*at * volume.chunk).truncate();
        let here = volume.chunk.truncate().min(size - first);
        for y in 0..here.y {
            let from = (z * volume.chunk.y + y) as usize * volume.chunk.x as usize;
            let from = &bytes[from * width..(from + here.x as usize) * width];
            let to = (first.y + y) as usize * size.x as usize + first.x as usize;
            for (value, voxel) in values[to..].iter_mut().zip(from.chunks_exact(width)) {
                *value = match volume.dtype {
                    Dtype::Uint16 => u16::from_le_bytes([voxel[0], voxel[1]]),
                    _ => u16::from(voxel[0]),
                };
            }
        }
    }
    Section { size, values }
}

/// Gray with transparency where nothing was acquired, from the darkest to the brightest value.
fn png(section: &Section) -> Vec<u8> {
    let mut measured: Vec<u16> = section.values.iter().copied().filter(|v| *v != 0).collect();
    measured.sort_unstable();
    let quantile = |part: f64| {
        let last = measured.len().saturating_sub(1);
        #[expect(clippy::cast_possible_truncation, reason = "a part of the length")]
        let at = (last as f64 * part).round() as usize;
        f64::from(measured.get(at).copied().unwrap_or(0))
    };
    let (dark, bright) = (quantile(CLIPPED), quantile(1.0 - CLIPPED));
    let gray = |value: u16| {
        let part = (f64::from(value) - dark) / (bright - dark).max(1.0);
        #[expect(clippy::cast_possible_truncation, reason = "clamped")]
        let gray = (part.clamp(0.0, 1.0) * 255.0).round() as u8;
        gray
    };
    let pixels = section.values.iter().flat_map(|value| match value {
        0 => [0, 0],
        value => [gray(*value), 255],
    });
    let pixels: Vec<u8> = pixels.collect();
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, section.size.x, section.size.y);
    encoder.set_color(png::ColorType::GrayscaleAlpha);
    encoder.set_depth(png::BitDepth::Eight);
    let written = encoder
        .write_header()
        .and_then(|mut writer| writer.write_image_data(&pixels));
    written.expect("memory takes every picture of the size it was given");
    file
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use saccade_source::memory::ArraySource;

    #[test]
    fn the_middle_comes_first_and_nothing_twice() {
        assert_eq!(outwards(2, 5).collect::<Vec<_>>(), [2, 3, 1, 4, 0]);
        assert_eq!(outwards(0, 3).collect::<Vec<_>>(), [0, 1, 2]);
        assert_eq!(outwards(3, 4).collect::<Vec<_>>(), [3, 2, 1, 0]);
        assert_eq!(outwards(0, 0).count(), 0);
    }

    fn pixels(file: &[u8]) -> (UVec2, Vec<[u8; 2]>) {
        let mut reader = png::Decoder::new(std::io::Cursor::new(file))
            .read_info()
            .unwrap();
        let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut bytes).unwrap();
        assert_eq!(info.color_type, png::ColorType::GrayscaleAlpha);
        let pixels = bytes.chunks(2).map(|p| [p[0], p[1]]).collect();
        (UVec2::new(info.width, info.height), pixels)
    }

    /// Only the first sections were acquired, and of them the left half.
    #[test]
    fn it_shows_what_there_is_and_leaves_out_what_there_is_not() {
        let extent = UVec3::new(70, 45, 40);
        let mut volume = Volume::new("em", extent, DVec3::ONE).unwrap();
        volume.chunk = UVec3::new(32, 16, 8);
        let value = |v: UVec3| {
            let value = u8::try_from(v.x + v.y).unwrap_or(255) + 50;
            if v.z < 3 && v.x < 35 { value } else { 0 }
        };
        let voxels = VoxelBox::of_size(extent).iter().map(value).collect();
        let source = Arc::new(ArraySource::new(volume, voxels).unwrap());
        let runtime = tokio::runtime::Builder::new_current_thread()
            .build()
            .unwrap();
        let section = runtime.block_on(async {
            let published = Arc::new(Published::new(source, None));
            section(published).await.unwrap().unwrap()
        });
        let (size, pixels) = pixels(&png(&section));
        assert_eq!(size, UVec2::new(70, 45), "level 0 is small enough");
        let at = |x: usize, y: usize| pixels[y * 70 + x];
        assert_eq!(at(35, 0), [0, 0], "nothing was acquired there");
        assert_eq!((at(0, 0), at(34, 44)), ([0, 255], [255, 255]));
        let row: Vec<u8> = (0..35).map(|x| at(x, 20)[0]).collect();
        assert!(row.is_sorted() && row[34] > row[0] + 90, "{row:?}");
    }

    #[test]
    fn large_volumes_are_shown_from_afar() {
        let of = |extent| level(&Volume::new("v", extent, DVec3::ONE).unwrap());
        assert_eq!(of(UVec3::new(256, 10, 900)), 0);
        assert_eq!(of(UVec3::new(257, 10, 900)), 1);
        assert_eq!(of(UVec3::new(10, 4096, 10)), 4);
    }
}
