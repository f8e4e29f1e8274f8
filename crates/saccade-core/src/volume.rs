//! What a volume is, before any voxel of it is known.

use glam::{DVec3, UVec3};
use serde::{Deserialize, Serialize};

use crate::brick::{BRICK_EDGE, MAX_BRICKS_PER_AXIS};
use crate::levels::{Level, halving_levels};
use crate::space::{Map, Normalised, Physical, Voxel};

/// How a voxel's value is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Dtype {
    /// 8 bit, unsigned.
    Uint8,
    /// 16 bit, unsigned, little-endian.
    Uint16,
}

impl Dtype {
    /// Bytes per voxel.
    pub const fn bytes(self) -> usize {
        match self {
            Self::Uint8 => 1,
            Self::Uint16 => 2,
        }
    }
}

/// What voxels are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VoxelKind {
    /// Shades: coarser levels are averages.
    #[default]
    Intensity,
    /// Numbers of objects: coarser levels show the most frequent, nothing is interpolated.
    Labels,
}

impl VoxelKind {
    /// Whether voxels are shades, as they are where nothing is said.
    pub fn is_intensity(&self) -> bool {
        *self == Self::Intensity
    }

    /// Whether voxels are numbers of objects.
    pub fn is_labels(&self) -> bool {
        *self == Self::Labels
    }
}

/// How a channel is meant to be shown at first, as far as whoever wrote the volume says.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Look {
    /// Colour of its large values, sRGB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub color: Option<[u8; 3]>,
    /// Values at the two ends of its colours, rising, `[0, 1]` of the value type's range.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub window: Option<[f32; 2]>,
    /// Whether it is not seen.
    pub hidden: bool,
}

/// A virtual 3D image: its shape is known, its voxels may not exist yet.
///
/// Value 0 means "nothing was acquired here"; sources keep measured values at 1 or above. Among labels 0 is
/// no object as well.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Volume {
    /// Name in addresses and file names.
    pub name: String,
    /// Value type of every channel.
    pub dtype: Dtype,
    /// What the voxels of every channel are.
    #[serde(default, skip_serializing_if = "VoxelKind::is_intensity")]
    pub kind: VoxelKind,
    /// Names of the channels; at least one.
    pub channels: Vec<String>,
    /// How channels are meant to be shown at first, in their order; nothing is said of those that are missing here.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub looks: Vec<Look>,
    /// Voxel size at level 0 \[nm\].
    pub voxel_nm: DVec3,
    /// How far the whole volume is moved in the space of whoever wrote it, which other images may share \[nm\]. Positions
    /// within the volume do not know of it.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub origin_nm: DVec3,
    /// How much further each level lies than the volume, as whoever wrote it says: by a part of its voxels, since they round, or
    /// mean another point of a voxel \[nm\]. Not at all where nothing is said. Pictures do not know of it either.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub shifts_nm: Vec<DVec3>,
    /// Levels, finest first; at least one.
    pub levels: Vec<Level>,
    /// Chunk size of every level \[voxels of the level\].
    pub chunk: UVec3,
}

/// A volume that cannot be.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum VolumeError {
    /// An axis without voxels.
    #[error("the volume's extent is {extent}, but every axis needs at least 1 voxel")]
    Extent {
        /// As given \[voxels\].
        extent: UVec3,
    },
    /// An axis longer than brick ids reach.
    #[error("the volume's extent is {extent}, but an axis can have {most} voxels at most")]
    ExtentTooLarge {
        /// As given \[voxels\].
        extent: UVec3,
        /// Largest possible \[voxels\].
        most: u32,
    },
    /// The name cannot be used in addresses and file names.
    #[error(
        "{name:?} cannot name a volume: use 1 to 100 ASCII letters, digits, '-', '_' and '.', and do not \
         begin with '.'"
    )]
    Name {
        /// As asked for.
        name: String,
    },
    /// A voxel size that is zero, negative or not a number.
    #[error("voxel size {voxel_nm} nm is not positive; give nanometres as x,y,z")]
    VoxelSize {
        /// As given \[nm\].
        voxel_nm: DVec3,
    },
}

/// Largest extent of an axis \[voxels\].
pub const MAX_EXTENT: u32 = MAX_BRICKS_PER_AXIS * BRICK_EDGE;

/// Checks that a name can be used in addresses and file names: 1 to 100 ASCII letters, digits, `-`,
/// `_` and `.`, the first not `.`. [`Volume::new`] does not: whoever takes a name in does.
///
/// # Errors
///
/// [`VolumeError::Name`].
pub fn check_name(name: &str) -> Result<(), VolumeError> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    let good =
        (1..=100).contains(&name.len()) && !name.starts_with('.') && name.chars().all(allowed);
    if good {
        Ok(())
    } else {
        let name = name.to_owned();
        Err(VolumeError::Name { name })
    }
}

impl Volume {
    /// A single-channel 8-bit volume with halving levels.
    ///
    /// # Errors
    ///
    /// [`VolumeError`] on an empty extent or an impossible voxel size.
    pub fn new(name: &str, extent: UVec3, voxel_nm: DVec3) -> Result<Self, VolumeError> {
        if extent.min_element() == 0 {
            return Err(VolumeError::Extent { extent });
        }
        if extent.max_element() > MAX_EXTENT {
            let most = MAX_EXTENT;
            return Err(VolumeError::ExtentTooLarge { extent, most });
        }
        if !(voxel_nm.is_finite() && voxel_nm.min_element() > 0.0) {
            return Err(VolumeError::VoxelSize { voxel_nm });
        }
        Ok(Self {
            name: name.to_owned(),
            dtype: Dtype::Uint8,
            kind: VoxelKind::Intensity,
            channels: vec!["intensity".to_owned()],
            looks: Vec::new(),
            voxel_nm,
            origin_nm: DVec3::ZERO,
            shifts_nm: Vec::new(),
            levels: halving_levels(extent, voxel_nm),
            chunk: UVec3::new(64, 64, 32),
        })
    }

    /// How a channel is meant to be shown at first.
    pub fn look(&self, channel: usize) -> Look {
        self.looks.get(channel).copied().unwrap_or_default()
    }

    /// Where a level lies that begins where it should, and as far as whoever wrote it says \[nm\].
    pub fn place_nm(&self, level: usize) -> DVec3 {
        self.origin_nm + self.shifts_nm.get(level).copied().unwrap_or_default()
    }

    /// Size at level 0 \[voxels\].
    pub fn extent(&self) -> UVec3 {
        self.levels[0].extent
    }

    /// Size \[nm\].
    pub fn size_nm(&self) -> DVec3 {
        self.extent().as_dvec3() * self.voxel_nm
    }

    /// To nanometres from level-0 voxels.
    pub fn physical_from_voxel(&self) -> Map<Physical, Voxel> {
        Map::scale(self.voxel_nm)
    }

    /// To nanometres from `[0, 1]` per axis.
    pub fn physical_from_normalised(&self) -> Map<Physical, Normalised> {
        Map::scale(self.size_nm())
    }

    /// Chunks per axis of a level.
    pub fn chunks(&self, level: usize) -> UVec3 {
        (self.levels[level].extent + (self.chunk - 1)) / self.chunk
    }
}

fn is_zero(origin_nm: &DVec3) -> bool {
    *origin_nm == DVec3::ZERO
}

/// On which side of the histogram the structures are that should be seen.
///
/// Interpolation between tissue and "nothing acquired" passes through all values in between. To
/// keep that transition on the transparent side, bricks of dark structures are stored inverted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Polarity {
    /// Fluorescence: structures are bright.
    #[default]
    Bright,
    /// Electron microscopy: structures are dark.
    Dark,
}

impl Polarity {
    /// The 8-bit value as a brick stores it. Nothing acquired stays 0; the map is its own inverse.
    pub const fn stored(self, value: u8) -> u8 {
        match self {
            Self::Bright => value,
            Self::Dark => value.wrapping_neg(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polarity_is_its_own_inverse_and_keeps_nothing() {
        for polarity in [Polarity::Bright, Polarity::Dark] {
            assert_eq!(polarity.stored(0), 0);
            for value in 0..=255 {
                assert_eq!(polarity.stored(polarity.stored(value)), value);
            }
        }
        assert_eq!(Polarity::Dark.stored(255), 1);
        assert_eq!(Polarity::Dark.stored(1), 255);
    }

    #[test]
    fn impossible_volumes_are_refused() {
        let nm = DVec3::splat(4.0);
        assert!(Volume::new("v", UVec3::new(4, 0, 4), nm).is_err());
        assert!(Volume::new("v", UVec3::new(1, MAX_EXTENT, 1), nm).is_ok());
        let beyond = Volume::new("v", UVec3::new(1, 1, MAX_EXTENT + 1), nm);
        assert!(matches!(beyond, Err(VolumeError::ExtentTooLarge { .. })));
        assert!(Volume::new("v", UVec3::ONE, DVec3::new(1.0, -1.0, 1.0)).is_err());
        assert!(Volume::new("v", UVec3::ONE, DVec3::NAN).is_err());
    }

    #[test]
    fn names_fit_addresses_and_files() {
        let longest = "n".repeat(100);
        for good in ["v", "fib25-medulla", "a.b_C-9", &longest] {
            assert_eq!(check_name(good), Ok(()), "{good}");
        }
        let long = "n".repeat(101);
        for bad in ["", ".", "..", ".v", "a b", "a/b", "a\\b", "µ", "a\n", &long] {
            let refused = check_name(bad);
            assert!(matches!(refused, Err(VolumeError::Name { .. })), "{bad:?}");
        }
    }

    #[test]
    fn descriptions_survive_json() {
        let mut v =
            Volume::new("v", UVec3::new(1000, 900, 50), DVec3::new(4.0, 4.0, 40.0)).unwrap();
        let json = serde_json::to_string(&v).unwrap();
        assert_eq!(serde_json::from_str::<Volume>(&json).unwrap(), v);
        let silent = ["looks", "origin", "shifts"]
            .iter()
            .all(|key| !json.contains(key));
        assert!(silent, "nothing is said: {json}");
        v.origin_nm = DVec3::new(-8.0, 0.5, 1e9);
        v.shifts_nm = vec![DVec3::ZERO, DVec3::X];
        assert_eq!(v.place_nm(1), DVec3::new(-7.0, 0.5, 1e9));
        assert_eq!(v.place_nm(2), v.origin_nm);
        let look = Look {
            color: Some([1, 2, 3]),
            window: Some([0.25, 0.5]),
            hidden: true,
        };
        v.looks = vec![Look::default(), look];
        let json = serde_json::to_string(&v).unwrap();
        assert_eq!(serde_json::from_str::<Volume>(&json).unwrap(), v);
        assert_eq!((v.look(1), v.look(2)), (look, Look::default()));
    }
}
