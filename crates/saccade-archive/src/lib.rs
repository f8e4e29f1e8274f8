//! Reads what microscopes write; keeps tile pyramids and the catalog.
//!
//! Two folders meet here. The *acquisition archive* is the microscope's: [`acquisition`] reads its
//! records and [`image`] its tiles, and neither changes it. The *visualization archive* is ours: a
//! [`catalog`] that says which tiles there are and where they lie, and a [`storage`] that holds
//! each tile's [`pyramid`]. [`VisualizationArchive`] opens both together.
//!
//! # Spaces and units
//!
//! | what | unit | origin |
//! |---|---|---|
//! | tile | pixel of its finest level | low corner of pixel 0; pixel `i` covers `[i, i + 1)` |
//! | pyramid level k | 2^k tile pixels | the same corner |
//! | sub-tile | 128 pixels of its level | the same corner |
//! | section | level-0 voxel, x and y | low corner of the volume; z is the section's number |
//!
//! Transforms lead to sections from tiles. Images are 8 bit, x fastest, y downwards as stored.
//!
//! # Failure
//!
//! Files are believed nothing: whatever is in them ends in a typed error, never a panic. Errors
//! tell what may succeed later (`is_transient`) from what will not. [`check`] looks at a whole archive.
//!
//! The order of a tile's steps makes crashes harmless: its pyramid is written under a temporary
//! name, synced, renamed, and the folder synced; only then does one transaction name it in the
//! catalog. The catalog therefore never names a pyramid that is not whole, and what it has
//! acknowledged survives a power cut. What a crash can leave is a pyramid that nothing names.
//!
//! # What it does not do
//!
//! It does not decide when anything is processed, move pixels between tiles, or know of a third
//! dimension beyond the sections' numbers. It does not run in browsers.

#![cfg_attr(
    test,
    allow(
        clippy::disallowed_methods,
        reason = "tests also wait for what really happens"
    )
)]

pub mod acquisition;
pub mod catalog;
pub mod check;
pub mod clock;
pub mod image;
mod large_buffer;
mod percent;
pub mod pyramid;
pub mod randomness;
pub mod storage;
pub mod tls;
mod visualization;

pub use catalog::CatalogLocation;
pub use large_buffer::LargeBuffer;
pub use visualization::{
    ArchiveError, ArchiveLocation, IDENTITY, LocationError, StorageLocation, VisualizationArchive,
    read_identity,
};
