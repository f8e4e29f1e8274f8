//! \[001 fig. 9.4\]: how many bricks have to be resident for each pixel, with page tables, an octree and the residency
//! octree.

use std::collections::HashSet;

use anyhow::{Context as _, Result, bail, ensure};
use glam::{DMat3, DVec2, DVec3, UVec2};
use image::{GrayImage, Luma};
use saccade_core::brick::{BRICK_EDGE, BrickId};
use saccade_core::volume::Volume;
use saccade_render::{BrickVoxels, Gpu, Renderer, RendererOptions, View};

use super::table_9_1::{cache_bytes, views};
use crate::baselines::{Baseline, Method, range};
use crate::bricks::{all_bricks, at_once};
use crate::report::Row;
use crate::settings::Settings;
use crate::volumes::{DataSet, Formula};

pub(crate) const IDS: &[&str] = &[
    "render.kingsnake_1ch.working_set_of_page_tables",
    "render.kingsnake_1ch.working_set_of_octree",
];

/// Bricks that a view loads, with each way to find them, and through how many of these each pixel's ray goes.
pub(crate) fn measure(settings: &Settings) -> Result<Vec<Row>> {
    let gpu = &pollster::block_on(Gpu::headless())?;
    let scale = settings.scale(gpu);
    let case = DataSet::Kingsnake.case(scale, 1)?;
    let volume = &case.formula.volume;
    let view = views(volume, scale)[0];
    let options = RendererOptions {
        memory_bytes: cache_bytes(scale),
        ..at_once()
    };
    let mut renderer = Renderer::new(gpu, volume.clone(), options)?;
    renderer.set_channels(&case.views)?;
    let ours = needed(&mut renderer, &view, &case.formula)?;
    let needed_by = |method| {
        let top = u32::try_from(volume.levels.len().saturating_sub(3))?;
        let bytes = cache_bytes(scale);
        let mut baseline = Baseline::new(gpu, volume, &case.views, method, top, bytes)?;
        baseline.settle(&view, &case.formula)?;
        baseline.needed(&view)
    };
    let tables = needed_by(Method::PageTables)?;
    let octree = needed_by(Method::ShortStack)?;
    let counts = [&tables, &octree, &ours].map(|ids| bricks_by_pixel(volume, &view, ids));
    let most = counts.iter().flatten().copied().max().unwrap_or(0);
    settings.picture(&side_by_side(&counts, view.size, most), "fig_9_4")?;
    let mean = |counts: &[u32]| {
        let sum: u64 = counts.iter().copied().map(u64::from).sum();
        sum as f64 / counts.len().max(1) as f64
    };
    let [of_tables, of_octree, of_ours] = counts.map(|counts| mean(&counts));
    let row = |id, theirs: f64, bricks: usize| {
        Row::new(
            id,
            "bricks a pixel, theirs over ours",
            vec![theirs / of_ours],
        )
        .setting("picture", format!("{}x{}", view.size.x, view.size.y))
        .setting("ours a pixel", of_ours)
        .setting("theirs a pixel", theirs)
        .setting("most a pixel, of any", most)
        .setting("ours in all", ours.len())
        .setting("theirs in all", bricks)
    };
    Ok(vec![
        row(IDS[0], of_tables, tables.len()),
        row(IDS[1], of_octree, octree.len()),
    ])
}

/// Bricks that are delivered for a view by a source that knows values of all before they are read, as stitched ones do.
fn needed(renderer: &mut Renderer, view: &View, source: &Formula) -> Result<Vec<BrickId>> {
    let mut delivered = Vec::new();
    let mut told = HashSet::new();
    for _ in 0..2_000 {
        renderer.render(view);
        let report = pollster::block_on(renderer.finish()).pop();
        let report = report.context("a frame without a report")?;
        if report.is_complete() && !report.redraw {
            ensure!(report.memory_bias == 0.0, "the bricks did not fit");
            return Ok(delivered);
        }
        for (&id, voxels) in { report.misses.iter() }.zip(all_bricks(source, &report.misses)) {
            let Some(voxels) = voxels else {
                renderer.deliver(id, BrickVoxels::Empty)?;
                continue;
            };
            let values = range(&voxels, source.volume.dtype);
            // What is missed again by a frame that knows is needed.
            if told.insert(id) && renderer.note_range(id, values) {
                continue;
            }
            renderer.deliver(id, BrickVoxels::Voxels(&voxels))?;
            delivered.push(id);
        }
    }
    bail!("the view does not settle")
}

/// Through how many of these bricks the ray of each pixel goes, row by row.
fn bricks_by_pixel(volume: &Volume, view: &View, ids: &[BrickId]) -> Vec<u32> {
    let mut counts = vec![0; view.size.element_product() as usize];
    let image = view.size.as_dvec2();
    let eye = view.camera.eye().xyz;
    let eye_from_physical = view.camera.physical_from_eye_axes().transpose();
    for id in ids {
        let level = volume.levels[id.level() as usize];
        let edge_nm = level.downsampling * volume.voxel_nm;
        let low = (id.brick() * BRICK_EDGE).as_dvec3() * edge_nm;
        let high = (low + f64::from(BRICK_EDGE) * edge_nm).min(volume.size_nm());
        let Some([first, end]) = pixels_around(view, eye_from_physical, [low - eye, high - eye])
        else {
            continue;
        };
        for y in first.y..end.y {
            for x in first.x..end.x {
                let ray = view
                    .camera
                    .ray(DVec2::new(f64::from(x), f64::from(y)) + 0.5, image);
                let (a, b) = ((low - eye) / ray, (high - eye) / ray);
                let enters = a.min(b).max_element().max(0.0);
                if enters < a.max(b).min_element() {
                    counts[(y * view.size.x + x) as usize] += 1;
                }
            }
        }
    }
    counts
}

/// The pixels that a box, given by two corners from the eye \[nm\], may appear on: from the first to before the end.
/// All where it reaches behind the eye.
fn pixels_around(view: &View, eye_from_physical: DMat3, corners: [DVec3; 2]) -> Option<[UVec2; 2]> {
    let tangent = (view.camera.fov / 2.0).to_radians().tan();
    let image = view.size.as_dvec2();
    let (mut first, mut end) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for corner in 0..8_usize {
        let pick = |axis: usize| corners[corner >> axis & 1][axis];
        let at = eye_from_physical * DVec3::new(pick(0), pick(1), pick(2));
        if at.z <= 0.0 {
            return Some([UVec2::ZERO, view.size]);
        }
        let pixel = (at.truncate() / at.z / tangent * image.y + image) / 2.0;
        (first, end) = (first.min(pixel), end.max(pixel));
    }
    let first = first.floor().clamp(DVec2::ZERO, image).as_uvec2();
    let end = end.ceil().clamp(DVec2::ZERO, image).as_uvec2();
    first.cmplt(end).all().then_some([first, end])
}

/// Pictures beside each other, white where a pixel needs the most bricks.
fn side_by_side(counts: &[Vec<u32>; 3], size: UVec2, most: u32) -> GrayImage {
    const GAP: u32 = 4;
    let mut picture = GrayImage::from_pixel(3 * size.x + 2 * GAP, size.y, Luma([255]));
    for (n, counts) in (0..).zip(counts) {
        for (at, count) in (0..).zip(counts) {
            let value = (255 * u64::from(*count)).div_ceil(u64::from(most.max(1)));
            let gray = u8::try_from(value).unwrap_or(u8::MAX);
            picture.put_pixel(n * (size.x + GAP) + at % size.x, at / size.x, Luma([gray]));
        }
    }
    picture
}

#[cfg(test)]
mod tests {
    use glam::UVec3;
    use saccade_core::camera::Camera;

    use super::*;

    /// Beside a count that knows of no rectangle: every ray, every brick.
    #[test]
    fn no_brick_is_forgotten() {
        let extent = UVec3::new(130, 70, 40);
        let volume = Volume::new("v", extent, DVec3::new(4.0, 4.0, 9.0)).unwrap();
        let bricks = (extent + BRICK_EDGE - 1) / BRICK_EDGE;
        let all = saccade_core::voxel_box::VoxelBox::of_size(bricks);
        let ids: Vec<_> = all
            .iter()
            .map(|at| BrickId::new(0, 0, at).unwrap())
            .collect();
        for (zoom, yaw) in [(1.0, 0.0), (1.3, 50.0), (9.0, 200.0), (0.2, 10.0)] {
            let camera = Camera::around(&volume).orbited(yaw, 3.0).zoomed(zoom);
            let view = View::new(camera, UVec2::new(37, 23));
            let counts = bricks_by_pixel(&volume, &view, &ids);
            // By small steps along the ray.
            let eye = camera.eye().xyz;
            let mut hit = 0;
            for (at, count) in (0..).zip(&counts) {
                let pixel = UVec2::new(at % 37, at / 37).as_dvec2() + 0.5;
                let ray = camera.ray(pixel, view.size.as_dvec2());
                let ray = ray.try_normalize().unwrap();
                let mut met = HashSet::new();
                let reach = camera.distance_nm + volume.size_nm().length();
                let mut depth = 0.0;
                while depth < reach {
                    let at = (eye + ray * depth) / volume.voxel_nm;
                    if at.cmpge(DVec3::ZERO).all() && at.cmplt(extent.as_dvec3()).all() {
                        met.insert(at.as_uvec3() / BRICK_EDGE);
                    }
                    depth += 1.0;
                }
                let stepped = u32::try_from(met.len()).unwrap();
                // Steps may pass over an edge that a ray only just touches.
                assert!(
                    stepped <= *count && count - stepped <= 1,
                    "{stepped} {count}"
                );
                hit += u32::from(stepped > 0);
            }
            assert!(hit > 3, "{hit} pixels see the volume");
        }
    }
}
