/// Decoded chunks that are kept, all levels together \[bytes\]. A page has 4 GB at most, and shares it with what it shows.
pub(crate) const CACHE_BYTES: u64 = 128 << 20;

/// Pieces of an image that are known again when they change.
pub(crate) const KNOWN_PIECES: usize = 1 << 14;
