//! How long the blocks take that the paper builds bricks from: 512 x 512 x 32 voxels, at random places.
//!
//! Chunks of a block are asked for at once, as a view that needs them does; sub-tiles that they share are to be decoded once.

use anyhow::{Result, ensure};
use futures::future::try_join_all;
use glam::UVec3;
use saccade_archive::VisualizationArchive;
use saccade_core::voxel_box::VoxelBox;
use saccade_ingest::{Cancel, ingest};
use saccade_source::stitched::{StitchedOptions, StitchedSource};
use saccade_source::{Chunk, ChunkId, VolumeSource};

use super::runtime;
use crate::clock::Stopwatch;
use crate::cpu;
use crate::report::Row;
use crate::scene::{Mosaic, NAME, Random, drop_from_cache};

pub(crate) const IDS: &[&str] = &[
    "block.cold_ms",
    "block.cold_worst_ms",
    "bricks.scattered_per_core_s",
];

const MOSAIC: Mosaic = Mosaic {
    edge: 2048,
    side: 2,
    sections: 64,
};
/// Of a block \[voxels\].
const BLOCK: UVec3 = UVec3::new(512, 512, 32);
const BRICK: u64 = 32 * 32 * 32;
const RUNS: usize = 3;
const BLOCKS: u32 = 60;

pub(crate) fn measure() -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let acquisition = folder.path().join("acquisition");
    MOSAIC.acquire(&acquisition)?;
    let archive_folder = folder.path().join("archive");
    let (mut typical, mut worst, mut rates) = (Vec::new(), Vec::new(), Vec::new());
    runtime()?.block_on(async {
        let archive = VisualizationArchive::create(&archive_folder).await?;
        let options = ingest::IngestOptions {
            once: true,
            ..Default::default()
        };
        ingest::run(&acquisition, &archive, &options, &(), &Cancel::new()).await?;
        let mut random = Random(88_172_645_463_325_252);
        for _ in 0..RUNS {
            let (mut times, mut seconds) = (Vec::new(), 0.0);
            for _ in 0..BLOCKS {
                drop_from_cache(&archive_folder.join("tiles"))?;
                // Nothing that was built or decoded before is at hand.
                let options = StitchedOptions::default();
                let source = StitchedSource::open(&archive, NAME, options).await?;
                let extent = source.volume().extent();
                let free = (extent - BLOCK) / BLOCK;
                let place = UVec3::new(
                    random.below(free.x + 1),
                    random.below(free.y + 1),
                    random.below(free.z + 1),
                );
                let (start, before) = (Stopwatch::start(), cpu::time()?);
                build(&source, place * BLOCK).await?;
                seconds += (cpu::time()? - before).as_secs_f64();
                times.push(start.elapsed().as_secs_f64() * 1e3);
            }
            let bricks = u64::from(BLOCKS) * BLOCK.as_u64vec3().element_product() / BRICK;
            rates.push(bricks as f64 / seconds);
            worst.push(times.iter().copied().fold(0.0, f64::max));
            typical.push(Row::new("", "", times).value());
        }
        anyhow::Ok(())
    })?;
    let what = "Hadwiger et al. 2012, section 8.4.1: interleaved, machine of 12 cores, stitching on its GPU";
    let described = |row: Row| {
        row.setting(
            "blocks",
            format!("{BLOCKS} random ones of 512x512x32 at level 0"),
        )
        .setting(
            "tiles",
            format!(
                "{} of {}x{}, a tenth overlapping, turned by up to 3 degrees",
                MOSAIC.tiles(),
                MOSAIC.edge,
                MOSAIC.edge
            ),
        )
        .setting(
            "caches",
            "source newly opened; files dropped from the system's file cache before each",
        )
    };
    Ok(vec![
        described(Row::new(IDS[0], "ms, median of the blocks", typical)).peer(300.0, what),
        described(Row::new(IDS[1], "ms", worst)).peer(1700.0, what),
        described(Row::new(IDS[2], "bricks per core and second", rates))
            .peer(69.4, "Hadwiger et al. 2012, section 8.4.1: typically 1.2 ms per 32^3 voxels, whole machine of 12 cores, stitching on its GPU; per core a twelfth"),
    ])
}

/// Builds all chunks of the block that begins there.
async fn build(source: &StitchedSource, min: UVec3) -> Result<()> {
    let volume = source.volume();
    let block = VoxelBox::new(min, min + BLOCK);
    let chunk = volume.chunk;
    let chunks = VoxelBox::new(block.min / chunk, (block.max + chunk - 1) / chunk);
    let read = chunks.iter().map(|chunk| async move {
        let id = ChunkId {
            channel: 0,
            level: 0,
            chunk,
        };
        let chunk = source.read(id).await?;
        ensure!(!matches!(chunk, Chunk::Empty), "{id:?} is empty");
        Ok(())
    });
    try_join_all(read).await.map(drop)
}
