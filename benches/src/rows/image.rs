//! The renderer beside its baselines on an image that is named: a real volume instead of a formula.

use std::sync::Arc;

use anyhow::{Context as _, Result, ensure};
use futures::StreamExt as _;
use futures::stream;
use glam::{IVec3, UVec3};
use saccade_core::brick::{BRICK_BORDER, BRICK_EDGE, BRICK_STORED_EDGE, BrickId};
use saccade_core::volume::{Dtype, Volume};
use saccade_core::voxel_box::VoxelBox;
use saccade_render::{ChannelView, Gpu};
use saccade_source::objects::Location;
use saccade_source::{Chunk, ChunkId, VolumeSource, images};

use super::table_9_1::{Subject, beside_baselines};
use crate::bricks::{Bricks, ramp};
use crate::report::Row;
use crate::settings::Settings;

pub(crate) const IDS: &[&str] = &[
    "render.image.vs_page_tables",
    "render.image.vs_octree",
    "render.image.vs_sampled_page_tables",
    "render.image.vs_sampled_octree",
];

/// Most voxels of all channels of an image: all of them are kept in main memory.
const MOST_VOXELS: u64 = 1 << 31;
/// Chunks that are read at once.
const AT_ONCE: usize = 16;

/// Without an image, no rows.
pub(crate) fn measure(settings: &Settings) -> Result<Vec<Row>> {
    let Some(place) = &settings.image else {
        eprintln!("  left out: --image names none");
        return Ok(Vec::new());
    };
    let gpu = &pollster::block_on(Gpu::headless())?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?;
    let levels = runtime.block_on(async {
        let location: Location = place.parse()?;
        let image = images::open(&location).await?;
        Levels::read(&*image.source).await
    });
    let levels = levels.with_context(|| format!("reading {place}"))?;
    let channels = levels.channels();
    let subject = Subject {
        volume: &levels.volume,
        bricks: &levels,
        channels: &channels,
    };
    let rows = beside_baselines(gpu, &subject, settings.scale(gpu), IDS)?;
    let named = |row: Row| row.setting("image", levels.volume.name.clone());
    Ok(rows.into_iter().map(named).collect())
}

/// All levels of an image in main memory.
struct Levels {
    volume: Arc<Volume>,
    /// Bytes a voxel.
    bytes: usize,
    /// By channel and level, x fastest, little-endian; 0 where nothing was acquired.
    voxels: Vec<Vec<Vec<u8>>>,
}

impl Levels {
    async fn read(source: &dyn VolumeSource) -> Result<Self> {
        let volume = source.volume();
        let bytes = match volume.dtype {
            Dtype::Uint8 => 1,
            Dtype::Uint16 => 2,
            other => anyhow::bail!("the baselines draw 8 and 16 bit, this is {other:?}"),
        };
        let channels = u32::try_from(volume.channels.len())?;
        let voxels = VoxelBox::of_size(volume.extent()).voxels() * u64::from(channels);
        ensure!(
            voxels <= MOST_VOXELS,
            "{voxels} voxels are more than the {MOST_VOXELS} that are kept in main memory"
        );
        let mut levels = Self {
            volume: Arc::new(Volume::clone(volume)),
            bytes,
            voxels: Vec::new(),
        };
        for channel in 0..channels {
            let mut of_channel = Vec::new();
            for level in 0..u32::try_from(volume.levels.len())? {
                of_channel.push(levels.level(source, channel, level).await?);
            }
            levels.voxels.push(of_channel);
        }
        Ok(levels)
    }

    async fn level(&self, source: &dyn VolumeSource, channel: u32, level: u32) -> Result<Vec<u8>> {
        let volume = &self.volume;
        let extent = volume.levels[level as usize].extent;
        let mut voxels = vec![0; extent.as_usizevec3().element_product() * self.bytes];
        let chunks = VoxelBox::of_size(volume.chunks(level as usize));
        let read = chunks.iter().map(|chunk| async move {
            let id = ChunkId {
                channel,
                level,
                chunk,
            };
            Ok::<_, anyhow::Error>((id, source.read(id).await?))
        });
        let mut read = stream::iter(read).buffer_unordered(AT_ONCE);
        while let Some(chunk) = read.next().await {
            let (id, chunk) = chunk?;
            let (Some(place), Chunk::Voxels(values)) = (id.voxels(volume), chunk) else {
                continue;
            };
            let row = (place.max.x - place.min.x) as usize * self.bytes;
            for z in place.min.z..place.max.z {
                for y in place.min.y..place.max.y {
                    let at = UVec3::new(place.min.x, y, z);
                    let (from, to) = (
                        flat(at - place.min, volume.chunk) * self.bytes,
                        flat(at, extent) * self.bytes,
                    );
                    voxels[to..to + row].copy_from_slice(&values[from..from + row]);
                }
            }
        }
        Ok(voxels)
    }

    /// The brighter half of each channel's values, opaque from the brightest hundredth on.
    fn channels(&self) -> Vec<ChannelView> {
        let largest = if self.bytes == 1 { 255.0 } else { 65_535.0 };
        let nm = 4.0 * self.volume.voxel_nm.max_element();
        let views = (0..).zip(&self.voxels).map(|(channel, levels)| {
            let mut counts = vec![0_u64; 1 << (8 * self.bytes)];
            for value in levels[0].chunks_exact(self.bytes) {
                let high = value.get(1).copied().unwrap_or(0);
                counts[usize::from(u16::from_le_bytes([value[0], high]))] += 1;
            }
            // What was not acquired is no value.
            counts[0] = 0;
            let all: u64 = counts.iter().sum();
            let below = |share: f64| {
                let mut seen = 0;
                let at = counts.iter().position(|count| {
                    seen += count;
                    seen as f64 > share * all as f64
                });
                at.unwrap_or(0) as f32 / largest
            };
            let (low, high) = (below(0.5), below(0.99));
            ChannelView::new(channel, ramp(low, high.max(low + 1.0 / largest), 0.9, nm))
        });
        views.collect()
    }
}

impl Bricks for Levels {
    fn brick(&self, id: BrickId) -> Option<Vec<u8>> {
        let level = id.level() as usize;
        let extent = self.volume.levels[level].extent;
        let voxels = &self.voxels[id.channel() as usize][level];
        let low = (id.brick() * BRICK_EDGE).as_ivec3() - BRICK_BORDER.cast_signed();
        let cells = VoxelBox::of_size(UVec3::splat(BRICK_STORED_EDGE)).iter();
        let brick = cells.flat_map(|cell| {
            let at = (low + cell.as_ivec3()).clamp(IVec3::ZERO, extent.as_ivec3() - 1);
            let at = flat(at.as_uvec3(), extent) * self.bytes;
            voxels[at..at + self.bytes].iter().copied()
        });
        Some(brick.collect())
    }
}

fn flat(at: UVec3, extent: UVec3) -> usize {
    let (at, extent) = (at.as_usizevec3(), extent.as_usizevec3());
    (at.z * extent.y + at.y) * extent.x + at.x
}
