//! From the acquisition archive to the visualization archive \[000 §6\].
//!
//! Each record goes the same way: the image is decoded, its pyramid made and written durably, then
//! the tile is entered in the catalog together with how far the records were read, in one
//! transaction. So the catalog only ever names whole pyramids, and ingest that was killed at any
//! instant goes on where it was. Tiles are decoded and written while others are committed; commits
//! keep the order of the records.
//!
//! What cannot become a tile goes to the catalog's quarantine with the reason, and the next record
//! is taken up. A file that is not whole yet is waited for, as long as it still changes.

mod error;
mod options;
mod prepare;
mod run;
mod waiting;

pub use error::IngestError;
pub use options::IngestOptions;
pub use run::{Summary, run};
