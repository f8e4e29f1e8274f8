//! Which part of a volume is shown, and how; as people choose it and as addresses name it.

use glam::DVec3;
use saccade_core::space::Point;
use saccade_core::volume::Volume;
use saccade_render::{Clip, Mode, Slab};

/// Which part of a volume is shown, and how.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Shown {
    /// How samples become colours. A slice shows values as they are, whatever this says.
    pub mode: Mode,
    /// Two opposite corners of the part that is seen \[level-0 voxels\].
    pub within: Option<[DVec3; 2]>,
    /// One plane instead of all depths.
    pub slice: Option<Slice>,
}

/// A plane across an axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Slice {
    /// 0 for x, 1 for y, 2 for z.
    pub axis: usize,
    /// Where, along it \[level-0 voxels\].
    pub at: f64,
}

/// Names of axes.
pub(crate) const AXES: [&str; 3] = ["x", "y", "z"];
/// Names of modes, as addresses have them.
const MODES: [(&str, Mode); 3] = [
    ("light", Mode::EmissionAbsorption),
    ("maximum", Mode::Maximum),
    ("surface", Mode::IsoSurface),
];

/// Text that names nothing that can be shown.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is no {what}; give {wanted}")]
pub struct ShownError {
    /// As given.
    pub text: String,
    /// What it was to be.
    pub what: &'static str,
    /// What would do.
    pub wanted: &'static str,
}

impl ShownError {
    fn of<T>(text: &str, what: &'static str, wanted: &'static str) -> Result<T, Self> {
        let text = text.to_owned();
        Err(Self { text, what, wanted })
    }
}

/// The mode of a name: `light`, `maximum` or `surface`.
///
/// # Errors
///
/// [`ShownError`] on anything else.
pub fn mode_from_text(text: &str) -> Result<Mode, ShownError> {
    match MODES.iter().find(|(name, _)| *name == text) {
        Some((_, mode)) => Ok(*mode),
        None => ShownError::of(text, "mode", "light, maximum or surface"),
    }
}

/// Two corners from six numbers with commas: x, y, z of one and of the other \[level-0 voxels\].
///
/// # Errors
///
/// [`ShownError`] on anything else, and on a box without voxels.
pub fn box_from_text(text: &str) -> Result<[DVec3; 2], ShownError> {
    let numbers = numbers(text);
    if let Some([a, b, c, d, e, f]) = numbers.as_deref() {
        let corners = [DVec3::new(*a, *b, *c), DVec3::new(*d, *e, *f)];
        if corners[0].cmpne(corners[1]).all() {
            return Ok(corners);
        }
    }
    ShownError::of(
        text,
        "clip box",
        "x,y,z,x,y,z of two opposite corners, in voxels of the finest level",
    )
}

/// A plane from an axis and a number, as in `z=40` \[level-0 voxels\].
///
/// # Errors
///
/// [`ShownError`] on anything else.
pub fn slice_from_text(text: &str) -> Result<Slice, ShownError> {
    let parts = text.split_once('=');
    let axis = parts.and_then(|(axis, _)| AXES.iter().position(|name| *name == axis.trim()));
    let at = parts.and_then(|(_, at)| at.trim().parse().ok());
    match axis.zip(at.filter(|at: &f64| at.is_finite())) {
        Some((axis, at)) => Ok(Slice { axis, at }),
        None => ShownError::of(
            text,
            "slice",
            "an axis and a voxel of the finest level, as in z=40",
        ),
    }
}

/// Channels from their numbers with commas, counted from 0.
///
/// # Errors
///
/// [`ShownError`] on anything else.
pub fn channels_from_text(text: &str) -> Result<Vec<u32>, ShownError> {
    let channels = text.split(',').map(|number| number.trim().parse());
    let channels: Result<Vec<u32>, _> = channels.collect();
    channels.or_else(|_| {
        ShownError::of(
            text,
            "list of channels",
            "numbers from 0 with commas, as in 0,2",
        )
    })
}

fn numbers(text: &str) -> Option<Vec<f64>> {
    let numbers = text
        .split(',')
        .map(|number| number.trim().parse::<f64>().ok());
    let finite = numbers.map(|number| number.filter(|number| number.is_finite()));
    finite.collect()
}

/// Nothing of the volume would be seen.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum OutsideError {
    /// The plane does not meet the volume.
    #[error("the slice {axis}={at} is outside the volume, in which {axis} goes from 0 to {last}")]
    Slice {
        /// x, y or z.
        axis: &'static str,
        /// As given \[level-0 voxels\].
        at: f64,
        /// The last voxel there is.
        last: u32,
    },
    /// The box does not meet the volume, or the plane does not meet the box.
    #[error(
        "nothing of the volume is in the clip box: along {axis} it goes from {from} to {to}, and what can be \
         seen from {low} to {high}"
    )]
    Clip {
        /// x, y or z.
        axis: &'static str,
        /// Where the box begins \[level-0 voxels\].
        from: f64,
        /// Where it ends.
        to: f64,
        /// Where what can be seen begins.
        low: f64,
        /// Where it ends.
        high: f64,
    },
}

impl Shown {
    /// Refuses what shows nothing of a volume.
    ///
    /// # Errors
    ///
    /// [`OutsideError`].
    pub fn check(&self, volume: &Volume) -> Result<(), OutsideError> {
        let extent = volume.extent();
        let mut low = DVec3::ZERO;
        let mut high = extent.as_dvec3();
        if let Some(Slice { axis, at }) = self.slice {
            let axis = axis % 3;
            if !(0.0..f64::from(extent[axis])).contains(&at) {
                let last = extent[axis].saturating_sub(1);
                let axis = AXES[axis];
                return Err(OutsideError::Slice { axis, at, last });
            }
            (low[axis], high[axis]) = (at, at);
        }
        let Some([one, other]) = self.within else {
            return Ok(());
        };
        let (min, max) = (one.min(other), one.max(other));
        for axis in 0..3 {
            let thin = low[axis] == high[axis];
            let meets = match thin {
                true => min[axis] <= low[axis] && low[axis] <= max[axis],
                false => min[axis] < high[axis] && low[axis] < max[axis],
            };
            if !meets {
                return Err(OutsideError::Clip {
                    axis: AXES[axis],
                    from: min[axis],
                    to: max[axis],
                    low: low[axis],
                    high: high[axis],
                });
            }
        }
        Ok(())
    }

    /// How samples become colours.
    pub fn drawn_mode(&self) -> Mode {
        match self.slice {
            Some(_) => Mode::Maximum,
            None => self.mode,
        }
    }

    /// What is cut away of a volume.
    pub fn clip(&self, volume: &Volume) -> Clip {
        let point = |voxels: DVec3| Point::new(voxels * volume.voxel_nm);
        let slab = self.slice.map(|slice| Slab {
            point: point(DVec3::AXES[slice.axis % 3] * slice.at),
            normal: DVec3::AXES[slice.axis % 3],
            thickness_nm: 0.0,
        });
        Clip {
            within: self.within.map(|corners| corners.map(point)),
            slab,
            ..Clip::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::UVec3;

    use super::*;

    #[test]
    fn text_names_what_is_shown() {
        assert_eq!(mode_from_text("maximum"), Ok(Mode::Maximum));
        let corners = [DVec3::new(1.0, 2.0, 3.0), DVec3::new(40.5, 0.0, 6.0)];
        assert_eq!(box_from_text("1,2, 3,40.5,0,6"), Ok(corners));
        assert_eq!(slice_from_text("y=-7.5"), Ok(Slice { axis: 1, at: -7.5 }));
        assert_eq!(channels_from_text("0, 12"), Ok(vec![0, 12]));
        for bad in ["", "Maximum", "mip"] {
            assert!(mode_from_text(bad).is_err(), "{bad:?}");
        }
        for bad in [
            "",
            "1,2,3",
            "1,2,3,1,5,6",
            "1,2,3,4,5,NaN",
            "1,2,3,4,5,6,7",
            "1,2,3,4,5,inf",
        ] {
            assert!(box_from_text(bad).is_err(), "{bad:?}");
        }
        for bad in ["", "z", "z=", "w=4", "z=NaN", "4"] {
            assert!(slice_from_text(bad).is_err(), "{bad:?}");
        }
        for bad in ["", "-1", "a", "1,,2", "1.5"] {
            assert!(channels_from_text(bad).is_err(), "{bad:?}");
        }
    }

    #[test]
    fn what_shows_nothing_is_refused_with_what_would_do() {
        let volume = Volume::new("v", UVec3::new(90, 80, 70), DVec3::ONE).unwrap();
        let check = |slice: Option<&str>, within: Option<&str>| {
            let shown = Shown {
                slice: slice.map(|text| slice_from_text(text).unwrap()),
                within: within.map(|text| box_from_text(text).unwrap()),
                ..Shown::default()
            };
            shown.check(&volume).map_err(|error| error.to_string())
        };
        for good in ["z=0", "z=69", "z=69.9", "x=89", "y=3.5"] {
            assert_eq!(check(Some(good), None), Ok(()), "{good}");
        }
        for bad in ["z=70", "z=-0.1", "x=9999", "y=80"] {
            assert!(check(Some(bad), None).is_err(), "{bad}");
        }
        let told = check(Some("z=9999"), None).unwrap_err();
        assert!(
            told.contains("z=9999") && told.contains("from 0 to 69"),
            "{told}"
        );
        for good in ["-5,-5,-5,1,1,1", "89,79,69,500,500,500", "40,10,3,0,5,60"] {
            assert_eq!(check(None, Some(good)), Ok(()), "{good}");
        }
        for bad in ["90,0,0,99,80,70", "-9,0,0,0,80,70", "0,0,200,9,9,300"] {
            assert!(check(None, Some(bad)).is_err(), "{bad}");
        }
        assert_eq!(check(Some("z=5"), Some("0,0,5,9,9,9")), Ok(()));
        assert!(check(Some("z=4"), Some("0,0,5,9,9,9")).is_err());
    }

    #[test]
    fn a_slice_is_a_plane_where_it_was_asked_for() {
        let volume = Volume::new("v", UVec3::new(90, 80, 70), DVec3::new(4.0, 4.0, 40.0)).unwrap();
        let shown = Shown {
            mode: Mode::IsoSurface,
            within: None,
            slice: Some(Slice { axis: 2, at: 30.5 }),
        };
        assert_eq!(shown.drawn_mode(), Mode::Maximum);
        let slab = shown.clip(&volume).slab.unwrap();
        assert_eq!((slab.point.xyz.z, slab.normal), (30.5 * 40.0, DVec3::Z));
        assert_eq!(Shown::default().clip(&volume), Clip::default());
    }
}
