//! Linux gives large pages to whom they are advised for, unless it is set to "never".

use memmap2::{Advice, MmapMut};

/// Asks for large pages. Where there are none the others do.
pub(super) fn prefer_large(map: &MmapMut) {
    let _ = map.advise(Advice::HugePage);
}
