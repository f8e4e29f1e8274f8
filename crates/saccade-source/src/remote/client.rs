//! Who sends requests: natively with encryption of our choice, in a browser the browser.

#[cfg(not(target_family = "wasm"))]
#[path = "client/native.rs"]
mod platform;
#[cfg(target_family = "wasm")]
#[path = "client/wasm.rs"]
mod platform;

pub(super) use platform::client;
