//! Coordinate spaces as types, so that a position in one cannot be used in another.

use std::fmt;
use std::marker::PhantomData;
use std::ops::Mul;

use glam::{DAffine3, DVec3};
use serde::{Deserialize, Serialize};

/// Nanometres from the low corner of voxel 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Physical {}

/// Level-0 voxels; voxel `i` covers `[i, i + 1)`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Voxel {}

/// `[0, 1]` along each axis of the volume: the `p` of a virtual address \[000 §4.1\].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Normalised {}

/// A position in space `S`.
#[derive(Serialize, Deserialize)]
#[serde(transparent)]
pub struct Point<S> {
    /// The coordinates, in the unit of `S`.
    pub xyz: DVec3,
    #[serde(skip)]
    space: PhantomData<S>,
}

impl<S> Point<S> {
    /// The position with these coordinates.
    pub const fn new(xyz: DVec3) -> Self {
        Self {
            xyz,
            space: PhantomData,
        }
    }
}

// Written out, because derives would ask for the same of the marker `S`.
impl<S> Clone for Point<S> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<S> Copy for Point<S> {}
impl<S> PartialEq for Point<S> {
    fn eq(&self, other: &Self) -> bool {
        self.xyz == other.xyz
    }
}
impl<S> fmt::Debug for Point<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(&self.xyz, f)
    }
}

/// An affine map into `To` from `From`. Name values `to_from_from`: `physical_from_voxel`.
pub struct Map<To, From> {
    affine: DAffine3,
    spaces: PhantomData<(To, From)>,
}

impl<To, From> Map<To, From> {
    /// The map that scales each axis about the origin.
    pub fn scale(by: DVec3) -> Self {
        Self {
            affine: DAffine3::from_scale(by),
            spaces: PhantomData,
        }
    }

    /// The map in the other direction.
    pub fn inverse(self) -> Map<From, To> {
        Map {
            affine: self.affine.inverse(),
            spaces: PhantomData,
        }
    }

    /// Maps a direction: translations do not apply. The result is not normalised.
    pub fn direction(self, from: DVec3) -> DVec3 {
        self.affine.transform_vector3(from)
    }
}

impl<To, From> Clone for Map<To, From> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<To, From> Copy for Map<To, From> {}
impl<To, From> fmt::Debug for Map<To, From> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(&self.affine, f)
    }
}

impl<A, B> Mul<Point<B>> for Map<A, B> {
    type Output = Point<A>;
    fn mul(self, p: Point<B>) -> Point<A> {
        Point::new(self.affine.transform_point3(p.xyz))
    }
}

impl<A, B, C> Mul<Map<B, C>> for Map<A, B> {
    type Output = Map<A, C>;
    fn mul(self, rhs: Map<B, C>) -> Map<A, C> {
        Map {
            affine: self.affine * rhs.affine,
            spaces: PhantomData,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_compose_and_invert() {
        let physical_from_voxel = Map::<Physical, Voxel>::scale(DVec3::new(4.0, 4.0, 40.0));
        let voxel_from_normalised = Map::<Voxel, Normalised>::scale(DVec3::new(100.0, 50.0, 3.0));
        let physical_from_normalised = physical_from_voxel * voxel_from_normalised;
        let corner = physical_from_normalised * Point::new(DVec3::ONE);
        assert_eq!(corner.xyz, DVec3::new(400.0, 200.0, 120.0));
        let back = physical_from_normalised.inverse() * corner;
        assert!((back.xyz - DVec3::ONE).length() < 1e-12);
    }
}
