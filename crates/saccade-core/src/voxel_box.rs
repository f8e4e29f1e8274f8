//! Half-open boxes of voxels.

use std::fmt;

use glam::{DVec3, UVec3};
use serde::{Deserialize, Serialize};

/// The voxels `min <= v < max` of one level. Empty when any axis is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct VoxelBox {
    /// First voxel inside.
    pub min: UVec3,
    /// First voxel outside, per axis.
    pub max: UVec3,
}

impl VoxelBox {
    /// No voxels.
    pub const EMPTY: Self = Self {
        min: UVec3::ZERO,
        max: UVec3::ZERO,
    };

    /// The box from `min` up to, not including, `max`.
    pub const fn new(min: UVec3, max: UVec3) -> Self {
        Self { min, max }
    }

    /// The box of `size` voxels at the origin.
    pub const fn of_size(size: UVec3) -> Self {
        Self {
            min: UVec3::ZERO,
            max: size,
        }
    }

    /// The smallest box of whole voxels around real bounds, cut at zero and at `u32::MAX`.
    ///
    /// Not-a-number bounds give an empty box.
    pub fn around(min: DVec3, max: DVec3) -> Self {
        if min.is_nan() || max.is_nan() {
            return Self::EMPTY;
        }
        // `as` saturates: exactly the cut that is wanted.
        Self {
            min: min.floor().as_uvec3(),
            max: max.ceil().as_uvec3(),
        }
    }

    /// Whether it holds no voxel.
    pub fn is_empty(self) -> bool {
        self.min.cmpge(self.max).any()
    }

    /// Voxels per axis; zero where empty.
    pub fn size(self) -> UVec3 {
        self.max.saturating_sub(self.min)
    }

    /// Number of voxels.
    pub fn voxels(self) -> u64 {
        let size = self.size();
        u64::from(size.x) * u64::from(size.y) * u64::from(size.z)
    }

    /// The voxels in both.
    pub fn intersection(self, other: Self) -> Self {
        Self {
            min: self.min.max(other.min),
            max: self.max.min(other.max),
        }
    }

    /// Whether any voxel is in both.
    pub fn intersects(self, other: Self) -> bool {
        !self.intersection(other).is_empty()
    }

    /// The smallest box around both; an empty box adds nothing.
    pub fn union(self, other: Self) -> Self {
        if self.is_empty() {
            other
        } else if other.is_empty() {
            self
        } else {
            Self {
                min: self.min.min(other.min),
                max: self.max.max(other.max),
            }
        }
    }

    /// Whether the voxel is inside.
    pub fn contains(self, voxel: UVec3) -> bool {
        voxel.cmpge(self.min).all() && voxel.cmplt(self.max).all()
    }

    /// Grown by `by` voxels on every side, cut at zero.
    pub fn grown(self, by: u32) -> Self {
        if self.is_empty() {
            return self;
        }
        let by = UVec3::splat(by);
        Self {
            min: self.min.saturating_sub(by),
            max: self.max.saturating_add(by),
        }
    }

    /// The grid cells of edge `cell` that it touches, x fastest.
    pub fn cells(self, cell: UVec3) -> impl Iterator<Item = UVec3> {
        let cells = if self.is_empty() {
            Self::EMPTY
        } else {
            Self {
                min: self.min / cell,
                max: (self.max - 1) / cell + 1,
            }
        };
        cells.iter()
    }

    /// Every voxel, x fastest.
    pub fn iter(self) -> impl Iterator<Item = UVec3> {
        let size = self.size();
        let rows = (0..size.z).flat_map(move |z| (0..size.y).map(move |y| (y, z)));
        let offsets = rows.flat_map(move |(y, z)| (0..size.x).map(move |x| UVec3::new(x, y, z)));
        offsets.map(move |offset| self.min + offset)
    }
}

impl fmt::Display for VoxelBox {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}..{}", self.min, self.max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn empty_boxes_stay_empty() {
        let a = VoxelBox::new(UVec3::new(5, 0, 0), UVec3::new(3, 9, 9));
        assert!(a.is_empty());
        assert_eq!(
            (a.voxels(), a.iter().count(), a.cells(UVec3::ONE).count()),
            (0, 0, 0)
        );
        assert!(a.grown(4).is_empty());
        assert_eq!(
            a.union(VoxelBox::of_size(UVec3::ONE)),
            VoxelBox::of_size(UVec3::ONE)
        );
    }

    #[test]
    fn cells_cover_exactly() {
        let b = VoxelBox::new(UVec3::new(31, 0, 64), UVec3::new(33, 1, 65));
        let cells: Vec<_> = b.cells(UVec3::splat(32)).collect();
        assert_eq!(cells, [UVec3::new(0, 0, 2), UVec3::new(1, 0, 2)]);
    }

    #[test]
    fn around_saturates() {
        let b = VoxelBox::around(DVec3::new(-3.5, 0.2, 7.0), DVec3::new(1.1, 1e20, 7.0));
        assert_eq!(b.min, UVec3::new(0, 0, 7));
        assert_eq!(b.max, UVec3::new(2, u32::MAX, 7));
        assert!(b.is_empty());
        assert!(VoxelBox::around(DVec3::NAN, DVec3::ONE).is_empty());
    }
}
