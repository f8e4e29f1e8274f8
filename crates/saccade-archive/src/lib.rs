//! Reads what microscopes write; keeps tile pyramids and the catalog.

pub mod acquisition;
pub mod image;
pub mod pyramid;
pub mod storage;
