//! Procedural neural tissue: any extent, any voxel computable alone \[DESIGN §4\].
//!
//! Neurites in bundles, with mitochondria, vesicles and synapses; somata with nuclei; capillaries.
//! Looks like electron microscopy, dark membranes on bright cytoplasm, and comes with its truth:
//! which cell a voxel belongs to and where every synapse is. Nothing is stored: a voxel is a function
//! of the seed, the voxel size and its position.
//!
//! # Spaces and units
//!
//! Tissue is made in physical space; voxel `i` along x has its sample at `(i + 0.5) * voxel_nm.x`.
//! Internally a smooth bend maps tissue to a *straight* geometry of convex cells \[nm\], and each
//! bundle of neurites has a *lattice* space in which neurites are about 1 apart.
//!
//! # Truth
//!
//! Labels are never 0. A cell's voxels hang together and membranes are painted where labels change,
//! both as far as the voxel size can show it.

use glam::DVec3;

use crate::space::{Physical, Point};
use crate::voxel_box::VoxelBox;

mod bundle;
mod noise;
mod paint;
mod random;
mod sampler;
mod territory;

pub use sampler::Sampler;

use random::mix;

/// Tissue without end in every positive direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Phantom {
    seed: u64,
    voxel_nm: DVec3,
}

/// A place where one neurite signals to another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Synapse {
    /// Middle of the cleft \[nm\].
    pub position: Point<Physical>,
    /// Label of the cell that sends; vesicles gather on its side.
    pub pre: u64,
    /// Label of the cell that receives.
    pub post: u64,
}

/// A voxel size in which no tissue can be sampled.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("voxel size {voxel_nm} nm of the phantom is not positive; give nanometres as x,y,z")]
pub struct PhantomError {
    /// As given \[nm\].
    pub voxel_nm: DVec3,
}

impl Phantom {
    /// The tissue of `seed`, seen in voxels of `voxel_nm`. The same tissue at every voxel size.
    ///
    /// # Errors
    ///
    /// [`PhantomError`] on a voxel size that is zero, negative or not a number.
    pub fn new(seed: u64, voxel_nm: DVec3) -> Result<Self, PhantomError> {
        if voxel_nm.is_finite() && voxel_nm.min_element() > 0.0 {
            Ok(Self { seed, voxel_nm })
        } else {
            Err(PhantomError { voxel_nm })
        }
    }

    /// Voxel size \[nm\].
    pub fn voxel_nm(&self) -> DVec3 {
        self.voxel_nm
    }

    /// A reader that is quick for voxels near each other.
    pub fn sampler(&self) -> Sampler {
        Sampler::new(*self)
    }

    /// The value of a voxel, 1 to 255.
    pub fn value(&self, x: u32, y: u32, z: u32) -> u8 {
        let mut value = [0];
        self.sampler().row(x, y, z, &mut value);
        value[0]
    }

    /// The cell that a voxel belongs to; never 0.
    pub fn label(&self, x: u32, y: u32, z: u32) -> u64 {
        let mut label = [0];
        self.sampler().labels(x, y, z, &mut label);
        label[0]
    }

    /// Writes the values of the voxels from (`x0`, `y`, `z`) along x. For many rows, use one
    /// [`Phantom::sampler`].
    pub fn row(&self, x0: u32, y: u32, z: u32, values: &mut [u8]) {
        self.sampler().row(x0, y, z, values);
    }

    /// All synapses whose position lies in a box of voxels, ordered by z, y, x.
    pub fn synapses(&self, voxels: VoxelBox) -> Vec<Synapse> {
        if voxels.is_empty() {
            return Vec::new();
        }
        let (low, high) = (voxels.min.as_dvec3(), voxels.max.as_dvec3());
        let reach = noise::WARP_REACH_NM + 1.0;
        let min = low * self.voxel_nm - reach;
        let max = high * self.voxel_nm + reach;
        let mut sampler = self.sampler();
        let mut found = Vec::new();
        for territory in territory::bundles(self.territory_seed(), min, max) {
            let bundle = sampler.bundle(&territory);
            let junctions = bundle.junctions(min, max, &mut |point| sampler.territory_at(point));
            for junction in junctions {
                let position = noise::unwarped(self.warp_seed(), bundle.straight(junction.at));
                let voxel = position / self.voxel_nm;
                if voxel.cmpge(low).all() && voxel.cmplt(high).all() {
                    found.push(Synapse {
                        position: Point::new(position),
                        pre: bundle.label(junction.pre),
                        post: bundle.label(junction.post),
                    });
                }
            }
        }
        found.sort_by(|a, b| {
            let key = |s: &Synapse| [s.position.xyz.z, s.position.xyz.y, s.position.xyz.x];
            let pairs = key(a).into_iter().zip(key(b));
            pairs
                .map(|(a, b)| a.total_cmp(&b))
                .find(|o| o.is_ne())
                .unwrap_or(std::cmp::Ordering::Equal)
        });
        found
    }

    fn x_nm(&self, x: u32) -> f64 {
        (f64::from(x) + 0.5) * self.voxel_nm.x
    }

    fn row_nm(&self, y: u32, z: u32) -> (f64, f64) {
        (
            (f64::from(y) + 0.5) * self.voxel_nm.y,
            (f64::from(z) + 0.5) * self.voxel_nm.z,
        )
    }

    /// Half width of a membrane: as in tissue, but wide enough to show.
    fn membrane_nm(&self) -> f64 {
        (0.62 * self.voxel_nm.x.min(self.voxel_nm.y)).max(7.0)
    }

    fn territory_seed(&self) -> u64 {
        mix(self.seed ^ 0x7e44)
    }

    fn warp_seed(&self) -> u64 {
        mix(self.seed ^ 0x3a49)
    }

    fn paint_seed(&self) -> u64 {
        mix(self.seed ^ 0x9a17)
    }
}

#[cfg(test)]
mod tests;
