//! Planes through a volume: slices, and faces of what is cut away.

use glam::DVec3;
use saccade_core::space::Point;
use saccade_core::volume::Volume;
use saccade_render::{HalfSpace, Slab};

use crate::shown::{ShownError, numbers};

/// Names of axes.
pub(crate) const AXES: [&str; 3] = ["x", "y", "z"];

/// A plane through a volume.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// Perpendicular to it, in nanometres' directions; of any length but zero.
    pub normal: DVec3,
    /// Some point in it \[level-0 voxels\].
    pub point: DVec3,
}

impl Plane {
    /// Across an axis: 0 for x, 1 for y, 2 for z; at a place along it \[level-0 voxels\].
    pub fn across(axis: usize, at: f64) -> Self {
        let normal = DVec3::AXES[axis % 3];
        let point = normal * at;
        Self { normal, point }
    }

    /// Across an axis, through the middle of a voxel, so that nothing of its neighbours is seen \[number of the voxel at
    /// level 0\].
    pub fn through_voxel(axis: usize, voxel: f64) -> Self {
        Self::across(axis, voxel + 0.5)
    }

    /// The axis that it is across, and where along it \[level-0 voxels\]; none if it is oblique.
    pub fn axis(&self) -> Option<(usize, f64)> {
        let axis = DVec3::AXES.iter().position(|axis| *axis == self.normal)?;
        Some((axis, self.point[axis]))
    }

    /// The same, moved along its normal until it is so far from the middle of a volume \[nm\].
    pub(crate) fn at_offset(self, offset_nm: f64, volume: &Volume) -> Self {
        let by = self.normal.normalize_or_zero() * (offset_nm - self.offset(volume));
        Self {
            point: self.point + by / volume.voxel_nm,
            ..self
        }
    }

    /// The same plane, whose normal points to the other side.
    pub(crate) fn flipped(self) -> Self {
        let normal = -self.normal;
        Self { normal, ..self }
    }

    /// How far it is from the middle of a volume, along its normal \[nm\].
    pub(crate) fn offset(&self, volume: &Volume) -> f64 {
        let from_middle = self.point * volume.voxel_nm - volume.size_nm() / 2.0;
        from_middle.dot(self.normal.normalize_or_zero())
    }

    /// How far from the middle of a volume its last voxels are, along the normal \[nm\].
    pub(crate) fn reach(&self, volume: &Volume) -> f64 {
        let normal = self.normal.normalize_or_zero();
        (volume.size_nm() / 2.0).dot(normal.abs())
    }

    /// Between which distances along the normal a box lies \[level-0 voxels, then nm\].
    pub(crate) fn range_of(&self, volume: &Volume, corners: [DVec3; 2]) -> [f64; 2] {
        let normal = self.normal.normalize_or_zero();
        let [a, b] = corners.map(|corner| (corner - self.point) * volume.voxel_nm * normal);
        [a.min(b).element_sum(), a.max(b).element_sum()]
    }

    fn physical(&self, volume: &Volume) -> Point<saccade_core::space::Physical> {
        Point::new(self.point * volume.voxel_nm)
    }

    /// What lies on the side that its normal points to.
    pub(crate) fn half_space(&self, volume: &Volume) -> HalfSpace {
        HalfSpace {
            point: self.physical(volume),
            normal: self.normal,
        }
    }

    /// What lies around it, so thick in all \[nm\].
    pub(crate) fn slab(&self, thickness_nm: f64, volume: &Volume) -> Slab {
        Slab {
            point: self.physical(volume),
            normal: self.normal,
            thickness_nm,
        }
    }
}

/// A plane to cut along: across an axis, as in `z=40`, which lies between voxels 39 and 40, or with any normal and through any
/// point, as in `1,0.5,0@300,200,40` \[the normal in nanometres' directions, the point in level-0 voxels from the volume's corner\].
///
/// # Errors
///
/// [`ShownError`] on anything else.
pub fn plane_from_text(text: &str) -> Result<Plane, ShownError> {
    plane(text, Plane::across)
}

/// A plane to look at: across an axis through the middle of a voxel, as in `z=40`, which is section 40, or as
/// [`plane_from_text`] has it.
///
/// # Errors
///
/// [`ShownError`] on anything else.
pub fn slice_from_text(text: &str) -> Result<Plane, ShownError> {
    plane(text, Plane::through_voxel)
}

fn plane(text: &str, at: impl Fn(usize, f64) -> Plane) -> Result<Plane, ShownError> {
    let across = across(text).map(|(axis, place)| at(axis, place));
    across.or_else(|| oblique(text)).map_or_else(
        || {
            ShownError::of(
                text,
                "plane",
                "an axis and a voxel of the finest level, as in z=40, or a normal and a point, as in \
                 1,0.5,0@300,200,40",
            )
        },
        Ok,
    )
}

fn across(text: &str) -> Option<(usize, f64)> {
    let (axis, at) = text.split_once('=')?;
    let axis = AXES.iter().position(|name| *name == axis.trim())?;
    let at: f64 = at.trim().parse().ok()?;
    at.is_finite().then_some((axis, at))
}

fn oblique(text: &str) -> Option<Plane> {
    let (normal, point) = text.split_once('@')?;
    let vector = |text| match numbers(text)?.as_slice() {
        &[x, y, z] => Some(DVec3::new(x, y, z)),
        _ => None,
    };
    let (normal, point) = (vector(normal)?, vector(point)?);
    let direction = normal.try_normalize()?;
    // Across an axis, it is that axis's.
    let normal = DVec3::AXES
        .into_iter()
        .find(|axis| *axis == direction)
        .unwrap_or(normal);
    Some(Plane { normal, point })
}

#[cfg(test)]
mod tests {
    use glam::UVec3;

    use super::*;

    fn volume() -> Volume {
        Volume::new("v", UVec3::new(90, 80, 70), DVec3::new(4.0, 4.0, 40.0)).unwrap()
    }

    #[test]
    fn text_names_planes() {
        assert_eq!(plane_from_text("y=-7.5"), Ok(Plane::across(1, -7.5)));
        let oblique = Plane {
            normal: DVec3::new(1.0, -0.5, 0.0),
            point: DVec3::new(3.0, 2.0, 1.5),
        };
        assert_eq!(plane_from_text("1,-0.5,0@3, 2,1.5"), Ok(oblique));
        assert_eq!(oblique.axis(), None);
        // Cuts lie between voxels, what is looked at in the middle of one.
        assert_eq!(slice_from_text("z=40"), Ok(Plane::across(2, 40.5)));
        assert_eq!(slice_from_text("1,-0.5,0@3,2,1.5"), Ok(oblique));
        let along = plane_from_text("0,0,8@3,2,1.5").unwrap();
        assert_eq!(along.axis(), Some((2, 1.5)), "across an axis");
        for bad in [
            "",
            "z",
            "z=",
            "w=4",
            "z=NaN",
            "4",
            "1,0,0",
            "0,0,0@1,2,3",
            "1,0@1,2,3",
            "1,0,0@1,2",
            "1,0,inf@1,2,3",
            "@",
        ] {
            assert!(plane_from_text(bad).is_err(), "{bad:?}");
        }
    }

    #[test]
    fn a_plane_moves_along_its_normal() {
        let volume = volume();
        let plane = Plane {
            normal: DVec3::new(0.0, 3.0, 4.0),
            point: DVec3::new(45.0, 40.0, 35.0),
        };
        assert!(plane.offset(&volume).abs() < 1e-9, "through the middle");
        // Half sizes are 180, 160, 1400 nm.
        let reach = 0.6 * 160.0 + 0.8 * 1400.0;
        assert!((plane.reach(&volume) - reach).abs() < 1e-9);
        for offset in [-300.0, 0.0, 77.0] {
            let moved = plane.at_offset(offset, &volume);
            assert!((moved.offset(&volume) - offset).abs() < 1e-9);
            assert_eq!(moved.normal, plane.normal);
        }
    }

    #[test]
    fn a_flipped_plane_is_where_it_was_and_keeps_the_other_side() {
        let volume = volume();
        let plane = Plane {
            normal: DVec3::new(0.0, 3.0, 4.0),
            point: DVec3::new(45.0, 50.0, 35.0),
        };
        let flipped = plane.flipped();
        assert_eq!(flipped.point, plane.point);
        assert_eq!(flipped.offset(&volume), -plane.offset(&volume));
        let [kept, cut] = [plane, flipped].map(|plane| plane.half_space(&volume));
        assert_eq!((kept.point, kept.normal), (cut.point, -cut.normal));
        assert_eq!(flipped.flipped(), plane);
    }

    #[test]
    fn half_spaces_and_slabs_are_where_the_plane_is() {
        let volume = volume();
        let plane = Plane::across(2, 30.5);
        assert_eq!(plane.half_space(&volume).point.xyz.z, 30.5 * 40.0);
        let slab = plane.slab(120.0, &volume);
        assert_eq!((slab.point.xyz.z, slab.thickness_nm), (30.5 * 40.0, 120.0));
        assert_eq!(slab.normal, DVec3::Z);
    }
}
