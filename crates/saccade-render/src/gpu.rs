//! The device everything is drawn with.

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use crate::layout::Counting;
use crate::ray_caster::RayCaster;

/// A device and its queue, with error and loss handlers installed. Cloning shares them.
#[derive(Clone, Debug)]
pub struct Gpu {
    device: wgpu::Device,
    queue: wgpu::Queue,
    adapter: wgpu::AdapterInfo,
    lost: Arc<Loss>,
    ray_caster: Arc<OnceLock<RayCaster>>,
}

/// Whether a device is gone, and who is told.
#[derive(Default)]
struct Loss {
    is_lost: AtomicBool,
    tell: OnceLock<Box<dyn Fn() + Send + Sync>>,
}

impl fmt::Debug for Loss {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Loss").field(&self.is_lost).finish()
    }
}

/// There is no device to draw with.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GpuError {
    /// No driver offers one.
    #[error("no GPU adapter was found: {}", hint::NO_ADAPTER)]
    NoAdapter {
        /// What each backend said.
        source: wgpu::RequestAdapterError,
    },
    /// The adapter refused a device.
    #[error("the GPU {adapter:?} gave no device")]
    NoDevice {
        /// What it said.
        source: wgpu::RequestDeviceError,
        /// Its name.
        adapter: String,
    },
}

#[cfg(not(target_family = "wasm"))]
#[path = "gpu/hint_native.rs"]
mod hint;
#[cfg(target_family = "wasm")]
#[path = "gpu/hint_wasm.rs"]
mod hint;

impl Gpu {
    /// A device without a window, the fastest adapter first; software drivers are taken too.
    ///
    /// # Errors
    ///
    /// [`GpuError`] when there is no adapter or it gives no device; the message says what to install.
    pub async fn headless() -> Result<Self, GpuError> {
        let instance =
            wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle().with_env());
        let adapter = instance
            .request_adapter(&wgpu::RequestAdapterOptions {
                power_preference: wgpu::PowerPreference::HighPerformance,
                ..Default::default()
            })
            .await
            .map_err(|source| GpuError::NoAdapter { source })?;
        let descriptor = Self::device_descriptor(&adapter);
        let (device, queue) = adapter
            .request_device(&descriptor)
            .await
            .map_err(|source| GpuError::NoDevice {
                source,
                adapter: adapter.get_info().name,
            })?;
        Ok(Self::from_parts(device, queue, adapter.get_info()))
    }

    /// What to ask an adapter for, so that caches can be as large as it allows.
    ///
    /// One feature is asked for, where it is offered: textures of 16 bit. All else is portable to browsers.
    pub fn device_descriptor(adapter: &wgpu::Adapter) -> wgpu::DeviceDescriptor<'static> {
        let has = adapter.limits();
        let required_limits = wgpu::Limits {
            max_texture_dimension_2d: has.max_texture_dimension_2d,
            max_texture_dimension_3d: has.max_texture_dimension_3d,
            max_buffer_size: has.max_buffer_size,
            max_storage_buffer_binding_size: has.max_storage_buffer_binding_size,
            ..wgpu::Limits::default()
        };
        wgpu::DeviceDescriptor {
            label: Some("saccade"),
            required_limits,
            required_features: adapter.features() & wgpu::Features::TEXTURE_FORMAT_16BIT_NORM,
            ..Default::default()
        }
    }

    /// Wraps a device that someone else made, such as the window's.
    ///
    /// Replaces the device's handlers: errors nobody caught are logged instead of ending the
    /// program, and a lost device is remembered.
    pub fn from_parts(
        device: wgpu::Device,
        queue: wgpu::Queue,
        adapter: wgpu::AdapterInfo,
    ) -> Self {
        let lost = Arc::new(Loss::default());
        device.on_uncaptured_error(Arc::new(|error| log::error!("GPU: {error}")));
        let loss = Arc::clone(&lost);
        device.set_device_lost_callback(move |reason, message| {
            if reason != wgpu::DeviceLostReason::Destroyed {
                log::error!("GPU lost: {message}");
            }
            loss.is_lost.store(true, Ordering::Release);
            if let Some(tell) = loss.tell.get() {
                tell();
            }
        });
        Self {
            device,
            queue,
            adapter,
            lost,
            ray_caster: Arc::default(),
        }
    }

    /// The device.
    pub fn device(&self) -> &wgpu::Device {
        &self.device
    }

    /// The queue.
    pub fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }

    /// Name, driver and kind of the adapter.
    pub fn adapter(&self) -> &wgpu::AdapterInfo {
        &self.adapter
    }

    /// Whether the device is gone, and everything made with it.
    pub fn is_lost(&self) -> bool {
        self.lost.is_lost.load(Ordering::Acquire)
    }

    /// Has `tell` called when the device is gone, from any thread, once or twice: soon in browsers, natively with the next work that is
    /// given to the device. Only the first `tell` counts.
    pub fn when_lost(&self, tell: impl Fn() + Send + Sync + 'static) {
        let _ = self.lost.tell.set(Box::new(tell));
        // Between the two it may have gone.
        if self.is_lost()
            && let Some(tell) = self.lost.tell.get()
        {
            tell();
        }
    }

    pub(crate) fn ray_caster(&self) -> &RayCaster {
        // Where the processor draws, another thread that compiles would slow down frames, which take long anyway.
        let is_processor = self.adapter.device_type == wgpu::DeviceType::Cpu;
        let counting = match is_processor {
            true => Counting::ByRays,
            false => Counting::ByGroups,
        };
        let new = || RayCaster::new(&self.device, !is_processor, counting);
        self.ray_caster.get_or_init(new)
    }

    /// Counts as another kind of device would; before the first renderer.
    #[cfg(test)]
    pub(crate) fn count(&self, counting: Counting) {
        let new = RayCaster::new(&self.device, false, counting);
        self.ray_caster.set(new).expect("nothing was drawn yet");
    }
}
