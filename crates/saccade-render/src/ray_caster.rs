//! The compiled ray-caster. Compiling takes a while, so all renderers of a device share one, and a frame does with a
//! variant that is there while the one it wants is compiled elsewhere.

use std::collections::{HashMap, HashSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::layout::{Counting, FrameUniform, Variant, ray_cast};

#[cfg(not(target_family = "wasm"))]
#[path = "ray_caster/native.rs"]
mod platform;
#[cfg(target_family = "wasm")]
#[path = "ray_caster/wasm.rs"]
mod platform;

/// Format of the picture: portable for storage, read as it is by windows.
pub(crate) const IMAGE_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;

/// The pipelines and the order of their bindings.
#[derive(Debug)]
pub(crate) struct RayCaster {
    pub(crate) layout: wgpu::BindGroupLayout,
    compiled: Arc<Mutex<Compiled>>,
    /// Whether others than the drawing thread compile.
    in_background: AtomicBool,
    counting: Counting,
}

#[derive(Debug, Default)]
struct Compiled {
    ready: HashMap<Variant, wgpu::ComputePipeline>,
    /// Those that some thread compiles, or has.
    begun: HashSet<Variant>,
}

impl Compiled {
    /// One that draws the same, as cheaply as there is one.
    fn stand_in(&self, wanted: Variant) -> Option<&wgpu::ComputePipeline> {
        let able = self.ready.iter().filter(|(v, _)| v.stands_in_for(wanted));
        let cheapest = able.min_by_key(|(v, _)| (v.slots, v.bounded, !v.levels_alike));
        cheapest.map(|(_, pipeline)| pipeline)
    }
}

fn lock(compiled: &Mutex<Compiled>) -> MutexGuard<'_, Compiled> {
    compiled.lock().unwrap_or_else(PoisonError::into_inner)
}

impl RayCaster {
    /// With `in_background`, other threads compile what can wait, where there are threads.
    pub(crate) fn new(device: &wgpu::Device, in_background: bool, counting: Counting) -> Self {
        Self {
            layout: bind_group_layout(device),
            compiled: Arc::default(),
            counting,
            in_background: AtomicBool::new(in_background && platform::HAS_THREADS),
        }
    }

    /// A pipeline that draws as this variant does: the variant's own, another one until that is compiled, or else its own,
    /// compiled at once.
    pub(crate) fn pipeline(
        &self,
        device: &wgpu::Device,
        variant: Variant,
    ) -> wgpu::ComputePipeline {
        let compiled = lock(&self.compiled);
        if let Some(pipeline) = compiled.ready.get(&variant) {
            return pipeline.clone();
        }
        if self.in_background.load(Ordering::Relaxed)
            && let Some(stand_in) = compiled.stand_in(variant).cloned()
        {
            drop(compiled);
            self.prepare(device, &[variant]);
            return stand_in;
        }
        drop(compiled);
        let pipeline = pipeline(device, &self.layout, variant, self.counting);
        let mut compiled = lock(&self.compiled);
        compiled.ready.insert(variant, pipeline.clone());
        pipeline
    }

    /// Compiles in the background what may be asked for soon.
    pub(crate) fn prepare(&self, device: &wgpu::Device, variants: &[Variant]) {
        if !self.in_background.load(Ordering::Relaxed) {
            return;
        }
        let mut compiled = lock(&self.compiled);
        let Compiled { ready, begun } = &mut *compiled;
        let new = variants.iter().copied();
        let new = new.filter(|variant| !ready.contains_key(variant) && begun.insert(*variant));
        let new: Vec<_> = new.collect();
        drop(compiled);
        if new.is_empty() {
            return;
        }
        let (device, layout) = (device.clone(), self.layout.clone());
        let (compiled, variants) = (Arc::clone(&self.compiled), new.clone());
        let counting = self.counting;
        let started = platform::spawn(move || {
            for variant in variants {
                let pipeline = pipeline(&device, &layout, variant, counting);
                lock(&compiled).ready.insert(variant, pipeline);
            }
        });
        if !started {
            let mut compiled = lock(&self.compiled);
            compiled.begun.retain(|variant| !new.contains(variant));
        }
    }

    /// Has other threads compile whatever the device is.
    #[cfg(test)]
    pub(crate) fn compile_in_background(&self) {
        self.in_background.store(true, Ordering::Relaxed);
    }

    /// Whether a variant is compiled.
    #[cfg(test)]
    pub(crate) fn is_ready(&self, variant: Variant) -> bool {
        lock(&self.compiled).ready.contains_key(&variant)
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
fn shader_module(
    device: &wgpu::Device,
    variant: Variant,
    counting: Counting,
) -> wgpu::ShaderModule {
    let descriptor = wgpu::ShaderModuleDescriptor {
        label: Some("ray-caster"),
        source: wgpu::ShaderSource::Wgsl(ray_cast(variant, counting).into()),
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
    counting: Counting,
) -> wgpu::ComputePipeline {
    let module = shader_module(device, variant, counting);
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
