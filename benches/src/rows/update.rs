//! From a transform that changes in the catalog to the picture that shows it.
//!
//! A registration, in another process as far as the catalog is concerned, changes transforms; a stitched
//! source follows, a session shows. The clock starts when the change is committed and stops at the first
//! picture that it changed, and at the first complete one. *Remote*: a server in between, as when a browser shows.

use std::future;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use glam::{DVec2, UVec2, UVec3};
use saccade_archive::VisualizationArchive;
use saccade_core::camera::Camera;
use saccade_core::transform::SectionFromTile;
use saccade_ingest::{Cancel, ingest};
use saccade_render::{Gpu, View};
use saccade_serve::{Options, Server, Volumes};
use saccade_source::VolumeSource;
use saccade_source::remote::RemoteSource;
use saccade_source::stitched::{StitchedOptions, StitchedSource};
use saccade_stream::{Session, SessionOptions};

use super::first_light::changed;
use super::runtime;
use crate::clock::Stopwatch;
use crate::report::Row;
use crate::scene::{Microscope, NAME, tissue};

pub(crate) const IDS: &[&str] = &[
    "update.transform_to_screen_s",
    "update.transform_to_complete_s",
    "update.section_to_screen_s",
    "update.section_to_complete_s",
];

pub(crate) const REMOTE_IDS: &[&str] = &[
    "update.remote.transform_to_screen_s",
    "update.remote.transform_to_complete_s",
    "update.remote.section_to_screen_s",
    "update.remote.section_to_complete_s",
];

/// Edge of a tile, and from one to the next \[pixels\].
const EDGE: u32 = 1024;
const PITCH: u32 = 922;
/// Tiles of the section: 350.
const SIDES: UVec2 = UVec2::new(25, 14);
const SECTIONS: u32 = 16;
const SECTION: u32 = SECTIONS / 2;
const SIZE: UVec2 = UVec2::new(400, 300);
/// How far tiles are moved, forth and back \[level-0 voxels\].
const MOVE: f64 = 600.0;
const RUNS: usize = 5;
/// Longest wait for a picture that must come.
const PATIENCE: Duration = Duration::from_secs(120);

pub(crate) fn measure() -> Result<Vec<Row>> {
    rows(IDS, false)
}

pub(crate) fn measure_remote() -> Result<Vec<Row>> {
    let rows = rows(REMOTE_IDS, true)?.into_iter();
    let between = "HTTP on loopback: chunks, and server-sent events";
    Ok(rows
        .map(|row| row.setting("between source and session", between))
        .collect())
}

fn rows(ids: &[&'static str], remote: bool) -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let times = runtime()?.block_on(update(folder.path(), remote))?;
    let rows = ids.iter().zip(times);
    let rows = rows.map(|(id, times)| {
        Row::new(id, "s", times)
            .setting("section", format!("{} tiles of {EDGE}x{EDGE}, overlapping by a tenth", SIDES.element_product()))
            .setting("moved by", format!("{MOVE} voxels, forth and back"))
            .setting("picture", format!("{}x{}, whole volume in view, everything shown before", SIZE.x, SIZE.y))
            .setting("clock", "from the end of the commit, by another connection to the catalog; source and renderer share the machine")
    });
    Ok(rows.collect())
}

fn name(x: u32, y: u32) -> String {
    format!("y{y}x{x}")
}

fn place(x: u32, y: u32) -> DVec2 {
    (UVec2::new(x, y) * PITCH).as_dvec2()
}

async fn update(folder: &Path, remote: bool) -> Result<[Vec<f64>; 4]> {
    let acquisition = folder.join("acquisition");
    let extent = (SIDES * PITCH).extend(SECTIONS) + UVec3::new(EDGE - PITCH, EDGE - PITCH, 0);
    let mut microscope = Microscope::start(&acquisition, extent)?;
    let pixels = tissue(EDGE, 0)?;
    let all = || (0..SIDES.y).flat_map(|y| (0..SIDES.x).map(move |x| (x, y)));
    microscope.write_image("tissue", EDGE, &pixels)?;
    for (x, y) in all() {
        let to = SectionFromTile::translation(place(x, y));
        microscope.announce_as(&name(x, y), "tissue", SECTION, EDGE, to)?;
    }
    let archive_folder = folder.join("archive");
    let archive = VisualizationArchive::create(&archive_folder).await?;
    let options = ingest::IngestOptions {
        once: true,
        ..Default::default()
    };
    ingest::run(&acquisition, &archive, &options, &(), &Cancel::new()).await?;
    let source = StitchedSource::open(&archive, NAME, StitchedOptions::default()).await?;
    let source: Arc<dyn VolumeSource> = match remote {
        true => Arc::new(served(Arc::new(source)).await?),
        false => Arc::new(source),
    };
    let view = View::new(Camera::around(source.volume()), SIZE);
    let mut session = Session::new(&Gpu::headless().await?, source, SessionOptions::default())?;
    session.settle(&view, PATIENCE).await?;

    // A connection of its own, as another process has.
    let registration = VisualizationArchive::open(&archive_folder).await?;
    let mut times: [Vec<f64>; 4] = Default::default();
    for run in 0..RUNS {
        let by = if run % 2 == 0 { MOVE } else { 0.0 };
        let one = [(SIDES.x / 2, SIDES.y / 2)];
        for (first, moved) in [(0, one.to_vec()), (2, all().collect())] {
            let before = session.renderer().read_pixels().await?;
            let mut commit = registration.catalog().begin(NAME).await?;
            for (x, y) in &moved {
                let to = SectionFromTile::translation(place(*x, *y) + by);
                commit.transform(&name(*x, *y), to, None).await?;
            }
            commit.finish().await?;
            let committed = Stopwatch::start();
            let mut shown = None;
            let complete = loop {
                let status = session.frame(&view);
                if status.drew && shown.is_none() {
                    let picture = session.renderer().read_pixels().await?;
                    shown = (changed(&before, &picture) > 0.0).then(|| committed.elapsed());
                }
                if status.complete && shown.is_some() {
                    break committed.elapsed();
                }
                ensure!(
                    committed.elapsed() < PATIENCE,
                    "the change of {} transforms never became visible",
                    moved.len()
                );
                tokio::time::sleep(Duration::from_millis(2)).await;
            };
            let shown = shown.context("a picture that shows it came first")?;
            times[first].push(shown.as_secs_f64());
            times[first + 1].push(complete.as_secs_f64());
            // What is left of it comes before the next change.
            session.settle(&view, PATIENCE).await?;
        }
    }
    Ok(times)
}

/// A source, as a server of this process offers it.
async fn served(source: Arc<StitchedSource>) -> Result<RemoteSource> {
    let server = Server::bind(SocketAddr::from((Ipv4Addr::LOCALHOST, 0))).await?;
    let base = format!("http://{}", server.address());
    let volumes = Volumes::new();
    volumes.publish(source, None);
    tokio::spawn(server.run(volumes, Options::DEFAULT, future::pending()));
    Ok(RemoteSource::open(&base, NAME).await?)
}
