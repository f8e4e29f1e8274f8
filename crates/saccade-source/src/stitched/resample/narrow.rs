//! In the place of `wide`, for processors whose wide registers are not used.

use super::line::{Line, OfSum};

/// Whether the processor serves a line in an image.
pub(super) fn serves(_values: &[u8], _line: Line) -> bool {
    false
}

/// Interpolates nothing, see [`serves`].
pub(super) fn interpolate<K: OfSum>(
    _values: &[u8],
    _width: usize,
    _line: Line,
    _out: &mut [K],
) -> usize {
    0
}
