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
//! | `/volumes` | a page that lists the volumes, with links that open them in other viewers |
//! | `/openapi.json` | describes the answers in JSON |
//! | `/volumes.json` | names and revisions; those that cannot be opened now, and why |
//! | `/v/NAME/volume.json` | the description, the revision and the version |
//! | `/v/NAME/status.json` | tiles, sections, files set aside |
//! | `/v/NAME/events` | server-sent events, one per change |
//! | `/v/NAME/changes/REVISION` | what has changed after that revision, as long as it is known |
//! | `/v/NAME/thumbnail.png` | one section of a coarse level |
//! | `/v/NAME/zarr/…` | OME-Zarr 0.5 |
//! | `/v/NAME/zarr2/…` | OME-Zarr 0.4 |
//! | `/v/NAME/precomputed/…` | Neuroglancer precomputed |
//! | `/v/NAME/at/VERSION/zarr/…`, and so on | the same, for clients that never ask again |
//!
//! Voxels carry a strong tag and are to be asked for again each time (`Cache-Control: no-cache`).
//! Below `at/VERSION` they are what they are now, too; those that have not changed since that
//! version may be kept for good.
//!
//! Of labels whose ids the volume's type has no room for, answers with voxels carry `saccade-renamed-label: ID` as soon as such an id
//! was met by anybody: it is another number there, which others may share.
//!
//! # Spaces and shapes
//!
//! In OME-Zarr arrays are `[c, z, y, x]` with chunks of `[1, cz, cy, cx]`; this is where x, y, z
//! turns around. Scales are nanometres per voxel. The origin is the middle of voxel 0 of level 0, so
//! a level whose voxels average several is moved by half the difference. Precomputed has x, y, z, its
//! origin at the corner of voxel 0, and chunks that end where the volume does. Boxes in events are
//! level-0 voxels.
//!
//! # Failure
//!
//! | status | meaning |
//! |---|---|
//! | 404 | no such volume, level or chunk; with the header `saccade-nothing-acquired`, a chunk without voxels: the fill value |
//! | 304, 412, 416 | what a client's own conditions ask for |
//! | 503 with `Retry-After` | not ready, or a failure that may pass, which `cause` names; also of a volume that cannot be opened now |
//! | 503 with `Retry-After`, also | more connections, requests or event streams at once than [`Limits`] allow |
//! | 421, 403 | a name that the server does not have, an origin that it does not let read ([`Access`]) |
//! | 424 | what the voxels are read from is damaged: `cause` says what, and asking again does not help |
//! | 500 | the catalog cannot be read; `cause` says why |
//!
//! Refusals are JSON, `{"error": …, "known": […]}`, and carry the headers that let pages of other
//! origins read them.
//!
//! # What it does not do
//!
//! It holds no state but the recent changes of each volume, limits no builds (sources do), knows no
//! users and no encryption: it listens on this computer only, unless told otherwise. It reads no
//! bodies of requests.

mod api;
mod archive;
mod assets;
mod events;
mod formats;
#[cfg(any(test, fuzzing))]
pub mod fuzz_targets;
mod history;
mod http;
mod index;
mod lingering;
mod pieces;
mod routes;
mod server;
mod status;
mod thumbnail;
mod volumes;

pub use archive::{Offer, follow_archive, offer_archive};
pub use server::{Access, Compress, Limits, Options, Origins, ServeError, Server};
pub use status::{
    CatalogStatus, DamagedTile, HeldUp, Quarantined, Status, StatusError, StatusSource,
};
pub use volumes::Volumes;
