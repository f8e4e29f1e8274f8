//! The pull: from a brick the eye missed to that brick in the picture.
//!
//! A [`Session`] joins a [`VolumeSource`](saccade_source::VolumeSource) to a
//! [`Renderer`](saccade_render::Renderer). Each call of [`Session::frame`] takes what has arrived,
//! asks for what the newest picture misses, most wanted first, hands finished bricks to the
//! renderer and draws when something changed. Everything that shows a volume goes through it: the
//! window, the browser, and pictures without either.
//!
//! # Spaces and shapes
//!
//! Sources speak of chunks of any size, renderers of bricks of 32³ voxels with a border of one.
//! [`brick`] is the only place where one becomes the other. Boxes of changes are level-0 voxels.
//!
//! # Promises
//!
//! - Nothing here waits: [`Session::frame`] returns at once, whatever sources and GPUs do.
//!   [`Session::settle`], for pictures without a window, is the exception and says so.
//! - Chunks in flight, memory for chunks, and bricks delivered per frame are bounded
//!   ([`policy::Limits`]).
//! - A brick that is wanted is delivered or reported as failed, in any order of delays, failures
//!   and changes; an answer that began before a change is never shown after it.
//!
//! # Failure
//!
//! Failures that may pass are asked for again, with growing delays. Lasting ones are reported
//! ([`pull::Progress`]) and not asked for again until a change touches them. No failure holds up
//! other bricks.
//!
//! # Platforms
//!
//! Native, on a Tokio runtime whose context [`Session`]'s methods are called in, and browsers.
//!
//! # What it does not do
//!
//! It knows neither where voxels come from nor what is drawn.

pub mod brick;
mod channels;
mod clock;
mod detail;
mod histogram;
mod host_cache;
pub mod policy;
pub mod pull;
mod requests;
mod session;
#[cfg(not(target_family = "wasm"))]
mod settle;

pub use channels::{Channel, shown_at_first};
pub use detail::Detail;
pub use histogram::{Sample, sample};
pub use session::{Again, Session, SessionError, SessionOptions, Status, TooLarge, TooMuch, Wake};
#[cfg(not(target_family = "wasm"))]
pub use settle::SettleError;
