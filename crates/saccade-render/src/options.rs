//! What a renderer may use, and why there may be none.

use glam::UVec3;
use saccade_core::page_table::{PageTableError, PageTableShape};

/// How rays find what is not worth sampling, and what may stand in for what is missing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Traversal {
    /// By the residency octree.
    #[default]
    ResidencyOctree,
    /// By page tables alone, brick by brick: slower, and the same picture. For comparison.
    PageTables,
}

/// What a renderer may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RendererOptions {
    /// Ceiling for bricks, tables, readbacks and the picture together \[bytes\]. Small volumes use less.
    /// Some kilobytes of constants come on top; the host keeps a copy of the tables.
    pub memory_bytes: u64,
    /// Of that, what is kept for the picture \[bytes\], see [`Renderer::picture_bytes`](crate::Renderer::picture_bytes).
    /// One that takes more is drawn as well, and [`MemoryUse::total`](crate::MemoryUse::total) says so.
    pub picture_bytes: u64,
    /// How page tables are cut; `None` chooses by the volume's size.
    pub page_table_shape: Option<PageTableShape>,
    /// How rays find their way.
    pub traversal: Traversal,
    /// Size of the residency octree's smallest boxes \[level-0 voxels\], rounded to powers of
    /// two; `None` chooses by the shape of voxels. At coarser levels boxes are as many voxels *of that level*.
    pub octree_cell: Option<UVec3>,
    /// Nodes of the residency octree that are visited before a frame, to bring it up to date, give or take a brick's: half a
    /// microsecond each. What is left waits for the next frame.
    pub nodes_per_frame: u64,
    /// Keep 16-bit voxels as two 8-bit parts even where the device has a format for them: the same
    /// picture, as devices without one draw it. For comparison.
    pub split_16_bit: bool,
    /// Submissions a frame is cut into. More than one keeps slow drivers from giving up on a
    /// frame that takes seconds, and lets windows breathe between.
    pub bands: u32,
}

impl Default for RendererOptions {
    fn default() -> Self {
        Self {
            memory_bytes: 512 << 20,
            picture_bytes: 0,
            page_table_shape: None,
            traversal: Traversal::default(),
            octree_cell: None,
            nodes_per_frame: 4_096,
            split_16_bit: false,
            bands: 1,
        }
    }
}

/// Why there is no renderer for a volume.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RendererError {
    /// The volume does not fit the page tables.
    #[error("the volume cannot be addressed")]
    PageTable {
        /// Which part does not fit.
        #[from]
        source: PageTableError,
    },
    /// A page table shape that the shaders cannot walk.
    #[error("page tables cannot be cut as {shape:?}; use depth 2 or 3 and blocks of 16 or 32")]
    PageTableShape {
        /// As asked for.
        shape: PageTableShape,
    },
    /// The ceiling leaves no room to work in.
    #[error("{ceiling} bytes of GPU memory are too few for this volume; allow {needed} or more")]
    Ceiling {
        /// As asked for \[bytes\].
        ceiling: u64,
        /// What would do \[bytes\].
        needed: u64,
    },
    /// The device does not offer what the shaders need.
    #[error("the GPU offers {offered} {what}, and {needed} are needed")]
    Limit {
        /// Which limit.
        what: &'static str,
        /// What the device has.
        offered: u64,
        /// What is needed.
        needed: u64,
    },
}
