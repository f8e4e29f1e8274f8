//! GPU virtual memory and the ray-caster.

mod gpu;
mod renderer;
mod report;
mod view;

pub use gpu::{Gpu, GpuError};
pub use renderer::{
    BrickVoxels, Delivery, DeliveryError, ReadError, Renderer, RendererError, RendererOptions,
};
pub use report::{Fidelity, FrameReport, MemoryUse, Statistics};
pub use view::{Image, View};
pub use wgpu;
