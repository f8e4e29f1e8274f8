//! GPU virtual memory and the ray-caster.
//!
//! [`Renderer`] draws one volume from the bricks that are resident right now. It never waits for
//! data: what a frame wanted and did not find is in its [`FrameReport`], and the caller delivers it
//! when it can. The same code and the same shaders run natively and in browsers.
//!
//! # The way of a frame
//!
//! ```text
//!            render(view)                 finish() or poll()               deliver(id, voxels)
//! View ─────► flush changed entries        counters, usage, misses  ──────► slot, entry, texture
//!             rays ─► directory ─► tables ─► brick cache                     (least recently used
//!                       │ missed entry, once a frame        FrameReport      goes, never what the
//!                       └ used slot, a bit                  misses, fidelity  last frame used)
//! ```
//!
//! 1. [`Renderer::render`] uploads what changed in the page tables and the residency octree, casts one
//!    ray per pixel, and asks for the report. It returns at once.
//! 2. A ray asks the octree, from the node it was in last, for the largest region around its next
//!    sample that the transfer function hides or in which all samples are alike \[001 §7.1\], and
//!    passes it in one step. Such a region needs no brick.
//! 3. Elsewhere it walks from the page directory through page table blocks to a brick \[000 §4.1.3\]. An
//!    unmapped entry is marked by its *physical* number in a dense bitmask and listed once, at most
//!    four per ray, front to back \[000 §4.2.2\].
//! 4. [`Renderer::poll`] reads reports that have arrived. Missing page table blocks are made at
//!    once, so the bricks behind them show up in the next report ([`FrameReport::redraw`]).
//! 5. [`Renderer::deliver`] gives a brick the slot that was used longest ago.
//!
//! When the bricks of a view do not fit, the level of detail becomes coarser until they do, the
//! report says so ([`FrameReport::memory_bias`]), and it becomes finer again when it can.
//!
//! # Spaces and units
//!
//! Lengths are nanometres (`_nm`), positions in a level are voxels of that level. A ray is
//! `eye + t * direction` where `t`, its *depth*, counts nanometres along the viewing direction.
//! Positions reach the shader as a brick near the eye and an offset in voxels, per level, so f32
//! is precise to a hundredth of a voxel wherever the eye is in a petascale volume: a level is only
//! wanted within some thousands of its voxels from the eye.
//!
//! # What a picture is
//!
//! A ray is cut into segments, from where it enters the volume or starts at the eye.
//!
//! - The **level** wanted at a segment's start is the one whose voxel is nearest to a pixel in size,
//!   by ratio. A voxel's size is the root of the area of its shadow along the ray: for voxels of
//!   4 x 4 x 40 nm, 4 nm seen from the front and 13 nm from the side. A pixel's size is
//!   [`Camera::pixel_nm`](saccade_core::camera::Camera::pixel_nm) at that depth, times 2 to the power of the level-of-detail bias.
//! - A **channel** is drawn at that level, or at the nearest of those it may be drawn at
//!   ([`ChannelView::levels`]), all at the same places: the finest of their levels says how far apart.
//! - A **segment** is half a voxel of the finest level drawn long, measured along the ray in voxels of
//!   that level, the last one shorter. After 8192 segments it doubles, so that every ray ends.
//! - It is **sampled** once, in its middle (or elsewhere in it, with [`View::jitter`]): trilinear
//!   within one level. Outside the volume is what bricks carry there, as a rule nothing.
//! - Its **colour** comes from the table of the transfer function, between two entries by their
//!   linear light and extinction. Channels add up: extinctions are summed, and so is light, by extinction. Its **opacity** is `1 - exp(-extinction * length)`. Pictures do
//!   not depend on the step.
//! - Segments are composited front to back in linear light over [`View::background`], until less
//!   than 1/4096 of the light is left, and encoded as sRGB.
//! - Where single values count, with [`Mode::Maximum`] and [`Mode::IsoSurface`], half a voxel is measured along the axis along which
//!   the ray passes most voxels, its main axis, and samples lie in the planes across it through voxels' middles and faces. Where the ray
//!   crosses planes through voxels' middles across the other axes, samples lie there as well, and stand for that of a face between two
//!   middles. So what is one voxel thin is met in its middle, and is as bright and as whole from wherever it is looked at. A
//!   maximum is also that of where the ray begins and ends. Of labels, samples lie half way between the planes of the main axis.
//! - With [`Mode::Maximum`] the largest value along the ray gives the colour of its channel, and the light
//!   of channels is added; with [`Mode::IsoSurface`] the ray ends where a channel's value, linear
//!   between samples, passes its bound, lit by how much the surface faces the eye; what a face of the volume or a
//!   clip cuts through faces it as the cut does. Its colour is that of the bound, half as bright as can be at least.
//! - **Clipping** ([`Clip`]) cuts the ray before it is cut into segments.
//! - 16-bit voxels are **exact**: in textures of 16 bit, or as two parts of 8 bit that are joined before they
//!   are interpolated.
//! - **Labels** ([`VoxelKind`](saccade_core::volume::VoxelKind)) are not interpolated: no sample has a number that no object has. Their surface is that of
//!   the first voxel met, lit as what belongs to objects lies in the 26 around it, whatever its number.
//! - What is **missing** is drawn from the nearest coarser level that is there, else from up to two
//!   levels finer, else not at all. Where no good substitute is there, a brick two levels coarser
//!   and the coarsest one are asked for first: they come soon and show much.
//! - Regions that are **hidden** by the transfer function are never sampled, and their bricks neither
//!   asked for nor kept, once it is known what values they have: from an earlier brick of the same
//!   level, or from [`Renderer::note_range`]. What is known outlives the brick, not a change.
//!
//! # Failure
//!
//! No adapter, an impossible ceiling, a channel twice: typed errors when things are
//! made. A missing brick is not an error. Errors of the device while drawing are logged and end
//! nothing; a lost device is told by [`Gpu::is_lost`], and everything made with it is to be made
//! again. A camera that is not finite sees background.
//!
//! # What it does not do
//!
//! It fetches nothing, opens no window, starts no thread but to compile shaders, and reads no clock. Labels have no colours of their own yet: their
//! numbers are taken for shades. Transfer functions have one dimension.

mod channel;
mod delivery;
mod frame;
mod gpu;
mod image;
mod layout;
mod memory;
mod octree;
mod options;
mod ray_caster;
mod readback;
mod renderer;
mod report;
mod resources;
mod stored_brick;
mod transfer_table;
mod view;

pub use channel::{ChannelError, ChannelView};
pub use delivery::{BrickVoxels, Delivery, DeliveryError};
pub use gpu::{Gpu, GpuError};
pub use image::{Image, ReadError};
pub use options::{RendererError, RendererOptions, Traversal};
pub use renderer::Renderer;
pub use report::{Fidelity, FrameReport, MemoryUse, Statistics};
pub use view::{Clip, FalseColors, HalfSpace, Heat, Mode, Slab, View, Work};
/// The GPU interface, so that all rooms use one version.
pub use wgpu;
