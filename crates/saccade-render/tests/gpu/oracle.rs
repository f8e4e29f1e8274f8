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

pub(crate) fn encoded(linear: f64) -> f64 {
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
    let background = view.background.map(f64::from);
    let Some((near, far, face)) = clipped(scene, view, eye, ray) else {
        return background;
    };
    let line = Line {
        eye,
        ray,
        near,
        far,
    };
    match view.mode {
        Mode::EmissionAbsorption => composited(scene, view, &line, cut),
        Mode::Maximum => {
            largest(scene, &line.samples(scene, view, cut), &line).unwrap_or(background)
        }
        Mode::IsoSurface => {
            let samples = line.samples(scene, view, cut);
            first_surface(scene, &samples, &line, face).unwrap_or(background)
        }
    }
}

/// What a ray passes through.
struct Line {
    eye: DVec3,
    ray: DVec3,
    near: f64,
    far: f64,
}

/// Where single values count: a depth, and the level whose voxels are met there.
#[derive(Clone, Copy)]
struct Sample {
    depth: f64,
    level: usize,
}

/// A part of a ray that has one level.
struct Stretch {
    begin: f64,
    end: f64,
    level: usize,
    /// Where its segments are sampled.
    own: Vec<f64>,
}

impl Line {
    fn at(&self, depth: f64) -> DVec3 {
        self.eye + self.ray * depth
    }

    /// Where the ray is in a level \[voxels\], and how far it goes there per depth.
    fn in_voxels(&self, scene: &Scene, level: usize) -> (DVec3, DVec3) {
        let voxel = scene.volume.voxel_nm * scene.volume.levels[level].downsampling;
        (self.eye / voxel, self.ray / voxel)
    }

    fn stretches(&self, scene: &Scene, view: &View, cut: Cut) -> Vec<Stretch> {
        let mut stretches: Vec<Stretch> = Vec::new();
        let mut start = self.near;
        while start < self.far {
            let level = level_at(scene, view, self.ray, start);
            let (eye, voxels) = self.in_voxels(scene, level);
            let half_voxel = 0.5 / voxels.abs().max_element();
            let step = match cut {
                Cut::HalfVoxels => half_voxel,
                Cut::Fine => half_voxel / 16.0,
            };
            let plane = next_plane(eye, voxels, start, step);
            let end = (start + step).min(self.far);
            let own = if plane < self.far {
                plane
            } else {
                (start + end) / 2.0
            };
            match stretches.last_mut() {
                Some(last) if last.level == level => {
                    last.end = end;
                    last.own.push(own);
                }
                _ => stretches.push(Stretch {
                    begin: start,
                    end,
                    level,
                    own: vec![own],
                }),
            }
            start += step;
        }
        stretches
    }

    /// All samples where single values count, front to back, also where stretches of one level begin and end.
    fn samples(&self, scene: &Scene, view: &View, cut: Cut) -> Vec<Sample> {
        let mut samples = Vec::new();
        for stretch in self.stretches(scene, view, cut) {
            let Stretch {
                begin,
                end,
                level,
                own,
            } = stretch;
            let (eye, voxels) = self.in_voxels(scene, level);
            let mut depths = own.clone();
            if matches!(cut, Cut::HalfVoxels) {
                let main = main_axis(voxels);
                let crossed = { (0..3).filter(|axis| *axis != main) }
                    .flat_map(|axis| middles(eye[axis], voxels[axis], begin, end));
                let crossed: Vec<f64> = crossed.collect();
                // Half way between two planes the others' stand in.
                let stands = |(n, depth): (usize, &f64)| {
                    let whole = eye[main] + voxels[main] * depth - 0.5;
                    let is_middle = (whole - whole.round()).abs() < 0.25;
                    let is_last = n + 1 == own.len() && !is_half(whole);
                    let before = if n == 0 { begin } else { own[n - 1] };
                    let after = own.get(n + 1).copied().unwrap_or(end);
                    let is_instead = (!is_middle || is_last) && { crossed.iter() }
                        .any(|at| (before..=after).contains(at));
                    (!is_instead).then_some(*depth)
                };
                depths = own.iter().enumerate().filter_map(stands).collect();
                depths.extend(crossed);
            }
            if matches!(cut, Cut::HalfVoxels) {
                depths.extend([begin, end]);
            }
            depths.sort_by(f64::total_cmp);
            samples.extend(depths.into_iter().map(|depth| Sample { depth, level }));
        }
        samples
    }
}

/// Whether a number is a multiple of a half.
fn is_half(number: f64) -> bool {
    let twice = number * 2.0;
    (twice - twice.round()).abs() < 1e-3
}

/// Depths from `begin` to `end` at which a coordinate is the middle of a voxel.
fn middles(eye: f64, voxels: f64, begin: f64, end: f64) -> Vec<f64> {
    if voxels.abs() < 1e-12 {
        return Vec::new();
    }
    let at = |depth: f64| eye + voxels * depth - 0.5;
    let (low, high) = (at(begin).min(at(end)), at(begin).max(at(end)));
    let (first, last) = (low.ceil() as i64, high.floor() as i64);
    (first..=last)
        .map(|plane| (plane as f64 + 0.5 - eye) / voxels)
        .collect()
}

fn main_axis(voxels: DVec3) -> usize {
    let mut main = 0;
    for axis in 1..3 {
        if voxels[axis].abs() > voxels[main].abs() {
            main = axis;
        }
    }
    main
}

fn largest(scene: &Scene, samples: &[Sample], line: &Line) -> Option<[f64; 3]> {
    let mut light = [0.0; 3];
    let mut is_met = false;
    for channel in scene.channels() {
        let values = samples.iter().map(|sample| {
            let (eye, voxels) = line.in_voxels(scene, sample.level);
            interpolated(channel, sample.level, eye + voxels * sample.depth)
        });
        let value = values.fold(0.0, f64::max);
        if value > 0.0 {
            is_met = true;
            for (light, color) in light.iter_mut().zip(color(channel, value)) {
                *light += color;
            }
        }
    }
    is_met.then_some(light)
}

fn first_surface(scene: &Scene, samples: &[Sample], line: &Line, face: DVec3) -> Option<[f64; 3]> {
    let mut first: Option<(f64, &Scene, DVec3)> = None;
    for channel in scene.channels() {
        let iso = stored_iso(channel);
        let mut before: Option<(f64, f64)> = None;
        for (n, &Sample { depth, level }) in samples.iter().enumerate() {
            let (eye, voxels) = line.in_voxels(scene, level);
            let stored = interpolated(channel, level, eye + voxels * depth);
            if stored < iso {
                before = Some((depth, stored));
                continue;
            }
            let hit = match before {
                Some((at, low)) => depth - (depth - at) * (stored - iso) / (stored - low),
                None => depth,
            };
            // What begins where the ray does is cut there.
            let normal = if n == 0 {
                face
            } else {
                gradient(channel, level, line.at(hit))
            };
            if first.is_none_or(|(other, ..)| hit < other) {
                first = Some((hit, channel, normal));
            }
            break;
        }
    }
    let (_, channel, normal) = first?;
    Some(lit(channel, normal, line.ray))
}

/// Light that is emitted along a ray, and what is left of the background behind.
fn composited(scene: &Scene, view: &View, line: &Line, cut: Cut) -> [f64; 3] {
    let mut light = [0.0; 3];
    let mut transmitted = 1.0;
    let mut start = line.near;
    while start < line.far && transmitted > 0.0 {
        let level = level_at(scene, view, line.ray, start);
        let (eye, voxels) = line.in_voxels(scene, level);
        let step = match cut {
            Cut::HalfVoxels => 0.5 / voxels.length(),
            Cut::Fine => 0.5 / voxels.length() / 16.0,
        };
        let end = (start + step).min(line.far);
        let at = eye + voxels * (start + end) / 2.0;
        let mut sum = [0.0; 4];
        for channel in scene.channels() {
            let [r, g, b, extinction] = color(channel, interpolated(channel, level, at));
            for (sum, part) in sum.iter_mut().zip([r, g, b, 1.0]) {
                *sum += extinction * part;
            }
        }
        if sum[3] > 0.0 {
            let opacity = 1.0 - (-sum[3] * (end - start) * line.ray.length()).exp();
            for (light, emitted) in light.iter_mut().zip(sum) {
                *light += transmitted * opacity * emitted / sum[3];
            }
            transmitted *= 1.0 - opacity;
        }
        start += step;
    }
    std::array::from_fn(|c| light[c] + transmitted * f64::from(view.background[c]))
}

/// Depth, one step after `start` at most, at which a ray is at a whole number of steps from the middles of voxels, along the axis along which it passes most.
fn next_plane(eye: DVec3, voxels: DVec3, start: f64, step: f64) -> f64 {
    let axis = main_axis(voxels);
    let steps = |depth: f64| (eye[axis] + voxels[axis] * depth - 0.5) / (voxels[axis] * step);
    let here = steps(start);
    // What lies in a plane but for rounding is met in the next.
    let mut whole = here.ceil();
    if whole - here < 1.0 / 256.0 {
        whole += 1.0;
    }
    start + (whole - here).min(1.0) * step
}

/// Stored value of a channel's surface.
fn stored_iso(scene: &Scene) -> f64 {
    match scene.transfer.polarity {
        Polarity::Bright => scene.iso,
        Polarity::Dark => 256.0 - scene.iso,
    }
}

fn gradient(scene: &Scene, level: usize, at: DVec3) -> DVec3 {
    let voxel = scene.volume.voxel_nm * scene.volume.levels[level].downsampling;
    let slope = |axis: DVec3| {
        let value = |sign: f64| interpolated(scene, level, at / voxel + axis * sign * 0.5);
        value(1.0) - value(-1.0)
    };
    DVec3::new(slope(DVec3::X), slope(DVec3::Y), slope(DVec3::Z)) / voxel
}

/// A surface lit from the eye; one without a direction as if it faced it.
fn lit(scene: &Scene, normal: DVec3, ray: DVec3) -> [f64; 3] {
    let facing = match normal.try_normalize() {
        Some(normal) => normal.dot(ray.normalize_or_zero()).abs(),
        None => 1.0,
    };
    surface_color(scene).map(|color| color * (0.15 + 0.85 * facing))
}

/// The colour of the surface's value, half as bright as can be at least; that of the brighter end of the map where it
/// is black.
pub(crate) fn surface_color(scene: &Scene) -> [f64; 3] {
    let rgb = |stored| {
        let [r, g, b, _] = color(scene, stored);
        [r, g, b]
    };
    let most = |rgb: [f64; 3]| rgb.into_iter().fold(0.0, f64::max);
    let own = rgb(stored_iso(scene));
    if most(own) >= 0.5 {
        return own;
    }
    let (low, high) = (rgb(1.0), rgb(255.0));
    let end = if most(high) >= most(low) { high } else { low };
    let hue = if most(own) > 1e-3 { own } else { end };
    hue.map(|part| part * 0.5 / most(hue).max(1e-6))
}

/// The part of a ray that is in the volume and not clipped, and the normal of the face it enters through; zero if the eye is inside.
fn clipped(scene: &Scene, view: &View, eye: DVec3, ray: DVec3) -> Option<(f64, f64, DVec3)> {
    let size = scene.volume.size_nm();
    let [low, high] = match view.clip.within {
        Some([a, b]) => [
            a.xyz.min(b.xyz).max(DVec3::ZERO),
            a.xyz.max(b.xyz).min(size),
        ],
        None => [DVec3::ZERO, size],
    };
    let (mut near, mut far, mut face) = slab(eye - low, ray, high - low)?;
    let mut keep = |point: DVec3, normal: DVec3| {
        let (approach, distance) = (normal.dot(ray), normal.dot(point - eye));
        if approach > 0.0 {
            if distance / approach > near {
                (near, face) = (distance / approach, normal);
            }
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
    (near < far).then_some((near, far, face))
}

/// Where the ray is between all three pairs of faces, in front of the eye, and the axis of the face it enters through.
fn slab(eye: DVec3, ray: DVec3, size: DVec3) -> Option<(f64, f64, DVec3)> {
    let (mut near, mut far, mut face) = (0.0_f64, f64::INFINITY, DVec3::ZERO);
    for axis in 0..3 {
        if ray[axis] == 0.0 {
            if eye[axis] < 0.0 || eye[axis] > size[axis] {
                return None;
            }
            continue;
        }
        let a = -eye[axis] / ray[axis];
        let b = (size[axis] - eye[axis]) / ray[axis];
        if a.min(b) > near {
            (near, face) = (a.min(b), DVec3::AXES[axis]);
        }
        far = far.min(a.max(b));
    }
    (near < far).then_some((near, far, face))
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
    use glam::{DVec2, UVec3};
    use saccade_core::camera::Camera;
    use saccade_core::space::Point;
    use saccade_core::transfer::{ColorMap, TransferFunction};
    use saccade_core::volume::Polarity;
    use saccade_render::{Clip, Slab};

    /// A slab of extinction s and thickness d transmits exp(-s d).
    #[test]
    fn oracle_agrees_with_the_closed_form() {
        let transfer = ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 0.2)], 50.0);
        // So many voxels that the soft edges of the slab matter little.
        let scene = Scene::new(UVec3::splat(64), DVec3::splat(4.0), transfer, |_| 0.0);
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

    /// A cube of 64 voxels of 4 nm, of which each has the value of its place \[voxels\].
    fn cube(transfer: TransferFunction, value: impl Fn(DVec3) -> f64) -> Scene {
        Scene::new(UVec3::splat(64), DVec3::splat(4.0), transfer, |nm| {
            value(nm / 4.0)
        })
    }

    /// The light of one ray along z through a place \[nm\], all but parallel to its neighbours, in front of blue.
    fn light_at(scene: &Scene, at: DVec2, mode: Mode, clip: Clip) -> [f64; 3] {
        let camera = Camera {
            target: Point::new(at.extend(128.0)),
            distance_nm: 1e6,
            yaw: 0.0,
            pitch: 0.0,
            fov: 0.01,
        };
        let view = View {
            background: [0.0, 0.0, 1.0],
            lod_bias: -20.0,
            mode,
            clip,
            ..View::new(camera, UVec2::ONE)
        };
        trace(scene, &view, UVec2::ZERO, Cut::Fine)
    }

    fn slab_at(z: f64, thickness_nm: f64) -> Clip {
        Clip {
            slab: Some(Slab {
                point: Point::new(DVec3::new(0.0, 0.0, z)),
                normal: DVec3::Z,
                thickness_nm,
            }),
            ..Clip::default()
        }
    }

    /// The surface of a sphere lies where its radius says, and is as bright as it faces the eye.
    #[test]
    fn a_sphere_has_its_surface_where_it_should() {
        let radius = 80.0;
        let transfer = ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 1.0)], 100.0);
        // 128 at the radius, and 8 more for each voxel inwards.
        let mut scene = cube(transfer, |at| {
            128.0 + 8.0 * (radius / 4.0 - (at - 32.0).length())
        });
        scene.iso = 128.0;
        let [own, ..] = surface_color(&scene);
        for off in [0.0, 30.0, 55.0, 70.0] {
            let at = DVec2::new(128.0 + off * 0.6, 128.0 - off * 0.8);
            let deep = f64::sqrt(radius * radius - off * off);
            let [light, _, blue] = light_at(&scene, at, Mode::IsoSurface, Clip::default());
            let want = own * (0.15 + 0.85 * deep / radius);
            assert!(
                (light - want).abs() < 0.02 * own,
                "{off} nm off: {light}, not {want}"
            );
            assert_eq!(light, blue, "the background is hidden");
            // Only what ends behind the surface shows it: it is met there, to half a voxel.
            let front = 128.0 - deep;
            for (end, met) in [(front - 2.0, false), (front + 2.0, true)] {
                let clip = slab_at(end / 2.0, end);
                let seen = light_at(&scene, at, Mode::IsoSurface, clip);
                assert_eq!(seen[2] < 0.9, met, "{off} nm off, up to {end} nm: {seen:?}");
            }
        }
    }

    /// What is cut through is as bright as the cut faces the eye, whatever the values there.
    #[test]
    fn a_cut_is_lit_as_a_plane() {
        let transfer = ramp(Polarity::Bright, ColorMap::Green, &[(0.0, 1.0)], 100.0);
        let mut scene = cube(transfer, |at| {
            let noise = at.floor().dot(DVec3::new(17.0, 29.0, 71.0)) % 13.0;
            60.0 + 10.0 * noise
        });
        // Nearly black in its own colour.
        scene.iso = 3.0;
        let clip = Clip {
            half_spaces: [
                Some(saccade_render::HalfSpace {
                    point: Point::new(DVec3::splat(128.0)),
                    normal: DVec3::new(1.0, 0.0, 2.0),
                }),
                None,
                None,
                None,
            ],
            ..Clip::default()
        };
        let facing = 2.0 / 5.0_f64.sqrt();
        let [red, green, _] = light_at(&scene, DVec2::splat(128.0), Mode::IsoSurface, clip);
        let want = 0.5 * (0.15 + 0.85 * facing);
        assert!((green - want).abs() < 0.01, "{green}, not {want}");
        assert!(red < 0.01, "{red}");
    }

    #[test]
    fn the_maximum_of_a_ramp_is_at_its_end() {
        let transfer = ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 0.0)], 100.0);
        let scene = cube(transfer.clone(), |at| 10.0 + 3.0 * (at.z - 0.5));
        let middle = DVec2::splat(128.0);
        let shown = |value: f64| f64::from(transfer.color_at((value / 255.0) as f32)[0]);
        for (clip, value) in [
            (Clip::default(), 199.0),
            // Up to the middle of the fifth voxel, and between two others.
            (slab_at(9.0, 18.0), 22.0),
            (slab_at(150.0, 20.0), 10.0 + 3.0 * 39.5),
        ] {
            let [light, ..] = light_at(&scene, middle, Mode::Maximum, clip);
            let want = shown(value);
            assert!(
                (light - want).abs() < 0.01 * want,
                "{clip:?}: {light}, not {want}"
            );
        }
    }

    /// Extinctions add up; light is shared by them.
    #[test]
    fn two_constant_channels_mix_by_extinction() {
        // Colours that do not depend on the value, as that fades towards the faces.
        let transfer = |map, opacity| TransferFunction {
            window: [-1.0, 0.0],
            ..ramp(Polarity::Bright, map, &[(0.0, opacity)], 50.0)
        };
        let of = |map, opacity| {
            let scene = cube(transfer(map, opacity), |_| 0.0);
            Scene {
                levels: scene.levels.iter().map(|l| vec![1; l.len()]).collect(),
                ..scene
            }
        };
        let (green, magenta) = (of(ColorMap::Green, 0.3), of(ColorMap::Magenta, 0.1));
        let extinctions = [0.3_f64, 0.1].map(|opacity| -(1.0 - opacity).ln() / 50.0);
        let colors = [&green, &magenta].map(|scene| color(scene, 1.0));
        let scene = Scene::of_channels(vec![green, magenta]);
        let thickness = 100.0;
        let clip = slab_at(128.0, thickness);
        let light = light_at(&scene, DVec2::splat(128.0), Mode::EmissionAbsorption, clip);
        let sum: f64 = extinctions.iter().sum();
        let transmitted = (-sum * thickness).exp();
        for c in 0..3 {
            let emitted = (extinctions[0] * colors[0][c] + extinctions[1] * colors[1][c]) / sum;
            let behind = if c == 2 { transmitted } else { 0.0 };
            let want = (1.0 - transmitted) * emitted + behind;
            assert!((light[c] - want).abs() < 1e-3, "{light:?} has not {want}");
        }
        assert!(light[0] > 0.05 && light[1] > 0.3, "{light:?}");
    }

    #[test]
    fn a_slab_lets_through_what_its_thickness_says() {
        let transfer = ramp(Polarity::Bright, ColorMap::Gray, &[(0.0, 0.2)], 50.0);
        let scene = cube(transfer, |_| 0.0);
        let scene = Scene {
            levels: scene.levels.iter().map(|l| vec![1; l.len()]).collect(),
            ..scene
        };
        for thickness in [1.0, 20.0, 77.0, 200.0] {
            let clip = slab_at(128.0, thickness);
            let at = DVec2::splat(128.0);
            let [.., blue] = light_at(&scene, at, Mode::EmissionAbsorption, clip);
            let want = 0.8_f64.powf(thickness / 50.0);
            assert!(
                (blue - want).abs() < 1e-3,
                "{thickness} nm: {blue} not {want}"
            );
        }
    }
}
