//! From the acquisition archive to the visualization archive \[000 §6\].
//!
//! Each record goes the same way: the image is decoded, its pyramid made and written durably, then
//! the tile is entered in the catalog, in one transaction with the end of its claim. So the catalog only
//! ever names whole pyramids, and ingest that was killed at any instant goes on where it was. Tiles are
//! decoded and written while others are entered.
//!
//! # Several workers
//!
//! Records are read in order, by whichever worker comes first, into the catalog's queue; transforms and
//! deletions take effect then, once what was said of their tile before is done. Tiles are claimed from the queue, by any number of workers on any number
//! of machines, and entered in the order in which they get ready. What a tile is follows from the
//! positions of its records, so that it does not matter whose turn it was. A worker gives signs of life;
//! the claims of one that gives none are free after [`IngestOptions::lease`]. A record that ends
//! [`IngestOptions::attempts`] workers goes to quarantine.
//!
//! What cannot become a tile goes to the catalog's quarantine with the reason, and the next record
//! is taken up. A file that is not whole yet is waited for, as long as it still changes, and so are records that
//! were cut shorter than what was read of them.

mod absent;
mod away;
mod begin;
mod earlier;
mod enter;
mod error;
mod images;
mod options;
mod prepare;
mod process;
mod reasons;
mod records;
mod run;
mod supply;
mod waiting;

pub use away::wait_until_there;
pub use error::IngestError;
pub use options::IngestOptions;
pub use run::{Summary, run};
