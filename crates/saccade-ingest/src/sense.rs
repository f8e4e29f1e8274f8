//! Which transforms can be meant.

use saccade_archive::acquisition::Record;
use saccade_core::transform::SectionFromTile;

/// What is senseless about a transform: its pixels are not about as large as an overview's, or a fine region's, could be.
pub(crate) fn nonsense(transform: SectionFromTile) -> Option<String> {
    const LARGEST_PIXEL: f64 = Record::LARGEST_PIXEL;
    (!Record::is_sensible(transform)).then(|| {
        format!(
            "a pixel of the tile would be larger than {LARGEST_PIXEL} voxels, or smaller than a {LARGEST_PIXEL}th of one \
             (transform {:?})",
            transform.elements()
        )
    })
}

/// What to look at.
pub(crate) const CHECK: &str = "the transform: it leads to level-0 voxels";
