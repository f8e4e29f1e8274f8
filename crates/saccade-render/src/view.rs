//! What one frame shows.

use glam::{DVec3, UVec2};
use saccade_core::camera::Camera;
use saccade_core::space::{Physical, Point};

/// How the samples along a ray become a colour.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Mode {
    /// Light that matter sends out and takes up.
    #[default]
    EmissionAbsorption,
    /// Per channel, the largest value, or the smallest where structures are dark. Opacities do
    /// not matter.
    Maximum,
    /// The first place where a channel's value passes [`ChannelView::iso`](crate::ChannelView::iso), lit from the eye.
    IsoSurface,
}

/// What colours tell besides values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum FalseColors {
    /// Nothing: they are those of the transfer function.
    #[default]
    None,
    /// What is drawn from another level than wanted is tinted, from green, one level coarser, to red, and blue where it is
    /// finer; what is missing lies in a magenta fog.
    Residency,
    /// Everything is tinted by the level that it is drawn from, as [`Self::of_level`] says.
    Level,
}

impl From<bool> for FalseColors {
    /// Nothing, or residency.
    fn from(residency: bool) -> Self {
        if residency {
            Self::Residency
        } else {
            Self::None
        }
    }
}

/// Tints of levels, from the finest on and then again. Mirrors `color.wgsl`; a test compares the two.
const LEVEL_TINTS: [[f32; 3]; 6] = [
    [0.9, 0.1, 0.1],
    [0.9, 0.7, 0.05],
    [0.15, 0.7, 0.1],
    [0.05, 0.7, 0.8],
    [0.1, 0.2, 1.0],
    [0.8, 0.15, 0.8],
];

impl FalseColors {
    /// What [`Self::Level`] tints a level with, linear RGB, for a legend.
    pub fn of_level(level: u32) -> [f32; 3] {
        LEVEL_TINTS[level as usize % LEVEL_TINTS.len()]
    }
}

/// What is drawn instead of the volume: how much work each ray was, from black through red and yellow to white.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Heat {
    /// What is counted.
    pub of: Work,
    /// A count that is drawn white.
    pub full: f32,
}

/// Work of a ray.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Work {
    /// Entries read of the page directory and of page tables \[000 fig. 6\].
    Lookups,
    /// Nodes of the residency octree visited.
    Nodes,
    /// Samples taken.
    Samples,
}

/// Half of space: what lies on the side that the normal points to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HalfSpace {
    /// Some point on its face \[nm\].
    pub point: Point<Physical>,
    /// Perpendicular to its face, of any length but zero, which is all of space.
    pub normal: DVec3,
}

/// Part of a volume.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Clip {
    /// Nothing outside of this box is seen: two opposite corners \[nm\].
    pub within: Option<[Point<Physical>; 2]>,
    /// Nothing outside of any of these is seen.
    pub half_spaces: [Option<HalfSpace>; 4],
    /// Nothing outside of this slab is seen.
    pub slab: Option<Slab>,
}

impl Clip {
    /// Low and high corner of what is seen of a volume of some size \[nm\]; not above each other where
    /// nothing is.
    pub(crate) fn corners(&self, size_nm: DVec3) -> [DVec3; 2] {
        match self.within {
            None => [DVec3::ZERO, size_nm],
            Some([a, b]) => [
                a.xyz.min(b.xyz).max(DVec3::ZERO),
                a.xyz.max(b.xyz).min(size_nm),
            ],
        }
    }
}

/// Space between two parallel planes; with [`Mode::Maximum`] and no thickness, a slice.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Slab {
    /// Some point in its middle \[nm\].
    pub point: Point<Physical>,
    /// Perpendicular to it, of any length but zero, which is all of space.
    pub normal: DVec3,
    /// Thickness \[nm\]; of 0, each ray takes one sample.
    pub thickness_nm: f64,
}

/// What one frame shows, and how.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// From where.
    pub camera: Camera,
    /// Size of the picture \[pixels\].
    pub size: UVec2,
    /// How samples become colours.
    pub mode: Mode,
    /// Which part is seen.
    pub clip: Clip,
    /// Levels coarser (positive) or finer (negative) than one voxel a pixel.
    pub lod_bias: f32,
    /// Draw missing bricks from other levels where those are resident.
    pub substitute: bool,
    /// What colours tell besides values.
    pub false_colors: FalseColors,
    /// Draw the work of rays instead.
    pub heat: Option<Heat>,
    /// Behind everything, linear RGB in `[0, 1]`.
    pub background: [f32; 3],
    /// Offset each ray's first sample by a fixed pattern: noise instead of rings.
    pub jitter: bool,
}

impl View {
    /// The plain view from a camera: one voxel a pixel, substitution on, black background.
    pub fn new(camera: Camera, size: UVec2) -> Self {
        Self {
            camera,
            size,
            mode: Mode::default(),
            clip: Clip::default(),
            lod_bias: 0.0,
            substitute: true,
            false_colors: FalseColors::None,
            heat: None,
            background: [0.0; 3],
            jitter: false,
        }
    }
}
