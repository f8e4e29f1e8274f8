//! How long a picture of a plane takes that nobody has asked for before.

use crate::clock::Stopwatch;
use anyhow::{Result, ensure};
use glam::UVec2;
use saccade_archive::VisualizationArchive;
use saccade_ingest::{Cancel, ingest};
use saccade_source::VolumeSource;
use saccade_source::stitched::{StitchedOptions, StitchedSource};

use super::runtime;
use crate::report::Row;
use crate::scene::{Mosaic, NAME, Random, drop_from_cache};

pub(crate) const IDS: &[&str] = &[
    "section.cold_512_worst_ms",
    "section.cold_512_mean_ms",
    "section.cold_512_least_ms",
    "section.cold_512_worst_ms.level_1",
    "section.cold_512_mean_ms.level_1",
    "section.cold_512_least_ms.level_1",
    "section.cold_512_worst_ms.level_2",
    "section.cold_512_mean_ms.level_2",
    "section.cold_512_least_ms.level_2",
    "section.cold_512_worst_ms.level_3",
    "section.cold_512_mean_ms.level_3",
    "section.cold_512_least_ms.level_3",
];

/// Greatest, mean and least time of table 3, interleaved, by level \[ms\].
const PUBLISHED: [[f64; 3]; 4] = [
    [54.01, 9.42, 4.41],
    [40.01, 8.88, 4.57],
    [25.73, 6.83, 5.13],
    [9.72, 4.58, 4.58],
];

const MOSAIC: Mosaic = Mosaic {
    edge: 6000,
    side: 2,
    sections: 4,
};
const EDGE: u32 = 512;
const RUNS: usize = 3;
/// Random ones of level 0, and of each other level.
const SECTIONS: [u32; 4] = [1000, 250, 250, 250];

pub(crate) fn measure() -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let acquisition = folder.path().join("acquisition");
    MOSAIC.acquire(&acquisition)?;
    let archive_folder = folder.path().join("archive");
    let mut found = [const { [const { Vec::new() }; 3] }; 4];
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
                thumbnail_bytes: 0,
                ..Default::default()
            };
            let source = StitchedSource::open(&archive, NAME, options).await?;
            for (level, (found, sections)) in (0..).zip(found.iter_mut().zip(SECTIONS)) {
                let extent = source.volume().levels[level as usize].extent;
                let mut times = Vec::new();
                for _ in 0..sections {
                    drop_from_cache(&archive_folder.join("tiles"))?;
                    let at = |end: u32, random: &mut Random| random.below(end - EDGE);
                    let min = UVec2::new(at(extent.x, &mut random), at(extent.y, &mut random));
                    let z = random.below(extent.z);
                    let start = Stopwatch::start();
                    let section = source
                        .cross_section(0, level, z, min, UVec2::splat(EDGE))
                        .await?;
                    times.push(start.elapsed().as_secs_f64() * 1e3);
                    let whole = section.is_some_and(|s| s.size == UVec2::splat(EDGE));
                    ensure!(whole, "a plane at {min}, {z} of level {level} is not there");
                }
                found[0].push(times.iter().copied().fold(0.0, f64::max));
                found[1].push(times.iter().sum::<f64>() / f64::from(sections));
                found[2].push(times.iter().copied().fold(f64::INFINITY, f64::min));
            }
        }
        anyhow::Ok(())
    })?;
    let what = "Hadwiger et al. 2012, table 3, interleaved: machine of 12 cores, stitching on its GPU; the least of files in its memory";
    let published = PUBLISHED.into_iter().flatten();
    let rows = IDS.iter().zip(found.into_iter().flatten()).zip(published);
    let described = (0..).zip(rows).map(|(n, ((id, runs), peer))| {
        let (level, row) = (n / 3, Row::new(id, "ms", runs).peer(peer, what));
        row.setting(
            "sections",
            format!(
                "{} random ones of {EDGE}x{EDGE} at level {level}",
                SECTIONS[level]
            ),
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
    Ok(described.collect())
}
