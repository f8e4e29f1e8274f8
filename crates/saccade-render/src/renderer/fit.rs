//! How a volume fits a device and a ceiling.

use saccade_core::page_table::{PageTableShape, PageTables};
use saccade_core::volume::Volume;

use crate::gpu::Gpu;
use crate::layout::MOST_CHANNELS;
use crate::memory::plan::{DeviceLimits, Misfit, Needs, OctreeSize, Plan};
use crate::octree::{Geometry, default_cell};
use crate::options::{RendererError, RendererOptions, Traversal};

/// Storage buffers the ray-caster binds.
const STORAGE_BUFFERS: u64 = 6;

/// How a volume fits a device.
pub(super) struct Planned {
    pub(super) tables: PageTables,
    pub(super) octree: Option<Geometry>,
    pub(super) octree_slots: u32,
    pub(super) plan: Plan,
}

/// What the caches of a volume are for, and what the device allows.
pub(super) struct Needed {
    pub(super) tables: PageTables,
    pub(super) needs: Needs,
    octree: Option<Geometry>,
    pub(super) device: DeviceLimits,
}

/// What a volume needs with that many channels complete together.
pub(super) fn needs(
    gpu: &Gpu,
    volume: &Volume,
    options: &RendererOptions,
    seen: u32,
) -> Result<Needed, RendererError> {
    let channels = u32::try_from(volume.channels.len()).unwrap_or(u32::MAX);
    let octree_slots = channels.min(u32::try_from(MOST_CHANNELS).expect("a few"));
    let shape = options.page_table_shape;
    let shape = shape.unwrap_or_else(|| PageTableShape::for_volume(&volume.levels, channels));
    if !(shape.block_edge.is_power_of_two() && (2..=3).contains(&shape.depth)) {
        return Err(RendererError::PageTableShape { shape });
    }
    let tables = PageTables::new(&volume.levels, channels, shape)?;
    let limits = gpu.device().limits();
    let buffers = u64::from(limits.max_storage_buffers_per_shader_stage);
    if buffers < STORAGE_BUFFERS {
        let what = "storage buffers a shader";
        return Err(RendererError::Limit {
            what,
            offered: buffers,
            needed: STORAGE_BUFFERS,
        });
    }
    let device = DeviceLimits {
        texture_edge: limits.max_texture_dimension_3d,
        rows: limits.max_texture_dimension_2d,
        buffer: limits
            .max_buffer_size
            .min(limits.max_storage_buffer_binding_size),
    };
    let octree = (options.traversal == Traversal::ResidencyOctree).then(|| {
        let cell = options.octree_cell;
        Geometry::new(volume, cell.unwrap_or_else(|| default_cell(volume)))
    });
    let needs = Needs {
        octree: OctreeSize {
            blocks: octree.as_ref().map_or(0, Geometry::all_blocks),
            slots: octree_slots,
        },
        voxel_bytes: u32::try_from(volume.dtype.bytes()).expect("a few bytes"),
        channels: seen,
    };
    Ok(Needed {
        tables,
        needs,
        octree,
        device,
    })
}

/// How a volume fits a device, so many channels of which are seen.
pub(super) fn planned(
    gpu: &Gpu,
    volume: &Volume,
    options: &RendererOptions,
    seen: u32,
) -> Result<Planned, RendererError> {
    let Needed {
        tables,
        needs,
        octree,
        device,
    } = needs(gpu, volume, options, seen)?;
    let ceiling = options.memory_bytes;
    let picture = options.picture_bytes;
    let caches = ceiling.saturating_sub(picture);
    let plan = Plan::new(&tables, needs, caches, device).map_err(|misfit| match misfit {
        Misfit::Ceiling(needed) => RendererError::Ceiling {
            ceiling,
            needed: needed.saturating_add(picture),
        },
        Misfit::Buffer(needed) => RendererError::Limit {
            what: "bytes in a storage buffer",
            offered: device.buffer,
            needed,
        },
    })?;
    Ok(Planned {
        tables,
        octree,
        octree_slots: needs.octree.slots,
        plan,
    })
}
