/// Main memory that may be asked for \[MiB\]: pages have no more.
pub(super) const MOST_HOST_MIB: u32 = 2048;

/// What that is, in words.
pub(super) const HOST_MEMORY_WANTED: &str = "whole MiB from 16 to 2048, as in 512";
