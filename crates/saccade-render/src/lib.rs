//! GPU virtual memory and the ray-caster.

mod frame;
mod gpu;
mod image;
mod layout;
mod memory;
mod ray_caster;
mod readback;
mod renderer;
mod report;
mod resources;
mod stored_brick;
mod view;

pub use gpu::{Gpu, GpuError};
pub use image::{Image, ReadError};
pub use renderer::{
    BrickVoxels, Delivery, DeliveryError, Renderer, RendererError, RendererOptions,
};
pub use report::{Fidelity, FrameReport, MemoryUse, Statistics};
pub use view::View;
pub use wgpu;
