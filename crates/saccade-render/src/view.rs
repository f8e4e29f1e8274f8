//! What one frame shows.

use glam::UVec2;
use saccade_core::camera::Camera;

/// What one frame shows, and how.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// From where.
    pub camera: Camera,
    /// Size of the picture \[pixels\].
    pub size: UVec2,
    /// Levels coarser (positive) or finer (negative) than one voxel a pixel.
    pub lod_bias: f32,
    /// Draw missing bricks from other levels where those are resident.
    pub substitute: bool,
    /// Tint what is drawn from other levels, and show what is missing.
    pub false_colors: bool,
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
            lod_bias: 0.0,
            substitute: true,
            false_colors: false,
            background: [0.0; 3],
            jitter: false,
        }
    }
}
