//! What it costs to make a tile ready, and to make one: beside the tools that laboratories would use.
//!
//! One raw tile, as an acquisition archive holds it: decoded, its pyramid made, encoded, written and
//! synced, its folder synced, the catalog committed. Other programs make a pyramid of the same file,
//! turn by turn, and sync nothing.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use glam::{DVec2, UVec2, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_core::transform::SectionFromTile;
use saccade_ingest::simulate::clock::SystemClock;
use saccade_ingest::simulate::stack::{PhantomStack, SectionFolder, Stack};
use saccade_ingest::simulate::{self, SimulateConfig};
use saccade_ingest::{Cancel, ingest};

use super::runtime;
use crate::clock::Stopwatch;
use crate::report::Row;
use crate::scene::{Microscope, VOXEL_NM, tissue, write_image};
use crate::{cpu, memory};

pub(crate) const IDS: &[&str] = &[
    "ingest.mpix_per_core_s",
    "ingest.vs_tiffsave",
    "ingest.vs_dzsave",
];

pub(crate) const SUSTAINED_IDS: &[&str] = &[
    "ingest.sustained_mpix_s",
    "ingest.start_s",
    "ingest.stored_over_raw",
];

pub(crate) const MEMORY_IDS: &[&str] = &["ingest.peak_memory_tiles"];

pub(crate) const SIMULATE_IDS: &[&str] = &["simulate.mpix_per_s", "simulate.phantom.mpix_per_s"];

/// Edge of a tile \[pixels\].
const EDGE: u32 = 12_000;
const MPIX: f64 = 144.0;
const RUNS: usize = 5;

/// Two tiles per worker, so that each has its next before its last is done.
const TILES_IN_MEMORY: u32 = 4;

/// Tiles that are taken in one after the other, so that starting does not count.
const SUSTAINED_TILES: u32 = 12;

/// Part of the tissue that the simulator images \[voxels\].
const SIMULATED: UVec3 = UVec3::new(8192, 8192, 2);

pub(crate) fn measure() -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let acquisition = folder.path().join("acquisition");
    let tile = acquire(&acquisition, 1)?;
    let vips = vips();
    let (mut ours, mut wall) = (Vec::new(), Vec::new());
    let (mut tiffsave, mut dzsave) = (Vec::new(), Vec::new());
    for run in 0..RUNS {
        let archive = folder.path().join(format!("archive{run}"));
        let (seconds, elapsed) = take_in(&acquisition, &archive)?;
        ours.push(MPIX / seconds);
        wall.push(format!("{:.0}", MPIX / elapsed));
        fs::remove_dir_all(&archive)?;
        if let Some(vips) = &vips {
            let out = folder.path().join("peer");
            fs::create_dir(&out)?;
            let theirs = |operation: &str, to: &str, options: &[&str]| {
                let mut command = Command::new(vips);
                command.arg(operation).arg(&tile).arg(out.join(to));
                processor_time_of(command.args(options))
            };
            tiffsave.push(theirs("tiffsave", "peer.tif", TIFFSAVE)? / seconds);
            dzsave.push(theirs("dzsave", "peer", DZSAVE)? / seconds);
            fs::remove_dir_all(&out)?;
        }
    }
    let described = |row: Row| {
        row.setting("tile", format!("{EDGE}x{EDGE}, 8 bit, tissue with noise, uncompressed TIFF"))
            .setting("encoding", format!("{:?}", ingest::IngestOptions::default().encoding))
            .setting(
                "time",
                "processor time, user and system: decoding, pyramid, encoding, durable writing, catalog",
            )
    };
    let mut rows = vec![
        described(Row::new(IDS[0], "Mpixel per core and second", ours))
            .peer(
                7.1,
                "Hadwiger et al. 2012, section 8.4.2: 85 Mpixel/s on a machine of 12 cores",
            )
            .setting(
                "wall clock",
                format!("{} Mpixel/s, one tile", wall.join(", ")),
            ),
    ];
    if let Some(vips) = vips {
        let version = Command::new(vips).arg("--version").output()?.stdout;
        let version = String::from_utf8_lossy(&version).trim().to_owned();
        for (id, runs, options) in [(IDS[1], tiffsave, TIFFSAVE), (IDS[2], dzsave, DZSAVE)] {
            let row = Row::new(id, "times as fast", runs);
            let peer = format!("{version}, {}", options.join(" "));
            rows.push(described(row).setting("peer", peer));
        }
    }
    Ok(rows)
}

/// A pyramid of the same sub-tiles and quality.
const TIFFSAVE: &[&str] = &[
    "--tile",
    "--pyramid",
    "--tile-width",
    "128",
    "--tile-height",
    "128",
    "--compression",
    "jpeg",
    "--Q",
    "85",
];

const DZSAVE: &[&str] = &[
    "--tile-size",
    "128",
    "--overlap",
    "0",
    "--suffix",
    ".jpg[Q=85]",
];

/// The program, if there is one.
fn vips() -> Option<PathBuf> {
    let named = std::env::var_os("SACCADE_VIPS").map_or_else(|| "vips".into(), PathBuf::from);
    let found = Command::new(&named).arg("--version").output().is_ok();
    found.then_some(named)
}

/// Processor time of a program, until it has ended \[s\].
fn processor_time_of(command: &mut Command) -> Result<f64> {
    let before = cpu::of_children()?;
    let output = command.output().context("cannot run vips")?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "vips failed: {said}");
    Ok((cpu::of_children()? - before).as_secs_f64())
}

/// An acquisition of so many tiles beside each other in z; the first one's file.
fn acquire(folder: &Path, tiles: u32) -> Result<PathBuf> {
    let mut microscope = Microscope::start(folder, UVec3::new(EDGE, EDGE, tiles))?;
    let image = tissue(EDGE, 0)?;
    for section in 0..tiles {
        let name = section.to_string();
        microscope.write_image(&name, EDGE, &image)?;
        let transform = SectionFromTile::translation(DVec2::ZERO);
        microscope.announce(&name, section, EDGE, transform)?;
    }
    Ok(folder.join("tiles/0.tif"))
}

/// Takes an acquisition in; processor time and wall-clock time \[s\].
fn take_in(acquisition: &Path, archive: &Path) -> Result<(f64, f64)> {
    let (before, start) = (cpu::time()?, Stopwatch::start());
    runtime()?.block_on(async {
        let archive = VisualizationArchive::create(archive).await?;
        let options = ingest::IngestOptions {
            once: true,
            poll: Duration::from_millis(5),
            ..Default::default()
        };
        let cancel = Cancel::new();
        let summary = ingest::run(acquisition, &archive, &options, &(), &cancel).await?;
        ensure!(summary.quarantined == 0, "a tile was refused");
        anyhow::Ok(())
    })?;
    let elapsed = start.elapsed().as_secs_f64();
    Ok(((cpu::time()? - before).as_secs_f64(), elapsed))
}

/// What a machine keeps up with, disk and all, and how long it takes to start.
pub(crate) fn measure_sustained() -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let [one, many] = ["one", "many"].map(|name| folder.path().join(name));
    acquire(&one, 1)?;
    acquire(&many, SUSTAINED_TILES)?;
    let (mut rates, mut starts, mut sizes) = (Vec::new(), Vec::new(), Vec::new());
    for run in 0..3 {
        let archive = folder.path().join(format!("archive{run}"));
        let (_, first) = take_in(&one, &archive)?;
        starts.push(first);
        fs::remove_dir_all(&archive)?;
        let (_, all) = take_in(&many, &archive)?;
        let mpix = MPIX * f64::from(SUSTAINED_TILES);
        rates.push(mpix / all);
        sizes.push(size_of(&archive)? as f64 / (mpix * 1e6));
        fs::remove_dir_all(&archive)?;
    }
    let described = |row: Row| {
        row.setting(
            "tiles",
            format!(
                "{SUSTAINED_TILES} of {EDGE}x{EDGE}, 8 bit, tissue with noise, uncompressed TIFF"
            ),
        )
        .setting(
            "encoding",
            format!("{:?}", ingest::IngestOptions::default().encoding),
        )
    };
    let what = "Hadwiger et al. 2012, section 8.4.2: sustained, all disk transfer included; machine of 12 cores";
    let [rate, start, size] = [rates, starts, sizes];
    Ok(vec![
        described(Row::new(SUSTAINED_IDS[0], "Mpixel/s", rate))
            .peer(85.0, what)
            .setting("time", "wall clock, all cores, from starting to the last tile made durable"),
        described(Row::new(SUSTAINED_IDS[1], "s", start)).setting(
            "time",
            "wall clock: an archive is made, a first tile of that size is read, taken in and made durable",
        ),
        described(Row::new(SUSTAINED_IDS[2], "bytes per byte of raw tiles", size)).peer(
            0.125,
            "Hadwiger et al. 2012, section 8.4.2: 210 GB of 11,689 tiles of 12,000x12,000, JPEG at 2 bit a pixel",
        ),
    ])
}

/// Bytes of all files below a folder.
fn size_of(folder: &Path) -> Result<u64> {
    let mut bytes = 0;
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        bytes += match entry.file_type()?.is_dir() {
            true => size_of(&entry.path())?,
            false => entry.metadata()?.len(),
        };
    }
    Ok(bytes)
}

pub(crate) fn measure_memory() -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let acquisition = folder.path().join("acquisition");
    acquire(&acquisition, TILES_IN_MEMORY)?;
    let workers = ingest::IngestOptions::default().workers;
    let mut runs = Vec::new();
    for run in 0..3 {
        let before = memory::reset_peak()?;
        let archive = folder.path().join(run.to_string());
        take_in(&acquisition, &archive)?;
        let grown = memory::peak()?.saturating_sub(before);
        runs.push(grown as f64 / (MPIX * 1e6 * workers as f64));
    }
    let row = Row::new(MEMORY_IDS[0], "tiles per worker", runs)
        .setting(
            "tiles",
            format!("{TILES_IN_MEMORY} of {EDGE}x{EDGE}, 8 bit, tissue with noise, uncompressed TIFF"),
        )
        .setting("workers", workers as u64)
        .setting(
            "memory",
            "highest resident memory of the process while it takes them in, less what it had before",
        );
    Ok(vec![row])
}

pub(crate) fn simulate() -> Result<Vec<Row>> {
    let sections = tempfile::tempdir()?;
    for section in 0..SIMULATED.z {
        let image = tissue(SIMULATED.x, section)?;
        let path = sections.path().join(format!("{section}.tif"));
        write_image(&path, SIMULATED.x, &image)?;
    }
    let (mut stack, mut phantom, mut tiles) = (Vec::new(), Vec::new(), 0);
    for seed in 1..4 {
        tiles = cut(&SectionFolder::open(sections.path())?, &mut stack)?;
        cut(&PhantomStack::new(seed, SIMULATED, VOXEL_NM)?, &mut phantom)?;
    }
    let described = |row: Row| {
        row.setting(
            "tiles",
            format!("{tiles} of 4096x4096, turned by 0.5 degrees"),
        )
        .setting("time", "wall clock, all cores: reading, cutting, writing")
    };
    Ok(vec![
        described(Row::new(SIMULATE_IDS[0], "Mpixel/s", stack))
            .peer(45.0, "Hadwiger et al. 2012, section 7; with all cores")
            .setting("tissue", "two registered sections of 8192x8192, TIFF files"),
        described(Row::new(SIMULATE_IDS[1], "Mpixel/s", phantom))
            .setting("tissue", "procedural, made as it is cut"),
    ])
}

/// Cuts a stack into tiles; adds the speed, and says how many there were.
fn cut(stack: &dyn Stack, mpix_per_s: &mut Vec<f64>) -> Result<u64> {
    let folder = tempfile::tempdir()?;
    let config = SimulateConfig {
        tile: UVec2::splat(4096),
        rate_mpixel_s: None,
        ..SimulateConfig::default()
    };
    let (clock, cancel) = (SystemClock, Cancel::new());
    let start = Stopwatch::start();
    let done = simulate::run(&config, stack, folder.path(), &clock, &cancel, &())?;
    mpix_per_s.push(done.pixels as f64 / 1e6 / start.elapsed().as_secs_f64());
    Ok(done.tiles)
}
