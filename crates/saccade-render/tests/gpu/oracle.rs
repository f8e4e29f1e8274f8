//! A ray-caster over plain arrays: slow, in f64, without bricks, page tables or early ends.
//!
//! It follows the rules in the crate's documentation and shares no code with the crate.

use glam::{DVec3, UVec2};
use saccade_core::volume::Polarity;
use saccade_render::{Image, Mode, View};

use crate::scene::Scene;

/// How the integral along a ray is cut.
#[derive(Clone, Copy)]
pub(crate) enum Cut {
    /// In half voxels, as the crate promises.
    HalfVoxels,
    /// So fine that it does not matter.
    Fine,
}

pub(crate) fn render(scene: &Scene, view: &View, cut: Cut) -> Image {
    let mut rgba = Vec::new();
    for y in 0..view.size.y {
        for x in 0..view.size.x {
            let light = trace(scene, view, UVec2::new(x, y), cut);
            rgba.extend(light.map(|linear| (encoded(linear) * 255.0).round() as u8));
            rgba.push(255);
        }
    }
    Image {
        size: view.size,
        rgba,
    }
}

fn encoded(linear: f64) -> f64 {
    let l = linear.clamp(0.0, 1.0);
    if l <= 0.003_130_8 {
        12.92 * l
    } else {
        1.055 * l.powf(1.0 / 2.4) - 0.055
    }
}

fn trace(scene: &Scene, view: &View, pixel: UVec2, cut: Cut) -> [f64; 3] {
    let eye = view.camera.eye().xyz;
    let ray = view
        .camera
        .ray(pixel.as_dvec2() + 0.5, view.size.as_dvec2());
    let mut light = [0.0; 3];
    let mut transmitted = 1.0;
    let channels: Vec<&Scene> = scene.channels().collect();
    let mut largest = vec![0.0_f64; channels.len()];
    let mut before = vec![0.0_f64; channels.len()];
    if let Some((near, far)) = clipped(scene, view, eye, ray) {
        let mut start = near;
        while start < far && transmitted > 0.0 {
            let level = level_at(scene, view, ray, start);
            let voxel = scene.volume.voxel_nm * scene.volume.levels[level].downsampling;
            let half_voxel = 0.5 / (ray / voxel).length();
            let step = match cut {
                Cut::HalfVoxels => half_voxel,
                Cut::Fine => half_voxel / 16.0,
            };
            let end = (start + step).min(far);
            let depth = (start + end) / 2.0;
            let at = eye + ray * depth;
            let mut sum = [0.0; 4];
            let mut surface: Option<(f64, usize)> = None;
            for (index, channel) in channels.iter().enumerate() {
                let stored = interpolated(channel, level, at / voxel);
                largest[index] = largest[index].max(stored);
                let iso = stored_iso(channel);
                if stored >= iso {
                    let back = (stored - iso) / (stored - before[index]).max(1e-9);
                    let back = if before[index] < iso { back } else { 0.0 };
                    let hit = depth - back * step;
                    if surface.is_none_or(|(other, _)| hit < other) {
                        surface = Some((hit, index));
                    }
                }
                before[index] = stored;
                let [r, g, b, extinction] = color(channel, stored);
                for (sum, part) in sum.iter_mut().zip([r, g, b, 1.0]) {
                    *sum += extinction * part;
                }
            }
            match view.mode {
                Mode::EmissionAbsorption if sum[3] > 0.0 => {
                    let opacity = 1.0 - (-sum[3] * (end - start) * ray.length()).exp();
                    for (light, emitted) in light.iter_mut().zip(sum) {
                        *light += transmitted * opacity * emitted / sum[3];
                    }
                    transmitted *= 1.0 - opacity;
                }
                Mode::IsoSurface => {
                    if let Some((hit, index)) = surface {
                        light = lit(channels[index], level, eye + ray * hit, ray);
                        transmitted = 0.0;
                    }
                }
                Mode::EmissionAbsorption | Mode::Maximum => {}
            }
            start += step;
        }
    }
    if view.mode == Mode::Maximum && largest.iter().any(|&value| value > 0.0) {
        for (channel, &value) in channels.iter().zip(&largest) {
            let [color @ .., _] = if value > 0.0 {
                color(channel, value)
            } else {
                [0.0; 4]
            };
            for (light, color) in light.iter_mut().zip(color) {
                *light += color;
            }
        }
        return light;
    }
    std::array::from_fn(|c| light[c] + transmitted * f64::from(view.background[c]))
}

/// Stored value of a channel's surface.
fn stored_iso(scene: &Scene) -> f64 {
    match scene.transfer.polarity {
        Polarity::Bright => scene.iso,
        Polarity::Dark => 256.0 - scene.iso,
    }
}

/// A surface lit from the eye.
fn lit(scene: &Scene, level: usize, at: DVec3, ray: DVec3) -> [f64; 3] {
    let voxel = scene.volume.voxel_nm * scene.volume.levels[level].downsampling;
    let slope = |axis: DVec3| {
        let value = |sign: f64| interpolated(scene, level, at / voxel + axis * sign * 0.5);
        value(1.0) - value(-1.0)
    };
    let gradient = DVec3::new(slope(DVec3::X), slope(DVec3::Y), slope(DVec3::Z)) / voxel;
    let facing = gradient
        .normalize_or_zero()
        .dot(ray.normalize_or_zero())
        .abs();
    let [r, g, b, _] = color(scene, stored_iso(scene));
    [r, g, b].map(|color| color * (0.15 + 0.85 * facing))
}

/// The part of a ray that is in the volume and not clipped.
fn clipped(scene: &Scene, view: &View, eye: DVec3, ray: DVec3) -> Option<(f64, f64)> {
    let size = scene.volume.size_nm();
    let [low, high] = match view.clip.within {
        Some([a, b]) => [
            a.xyz.min(b.xyz).max(DVec3::ZERO),
            a.xyz.max(b.xyz).min(size),
        ],
        None => [DVec3::ZERO, size],
    };
    let (mut near, mut far) = slab(eye - low, ray, high - low)?;
    let mut keep = |point: DVec3, normal: DVec3| {
        let (approach, distance) = (normal.dot(ray), normal.dot(point - eye));
        if approach > 0.0 {
            near = near.max(distance / approach);
        } else if approach < 0.0 {
            far = far.min(distance / approach);
        } else if distance > 0.0 {
            far = near;
        }
    };
    for half in view.clip.half_spaces.into_iter().flatten() {
        keep(half.point.xyz, half.normal);
    }
    if let Some(slab) = view.clip.slab {
        let normal = slab.normal.normalize_or_zero();
        let half = normal * slab.thickness_nm / 2.0;
        keep(slab.point.xyz - half, normal);
        keep(slab.point.xyz + half, -normal);
    }
    (near < far).then_some((near, far))
}

/// Where the ray is between all three pairs of faces, in front of the eye.
fn slab(eye: DVec3, ray: DVec3, size: DVec3) -> Option<(f64, f64)> {
    let (mut near, mut far) = (0.0_f64, f64::INFINITY);
    for axis in 0..3 {
        if ray[axis] == 0.0 {
            if eye[axis] < 0.0 || eye[axis] > size[axis] {
                return None;
            }
            continue;
        }
        let a = -eye[axis] / ray[axis];
        let b = (size[axis] - eye[axis]) / ray[axis];
        near = near.max(a.min(b));
        far = far.min(a.max(b));
    }
    (near < far).then_some((near, far))
}

/// The level whose voxels are nearest to a pixel in size, by ratio.
fn level_at(scene: &Scene, view: &View, ray: DVec3, depth: f64) -> usize {
    let pixel = view.camera.pixel_nm(depth, f64::from(view.size.y));
    let pixel = pixel * f64::from(view.lod_bias).exp2();
    let d = ray / ray.length();
    let seen = |level: &saccade_core::levels::Level| {
        let v = scene.volume.voxel_nm * level.downsampling;
        (d.x.abs() * v.y * v.z + d.y.abs() * v.x * v.z + d.z.abs() * v.x * v.y).sqrt()
    };
    let sizes: Vec<f64> = scene.volume.levels.iter().map(seen).collect();
    let mut level = 0;
    while level + 1 < sizes.len() && pixel >= (sizes[level] * sizes[level + 1]).sqrt() {
        level += 1;
    }
    level
}

fn interpolated(scene: &Scene, level: usize, voxel: DVec3) -> f64 {
    let corner = (voxel - 0.5).floor();
    let t = voxel - 0.5 - corner;
    let mut value = 0.0;
    for corner_index in 0..8 {
        let offset = [corner_index & 1, corner_index >> 1 & 1, corner_index >> 2];
        let mut weight = 1.0;
        let mut at = [0; 3];
        for axis in 0..3 {
            weight *= if offset[axis] == 1 {
                t[axis]
            } else {
                1.0 - t[axis]
            };
            at[axis] = corner[axis] as i64 + offset[axis];
        }
        value += weight * f64::from(scene.stored(level, at));
    }
    value
}

/// Linear RGB and extinction \[1/nm\] of a stored value.
fn color(scene: &Scene, stored: f64) -> [f64; 4] {
    let table = &scene.table;
    let low = (stored.floor() as usize).min(254);
    let t = stored - low as f64;
    let entry = |index: usize| {
        let [r, g, b, opacity] = table[index].map(f64::from);
        [
            r,
            g,
            b,
            -(1.0 - opacity).ln() / scene.transfer.opacity_length_nm,
        ]
    };
    let (a, b) = (entry(low), entry(low + 1));
    std::array::from_fn(|c| a[c] * (1.0 - t) + b[c] * t)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::ramp;
    use saccade_core::camera::Camera;
    use saccade_core::space::Point;
    use saccade_core::transfer::ColorMap;
    use saccade_core::volume::Polarity;

    /// A slab of extinction s and thickness d transmits exp(-s d).
    #[test]
    fn oracle_agrees_with_the_closed_form() {
        let transfer = ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 0.2)], 50.0);
        // So many voxels that the soft edges of the slab matter little.
        let scene = Scene::new(glam::UVec3::splat(64), DVec3::splat(4.0), transfer, |_| 0.0);
        let scene = Scene {
            levels: scene.levels.iter().map(|l| vec![1; l.len()]).collect(),
            ..scene
        };
        let camera = Camera {
            target: Point::new(DVec3::splat(128.0)),
            distance_nm: 1e6,
            yaw: 0.0,
            pitch: 0.0,
            fov: 0.01,
        };
        let view = View {
            background: [1.0; 3],
            lod_bias: -20.0,
            ..View::new(camera, UVec2::ONE)
        };
        let [light, ..] = trace(&scene, &view, UVec2::ZERO, Cut::Fine);
        // Towards either face the value fades to a half within half a voxel: 3/4 on average.
        let seen_nm = 64.0 * 4.0 - 2.0 * (0.5 * 4.0) * 0.25;
        let transmitted = 0.8_f64.powf(seen_nm / 50.0);
        assert!(
            (light - transmitted).abs() < 1e-3,
            "{light} instead of {transmitted}"
        );
    }
}
