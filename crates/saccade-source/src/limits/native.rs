/// Decoded chunks that are kept, all levels together \[bytes\].
pub(crate) const CACHE_BYTES: u64 = 512 << 20;

/// Pieces of an image that are known again when they change.
pub(crate) const KNOWN_PIECES: usize = 1 << 18;
