//! Futures natively travel between threads; in a browser nothing does.
//!
//! This folder is the whole difference that platforms make to asynchronous code here.

#[cfg(not(target_family = "wasm"))]
#[path = "maybe_send/native.rs"]
mod platform;
#[cfg(target_family = "wasm")]
#[path = "maybe_send/wasm.rs"]
mod platform;

pub use platform::{BoxFuture, BoxStream, MaybeSend, MaybeSync, sleep, spawn};
