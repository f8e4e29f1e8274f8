//! An orbiting camera in physical space.

use std::fmt;
use std::str::FromStr;

use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::space::{Physical, Point};
use crate::volume::Volume;

/// Looks at `target` from `distance_nm` away.
///
/// As text: `yaw,pitch,distance,x,y,z` in degrees and nanometres, optionally `,fov` in degrees.
/// At yaw 0 and pitch 0 it looks along +z with x to the right and y down, as section images are
/// drawn; positive yaw moves the eye to the right, positive pitch up.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Point in the middle of the picture \[nm\].
    pub target: Point<Physical>,
    /// Distance of the eye from the target \[nm\].
    pub distance_nm: f64,
    /// Turn about the vertical axis \[degrees\].
    pub yaw: f64,
    /// Turn about the horizontal axis \[degrees\], within ±90.
    pub pitch: f64,
    /// Vertical opening angle \[degrees\].
    pub fov: f64,
}

/// So many pixels wide, a volume meets the middle of some.
const WIDE_ENOUGH: f64 = 2.0;

/// Text that names no camera.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("camera {text:?} is not yaw,pitch,distance,x,y,z[,fov] in degrees and nanometres: {wrong}")]
pub struct ParseCameraError {
    /// As given.
    pub text: String,
    /// What is wrong with it, and what would do.
    pub wrong: &'static str,
}

impl Camera {
    /// Opening angle unless another is asked for \[degrees\].
    pub const FOV: f64 = 35.0;

    /// Sees the whole volume, from a corner, on a picture at least as wide as it is high.
    pub fn around(volume: &Volume) -> Self {
        Self::framing(volume, DVec2::ONE)
    }

    /// Sees the whole volume, from a corner, on a picture of this size \[any unit\]: from farther away where
    /// it is narrow.
    pub fn framing(volume: &Volume, image: DVec2) -> Self {
        let size = volume.size_nm();
        let radius = size.length() / 2.0;
        let image = image.max(DVec2::ONE);
        let mut half_angle = (Self::FOV / 2.0).to_radians();
        if image.x < image.y {
            half_angle = (half_angle.tan() * image.x / image.y).atan();
        }
        Self {
            target: Point::new(size / 2.0),
            distance_nm: 1.02 * radius / half_angle.sin(),
            yaw: 30.0,
            pitch: 25.0,
            fov: Self::FOV,
        }
    }

    /// From nearer by where a thin volume would be less than two pixels wide in a picture \[pixels\], which may meet none of them;
    /// no nearer than all of its corners allow. What is turned then may leave the picture.
    pub fn near_enough(self, volume: &Volume, image: DVec2) -> Self {
        let (size, image) = (volume.size_nm(), image.max(DVec2::ONE));
        let pixels = self.narrowest_nm(size) / self.pixel_nm(self.distance_nm, image.y);
        if pixels >= WIDE_ENOUGH {
            return self;
        }
        let tangent = (self.fov / 2.0).to_radians().tan();
        let whole = 1.02 * self.distance_of(size, DVec2::new(image.x / image.y, 1.0) * tangent);
        let near = self.distance_nm * pixels / WIDE_ENOUGH;
        Self {
            distance_nm: near.max(whole).min(self.distance_nm),
            ..self
        }
    }

    /// The width of a box's outline where it is narrowest \[nm\].
    fn narrowest_nm(&self, size: DVec3) -> f64 {
        let axes = self.physical_from_eye_axes();
        let widths = (0..90_u32).map(|step| {
            let (sin, cos) = (f64::from(step) * 2.0).to_radians().sin_cos();
            let across = axes.x_axis * cos + axes.y_axis * sin;
            across.abs().dot(size)
        });
        widths.fold(f64::INFINITY, f64::min)
    }

    /// From how far away a box around the target is whole in a picture with these tangents of half its opening angles.
    fn distance_of(&self, size: DVec3, tangents: DVec2) -> f64 {
        let eye_from_physical = self.physical_from_eye_axes().transpose();
        let corners = (0..8_u8).map(|corner| {
            let signs = [1, 2, 4].map(|bit| if corner & bit == 0 { -0.5 } else { 0.5 });
            eye_from_physical * (DVec3::from_array(signs) * size)
        });
        let needed = corners.map(|at| (at.truncate().abs() / tangents).max_element() - at.z);
        needed.fold(0.0, f64::max)
    }

    /// Right, down and forward: unit vectors in physical space, as columns.
    pub fn physical_from_eye_axes(&self) -> DMat3 {
        let (sy, cy) = self.yaw.to_radians().sin_cos();
        let (sp, cp) = self.pitch.to_radians().sin_cos();
        let right = DVec3::new(cy, 0.0, sy);
        let forward = DVec3::new(-sy * cp, sp, cy * cp);
        DMat3::from_cols(right, forward.cross(right), forward)
    }

    /// Where the eye is.
    pub fn eye(&self) -> Point<Physical> {
        Point::new(self.target.xyz - self.physical_from_eye_axes().z_axis * self.distance_nm)
    }

    /// Direction of the ray through a pixel's centre, not normalised: its component along the
    /// viewing direction is 1. Pixels count from the upper left.
    pub fn ray(&self, pixel: DVec2, image: DVec2) -> DVec3 {
        let tangent = (self.fov / 2.0).to_radians().tan();
        let at = (pixel * 2.0 - image) / image.y * tangent;
        self.physical_from_eye_axes() * DVec3::new(at.x, at.y, 1.0)
    }

    /// Size that one pixel has at a distance along the viewing direction \[nm\].
    pub fn pixel_nm(&self, depth_nm: f64, image_height: f64) -> f64 {
        2.0 * depth_nm * (self.fov / 2.0).to_radians().tan() / image_height
    }

    /// Turned about the target by degrees; pitch stops at the poles.
    pub fn orbited(self, yaw: f64, pitch: f64) -> Self {
        let yaw = (self.yaw + yaw).rem_euclid(360.0);
        Self {
            yaw,
            pitch: (self.pitch + pitch).clamp(-89.9, 89.9),
            ..self
        }
    }

    /// Moved so that what was seen at the target moves by `pixels` on an image of that height.
    pub fn panned(self, pixels: DVec2, image_height: f64) -> Self {
        let axes = self.physical_from_eye_axes();
        let by = pixels * self.pixel_nm(self.distance_nm, image_height);
        let target = self.target.xyz - axes.x_axis * by.x - axes.y_axis * by.y;
        Self {
            target: Point::new(target),
            ..self
        }
    }

    /// Closer by a factor above 1, farther by one below.
    pub fn zoomed(self, factor: f64) -> Self {
        Self {
            distance_nm: (self.distance_nm / factor).clamp(1e-3, 1e15),
            ..self
        }
    }
}

impl fmt::Display for Camera {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let DVec3 { x, y, z } = self.target.xyz;
        let Self {
            yaw,
            pitch,
            distance_nm,
            fov,
            ..
        } = self;
        write!(f, "{yaw},{pitch},{distance_nm},{x},{y},{z},{fov}")
    }
}

impl FromStr for Camera {
    type Err = ParseCameraError;
    fn from_str(text: &str) -> Result<Self, ParseCameraError> {
        let error = |wrong| ParseCameraError {
            text: text.to_owned(),
            wrong,
        };
        let numbers = text.split(',').map(|n| n.trim().parse().ok());
        let numbers: Option<Vec<f64>> = numbers.map(|n| n.filter(|n| f64::is_finite(*n))).collect();
        let numbers = numbers.ok_or_else(|| error("one of them is no number"))?;
        let (yaw, pitch, distance_nm, target, fov) = match numbers[..] {
            [yaw, pitch, distance, x, y, z] => (yaw, pitch, distance, [x, y, z], Self::FOV),
            [yaw, pitch, distance, x, y, z, fov] => (yaw, pitch, distance, [x, y, z], fov),
            _ => return Err(error("give six numbers or seven, with commas")),
        };
        if pitch.abs() > 90.0 {
            return Err(error("the pitch goes from -90 to 90"));
        }
        if distance_nm <= 0.0 {
            return Err(error("the distance has to be above 0"));
        }
        if !(fov > 0.0 && fov < 180.0) {
            return Err(error("the fov has to be above 0 and below 180"));
        }
        Ok(Self {
            target: Point::new(target.into()),
            distance_nm,
            yaw,
            pitch,
            fov,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::UVec3;

    fn volume() -> Volume {
        Volume::new("v", UVec3::new(100, 80, 10), DVec3::new(4.0, 4.0, 40.0)).unwrap()
    }

    #[test]
    fn looks_as_sections_are_drawn() {
        let camera = Camera {
            yaw: 0.0,
            pitch: 0.0,
            ..Camera::around(&volume())
        };
        let axes = camera.physical_from_eye_axes();
        assert!((axes.x_axis - DVec3::X).length() < 1e-12);
        assert!(
            (axes.y_axis - DVec3::Y).length() < 1e-12,
            "y runs down in image and volume"
        );
        assert!((axes.z_axis - DVec3::Z).length() < 1e-12);
    }

    /// Whether all corners of the volume are on a picture.
    fn is_whole(camera: Camera, image: DVec2) -> bool {
        let volume = volume();
        let from_eye = camera.physical_from_eye_axes().transpose();
        let reach = (camera.fov / 2.0).to_radians().tan() * DVec2::new(image.x / image.y, 1.0);
        (0..8).all(|corner| {
            let corner = DVec3::from_array([1, 2, 4].map(|bit| f64::from(corner & bit).min(1.0)));
            let at = from_eye * (volume.size_nm() * corner - camera.eye().xyz);
            at.z > 0.0 && (at.truncate() / at.z).abs().cmple(reach).all()
        })
    }

    #[test]
    fn the_whole_volume_is_framed_whatever_the_picture() {
        for image in [[800.0, 600.0], [300.0, 300.0], [299.0, 900.0], [7.0, 400.0]] {
            let image = DVec2::from(image);
            for (yaw, pitch) in [(0.0, 0.0), (60.0, 0.0), (15.0, -110.0), (200.0, 40.0)] {
                let camera = Camera::framing(&volume(), image).orbited(yaw, pitch);
                assert!(is_whole(camera, image), "{image}");
                assert!(
                    image.x < image.y || camera == Camera::around(&volume()).orbited(yaw, pitch)
                );
            }
        }
        let narrow = DVec2::new(299.0, 900.0);
        assert!(!is_whole(Camera::around(&volume()), narrow));
        // No picture at all is none to fall out of.
        assert!(
            Camera::framing(&volume(), DVec2::ZERO)
                .distance_nm
                .is_finite()
        );
    }

    #[test]
    fn thin_volumes_are_seen_in_narrow_pictures() {
        let nm = DVec3::new(16.0, 16.0, 40.0);
        for extent in [[20, 600, 6], [600, 20, 6], [20, 20, 600]] {
            let volume = Volume::new("v", UVec3::from_array(extent), nm).unwrap();
            for image in [[8.0, 600.0], [600.0, 8.0], [9.0, 601.0]] {
                let image = DVec2::from(image);
                let framed = Camera::framing(&volume, image);
                let camera = framed.near_enough(&volume, image);
                assert!(camera.distance_nm <= framed.distance_nm);
                let corners = (0..8).map(|corner| {
                    let corner = [1, 2, 4].map(|bit| f64::from(corner & bit).min(1.0));
                    let at = volume.size_nm() * DVec3::from_array(corner) - camera.eye().xyz;
                    let at = camera.physical_from_eye_axes().transpose() * at;
                    assert!(at.z > 0.0);
                    let tangent = (camera.fov / 2.0).to_radians().tan();
                    at.truncate() / at.z / tangent * image.y / 2.0
                });
                let corners: Vec<DVec2> = corners.collect();
                let all = |at: &DVec2| at.abs().cmple(image / 2.0).all();
                assert!(
                    corners.iter().all(all),
                    "{extent:?} in {image}: {corners:?}"
                );
            }
        }
        let volume = Volume::new("v", UVec3::new(20, 600, 6), nm).unwrap();
        let image = DVec2::new(8.0, 600.0);
        let framed = Camera::framing(&volume, image);
        let width = |camera: Camera| {
            camera.narrowest_nm(volume.size_nm()) / camera.pixel_nm(camera.distance_nm, image.y)
        };
        assert!(width(framed) < 0.5, "{} pixels", width(framed));
        assert!(width(framed.near_enough(&volume, image)) > 1.5);
        // What is wide enough stays where it is.
        let image = DVec2::new(7.0, 400.0);
        let framed = Camera::framing(&self::volume(), image);
        assert_eq!(framed.near_enough(&self::volume(), image), framed);
    }

    #[test]
    fn positive_yaw_moves_the_eye_right_and_positive_pitch_up() {
        let front = Camera {
            yaw: 0.0,
            pitch: 0.0,
            ..Camera::around(&volume())
        };
        assert!(front.orbited(20.0, 0.0).eye().xyz.x > front.eye().xyz.x);
        assert!(
            front.orbited(0.0, 20.0).eye().xyz.y < front.eye().xyz.y,
            "up is towards -y"
        );
    }

    #[test]
    fn axes_are_right_handed_and_unit_everywhere() {
        for yaw in [0.0, 77.0, 180.0, 301.0] {
            for pitch in [-89.9, -10.0, 0.0, 60.0] {
                let camera = Camera {
                    yaw,
                    pitch,
                    ..Camera::around(&volume())
                };
                let m = camera.physical_from_eye_axes();
                assert!((m.determinant() - 1.0).abs() < 1e-9);
                assert!((m.transpose() * m - DMat3::IDENTITY).abs_diff_eq(DMat3::ZERO, 1e-9));
            }
        }
    }

    #[test]
    fn text_survives() {
        let camera = Camera::around(&volume()).orbited(11.5, -3.0);
        assert_eq!(camera.to_string().parse::<Camera>().unwrap(), camera);
        for (bad, told) in [
            ("", "no number"),
            ("1,2,3", "six numbers or seven"),
            ("1,2,3,4,5,6,7,8", "six numbers or seven"),
            ("0,0,-5,0,0,0", "distance"),
            ("0,0,inf,0,0,0", "no number"),
            ("0,0,1,0,x,0", "no number"),
            ("0,99,1,0,0,0", "from -90 to 90"),
            ("0,0,1,0,0,0,180", "above 0 and below 180"),
            ("0,0,1,0,0,0,0", "above 0 and below 180"),
        ] {
            let error = bad.parse::<Camera>().unwrap_err().to_string();
            assert!(error.contains(told), "{bad:?}: {error}");
        }
    }

    #[test]
    fn panning_follows_the_hand() {
        let camera = Camera {
            yaw: 0.0,
            pitch: 0.0,
            ..Camera::around(&volume())
        };
        let image = DVec2::new(640.0, 480.0);
        let moved = camera.panned(DVec2::new(100.0, 0.0), image.y);
        // The old target now appears 100 pixels right of the centre.
        let ray = moved.ray(DVec2::new(420.0, 240.0), image) * moved.distance_nm;
        assert!((moved.eye().xyz + ray - camera.target.xyz).length() < 1e-6);
    }
}
