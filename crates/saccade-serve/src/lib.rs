//! Volumes over HTTP: chunks, metadata, change events, state and the browser application.
//!
//! [`Volumes`] is the set of volumes on offer; it may grow while a [`Server`] runs. Every chunk is
//! asked of its [`VolumeSource`](saccade_source::VolumeSource) at the moment a client asks.
//!
//! # Addresses
//!
//! | address | what |
//! |---|---|
//! | `/` | the browser application |
//! | `/volumes.json` | names and revisions |
//! | `/v/NAME/volume.json` | the description and the revision |
//! | `/v/NAME/status.json` | tiles, sections, files set aside |
//! | `/v/NAME/events` | server-sent events, one per change |
//! | `/v/NAME/zarr/…` | OME-Zarr 0.5 |
//!
//! # Spaces and shapes
//!
//! Arrays are `[c, z, y, x]` with chunks of `[1, cz, cy, cx]`; this is where x, y, z turns around.
//! Scales are nanometres per voxel. The origin is the middle of voxel 0 of level 0, so a level whose
//! voxels average several is moved by half the difference. Boxes in events are level-0 voxels.
//!
//! # Failure
//!
//! | status | meaning |
//! |---|---|
//! | 404 | no such volume, level or chunk, or nothing was acquired there: the fill value |
//! | 304, 412, 416 | what a client's own conditions ask for |
//! | 503 with `Retry-After` | not ready, or a failure that may pass |
//! | 500 | reading failed for good; the log has the reason |
//!
//! Refusals are JSON, `{"error": …, "known": […]}`, and carry the headers that let pages of other
//! origins read them.
//!
//! # What it does not do
//!
//! It holds no state but the recent changes of each volume, limits no builds (sources do), knows no
//! users and no encryption: it listens on this computer only, unless told otherwise.

mod archive;
mod assets;
mod events;
mod history;
mod http;
mod routes;
mod server;
mod status;
mod volumes;
mod zarr;

pub use archive::{OfferError, follow_archive, offer_archive};
pub use server::{Compress, Options, ServeError, Server};
pub use status::{CatalogStatus, Quarantined, Status, StatusError, StatusSource};
pub use volumes::Volumes;
