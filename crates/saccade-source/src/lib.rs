//! Where voxels come from.
//!
//! A [`VolumeSource`] describes a volume and delivers its chunks on demand: stitched from the tiles
//! of an archive ([`stitched`]), from an OME-Zarr image ([`zarr`]) or a precomputed volume ([`precomputed`]), an array in memory ([`memory`]), or a Saccade server
//! ([`remote`]). What a source cannot do is wait for the eye: everything above asks for chunks it
//! needs now, in the order of need, and drops the requests it no longer needs.
//!
//! The other way round, [`export`] writes what a source delivers as an OME-Zarr image, and [`ome`] describes it.
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
mod codecs;
pub mod conformance;
mod decoding;
#[cfg(not(target_family = "wasm"))]
pub mod export;
mod flights;
#[cfg(all(any(test, fuzzing), not(target_family = "wasm")))]
pub mod fuzz_targets;
pub mod images;
mod limits;
pub mod maybe_send;
pub mod memory;
pub mod objects;
pub mod ome;
pub mod precomputed;
#[cfg(not(target_family = "wasm"))]
mod processors;
pub mod remote;
#[cfg(all(test, not(target_family = "wasm")))]
mod shared;
mod source;
#[cfg(not(target_family = "wasm"))]
pub mod stitched;
mod stored;
#[cfg(all(test, not(target_family = "wasm")))]
mod test_server;
mod values;
#[cfg(target_family = "wasm")]
pub mod workers;
pub mod zarr;

pub use source::{
    Change, ChangeReason, Chunk, ChunkError, ChunkId, Damage, SourceError, ValueRange, VolumeSource,
};
pub use stored::PieceError;
