//! How a session's GPU memory is divided between bricks and the picture.

use std::sync::Arc;

use glam::UVec2;
use saccade_core::volume::Volume;
use saccade_render::wgpu::DeviceType;
use saccade_render::{ChannelError, Gpu, Renderer, RendererError, RendererOptions};

use super::{Session, SessionError};

/// Share of the GPU's ceiling that is kept for the picture and for bricks on their way to it, at least.
const KEPT_SHARE: u64 = 8;

/// A picture that does not fit below the ceiling together with the bricks that it takes to draw one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "a picture of {} x {} pixels does not fit {ceiling} bytes of GPU memory; allow {needed} or more, or draw a smaller one",
    size.x, size.y
)]
pub struct TooLarge {
    /// Its size \[pixels\].
    pub size: UVec2,
    /// The ceiling in force \[bytes\].
    pub ceiling: u64,
    /// One that would do \[bytes\].
    pub needed: u64,
}

/// Bricks of a view that do not fit below the ceiling, not even those of the coarsest level.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{ceiling} bytes of GPU memory are too few for what is in view, even at the coarsest level that is drawn; {}", way_out(*needed))]
pub struct TooMuch {
    /// The ceiling in force \[bytes\].
    pub ceiling: u64,
    /// One that would do for any view, if there is any \[bytes\].
    pub needed: Option<u64>,
}

fn way_out(needed: Option<u64>) -> String {
    match needed {
        Some(needed) => format!("allow {needed}, go nearer, or show fewer channels"),
        None => "go nearer, or show fewer channels".to_owned(),
    }
}

/// What is kept while no picture's size is known \[bytes\].
pub(super) fn kept_at_first(gpu_bytes: u64) -> u64 {
    gpu_bytes / KEPT_SHARE
}

/// The ceiling that is needed where at least the share is kept, if `needed` suffices for what is kept now.
fn with_share(needed: u64, kept_bytes: u64) -> u64 {
    let caches = needed.saturating_sub(kept_bytes);
    needed.max(caches + caches / (KEPT_SHARE - 1) + 1)
}

pub(super) fn renderer(
    gpu: &Gpu,
    volume: &Arc<Volume>,
    bytes: u64,
    kept_bytes: u64,
) -> Result<Renderer, SessionError> {
    // Drivers that draw on the CPU take seconds for a frame; in parts, others get a turn. Work before it does not count
    // there, and other drivers have drawn the frame by then.
    let software = gpu.adapter().device_type == DeviceType::Cpu;
    let options = RendererOptions {
        memory_bytes: bytes,
        picture_bytes: kept_bytes,
        bands: if software { 4 } else { 1 },
        nodes_per_frame: if software { 32_768 } else { 4_096 },
        ..RendererOptions::default()
    };
    Renderer::new(gpu, volume.clone(), options).map_err(|source| SessionError::Renderer {
        source: match source {
            RendererError::Ceiling { ceiling, needed } => RendererError::Ceiling {
                ceiling,
                needed: with_share(needed, kept_bytes),
            },
            other => other,
        },
        name: volume.name.clone(),
    })
}

/// What would do for channels, where at least the share is kept for the picture.
pub(super) fn with_share_of(error: ChannelError, kept_bytes: u64) -> ChannelError {
    match error {
        ChannelError::Memory {
            got,
            most,
            ceiling,
            needed,
        } => ChannelError::Memory {
            got,
            most,
            ceiling,
            needed: with_share(needed, kept_bytes),
        },
        other => other,
    }
}

impl Session {
    /// Sees to it that a picture of this size fits below the ceiling. One that does not is not drawn.
    pub(super) fn make_room(&mut self, size: UVec2) {
        let bytes = self.renderer.picture_bytes(size);
        if bytes <= self.kept_bytes {
            self.too_large = None;
            return;
        }
        if self.too_large.is_some_and(|refused| refused.size == size) {
            return;
        }
        // A window that grows passes many sizes: more is kept than is needed now, if there is so much.
        for kept_bytes in [bytes + bytes / 4, bytes] {
            let needed = match self.renderer.keep_for_picture(kept_bytes) {
                Ok(()) => {
                    (self.kept_bytes, self.too_large) = (kept_bytes, None);
                    if let Err(error) = self.begin_again() {
                        log::error!("channels were refused: {error}");
                    }
                    return;
                }
                Err(RendererError::Ceiling { needed, .. }) => with_share(needed, kept_bytes),
                Err(error) => {
                    log::error!("no room for a picture of {size} pixels: {error}");
                    u64::MAX
                }
            };
            self.too_large = Some(TooLarge {
                size,
                ceiling: self.gpu_bytes,
                needed,
            });
        }
    }

    /// Why the newest view stays incomplete, if too much is in it for the memory.
    pub fn too_much(&self) -> Option<TooMuch> {
        let known = self.pending.is_empty() && !self.dirty;
        let starved = self.report.as_ref().is_some_and(|report| report.starved);
        (known && starved).then(|| TooMuch {
            ceiling: self.gpu_bytes,
            needed: { self.renderer.enough_memory() }
                .map(|needed| with_share(needed, self.kept_bytes)),
        })
    }

    /// Why nothing of the newest view is drawn, if it is too large a picture.
    pub fn too_large(&self) -> Option<TooLarge> {
        self.too_large
    }
}
