//! What the window's device must offer.

use std::sync::Arc;

use eframe::egui_wgpu::{RenderState, WgpuConfiguration, WgpuSetup, WgpuSetupCreateNew};
use saccade_render::Gpu;

/// A device that the renderer can work with, on any backend that has compute shaders.
pub(crate) fn wgpu_options() -> WgpuConfiguration {
    let mut create = WgpuSetupCreateNew::without_display_handle();
    create.device_descriptor = Arc::new(Gpu::device_descriptor);
    WgpuConfiguration {
        wgpu_setup: WgpuSetup::CreateNew(create),
        ..WgpuConfiguration::default()
    }
}

/// The renderer's part of the window's device.
pub(crate) fn gpu_of(state: &RenderState) -> Gpu {
    Gpu::from_parts(
        state.device.clone(),
        state.queue.clone(),
        state.adapter.get_info(),
    )
}
