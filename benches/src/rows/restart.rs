//! How long the first overview takes of a server that starts again: the coarse levels, none of whose blocks are kept on disk, made of
//! what is.
//!
//! All tiles show the same image: their pyramids are links to a few files, so that there can be many.

use std::fs;
use std::path::Path;

use anyhow::{Result, ensure};
use futures::stream::{self, StreamExt, TryStreamExt};
use glam::{UVec2, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_archive::image::Gray;
use saccade_archive::pyramid::{Encoding, encode};
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_source::stitched::{DiskCache, StitchedOptions, StitchedSource};
use saccade_source::{Chunk, ChunkId, VolumeSource};
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection};

use super::runtime;
use crate::clock::Stopwatch;
use crate::report::Row;
use crate::scene::{NAME, VOXEL_NM, tissue};

pub(crate) const IDS: &[&str] = &["restart.overview_s"];

const EDGE: u32 = 12_000;
const PITCH: u32 = 10_800;
/// Tiles along x and y of a section.
const SIDE: u32 = 5;
const SECTIONS: u32 = 4000;
/// Of names, a file may have no more.
const LINKS: u32 = 50_000;
const RUNS: usize = 3;
/// Chunks asked for at the same time.
const AT_ONCE: usize = 8;
/// The sections that a voxel spans in the levels that are measured, more than in any of which blocks are kept.
const SPAN: f64 = 16.0;

pub(crate) fn measure() -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    runtime()?.block_on(async {
        let archive = make(&folder.path().join("archive")).await?;
        let kept = folder.path().join("kept");
        let (mut without, mut with) = (Vec::new(), Vec::new());
        // The first one with a cache on disk fills it.
        for run in 0..=RUNS {
            for (runs, cache) in [(&mut without, None), (&mut with, Some(&*kept))] {
                let overview = overview(&archive, cache).await?;
                if run > 0 {
                    runs.push(overview);
                }
            }
        }
        let seconds = |runs: &[Overview], of: fn(&Overview) -> f64| {
            let runs = runs.iter().map(|run| format!("{:.3}", of(run)));
            runs.collect::<Vec<_>>().join(", ")
        };
        let (last, first) = (&with[with.len() - 1], &without[without.len() - 1]);
        ensure!(last.opened == 0, "{} pyramids were opened", last.opened);
        let row = Row::new(IDS[0], "s", with.iter().map(|run| run.all).collect())
            .setting("volume", format!("{} tiles of {EDGE}x{EDGE}, {} in each of {SECTIONS} sections", SECTIONS * SIDE * SIDE, SIDE * SIDE))
            .setting("overview", format!("all {} levels whose voxels span more than {SPAN} sections, coarsest first: {:.1} Mvoxel", last.levels, last.voxels as f64 / 1e6))
            .setting("kept on disk", format!("coarsest levels of {} pyramids", last.from_disk))
            .setting("coarsest level alone", seconds(&with, |run| run.coarsest))
            .setting("without a cache on disk", seconds(&without, |run| run.all))
            .setting("without, coarsest level alone", seconds(&without, |run| run.coarsest))
            .setting("without, pyramids opened", first.opened)
            .setting("caches", "source newly opened; files in the system's file cache");
        Ok(vec![row])
    })
}

struct Overview {
    /// Until the coarsest level was there, and all were \[s\].
    coarsest: f64,
    all: f64,
    levels: usize,
    voxels: u64,
    opened: u64,
    from_disk: u64,
}

async fn overview(archive: &VisualizationArchive, cache: Option<&Path>) -> Result<Overview> {
    let disk_cache = match cache {
        Some(folder) => Some(DiskCache::open(folder, 4 << 30).await?),
        None => None,
    };
    let options = StitchedOptions {
        disk_cache: disk_cache.clone(),
        ..StitchedOptions::default()
    };
    let start = Stopwatch::start();
    let source = StitchedSource::open(archive, NAME, options).await?;
    let volume = source.volume().clone();
    let levels = 0..u32::try_from(volume.levels.len())?;
    let levels = levels.zip(&volume.levels).rev();
    let levels: Vec<_> = levels
        .take_while(|(_, l)| l.downsampling.z > SPAN)
        .collect();
    let (mut coarsest, mut voxels) = (None, 0);
    for (level, _) in &levels {
        voxels += read(&source, *level).await?;
        coarsest.get_or_insert(start.elapsed().as_secs_f64());
    }
    let all = start.elapsed().as_secs_f64();
    let statistics = source.statistics();
    drop(source);
    if let Some(cache) = disk_cache {
        cache.close().await;
    }
    Ok(Overview {
        coarsest: coarsest.unwrap_or_default(),
        all,
        levels: levels.len(),
        voxels,
        opened: statistics.pyramids_opened,
        from_disk: statistics.thumbnails_from_disk,
    })
}

/// Reads a level. Returns its voxels, all of which must have been acquired.
async fn read(source: &StitchedSource, level: u32) -> Result<u64> {
    let volume = source.volume();
    let chunks = VoxelBox::of_size(volume.chunks(level as usize)).iter();
    let ids = chunks.map(|chunk| ChunkId {
        channel: 0,
        level,
        chunk,
    });
    let reads = stream::iter(ids.map(|id| async move { source.read(id).await }));
    let chunks: Vec<Chunk> = reads.buffer_unordered(AT_ONCE).try_collect().await?;
    let all_there = !chunks.iter().any(|chunk| matches!(chunk, Chunk::Empty));
    ensure!(all_there, "chunks of level {level} are empty");
    Ok(VoxelBox::of_size(volume.levels[level as usize].extent).voxels())
}

/// An archive as ingest would leave it, apart from its changes, which nobody has to catch up with.
async fn make(folder: &Path) -> Result<VisualizationArchive> {
    let extent =
        UVec2::splat(SIDE * PITCH).extend(SECTIONS) + UVec3::new(EDGE - PITCH, EDGE - PITCH, 0);
    let archive = VisualizationArchive::create(folder).await?;
    let volume = Volume::new(NAME, extent, VOXEL_NM)?;
    archive.catalog().create_volume(&volume).await?;
    archive.catalog().close().await;
    let image = Gray::new(EDGE, EDGE, tissue(EDGE, 0)?);
    let pyramid = encode(&image, &Encoding::Jpeg { quality: 85 })?;
    let tiles = folder.join("tiles");
    fs::create_dir_all(&tiles)?;
    for n in 0..SECTIONS * SIDE * SIDE {
        let file = tiles.join(format!("{n}.tif"));
        match n % LINKS {
            0 => fs::write(file, &pyramid)?,
            of => fs::hard_link(tiles.join(format!("{}.tif", n - of)), file)?,
        }
    }
    let file = folder.join(VisualizationArchive::CATALOG);
    let mut connection = SqliteConnectOptions::new().filename(file).connect().await?;
    let insert = "INSERT INTO tiles (volume, name, section, width, height, a, b, c, d, tx, ty, pyramid, \
                  revision, position, transform_position) \
                  WITH RECURSIVE tiles (n) AS (SELECT 0 UNION ALL SELECT n + 1 FROM tiles WHERE n + 1 < ?1 * ?2 * ?2) \
                  SELECT (SELECT id FROM volumes), 't' || n, n / (?2 * ?2), ?3, ?3, 1.0, 0.0, 0.0, 1.0, \
                  n % ?2 * ?4, n / ?2 % ?2 * ?4, 'tiles/' || n || '.tif', n + 1, n, n FROM tiles";
    let insert = sqlx::query(insert).bind(SECTIONS).bind(SIDE);
    insert
        .bind(EDGE)
        .bind(PITCH)
        .execute(&mut connection)
        .await?;
    for count in [
        "UPDATE volumes SET tiles = (SELECT count(*) FROM tiles), revision = (SELECT max(revision) FROM tiles)",
        "INSERT INTO sections (volume, section, tiles) \
         SELECT volume, section, count(*) FROM tiles GROUP BY volume, section",
    ] {
        sqlx::query(count).execute(&mut connection).await?;
    }
    connection.close().await?;
    Ok(VisualizationArchive::open(folder).await?)
}
