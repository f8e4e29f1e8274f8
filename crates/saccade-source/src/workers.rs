//! Decoding chunks off the page's own thread.
//!
//! A page says once where its workers' script is ([`use_workers`]); the script gives what it is sent to [`work`].
//! Workers are plain ones: no shared memory, no headers that a server must send. Bytes and voxels are handed over between
//! threads, not copied.

pub use crate::decoding::{Counts, counts, use_workers, work};
