//! From a view to the numbers a frame's shader reads. Here f64 becomes f32.

use bytemuck::Zeroable;
use glam::{DVec3, IVec3, Vec3};
use saccade_core::brick::{BRICK_EDGE, MAX_LEVELS};
use saccade_core::page_table::PageTables;
use saccade_core::transfer::{TABLE_LEN, TransferFunction};
use saccade_core::volume::Volume;

use crate::layout::{
    DepthUniform, FLAG_FALSE_COLORS, FLAG_JITTER, FLAG_OCTREE, FLAG_RESIDENCY, FLAG_SUBSTITUTE,
    FrameUniform, LevelUniform, MOST_DEPTHS, OctreeUniform, TransferStorage,
};
use crate::memory::plan::Plan;
use crate::octree::ResidencyOctree;
use crate::view::View;

/// Anchors stay this near to the volume \[bricks, cells\]; beyond, positions need no precision.
const ANCHOR_REACH: f64 = 1e6;
/// More levels than this finer or coarser make no sense.
const MOST_BIAS: f32 = 32.0;

/// Extinction beyond which nothing is seen any more, yet finite \[1/nm\].
const OPAQUE: f64 = 1e6;

/// The numbers of a frame. A camera that is not finite sees nothing but background.
pub(crate) fn frame_uniform(
    view: &View,
    lod_bias: f32,
    volume: &Volume,
    tables: &PageTables,
    plan: &Plan,
    octree: Option<&ResidencyOctree>,
) -> FrameUniform {
    let camera = &view.camera;
    let axes = camera.physical_from_eye_axes();
    let eye_nm = camera.eye().xyz;
    let size = view.size.as_dvec2();
    let tangent = (camera.fov / 2.0).to_radians().tan();
    let bias = f64::from(lod_bias.clamp(-MOST_BIAS, MOST_BIAS));
    let pixel = camera.pixel_nm(1.0, size.y) * bias.exp2();
    let usable = axes.is_finite() && eye_nm.is_finite() && pixel.is_finite() && pixel > 0.0;

    let mut levels = [LevelUniform::zeroed(); MAX_LEVELS];
    let bricks = f64::from(BRICK_EDGE);
    for ((uniform, level), table) in levels.iter_mut().zip(&volume.levels).zip(tables.levels()) {
        let voxel_nm = volume.voxel_nm * level.downsampling;
        let (anchor, eye) = anchored(eye_nm / voxel_nm, bricks, table.bricks.as_dvec3());
        *uniform = LevelUniform {
            eye,
            directory_base: table.directory_base,
            anchor,
            voxels_per_nm: (1.0 / voxel_nm).as_vec3(),
            bricks: table.bricks,
            directory: table.directory,
            ..LevelUniform::zeroed()
        };
    }
    if let Some(octree) = octree {
        for (uniform, depths) in levels.iter_mut().zip(&octree.geometry().levels) {
            uniform.values_depth = depths.values;
        }
    }
    let flag = |set, flag| if set { flag } else { 0 };
    let values_hold = octree.is_some_and(ResidencyOctree::values_hold);
    let residency = octree.is_some_and(ResidencyOctree::residency_is_complete);
    FrameUniform {
        forward: axes.z_axis.as_vec3(),
        pixel: single(pixel),
        right: (axes.x_axis * tangent * size.x / size.y).as_vec3(),
        level_count: if usable {
            u32::try_from(volume.levels.len()).unwrap_or(0)
        } else {
            0
        },
        down: (axes.y_axis * tangent).as_vec3(),
        flags: flag(view.substitute, FLAG_SUBSTITUTE)
            | flag(view.false_colors, FLAG_FALSE_COLORS)
            | flag(view.jitter, FLAG_JITTER)
            | flag(values_hold, FLAG_OCTREE)
            | flag(values_hold && residency, FLAG_RESIDENCY),
        low_nm: (-eye_nm).as_vec3(),
        depth: tables.shape().depth,
        high_nm: (volume.size_nm() - eye_nm).as_vec3(),
        block_edge_log2: tables.shape().block_edge.ilog2(),
        background: view.background.into(),
        directory_entries: plan.directory,
        brick_grid: plan.brick_grid,
        first_row: 0,
        size: view.size,
        usage_words: plan.usage_words(),
        pad_0: 0,
        levels,
        octree: octree.map_or_else(OctreeUniform::zeroed, |octree| {
            octree_uniform(octree, eye_nm, volume.voxel_nm)
        }),
    }
}

fn octree_uniform(octree: &ResidencyOctree, eye_nm: DVec3, voxel_nm: DVec3) -> OctreeUniform {
    let geometry = octree.geometry();
    let cell_nm = geometry.cell.as_dvec3() * voxel_nm;
    let (anchor, eye) = anchored(eye_nm / cell_nm, 1.0, geometry.cells.as_dvec3());
    let mut depths = [DepthUniform::zeroed(); MOST_DEPTHS];
    for (depth, uniform) in (0..=geometry.deepest()).zip(&mut depths) {
        *uniform = DepthUniform {
            shift: geometry.depth(depth).shift,
            residency: geometry.residency_at(depth),
            bits: geometry.depth(depth).bits,
            pad_0: 0,
        };
    }
    OctreeUniform {
        eye,
        node_words: octree.node_words(),
        anchor,
        cells_per_nm: (1.0 / cell_nm).as_vec3(),
        cells: geometry.cells,
        depths,
        ..OctreeUniform::zeroed()
    }
}

/// A position as a box of a grid near it, with edges of `edge`, and the rest, which is small unless
/// the position is far outside of the `count` boxes.
fn anchored(position: DVec3, edge: f64, count: DVec3) -> (IVec3, Vec3) {
    let reach = DVec3::splat(ANCHOR_REACH);
    let anchor = (position / edge).floor().max(-reach).min(count + reach);
    (anchor.as_ivec3(), (position - anchor * edge).as_vec3())
}

/// The table that the shader reads: opacity as extinction, so that interpolation and step length
/// commute, and a running count of the entries that can be seen.
pub(crate) fn transfer_storage(transfer: &TransferFunction) -> TransferStorage {
    let mut storage = TransferStorage::zeroed();
    let length_nm = transfer.opacity_length_nm.max(f64::MIN_POSITIVE);
    for (index, [r, g, b, opacity]) in transfer.table().into_iter().enumerate() {
        let extinction = -(-f64::from(opacity)).ln_1p() / length_nm;
        storage.colors[index] = [r, g, b, single(extinction.min(OPAQUE))];
        let opaque = u32::from(storage.colors[index][3] > 0.0);
        storage.opaque_before[index + 1] = storage.opaque_before[index] + opaque;
        storage.visible_bins |= opaque << (index * 32 / TABLE_LEN);
    }
    debug_assert!(storage.opaque_before[TABLE_LEN] <= 256, "one per entry");
    storage
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "the nearest f32 is what is wanted"
)]
fn single(value: f64) -> f32 {
    value as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A voxel of a petascale volume, seen from nearby, stays apart from its neighbour by far.
    #[test]
    fn positions_stay_exact_far_from_the_origin() {
        let bricks = DVec3::splat(62_500.0);
        let eye = DVec3::new(1_999_987.3, 1_234_567.91, 249_999.53);
        let (anchor, rest) = anchored(eye, 32.0, bricks);
        let restored = anchor.as_dvec3() * 32.0 + rest.as_dvec3();
        assert!(
            (restored - eye).abs().max_element() < 1e-5,
            "{restored} is not {eye}"
        );
        assert!(
            (eye.as_vec3().as_dvec3() - eye).abs().max_element() > 1e-3,
            "f32 alone is not"
        );
    }

    #[test]
    fn opacity_of_no_length_is_not_infinite() {
        use saccade_core::transfer::{ColorMap, OpacityPoint};
        let mut transfer = TransferFunction {
            polarity: Default::default(),
            color_map: ColorMap::Gray,
            window: [0.0, 1.0],
            opacity: vec![OpacityPoint {
                value: 0.0,
                opacity: 0.5,
            }],
            opacity_length_nm: 100.0,
        };
        let storage = transfer_storage(&transfer);
        assert_eq!(
            (storage.colors[0][3], storage.opaque_before[TABLE_LEN]),
            (0.0, 255)
        );
        assert!((storage.colors[9][3] - 0.5_f32.ln().abs() / 100.0).abs() < 1e-6);
        for length in [0.0, -1.0, f64::NAN, 1e-300] {
            transfer.opacity_length_nm = length;
            let colors = transfer_storage(&transfer).colors;
            assert!(colors.iter().flatten().all(|c| c.is_finite()), "{length}");
        }
    }

    #[test]
    fn eyes_at_the_end_of_the_world_do_not_overflow() {
        let (anchor, rest) = anchored(DVec3::new(1e15, -1e15, 3.0), 32.0, DVec3::splat(4.0));
        assert_eq!(anchor.z, 0);
        assert!(anchor.abs().max_element() < 2_000_000 && rest.is_finite());
    }
}
