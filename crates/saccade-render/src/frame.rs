//! From a view to the numbers a frame's shader reads. Here f64 becomes f32.

use bytemuck::Zeroable;
use glam::{DVec3, IVec3, UVec3, Vec2, Vec3, Vec4};
use saccade_core::brick::{BRICK_EDGE, MAX_LEVELS};
use saccade_core::page_table::PageTables;
use saccade_core::space::Point;
use saccade_core::volume::Volume;

use crate::channel::ChannelView;
use crate::layout::{
    CHANNEL_RESIDENCY, CHANNEL_VALUES, ChannelUniform, DepthUniform, FALSE_LEVEL, FALSE_NONE,
    FALSE_RESIDENCY, FLAG_JITTER, FLAG_NEAREST, FLAG_OCTREE, FLAG_SUBSTITUTE, FrameUniform,
    HEAT_LOOKUPS, HEAT_NODES, HEAT_NONE, HEAT_SAMPLES, LevelUniform, MODE_EMISSION_ABSORPTION,
    MODE_ISO_SURFACE, MODE_MAXIMUM, MOST_CHANNELS, MOST_DEPTHS, MOST_PLANES, OctreeUniform,
};
use crate::memory::plan::Plan;
use crate::octree::ResidencyOctree;
use crate::transfer_table::TransferTable;
use crate::view::{Clip, FalseColors, HalfSpace, Mode, Slab, View, Work};

/// Anchors stay this near to the volume \[bricks, cells\]; beyond, positions need no precision.
const ANCHOR_REACH: f64 = 1e6;
/// More levels than this finer or coarser make no sense.
const MOST_BIAS: f32 = 32.0;
/// Voxels from the eye up to which f32 places samples well: its steps there are a sixty-fourth of a voxel.
const FAR_VOXELS: f32 = 262_144.0;
/// Thickness of a slab that is to have none, of the finest voxel's shortest edge: one sample.
const THIN: f64 = 1e-3;
/// The same of its distance from the eye: a few of the steps that f32 has there, so that its faces stay apart.
const THIN_FROM_AFAR: f64 = 1.0 / 1_048_576.0;

/// A channel that is seen, and what it is stored as.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen<'a> {
    pub(crate) view: &'a ChannelView,
    pub(crate) table: &'a TransferTable,
}

/// What a frame is drawn from.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scene<'a> {
    pub(crate) volume: &'a Volume,
    pub(crate) tables: &'a PageTables,
    pub(crate) plan: &'a Plan,
    pub(crate) octree: Option<&'a ResidencyOctree>,
    /// To a stored value from 0 to 1, of a texel's two parts.
    pub(crate) combine: Vec2,
    /// Stored value that is 1.
    pub(crate) largest: f32,
}

/// The numbers of a frame. A camera that is not finite sees nothing but background.
pub(crate) fn frame_uniform(
    view: &View,
    lod_bias: f32,
    scene: Scene<'_>,
    seen: &[Seen<'_>],
) -> FrameUniform {
    let Scene {
        volume,
        tables,
        plan,
        octree,
        combine,
        largest,
    } = scene;
    let camera = &view.camera;
    let axes = camera.physical_from_eye_axes();
    let eye_nm = camera.eye().xyz;
    let size = view.size.as_dvec2();
    let tangent = (camera.fov / 2.0).to_radians().tan();
    let bias = f64::from(lod_bias.clamp(-MOST_BIAS, MOST_BIAS));
    let pixel = camera.pixel_nm(1.0, size.y) * bias.exp2();
    let [low_nm, high_nm] = view.clip.corners(volume.size_nm());
    let planes = planes(&view.clip, eye_nm, volume.voxel_nm.min_element() * THIN);
    let usable = !seen.is_empty()
        && low_nm.cmplt(high_nm).all()
        && planes.is_some()
        && axes.is_finite()
        && eye_nm.is_finite()
        && pixel.is_finite()
        && pixel > 0.0;

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
    let mut channels = [ChannelUniform::zeroed(); MOST_CHANNELS];
    let last_level = u32::try_from(volume.levels.len().saturating_sub(1)).unwrap_or(0);
    for (uniform, seen) in channels.iter_mut().zip(seen) {
        let channel = seen.view.channel;
        let assigned = octree.is_some_and(|octree| octree.is_assigned(channel));
        let holds = assigned && values_hold;
        let [first_opaque, last_opaque] = seen.table.opaque_entries();
        *uniform = ChannelUniform {
            directory_offset: channel * tables.entries_per_channel(),
            octree_slot: octree.and_then(|o| o.slot_of(channel)).unwrap_or(0),
            first_level: (*seen.view.levels.start()).min(last_level),
            last_level: (*seen.view.levels.end())
                .max(*seen.view.levels.start())
                .min(last_level),
            coarser: seen.view.coarser.min(last_level),
            flags: flag(holds, CHANNEL_VALUES) | flag(holds && residency, CHANNEL_RESIDENCY),
            table_scale: seen.table.scale,
            table_offset: seen.table.offset,
            first_opaque,
            last_opaque,
            visible_bins: seen.table.visible_bins,
            iso: seen.table.iso,
        };
    }
    let (heat, heat_full) = match view.heat {
        None => (HEAT_NONE, 1.0),
        Some(heat) => {
            let of = match heat.of {
                Work::Lookups => HEAT_LOOKUPS,
                Work::Nodes => HEAT_NODES,
                Work::Samples => HEAT_SAMPLES,
            };
            (of, heat.full.max(f32::MIN_POSITIVE))
        }
    };
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
            | flag(view.jitter, FLAG_JITTER)
            | flag(values_hold, FLAG_OCTREE)
            | flag(volume.kind.is_labels(), FLAG_NEAREST),
        low_nm: (low_nm - eye_nm).as_vec3(),
        depth: tables.shape().depth,
        high_nm: (high_nm - eye_nm).as_vec3(),
        block_edge_log2: tables.shape().block_edge.ilog2(),
        background: view.background.into(),
        directory_entries: plan.directory,
        brick_grid: plan.brick_grid,
        first_row: 0,
        size: view.size,
        usage_words: plan.usage_words(),
        channel_count: u32::try_from(seen.len()).unwrap_or(0),
        combine,
        largest,
        heat,
        heat_full,
        pad_0: [0; 3],
        levels,
        channels,
        planes: planes.unwrap_or([Vec4::W; MOST_PLANES]),
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
            shift: bytes(geometry.depth(depth).shift),
            bits: bytes(geometry.depth(depth).bits),
            residency: geometry.residency_at(depth),
            pad_0: 0,
        };
    }
    OctreeUniform {
        eye,
        slots: octree.slots(),
        anchor,
        cells_per_nm: (1.0 / cell_nm).as_vec3(),
        cells: geometry.cells,
        depths,
        ..OctreeUniform::zeroed()
    }
}

/// Small numbers, a byte per axis.
fn bytes(numbers: UVec3) -> u32 {
    numbers.x | numbers.y << 8 | numbers.z << 16
}

/// A position as a box of a grid near it, with edges of `edge`, and the rest, which is small unless
/// the position is far outside of the `count` boxes.
fn anchored(position: DVec3, edge: f64, count: DVec3) -> (IVec3, Vec3) {
    let reach = DVec3::splat(ANCHOR_REACH);
    let anchor = (position / edge).floor().max(-reach).min(count + reach);
    (anchor.as_ivec3(), (position - anchor * edge).as_vec3())
}

/// Whether voxels may be sampled so far from the eye that f32 misplaces them by more than a quarter of their size, and with
/// that perhaps in another brick than the one they are looked up in.
pub(crate) fn is_far(frame: &FrameUniform) -> bool {
    let corner = frame.low_nm.abs().max(frame.high_nm.abs());
    let farthest = corner.length();
    // Of a voxel's shortest edge.
    let edges = |level: u32| {
        let per_nm = frame.levels[level as usize].voxels_per_nm;
        (
            farthest * per_nm.max_element(),
            per_nm.max_element() / per_nm.min_element(),
        )
    };
    let channels = frame.channels.iter().take(frame.channel_count as usize);
    channels.into_iter().any(|channel| {
        let (finest, longest) = edges(channel.first_level);
        let (coarsest, _) = edges(channel.last_level);
        // A level is drawn where its voxels appear as large as a pixel, give or take the step to the next one, and a
        // ray is longer than its depth by what is seen at an angle.
        let by_level = 8.0 * longest / frame.pixel;
        coarsest.max(finest.min(by_level)) >= FAR_VOXELS
    })
}

/// Whether the same level of all channels is wanted, wherever.
pub(crate) fn are_levels_alike(frame: &FrameUniform) -> bool {
    let channels = &frame.channels[..frame.channel_count as usize];
    let levels = |of: &ChannelUniform| (of.first_level, of.last_level, of.coarser);
    channels
        .windows(2)
        .all(|pair| levels(&pair[0]) == levels(&pair[1]))
}

/// The shader's name of a mode.
pub(crate) fn mode_of(mode: Mode) -> u32 {
    match mode {
        Mode::EmissionAbsorption => MODE_EMISSION_ABSORPTION,
        Mode::Maximum => MODE_MAXIMUM,
        Mode::IsoSurface => MODE_ISO_SURFACE,
    }
}

/// The shader's name of what colours tell.
pub(crate) fn false_colors_of(false_colors: FalseColors) -> u32 {
    match false_colors {
        FalseColors::None => FALSE_NONE,
        FalseColors::Residency => FALSE_RESIDENCY,
        FalseColors::Level => FALSE_LEVEL,
    }
}

/// What is seen lies on the inner side of all of these, from the eye; `None` for planes that are not
/// finite.
fn planes(clip: &Clip, eye_nm: DVec3, thin_nm: f64) -> Option<[Vec4; MOST_PLANES]> {
    let mut planes = [Vec4::W; MOST_PLANES];
    let slab = clip.slab.map(|slab| faces(slab, eye_nm, thin_nm));
    let faces = slab.into_iter().flatten();
    let half_spaces = clip.half_spaces.into_iter().flatten().chain(faces);
    for (plane, HalfSpace { point, normal }) in planes.iter_mut().zip(half_spaces) {
        let Some(normal) = normal.try_normalize() else {
            if normal == DVec3::ZERO {
                continue;
            }
            return None;
        };
        let offset = normal.dot(eye_nm - point.xyz);
        *plane = normal.as_vec3().extend(single(offset));
        if !plane.is_finite() {
            return None;
        }
    }
    Some(planes)
}

fn faces(slab: Slab, eye_nm: DVec3, thin_nm: f64) -> [HalfSpace; 2] {
    let normal = slab.normal.normalize_or_zero();
    let distance = normal.dot(eye_nm - slab.point.xyz).abs();
    let thin_nm = thin_nm.max(distance * THIN_FROM_AFAR);
    let half = slab.thickness_nm.max(thin_nm) / 2.0;
    [normal, -normal].map(|normal| HalfSpace {
        point: Point::new(slab.point.xyz - normal * half),
        normal,
    })
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
    fn what_is_far_is_told() {
        let mut frame = FrameUniform::zeroed();
        frame.channel_count = 1;
        frame.pixel = 1e-3;
        frame.channels[0].last_level = 8;
        for (n, level) in frame.levels.iter_mut().enumerate() {
            level.voxels_per_nm = Vec3::new(0.2, 0.2, 0.02) / 2_f32.powi(i32::try_from(n).unwrap());
        }
        // Two million voxels wide: what is far is drawn from coarse levels.
        frame.low_nm = Vec3::new(-10.0, -10.0, 1e4);
        frame.high_nm = Vec3::splat(1e7);
        assert!(!is_far(&frame));
        // Where only the finest may be drawn it is.
        frame.channels[0].last_level = 0;
        assert!(is_far(&frame));
        frame.high_nm = Vec3::splat(1e5);
        assert!(!is_far(&frame));
        // Where levels are drawn much finer than seen, too.
        (frame.high_nm, frame.channels[0].last_level) = (Vec3::splat(1e7), 8);
        frame.pixel = 1e-8;
        assert!(is_far(&frame));
        frame.channel_count = 0;
        assert!(!is_far(&frame));
    }

    #[test]
    fn a_slab_without_thickness_is_between_its_faces() {
        let slab = Slab {
            point: Point::new(DVec3::new(0.0, 0.0, 90.0)),
            normal: DVec3::Z * 7.0,
            thickness_nm: 0.0,
        };
        let clip = Clip {
            slab: Some(slab),
            ..Clip::default()
        };
        let planes = planes(&clip, DVec3::new(5.0, 5.0, -10.0), 0.01).unwrap();
        let inside = |z: f32| planes.iter().all(|p| p.z * z + p.w >= 0.0);
        assert!(inside(100.0) && inside(100.004));
        assert!(!inside(100.1) && !inside(99.9));
        let nowhere = Slab {
            normal: DVec3::NAN,
            ..slab
        };
        let clip = Clip {
            slab: Some(nowhere),
            ..Clip::default()
        };
        assert!(super::planes(&clip, DVec3::ZERO, 0.01).is_some_and(|p| p == [Vec4::W; 6]));
    }

    /// As far away as a petascale volume is seen from, the two faces are not one number.
    #[test]
    fn the_faces_of_a_slab_without_thickness_stay_apart() {
        for distance in [0.0, 3.0, 1e5, 3e7, 1e12] {
            let slab = Slab {
                point: Point::new(DVec3::splat(7.0)),
                normal: DVec3::new(0.3, 0.1, 1.0),
                thickness_nm: 0.0,
            };
            let clip = Clip {
                slab: Some(slab),
                ..Clip::default()
            };
            let eye = DVec3::new(7.0, 7.0, 7.0 - distance);
            let planes = planes(&clip, eye, 0.004).unwrap();
            let [near, far] = [planes[0].w, planes[1].w].map(f32::abs);
            let steps = near.to_bits().abs_diff(far.to_bits());
            let apart = distance == 0.0 || steps >= 8;
            assert!(apart, "{distance} nm away: {near} and {far}");
            let thickness = f64::from(far) - f64::from(near);
            assert!(thickness <= (distance * 2e-6).max(0.005), "{thickness} nm");
        }
    }

    #[test]
    fn eyes_at_the_end_of_the_world_do_not_overflow() {
        let (anchor, rest) = anchored(DVec3::new(1e15, -1e15, 3.0), 32.0, DVec3::splat(4.0));
        assert_eq!(anchor.z, 0);
        assert!(anchor.abs().max_element() < 2_000_000 && rest.is_finite());
    }
}
