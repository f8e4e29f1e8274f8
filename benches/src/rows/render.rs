//! How long a frame takes when everything it needs is resident.

use std::sync::Arc;
use std::time::Duration;

use crate::clock::Stopwatch;
use anyhow::{Result, ensure};
use glam::{DVec3, UVec2, UVec3};
use saccade_core::camera::Camera;
use saccade_core::phantom::Phantom;
use saccade_core::transfer::{ColorMap, TransferFunction};
use saccade_core::volume::{Volume, VoxelKind};
use saccade_render::{Gpu, Mode, View};
use saccade_source::memory::ArraySource;
use saccade_stream::{Session, SessionOptions};

use super::runtime;
use crate::bricks::ramp;
use crate::report::Row;
use crate::scene::{NAME, VOXEL_NM};
use crate::settings::Settings;

pub(crate) const IDS: &[&str] = &["render.frame_ms", "render.maximum_ms", "render.surface_ms"];
pub(crate) const SEGMENTED_IDS: &[&str] =
    &["render.segmented_fps", "render.segmented_transparent_fps"];

/// As the paper's table 2.
const SIZE: UVec2 = UVec2::new(1024, 768);
/// A piece of tissue that is nearly a cube.
const EXTENT: UVec3 = UVec3::new(512, 512, 48);
const FRAMES: usize = 7;

/// The same views in each mode.
pub(crate) fn measure(settings: &Settings) -> Result<Vec<Row>> {
    let modes = [Mode::EmissionAbsorption, Mode::Maximum, Mode::IsoSurface];
    let wanted = IDS.iter().zip(modes).filter(|(id, _)| settings.wants(id));
    let rows = wanted.map(|(id, mode)| {
        let row = Row::new(id, "ms", frames(source()?, None, mode)?)
            .setting("volume", format!("{}x{}x{} voxels of {VOXEL_NM} nm, tissue", EXTENT.x, EXTENT.y, EXTENT.z))
            .setting("transfer function", "automatic");
        let row = match mode {
            Mode::EmissionAbsorption => {
                row.peer(13.3, "Hadwiger et al. 2012, table 2: 75 fps for 21,494 x 25,790 x 1,850, linear ramp, Quadro 6000")
            }
            Mode::Maximum | Mode::IsoSurface => row,
        };
        Ok(of_all_resident(row))
    });
    rows.collect()
}

/// The cells of the same piece, as frames per second \[003 table 1\].
pub(crate) fn measure_segmented(settings: &Settings) -> Result<Vec<Row>> {
    let functions = [
        ("a linear ramp", ramp(0.0, 1.0, 0.9, 16.0), 70.0),
        ("more transparent", ramp(0.35, 1.0, 0.25, 400.0), 9.0),
    ];
    let wanted = { SEGMENTED_IDS.iter().zip(functions) }.filter(|(id, _)| settings.wants(id));
    let rows = wanted.map(|(id, (words, function, published))| {
        let function = TransferFunction {
            color_map: ColorMap::Viridis,
            ..function
        };
        let runs = frames(segmentation()?, Some(function), Mode::EmissionAbsorption)?;
        let runs = runs.iter().map(|ms| 1e3 / ms).collect();
        let row = Row::new(id, "frames per second", runs)
            .peer(
                published,
                "Beyer et al. 2013, table 1, 21,494 x 25,790 x 1,850, Quadro 6000",
            )
            .setting(
                "volume",
                format!(
                    "{}x{}x{} voxels of {VOXEL_NM} nm, numbers of cells",
                    EXTENT.x, EXTENT.y, EXTENT.z
                ),
            )
            .setting("transfer function", words);
        Ok(of_all_resident(row))
    });
    rows.collect()
}

fn of_all_resident(row: Row) -> Row {
    row.setting("picture", format!("{}x{}", SIZE.x, SIZE.y))
        .setting("data", "all resident")
}

/// How long frames of a turned view take when all is there \[ms\].
fn frames(source: ArraySource, function: Option<TransferFunction>, mode: Mode) -> Result<Vec<f64>> {
    let source = Arc::new(source);
    let camera = Camera::around(saccade_source::VolumeSource::volume(&*source));
    runtime()?.block_on(async {
        let gpu = Gpu::headless().await?;
        let mut session = Session::new(&gpu, source, SessionOptions::default())?;
        if let Some(function) = function {
            session.set_transfer_function(0, function)?;
        }
        // Two views close to each other: each is resident while the other is drawn, and neither
        // is drawn twice in a row, which a session would not do.
        let views = [0.0, 2.0].map(|yaw| View {
            mode,
            ..View::new(camera.orbited(yaw, 0.0), SIZE)
        });
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
        Ok(runs)
    })
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

/// Which cell is where in that piece, with numbers of a byte.
fn segmentation() -> Result<ArraySource> {
    let volume = Volume {
        kind: VoxelKind::Labels,
        ..Volume::new(NAME, EXTENT, VOXEL_NM)?
    };
    let phantom = Phantom::new(1, VOXEL_NM)?;
    let mut sampler = phantom.sampler();
    let mut voxels = vec![0; EXTENT.as_usizevec3().element_product()];
    let mut labels = vec![0; EXTENT.x as usize];
    for (row, values) in (0..).zip(voxels.chunks_exact_mut(EXTENT.x as usize)) {
        sampler.labels(0, row % EXTENT.y, row / EXTENT.y, &mut labels);
        for (value, label) in values.iter_mut().zip(&labels) {
            // Not 0, which is no cell.
            let [low, ..] = (label.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32).to_le_bytes();
            *value = low.max(1);
        }
    }
    Ok(ArraySource::new(volume, voxels)?)
}
