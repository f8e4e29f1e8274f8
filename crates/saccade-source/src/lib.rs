//! Where voxels come from.
//!
//! A [`VolumeSource`] describes a volume and delivers its chunks on demand: stitched from the tiles
//! of an archive ([`stitched`]), from an OME-Zarr image ([`zarr`]), an array in memory ([`memory`]), or a Saccade server
//! ([`remote`]). What a source cannot do is wait for the eye: everything above asks for chunks it
//! needs now, in the order of need, and drops the requests it no longer needs.
//!
//! # Spaces and shapes
//!
//! Chunks are boxes of [`Volume::chunk`](saccade_core::volume::Volume::chunk) voxels of one level
//! and channel, x fastest. A chunk that reaches past the volume's end has its full size, padded
//! with 0. Value 0 means nothing was acquired; measured values are 1 or above.
//!
//! # Failure
//!
//! A chunk without data is not an error: it is [`Chunk::Empty`]. [`ChunkError`] tells what may
//! succeed later from what will not. No failure stops other requests.
//!
//! # What it does not do
//!
//! It knows nothing of bricks, borders, GPUs or views.

mod changes;
pub mod conformance;
pub mod maybe_send;
pub mod memory;
pub mod remote;
mod source;
#[cfg(not(target_family = "wasm"))]
pub mod stitched;
#[cfg(not(target_family = "wasm"))]
pub mod zarr;

pub use source::{
    Change, ChangeReason, Chunk, ChunkError, ChunkId, SourceError, ValueRange, VolumeSource,
};
