//! What is kept at most, where a page has less room than a program.

#[cfg(not(target_family = "wasm"))]
#[path = "limits/native.rs"]
mod platform;
#[cfg(target_family = "wasm")]
#[path = "limits/wasm.rs"]
mod platform;

pub(crate) use platform::{CACHE_BYTES, KNOWN_PIECES};
