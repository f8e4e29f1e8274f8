//! What a renderer has on the device: caches, buffers, the picture.

use std::ops::Range;

use glam::{UVec2, UVec3};
use saccade_core::brick::BRICK_STORED_EDGE;
use saccade_core::transfer::TABLE_LEN;

use crate::gpu::Gpu;
use crate::layout::{FrameUniform, MOST_CHANNELS, NODE_ROW, Variant, WORKGROUP};
use crate::memory::plan::Plan;
use crate::memory::{Array, Entry};
use crate::ray_caster::IMAGE_FORMAT;
use crate::stored_brick::StoredBrick;

/// Caches and buffers of one volume.
#[derive(Debug)]
pub(crate) struct Resources {
    frames: wgpu::Buffer,
    frame_stride: u32,
    directory: wgpu::Buffer,
    tables: wgpu::Buffer,
    nodes: wgpu::Texture,
    residents: wgpu::Buffer,
    slot_ranges: wgpu::Buffer,
    missed: wgpu::Buffer,
    report: wgpu::Buffer,
    colors: wgpu::Texture,
    bricks: wgpu::Texture,
    brick_bytes: u32,
    brick_grid: UVec3,
    sampler: wgpu::Sampler,
}

/// Where a frame is drawn.
#[derive(Debug)]
pub(crate) struct Picture {
    pub(crate) texture: wgpu::Texture,
    pub(crate) view: wgpu::TextureView,
    bind_group: wgpu::BindGroup,
}

impl Resources {
    /// Caches of bricks in a format of one or two bytes a texel.
    pub(crate) fn new(
        gpu: &Gpu,
        plan: &Plan,
        format: wgpu::TextureFormat,
        bands: u32,
        filter: wgpu::FilterMode,
    ) -> Self {
        let device = gpu.device();
        let align = device.limits().min_uniform_buffer_offset_alignment;
        let frame_stride = size_u32::<FrameUniform>().next_multiple_of(align);
        let storage = wgpu::BufferUsages::STORAGE;
        let copy_dst = wgpu::BufferUsages::COPY_DST;
        let words = |label, words: u32, usage| buffer(device, label, u64::from(words) * 4, usage);
        let frames_bytes = u64::from(frame_stride) * u64::from(bands);
        let frames = buffer(
            device,
            "frames",
            frames_bytes,
            wgpu::BufferUsages::UNIFORM | copy_dst,
        );
        let directory = words("page directory", plan.directory, storage | copy_dst);
        let tables = words("page table cache", plan.table_entries(), storage | copy_dst);
        let nodes = nodes_texture(device, plan.node_rows());
        let residents = words("residents", plan.node_texels(), storage | copy_dst);
        let slot_ranges = words("slot ranges", plan.bricks(), storage | copy_dst);
        let missed = words("missed", plan.mask_words(), storage | copy_dst);
        let report_usage = storage | copy_dst | wgpu::BufferUsages::COPY_SRC;
        let report = buffer(device, "report", plan.report_bytes(), report_usage);
        let colors = colors_texture(device);
        let bricks = device.create_texture(&wgpu::TextureDescriptor {
            label: Some("brick cache"),
            size: extent(plan.brick_grid * BRICK_STORED_EDGE),
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D3,
            format,
            usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
            view_formats: &[],
        });
        let sampler = device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some("bricks"),
            mag_filter: filter,
            min_filter: filter,
            ..Default::default()
        });
        Self {
            frames,
            frame_stride,
            directory,
            tables,
            nodes,
            residents,
            slot_ranges,
            missed,
            report,
            colors,
            bricks,
            brick_bytes: format.block_copy_size(None).unwrap_or(1),
            brick_grid: plan.brick_grid,
            sampler,
        }
    }

    /// Gives up what takes memory, as soon as no frame that was submitted needs it.
    pub(crate) fn destroy(&self) {
        let buffers = [
            &self.directory,
            &self.tables,
            &self.residents,
            &self.slot_ranges,
            &self.missed,
            &self.report,
        ];
        for buffer in buffers {
            buffer.destroy();
        }
        self.nodes.destroy();
        self.bricks.destroy();
    }

    /// A picture of `size` pixels.
    pub(crate) fn picture(&self, gpu: &Gpu, size: UVec2) -> Picture {
        let texture = image_texture(gpu.device(), size);
        let view = texture.create_view(&wgpu::TextureViewDescriptor::default());
        let bricks = self
            .bricks
            .create_view(&wgpu::TextureViewDescriptor::default());
        let colors = self
            .colors
            .create_view(&wgpu::TextureViewDescriptor::default());
        let nodes = self
            .nodes
            .create_view(&wgpu::TextureViewDescriptor::default());
        let frame = wgpu::BufferBinding {
            buffer: &self.frames,
            offset: 0,
            size: wgpu::BufferSize::new(u64::from(size_u32::<FrameUniform>())),
        };
        let resources = [
            wgpu::BindingResource::Buffer(frame),
            self.directory.as_entire_binding(),
            self.tables.as_entire_binding(),
            self.slot_ranges.as_entire_binding(),
            self.missed.as_entire_binding(),
            self.report.as_entire_binding(),
            wgpu::BindingResource::TextureView(&colors),
            wgpu::BindingResource::TextureView(&bricks),
            wgpu::BindingResource::Sampler(&self.sampler),
            wgpu::BindingResource::TextureView(&view),
            wgpu::BindingResource::TextureView(&nodes),
            self.residents.as_entire_binding(),
        ];
        let entries = (0..).zip(resources);
        let entries = entries.map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource });
        let bind_group = gpu.device().create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("ray-caster"),
            layout: &gpu.ray_caster().layout,
            entries: &entries.collect::<Vec<_>>(),
        });
        Picture {
            texture,
            view,
            bind_group,
        }
    }

    /// Writes the colours of the channels that are seen, in their order: a row of the texture each.
    pub(crate) fn write_colors(&self, gpu: &Gpu, colors: &[[[f32; 4]; TABLE_LEN]]) {
        let rows = u32::try_from(colors.len()).expect("a few channels");
        if rows == 0 {
            return;
        }
        let layout = wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some(size_u32::<[[f32; 4]; TABLE_LEN]>()),
            rows_per_image: None,
        };
        let size = wgpu::Extent3d {
            height: rows,
            ..self.colors.size()
        };
        let texels = bytemuck::cast_slice(colors);
        gpu.queue()
            .write_texture(self.colors.as_image_copy(), texels, layout, size);
    }

    pub(crate) fn write_entries(&self, gpu: &Gpu, array: Array, first: u32, entries: &[Entry]) {
        let buffer = match array {
            Array::Directory => &self.directory,
            Array::Tables => &self.tables,
        };
        gpu.queue()
            .write_buffer(buffer, u64::from(first) * 4, bytemuck::cast_slice(entries));
    }

    /// Writes what nodes know, from a texel on: a channel of a node each.
    pub(crate) fn write_nodes(&self, gpu: &Gpu, first: u32, texels: &[[u32; 4]], resident: &[u32]) {
        let at = u64::from(first) * 4;
        let resident = bytemuck::cast_slice(resident);
        gpu.queue().write_buffer(&self.residents, at, resident);
        for (rows, range) in rows_of(first, texels.len(), NODE_ROW) {
            let target = wgpu::TexelCopyTextureInfo {
                texture: &self.nodes,
                mip_level: 0,
                origin: wgpu::Origin3d {
                    x: rows.x,
                    y: rows.y,
                    z: 0,
                },
                aspect: wgpu::TextureAspect::All,
            };
            let layout = wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(rows.width * size_u32::<[u32; 4]>()),
                rows_per_image: None,
            };
            let size = extent(UVec3::new(rows.width, rows.height, 1));
            let texels = bytemuck::cast_slice(&texels[range]);
            gpu.queue().write_texture(target, texels, layout, size);
        }
    }

    /// Writes a brick with its border, and the range of its values.
    pub(crate) fn write_brick(&self, gpu: &Gpu, slot: u32, brick: &StoredBrick<'_>) {
        let UVec3 { x, y, .. } = self.brick_grid;
        let cell = UVec3::new(slot % x, slot / x % y, slot / (x * y));
        let at = cell * BRICK_STORED_EDGE;
        let target = wgpu::TexelCopyTextureInfo {
            texture: &self.bricks,
            mip_level: 0,
            origin: wgpu::Origin3d {
                x: at.x,
                y: at.y,
                z: at.z,
            },
            aspect: wgpu::TextureAspect::All,
        };
        let rows = wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some(BRICK_STORED_EDGE * self.brick_bytes),
            rows_per_image: Some(BRICK_STORED_EDGE),
        };
        let size = extent(UVec3::splat(BRICK_STORED_EDGE));
        let voxels = brick.voxels.bytes();
        gpu.queue().write_texture(target, voxels, rows, size);
        let [low, high] = brick.range.map(u32::from);
        let range = (low | high << 16).to_le_bytes();
        gpu.queue()
            .write_buffer(&self.slot_ranges, u64::from(slot) * 4, &range);
    }

    /// Submits a frame, in bands; at last copies its report where it can be read.
    pub(crate) fn draw(
        &self,
        gpu: &Gpu,
        picture: &Picture,
        (variant, frame): (Variant, &FrameUniform),
        bands: u32,
        report: Option<&wgpu::Buffer>,
    ) {
        let groups = frame.size.map(|pixels| pixels.div_ceil(WORKGROUP));
        let per_band = groups.y.div_ceil(bands.max(1)).max(1);
        let bands = groups.y.div_ceil(per_band);
        for band in 0..bands {
            let first = band * per_band;
            let uniform = FrameUniform {
                first_row: first * WORKGROUP,
                ..*frame
            };
            let at = band * self.frame_stride;
            gpu.queue()
                .write_buffer(&self.frames, u64::from(at), bytemuck::bytes_of(&uniform));
        }
        let pipeline = gpu.ray_caster().pipeline(gpu.device(), variant);
        for band in 0..bands {
            let mut encoder = gpu.device().create_command_encoder(&Default::default());
            if band == 0 {
                encoder.clear_buffer(&self.missed, 0, None);
                encoder.clear_buffer(&self.report, 0, None);
            }
            {
                let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                    label: Some("ray-caster"),
                    timestamp_writes: None,
                });
                pass.set_pipeline(&pipeline);
                pass.set_bind_group(0, &picture.bind_group, &[band * self.frame_stride]);
                let rows = per_band.min(groups.y - band * per_band);
                pass.dispatch_workgroups(groups.x, rows, 1);
            }
            if let (true, Some(target)) = (band + 1 == bands, report) {
                encoder.copy_buffer_to_buffer(&self.report, 0, target, 0, target.size());
            }
            gpu.queue().submit([encoder.finish()]);
        }
    }
}

fn size_u32<T>() -> u32 {
    u32::try_from(size_of::<T>()).expect("structs of a few kilobytes")
}

fn extent(size: UVec3) -> wgpu::Extent3d {
    wgpu::Extent3d {
        width: size.x,
        height: size.y,
        depth_or_array_layers: size.z,
    }
}

fn buffer(
    device: &wgpu::Device,
    label: &str,
    size: u64,
    usage: wgpu::BufferUsages,
) -> wgpu::Buffer {
    let label = Some(label);
    device.create_buffer(&wgpu::BufferDescriptor {
        label,
        size,
        usage,
        mapped_at_creation: false,
    })
}

/// A texel per channel of each node.
fn nodes_texture(device: &wgpu::Device, rows: u32) -> wgpu::Texture {
    device.create_texture(&wgpu::TextureDescriptor {
        label: Some("octree"),
        size: extent(UVec3::new(NODE_ROW, rows.max(1), 1)),
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::Rgba32Uint,
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    })
}

/// A rectangle of a texture whose texels are numbered row by row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Rows {
    x: u32,
    y: u32,
    width: u32,
    height: u32,
}

/// Texels in a row, as rectangles, each with which of them it holds: three at most.
fn rows_of(first: u32, count: usize, row: u32) -> Vec<(Rows, Range<usize>)> {
    let mut parts = Vec::with_capacity(3);
    let mut done = 0;
    while done < count {
        let at = first + u32::try_from(done).expect("fewer than a texture holds");
        let left = u32::try_from(count - done).expect("fewer than a texture holds");
        let (x, y) = (at % row, at / row);
        let (width, height) = match x == 0 && left >= row {
            true => (row, left / row),
            false => (left.min(row - x), 1),
        };
        let next = done + (width * height) as usize;
        let rows = Rows {
            x,
            y,
            width,
            height,
        };
        parts.push((rows, done..next));
        done = next;
    }
    parts
}

/// A row of colours per channel. A texture, since drivers that draw on the CPU read a buffer value by value.
fn colors_texture(device: &wgpu::Device) -> wgpu::Texture {
    let [width, height] = [TABLE_LEN, MOST_CHANNELS].map(|n| u32::try_from(n).expect("a few"));
    device.create_texture(&wgpu::TextureDescriptor {
        label: Some("transfer functions"),
        size: extent(UVec3::new(width, height, 1)),
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::Rgba32Float,
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    })
}

fn image_texture(device: &wgpu::Device, size: UVec2) -> wgpu::Texture {
    device.create_texture(&wgpu::TextureDescriptor {
        label: Some("picture"),
        size: extent(size.extend(1)),
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: IMAGE_FORMAT,
        usage: wgpu::TextureUsages::TEXTURE_BINDING
            | wgpu::TextureUsages::STORAGE_BINDING
            | wgpu::TextureUsages::COPY_SRC,
        view_formats: &[],
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texels_in_a_row_are_as_few_rectangles() {
        for first in 0..23 {
            for count in 0..40 {
                let parts = rows_of(first, count, 7);
                assert!(parts.len() <= 3, "{first} {count}: {parts:?}");
                let texels = parts.iter().flat_map(|(rows, range)| {
                    let (x, width) = (rows.x, rows.width);
                    assert!(x + width <= 7);
                    let numbers = (rows.y..rows.y + rows.height)
                        .flat_map(move |y| (x..x + width).map(move |x| y * 7 + x));
                    let numbers: Vec<_> = numbers.collect();
                    assert_eq!(numbers.len(), range.len());
                    numbers
                });
                let end = first + u32::try_from(count).unwrap();
                assert!(texels.eq(first..end), "{first} {count}: {parts:?}");
                let ranges = parts.iter().flat_map(|(_, range)| range.clone());
                assert!(ranges.eq(0..count));
            }
        }
    }
}
