//! The neurites of one bundle, and the synapses between them.
//!
//! Inside a bundle space is stretched along the bundle's direction until neurites become round: the
//! lattice space, whose unit is the spacing of neurites. There they are the cells of a power diagram
//! with one site per lattice cell, again convex.

use glam::{DMat3, DQuat, DVec3, IVec3};

use super::random::{floor3, hash, mix, signed, unit};
use super::territory::{BORDER_REACH_NM, Here, Territory};

/// Edge of the blocks for which candidate sites are gathered \[lattice units\].
const BLOCK: f64 = 0.5;
/// Sites stay this close to the middle of their lattice cell.
const JITTER: f64 = 0.38;
/// Largest squared radius of a site.
const WEIGHT: f64 = 0.14;
/// A bundle never owns a point further from its centre than this \[nm\].
const OWNED_NM: f64 = 4_500.0;
/// Share of sites that have a synapse with a neighbour, where the two really touch: about one
/// synapse per cubic micrometre, as in cortex.
const SYNAPSE_SHARE: f64 = 0.6;
/// A synapse shows no further from its middle than this \[nm\].
pub(super) const SYNAPSE_REACH_NM: f64 = 330.0;

/// A bundle's direction and the thickness of its neurites.
#[derive(Debug)]
pub(super) struct Bundle {
    pub(super) id: u64,
    centre: DVec3,
    lattice_from_straight: DMat3,
    straight_from_lattice: DMat3,
    per_nm: DVec3,
    /// Spacing of neurites across the bundle \[nm\].
    pub(super) across_nm: f64,
    /// Spacing along the bundle \[nm\].
    pub(super) along_nm: f64,
    /// Distances to a border are exact up to this \[nm\].
    reach_nm: f64,
}

/// One neurite.
#[derive(Clone, Copy, Debug)]
pub(super) struct Site {
    pub(super) id: u64,
    pub(super) at: DVec3,
    weight: f64,
}

impl Site {
    fn distance(&self, at: DVec3) -> f64 {
        (at - self.at).length_squared() - self.weight
    }
}

/// A synapse, in lattice space.
#[derive(Clone, Copy, Debug)]
pub(super) struct Junction {
    pub(super) pre: u64,
    pub(super) post: u64,
    /// Middle of the cleft.
    pub(super) at: DVec3,
    /// Times a lattice vector: its length across the cleft, towards the postsynaptic side \[nm\].
    pub(super) across: DVec3,
    /// Radius of the active zone \[nm\].
    pub(super) radius_nm: f64,
}

/// The neurites that can own a point of one block, or border on it within reach.
#[derive(Debug)]
pub(super) struct Block {
    sites: Vec<Site>,
    pub(super) junctions: Vec<Junction>,
}

/// The neurite at a point.
#[derive(Clone, Copy, Debug)]
pub(super) struct Neurite {
    pub(super) site: Site,
    /// Distance to the next neurite of the bundle \[nm\]; infinite if beyond reach.
    pub(super) border_nm: f64,
}

/// The block that holds a point of lattice space.
pub(super) fn block_of(at: DVec3) -> IVec3 {
    floor3(at * (1.0 / BLOCK))
}

impl Bundle {
    pub(super) fn new(territory: &Territory) -> Self {
        let bits = mix(territory.id ^ 0x5eed);
        let across_nm = match unit(bits, 0) {
            share if share < 0.25 => 210.0,
            share if share < 0.60 => 320.0,
            share if share < 0.85 => 520.0,
            _ => 900.0,
        };
        let along_nm = (1_300.0 + 1_500.0 * unit(bits, 1)).max(1.6 * across_nm);
        let more = mix(bits);
        let turn = |n| std::f64::consts::TAU * unit(more, n);
        let tilt = (2.0 * unit(more, 2) - 1.0).acos();
        let turned = DQuat::from_rotation_z(turn(0)) * DQuat::from_rotation_y(tilt);
        let turned = DMat3::from_quat(turned * DQuat::from_rotation_z(turn(1)));
        let per_nm = DVec3::new(across_nm, across_nm, along_nm).recip();
        Self {
            id: territory.id,
            centre: territory.centre,
            lattice_from_straight: DMat3::from_diagonal(per_nm) * turned.transpose(),
            straight_from_lattice: turned * DMat3::from_diagonal(per_nm.recip()),
            per_nm,
            across_nm,
            along_nm,
            reach_nm: BORDER_REACH_NM.min(0.15 * across_nm),
        }
    }

    pub(super) fn lattice(&self, straight: DVec3) -> DVec3 {
        self.lattice_from_straight * (straight - self.centre)
    }

    pub(super) fn straight(&self, at: DVec3) -> DVec3 {
        self.centre + self.straight_from_lattice * at
    }

    /// Length \[nm\] of a vector of lattice space.
    pub(super) fn length_nm(&self, vector: DVec3) -> f64 {
        (self.straight_from_lattice * vector).length()
    }

    /// The label of a neurite.
    pub(super) fn label(&self, site: u64) -> u64 {
        mix(self.id ^ site.rotate_left(17)).max(1)
    }

    fn site(&self, cell: IVec3) -> Site {
        let id = hash(self.id, cell);
        let jitter = DVec3::new(signed(id, 0), signed(id, 1), signed(id, 2));
        let at = cell.as_dvec3() + 0.5 + jitter * JITTER;
        Site {
            id,
            at,
            weight: WEIGHT * unit(id, 3),
        }
    }

    /// Steepness of the border between two sites: how fast the difference of their distances grows
    /// \[lattice units^2 per nm\].
    fn steepness(&self, a: &Site, b: &Site) -> f64 {
        2.0 * ((b.at - a.at) * self.per_nm).length()
    }

    /// The synapse that the site of `cell` has with its neighbour along x or y, if they share a
    /// large enough face. Whether the bundle reaches that far is not checked.
    fn junction(&self, cell: IVec3, near: impl Fn(DVec3) -> bool) -> Option<Junction> {
        let bits = mix(hash(self.id, cell) ^ 0x0053_7a95);
        if unit(bits, 0) > SYNAPSE_SHARE {
            return None;
        }
        let along_x = bits & (1 << 20) != 0;
        let partner = cell + if along_x { IVec3::X } else { IVec3::Y };
        let (one, other) = (self.site(cell), self.site(partner));
        let apart = other.at - one.at;
        if apart.length_squared() > 1.4 {
            return None;
        }
        let share = 0.5 + (one.weight - other.weight) / (2.0 * apart.length_squared());
        let at = one.at + apart * share;
        if !(0.1..0.9).contains(&share) || !near(at) {
            return None;
        }
        // Sites stay inside their lattice cells, so nothing outside these 27 comes near.
        let held = one.distance(at) + 0.12;
        let around = floor3(at);
        for z in -1..=1 {
            for y in -1..=1 {
                for x in -1..=1 {
                    let third = around + IVec3::new(x, y, z);
                    if third != cell && third != partner && self.site(third).distance(at) < held {
                        return None;
                    }
                }
            }
        }
        let (pre, post) = if bits & (1 << 21) != 0 {
            (one, other)
        } else {
            (other, one)
        };
        let across = (post.at - pre.at) * (2.0 / self.steepness(&pre, &post));
        let radius_nm = (80.0 + 110.0 * unit(bits, 2)).min(0.45 * self.across_nm);
        Some(Junction {
            pre: pre.id,
            post: post.id,
            at,
            across,
            radius_nm,
        })
    }

    /// Whether a synapse lies well inside the bundle; `territory_at` answers for any point.
    fn holds(&self, junction: &Junction, territory_at: &mut dyn FnMut(DVec3) -> Here) -> bool {
        let here = territory_at(self.straight(junction.at));
        here.territory.id == self.id && here.border_nm.is_infinite()
    }

    /// All synapses of the bundle whose middle lies between two points of straight space.
    pub(super) fn junctions(
        &self,
        min: DVec3,
        max: DVec3,
        territory_at: &mut dyn FnMut(DVec3) -> Here,
    ) -> Vec<Junction> {
        let min = min.max(self.centre - OWNED_NM);
        let max = max.min(self.centre + OWNED_NM);
        if min.cmpge(max).any() {
            return Vec::new();
        }
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for corner in 0..8_u32 {
            let pick = |bit: u32| corner & bit != 0;
            let corner = DVec3::select(glam::BVec3::new(pick(1), pick(2), pick(4)), max, min);
            let at = self.lattice(corner);
            (low, high) = (low.min(at), high.max(at));
        }
        // The middle lies between two sites, at most two cells from the first one's cell.
        let (low, high) = (floor3(low) - 2, floor3(high) + 2);
        let mut found = Vec::new();
        for z in low.z..=high.z {
            for y in low.y..=high.y {
                for x in low.x..=high.x {
                    let inside = |at: DVec3| {
                        let straight = self.straight(at);
                        straight.cmpge(min).all() && straight.cmplt(max).all()
                    };
                    let junction = self.junction(IVec3::new(x, y, z), inside);
                    found.extend(junction.filter(|j| self.holds(j, territory_at)));
                }
            }
        }
        found
    }

    pub(super) fn gather(
        &self,
        block: IVec3,
        territory_at: &mut dyn FnMut(DVec3) -> Here,
    ) -> Block {
        let min = block.as_dvec3() * BLOCK;
        let max = min + BLOCK;
        let (low, high) = (floor3(min) - 2, floor3(max) + 2);
        let mut sites = Vec::with_capacity(150);
        let mut junctions = Vec::new();
        let near = |at: DVec3| self.length_nm(at.clamp(min, max) - at) < SYNAPSE_REACH_NM * 1.3;
        for z in low.z..=high.z {
            for y in low.y..=high.y {
                for x in low.x..=high.x {
                    let cell = IVec3::new(x, y, z);
                    sites.push(self.site(cell));
                    let junction = self.junction(cell, near);
                    junctions.extend(junction.filter(|j| self.holds(j, territory_at)));
                }
            }
        }
        // Differences of two distances are linear, so their least value in the block is exact. A
        // site matters if nowhere is it so far behind one of the likely owners that even its border
        // is out of reach.
        let (middle, half) = (min + 0.5 * BLOCK, 0.5 * BLOCK);
        sites.sort_unstable_by(|a, b| a.distance(middle).total_cmp(&b.distance(middle)));
        let furthest = |s: &Site| (s.at - min).abs().max((s.at - max).abs()).length_squared();
        let owner_reach = (furthest(&sites[0]) - sites[0].weight + WEIGHT)
            .max(0.0)
            .sqrt();
        let likely: [Site; 6] = std::array::from_fn(|n| sites[n]);
        sites.retain(|site| {
            let apart = (site.at - middle).abs() + half + owner_reach;
            let reach = 2.0 * self.reach_nm * (apart * self.per_nm).length();
            likely.iter().all(|owner| {
                let slope = 2.0 * (owner.at - site.at).abs().element_sum();
                site.distance(middle) - owner.distance(middle) - slope * half < reach
            })
        });
        Block { sites, junctions }
    }

    /// The neurite at a point of `block`. `distances` is room to work in.
    pub(super) fn at(&self, block: &Block, at: DVec3, distances: &mut Vec<f64>) -> Neurite {
        let mut owner = 0;
        let mut least = f64::INFINITY;
        distances.clear();
        distances.extend(block.sites.iter().map(|site| site.distance(at)));
        for (n, distance) in distances.iter().enumerate() {
            if *distance < least {
                (owner, least) = (n, *distance);
            }
        }
        let owner_at = owner;
        let owner = &block.sites[owner];
        let mut border_nm = f64::INFINITY;
        // What is further ahead than this is out of reach, as sites are less than 4 apart.
        let worth = least + 8.0 * self.reach_nm * self.per_nm.max_element();
        for ((n, site), distance) in block.sites.iter().enumerate().zip(&*distances) {
            if *distance < worth && n != owner_at {
                border_nm = border_nm.min((distance - least) / self.steepness(owner, site));
            }
        }
        let border_nm = if border_nm < self.reach_nm {
            border_nm
        } else {
            f64::INFINITY
        };
        Neurite {
            site: *owner,
            border_nm,
        }
    }

    /// The owner of a point and the distance to its border, from many more sites than needed.
    #[cfg(test)]
    pub(super) fn far_and_wide(&self, at: DVec3) -> (u64, f64) {
        let mut sites = Vec::new();
        for n in 0..11_i32.pow(3) {
            let offset = IVec3::new(n % 11, n / 11 % 11, n / 121) - 5;
            sites.push(self.site(floor3(at) + offset));
        }
        sites.sort_by(|a, b| a.distance(at).total_cmp(&b.distance(at)));
        let owner = sites[0];
        let ahead = |site: &Site| site.distance(at) - owner.distance(at);
        let borders = sites[1..]
            .iter()
            .map(|site| ahead(site) / self.steepness(&owner, site));
        (owner.id, borders.fold(f64::INFINITY, f64::min))
    }
}
