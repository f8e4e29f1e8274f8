//! What a second ingest worker is worth, with the catalog in a file and on a server.
//!
//! A worker is a process of its own that has one thread for pyramids, as a machine with one core would. One
//! takes in all tiles, then two share the same ones, turn by turn.

use std::path::Path;
use std::process::{Child, Command};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use glam::{DVec2, UVec2};
use saccade_archive::VisualizationArchive;
use saccade_archive::catalog::{Catalog, CatalogLocation};
use saccade_archive::storage::LocalStorage;
use saccade_core::transform::SectionFromTile;
use saccade_ingest::{Cancel, ingest};

use super::runtime;
use crate::clock::Stopwatch;
use crate::report::Row;
use crate::scene::{Microscope, NAME, tissue};

#[allow(dead_code, reason = "tests also kill it")]
#[path = "../../../crates/saccade-archive/tests/support/postgres.rs"]
#[allow(
    clippy::unwrap_used,
    reason = "a server that does not start ends the benchmark"
)]
mod postgres;

pub(crate) const IDS: &[&str] = &[
    "ingest.two_workers_speedup",
    "ingest.two_workers_speedup.postgres",
];

/// Edge of a tile \[pixels\].
const EDGE: u32 = 4096;
/// Along x and y. So many that how workers start, and that one ends before the other, are a few hundredths of it.
const SIDES: UVec2 = UVec2::new(12, 8);
const RUNS: usize = 5;

/// What a worker is told: acquisition, archive and, on a server, catalog.
const WORKER: [&str; 3] = [
    "SACCADE_BENCH_ACQUISITION",
    "SACCADE_BENCH_ARCHIVE",
    "SACCADE_BENCH_CATALOG",
];

/// Works, if this process was started as a worker.
pub(crate) fn worker() -> Option<Result<()>> {
    let [acquisition, archive, catalog] = WORKER.map(|name| std::env::var(name).ok());
    let (acquisition, archive) = (acquisition?, archive?);
    Some(work(
        Path::new(&acquisition),
        Path::new(&archive),
        catalog.as_deref(),
    ))
}

fn work(acquisition: &Path, archive: &Path, catalog: Option<&str>) -> Result<()> {
    runtime()?.block_on(async {
        let archive = open(archive, catalog).await?;
        let options = ingest::IngestOptions {
            once: true,
            workers: 1,
            // Who has nothing left to do sees at once that all is done.
            poll: Duration::from_millis(20),
            ..Default::default()
        };
        ingest::run(acquisition, &archive, &options, &(), &Cancel::new()).await?;
        archive.catalog().close().await;
        Ok(())
    })
}

async fn open(folder: &Path, catalog: Option<&str>) -> Result<VisualizationArchive> {
    let Some(url) = catalog else {
        return Ok(VisualizationArchive::create(folder).await?);
    };
    let catalog = Catalog::create(&CatalogLocation::parse(url)).await?;
    let storage = Arc::new(LocalStorage::new(folder)?);
    Ok(VisualizationArchive::from_parts(catalog, storage))
}

fn start(acquisition: &Path, archive: &Path, catalog: Option<&str>) -> Result<Child> {
    let mut command = Command::new(std::env::current_exe()?);
    command.env(WORKER[0], acquisition).env(WORKER[1], archive);
    if let Some(url) = catalog {
        command.env(WORKER[2], url);
    }
    command
        .env("RAYON_NUM_THREADS", "1")
        .spawn()
        .context("a worker cannot be started")
}

/// Seconds that so many workers take.
fn take_in(workers: usize, acquisition: &Path, catalog: Option<&str>) -> Result<f64> {
    let folder = tempfile::tempdir()?;
    let archive = folder.path().join("archive");
    // Made before, so that all begin with the tiles.
    let made = async {
        let archive = open(&archive, catalog).await?;
        archive.catalog().close().await;
        Ok::<_, anyhow::Error>(())
    };
    runtime()?.block_on(made)?;
    let start_all = Stopwatch::start();
    let running = (0..workers).map(|_| start(acquisition, &archive, catalog));
    let running: Vec<_> = running.collect::<Result<_>>()?;
    for mut worker in running {
        ensure!(worker.wait()?.success(), "a worker failed");
    }
    let seconds = start_all.elapsed().as_secs_f64();
    let tiles = runtime()?.block_on(async {
        let archive = open(&archive, catalog).await?;
        Ok::<_, anyhow::Error>(archive.catalog().entry(NAME).await?.tiles)
    })?;
    ensure!(
        tiles == u64::from(SIDES.element_product()),
        "{tiles} tiles were taken in"
    );
    Ok(seconds)
}

pub(crate) fn measure() -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let acquisition = folder.path().join("acquisition");
    let mut microscope = Microscope::start(&acquisition, (SIDES * EDGE).extend(2))?;
    let pixels = tissue(EDGE, 0)?;
    for y in 0..SIDES.y {
        for x in 0..SIDES.x {
            let tile = format!("y{y}x{x}");
            microscope.write_image(&tile, EDGE, &pixels)?;
            let at: DVec2 = (UVec2::new(x, y) * EDGE).as_dvec2();
            microscope.announce(&tile, 0, EDGE, SectionFromTile::translation(at))?;
        }
    }
    let server = postgres::Server::start(&[]);
    let mut rows = Vec::new();
    for (id, server) in [(IDS[0], None), (IDS[1], server.as_ref())] {
        if id == IDS[1] && server.is_none() {
            continue;
        }
        let (mut runs, mut seconds) = (Vec::new(), Vec::new());
        for _ in 0..RUNS {
            let catalog = || {
                server.map(|server| {
                    runtime()?.block_on(async { anyhow::Ok(server.database().await) })
                })
            };
            let one = take_in(1, &acquisition, catalog().transpose()?.as_deref())?;
            let two = take_in(2, &acquisition, catalog().transpose()?.as_deref())?;
            runs.push(one / two);
            seconds.push(format!("{one:.1} and {two:.1}"));
        }
        let row = Row::new(id, "times as fast", runs)
            .setting(
                "tiles",
                format!(
                    "{} of {EDGE}x{EDGE}, tissue with noise, uncompressed TIFF",
                    SIDES.element_product()
                ),
            )
            .setting(
                "worker",
                "a process with one thread for pyramids, start included",
            )
            .setting("seconds of one and of two", seconds.join("; "));
        rows.push(row);
    }
    Ok(rows)
}
