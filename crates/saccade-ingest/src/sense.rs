//! Which transforms can be meant.

use saccade_core::transform::SectionFromTile;

/// Most voxels that a pixel may span along an axis, and most pixels that a voxel may.
const LARGEST_PIXEL: f64 = 512.0;

/// What is senseless about a transform: its pixels are not about as large as an overview's, or a fine region's, could be.
pub(crate) fn nonsense(transform: SectionFromTile) -> Option<String> {
    let [a, b, c, d, ..] = transform.elements();
    let sensible = 1.0 / LARGEST_PIXEL..=LARGEST_PIXEL;
    let is_sensible = [a.hypot(b), c.hypot(d)]
        .iter()
        .all(|scale| sensible.contains(scale));
    (!is_sensible).then(|| {
        format!(
            "a pixel of the tile would be larger than {LARGEST_PIXEL} voxels, or smaller than a {LARGEST_PIXEL}th of one \
             (transform {:?})",
            transform.elements()
        )
    })
}

/// What to look at.
pub(crate) const CHECK: &str = "the transform: it leads to level-0 voxels";
