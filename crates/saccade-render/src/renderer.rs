//! The frame loop.

use std::sync::Arc;

use saccade_core::brick::BrickId;
use saccade_core::page_table::{PageTableError, PageTableShape};
use saccade_core::transfer::TransferFunction;
use saccade_core::volume::{Dtype, Volume};
use saccade_core::voxel_box::VoxelBox;

use crate::gpu::Gpu;
use crate::report::{FrameReport, MemoryUse};
use crate::view::{Image, View};

/// What a renderer may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RendererOptions {
    /// Ceiling for bricks, tables and readbacks together \[bytes\]. Small volumes use less.
    pub memory_bytes: u64,
    /// How page tables are cut; `None` chooses by the volume's size.
    pub page_table_shape: Option<PageTableShape>,
    /// Submissions a frame is cut into. More than one keeps slow drivers from giving up on a
    /// frame that takes seconds, and lets windows breathe between.
    pub bands: u32,
}

impl Default for RendererOptions {
    fn default() -> Self {
        Self {
            memory_bytes: 512 << 20,
            page_table_shape: None,
            bands: 1,
        }
    }
}

/// Why there is no renderer for a volume.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RendererError {
    /// A value type that is not drawn yet.
    #[error("volumes of {dtype:?} voxels cannot be drawn; convert them to 8 bit")]
    Dtype {
        /// As the volume has it.
        dtype: Dtype,
    },
    /// The volume does not fit the page tables.
    #[error("the volume cannot be addressed")]
    PageTable {
        /// Which part does not fit.
        #[from]
        source: PageTableError,
    },
    /// The ceiling leaves no room to work in.
    #[error("{ceiling} bytes of GPU memory are too few for this volume; allow {needed} or more")]
    Ceiling {
        /// As asked for \[bytes\].
        ceiling: u64,
        /// What would do \[bytes\].
        needed: u64,
    },
    /// The device does not offer what the shaders need.
    #[error("the GPU offers {offered} {what}, and {needed} are needed")]
    Limit {
        /// Which limit.
        what: &'static str,
        /// What the device has.
        offered: u64,
        /// What is needed.
        needed: u64,
    },
}

/// What a delivered brick holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BrickVoxels<'a> {
    /// The voxels with their border, as measured, x fastest:
    /// [`BRICK_STORED_VOXELS`](saccade_core::brick::BRICK_STORED_VOXELS) values.
    Voxels(&'a [u8]),
    /// Nothing was acquired there.
    Empty,
}

/// What became of a delivered brick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// The next frame draws it.
    Resident,
    /// The next frame knows that nothing is there.
    Empty,
    /// Everything in memory is in use. It will be asked for again if it is still wanted.
    NoRoom,
}

/// A brick that cannot be taken: the caller's mistake.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DeliveryError {
    /// The volume has no such brick.
    #[error("the volume has no {id}")]
    NoSuchBrick {
        /// As given.
        id: BrickId,
    },
    /// Too few or too many voxels.
    #[error("{id} came with {got} voxels instead of {expected}")]
    Length {
        /// As given.
        id: BrickId,
        /// Voxels given.
        got: usize,
        /// Voxels of a brick with its border.
        expected: usize,
    },
}

/// The picture could not be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the picture could not be read back from the GPU")]
pub struct ReadError;

/// Draws one volume. See the crate's documentation for the way of a frame.
#[derive(Debug)]
pub struct Renderer {
    gpu: Gpu,
    volume: Arc<Volume>,
    options: RendererOptions,
    frame: u64,
    texture: wgpu::Texture,
    view: wgpu::TextureView,
}

impl Renderer {
    /// Makes the caches for a volume, within the ceiling. No voxel is resident yet.
    ///
    /// # Errors
    ///
    /// [`RendererError`] when the volume or the device does not fit.
    pub fn new(
        gpu: &Gpu,
        volume: Arc<Volume>,
        options: RendererOptions,
    ) -> Result<Self, RendererError> {
        let texture = gpu.device().create_texture(&wgpu::TextureDescriptor {
            label: Some("image"),
            size: wgpu::Extent3d {
                width: 1,
                height: 1,
                depth_or_array_layers: 1,
            },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: wgpu::TextureFormat::Rgba8Unorm,
            usage: wgpu::TextureUsages::TEXTURE_BINDING
                | wgpu::TextureUsages::STORAGE_BINDING
                | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        });
        let view = texture.create_view(&wgpu::TextureViewDescriptor::default());
        Ok(Self {
            gpu: gpu.clone(),
            volume,
            options,
            frame: 0,
            texture,
            view,
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

    /// Sets colours and opacities from the next frame on.
    ///
    /// A change of polarity drops all resident bricks, since they are stored by it.
    pub fn set_transfer_function(&mut self, _transfer: &TransferFunction) {}

    /// Records and submits one frame; never waits. Returns its number.
    pub fn render(&mut self, _view: &View) -> u64 {
        self.frame += 1;
        self.frame
    }

    /// Reports of frames that have arrived, oldest first. Never waits.
    pub fn poll(&mut self) -> Vec<FrameReport> {
        Vec::new()
    }

    /// Waits until every frame submitted so far is drawn, and returns all reports that arrived.
    ///
    /// Natively this blocks the thread for as long as the GPU works.
    pub async fn finish(&mut self) -> Vec<FrameReport> {
        Vec::new()
    }

    /// Takes a brick.
    ///
    /// # Errors
    ///
    /// [`DeliveryError`] when the brick is not one of this volume's or has the wrong size.
    pub fn deliver(
        &mut self,
        _id: BrickId,
        _voxels: BrickVoxels<'_>,
    ) -> Result<Delivery, DeliveryError> {
        Ok(Delivery::Empty)
    }

    /// Level-0 voxels changed: their bricks are wanted again at all levels.
    ///
    /// Resident ones stay in the picture until their replacement is delivered, and count as missing.
    pub fn invalidate(&mut self, _voxels: VoxelBox) {}

    /// The picture: `Rgba8Unorm` holding sRGB-encoded values, opaque. Replaced when the size of the
    /// view changes.
    pub fn output(&self) -> &wgpu::TextureView {
        &self.view
    }

    /// The texture of [`Self::output`].
    pub fn output_texture(&self) -> &wgpu::Texture {
        &self.texture
    }

    /// The picture in main memory, once all frames submitted are drawn.
    ///
    /// # Errors
    ///
    /// [`ReadError`] when the device was lost.
    pub async fn read_pixels(&self) -> Result<Image, ReadError> {
        Err(ReadError)
    }

    /// Memory in use.
    pub fn memory(&self) -> MemoryUse {
        MemoryUse {
            ceiling: self.options.memory_bytes,
            ..MemoryUse::default()
        }
    }
}
