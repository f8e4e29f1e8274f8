//! Watches an acquisition archive and turns raw tiles into pyramids; simulates a microscope.
//!
//! [`ingest::run`] follows what a microscope writes: each tile gets its pyramid and its catalog
//! entry as soon as it arrives, whatever its transform and whoever looks.
//!
//! # Spaces and units
//!
//! Images are in tile pixels, transforms map them to level-0 voxels of their section. Sizes are in
//! bytes and pixels as named; rates in Mpixel/s (10^6 pixels).
//!
//! # Failure
//!
//! Bad input never ends the stream: it goes to the catalog's quarantine with its reason. What may
//! pass (an unfinished file, a full disk) is waited for. Errors are for what a person must mend
//! first. At any instant, and after `kill -9` at any instant, the catalog names only whole
//! pyramids; an acknowledged tile is never lost; starting again goes on where it was.
//!
//! # What it does not do
//!
//! It never changes the acquisition archive, and knows nothing of 3D: no levels, chunks or bricks.

#![cfg_attr(
    test,
    allow(
        clippy::disallowed_methods,
        reason = "tests also wait for what really happens"
    )
)]

mod cancel;
#[cfg(any(test, fuzzing))]
pub mod fuzz_targets;
mod held_up;
pub mod ingest;
mod progress;
pub mod replay;
mod sense;
pub mod simulate;
pub mod update;
#[cfg(unix)]
pub mod watch;
mod words;

pub use cancel::Cancel;
pub use held_up::{HeldUp, Part, Reason};
pub use progress::{Meter, Progress, State};
