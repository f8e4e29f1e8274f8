//! A baseline on the device.

use std::sync::Arc;

use anyhow::{Context as _, Result, bail, ensure};
use glam::{DVec3, UVec3, Vec3};
use saccade_core::brick::{BRICK_STORED_EDGE, BRICK_STORED_VOXELS, BrickId, bricks_of};
use saccade_core::transfer::TABLE_LEN;
use saccade_core::volume::{Dtype, Volume};
use saccade_render::wgpu::util::DeviceExt as _;
use saccade_render::{ChannelView, Gpu, View, wgpu};

use super::Method;
use super::paged::Paged;
use super::table::{Table, largest, single};
use crate::bricks::{Bricks, all_bricks};
use crate::shader::shader_module;

/// As the shader has them.
const COUNTERS: usize = 16;
const MASK_WORDS: usize = 65_536;
const MISSES: usize = 65_536;
const MAX_LEVELS: usize = 32;
const NODE_ROW: usize = 4096;
/// Nodes of each channel that the short stack remembers, as in the paper.
const STACK: u32 = 4;

/// What the rays of a frame did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Work {
    /// Rays that met the volume.
    pub(crate) rays: u64,
    /// Samples taken.
    pub(crate) samples: u64,
    /// Entries of page tables read, or nodes visited.
    pub(crate) work: u64,
    /// Of the rays that met the volume, the work of the one that had the least, and the most.
    pub(crate) per_ray: [u32; 2],
    /// Bricks that have to be there, those above others included.
    pub(crate) bricks: u64,
}

impl Work {
    /// Work of a ray, on average.
    pub(crate) fn mean(&self) -> f64 {
        self.work as f64 / self.rays.max(1) as f64
    }
}

/// A way to draw, with what it needs on the device.
pub(crate) struct Baseline {
    gpu: Gpu,
    volume: Arc<Volume>,
    views: Vec<ChannelView>,
    paged: Paged,
    start_level: u32,
    grid: UVec3,
    bricks: wgpu::Texture,
    pipeline: wgpu::ComputePipeline,
    sampler: wgpu::Sampler,
    looks: Looks,
    report: wgpu::Buffer,
    loaded: Vec<BrickId>,
    /// What each slot holds.
    slots: Vec<BrickId>,
    usage_words: usize,
    /// As of the last upload.
    on_device: Option<Index>,
    image: Option<wgpu::Texture>,
}

/// What leads to bricks.
struct Index {
    /// Values of the brick in each slot.
    ranges: wgpu::Buffer,
    way: Way,
}

enum Way {
    /// Directory and blocks.
    PageTables([wgpu::Buffer; 2]),
    Nodes(wgpu::TextureView),
}

impl Index {
    fn new(gpu: &Gpu, paged: &Paged, first_level: u32) -> Self {
        let storage = |words: &[u32]| {
            let mut words = words.to_vec();
            // Buffers may not be empty.
            words.resize(words.len().max(4), 0);
            let device = gpu.device();
            device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
                label: Some("baseline"),
                contents: bytemuck::cast_slice(&words),
                usage: wgpu::BufferUsages::STORAGE,
            })
        };
        let way = match paged.nodes(first_level) {
            None => Way::PageTables([&paged.directory, &paged.blocks].map(|words| storage(words))),
            Some(mut nodes) => {
                nodes.resize(nodes.len().next_multiple_of(NODE_ROW), [0; 4]);
                let format = wgpu::TextureFormat::Rgba32Uint;
                Way::Nodes(texels(gpu, format, NODE_ROW, &nodes))
            }
        };
        let ranges = storage(&paged.ranges);
        Self { ranges, way }
    }

    fn way(&self) -> Vec<wgpu::BindingResource<'_>> {
        match &self.way {
            Way::PageTables(buffers) => {
                let buffers = buffers.iter().map(wgpu::Buffer::as_entire_binding);
                buffers.collect()
            }
            Way::Nodes(nodes) => vec![wgpu::BindingResource::TextureView(nodes)],
        }
    }
}

/// How channels look.
struct Looks {
    colors: wgpu::TextureView,
    opaque_before: wgpu::TextureView,
    /// Scale and offset of each channel's table.
    tables: Vec<[f32; 2]>,
}

/// A texture of so wide rows of texels.
fn texels<T: bytemuck::NoUninit>(
    gpu: &Gpu,
    format: wgpu::TextureFormat,
    width: usize,
    texels: &[T],
) -> wgpu::TextureView {
    let rows = texels.len() / width;
    let word = |n: usize| u32::try_from(n).expect("rows of a few megabytes");
    let texture = gpu.device().create_texture_with_data(
        gpu.queue(),
        &wgpu::TextureDescriptor {
            label: Some("baseline"),
            size: size_3d(UVec3::new(word(width), word(rows), 1)),
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format,
            usage: wgpu::TextureUsages::TEXTURE_BINDING,
            view_formats: &[],
        },
        wgpu::util::TextureDataOrder::LayerMajor,
        bytemuck::cast_slice(texels),
    );
    texture.create_view(&wgpu::TextureViewDescriptor::default())
}

impl Looks {
    fn new(gpu: &Gpu, views: &[ChannelView], dtype: Dtype) -> Self {
        let tables: Vec<_> = views.iter().map(|view| Table::new(view, dtype)).collect();
        let colors: Vec<_> = tables.iter().flat_map(|t| t.colors.clone()).collect();
        let opaque: Vec<_> = tables
            .iter()
            .flat_map(|t| t.opaque_before.clone())
            .collect();
        Self {
            colors: texels(gpu, wgpu::TextureFormat::Rgba32Float, TABLE_LEN, &colors),
            opaque_before: texels(gpu, wgpu::TextureFormat::R32Uint, TABLE_LEN + 1, &opaque),
            tables: tables.iter().map(|t| [t.scale, t.offset]).collect(),
        }
    }
}

impl Baseline {
    /// Nothing is there. Bricks and their tables take `bytes` at most; octrees are entered at `start_level` or
    /// the coarsest that there is.
    pub(crate) fn new(
        gpu: &Gpu,
        volume: &Arc<Volume>,
        views: &[ChannelView],
        method: Method,
        start_level: u32,
        bytes: u64,
    ) -> Result<Self> {
        let device = gpu.device();
        let last = u32::try_from(volume.levels.len() - 1)?;
        let start_level = start_level.min(last);
        let per_brick = (BRICK_STORED_VOXELS * volume.dtype.bytes()) as u64;
        let all: u64 = volume.levels[first_level(views, last) as usize..]
            .iter()
            .map(|level| u64::from(bricks_of(level.extent).element_product()))
            .sum();
        let slots = (all * views.len() as u64).min(bytes / per_brick).max(1);
        let grid = grid(slots, device.limits().max_texture_dimension_3d)?;
        let format = match volume.dtype {
            Dtype::Uint16 => wgpu::TextureFormat::R16Unorm,
            _ => wgpu::TextureFormat::R8Unorm,
        };
        let bricks = device.create_texture(&wgpu::TextureDescriptor {
            label: Some("baseline bricks"),
            size: size_3d(grid * BRICK_STORED_EDGE),
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D3,
            format,
            usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
            view_formats: &[],
        });
        let pipeline = pipeline(gpu, method, views.len());
        let sampler = device.create_sampler(&wgpu::SamplerDescriptor {
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            ..Default::default()
        });
        let usage_words = (grid.element_product() as usize).div_ceil(32);
        let report = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("baseline report"),
            size: 4 * (COUNTERS + usage_words + MASK_WORDS + 2 * MISSES) as u64,
            usage: wgpu::BufferUsages::STORAGE
                | wgpu::BufferUsages::COPY_SRC
                | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        Ok(Self {
            gpu: gpu.clone(),
            volume: volume.clone(),
            paged: Paged::new(volume, views.len(), method.is_octree(), start_level)?,
            views: views.to_vec(),
            start_level,
            grid,
            bricks,
            pipeline,
            sampler,
            looks: Looks::new(gpu, views, volume.dtype),
            report,
            loaded: Vec::new(),
            slots: Vec::new(),
            usage_words,
            on_device: None,
            image: None,
        })
    }

    /// Page table blocks, or nodes of bricks, that there are.
    pub(crate) fn parts(&self) -> usize {
        self.paged.parts()
    }

    /// Bricks that were asked for so far, in that order.
    pub(crate) fn loaded(&self) -> &[BrickId] {
        &self.loaded
    }

    /// Shows the same channels otherwise.
    pub(crate) fn set_views(&mut self, views: &[ChannelView]) {
        let looks = Looks::new(&self.gpu, views, self.volume.dtype);
        (self.looks, self.views) = (looks, views.to_vec());
    }

    /// Bricks that the rays of a view need to be there, all of which are loaded.
    pub(crate) fn needed(&mut self, view: &View) -> Result<Vec<BrickId>> {
        self.draw(view, true, 1)?;
        let words = read_buffer(&self.gpu, &self.report)?;
        ensure!(self.missed(&words)?.is_empty(), "the view is not settled");
        let used = &words[COUNTERS..COUNTERS + self.usage_words];
        let is_used = |slot: usize| (used[slot / 32] >> (slot % 32)) & 1 == 1;
        let slots = self.slots.iter().enumerate();
        let used = slots.filter(|(slot, _)| is_used(*slot));
        Ok(used.map(|(_, id)| *id).collect())
    }

    /// Loads what a view needs, and tells what its rays do then.
    pub(crate) fn settle(&mut self, view: &View, source: &(impl Bricks + Sync)) -> Result<Work> {
        for _ in 0..2_000 {
            self.draw(view, true, 1)?;
            let words = read_buffer(&self.gpu, &self.report)?;
            let missed = self.missed(&words)?;
            if missed.is_empty() {
                return Ok(self.work(&words));
            }
            self.load(&missed, source)?;
        }
        bail!("the view does not settle")
    }

    fn missed(&self, words: &[u32]) -> Result<Vec<BrickId>> {
        let first = COUNTERS + self.usage_words + MASK_WORDS;
        let count = (words[0] as usize).min(MISSES);
        let (pairs, _) = words[first..first + 2 * count].as_chunks::<2>();
        let ids = pairs.iter().map(|[a, b]| {
            let brick = UVec3::new(a & 0xffff, a >> 16, b & 0xffff);
            Ok(BrickId::new(b >> 24, (b >> 16) & 0xff, brick)?)
        });
        ids.collect()
    }

    fn work(&self, words: &[u32]) -> Work {
        let two = |at: usize| u64::from(words[at]) | u64::from(words[at + 1]) << 32;
        let used = &words[COUNTERS..COUNTERS + self.usage_words];
        Work {
            rays: u64::from(words[1]),
            samples: two(2),
            work: two(4),
            per_ray: [u32::MAX - words[7], words[6]],
            bricks: used.iter().map(|w| u64::from(w.count_ones())).sum(),
        }
    }

    fn load(&mut self, ids: &[BrickId], source: &(impl Bricks + Sync)) -> Result<()> {
        self.on_device = None;
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        for ids in ids.chunks(threads * 16) {
            let of_channel = |id: &BrickId| {
                let channel = self.views[id.channel() as usize].channel;
                BrickId::new(channel, id.level(), id.brick())
            };
            let wanted: Vec<_> = ids.iter().map(of_channel).collect::<Result<_, _>>()?;
            let bricks = all_bricks(source, &wanted);
            for (&id, voxels) in ids.iter().zip(bricks) {
                ensure!(
                    !self.paged.contains(id),
                    "{id} is missed though it is there"
                );
                self.loaded.push(id);
                let range = voxels.as_ref().map(|v| range(v, self.volume.dtype));
                match (voxels, range) {
                    (Some(voxels), Some([low, high])) if high > 0 => {
                        let slot = u32::try_from(self.paged.ranges.len())?;
                        ensure!(slot < self.grid.element_product(), "the bricks do not fit");
                        self.write(slot, &voxels);
                        self.slots.push(id);
                        self.paged.insert(id, Some((slot, [low, high])));
                    }
                    _ => self.paged.insert(id, None),
                }
            }
        }
        Ok(())
    }

    fn write(&self, slot: u32, voxels: &[u8]) {
        let UVec3 { x, y, .. } = self.grid;
        let at = UVec3::new(slot % x, slot / x % y, slot / (x * y)) * BRICK_STORED_EDGE;
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
        let bytes = u32::try_from(self.volume.dtype.bytes()).unwrap_or(1);
        let rows = wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some(BRICK_STORED_EDGE * bytes),
            rows_per_image: Some(BRICK_STORED_EDGE),
        };
        let size = size_3d(UVec3::splat(BRICK_STORED_EDGE));
        self.gpu.queue().write_texture(target, voxels, rows, size);
    }

    /// The device drawn with.
    pub(crate) fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Draws so many frames, which are asked for at once, and waits for the last.
    pub(crate) fn frames(&mut self, view: &View, frames: u32) -> Result<()> {
        self.draw(view, false, frames)?;
        self.gpu
            .device()
            .poll(wgpu::PollType::wait_indefinitely())
            .context("the device was lost")?;
        Ok(())
    }

    fn draw(&mut self, view: &View, counting: bool, frames: u32) -> Result<()> {
        let device = self.gpu.device();
        let first = first_level(&self.views, u32::MAX);
        let words = self.frame(view, counting);
        let index = self
            .on_device
            .get_or_insert_with(|| Index::new(&self.gpu, &self.paged, first));
        let is_size = |i: &wgpu::Texture| [i.width(), i.height()] == view.size.to_array();
        let image = match self.image.take() {
            Some(image) if is_size(&image) => image,
            _ => picture(device, view),
        };
        let frame = device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: Some("baseline frame"),
            contents: bytemuck::cast_slice(&words),
            usage: wgpu::BufferUsages::UNIFORM,
        });
        let [texture, target] =
            [&self.bricks, &image].map(|t| t.create_view(&wgpu::TextureViewDescriptor::default()));
        let resources = [
            frame.as_entire_binding(),
            self.report.as_entire_binding(),
            wgpu::BindingResource::TextureView(&self.looks.colors),
            wgpu::BindingResource::TextureView(&self.looks.opaque_before),
            index.ranges.as_entire_binding(),
            wgpu::BindingResource::TextureView(&texture),
            wgpu::BindingResource::Sampler(&self.sampler),
            wgpu::BindingResource::TextureView(&target),
        ];
        let entries = (0..).zip(resources.into_iter().chain(index.way()));
        let entries = entries.map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource });
        let bind_group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("baseline"),
            layout: &layout(device, self.paged.is_octree()),
            entries: &entries.collect::<Vec<_>>(),
        });
        for _ in 0..frames {
            let mut encoder = device.create_command_encoder(&Default::default());
            encoder.clear_buffer(&self.report, 0, None);
            {
                let mut pass = encoder.begin_compute_pass(&Default::default());
                pass.set_pipeline(&self.pipeline);
                pass.set_bind_group(0, &bind_group, &[]);
                let [x, y] = view.size.to_array().map(|n| n.div_ceil(8));
                pass.dispatch_workgroups(x, y, 1);
            }
            self.gpu.queue().submit([encoder.finish()]);
        }
        self.image = Some(image);
        Ok(())
    }

    /// What the shader's `Frame` is, row by row.
    fn frame(&self, view: &View, counting: bool) -> Vec<[u32; 4]> {
        let camera = &view.camera;
        let axes = camera.physical_from_eye_axes();
        let eye = camera.eye().xyz;
        let size = view.size.as_dvec2();
        let tangent = (camera.fov / 2.0).to_radians().tan();
        let pixel = camera.pixel_nm(1.0, size.y) * f64::from(view.lod_bias).exp2();
        let last = self.volume.levels.len() - 1;
        let level_word = |level: usize| u32::try_from(level).unwrap_or(u32::MAX);
        let first = first_level(&self.views, level_word(last));
        let coarsest = self.views.iter().map(|view| *view.levels.end()).max();
        let tables = self.paged.tables();
        let mut rows = vec![
            row(axes.z_axis, single(pixel).to_bits()),
            row(
                axes.x_axis * tangent * size.x / size.y,
                level_word(last + 1),
            ),
            row(axes.y_axis * tangent, first),
            row(-eye, coarsest.unwrap_or(0).min(level_word(last))),
            row(self.volume.size_nm() - eye, tables.entries_per_channel()),
            counts(self.grid, self.start_level),
            [
                view.size.x,
                view.size.y,
                level_word(self.usage_words),
                single(largest(self.volume.dtype)).to_bits(),
            ],
            [u32::from(counting), 0, 0, 0],
        ];
        for channel in 0..16 {
            let [scale, offset] = self.looks.tables.get(channel).copied().unwrap_or_default();
            rows.push([scale.to_bits(), offset.to_bits(), 0, 0]);
        }
        for index in 0..MAX_LEVELS {
            let Some(level) = self.volume.levels.get(index) else {
                rows.extend([[0; 4]; 4]);
                continue;
            };
            let table = tables.levels()[index];
            let voxel_nm = self.volume.voxel_nm * level.downsampling;
            let [x, y, z] = level.downsampling.as_uvec3().to_array().map(u32::ilog2);
            rows.extend([
                row(eye / voxel_nm, table.directory_base),
                row(1.0 / voxel_nm, x | y << 8 | z << 16),
                counts(table.bricks, 0),
                counts(table.directory, 0),
            ]);
        }
        rows
    }

    /// The picture of the last frame, RGBA.
    #[cfg(test)]
    pub(crate) fn pixels(&self) -> Vec<u8> {
        let image = self.image.as_ref().expect("a frame was drawn");
        crate::dense::read_image(&self.gpu, image)
    }
}

/// The finest level that is drawn.
fn first_level(views: &[ChannelView], most: u32) -> u32 {
    let first = views.iter().map(|view| *view.levels.start()).min();
    first.unwrap_or(0).min(most)
}

/// Smallest and largest value of a brick.
pub(crate) fn range(voxels: &[u8], dtype: Dtype) -> [u16; 2] {
    let of = |values: &mut dyn Iterator<Item = u16>| {
        values.fold([u16::MAX, 0], |[low, high], v| [low.min(v), high.max(v)])
    };
    match dtype {
        Dtype::Uint16 => {
            let (pairs, _) = voxels.as_chunks::<2>();
            of(&mut pairs.iter().map(|pair| u16::from_le_bytes(*pair)))
        }
        _ => of(&mut voxels.iter().map(|v| u16::from(*v))),
    }
}

fn row(v: DVec3, word: u32) -> [u32; 4] {
    let Vec3 { x, y, z } = v.as_vec3();
    [x.to_bits(), y.to_bits(), z.to_bits(), word]
}

fn counts(v: UVec3, word: u32) -> [u32; 4] {
    [v.x, v.y, v.z, word]
}

/// A grid of `slots` bricks or a few more.
fn grid(slots: u64, texture_edge: u32) -> Result<UVec3> {
    let most = texture_edge / BRICK_STORED_EDGE;
    let slots = u32::try_from(slots)?;
    let across = (1..=most).find(|edge| edge.pow(3) >= slots).unwrap_or(most);
    let deep = slots.div_ceil(across * across);
    ensure!(deep <= most, "{slots} bricks do not fit a texture");
    Ok(UVec3::new(across, across, deep))
}

fn size_3d(size: UVec3) -> wgpu::Extent3d {
    wgpu::Extent3d {
        width: size.x,
        height: size.y,
        depth_or_array_layers: size.z,
    }
}

fn picture(device: &wgpu::Device, view: &View) -> wgpu::Texture {
    device.create_texture(&wgpu::TextureDescriptor {
        label: Some("picture"),
        size: size_3d(view.size.extend(1)),
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::Rgba8Unorm,
        usage: wgpu::TextureUsages::STORAGE_BINDING | wgpu::TextureUsages::COPY_SRC,
        view_formats: &[],
    })
}

fn layout(device: &wgpu::Device, octree: bool) -> wgpu::BindGroupLayout {
    let buffer = |ty| wgpu::BindingType::Buffer {
        ty,
        has_dynamic_offset: false,
        min_binding_size: None,
    };
    let storage = |read_only| buffer(wgpu::BufferBindingType::Storage { read_only });
    let texture = |sample_type, view_dimension| wgpu::BindingType::Texture {
        sample_type,
        view_dimension,
        multisampled: false,
    };
    let filterable = |filterable| wgpu::TextureSampleType::Float { filterable };
    let (whole, flat) = (
        wgpu::TextureSampleType::Uint,
        wgpu::TextureViewDimension::D2,
    );
    let mut types = vec![
        buffer(wgpu::BufferBindingType::Uniform),
        storage(false),
        texture(filterable(false), flat),
        texture(whole, flat),
        storage(true),
        texture(filterable(true), wgpu::TextureViewDimension::D3),
        wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering),
        wgpu::BindingType::StorageTexture {
            access: wgpu::StorageTextureAccess::WriteOnly,
            format: wgpu::TextureFormat::Rgba8Unorm,
            view_dimension: flat,
        },
    ];
    types.extend(match octree {
        true => vec![texture(whole, flat)],
        false => vec![storage(true); 2],
    });
    let entries = (0..).zip(types);
    let entries = entries.map(|(binding, ty)| wgpu::BindGroupLayoutEntry {
        binding,
        visibility: wgpu::ShaderStages::COMPUTE,
        ty,
        count: None,
    });
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some("baseline"),
        entries: &entries.collect::<Vec<_>>(),
    })
}

/// The source of a method's ray-caster.
pub(super) fn shader(method: Method, channels: usize) -> String {
    let stack = if matches!(method, Method::ShortStack | Method::SampledOctree) {
        STACK
    } else {
        0
    };
    let hides = method == Method::HidingPageTables;
    let each = method.is_sampled();
    let traversal = match method.is_octree() {
        true => include_str!("octree.wgsl"),
        false => include_str!("page_tables.wgsl"),
    };
    format!(
        "const SLOTS = {channels}u;\nconst STACK = {stack}u;\nconst HIDES = {hides};\nconst EACH_SAMPLE = {each};\n{}{traversal}",
        include_str!("ray_cast.wgsl")
    )
}

fn pipeline(gpu: &Gpu, method: Method, channels: usize) -> wgpu::ComputePipeline {
    let device = gpu.device();
    let source = shader(method, channels);
    let module = shader_module(device, "baseline", &source);
    let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some("baseline"),
        bind_group_layouts: &[Some(&layout(device, method.is_octree()))],
        immediate_size: 0,
    });
    device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some("baseline"),
        layout: Some(&layout),
        module: &module,
        entry_point: Some("main"),
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    })
}

/// Words of a buffer, once all that was submitted is done.
fn read_buffer(gpu: &Gpu, buffer: &wgpu::Buffer) -> Result<Vec<u32>> {
    let device = gpu.device();
    let staging = device.create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: buffer.size(),
        usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
        mapped_at_creation: false,
    });
    let mut encoder = device.create_command_encoder(&Default::default());
    encoder.copy_buffer_to_buffer(buffer, 0, &staging, 0, buffer.size());
    gpu.queue().submit([encoder.finish()]);
    staging.map_async(wgpu::MapMode::Read, .., |_| ());
    device
        .poll(wgpu::PollType::wait_indefinitely())
        .context("the device was lost")?;
    let mapped = staging.get_mapped_range(..)?;
    Ok(bytemuck::pod_collect_to_vec(&mapped[..]))
}
