//! What an electron microscope would see: dark membranes on bright cytoplasm.
//!
//! Values are on the scale of 8-bit images. Lengths are those of stained tissue, but nothing is
//! thinner than the voxels can show.

use glam::{DVec3, IVec3};

use super::Phantom;
use super::bundle::SYNAPSE_REACH_NM;
use super::noise::RowNoise;
use super::random::{floor3, hash, mix, signed, unit};
use super::sampler::{InBundle, Spot};
use super::territory::{BORDER_REACH_NM, Territory, Tissue};

const CYTOPLASM: f64 = 187.0;
const MEMBRANE: f64 = 66.0;
const CLEFT: f64 = 34.0;
const MITOCHONDRION: f64 = 118.0;
const MYELIN: f64 = 52.0;
const LUMEN: f64 = 226.0;

/// Paints the voxels of one row.
pub(super) struct RowPaint {
    seed: u64,
    y: u32,
    z: u32,
    /// Half width of a membrane \[nm\].
    membrane_nm: f64,
    fine: RowNoise<1>,
    grain: RowNoise<1>,
    cloud: RowNoise<1>,
    mottle: RowNoise<1>,
    slow: RowNoise<1>,
}

/// 1 at 0, easing to 0 at `reach`.
fn bump(distance: f64, reach: f64) -> f64 {
    let t = distance / reach;
    let left = (1.0 - t * t).max(0.0);
    left * left
}

/// 0 below `-soft`, 1 above `soft`.
fn step(value: f64, soft: f64) -> f64 {
    let t = (0.5 + 0.5 * value / soft).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

fn mixed(from: f64, to: f64, share: f64) -> f64 {
    from + (to - from) * share
}

impl RowPaint {
    pub(super) fn new(phantom: &Phantom, y: u32, z: u32) -> Self {
        let (y_nm, z_nm) = phantom.row_nm(y, z);
        let seed = phantom.paint_seed();
        let noise = |n: u64, period| RowNoise::new(mix(seed ^ n), period, y_nm, z_nm);
        Self {
            seed,
            y,
            z,
            membrane_nm: phantom.membrane_nm(),
            fine: noise(1, 15.0),
            grain: noise(2, 48.0),
            cloud: noise(3, 520.0),
            mottle: noise(5, 190.0),
            slow: noise(4, 23_000.0),
        }
    }

    /// The value of voxel `x`, at `x_nm`. At least 1: the phantom is measured everywhere.
    pub(super) fn value(&mut self, x: u32, x_nm: f64, spot: &Spot<'_>) -> u8 {
        let ([cloud], [mottle]) = (self.cloud.at(x_nm), self.mottle.at(x_nm));
        let cloud = 0.75 * cloud + 0.45 * mottle;
        let [grain] = self.grain.at(x_nm);
        let inside = match &spot.neurite {
            Some(neurite) => self.neurite(neurite, spot, grain),
            None if spot.here.territory.tissue == Tissue::Soma => self.soma(spot, cloud, grain),
            None => self.vessel(spot, grain),
        };
        let membrane = bump(spot.border_nm, 2.0 * self.membrane_nm);
        let mut value = mixed(inside, MEMBRANE.min(inside), membrane);
        if let Some(neurite) = &spot.neurite {
            value = self.synapses(neurite, value);
        }
        let [fine] = self.fine.at(x_nm);
        let [slow] = self.slow.at(x_nm);
        let bits = hash(self.seed, voxel(x, self.y, self.z));
        let noise = signed(bits, 0) + signed(bits, 1) + signed(bits, 2);
        let texture = 8.0 * fine + 6.0 * noise;
        quantised(value * (1.0 + 0.05 * slow) + texture + 7.0 * slow)
    }

    fn neurite(&self, spot: &InBundle<'_>, whole: &Spot<'_>, grain: f64) -> f64 {
        let InBundle {
            bundle,
            neurite,
            at,
            ..
        } = spot;
        let bits = mix(neurite.site.id ^ 0xce11);
        let tone = 15.0 * signed(bits, 0) + if unit(bits, 1) < 0.12 { -22.0 } else { 0.0 };
        let mut value = CYTOPLASM + tone + 7.0 * grain;
        let from_site = *at - neurite.site.at;
        if bundle.across_nm > 400.0 && unit(bits, 1) > 0.92 {
            let depth = whole.border_nm.min(BORDER_REACH_NM);
            let lamellae = (depth * 0.7).sin();
            let wrapped = step(70.0 - depth, 5.0);
            return mixed(value + 14.0, MYELIN + 12.0 * lamellae, wrapped);
        }
        // A mitochondrion along the neurite, never through its membrane.
        if unit(bits, 2) < 0.5 {
            let along = (from_site.z - 0.5 * signed(bits, 3)) * bundle.along_nm;
            let radius = (0.27 * bundle.across_nm).min(170.0);
            let beyond = (along.abs() - 1.8 * radius).max(0.0);
            let off = DVec3::new(from_site.x, from_site.y, 0.0) * bundle.across_nm;
            let outside = (off.length_squared() + beyond * beyond).sqrt() - radius;
            let outside = outside.max(22.0 - whole.border_nm);
            let cristae = ((along + 0.35 * off.x) * 0.11).sin();
            value = self.mitochondrion(value, outside, cristae + grain);
        }
        value
    }

    fn mitochondrion(&self, around: f64, outside_nm: f64, cristae: f64) -> f64 {
        let inner = MITOCHONDRION + 13.0 * cristae;
        let value = mixed(around, inner, step(-outside_nm, 6.0));
        mixed(
            value,
            MEMBRANE + 14.0,
            bump(outside_nm, 1.8 * self.membrane_nm),
        )
    }

    fn soma(&self, spot: &Spot<'_>, cloud: f64, grain: f64) -> f64 {
        let Territory {
            centre, radius, id, ..
        } = spot.here.territory;
        let from_centre = spot.straight - centre;
        let lumpy = 1.0 + 0.05 * cloud;
        let outside_nucleus = from_centre.length() - 0.68 * radius * lumpy;
        if outside_nucleus < 0.0 {
            let offset = DVec3::new(signed(id, 0), signed(id, 1), signed(id, 2)) * 0.25 * radius;
            let nucleolus = (from_centre - offset).length() - 0.16 * radius * lumpy;
            let patches = step(cloud - 0.28, 0.16) * 38.0;
            let value = 168.0 + 9.0 * grain - patches;
            let value = mixed(value, 92.0 + 10.0 * grain, step(-nucleolus, 40.0));
            // Chromatin lines the envelope.
            let value = mixed(value, 128.0, 0.7 * bump(outside_nucleus, 130.0));
            return mixed(
                value,
                MEMBRANE,
                bump(outside_nucleus, 2.0 * self.membrane_nm),
            );
        }
        let mut value = 160.0 + 8.0 * grain;
        // Endoplasmic reticulum: sheets where the noise crosses zero.
        value -= 52.0 * bump(cloud + 0.12 * grain, 0.09);
        let organelle = floor3(spot.straight * (1.0 / 620.0));
        let bits = hash(id, organelle);
        if unit(bits, 3) < 0.5 {
            let jitter = DVec3::new(signed(bits, 0), signed(bits, 1), signed(bits, 2));
            let middle = (organelle.as_dvec3() + 0.5 + 0.14 * jitter) * 620.0;
            let axis = jitter.try_normalize().unwrap_or(DVec3::X);
            let off = spot.straight - middle;
            let along = off.dot(axis);
            let across = (off - axis * along).length();
            let beyond = (along.abs() - 80.0).max(0.0);
            let outside = (across * across + beyond * beyond).sqrt() - 125.0;
            let outside = outside
                .max(40.0 - spot.border_nm)
                .max(40.0 - outside_nucleus);
            value = self.mitochondrion(value, outside, (along * 0.12).sin() + grain);
        }
        mixed(
            value,
            MEMBRANE,
            bump(outside_nucleus, 2.0 * self.membrane_nm),
        )
    }

    fn vessel(&self, spot: &Spot<'_>, grain: f64) -> f64 {
        let Territory { centre, radius, .. } = spot.here.territory;
        // The wall, an endothelial cell, is what the lumen leaves; then a dark basal lamina.
        let inside = 1.3 * radius - (spot.straight - centre).length();
        let inside = inside.min(spot.border_nm - 60.0);
        let wall = 134.0 + 14.0 * grain;
        let wall = mixed(wall, 96.0, bump(spot.border_nm, 60.0));
        let value = mixed(wall, LUMEN, step(inside, 6.0));
        mixed(value, MEMBRANE, bump(inside, 2.0 * self.membrane_nm))
    }

    /// Clefts with their density and vesicles, over what is already there.
    fn synapses(&self, spot: &InBundle<'_>, value: f64) -> f64 {
        let InBundle {
            bundle,
            block,
            at,
            neurite,
        } = spot;
        let mut value = value;
        for junction in &block.junctions {
            let id = neurite.site.id;
            let presynaptic = id == junction.pre;
            if !presynaptic && id != junction.post {
                continue;
            }
            let off = *at - junction.at;
            let across = off.dot(junction.across);
            let distance = bundle.length_nm(off);
            if distance > SYNAPSE_REACH_NM {
                continue;
            }
            let aside = (distance * distance - across * across).max(0.0).sqrt();
            let zone = step(junction.radius_nm - aside, 12.0);
            // The density on the postsynaptic side is what makes a synapse stand out.
            let (reach, dark) = if presynaptic {
                (16.0, 52.0)
            } else {
                (40.0, CLEFT)
            };
            let reach = reach + self.membrane_nm;
            value = mixed(value, dark.min(value), zone * bump(across, reach));
            value = mixed(
                value,
                CLEFT.min(value),
                zone * bump(across, 2.0 * self.membrane_nm),
            );
            if presynaptic && across < -34.0 {
                let shell = self.vesicle(bundle.straight(*at));
                let cloud = step(SYNAPSE_REACH_NM - 90.0 - distance, 40.0);
                value = mixed(
                    value,
                    92.0,
                    shell * cloud * step(spot.neurite.border_nm - 26.0, 4.0),
                );
            }
        }
        value
    }

    /// How much of the shell of a vesicle is at a point.
    fn vesicle(&self, straight: DVec3) -> f64 {
        const SPACING_NM: f64 = 52.0;
        let cell = floor3(straight * (1.0 / SPACING_NM));
        let bits = hash(self.seed, cell);
        if unit(bits, 3) > 0.75 {
            return 0.0;
        }
        let jitter = DVec3::new(signed(bits, 0), signed(bits, 1), signed(bits, 2));
        let middle = (cell.as_dvec3() + 0.5 + 0.1 * jitter) * SPACING_NM;
        bump((straight - middle).length() - 15.0, 9.0)
    }
}

fn voxel(x: u32, y: u32, z: u32) -> IVec3 {
    IVec3::new(x.cast_signed(), y.cast_signed(), z.cast_signed())
}

fn quantised(value: f64) -> u8 {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "clamped to the range of u8; 0 is kept for nothing acquired"
    )]
    let value = (value + 0.5).clamp(1.0, 255.0) as u8;
    value
}
