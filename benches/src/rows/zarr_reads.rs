//! Random reads of a sharded OME-Zarr, beside tensorstore's of the same files.
//!
//! Each opens the image anew and reads the same cubes, all of them asked for at once, turn by turn, from the
//! page cache. Sums of the voxels must agree. Besides, what it costs to check a checksum of each chunk: the same image,
//! written with and without.

use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result, bail, ensure};
use futures::future::join_all;
use glam::UVec3;
use saccade_source::zarr::ZarrSource;
use saccade_source::{Chunk, ChunkId, VolumeSource};
use serde::Deserialize;

use crate::clock::Stopwatch;
use crate::cpu;
use crate::report::Row;

pub(crate) const IDS: &[&str] = &[
    "zarr.random_read.vs_tensorstore",
    "zarr.random_read.mvoxel_per_s",
    "zarr.random_read.checksums",
];

const SCRIPT: &str = include_str!("zarr_reads.py");
/// Edges of the image, its shards, its chunks \[voxels\].
const EDGE: u32 = 512;
const SHARD: u32 = 256;
const CHUNK: u32 = 64;
/// Cubes of 64 voxels that are read.
const READS: u32 = 300;
const RUNS: u32 = 7;
/// Reads with and without checksums in a run: what is beside them on the machine hits neither of the least.
const PAIRS: u32 = 3;

#[derive(Deserialize)]
struct Peer {
    seconds: f64,
    sum: u64,
}

pub(crate) fn measure() -> Result<Vec<Row>> {
    let work = tempfile::tempdir()?;
    let [folder, checked] = ["image.zarr", "checked.zarr"].map(|name| work.path().join(name));
    let mut arguments = [EDGE, SHARD, CHUNK].map(|n| n.to_string()).to_vec();
    std::fs::create_dir(&folder)?;
    tensorstore("write", &folder, &arguments)?;
    arguments.push("checked".to_owned());
    std::fs::create_dir(&checked)?;
    tensorstore("write", &checked, &arguments)?;
    let runtime = tokio::runtime::Runtime::new()?;
    let (mut ratios, mut speeds, mut costs) = (Vec::new(), Vec::new(), Vec::new());
    for run in 0..RUNS {
        let chunks = chunks(run);
        let positions = chunks.iter().map(|chunk| {
            let [x, y, z] = (*chunk * CHUNK).to_array();
            format!("{x},{y},{z}")
        });
        let theirs = tensorstore("read", &folder, &positions.collect::<Vec<_>>())?;
        let theirs: Peer =
            serde_json::from_slice(&theirs).context("the peer's script said nonsense")?;
        let (seconds, sum) = runtime.block_on(read(&folder, &chunks))?;
        ensure!(sum == theirs.sum, "voxels differ: {sum} and {}", theirs.sum);
        ratios.push(theirs.seconds / seconds);
        speeds.push(f64::from(READS) * f64::from(CHUNK).powi(3) / 1e6 / seconds);
        costs.push(checked_over_plain(
            &runtime,
            [&folder, &checked],
            &chunks,
            run,
        )?);
    }
    let peer = "tensorstore (PyPI), zarr3, cache_pool of 512 MiB, its own threads";
    let rows = [
        Row::new(IDS[0], "times as fast", ratios).setting("peer", peer),
        Row::new(IDS[1], "Mvoxel/s", speeds).setting("peer", peer),
        Row::new(IDS[2], "times the processor time", costs).setting(
            "compared",
            format!("crc32c of each chunk behind its zstd, with none; {PAIRS} of each in turn, the least of each"),
        ),
    ];
    let described = rows.into_iter().map(|row| {
        row.setting("image", format!("{EDGE}^3 of 8 bit, shards of {SHARD}^3, chunks of {CHUNK}^3, zstd 3, crc32c of indices"))
            .setting("reads", format!("{READS} chunks of {CHUNK}^3 at random, all asked for at once; opened anew each time"))
    });
    Ok(described.collect())
}

/// How much more processor time, whoever else has the machine, the same reads take where each chunk has a checksum.
fn checked_over_plain(
    runtime: &tokio::runtime::Runtime,
    folders: [&Path; 2],
    chunks: &[UVec3],
    run: u32,
) -> Result<f64> {
    let mut least = [f64::INFINITY; 2];
    let mut sums = [0; 2];
    for pair in 0..PAIRS {
        // Now the one goes first, now the other.
        for n in [(run + pair) % 2, (run + pair + 1) % 2].map(|n| n as usize) {
            let before = cpu::of_threads()?;
            let (_, sum) = runtime.block_on(read(folders[n], chunks))?;
            let spent = cpu::of_threads()?.saturating_sub(before);
            least[n] = least[n].min(spent.as_secs_f64());
            sums[n] = sum;
        }
    }
    ensure!(sums[0] == sums[1], "voxels differ: {sums:?}");
    Ok(least[1] / least[0])
}

/// Different chunks in a random order, another for each run.
fn chunks(run: u32) -> Vec<UVec3> {
    let per_axis = EDGE / CHUNK;
    let mut all: Vec<u32> = (0..per_axis.pow(3)).collect();
    // Sorted by a hash: random enough, and the same in every measurement.
    all.sort_by_key(|n| {
        (n + run * 7919 + 1)
            .wrapping_mul(0x9e37_79b9)
            .rotate_left(run + 7)
            .wrapping_mul(0x85eb_ca6b)
    });
    let chunk = |n: &u32| {
        UVec3::new(
            n % per_axis,
            n / per_axis % per_axis,
            n / per_axis / per_axis,
        )
    };
    all.iter().take(READS as usize).map(chunk).collect()
}

/// Seconds, and the sum of all voxels.
async fn read(folder: &Path, chunks: &[UVec3]) -> Result<(f64, u64)> {
    let watch = Stopwatch::start();
    let source = ZarrSource::open_folder(folder).await?;
    ensure!(
        source.volume().chunk == UVec3::splat(CHUNK),
        "a cube is a chunk of ours"
    );
    let read = |chunk: &UVec3| {
        source.read(ChunkId {
            channel: 0,
            level: 0,
            chunk: *chunk,
        })
    };
    let cubes = join_all(chunks.iter().map(read)).await;
    let seconds = watch.elapsed().as_secs_f64();
    let mut sum = 0;
    for cube in cubes {
        if let Chunk::Voxels(voxels) = cube? {
            sum += voxels.iter().map(|voxel| u64::from(*voxel)).sum::<u64>();
        }
    }
    Ok((seconds, sum))
}

fn tensorstore(what: &str, folder: &Path, more: &[String]) -> Result<Vec<u8>> {
    let python = std::env::var("SACCADE_BENCH_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let ran = Command::new(&python)
        .args(["-c", SCRIPT, what])
        .arg(folder)
        .args(more)
        .output()
        .with_context(|| format!("cannot run {python}; `./dev bench` sets it up"))?;
    if !ran.status.success() {
        bail!(
            "tensorstore did not run; `./dev bench` installs it: {}",
            String::from_utf8_lossy(&ran.stderr)
        );
    }
    Ok(ran.stdout)
}
