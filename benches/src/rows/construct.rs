//! What it costs to build chunks out of tiles: find, read, decode, stitch, resample.

use std::time::Duration;

use crate::clock::Stopwatch;
use anyhow::Result;
use futures::stream::{self, StreamExt, TryStreamExt};
use saccade_archive::VisualizationArchive;
use saccade_core::voxel_box::VoxelBox;
use saccade_ingest::{Cancel, ingest};
use saccade_source::stitched::{StitchedOptions, StitchedSource};
use saccade_source::{Chunk, ChunkId, VolumeSource};

use super::runtime;
use crate::cpu;
use crate::report::Row;
use crate::scene::{Mosaic, NAME, drop_from_cache};

pub(crate) const IDS: &[&str] = &[
    "construct.mpix_per_core_s",
    "construct.mpix_per_core_s.cold",
    "bricks.cold_per_core_s",
];

const MOSAIC: Mosaic = Mosaic {
    edge: 2048,
    side: 2,
    sections: 16,
};
const RUNS: usize = 3;
/// Chunks asked for at the same time.
const AT_ONCE: usize = 4;

pub(crate) fn measure() -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let acquisition = folder.path().join("acquisition");
    MOSAIC.acquire(&acquisition)?;
    let archive_folder = folder.path().join("archive");
    let (mut warm, mut cold) = (Vec::new(), Vec::new());
    let mut wall = [Duration::ZERO; 2];
    let runtime = runtime()?;
    runtime.block_on(async {
        let archive = VisualizationArchive::create(&archive_folder).await?;
        let options = ingest::IngestOptions {
            once: true,
            ..Default::default()
        };
        ingest::run(&acquisition, &archive, &options, &(), &Cancel::new()).await?;
        for _ in 0..RUNS {
            drop_from_cache(&archive_folder)?;
            for (runs, wall) in [&mut cold, &mut warm].into_iter().zip(&mut wall) {
                // A new source each time: nothing built before is at hand.
                let source =
                    StitchedSource::open(&archive, NAME, StitchedOptions::default()).await?;
                let (cpu_before, start) = (cpu::time()?, Stopwatch::start());
                let voxels = build_all(&source).await?;
                *wall += start.elapsed();
                runs.push(voxels as f64 / 1e6 / (cpu::time()? - cpu_before).as_secs_f64());
            }
        }
        anyhow::Ok(())
    })?;
    let extent = MOSAIC.extent();
    let mpix = f64::from(extent.x) * f64::from(extent.y) * f64::from(extent.z) / 1e6;
    // Bricks of 32^3 voxels, borders not counted: they come with the chunks.
    let bricks = cold.iter().map(|mpix| mpix * 1e6 / 32_768.0).collect();
    let bricks = Row::new(IDS[2], "bricks per core and second", bricks)
        .peer(69.4, "Hadwiger et al. 2012, section 8.4.1: typically 1.2 ms per 32^3 voxels, whole machine of 12 cores, stitching on its GPU; per core a twelfth")
        .setting("bricks", "32x32x32 voxels of level 0, from JPEG of quality 85")
        .setting("caches", "source newly opened; files dropped from the system's file cache");
    let rows = [
        (IDS[0], warm, wall[1], "in the system's file cache"),
        (
            IDS[1],
            cold,
            wall[0],
            "dropped from the system's file cache",
        ),
    ];
    let rows = rows.map(|(id, runs, wall, files)| {
        let rate = mpix * RUNS as f64 / wall.as_secs_f64();
        Row::new(id, "Mvoxel per core and second", runs)
            .peer(27.8, "Hadwiger et al. 2012, table 3: 512x512 in 9.42 ms at level 0, whole machine of 12 cores, stitching on its GPU")
            .setting("volume", format!("{}x{}x{}, level 0", extent.x, extent.y, extent.z))
            .setting("tiles", format!("{} of {}x{}, a tenth overlapping, turned by up to 3 degrees", MOSAIC.tiles(), MOSAIC.edge, MOSAIC.edge))
            .setting("caches", format!("source newly opened; files {files}"))
            .setting("requests at once", AT_ONCE)
            .setting("wall clock", format!("{rate:.0} Mvoxel/s on all cores"))
    });
    Ok(rows.into_iter().chain([bricks]).collect())
}

/// Builds all chunks of the finest level; returns the voxels of the volume they cover.
async fn build_all(source: &StitchedSource) -> Result<u64> {
    let volume = source.volume();
    let chunks = VoxelBox::of_size(volume.chunks(0)).iter();
    let ids = chunks.map(|chunk| ChunkId {
        channel: 0,
        level: 0,
        chunk,
    });
    stream::iter(ids)
        .map(|id| async move {
            let chunk = source.read(id).await?;
            let voxels = id.voxels(volume).map_or(0, |v| v.voxels());
            anyhow::Ok(if chunk == Chunk::Empty { 0 } else { voxels })
        })
        .buffer_unordered(AT_ONCE)
        .try_fold(0, |sum, voxels| async move { Ok(sum + voxels) })
        .await
}
