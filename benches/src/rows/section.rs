//! How long a picture of a plane takes that nobody has asked for before.

use crate::clock::Stopwatch;
use anyhow::{Result, ensure};
use glam::UVec2;
use saccade_archive::VisualizationArchive;
use saccade_ingest::{Cancel, ingest};
use saccade_source::stitched::{StitchedOptions, StitchedSource};

use super::runtime;
use crate::report::Row;
use crate::scene::{Mosaic, NAME, Random, drop_from_cache};

pub(crate) const IDS: &[&str] = &["section.cold_512_worst_ms", "section.cold_512_mean_ms"];

const MOSAIC: Mosaic = Mosaic {
    edge: 6000,
    side: 2,
    sections: 4,
};
const EDGE: u32 = 512;
const RUNS: usize = 3;
const SECTIONS: u32 = 1000;

pub(crate) fn measure() -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let acquisition = folder.path().join("acquisition");
    MOSAIC.acquire(&acquisition)?;
    let archive_folder = folder.path().join("archive");
    let (mut worst, mut mean) = (Vec::new(), Vec::new());
    runtime()?.block_on(async {
        let archive = VisualizationArchive::create(&archive_folder).await?;
        let options = ingest::IngestOptions {
            once: true,
            ..Default::default()
        };
        ingest::run(&acquisition, &archive, &options, &(), &Cancel::new()).await?;
        let mut random = Random(88_172_645_463_325_252);
        for _ in 0..RUNS {
            // It keeps nothing: each plane opens, reads and decodes its tiles anew.
            let options = StitchedOptions {
                block_bytes: 0,
                sub_tile_bytes: 0,
                index_bytes: 0,
                ..Default::default()
            };
            let source = StitchedSource::open(&archive, NAME, options).await?;
            let mut times = Vec::new();
            for _ in 0..SECTIONS {
                drop_from_cache(&archive_folder.join("tiles"))?;
                let extent = MOSAIC.extent();
                let at = |end: u32, random: &mut Random| random.below(end - EDGE);
                let min = UVec2::new(at(extent.x, &mut random), at(extent.y, &mut random));
                let z = random.below(extent.z);
                let start = Stopwatch::start();
                let section = source
                    .cross_section(0, 0, z, min, UVec2::splat(EDGE))
                    .await?;
                times.push(start.elapsed().as_secs_f64() * 1e3);
                let whole = section.is_some_and(|s| s.size == UVec2::splat(EDGE));
                ensure!(whole, "a plane at {min}, {z} is not there");
            }
            worst.push(times.iter().copied().fold(0.0, f64::max));
            mean.push(times.iter().sum::<f64>() / f64::from(SECTIONS));
        }
        anyhow::Ok(())
    })?;
    let what = "Hadwiger et al. 2012, table 3, level 0, interleaved: machine of 12 cores, stitching on its GPU";
    let rows = [
        Row::new(IDS[0], "ms", worst).peer(54.01, what),
        Row::new(IDS[1], "ms", mean).peer(9.42, what),
    ];
    let described = rows.map(|row| {
        row.setting(
            "sections",
            format!("{SECTIONS} random ones of {EDGE}x{EDGE} at level 0"),
        )
        .setting(
            "tiles",
            format!(
                "{} of {}x{}, a tenth overlapping, turned by a few degrees",
                MOSAIC.tiles(),
                MOSAIC.edge,
                MOSAIC.edge
            ),
        )
        .setting(
            "caches",
            "none but where tiles lie; files dropped from the system's file cache before each",
        )
    });
    Ok(described.into())
}
