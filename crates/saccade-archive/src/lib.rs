//! Reads what microscopes write; keeps tile pyramids and the catalog.

pub mod acquisition;
pub mod catalog;
pub mod image;
pub mod pyramid;
pub mod storage;
mod visualization;

pub use visualization::{ArchiveError, VisualizationArchive};
