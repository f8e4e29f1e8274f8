//! Volumes as plain arrays, one per level.

use std::sync::Arc;

use glam::{DVec3, UVec3};
use saccade_core::brick::{BRICK_BORDER, BRICK_EDGE, BRICK_STORED_EDGE, BrickId};
use saccade_core::levels::Level;
use saccade_core::transfer::{ColorMap, OpacityPoint, TABLE_LEN, TransferFunction};
use saccade_core::volume::{Dtype, Polarity, Volume};
use saccade_core::voxel_box::VoxelBox;
use saccade_render::ChannelView;

/// All levels of a volume, in main memory.
pub(crate) struct Scene {
    pub(crate) volume: Arc<Volume>,
    /// Per level, x fastest.
    pub(crate) levels: Vec<Vec<u8>>,
    pub(crate) transfer: TransferFunction,
    pub(crate) table: [[f32; 4]; TABLE_LEN],
    /// Value of the surface, `[0, 255]`.
    pub(crate) iso: f64,
    /// Channels after the first, of the same shape.
    pub(crate) others: Vec<Self>,
    /// 1, or what 16-bit values are more than 8-bit ones.
    pub(crate) factor: u16,
}

impl Scene {
    pub(crate) fn new(
        extent: UVec3,
        voxel_nm: DVec3,
        transfer: TransferFunction,
        value: impl Fn(DVec3) -> f64,
    ) -> Self {
        let volume = Volume::new("scene", extent, voxel_nm).unwrap();
        let finest = VoxelBox::of_size(extent).iter().map(|voxel| {
            let nm = (voxel.as_dvec3() + 0.5) * voxel_nm;
            value(nm).round().clamp(0.0, 255.0) as u8
        });
        let mut levels = vec![finest.collect::<Vec<u8>>()];
        for level in &volume.levels[1..] {
            let down = level.downsampling.as_uvec3();
            let average = |voxel: UVec3| {
                let covered = VoxelBox::new(voxel * down, (voxel + 1) * down);
                let covered = covered.intersection(VoxelBox::of_size(extent));
                let sum: u64 = covered
                    .iter()
                    .map(|v| u64::from(levels[0][flat(v, extent)]))
                    .sum();
                ((sum + covered.voxels() / 2) / covered.voxels()) as u8
            };
            let coarser = VoxelBox::of_size(level.extent)
                .iter()
                .map(average)
                .collect();
            levels.push(coarser);
        }
        Self {
            volume: Arc::new(volume),
            levels,
            table: transfer.table(),
            transfer,
            iso: 128.0,
            others: Vec::new(),
            factor: 1,
        }
    }

    /// A volume whose levels are coarser than the first by these factors. Each voxel is what its middle is.
    pub(crate) fn with_levels(
        extent: UVec3,
        voxel_nm: DVec3,
        factors: &[DVec3],
        transfer: TransferFunction,
        value: impl Fn(DVec3) -> f64,
    ) -> Self {
        let plain = Self::new(extent, voxel_nm, transfer, |_| 0.0);
        let levels = factors.iter().map(|&downsampling| Level {
            extent: (extent.as_dvec3() / downsampling).ceil().as_uvec3(),
            downsampling,
        });
        let levels: Vec<_> = levels.collect();
        let voxels = levels.iter().map(|level| {
            let voxels = VoxelBox::of_size(level.extent).iter();
            let middle = |voxel: UVec3| (voxel.as_dvec3() + 0.5) * level.downsampling * voxel_nm;
            let values = voxels.map(|voxel| value(middle(voxel)).round().clamp(0.0, 255.0) as u8);
            values.collect()
        });
        Self {
            levels: voxels.collect(),
            volume: Arc::new(Volume {
                levels,
                ..(*plain.volume).clone()
            }),
            ..plain
        }
    }

    /// A volume of several channels, all of the same shape.
    pub(crate) fn of_channels(mut channels: Vec<Self>) -> Self {
        let mut first = channels.remove(0);
        let names = (0..=channels.len()).map(|n| format!("channel {n}"));
        first.volume = Arc::new(Volume {
            channels: names.collect(),
            ..(*first.volume).clone()
        });
        first.others = channels;
        first
    }

    /// The same in 16 bit, values `factor` times as large.
    pub(crate) fn deep(mut self, factor: u16) -> Self {
        self.volume = Arc::new(Volume {
            dtype: Dtype::Uint16,
            ..(*self.volume).clone()
        });
        self.factor = factor;
        self.others = self.others.into_iter().map(|c| c.deep(factor)).collect();
        self
    }

    /// All channels.
    pub(crate) fn channels(&self) -> impl Iterator<Item = &Self> {
        std::iter::once(self).chain(&self.others)
    }

    /// How all channels are seen.
    pub(crate) fn views(&self) -> Vec<ChannelView> {
        let largest = if self.factor == 1 { 255.0 } else { 65_535.0 };
        let scale = f32::from(self.factor) * 255.0 / largest;
        let views = (0..).zip(self.channels()).map(|(channel, scene)| {
            let mut transfer = scene.transfer.clone();
            transfer.window = transfer.window.map(|value| value * scale);
            for point in &mut transfer.opacity {
                point.value *= scale;
            }
            ChannelView {
                iso: (scene.iso * f64::from(self.factor)) as f32 / largest,
                significant_bits: 8 + u32::from(self.factor.ilog2() as u8),
                ..ChannelView::new(channel, transfer)
            }
        });
        views.collect()
    }

    /// Stored value of a voxel of a level; 0 outside.
    pub(crate) fn stored(&self, level: usize, voxel: [i64; 3]) -> u8 {
        let extent = self.volume.levels[level].extent;
        let inside = (0..3).all(|a| (0..i64::from(extent[a])).contains(&voxel[a]));
        if !inside {
            return 0;
        }
        let voxel = UVec3::from_array(voxel.map(|v| u32::try_from(v).unwrap()));
        self.transfer
            .polarity
            .stored(self.levels[level][flat(voxel, extent)])
    }

    /// A brick with its border, as a source delivers it; `None` where nothing was acquired.
    pub(crate) fn brick(&self, id: BrickId) -> Option<Vec<u8>> {
        if let Some(other) = id.channel().checked_sub(1) {
            let id = BrickId::new(0, id.level(), id.brick()).unwrap();
            return self.others[other as usize].brick(id);
        }
        let level = id.level() as usize;
        let low = (id.brick() * BRICK_EDGE).as_i64vec3() - i64::from(BRICK_BORDER);
        let voxels = VoxelBox::of_size(UVec3::splat(BRICK_STORED_EDGE))
            .iter()
            .map(|offset| {
                let stored = self.stored(level, (low + offset.as_i64vec3()).to_array());
                self.transfer.polarity.stored(stored)
            });
        let voxels: Vec<u8> = voxels.collect();
        let some = voxels.iter().any(|&v| v != 0);
        some.then(|| match self.factor {
            1 => voxels,
            factor => {
                let deep = voxels.iter().map(|&v| u16::from(v) * factor);
                deep.flat_map(u16::to_le_bytes).collect()
            }
        })
    }
}

fn flat(voxel: UVec3, extent: UVec3) -> usize {
    ((voxel.z * extent.y + voxel.y) * extent.x + voxel.x) as usize
}

/// A ramp of opacity over the values, in grey or colour.
pub(crate) fn ramp(
    polarity: Polarity,
    color_map: ColorMap,
    points: &[(f32, f32)],
    nm: f64,
) -> TransferFunction {
    let point = |&(value, opacity): &(f32, f32)| OpacityPoint { value, opacity };
    TransferFunction {
        polarity,
        color_map,
        window: [0.0, 1.0],
        opacity: points.iter().map(point).collect(),
        opacity_length_nm: nm,
    }
}

/// Smooth waves, in odd sizes and voxels five times as thick as wide.
pub(crate) fn waves() -> Scene {
    let transfer = ramp(
        Polarity::Bright,
        ColorMap::Gray,
        &[(0.3, 0.0), (0.8, 0.7)],
        40.0,
    );
    Scene::new(
        UVec3::new(61, 47, 33),
        DVec3::new(4.0, 4.0, 20.0),
        transfer,
        |nm| {
            let wave = (nm.x / 31.0).sin()
                + (nm.y / 23.0 + 1.0).cos()
                + (nm.z / 97.0 + nm.x / 200.0).sin();
            128.0 + 40.0 * wave
        },
    )
}

/// Bright cells with dark walls and dark spots, as electron microscopy shows tissue; a corner is
/// not acquired yet.
pub(crate) fn tissue() -> Scene {
    let transfer = ramp(
        Polarity::Dark,
        ColorMap::Gray,
        &[(0.1, 0.9), (0.45, 0.0)],
        16.0,
    );
    let size = DVec3::new(151.0 * 4.0, 133.0 * 4.0, 21.0 * 20.0);
    let seeds: Vec<DVec3> = (0..40).map(|n| halton(n) * size).collect();
    Scene::new(
        UVec3::new(151, 133, 21),
        DVec3::new(4.0, 4.0, 20.0),
        transfer,
        move |nm| {
            if nm.x > size.x * 0.7 && nm.y < size.y * 0.4 {
                return 0.0;
            }
            let mut distances: Vec<f64> = seeds.iter().map(|s| s.distance(nm)).collect();
            distances.sort_by(f64::total_cmp);
            let wall = ((distances[1] - distances[0]) / 12.0).min(1.0);
            let spot = ((distances[0] - 14.0) / 8.0).clamp(0.0, 1.0);
            1.0 + 220.0 * wall * (0.4 + 0.6 * spot)
        },
    )
}

/// A few bright spots in matter that is dim, and nowhere quite empty.
pub(crate) fn specks() -> Scene {
    let transfer = ramp(
        Polarity::Bright,
        ColorMap::Gray,
        &[(0.4, 0.0), (0.7, 0.8)],
        20.0,
    );
    let extent = UVec3::new(142, 129, 75);
    let size = extent.as_dvec3() * 4.0;
    let seeds: Vec<DVec3> = (0..9).map(|n| halton(n) * size).collect();
    Scene::new(extent, DVec3::splat(4.0), transfer, move |nm| {
        let near = seeds.iter().map(|s| s.distance(nm));
        let near = near.fold(f64::INFINITY, f64::min);
        let dim = 30.0 + 20.0 * (nm.x / 7.0).sin() * (nm.y / 5.0).cos() + (nm.z / 3.0).sin();
        dim + 200.0 * (1.0 - near / 40.0).max(0.0)
    })
}

/// Three kinds of matter, each in its channel and colour: waves, specks, and a slanted sheet.
pub(crate) fn stained() -> Scene {
    let extent = UVec3::new(61, 47, 33);
    let nm = DVec3::new(4.0, 4.0, 20.0);
    let transfer = |map, from, to| ramp(Polarity::Bright, map, &[(from, 0.0), (to, 0.5)], 40.0);
    let waves = Scene::new(extent, nm, transfer(ColorMap::Green, 0.4, 0.8), |nm| {
        128.0 + 50.0 * ((nm.x / 31.0).sin() + (nm.y / 23.0 + 1.0).cos() * (nm.z / 97.0).sin())
    });
    let size = extent.as_dvec3() * nm;
    let seeds: Vec<DVec3> = (0..12).map(|n| halton(n) * size).collect();
    let specks = Scene::new(extent, nm, transfer(ColorMap::Magenta, 0.2, 0.9), |nm| {
        let near = seeds.iter().map(|s| s.distance(nm));
        20.0 + 220.0 * (1.0 - near.fold(f64::INFINITY, f64::min) / 50.0).max(0.0)
    });
    let sheet = Scene::new(extent, nm, transfer(ColorMap::Inferno, 0.3, 1.0), |nm| {
        let off = (nm.x + nm.y * 0.5 + nm.z * 0.3 - 250.0).abs();
        // Nothing was imaged in a corner of this channel.
        if nm.x < 40.0 {
            0.0
        } else {
            10.0 + 200.0 * (1.0 - off / 60.0).max(0.0)
        }
    });
    Scene::of_channels(vec![waves, specks, sheet])
}

/// Points that fill the unit cube evenly.
fn halton(n: u32) -> DVec3 {
    let radical = |base: u32| {
        let (mut value, mut scale, mut rest) = (0.0, 1.0, n + 1);
        while rest > 0 {
            scale /= f64::from(base);
            value += scale * f64::from(rest % base);
            rest /= base;
        }
        value
    };
    DVec3::new(radical(2), radical(3), radical(5))
}
