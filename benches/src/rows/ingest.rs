//! What it costs to make a tile ready: decode, pyramid, encoding, writing, catalog.

use std::time::Duration;

use crate::clock::Stopwatch;
use anyhow::{Result, ensure};
use saccade_archive::VisualizationArchive;
use saccade_ingest::{Cancel, ingest};

use super::runtime;
use crate::cpu;
use crate::report::Row;
use crate::scene::Mosaic;

pub(crate) const IDS: &[&str] = &["ingest.mpix_per_core_s"];

const MOSAIC: Mosaic = Mosaic {
    edge: 4096,
    side: 2,
    sections: 2,
};
const RUNS: usize = 3;

pub(crate) fn measure() -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let acquisition = folder.path().join("acquisition");
    MOSAIC.acquire(&acquisition)?;
    let runtime = runtime()?;
    let mut runs = Vec::new();
    let mut wall = Duration::ZERO;
    for run in 0..RUNS {
        let (cpu_before, start) = (cpu::time()?, Stopwatch::start());
        runtime.block_on(async {
            let archive =
                VisualizationArchive::create(&folder.path().join(run.to_string())).await?;
            let options = ingest::IngestOptions {
                once: true,
                ..Default::default()
            };
            let summary =
                ingest::run(&acquisition, &archive, &options, &(), &Cancel::new()).await?;
            ensure!(summary.quarantined == 0, "a tile was refused");
            anyhow::Ok(())
        })?;
        wall += start.elapsed();
        runs.push(mpix() / (cpu::time()? - cpu_before).as_secs_f64());
    }
    let options = ingest::IngestOptions::default();
    let wall_rate = mpix() * RUNS as f64 / wall.as_secs_f64();
    let row = Row::new(IDS[0], "Mpixel per core and second", runs)
        .peer(
            7.1,
            "Hadwiger et al. 2012, section 8.4.2: 85 Mpixel/s on a machine of 12 cores",
        )
        .setting(
            "tiles",
            format!(
                "{} of {}x{}, tissue with noise, uncompressed TIFF",
                MOSAIC.tiles(),
                MOSAIC.edge,
                MOSAIC.edge
            ),
        )
        .setting("encoding", format!("{:?}", options.encoding))
        .setting(
            "wall clock",
            format!("{wall_rate:.0} Mpixel/s on all cores"),
        )
        .setting(
            "time",
            "processor time of the process: decoding, pyramid, encoding, durable writing, catalog",
        );
    Ok(vec![row])
}

fn mpix() -> f64 {
    MOSAIC.pixels() as f64 / 1e6
}
