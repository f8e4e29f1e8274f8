//! Which part of a volume is shown, and how; as people choose it and as addresses name it.

use glam::DVec3;
use saccade_core::space::Point;
use saccade_core::volume::Volume;
use saccade_render::{Clip, FalseColors, Heat, Mode, Work};

use crate::plane::{AXES, Plane};

/// Planes that cut something away, at most.
pub const MOST_CUTS: usize = 4;

/// Which part of a volume is shown, and how.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Shown {
    /// How samples become colours. A plane shows values as they are, whatever this says.
    pub mode: Mode,
    /// Two opposite corners of the part that is seen \[level-0 voxels\].
    pub within: Option<[DVec3; 2]>,
    /// One plane instead of all depths.
    pub slice: Option<Plane>,
    /// How thick what is shown around that plane is \[nm\]; 0 is the plane alone.
    pub slab_nm: f64,
    /// Nothing is seen on the sides that these do not point to.
    pub cuts: [Option<Plane>; MOST_CUTS],
    /// The work of rays instead of the volume.
    pub heat: Option<Heat>,
}

/// Names of modes, as addresses have them.
const MODES: [(&str, Mode); 3] = [
    ("light", Mode::EmissionAbsorption),
    ("maximum", Mode::Maximum),
    ("surface", Mode::IsoSurface),
];

/// Names of false colours, as addresses have them.
const FALSE_COLORS: [(&str, FalseColors); 3] = [
    ("none", FalseColors::None),
    ("residency", FalseColors::Residency),
    ("level", FalseColors::Level),
];

/// Names of what rays do, as addresses have them, and what is much of it for a ray.
pub(crate) const WORKS: [(&str, Work, f32); 3] = [
    ("lookups", Work::Lookups, 16.0),
    ("nodes", Work::Nodes, 128.0),
    ("samples", Work::Samples, 512.0),
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
    pub(crate) fn of<T>(text: &str, what: &'static str, wanted: &'static str) -> Result<T, Self> {
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

/// What colours tell besides values: `none`, `residency` or `level`.
///
/// # Errors
///
/// [`ShownError`] on anything else.
pub fn false_colors_from_text(text: &str) -> Result<FalseColors, ShownError> {
    match FALSE_COLORS.iter().find(|(name, _)| *name == text) {
        Some((_, colors)) => Ok(*colors),
        None => ShownError::of(text, "choice of false colours", "none, residency or level"),
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

/// The work of rays from `lookups`, `nodes` or `samples`, and how much of it is drawn white, as in `nodes=40`.
///
/// # Errors
///
/// [`ShownError`] on anything else.
pub fn heat_from_text(text: &str) -> Result<Heat, ShownError> {
    let (name, full) = match text.split_once('=') {
        Some((name, full)) => (name.trim(), Some(full.trim().parse::<f32>().ok())),
        None => (text, None),
    };
    let known = WORKS.iter().find(|(known, ..)| *known == name);
    let heat = known.and_then(|&(_, of, usual)| {
        let full = full.unwrap_or(Some(usual))?;
        (full.is_finite() && full > 0.0).then_some(Heat { of, full })
    });
    heat.map_or_else(
        || {
            let wanted = "lookups, nodes or samples, and what is drawn white, as in nodes=40";
            ShownError::of(text, "work of rays", wanted)
        },
        Ok,
    )
}

/// Values of channels' surfaces, from 0 to 1, as in `0.4`; for all of them, or each as in `0:0.4,2:0.6`.
///
/// # Errors
///
/// [`ShownError`] on anything else.
pub fn isos_from_text(text: &str) -> Result<Vec<(Option<u32>, f32)>, ShownError> {
    let value = |text: &str| text.parse().ok().filter(|iso| (0.0..=1.0).contains(iso));
    each_channel(text, value).map_or_else(
        || {
            let wanted = "numbers from 0 to 1, for all channels or each once, as in 0:0.4,2:0.6";
            ShownError::of(text, "value of a surface", wanted)
        },
        Ok,
    )
}

/// With commas, what is said of all channels, or of each as in `2:WORD`; of none twice.
pub(crate) fn each_channel<T>(
    text: &str,
    word: impl Fn(&str) -> Option<T>,
) -> Option<Vec<(Option<u32>, T)>> {
    let one = |text: &str| match text.split_once(':') {
        Some((channel, text)) => Some((Some(channel.trim().parse().ok()?), word(text.trim())?)),
        None => Some((None, word(text.trim())?)),
    };
    let said: Vec<(Option<u32>, T)> = text.split(',').map(one).collect::<Option<_>>()?;
    let mut channels: Vec<_> = said.iter().map(|(channel, _)| *channel).collect();
    channels.sort_unstable();
    channels.dedup();
    (channels.len() == said.len()).then_some(said)
}

/// A length that is not negative \[nm\].
///
/// # Errors
///
/// [`ShownError`] on anything else.
pub fn thickness_from_text(text: &str) -> Result<f64, ShownError> {
    let nm = text.trim().parse().ok();
    nm.filter(|nm: &f64| nm.is_finite() && *nm >= 0.0)
        .map_or_else(
            || ShownError::of(text, "thickness", "nanometres, as in 400"),
            Ok,
        )
}

pub(crate) fn numbers(text: &str) -> Option<Vec<f64>> {
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
        /// Number of the voxel at level 0, as given.
        at: f64,
        /// The last voxel there is.
        last: u32,
    },
    /// The oblique plane does not meet the volume.
    #[error(
        "the slice passes the volume at a distance of {away:.0} nm; give a point inside the volume"
    )]
    Oblique {
        /// How far away \[nm\].
        away: f64,
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
    /// A plane cuts away all of it.
    #[error(
        "the cut {axis}={at} leaves nothing: along {axis}, what can be seen ends at {end}; give less"
    )]
    Cut {
        /// x, y or z.
        axis: &'static str,
        /// As given \[level-0 voxels\].
        at: f64,
        /// Where what can be seen ends.
        end: f64,
    },
    /// An oblique plane cuts away all of it.
    #[error(
        "a cut leaves nothing: its normal points away from what can be seen, which ends {away:.0} nm before the plane; \
         turn the normal around, or give a point inside the volume"
    )]
    ObliqueCut {
        /// How far from the plane what can be seen is \[nm\].
        away: f64,
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
        if let Some(plane) = self.slice {
            let half = self.slab_nm / 2.0;
            match plane.axis() {
                Some((axis, at)) => {
                    let half = half / volume.voxel_nm[axis];
                    let (from, to) = (at - half, at + half);
                    let end = f64::from(extent[axis]);
                    if !(from < end && to >= 0.0) {
                        // As it was given.
                        let at = at - 0.5;
                        let last = extent[axis].saturating_sub(1);
                        let axis = AXES[axis];
                        return Err(OutsideError::Slice { axis, at, last });
                    }
                    (low[axis], high[axis]) = (from.max(0.0), to.min(end));
                }
                None if plane.offset(volume).abs() > plane.reach(volume) + half => {
                    let away = plane.offset(volume).abs() - plane.reach(volume);
                    return Err(OutsideError::Oblique { away });
                }
                None => {}
            }
        }
        let Some([one, other]) = self.within else {
            return self.check_cuts(volume, [low, high]);
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
        self.check_cuts(volume, [low.max(min), high.min(max)])
    }

    /// Refuses planes that leave nothing of a box \[level-0 voxels\].
    fn check_cuts(&self, volume: &Volume, [low, high]: [DVec3; 2]) -> Result<(), OutsideError> {
        // A plane alone may lie in the cut.
        let is_thin = low.cmpeq(high).any();
        for cut in self.cuts.iter().flatten() {
            let left = cut.range_of(volume, [low, high])[1];
            if left > 0.0 || (is_thin && left == 0.0) {
                continue;
            }
            return Err(match cut.axis() {
                Some((axis, at)) => OutsideError::Cut {
                    axis: AXES[axis],
                    at,
                    end: high[axis],
                },
                None => OutsideError::ObliqueCut { away: -left },
            });
        }
        Ok(())
    }

    /// How samples become colours.
    pub fn drawn_mode(&self) -> Mode {
        match self.slice {
            Some(_) if self.slab_nm == 0.0 => Mode::Maximum,
            _ => self.mode,
        }
    }

    /// What is cut away of a volume.
    pub fn clip(&self, volume: &Volume) -> Clip {
        let point = |voxels: DVec3| Point::new(voxels * volume.voxel_nm);
        Clip {
            within: self.within.map(|corners| corners.map(point)),
            half_spaces: self.cuts.map(|cut| cut.map(|cut| cut.half_space(volume))),
            slab: self.slice.map(|plane| plane.slab(self.slab_nm, volume)),
        }
    }

    /// Cuts along another plane; whether there was room for it.
    pub fn cut(&mut self, plane: Plane) -> bool {
        let free = self.cuts.iter_mut().find(|cut| cut.is_none());
        free.map(|cut| *cut = Some(plane)).is_some()
    }
}

#[cfg(test)]
mod tests {
    use glam::UVec3;

    use super::*;
    use crate::plane::{plane_from_text, slice_from_text};

    #[test]
    fn text_names_what_is_shown() {
        assert_eq!(mode_from_text("maximum"), Ok(Mode::Maximum));
        let corners = [DVec3::new(1.0, 2.0, 3.0), DVec3::new(40.5, 0.0, 6.0)];
        assert_eq!(box_from_text("1,2, 3,40.5,0,6"), Ok(corners));
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
        for (name, colors) in FALSE_COLORS {
            assert_eq!(false_colors_from_text(name), Ok(colors));
        }
        for bad in ["", "on", "Level", "levels"] {
            assert!(false_colors_from_text(bad).is_err(), "{bad:?}");
        }
        let heat = |of, full| Ok(Heat { of, full });
        assert_eq!(heat_from_text("nodes=40"), heat(Work::Nodes, 40.0));
        assert_eq!(heat_from_text("samples"), heat(Work::Samples, 512.0));
        for bad in ["", "node", "nodes=", "nodes=0", "nodes=NaN", "nodes=-1"] {
            assert!(heat_from_text(bad).is_err(), "{bad:?}");
        }
        assert_eq!(isos_from_text("0.4"), Ok(vec![(None, 0.4)]));
        let each = vec![(None, 0.0), (Some(2), 1.0)];
        assert_eq!(isos_from_text("0, 2:1"), Ok(each));
        for bad in [
            "",
            "1.1",
            "-0.1",
            "NaN",
            "2:",
            ":0.5",
            "a:0.5",
            "1:2:0.5",
            "0.5,",
            "2:0.4,2:0.5",
            "0.4,0.4",
        ] {
            assert!(isos_from_text(bad).is_err(), "{bad:?}");
        }
        assert_eq!(thickness_from_text("40.5"), Ok(40.5));
        for bad in ["", "-1", "NaN", "inf", "4nm"] {
            assert!(thickness_from_text(bad).is_err(), "{bad:?}");
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
        for good in ["z=0", "z=69", "z=69.4", "x=89", "y=3.5"] {
            assert_eq!(check(Some(good), None), Ok(()), "{good}");
        }
        for bad in ["z=70", "z=-0.6", "x=9999", "y=80"] {
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
        assert_eq!(check(Some("1,1,0@40,40,3"), None), Ok(()));
        let told = check(Some("1,1,0@140,140,3"), None).unwrap_err();
        assert!(told.contains("distance of 78 nm"), "{told}");
        assert_eq!(check(Some("z=5"), Some("0,0,5,9,9,9")), Ok(()));
        assert!(check(Some("z=4"), Some("0,0,5,9,9,9")).is_err());
    }

    #[test]
    fn cuts_that_leave_nothing_are_refused() {
        let volume = Volume::new("v", UVec3::new(90, 80, 70), DVec3::new(4.0, 4.0, 40.0)).unwrap();
        let check = |cut: &str, slice: Option<&str>, within: Option<&str>| {
            let mut shown = Shown {
                slice: slice.map(|text| slice_from_text(text).unwrap()),
                within: within.map(|text| box_from_text(text).unwrap()),
                ..Shown::default()
            };
            assert!(shown.cut(plane_from_text(cut).unwrap()));
            shown.check(&volume).map_err(|error| error.to_string())
        };
        for good in ["z=69.5", "z=-5", "x=0", "-1,0,0@3,0,0", "1,1,0@89,80,0"] {
            assert_eq!(check(good, None, None), Ok(()), "{good}");
        }
        // At the far face there is nothing left.
        for at in [70.0, 71.0, 900.0] {
            let told = check(&format!("z={at}"), None, None).unwrap_err();
            let parts = [format!("z={at} "), "ends at 70;".to_owned()];
            assert!(parts.iter().all(|part| told.contains(part)), "{told}");
        }
        for bad in ["-1,0,0@0,0,0", "1,1,0@90,81,0"] {
            assert!(check(bad, None, None).is_err(), "{bad}");
        }
        let told = check("0,0,-1@0,0,-2", None, None).unwrap_err();
        assert!(told.contains("80 nm before"), "{told}");
        // What the box and the plane leave counts.
        let part = Some("10,10,10,20,20,20");
        assert_eq!(check("z=19", None, part), Ok(()));
        assert!(check("z=20", None, part).unwrap_err().contains("at 20"));
        assert_eq!(check("z=40", Some("z=40"), None), Ok(()));
        assert_eq!(check("z=40.5", Some("z=40"), None), Ok(()), "in the plane");
        assert!(check("z=41", Some("z=40"), None).is_err());
    }

    #[test]
    fn a_plane_shows_values_and_a_slab_what_the_mode_says() {
        let volume = Volume::new("v", UVec3::new(90, 80, 70), DVec3::new(4.0, 4.0, 40.0)).unwrap();
        let mut shown = Shown {
            mode: Mode::IsoSurface,
            slice: Some(Plane::across(2, 30.5)),
            ..Shown::default()
        };
        assert_eq!(shown.drawn_mode(), Mode::Maximum);
        let slab = shown.clip(&volume).slab.unwrap();
        assert_eq!((slab.point.xyz.z, slab.normal), (30.5 * 40.0, DVec3::Z));
        shown.slab_nm = 200.0;
        assert_eq!(shown.drawn_mode(), Mode::IsoSurface);
        assert_eq!(shown.clip(&volume).slab.unwrap().thickness_nm, 200.0);
        assert_eq!(Shown::default().clip(&volume), Clip::default());
    }

    #[test]
    fn four_planes_cut() {
        let volume = Volume::new("v", UVec3::new(90, 80, 70), DVec3::new(4.0, 4.0, 40.0)).unwrap();
        let mut shown = Shown::default();
        for at in 0..MOST_CUTS {
            assert!(shown.cut(Plane::across(0, at as f64)));
        }
        assert!(!shown.cut(Plane::across(1, 7.0)), "no room");
        let places = shown
            .clip(&volume)
            .half_spaces
            .map(|h| h.unwrap().point.xyz.x);
        assert_eq!(places, [0.0, 4.0, 8.0, 12.0]);
    }
}
