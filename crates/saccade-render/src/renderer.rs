//! The frame loop.

mod deliveries;
mod fit;
#[cfg(test)]
mod tests;

use std::collections::HashSet;
use std::sync::Arc;

use glam::{UVec2, Vec2};
use saccade_core::brick::BrickId;
use saccade_core::transfer::TransferFunction;
use saccade_core::volume::{Dtype, Polarity, Volume, VoxelKind};

use crate::channel::{self, ChannelError, ChannelView};
use crate::frame::{
    Scene, Seen, are_levels_alike, false_colors_of, frame_uniform, is_far, mode_of,
};
use crate::gpu::Gpu;
use crate::image::{Image, ReadError, read_image};
use crate::layout::Variant;
use crate::memory::plan::{Plan, READBACKS};
use crate::memory::pressure::Pressure;
use crate::memory::{Frame, VirtualMemory, Want};
use crate::octree::ResidencyOctree;
use crate::options::{RendererError, RendererOptions};
use crate::readback::{self, Staging};
use crate::report::{FrameReport, MemoryUse, RawReport};
use crate::resources::{Picture, Resources};
use crate::transfer_table::{TransferTable, bins_of, largest};
use crate::view::{Mode, View};
use fit::{Planned, needs, planned};

/// Bytes of a pixel of the picture.
const PIXEL_BYTES: u32 = 4;
/// Page table blocks made for one report; the others come with the next.
const TABLES_PER_FRAME: u32 = 64;

/// Draws one volume. See the crate's documentation for the way of a frame.
#[derive(Debug)]
pub struct Renderer {
    gpu: Gpu,
    volume: Arc<Volume>,
    options: RendererOptions,
    plan: Plan,
    memory: VirtualMemory,
    octree: Option<ResidencyOctree>,
    pressure: Pressure,
    /// Per channel, how its bricks are stored.
    polarity: Vec<Polarity>,
    /// The channels that are seen, and how.
    channels: Vec<(ChannelView, TransferTable)>,
    mode: Mode,
    format: BrickFormat,
    resources: Resources,
    picture: Picture,
    readbacks: Vec<Readback>,
    view: Option<View>,
    /// Bricks of the latest report: what finds no room matters only if it is among them.
    wanted: HashSet<BrickId>,
}

/// How bricks are stored on the device.
#[derive(Clone, Copy, Debug)]
struct BrickFormat {
    texture: wgpu::TextureFormat,
    /// To a stored value from 0 to 1, of a texel's two parts.
    combine: Vec2,
}

impl BrickFormat {
    /// 16 bit is exact: in one part where the device can, else in two of 8 bit, which the shader joins
    /// before it interpolates.
    fn new(dtype: Dtype, features: wgpu::Features, split: bool) -> Self {
        let whole = features.contains(wgpu::Features::TEXTURE_FORMAT_16BIT_NORM) && !split;
        let (texture, combine) = match dtype {
            Dtype::Uint16 if whole => (wgpu::TextureFormat::R16Unorm, Vec2::X),
            Dtype::Uint16 => {
                let parts = Vec2::new(255.0, 255.0 * 256.0) / 65_535.0;
                (wgpu::TextureFormat::Rg8Unorm, parts)
            }
            _ => (wgpu::TextureFormat::R8Unorm, Vec2::X),
        };
        Self { texture, combine }
    }

    /// Whether a texel has two parts.
    fn is_joined(self) -> bool {
        self.combine.y > 0.0
    }
}

/// A report on its way back.
#[derive(Debug)]
struct Readback {
    staging: Staging,
    frame: Frame,
    lod_bias: f32,
    memory_bias: f32,
    octree_is_current: bool,
}

impl Renderer {
    /// Makes the caches for a volume, within the ceiling. No voxel is resident yet, and no channel is
    /// seen until [`Self::set_channels`].
    ///
    /// # Errors
    ///
    /// [`RendererError`] when the volume or the device does not fit.
    pub fn new(
        gpu: &Gpu,
        volume: Arc<Volume>,
        options: RendererOptions,
    ) -> Result<Self, RendererError> {
        let Planned {
            tables,
            octree,
            octree_slots,
            plan,
        } = planned(gpu, &volume, &options, 1)?;
        let channels = u32::try_from(volume.channels.len()).unwrap_or(u32::MAX);
        let bands = options.bands.max(1);
        let format = BrickFormat::new(volume.dtype, gpu.device().features(), options.split_16_bit);
        // Between two objects' numbers lies no third object's.
        let filter = match volume.kind {
            VoxelKind::Labels => wgpu::FilterMode::Nearest,
            VoxelKind::Intensity => wgpu::FilterMode::Linear,
        };
        let resources = Resources::new(gpu, &plan, format.texture, bands, filter);
        let readback = |_| Readback {
            staging: Staging::new(gpu.device(), plan.report_bytes()),
            frame: 0,
            lod_bias: 0.0,
            memory_bias: 0.0,
            octree_is_current: false,
        };
        Ok(Self {
            gpu: gpu.clone(),
            options: RendererOptions { bands, ..options },
            memory: VirtualMemory::new(tables, plan.blocks, plan.bricks()),
            octree: octree.map(|geometry| {
                let octree = ResidencyOctree::new(geometry, octree_slots, plan.node_blocks);
                // Bins follow how many bits values have.
                let stays = channels <= octree_slots && volume.dtype != Dtype::Uint16;
                if stays {
                    octree.of_the_same_channels()
                } else {
                    octree
                }
            }),
            pressure: Pressure::default(),
            polarity: vec![Polarity::default(); volume.channels.len()],
            channels: Vec::new(),
            mode: Mode::default(),
            format,
            picture: resources.picture(gpu, UVec2::ONE),
            resources,
            readbacks: (0..READBACKS).map(readback).collect(),
            plan,
            volume,
            view: None,
            wanted: HashSet::new(),
        })
    }

    /// The volume drawn.
    pub fn volume(&self) -> &Arc<Volume> {
        &self.volume
    }

    /// The device drawn with.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Shows the first channel, and no other, with these colours and opacities from the next frame on.
    ///
    /// As [`Self::set_channels`], which can do more.
    pub fn set_transfer_function(&mut self, transfer: &TransferFunction) {
        let view = ChannelView::new(0, transfer.clone());
        // A volume has one channel at least.
        let _ = self.set_channels(&[view]);
    }

    /// Sets what is seen of which channels from the next frame on: 16 of them at most, none is nothing but
    /// background.
    ///
    /// Bricks are kept whether their channel is seen or not, as far as there is room. A change of
    /// a channel's polarity drops its bricks, since they are stored by it.
    ///
    /// # Errors
    ///
    /// [`ChannelError`] for channels that cannot be seen together, or for which there is not enough memory even where each is
    /// drawn from its coarsest level; nothing changes then.
    pub fn set_channels(&mut self, views: &[ChannelView]) -> Result<(), ChannelError> {
        channel::check(
            views,
            u32::try_from(self.polarity.len()).unwrap_or(u32::MAX),
        )?;
        if views.len() > self.plan.channels as usize {
            return Err(self.too_little_for(views.len()));
        }
        for view in views {
            let stored = &mut self.polarity[view.channel as usize];
            if *stored != view.transfer.polarity {
                *stored = view.transfer.polarity;
                // Others may have lost their slots before.
                self.note_evicted();
                self.memory.drop_bricks(view.channel);
                // The tree forgets them all at once.
                self.memory.take_evicted();
                if let Some(octree) = &mut self.octree {
                    octree.forget_channel(view.channel);
                }
            }
        }
        if let Some(octree) = &mut self.octree {
            let dtype = self.volume.dtype;
            let bins = views
                .iter()
                .map(|view| (view.channel, bins_of(view, dtype)));
            for channel in octree.assign(&bins.collect::<Vec<_>>()) {
                // What is resident since the channel was seen before, or by chance.
                let mut resident: Vec<_> = self.memory.resident(channel).collect();
                resident.sort_unstable();
                for id in resident {
                    octree.insert_again(id);
                }
            }
        }
        self.wanted
            .retain(|id| views.iter().any(|view| view.channel == id.channel()));
        let with_table = |view: &ChannelView| {
            let table = TransferTable::new(view, self.volume.dtype, self.volume.kind, self.mode);
            (view.clone(), table)
        };
        self.channels = views.iter().map(with_table).collect();
        self.write_transfer();
        self.pressure.view_changed();
        Ok(())
    }

    /// The channels that are seen, and how.
    pub fn channels(&self) -> impl ExactSizeIterator<Item = &ChannelView> {
        self.channels.iter().map(|(view, _)| view)
    }

    /// What would do for so many channels.
    fn too_little_for(&self, got: usize) -> ChannelError {
        let channels = u32::try_from(got).unwrap_or(u32::MAX);
        let ceiling = self.options.memory_bytes;
        let needed = match planned(&self.gpu, &self.volume, &self.options, channels) {
            Err(RendererError::Ceiling { needed, .. }) => needed,
            _ => ceiling.saturating_add(1),
        };
        ChannelError::Memory {
            got,
            most: self.plan.channels as usize,
            ceiling,
            needed,
        }
    }

    /// A ceiling that would do for any view of the channels that are seen, from the coarsest of the levels that they are drawn
    /// from \[bytes\]; `None` where no ceiling would.
    pub fn enough_memory(&self) -> Option<u64> {
        let needed = needs(&self.gpu, &self.volume, &self.options, 1).ok()?;
        let levels = self.channels().map(|view| self.coarsest_of(view));
        let bytes = Plan::needed_for(&needed.tables, needed.needs, levels, needed.device)?;
        Some(bytes.saturating_add(self.options.picture_bytes))
    }

    /// The coarsest level that a channel may be drawn from.
    fn coarsest_of(&self, view: &ChannelView) -> u32 {
        let last = u32::try_from(self.volume.levels.len().saturating_sub(1)).unwrap_or(0);
        (*view.levels.end()).max(*view.levels.start()).min(last)
    }

    fn set_mode(&mut self, mode: Mode) {
        if self.mode != mode {
            self.mode = mode;
            for (view, table) in &mut self.channels {
                *table = TransferTable::new(view, self.volume.dtype, self.volume.kind, mode);
            }
            self.write_transfer();
        }
    }

    fn write_transfer(&self) {
        let tables: Vec<_> = self
            .channels
            .iter()
            .map(|(_, table)| table.colors)
            .collect();
        self.resources.write_colors(&self.gpu, &tables);
    }

    /// What the picture of a view of this size takes \[bytes\].
    pub fn picture_bytes(&self, size: UVec2) -> u64 {
        let UVec2 { x, y } = self.drawn_size(size);
        u64::from(x) * u64::from(y) * u64::from(PIXEL_BYTES)
    }

    /// A view's size, at least a pixel and at most what the device can draw.
    fn drawn_size(&self, size: UVec2) -> UVec2 {
        let most = self.gpu.device().limits().max_texture_dimension_2d;
        size.clamp(UVec2::ONE, UVec2::splat(most))
    }

    /// Keeps so much of the ceiling for the picture from now on \[bytes\]. Caches are made anew, of another size, and are
    /// empty; no channel is seen until [`Self::set_channels`], and frames count from 1.
    ///
    /// # Errors
    ///
    /// [`RendererError::Ceiling`] when the rest would be too little; nothing changes then.
    pub fn keep_for_picture(&mut self, picture_bytes: u64) -> Result<(), RendererError> {
        let options = RendererOptions {
            picture_bytes,
            ..self.options
        };
        let seen = u32::try_from(self.channels.len()).unwrap_or(u32::MAX);
        planned(&self.gpu, &self.volume, &options, seen.max(1))?;
        // Before others take their place: both together are above the ceiling.
        self.resources.destroy();
        self.picture.texture.destroy();
        *self = Self::new(&self.gpu, Arc::clone(&self.volume), options)?;
        Ok(())
    }

    /// Records and submits one frame; never waits. Returns its number.
    ///
    /// Sizes beyond what the device can draw are cut.
    pub fn render(&mut self, view: &View) -> u64 {
        if self.view.as_ref() != Some(view) {
            self.pressure.view_changed();
            self.view = Some(*view);
        }
        let size = self.drawn_size(view.size);
        let view = View { size, ..*view };
        if size != self.size() {
            self.picture = self.resources.picture(&self.gpu, size);
        }
        self.set_mode(view.mode);
        let memory_bias = self.pressure.bias();
        let lod_bias = view.lod_bias + memory_bias;
        let frame = self.memory.next_frame();
        let (resources, gpu) = (&self.resources, &self.gpu);
        self.memory.flush(|array, first, entries| {
            resources.write_entries(gpu, array, first, entries);
        });
        if let Some(octree) = &mut self.octree {
            octree.advance(self.options.nodes_per_frame);
            octree.flush(|first, texels, resident| {
                resources.write_nodes(gpu, first, texels, resident);
            });
        }
        let octree = self.octree.as_ref();
        let octree_is_current = octree.is_none_or(ResidencyOctree::is_current);
        let scene = Scene {
            volume: &self.volume,
            tables: self.memory.tables(),
            plan: &self.plan,
            octree: self.octree.as_ref(),
            combine: self.format.combine,
            largest: f32::from(largest(self.volume.dtype)),
        };
        let seen = self
            .channels
            .iter()
            .map(|(view, table)| Seen { view, table });
        let uniform = frame_uniform(&view, lod_bias, scene, &seen.collect::<Vec<_>>());
        let variant = Variant::new(
            self.channels.len(),
            mode_of(self.mode),
            self.format.is_joined(),
            false_colors_of(view.false_colors),
            is_far(&uniform),
        );
        let variant = variant.with_levels(are_levels_alike(&uniform));
        let readback = self.readbacks.iter_mut().find(|r| r.staging.is_idle());
        let target = readback.as_ref().map(|r| r.staging.buffer());
        let bands = self.options.bands;
        resources.draw(gpu, &self.picture, (variant, &uniform), bands, target);
        let next = variant.likely_next(self.volume.channels.len());
        gpu.ray_caster().prepare(gpu.device(), &next);
        if let Some(readback) = readback {
            readback.staging.begin();
            readback.frame = frame;
            readback.lod_bias = lod_bias;
            readback.memory_bias = memory_bias;
            readback.octree_is_current = octree_is_current;
        }
        self.memory.frame_submitted();
        frame
    }

    /// Reports of frames that have arrived, oldest first. Never waits.
    pub fn poll(&mut self) -> Vec<FrameReport> {
        readback::pump(self.gpu.device());
        let mut arrived = Vec::new();
        for readback in &mut self.readbacks {
            if readback.staging.is_done() {
                let words = readback
                    .staging
                    .take(bytemuck::pod_collect_to_vec::<u8, u32>);
                let Readback {
                    frame,
                    lod_bias,
                    memory_bias,
                    octree_is_current,
                    ..
                } = *readback;
                let biases = (lod_bias, memory_bias);
                match words {
                    Some(words) => arrived.push((frame, biases, octree_is_current, words)),
                    None => log::warn!("the report of frame {frame} was lost"),
                }
            }
        }
        arrived.sort_unstable_by_key(|(frame, ..)| *frame);
        let reports = arrived
            .into_iter()
            .map(|(frame, biases, octree_is_current, words)| {
                let mut report = self.read_report(frame, &words);
                (report.lod_bias, report.memory_bias) = biases;
                report.octree_is_current = octree_is_current;
                report
            });
        reports.collect()
    }

    /// Waits until every frame submitted so far is drawn, and returns all reports that arrived.
    ///
    /// Natively this blocks the thread for as long as the GPU works; in a browser it yields.
    pub async fn finish(&mut self) -> Vec<FrameReport> {
        readback::wait(self.gpu.device());
        for readback in &self.readbacks {
            readback.staging.done().await;
        }
        self.poll()
    }

    /// The picture: `Rgba8Unorm` holding sRGB-encoded values, opaque. Replaced when the size of the
    /// view changes.
    pub fn output(&self) -> &wgpu::TextureView {
        &self.picture.view
    }

    /// The texture of [`Self::output`].
    pub fn output_texture(&self) -> &wgpu::Texture {
        &self.picture.texture
    }

    /// Size of the picture \[pixels\].
    pub fn size(&self) -> UVec2 {
        UVec2::new(self.picture.texture.width(), self.picture.texture.height())
    }

    /// The picture in main memory, once all frames submitted are drawn.
    ///
    /// Natively this blocks the thread for as long as the GPU works; in a browser it yields.
    ///
    /// # Errors
    ///
    /// [`ReadError`] when the device was lost.
    pub async fn read_pixels(&self) -> Result<Image, ReadError> {
        read_image(&self.gpu, &self.picture.texture).await
    }

    /// Memory in use.
    pub fn memory(&self) -> MemoryUse {
        let (bricks_resident, brick_slots) = self.memory.bricks();
        let (tables_resident, table_slots) = self.memory.blocks();
        MemoryUse {
            bricks: self.plan.brick_bytes(),
            tables: self.plan.table_bytes(),
            octree: self.plan.octree_bytes(),
            readback: self.plan.readback_bytes(),
            image: self.picture_bytes(self.size()),
            ceiling: self.options.memory_bytes,
            brick_slots,
            bricks_resident,
            table_slots,
            tables_resident,
            node_blocks: self.plan.node_blocks,
            node_blocks_used: self.octree.as_ref().map_or(0, |o| o.blocks().0),
        }
    }

    fn is_seen(&self, channel: u32) -> bool {
        self.channels().any(|view| view.channel == channel)
    }

    /// Digests what a frame met: slots it used, entries it stumbled on.
    fn read_report(&mut self, frame: Frame, words: &[u32]) -> FrameReport {
        let report = RawReport::new(words, self.plan.usage_words());
        let (bricks_used, blocks_used) = self.memory.note_usage(frame, report.usage);
        let fidelity = report.fidelity();
        self.memory.note_finest(fidelity.level.unwrap_or(0));
        let mut misses = Vec::new();
        let mut tables_made = 0;
        for entry in report.misses_by_urgency() {
            match self
                .memory
                .want(frame, entry, tables_made < TABLES_PER_FRAME)
            {
                // A channel that is no longer seen wants nothing.
                Want::Brick(id) if self.is_seen(id.channel()) => misses.push(id),
                Want::Brick(_) => {}
                Want::Table => tables_made += 1,
                Want::NoRoom => self.pressure.refuse(),
                Want::Nothing => {}
            }
        }
        self.wanted.clear();
        self.wanted.extend(&misses);
        let memory = self.memory();
        let share = |used, slots| used as f32 / slots as f32;
        let used = share(bricks_used, memory.brick_slots);
        let used = used.max(share(blocks_used, memory.table_slots));
        let next = self.memory.next_frame();
        let complete = fidelity.missing == 0;
        let coarsest = self.channels().map(|view| self.coarsest_of(view)).max();
        let is_coarsest = fidelity.level.is_some() && fidelity.level >= coarsest;
        let bias_moves = self
            .pressure
            .report(frame, next, (complete, is_coarsest), used);
        FrameReport {
            frame,
            misses,
            fidelity,
            redraw: bias_moves || tables_made > 0,
            starved: self.pressure.is_starved(),
            lod_bias: 0.0,
            memory_bias: 0.0,
            octree_is_current: false,
            statistics: report.statistics(bricks_used, blocks_used),
            memory,
        }
    }
}
