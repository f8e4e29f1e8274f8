//! How long a frame takes when everything it needs is resident.

use std::sync::Arc;
use std::time::Duration;

use crate::clock::Stopwatch;
use anyhow::{Result, ensure};
use glam::{DVec3, UVec2, UVec3};
use saccade_core::camera::Camera;
use saccade_core::phantom::Phantom;
use saccade_core::volume::Volume;
use saccade_render::{Gpu, View};
use saccade_source::memory::ArraySource;
use saccade_stream::{Session, SessionOptions};

use super::runtime;
use crate::report::Row;
use crate::scene::{NAME, VOXEL_NM};

pub(crate) const IDS: &[&str] = &["render.frame_ms"];

/// As the paper's table 2.
const SIZE: UVec2 = UVec2::new(1024, 768);
/// A piece of tissue that is nearly a cube.
const EXTENT: UVec3 = UVec3::new(512, 512, 48);
const FRAMES: usize = 7;

pub(crate) fn measure() -> Result<Vec<Row>> {
    let source = Arc::new(source()?);
    let volume = Volume::clone(saccade_source::VolumeSource::volume(&*source));
    let camera = Camera::around(&volume);
    let runtime = runtime()?;
    let runs = runtime.block_on(async {
        let gpu = Gpu::headless().await?;
        let mut session = Session::new(&gpu, source, SessionOptions::default())?;
        // Two views close to each other: each is resident while the other is drawn, and neither
        // is drawn twice in a row, which a session would not do.
        let views = [0.0, 2.0].map(|yaw| View::new(camera.orbited(yaw, 0.0), SIZE));
        for _ in 0..2 {
            for view in &views {
                session.settle(view, Duration::from_secs(600)).await?;
            }
        }
        let mut runs = Vec::new();
        for view in views.iter().cycle().take(FRAMES) {
            let before = session
                .settle(
                    &views[usize::from(*view == views[0])],
                    Duration::from_secs(600),
                )
                .await?;
            let start = Stopwatch::start();
            let after = session.settle(view, Duration::from_secs(600)).await?;
            runs.push(start.elapsed().as_secs_f64() * 1e3);
            ensure!(after.frame == before.frame + 1, "the view was not resident");
        }
        anyhow::Ok(runs)
    })?;
    let row = Row::new("render.frame_ms", "ms", runs)
        .peer(13.3, "Hadwiger et al. 2012, table 2: 75 fps for 21,494 x 25,790 x 1,850, linear ramp, Quadro 6000")
        .setting("picture", format!("{}x{}", SIZE.x, SIZE.y))
        .setting("volume", format!("{}x{}x{} voxels of {VOXEL_NM} nm, tissue", EXTENT.x, EXTENT.y, EXTENT.z))
        .setting("transfer function", "automatic")
        .setting("data", "all resident");
    Ok(vec![row])
}

/// A ball of tissue, which looks alike from everywhere.
pub(super) fn ball() -> Result<ArraySource> {
    const EDGE: u32 = 288;
    const RADIUS: f64 = 140.0;
    let voxel_nm = DVec3::splat(16.0);
    let volume = Volume::new(NAME, UVec3::splat(EDGE), voxel_nm)?;
    let phantom = Phantom::new(1, voxel_nm)?;
    let mut sampler = phantom.sampler();
    let mut voxels = vec![0; UVec3::splat(EDGE).as_usizevec3().element_product()];
    for (row, values) in (0..).zip(voxels.chunks_exact_mut(EDGE as usize)) {
        let (y, z) = (row % EDGE, row / EDGE);
        sampler.row(0, y, z, values);
        for (x, value) in (0..).zip(values) {
            let from_middle = UVec3::new(x, y, z).as_dvec3() + 0.5 - f64::from(EDGE) / 2.0;
            if from_middle.length() > RADIUS {
                *value = 0;
            }
        }
    }
    Ok(ArraySource::new(volume, voxels)?)
}

/// A piece of tissue.
pub(super) fn source() -> Result<ArraySource> {
    let volume = Volume::new(NAME, EXTENT, VOXEL_NM)?;
    let phantom = Phantom::new(1, VOXEL_NM)?;
    let mut sampler = phantom.sampler();
    let mut voxels = vec![0; EXTENT.as_usizevec3().element_product()];
    for (row, values) in (0..).zip(voxels.chunks_exact_mut(EXTENT.x as usize)) {
        sampler.row(0, row % EXTENT.y, row / EXTENT.y, values);
    }
    Ok(ArraySource::new(volume, voxels)?)
}
