//! Brute force over one dense 3D texture: what virtual memory is measured against.

use glam::{DVec3, Vec3};
use saccade_core::transfer::TransferFunction;
use saccade_render::wgpu::util::DeviceExt as _;
use saccade_render::{Gpu, View, wgpu};
use serde_json::{Value, json};

use crate::bricks::Arrays;
use crate::clock::DrawClock;
use crate::shader::shader_module;

/// As `dense.wgsl` has it, each vector padded to four words.
type Frame = [[f32; 4]; 7];

/// Between samples \[voxels\].
const STEP_VOXELS: f32 = 0.5;

/// Everything it needs on the device.
pub(crate) struct Dense {
    gpu: Gpu,
    pipeline: wgpu::ComputePipeline,
    bind_group: wgpu::BindGroup,
    image: wgpu::Texture,
}

impl Dense {
    /// Level 0 of a volume, seen like this.
    pub(crate) fn new(
        gpu: &Gpu,
        arrays: &Arrays,
        transfer: &TransferFunction,
        view: &View,
    ) -> Self {
        let device = gpu.device();
        let module = shader_module(device, "dense", include_str!("dense.wgsl"));
        let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some("dense"),
            layout: None,
            module: &module,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        });
        let extent = arrays.volume.extent();
        let volume = device.create_texture_with_data(
            gpu.queue(),
            &wgpu::TextureDescriptor {
                label: Some("dense"),
                size: wgpu::Extent3d {
                    width: extent.x,
                    height: extent.y,
                    depth_or_array_layers: extent.z,
                },
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D3,
                format: wgpu::TextureFormat::R8Unorm,
                usage: wgpu::TextureUsages::TEXTURE_BINDING,
                view_formats: &[],
            },
            wgpu::util::TextureDataOrder::LayerMajor,
            &arrays.levels[0],
        );
        let image = device.create_texture(&wgpu::TextureDescriptor {
            label: Some("picture"),
            size: wgpu::Extent3d {
                width: view.size.x,
                height: view.size.y,
                depth_or_array_layers: 1,
            },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: wgpu::TextureFormat::Rgba8Unorm,
            usage: wgpu::TextureUsages::STORAGE_BINDING | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        });
        let words = |contents: &[u8], usage| {
            device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
                label: Some("dense"),
                contents,
                usage,
            })
        };
        let frame = frame(arrays, view);
        let frame = words(bytemuck::cast_slice(&frame), wgpu::BufferUsages::UNIFORM);
        // As the renderer has them: a driver that draws on the CPU reads textures quicker than buffers.
        let colors = colors(transfer);
        let colors = device.create_texture_with_data(
            gpu.queue(),
            &wgpu::TextureDescriptor {
                label: Some("dense"),
                size: wgpu::Extent3d {
                    width: 256,
                    height: 1,
                    depth_or_array_layers: 1,
                },
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format: wgpu::TextureFormat::Rgba32Float,
                usage: wgpu::TextureUsages::TEXTURE_BINDING,
                view_formats: &[],
            },
            wgpu::util::TextureDataOrder::LayerMajor,
            bytemuck::cast_slice(&colors),
        );
        let sampler = device.create_sampler(&wgpu::SamplerDescriptor {
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            ..Default::default()
        });
        let [volume, picture, colors] = [&volume, &image, &colors]
            .map(|texture| texture.create_view(&wgpu::TextureViewDescriptor::default()));
        let resources = [
            frame.as_entire_binding(),
            wgpu::BindingResource::TextureView(&colors),
            wgpu::BindingResource::TextureView(&volume),
            wgpu::BindingResource::Sampler(&sampler),
            wgpu::BindingResource::TextureView(&picture),
        ];
        let entries = (0..).zip(resources);
        let entries = entries.map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource });
        let bind_group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("dense"),
            layout: &pipeline.get_bind_group_layout(0),
            entries: &entries.collect::<Vec<_>>(),
        });
        Self {
            gpu: gpu.clone(),
            pipeline,
            bind_group,
            image,
        }
    }

    /// What one frame takes, from asking for it until it is drawn \[ms\].
    pub(crate) fn frame_ms(&self) -> f64 {
        let start = DrawClock::start(&self.gpu);
        let device = self.gpu.device();
        let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            pass.set_pipeline(&self.pipeline);
            pass.set_bind_group(0, &self.bind_group, &[]);
            let [x, y] = [self.image.width(), self.image.height()].map(|n| n.div_ceil(8));
            pass.dispatch_workgroups(x, y, 1);
        }
        self.gpu.queue().submit([encoder.finish()]);
        if let Err(error) = device.poll(wgpu::PollType::wait_indefinitely()) {
            log::error!("the device was lost: {error}");
        }
        start.ms()
    }

    /// The picture, RGBA.
    #[cfg(test)]
    fn pixels(&self) -> Vec<u8> {
        read_image(&self.gpu, &self.image)
    }
}

/// A picture in main memory, RGBA.
#[cfg(test)]
pub(crate) fn read_image(gpu: &Gpu, image: &wgpu::Texture) -> Vec<u8> {
    let (device, queue) = (gpu.device(), gpu.queue());
    let (width, height) = (image.width(), image.height());
    let row = (width * 4).next_multiple_of(256);
    let buffer = device.create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: u64::from(row * height),
        usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
        mapped_at_creation: false,
    });
    let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    encoder.copy_texture_to_buffer(
        image.as_image_copy(),
        wgpu::TexelCopyBufferInfo {
            buffer: &buffer,
            layout: wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(row),
                rows_per_image: None,
            },
        },
        image.size(),
    );
    queue.submit([encoder.finish()]);
    buffer.map_async(wgpu::MapMode::Read, .., |result| {
        result.expect("it is mapped once")
    });
    device
        .poll(wgpu::PollType::wait_indefinitely())
        .expect("the device is there");
    let mapped = buffer.get_mapped_range(..).expect("it was mapped");
    let rows = mapped.chunks_exact(row as usize);
    rows.flat_map(|row| row[..width as usize * 4].to_vec())
        .collect()
}

/// The rays, for kernels elsewhere: vectors as `dense.wgsl` has them, and the extinction of the highest value \[1/nm\].
pub(crate) fn rays(arrays: &Arrays, transfer: &TransferFunction, view: &View) -> Value {
    let vectors = frame(arrays, view).map(|[x, y, z, _]| [x, y, z]);
    let [eye, forward, right, down, extent, voxels_per_nm, _] = vectors;
    let extinction = colors(transfer).last().map(|color| color[3]);
    json!({
        "size": view.size.to_array(),
        "eye": eye,
        "forward": forward,
        "right": right,
        "down": down,
        "extent": extent,
        "voxels_per_nm": voxels_per_nm,
        "step_voxels": STEP_VOXELS,
        "extinction": extinction,
    })
}

fn frame(arrays: &Arrays, view: &View) -> Frame {
    let camera = &view.camera;
    let axes = camera.physical_from_eye_axes();
    let voxels_per_nm = 1.0 / arrays.volume.voxel_nm;
    let size = view.size.as_dvec2();
    let tangent = (camera.fov / 2.0).to_radians().tan();
    let row = |v: DVec3| {
        let Vec3 { x, y, z } = v.as_vec3();
        [x, y, z, 0.0]
    };
    let [x, y] = view.size.to_array().map(f32::from_bits);
    [
        row(camera.eye().xyz * voxels_per_nm),
        row(axes.z_axis),
        row(axes.x_axis * tangent * size.x / size.y),
        row(axes.y_axis * tangent),
        row(arrays.volume.extent().as_dvec3()),
        row(voxels_per_nm),
        [x, y, STEP_VOXELS, 0.0],
    ]
}

fn colors(transfer: &TransferFunction) -> Vec<[f32; 4]> {
    let table = transfer.table().into_iter();
    #[expect(
        clippy::cast_possible_truncation,
        reason = "the nearest f32 is what is wanted"
    )]
    let color = |[r, g, b, opacity]: [f32; 4]| {
        let extinction = -(1.0 - f64::from(opacity)).ln() / transfer.opacity_length_nm;
        [r, g, b, extinction as f32]
    };
    table.map(color).collect()
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::bricks::{ramp, settle};
    use glam::{UVec2, UVec3};
    use saccade_core::camera::Camera;
    use saccade_render::{Renderer, RendererOptions, Traversal};

    /// Peak signal to noise of colours \[dB\].
    pub(crate) fn psnr(a: &[u8], b: &[u8]) -> f64 {
        let squares = a
            .iter()
            .zip(b)
            .map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2));
        let mean = squares.sum::<f64>() / (a.len() as f64 * 0.75);
        10.0 * (255.0_f64.powi(2) / mean.max(1e-6)).log10()
    }

    /// A device; none where tests do without.
    pub(crate) fn gpu() -> Option<Gpu> {
        match pollster::block_on(Gpu::headless()) {
            Ok(gpu) => Some(gpu),
            Err(error) => {
                let required = std::env::var("SACCADE_GPU_TESTS").is_ok_and(|v| v == "require");
                assert!(!required, "SACCADE_GPU_TESTS=require, but: {error}");
                None
            }
        }
    }

    #[test]
    #[expect(clippy::cast_possible_truncation, reason = "values are made to fit")]
    fn everything_measured_draws_the_same_picture() {
        let Some(gpu) = gpu() else { return };
        let arrays = Arrays::new(UVec3::new(70, 61, 45), DVec3::new(4.0, 4.0, 10.0), |v| {
            let at = v.as_dvec3();
            let wave = (at.x / 5.0).sin() + (at.y / 4.0).cos() + (at.z / 3.0 + at.x / 9.0).sin();
            u8::try_from(128 + (40.0 * wave).round() as i32).unwrap()
        })
        .unwrap();
        let transfer = ramp(0.3, 0.8, 0.7, 40.0);
        let camera = Camera::around(&arrays.volume);
        let view = View {
            lod_bias: -20.0,
            ..View::new(camera, UVec2::new(60, 44))
        };
        let dense = Dense::new(&gpu, &arrays, &transfer, &view);
        dense.frame_ms();
        let want = dense.pixels();
        for traversal in [Traversal::ResidencyOctree, Traversal::PageTables] {
            let options = RendererOptions {
                traversal,
                ..RendererOptions::default()
            };
            let mut renderer = Renderer::new(&gpu, arrays.volume.clone(), options).unwrap();
            renderer.set_transfer_function(&transfer);
            settle(&mut renderer, &view, &arrays).unwrap();
            let got = pollster::block_on(renderer.read_pixels()).unwrap();
            let db = psnr(&got.rgba, &want);
            assert!(db >= 45.0, "{traversal:?}: {db:.1} dB");
        }
        let turned = View {
            camera: camera.orbited(2.0, 0.0),
            ..view
        };
        let turned = Dense::new(&gpu, &arrays, &transfer, &turned);
        turned.frame_ms();
        let db = psnr(&turned.pixels(), &want);
        assert!(db < 42.0, "turned: {db:.1} dB");
    }
}
