/// Main memory that may be asked for \[MiB\].
pub(super) const MOST_HOST_MIB: u32 = u32::MAX;

/// What that is, in words.
pub(super) const HOST_MEMORY_WANTED: &str = "whole MiB from 16 on, as in 512";
