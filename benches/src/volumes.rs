//! Volumes like those of the papers, given by formulas, so that a brick of any size of volume is made when it is needed.

use std::collections::HashMap;
use std::f64::consts::TAU;
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::Result;
use glam::{DVec3, IVec3, UVec3};
use saccade_core::brick::{BRICK_BORDER, BRICK_EDGE, BRICK_STORED_EDGE, BrickId};
use saccade_core::phantom::Phantom;
use saccade_core::transfer::{ColorMap, TransferFunction};
use saccade_core::volume::{Dtype, Volume};
use saccade_core::voxel_box::VoxelBox;
use saccade_render::ChannelView;

use crate::bricks::{Bricks, ramp};

/// What is where: a value from 0 to 1 of a channel at a place \[level-0 voxels\].
type Value = Box<dyn Fn(u32, DVec3) -> f64 + Send + Sync>;

/// A volume by formula. A coarse voxel is what its middle is.
pub(crate) struct Formula {
    pub(crate) volume: Arc<Volume>,
    value: Value,
    /// Whether all channels are the first.
    alike: bool,
    /// Bricks made so far: each of several ways to draw asks for them.
    made: Mutex<HashMap<BrickId, Arc<[u8]>>>,
}

impl Formula {
    pub(crate) fn new(
        extent: UVec3,
        voxel_nm: DVec3,
        dtype: Dtype,
        channels: u32,
        value: impl Fn(u32, DVec3) -> f64 + Send + Sync + 'static,
    ) -> Result<Self> {
        let volume = Volume::new("bench", extent, voxel_nm)?;
        let volume = Volume {
            dtype,
            channels: (0..channels).map(|c| format!("channel {c}")).collect(),
            ..volume
        };
        Ok(Self {
            volume: Arc::new(volume),
            value: Box::new(value),
            alike: false,
            made: Mutex::default(),
        })
    }

    /// Simulates channels: all are the first.
    fn alike(self) -> Self {
        Self {
            alike: true,
            ..self
        }
    }

    fn make(&self, id: BrickId) -> Vec<u8> {
        let level = &self.volume.levels[id.level() as usize];
        let low = (id.brick() * BRICK_EDGE).as_ivec3() - BRICK_BORDER.cast_signed();
        let end = self.volume.extent().as_dvec3();
        let cells = VoxelBox::of_size(UVec3::splat(BRICK_STORED_EDGE)).iter();
        let values = cells.map(|cell| {
            let at = (low + cell.as_ivec3()).clamp(IVec3::ZERO, level.extent.as_ivec3() - 1);
            let middle = (at.as_dvec3() + 0.5) * level.downsampling;
            (self.value)(id.channel(), middle.min(end - 0.5))
        });
        #[expect(
            clippy::cast_possible_truncation,
            reason = "from 0 to 1 times the largest"
        )]
        #[expect(clippy::cast_sign_loss, reason = "from 0 to 1 times the largest")]
        match self.volume.dtype {
            Dtype::Uint16 => values
                .flat_map(|v| ((v * 65_535.0) as u16).to_le_bytes())
                .collect(),
            _ => values.map(|v| (v * 255.0) as u8).collect(),
        }
    }
}

impl Bricks for Formula {
    fn brick(&self, id: BrickId) -> Option<Vec<u8>> {
        let id = match BrickId::new(0, id.level(), id.brick()) {
            Ok(first) if self.alike => first,
            _ => id,
        };
        let made = || self.made.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(brick) = made().get(&id) {
            return Some(brick.to_vec());
        }
        let brick = self.make(id);
        made().insert(id, brick.as_slice().into());
        Some(brick)
    }
}

/// Tissue of any extent, in voxels of 4 x 4 x 30 nm.
pub(crate) struct Tissue {
    pub(crate) volume: Arc<Volume>,
    levels: Vec<Phantom>,
    /// Bricks made so far: those of coarse levels take a second.
    made: Mutex<HashMap<BrickId, Arc<[u8]>>>,
}

impl Tissue {
    pub(crate) fn new(extent: UVec3) -> Result<Self> {
        let volume = Volume::new("bench", extent, DVec3::new(4.0, 4.0, 30.0))?;
        let phantom = |level: &saccade_core::levels::Level| {
            Phantom::new(1, volume.voxel_nm * level.downsampling)
        };
        let levels = volume
            .levels
            .iter()
            .map(phantom)
            .collect::<Result<_, _>>()?;
        Ok(Self {
            volume: Arc::new(volume),
            levels,
            made: Mutex::default(),
        })
    }

    fn make(&self, id: BrickId) -> Vec<u8> {
        let mut sampler = self.levels[id.level() as usize].sampler();
        let extent = self.volume.levels[id.level() as usize].extent.as_ivec3();
        let low = (id.brick() * BRICK_EDGE).as_ivec3() - BRICK_BORDER.cast_signed();
        let at = |offset: IVec3| (low + offset).clamp(IVec3::ZERO, extent - 1).as_uvec3();
        let edge = BRICK_STORED_EDGE as usize;
        let mut voxels = Vec::with_capacity(edge.pow(3));
        let mut row = vec![0; edge];
        for z in 0..BRICK_STORED_EDGE.cast_signed() {
            for y in 0..BRICK_STORED_EDGE.cast_signed() {
                let first = at(IVec3::new(0, y, z));
                let last = at(IVec3::new(BRICK_STORED_EDGE.cast_signed() - 1, y, z));
                let inside = (last.x - first.x + 1) as usize;
                sampler.row(first.x, first.y, first.z, &mut row[..inside]);
                // Voxels outside repeat the nearest one inside.
                let before = usize::from(low.x < 0);
                voxels.extend((0..edge).map(|x| row[x.saturating_sub(before).min(inside - 1)]));
            }
        }
        voxels
    }
}

impl Bricks for Tissue {
    fn brick(&self, id: BrickId) -> Option<Vec<u8>> {
        let made = || self.made.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(brick) = made().get(&id) {
            return Some(brick.to_vec());
        }
        let brick = self.make(id);
        made().insert(id, brick.as_slice().into());
        Some(brick)
    }
}

/// A data set of a table, and how it is seen.
pub(crate) struct Case {
    pub(crate) formula: Formula,
    pub(crate) views: Vec<ChannelView>,
}

/// How large things are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Scale {
    /// For drivers that draw on the CPU.
    Small,
    /// As large as such a driver draws in minutes: each ray meets about half as many bricks as in the papers, or as many.
    Medium,
    /// As published.
    Paper,
}

/// The data sets of \[001 table 9.1\].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum DataSet {
    Aneurism,
    Bonsai,
    Kingsnake,
    CycifSmall,
    CycifMedium,
    CycifLarge,
}

const COLORS: [ColorMap; 8] = [
    ColorMap::Gray,
    ColorMap::Green,
    ColorMap::Magenta,
    ColorMap::Cyan,
    ColorMap::Yellow,
    ColorMap::Red,
    ColorMap::Blue,
    ColorMap::Bone,
];

impl DataSet {
    /// Channels 0 to `channels` of it.
    pub(crate) fn case(self, scale: Scale, channels: u32) -> Result<Case> {
        let extent = self.extent(scale);
        let size = extent.as_dvec3();
        let scanned = DVec3::splat(1000.0);
        let tissue = DVec3::new(140.0, 140.0, 280.0);
        let (formula, levels) = match self {
            Self::Aneurism => {
                let value = move |_, at: DVec3| vessels(at / size);
                (
                    Formula::new(extent, scanned, Dtype::Uint8, channels, value)?.alike(),
                    0..=u32::MAX,
                )
            }
            Self::Bonsai => {
                let value = move |_, at: DVec3| plant(at / size, at);
                (
                    Formula::new(extent, scanned, Dtype::Uint8, channels, value)?.alike(),
                    0..=u32::MAX,
                )
            }
            Self::Kingsnake => {
                let value = snake(extent);
                let value = move |_, at: DVec3| value(at);
                (
                    Formula::new(extent, scanned, Dtype::Uint8, channels, value)?.alike(),
                    0..=u32::MAX,
                )
            }
            Self::CycifSmall => {
                let value = move |channel, at: DVec3| cells(channel, at);
                (
                    Formula::new(extent, tissue, Dtype::Uint16, channels, value)?,
                    0..=u32::MAX,
                )
            }
            Self::CycifMedium | Self::CycifLarge => {
                // The microscope recorded more than the tissue: nothing above and below.
                let value = move |channel, at: DVec3| {
                    let inside = (0.15..0.85).contains(&(at.z / size.z));
                    if inside { cells(channel, at) } else { 0.0 }
                };
                let (dtype, levels) = match self {
                    Self::CycifMedium => (Dtype::Uint16, 0..=u32::MAX),
                    _ => (Dtype::Uint8, 1..=u32::MAX),
                };
                (
                    Formula::new(extent, tissue, dtype, channels, value)?,
                    levels,
                )
            }
        };
        let views = (0..channels).map(|channel| ChannelView {
            levels: levels.clone(),
            significant_bits: 16,
            ..ChannelView::new(channel, self.transfer(channel))
        });
        Ok(Case {
            formula,
            views: views.collect(),
        })
    }

    fn extent(self, scale: Scale) -> UVec3 {
        let [x, y, z] = match (self, scale) {
            (Self::Aneurism | Self::Bonsai, Scale::Medium | Scale::Paper) => [256; 3],
            (Self::Aneurism | Self::Bonsai, Scale::Small) => [96; 3],
            (Self::Kingsnake, Scale::Paper) => [1024, 1024, 795],
            (Self::Kingsnake, Scale::Medium) => [512, 512, 398],
            (Self::Kingsnake, Scale::Small) => [160, 160, 124],
            (Self::CycifSmall, Scale::Paper) => [1024, 1024, 40],
            (Self::CycifSmall, Scale::Medium) => [256, 256, 40],
            (Self::CycifSmall, Scale::Small) => [64, 64, 40],
            (Self::CycifMedium, Scale::Paper) => [1024, 1024, 105],
            (Self::CycifMedium, Scale::Medium) => [256, 256, 105],
            (Self::CycifMedium, Scale::Small) => [64, 64, 53],
            (Self::CycifLarge, Scale::Paper) => [5632, 4352, 160],
            (Self::CycifLarge, Scale::Medium) => [704, 544, 160],
            (Self::CycifLarge, Scale::Small) => [176, 136, 80],
        };
        UVec3::new(x, y, z)
    }

    /// Opacity of a channel; of simulated ones, of different values.
    fn transfer(self, channel: u32) -> TransferFunction {
        let (low, high, nm) = match (self, channel) {
            (Self::Aneurism, 0) => (0.3, 0.8, 2000.0),
            (Self::Aneurism, 1) => (0.5, 0.9, 2000.0),
            (Self::Aneurism, 2) => (0.6, 0.95, 2000.0),
            (Self::Aneurism, _) => (0.7, 0.99, 2000.0),
            (Self::Bonsai, 0) => (0.22, 0.28, 3000.0),
            (Self::Bonsai, 1) => (0.45, 0.6, 2000.0),
            (Self::Bonsai, 2) => (0.65, 0.8, 2000.0),
            (Self::Bonsai, _) => (0.32, 0.38, 2000.0),
            (Self::Kingsnake, 0) => (0.55, 0.7, 1000.0),
            (Self::Kingsnake, 1) => (0.6, 0.75, 1000.0),
            (Self::Kingsnake, 2) => (0.7, 0.8, 1000.0),
            (Self::Kingsnake, _) => (0.8, 0.9, 1000.0),
            (_, _) => (0.2, 0.6, 3000.0),
        };
        TransferFunction {
            color_map: COLORS[channel as usize % COLORS.len()],
            window: [low * 0.5, high],
            ..ramp(low, high, 0.7, nm)
        }
    }
}

/// Thin bright vessels in nothing; places from 0 to 1.
fn vessels(at: DVec3) -> f64 {
    let mut value: f64 = 0.0;
    for vessel in 0..7 {
        let k = f64::from(vessel);
        let x = 0.5 + (0.12 + 0.04 * k) * (k * 2.1 + (3.0 + k) * at.z).sin();
        let y = 0.5 + (0.30 - 0.03 * k) * (k * 1.3 + (5.0 - 0.7 * k) * at.z).cos();
        let radius = 0.011 + 0.004 * (k * 1.7 + 9.0 * at.z).sin();
        let off = (at.x - x).hypot(at.y - y);
        value = value.max((1.6 - off / radius).clamp(0.0, 1.0));
    }
    // The aneurism itself.
    let bulge = (at - DVec3::new(0.55, 0.42, 0.5)).length() / 0.07;
    value.max((2.0 - 2.0 * bulge).clamp(0.0, 1.0)) * 0.99
}

/// A tree in a pot, in nothing; places from 0 to 1, and in voxels.
pub(crate) fn plant(at: DVec3, voxel: DVec3) -> f64 {
    let across = (at.x - 0.5).hypot(at.z - 0.5);
    if (0.76..0.93).contains(&at.y) && across < 0.26 {
        return if across > 0.23 { 0.8 } else { 0.72 };
    }
    if (0.73..0.76).contains(&at.y) && across < 0.25 {
        return 0.36;
    }
    let bend = 0.05 * (at.y * 9.0).sin();
    if (0.35..0.73).contains(&at.y) && (at.x - 0.5 - bend).hypot(at.z - 0.5) < 0.035 {
        return 0.55;
    }
    let crown = ((at - DVec3::new(0.52, 0.3, 0.5)) / DVec3::new(0.36, 0.2, 0.34)).length();
    if crown < 1.0 && random((voxel / 5.0).floor(), 1) > 0.55 {
        return 0.27;
    }
    0.0
}

/// A thin, bright, coiled tube in matter that is dim and noisy, and nowhere zero: what the
/// scan of a snake in its egg is like.
fn snake(extent: UVec3) -> impl Fn(DVec3) -> f64 {
    let middle = extent.as_dvec3() / 2.0;
    let radius = middle.x * 0.6;
    let pitch = f64::from(extent.z) / 4.0;
    let thick = f64::from(extent.x) / 256.0;
    move |place| {
        let at = place - middle;
        let around = at.y.atan2(at.x) / TAU;
        let turn = ((at.z / pitch - around).fract() + 1.5).fract() - 0.5;
        let off = (at.truncate().length() - radius).hypot(turn * pitch) / thick;
        let vertebra = (around * 120.0).sin();
        let noise = 16.0 * random(place.floor(), 7);
        let inside = (at / middle).length() < 0.95;
        let value = match off < 3.5 + vertebra {
            true => 190.0 + 3.0 * noise,
            false if inside => 40.0 + 2.0 * noise,
            false => 4.0 + noise,
        };
        value / 255.0
    }
}

/// Tissue of cells, of which a channel shows some: in one the nuclei of all, in others the rims or bodies of a few.
fn cells(channel: u32, at: DVec3) -> f64 {
    const EDGE: DVec3 = DVec3::new(24.0, 24.0, 12.0);
    let cell = (at / EDGE).floor();
    let jitter = DVec3::new(random(cell, 11), random(cell, 12), random(cell, 13));
    let middle = (cell + 0.35 + 0.3 * jitter) * EDGE;
    let off = ((at - middle) / (EDGE * 0.33)).length();
    let dim = 0.01 + 0.02 * random(at.floor(), 100 + channel);
    let shown = match channel {
        0 => true,
        // Kinds of cells live together, in patches.
        _ => {
            random((at / 160.0).floor(), 200 + channel) < 0.35 && random(cell, 300 + channel) < 0.5
        }
    };
    if !shown || off > 1.0 {
        return dim;
    }
    let bright = 0.45 + 0.4 * random(cell, 400 + channel);
    let part = match channel % 3 {
        0 => off < 0.6,
        1 => off > 0.7,
        _ => true,
    };
    if part { bright } else { dim + 0.05 }
}

/// A fixed number from 0 to 1 for a place on a grid.
fn random(at: DVec3, seed: u32) -> f64 {
    let [x, y, z] = at.as_ivec3().to_array().map(i32::cast_unsigned);
    let mut hash = x.wrapping_mul(73_856_093)
        ^ y.wrapping_mul(19_349_663)
        ^ z.wrapping_mul(83_492_791)
        ^ seed.wrapping_mul(2_654_435_761);
    hash ^= hash >> 15;
    hash = hash.wrapping_mul(2_246_822_519);
    hash ^= hash >> 13;
    f64::from(hash) / f64::from(u32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_fit_and_bricks_are_whole() {
        for set in [
            DataSet::Aneurism,
            DataSet::Bonsai,
            DataSet::Kingsnake,
            DataSet::CycifSmall,
            DataSet::CycifMedium,
            DataSet::CycifLarge,
        ] {
            let case = set.case(Scale::Small, 2).unwrap();
            let volume = &case.formula.volume;
            let last = u32::try_from(volume.levels.len() - 1).unwrap();
            let id = BrickId::new(1, last, UVec3::ZERO).unwrap();
            let brick = case.formula.brick(id).unwrap();
            let bytes = BRICK_STORED_EDGE.pow(3) as usize * volume.dtype.bytes();
            assert_eq!(brick.len(), bytes, "{set:?}");
            assert!(brick.iter().any(|v| *v > 0), "{set:?} shows nothing");
            let extent = volume.extent();
            for n in 0..2000_u32 {
                let place = [n * 7, n * 13, n * 3].map(|v| v + n / 5);
                let at = (UVec3::from_array(place) % extent).as_dvec3() + 0.5;
                let value = (case.formula.value)(n % 2, at);
                assert!((0.0..=1.0).contains(&value), "{set:?}: {value} at {at}");
            }
        }
    }

    /// What a table says of a data set is so: one is mostly zeros, another nowhere.
    #[test]
    fn data_sets_are_as_dense_as_published() {
        let zeros = |set: DataSet| {
            let case = set.case(Scale::Small, 1).unwrap();
            let size = case.formula.volume.extent().as_dvec3();
            let places = (0..4000_u32).map(|n| {
                let part = |k: f64| (f64::from(n) * k).fract();
                DVec3::new(part(0.754_87), part(0.569_84), part(0.438_2)) * size
            });
            let zero = places.filter(|at| (case.formula.value)(0, *at) == 0.0);
            zero.count() as f64 / 4000.0
        };
        assert!(zeros(DataSet::Aneurism) > 0.9);
        assert!(zeros(DataSet::Bonsai) > 0.7);
        assert!(zeros(DataSet::Kingsnake) < 0.01);
        assert!(zeros(DataSet::CycifSmall) < 0.01);
    }
}
