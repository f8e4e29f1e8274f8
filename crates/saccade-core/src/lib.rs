//! The words every other room uses.
//!
//! Pure data and arithmetic: where a voxel is, which brick holds it, which page table entry maps
//! the brick, how a value becomes a colour. Everything here can be computed by hand and is tested
//! that way.
//!
//! # Spaces and units
//!
//! | space | unit | origin | Rust | WGSL suffix |
//! |---|---|---|---|---|
//! | physical | nanometre | low corner of voxel 0 | [`Point<Physical>`](space::Point) | `_nm` |
//! | voxel | level-0 voxel | low corner of voxel 0 | [`Point<Voxel>`](space::Point) | `_voxel` |
//! | normalised | 1 | low corner of the volume, `[0, 1]` per axis | [`Point<Normalised>`](space::Point) | `_norm` |
//! | tile | pixel of a tile's finest level | low corner of pixel 0 | [`transform::TilePoint`] | |
//!
//! Voxel `i` covers `[i, i + 1)`; its sample sits at `i + 0.5`. The same holds for tile pixels and
//! for the voxels of every level.
//!
//! # Shapes
//!
//! Vectors are `(x, y, z)`. Arrays of voxels are stored with x fastest, then y, then z.
//!
//! # Failure
//!
//! Values that came from outside are checked where they enter and refused with a typed error.
//! Nothing here panics unless this crate has a bug.
//!
//! # What it does not do
//!
//! No input or output, no `async`, no GPU, no threads, no clock. Runs natively and in browsers.

pub mod brick;
pub mod camera;
pub mod levels;
pub mod page_table;
pub mod phantom;
pub mod space;
pub mod transfer;
pub mod transform;
pub mod volume;
pub mod voxel_box;
