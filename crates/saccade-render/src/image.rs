//! Pictures in main memory.

use glam::UVec2;

use crate::gpu::Gpu;
use crate::readback::{self, Staging};

/// A picture in main memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    /// Size \[pixels\].
    pub size: UVec2,
    /// sRGB-encoded red, green, blue and an opacity of 255; rows from the top, left to right.
    pub rgba: Vec<u8>,
}

/// The picture could not be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the picture could not be read back: the GPU was lost")]
pub struct ReadError;

/// Copies a texture of four bytes a pixel.
pub(crate) async fn read_image(gpu: &Gpu, texture: &wgpu::Texture) -> Result<Image, ReadError> {
    let size = UVec2::new(texture.width(), texture.height());
    let row = size.x * 4;
    let pitch = row.next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
    let mut staging = Staging::new(gpu.device(), u64::from(pitch) * u64::from(size.y));
    let mut encoder = gpu.device().create_command_encoder(&Default::default());
    let layout = wgpu::TexelCopyBufferLayout {
        offset: 0,
        bytes_per_row: Some(pitch),
        rows_per_image: None,
    };
    let target = wgpu::TexelCopyBufferInfo {
        buffer: staging.buffer(),
        layout,
    };
    encoder.copy_texture_to_buffer(texture.as_image_copy(), target, texture.size());
    gpu.queue().submit([encoder.finish()]);
    staging.begin();
    readback::wait(gpu.device());
    staging.done().await;
    let rows = |bytes: &[u8]| {
        let rows = bytes.chunks_exact(pitch as usize);
        rows.flat_map(|padded| &padded[..row as usize])
            .copied()
            .collect()
    };
    let rgba = staging.take(rows).ok_or(ReadError)?;
    Ok(Image { size, rgba })
}
