//! A petabyte's worth of tiles: how long opening takes, finding, and how much memory.
//!
//! The catalog is made in bulk, without pyramids, and kept for later runs: its making is not measured.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use glam::{DVec2, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_core::transform::SectionPoint;
use saccade_core::volume::Volume;
use saccade_source::VolumeSource;
use saccade_source::stitched::{StitchedOptions, StitchedSource};
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection};

use super::runtime;
use crate::clock::Stopwatch;
use crate::report::Row;
use crate::scene::{NAME, Random, VOXEL_NM, drop_from_cache};

pub(crate) const IDS: &[&str] = &["index.bytes_per_tile", "index.open_7m_s", "index.query_us"];

/// Tiles along x and y of a section.
const GRID: (u32, u32) = (25, 14);
const SECTIONS: u32 = 20_000;
const EDGE: u32 = 12_000;
const PITCH: u32 = 10_800;
const RUNS: usize = 5;
/// Sections that boxes are asked for in, once they are loaded.
const LOADED: u32 = 1000;
const QUERIES: u32 = 200_000;
/// Edge of a box \[level-0 voxels\].
const BOX: u32 = 512;

pub(crate) fn measure() -> Result<Vec<Row>> {
    let folder = archive_folder()?;
    runtime()?.block_on(async {
        if !folder.is_dir() {
            make(&folder).await?;
        }
        let mut random = Random(2_463_534_242);
        let mut open = Vec::new();
        for _ in 0..RUNS {
            drop_from_cache(&folder)?;
            let start = Stopwatch::start();
            let source = open_source(&folder).await?;
            let z = random.below(SECTIONS);
            let found = source.index().section(z).await?.touching(SectionPoint(DVec2::ZERO), SectionPoint(DVec2::splat(f64::from(BOX))));
            open.push(start.elapsed().as_secs_f64());
            ensure!(!found.is_empty(), "section {z} has no tile at its corner");
        }
        let source = open_source(&folder).await?;
        let extent = source.volume().extent();
        let index = source.index();
        let (before, resident) = (index.bytes(), resident()?);
        let mut loaded = Vec::new();
        let start = Stopwatch::start();
        for n in 0..LOADED {
            loaded.push(n * (SECTIONS / LOADED));
            index.section(loaded[n as usize]).await?;
        }
        let section_ms = start.elapsed().as_secs_f64() * 1e3 / f64::from(LOADED);
        let tiles = index.tiles();
        ensure!(tiles == u64::from(LOADED * GRID.0 * GRID.1), "{tiles} tiles are indexed");
        let bytes = (index.bytes() - before) as f64 / tiles as f64;
        let grown = (self::resident()? - resident) as f64 / tiles as f64;
        let mut query = Vec::new();
        let mut found = 0_usize;
        for _ in 0..RUNS {
            let start = Stopwatch::start();
            for _ in 0..QUERIES {
                let z = loaded[random.below(LOADED) as usize];
                let min = DVec2::new(
                    f64::from(random.below(extent.x - BOX)),
                    f64::from(random.below(extent.y - BOX)),
                );
                let max = min + f64::from(BOX);
                let section = index.section(z).await?;
                found += section.touching(SectionPoint(min), SectionPoint(max)).len();
            }
            query.push(start.elapsed().as_secs_f64() * 1e6 / f64::from(QUERIES));
        }
        let per_box = found as f64 / (RUNS as f64 * f64::from(QUERIES));
        ensure!(per_box >= 1.0, "boxes have {per_box} tiles");
        let catalog = fs::metadata(folder.join(VisualizationArchive::CATALOG))?.len();
        let rows = [
            Row::new(IDS[0], "bytes", vec![bytes])
                .peer(1140.0, "Hadwiger et al. 2012, section 8.4.2: 13.3 MB for 11,689 tiles, an index of sub-tiles included")
                .setting("counted", "all that is kept of tiles whose pyramid is not open")
                .setting("growth of the process", format!("{grown:.0} bytes per tile")),
            Row::new(IDS[1], "s", open)
                .setting("from", "nothing: archive, catalog, volume, first box of a random section")
                .setting("catalog", format!("{:.1} GB, dropped from the system's file cache", catalog as f64 / 1e9)),
            Row::new(IDS[2], "us", query)
                .setting("box", format!("{BOX}x{BOX} at random in one of {LOADED} loaded sections, {per_box:.1} tiles on average"))
                .setting("loading a section", format!("{section_ms:.1} ms")),
        ];
        let volume = format!("{} tiles of {EDGE}x{EDGE}, {} in each of {SECTIONS} sections", SECTIONS * GRID.0 * GRID.1, GRID.0 * GRID.1);
        Ok(rows.map(|row| row.setting("volume", volume.clone())).into())
    })
}

async fn open_source(folder: &Path) -> Result<StitchedSource> {
    let archive = VisualizationArchive::open(folder).await?;
    Ok(StitchedSource::open(&archive, NAME, StitchedOptions::default()).await?)
}

/// Memory of this process \[bytes\].
pub(super) fn resident() -> Result<u64> {
    let status = fs::read_to_string("/proc/self/status").context("memory needs /proc")?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.trim().strip_suffix(" kB"));
    let kib: u64 = kib
        .context("/proc/self/status has an unknown form")?
        .parse()?;
    Ok(kib * 1024)
}

fn archive_folder() -> Result<PathBuf> {
    Ok(cache_folder()?.join("bench/seven-million-tiles-2"))
}

/// Where builds and what rows keep for later runs are.
pub(super) fn cache_folder() -> Result<PathBuf> {
    let set = |name| std::env::var_os(name).map(PathBuf::from);
    let home = || Some(set("HOME")?.join(".cache"));
    let user = || Some(set("XDG_CACHE_HOME").or_else(home)?.join("saccade"));
    set("SACCADE_CACHE")
        .or_else(user)
        .context("there is no HOME")
}

/// A catalog as ingest would leave it, apart from its changes, which nobody has to catch up with.
async fn make(folder: &Path) -> Result<()> {
    let unfinished = folder.with_extension("unfinished");
    let _ = fs::remove_dir_all(&unfinished);
    let file = unfinished.join(VisualizationArchive::CATALOG);
    let extent = UVec3::new(GRID.0 * PITCH, GRID.1 * PITCH, SECTIONS);
    let archive = VisualizationArchive::create(&unfinished).await?;
    let catalog = archive.catalog();
    catalog
        .create_volume(&Volume::new(NAME, extent, VOXEL_NM)?)
        .await?;
    catalog.close().await;
    let mut connection = SqliteConnectOptions::new()
        .filename(&file)
        .connect()
        .await?;
    // Nobody else sees it before it is whole.
    for pragma in [
        "PRAGMA journal_mode = OFF",
        "PRAGMA synchronous = OFF",
        "PRAGMA cache_size = -400000",
    ] {
        sqlx::query(pragma).execute(&mut connection).await?;
    }
    // Turned by up to 0.02 about the corner, as little as makes no difference to lengths.
    let insert = "INSERT INTO tiles (volume, name, section, width, height, a, b, c, d, tx, ty, pyramid, \
                  revision, position, transform_position) \
                  WITH RECURSIVE \
                  sections (z) AS (SELECT 0 UNION ALL SELECT z + 1 FROM sections WHERE z + 1 < ?1), \
                  tiles (n) AS (SELECT 0 UNION ALL SELECT n + 1 FROM tiles WHERE n + 1 < ?2 * ?3), \
                  turned (z, n, e) AS (SELECT z, n, ((z * 350 + n) * 7919 % 4001 - 2000) / 100000.0 FROM sections CROSS JOIN tiles) \
                  SELECT (SELECT id FROM volumes), printf('s%05d_t%03d', z, n), z, ?4, ?4, 1.0, e, -e, 1.0, \
                  n % ?2 * ?5 - 600.0 + 5000.0 * e, n / ?2 * ?5 - 600.0 - 5000.0 * e, \
                  printf('tiles/s%05d/s%05d_t%03d-%016x.tif', z, z, n, z * 7919 + n), \
                  z * ?2 * ?3 + n + 1, z * ?2 * ?3 + n, z * ?2 * ?3 + n FROM turned";
    let insert = sqlx::query(insert).bind(SECTIONS).bind(GRID.0).bind(GRID.1);
    insert
        .bind(EDGE)
        .bind(PITCH)
        .execute(&mut connection)
        .await?;
    let counted = "UPDATE volumes SET tiles = (SELECT count(*) FROM tiles), revision = (SELECT max(revision) FROM tiles)";
    sqlx::query(counted).execute(&mut connection).await?;
    let sections = "INSERT INTO sections (volume, section, tiles) \
                    SELECT volume, section, count(*) FROM tiles GROUP BY volume, section";
    sqlx::query(sections).execute(&mut connection).await?;
    connection.close().await?;
    fs::rename(&unfinished, folder)?;
    Ok(())
}
