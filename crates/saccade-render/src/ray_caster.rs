//! The compiled ray-caster. Compiling takes a while, so all renderers of a device share one.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};

use crate::layout::{FrameUniform, Variant, ray_cast};

/// Format of the picture: portable for storage, read as it is by windows.
pub(crate) const IMAGE_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;

/// The pipelines and the order of their bindings.
#[derive(Debug)]
pub(crate) struct RayCaster {
    pub(crate) layout: wgpu::BindGroupLayout,
    pipelines: Mutex<HashMap<Variant, wgpu::ComputePipeline>>,
}

impl RayCaster {
    pub(crate) fn new(device: &wgpu::Device) -> Self {
        Self {
            layout: bind_group_layout(device),
            pipelines: Mutex::default(),
        }
    }

    /// The pipeline of a variant, compiled when it is first asked for.
    pub(crate) fn pipeline(
        &self,
        device: &wgpu::Device,
        variant: Variant,
    ) -> wgpu::ComputePipeline {
        let mut pipelines = self
            .pipelines
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let compile = || pipeline(device, &self.layout, variant);
        pipelines.entry(variant).or_insert_with(compile).clone()
    }
}

fn bind_group_layout(device: &wgpu::Device) -> wgpu::BindGroupLayout {
    let storage = |read_only| wgpu::BindingType::Buffer {
        ty: wgpu::BufferBindingType::Storage { read_only },
        has_dynamic_offset: false,
        min_binding_size: None,
    };
    let texture = |view_dimension, sample_type| wgpu::BindingType::Texture {
        sample_type,
        view_dimension,
        multisampled: false,
    };
    let float = |filterable| wgpu::TextureSampleType::Float { filterable };
    let types = [
        wgpu::BindingType::Buffer {
            ty: wgpu::BufferBindingType::Uniform,
            has_dynamic_offset: true,
            min_binding_size: wgpu::BufferSize::new(size_of::<FrameUniform>() as u64),
        },
        storage(true),
        storage(true),
        storage(true),
        storage(false),
        storage(false),
        texture(wgpu::TextureViewDimension::D2, float(false)),
        texture(wgpu::TextureViewDimension::D3, float(true)),
        wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering),
        wgpu::BindingType::StorageTexture {
            access: wgpu::StorageTextureAccess::WriteOnly,
            format: IMAGE_FORMAT,
            view_dimension: wgpu::TextureViewDimension::D2,
        },
        texture(
            wgpu::TextureViewDimension::D2,
            wgpu::TextureSampleType::Uint,
        ),
        storage(true),
    ];
    let entries = (0..)
        .zip(types)
        .map(|(binding, ty)| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty,
            count: None,
        });
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some("ray-caster"),
        entries: &entries.collect::<Vec<_>>(),
    })
}

/// Compiles the ray-caster without counters that end its loops, which cost as much as what they count: each loop ends
/// by itself, as a ray comes to its end whatever it meets, nodes have so many depths, and there are so many levels, channels and bricks.
#[expect(unsafe_code, reason = "loops of our own that end need no counters")]
fn shader_module(device: &wgpu::Device, variant: Variant) -> wgpu::ShaderModule {
    let descriptor = wgpu::ShaderModuleDescriptor {
        label: Some("ray-caster"),
        source: wgpu::ShaderSource::Wgsl(ray_cast(variant).into()),
    };
    let checks = wgpu::ShaderRuntimeChecks {
        force_loop_bounding: false,
        ..wgpu::ShaderRuntimeChecks::checked()
    };
    // SAFETY: No loop is infinite (see above), and all other checks stay.
    unsafe { device.create_shader_module_trusted(descriptor, checks) }
}

fn pipeline(
    device: &wgpu::Device,
    layout: &wgpu::BindGroupLayout,
    variant: Variant,
) -> wgpu::ComputePipeline {
    let module = shader_module(device, variant);
    let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some("ray-caster"),
        bind_group_layouts: &[Some(layout)],
        immediate_size: 0,
    });
    device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some("ray-caster"),
        layout: Some(&layout),
        module: &module,
        entry_point: Some("main"),
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    })
}
