//! Other systems decide for themselves.

use memmap2::MmapMut;

/// Nothing to ask for.
pub(super) fn prefer_large(_map: &MmapMut) {}
