//! Shaders of what is compared with, compiled as the product's is.

use saccade_render::wgpu;

/// Compiles without counters that end loops, as the product's ray-caster is.
///
/// `source` is one of the files here: each of their loops takes a step along a ray, or down a tree.
#[expect(
    unsafe_code,
    reason = "compared with a ray-caster whose loops have no counters"
)]
pub(crate) fn shader_module(
    device: &wgpu::Device,
    label: &str,
    source: &str,
) -> wgpu::ShaderModule {
    let descriptor = wgpu::ShaderModuleDescriptor {
        label: Some(label),
        source: wgpu::ShaderSource::Wgsl(source.into()),
    };
    let checks = wgpu::ShaderRuntimeChecks {
        force_loop_bounding: false,
        ..wgpu::ShaderRuntimeChecks::checked()
    };
    // SAFETY: No loop is infinite (see above), and all other checks stay.
    unsafe { device.create_shader_module_trusted(descriptor, checks) }
}
