//! Large pieces of tissue: bundles of neuropil, somata, blood vessels.
//!
//! All are cells of one power diagram: site `s` with radius `r` owns the points where
//! `|p - s|^2 - r^2` is least. Such cells are convex, however big the radius of a neighbour is, so
//! a soma pushes its surroundings aside and never cuts a cell in two. A vessel is a chain of cells.

use glam::{DVec3, IVec3};

use super::random::{floor3, hash, mix, signed, unit};

/// Edge of the blocks for which candidate sites are gathered \[nm\].
pub(super) const BLOCK_NM: f64 = 400.0;
/// Distances to a border are exact up to this, and not asked for beyond \[nm\].
pub(super) const BORDER_REACH_NM: f64 = 100.0;

const BUNDLE_SPACING_NM: f64 = 2_800.0;
const SOMA_SPACING_NM: f64 = 12_000.0;
const SOMA_SHARE: f64 = 0.7;
const VESSEL_SPACING_NM: f64 = 15_000.0;
const VESSEL_SHARE: f64 = 0.65;
/// No site has a larger radius \[nm\].
const LARGEST_RADIUS_NM: f64 = 3_600.0;

/// What a territory is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Tissue {
    /// Many neurites running side by side.
    Bundle,
    /// The body of one neuron.
    Soma,
    /// A capillary.
    Vessel,
}

/// A site of the power diagram.
#[derive(Clone, Copy, Debug)]
pub(super) struct Territory {
    pub(super) tissue: Tissue,
    /// Equal for all links of one vessel, different for all else; never 0.
    pub(super) id: u64,
    pub(super) centre: DVec3,
    pub(super) radius: f64,
}

impl Territory {
    /// Power distance \[nm^2\]; the territory with the least owns the point.
    pub(super) fn distance(&self, point: DVec3) -> f64 {
        (point - self.centre).length_squared() - self.radius * self.radius
    }
}

/// The territory at a point, and what it borders on.
#[derive(Clone, Copy, Debug)]
pub(super) struct Here {
    pub(super) territory: Territory,
    /// Distance to the nearest border with another territory \[nm\]; infinite if beyond reach.
    pub(super) border_nm: f64,
}

/// The territories that can own a point of one block, or border on it within reach.
#[derive(Debug)]
pub(super) struct Block {
    candidates: Vec<Territory>,
}

/// The block that holds a point.
pub(super) fn block_of(point: DVec3) -> IVec3 {
    floor3(point * (1.0 / BLOCK_NM))
}

impl Block {
    pub(super) fn gather(seed: u64, block: IVec3) -> Self {
        let min = block.as_dvec3() * BLOCK_NM;
        let max = min + BLOCK_NM;
        let mut candidates = Vec::with_capacity(160);
        // Two cells each way: a site further off than that is beaten by the one in the point's own
        // cell, even within the border's reach.
        cells(min, max, BUNDLE_SPACING_NM, 2, |cell| {
            candidates.push(bundle(seed, cell))
        });
        cells(min, max, SOMA_SPACING_NM, 1, |cell| {
            candidates.extend(soma(seed, cell))
        });
        vessels(seed, min, max, &mut candidates);

        let nearest = |c: DVec3| (c.clamp(min, max) - c).length_squared();
        let furthest = |c: DVec3| (c - min).abs().max((c - max).abs()).length_squared();
        let bound = candidates
            .iter()
            .map(|t| furthest(t.centre) - t.radius * t.radius);
        let bound = bound.fold(f64::INFINITY, f64::min);
        let owner_reach = (bound.max(0.0) + LARGEST_RADIUS_NM * LARGEST_RADIUS_NM).sqrt();
        candidates.retain(|t| {
            let margin = 2.0 * BORDER_REACH_NM * (furthest(t.centre).sqrt() + owner_reach);
            nearest(t.centre) - t.radius * t.radius <= bound + margin
        });
        Self { candidates }
    }

    /// The territory at `point` of this block.
    pub(super) fn at(&self, point: DVec3) -> Here {
        let mut owner = &self.candidates[0];
        if self.candidates.len() == 1 {
            return Here {
                territory: *owner,
                border_nm: f64::INFINITY,
            };
        }
        let mut least = owner.distance(point);
        for candidate in &self.candidates[1..] {
            let distance = candidate.distance(point);
            if distance < least {
                (owner, least) = (candidate, distance);
            }
        }
        let mut border_nm = f64::INFINITY;
        for other in &self.candidates {
            if other.id != owner.id {
                let ahead = other.distance(point) - least;
                // Cheap refusal first; sites are rarely further apart than this.
                if ahead < 2.0 * BORDER_REACH_NM * 14_000.0 {
                    let apart = (other.centre - owner.centre).length();
                    border_nm = border_nm.min(ahead / (2.0 * apart));
                }
            }
        }
        Here {
            territory: *owner,
            border_nm: within_reach(border_nm),
        }
    }
}

fn within_reach(border_nm: f64) -> f64 {
    if border_nm < BORDER_REACH_NM {
        border_nm
    } else {
        f64::INFINITY
    }
}

/// Calls `each` with the lattice cells that hold a box, and `around` more on every side.
fn cells(min: DVec3, max: DVec3, spacing: f64, around: i32, mut each: impl FnMut(IVec3)) {
    let low = floor3(min / spacing) - around;
    let high = floor3(max / spacing) + around;
    for z in low.z..=high.z {
        for y in low.y..=high.y {
            for x in low.x..=high.x {
                each(IVec3::new(x, y, z));
            }
        }
    }
}

fn jittered(cell: IVec3, bits: u64, by: f64) -> DVec3 {
    let jitter = DVec3::new(signed(bits, 0), signed(bits, 1), signed(bits, 2));
    cell.as_dvec3() + 0.5 + jitter * by
}

fn bundle(seed: u64, cell: IVec3) -> Territory {
    let id = hash(seed ^ 0x0b0d_1e5a, cell);
    let centre = jittered(cell, id, 0.4) * BUNDLE_SPACING_NM;
    Territory {
        tissue: Tissue::Bundle,
        id: id.max(1),
        centre,
        radius: 0.0,
    }
}

fn soma(seed: u64, cell: IVec3) -> Option<Territory> {
    let id = hash(seed ^ 0x0050_3a7a, cell);
    if unit(id, 3) > SOMA_SHARE {
        return None;
    }
    let radius = 2_300.0 + 1_200.0 * unit(mix(id), 0);
    let centre = jittered(cell, id, 0.2) * SOMA_SPACING_NM;
    Some(Territory {
        tissue: Tissue::Soma,
        id: id.max(1),
        centre,
        radius,
    })
}

/// The links of all vessels that come near a box. Vessels wander along z, one per column at most.
fn vessels(seed: u64, min: DVec3, max: DVec3, into: &mut Vec<Territory>) {
    const REACH_NM: f64 = 6_000.0;
    let flat = DVec3::new(1.0, 1.0, 0.0);
    cells(min * flat, max * flat, VESSEL_SPACING_NM, 1, |cell| {
        // Columns meet in one plane of cells; the box is flat and gives cells at z -1, 0 and 1.
        if cell.z != 0 {
            return;
        }
        let id = hash(seed ^ 0x0b10_0d00, cell);
        if unit(id, 3) > VESSEL_SHARE {
            return;
        }
        let radius = 900.0 + 700.0 * unit(id, 2);
        let more = mix(id);
        let base = jittered(cell, id, 0.12) * VESSEL_SPACING_NM;
        let course = |z: f64| {
            let turn = |n, period: f64| (z / period + std::f64::consts::TAU * unit(more, n)).sin();
            let x = base.x + 2_100.0 * turn(0, 4_300.0) + 500.0 * turn(1, 1_900.0);
            let y = base.y + 2_100.0 * turn(2, 5_100.0) + 500.0 * turn(3, 1_700.0);
            DVec3::new(x, y, z)
        };
        let step = 0.4 * radius;
        let first = super::random::floor((min.z - REACH_NM) / step);
        let last = super::random::floor((max.z + REACH_NM) / step);
        for link in first..=last {
            let centre = course(f64::from(link) * step);
            if (centre.clamp(min, max) - centre).length() < REACH_NM {
                into.push(Territory {
                    tissue: Tissue::Vessel,
                    id: id.max(1),
                    centre,
                    radius,
                });
            }
        }
    });
}

/// The bundles that can own a point between two points of straight space.
pub(super) fn bundles(seed: u64, min: DVec3, max: DVec3) -> Vec<Territory> {
    let mut found = Vec::new();
    // A point's owner sits at most two cells from the point's own cell.
    cells(min, max, BUNDLE_SPACING_NM, 2, |cell| {
        found.push(bundle(seed, cell))
    });
    found
}

/// Everything that could matter at a point, and much that cannot.
#[cfg(test)]
pub(super) fn far_and_wide(seed: u64, point: DVec3) -> Vec<Territory> {
    let mut found = Vec::new();
    cells(point, point, BUNDLE_SPACING_NM, 4, |cell| {
        found.push(bundle(seed, cell))
    });
    cells(point, point, SOMA_SPACING_NM, 2, |cell| {
        found.extend(soma(seed, cell))
    });
    vessels(seed, point - 9_000.0, point + 9_000.0, &mut found);
    found
}
