//! A volume as a virtual OME-Zarr 0.5 image.

mod chunk;
mod key;
mod metadata;

pub(crate) use chunk::chunk;
pub(crate) use key::Key;
pub(crate) use metadata::{array, group};
