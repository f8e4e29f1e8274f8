//! From a tile's arrival to its pixels on screen.
//!
//! Everything of a running acquisition in one process: ingest follows the archive, a stitched
//! source follows the catalog, a session shows it. The clock starts when the last byte of the
//! tile's record is written and stops at the first picture that the tile changed.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use crate::clock::Stopwatch;
use anyhow::{Result, ensure};
use glam::{UVec2, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_core::camera::Camera;
use saccade_core::transform::SectionFromTile;
use saccade_ingest::{Cancel, ingest};
use saccade_render::{Gpu, Image, View};
use saccade_source::VolumeSource;
use saccade_source::stitched::{StitchedOptions, StitchedSource};
use saccade_stream::{Session, SessionOptions};

use super::runtime;
use crate::report::Row;
use crate::scene::{Microscope, NAME, tissue};

pub(crate) const IDS: &[&str] = &[
    "first_light.tile_to_screen_s",
    "first_light.tile_to_complete_s",
];

const EDGE: u32 = 12_000;
const SECTIONS: u32 = 16;
const SIZE: UVec2 = UVec2::new(400, 300);
const RUNS: usize = 3;
/// Longest wait for a picture that must come.
const PATIENCE: Duration = Duration::from_secs(300);

pub(crate) fn measure() -> Result<Vec<Row>> {
    let pixels = tissue(EDGE, 0)?;
    let runtime = runtime()?;
    let mut first = Vec::new();
    let mut complete = Vec::new();
    for _ in 0..RUNS {
        let folder = tempfile::tempdir()?;
        let times = runtime.block_on(arrival(folder.path(), &pixels))?;
        first.push(times.first.as_secs_f64());
        complete.push(times.complete.as_secs_f64());
    }
    let rows = [
        Row::new(IDS[0], "s", first),
        Row::new(IDS[1], "s", complete),
    ];
    let options = ingest::IngestOptions::default();
    let described = rows.map(|row| {
        row.setting("tile", format!("{EDGE}x{EDGE}, tissue with noise, uncompressed TIFF, on local disk"))
            .setting("volume", format!("{EDGE}x{EDGE}x{SECTIONS} voxels, empty before"))
            .setting("encoding", format!("{:?}", options.encoding))
            .setting("ingest polls every", format!("{:?}", options.poll))
            .setting("picture", format!("{}x{}, whole volume in view", SIZE.x, SIZE.y))
            .setting("clock", "from the last byte of the tile's record; ingest, source and renderer share the machine")
    });
    Ok(described.into())
}

struct Times {
    /// Until the first picture that shows some of the tile.
    first: Duration,
    /// Until the picture shows all of it as the view wants it.
    complete: Duration,
}

async fn arrival(folder: &Path, pixels: &[u8]) -> Result<Times> {
    let acquisition = folder.join("acquisition");
    let mut microscope = Microscope::start(&acquisition, UVec3::new(EDGE, EDGE, SECTIONS))?;
    let archive = VisualizationArchive::create(&folder.join("archive")).await?;
    archive
        .catalog()
        .create_volume(
            &saccade_archive::acquisition::AcquisitionInfo::read(&acquisition)?.volume()?,
        )
        .await?;
    let source: Arc<dyn VolumeSource> =
        Arc::new(StitchedSource::open(&archive, NAME, StitchedOptions::default()).await?);
    let cancel = Cancel::new();
    let following = tokio::spawn({
        let (cancel, archive) = (cancel.clone(), archive.clone());
        async move {
            ingest::run(
                &acquisition,
                &archive,
                &ingest::IngestOptions::default(),
                &(),
                &cancel,
            )
            .await
        }
    });

    let view = View::new(Camera::around(source.volume()), SIZE);
    let mut session = Session::new(&Gpu::headless().await?, source, SessionOptions::default())?;
    session.settle(&view, PATIENCE).await?;
    let empty = session.renderer().read_pixels().await?;

    microscope.write_image("tile", EDGE, pixels)?;
    microscope.announce("tile", SECTIONS / 2, EDGE, SectionFromTile::IDENTITY)?;
    let arrived = Stopwatch::start();
    let mut first = None;
    let complete = loop {
        let status = session.frame(&view);
        if status.drew && first.is_none() {
            let picture = session.renderer().read_pixels().await?;
            first = (changed(&empty, &picture) > 0.0).then(|| arrived.elapsed());
        }
        if status.complete && first.is_some() {
            break arrived.elapsed();
        }
        ensure!(
            arrived.elapsed() < PATIENCE,
            "the tile never became visible"
        );
        tokio::time::sleep(Duration::from_millis(2)).await;
    };
    cancel.cancel();
    following.await??;
    let shown = changed(&empty, &session.renderer().read_pixels().await?);
    ensure!(
        shown > 0.05,
        "the tile covers {shown} of the picture, which cannot be all of it"
    );
    let first = first.unwrap_or(complete);
    Ok(Times { first, complete })
}

/// Part of the pixels that changed by more than rounding.
pub(super) fn changed(a: &Image, b: &Image) -> f64 {
    let pairs = a.rgba.chunks_exact(4).zip(b.rgba.chunks_exact(4));
    let differs = |(a, b): (&[u8], &[u8])| a.iter().zip(b).any(|(a, b)| a.abs_diff(*b) > 4);
    pairs.map(differs).map(f64::from).sum::<f64>() / f64::from(a.size.element_product())
}
