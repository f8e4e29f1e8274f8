//! Bringing buffers back without waiting for them.

use std::future::poll_fn;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Poll, Waker};

#[cfg(not(target_family = "wasm"))]
#[path = "readback/native.rs"]
mod platform;
#[cfg(target_family = "wasm")]
#[path = "readback/wasm.rs"]
mod platform;

pub(crate) use platform::{pump, wait};

/// Whether a mapping has happened, and how it ended.
#[derive(Debug, Default)]
struct Mapping {
    done: Option<bool>,
    waker: Option<Waker>,
}

/// Ends a mapping. Dropped unused, as by a lost device, it ends it as failed.
#[derive(Debug)]
struct End(Arc<Mutex<Mapping>>);

impl End {
    fn set(&self, arrived: bool) {
        let mut mapping = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        mapping.done.get_or_insert(arrived);
        if let Some(waker) = mapping.waker.take() {
            waker.wake();
        }
    }
}

impl Drop for End {
    fn drop(&mut self) {
        self.set(false);
    }
}

/// A buffer that the GPU fills and the CPU then reads.
#[derive(Debug)]
pub(crate) struct Staging {
    buffer: wgpu::Buffer,
    mapping: Option<Arc<Mutex<Mapping>>>,
}

impl Staging {
    pub(crate) fn new(device: &wgpu::Device, bytes: u64) -> Self {
        let buffer = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("readback"),
            size: bytes,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        Self {
            buffer,
            mapping: None,
        }
    }

    pub(crate) fn buffer(&self) -> &wgpu::Buffer {
        &self.buffer
    }

    /// Whether nothing is on its way.
    pub(crate) fn is_idle(&self) -> bool {
        self.mapping.is_none()
    }

    /// Asks for what the commands submitted so far leave in the buffer.
    pub(crate) fn begin(&mut self) {
        let mapping = Arc::<Mutex<Mapping>>::default();
        let end = End(Arc::clone(&mapping));
        self.mapping = Some(mapping);
        self.buffer
            .map_async(wgpu::MapMode::Read, .., move |result| {
                end.set(result.is_ok())
            });
    }

    /// Whether it has arrived, or never will.
    pub(crate) fn is_done(&self) -> bool {
        let mapping = self.mapping.as_ref();
        mapping.is_some_and(|m| {
            m.lock()
                .unwrap_or_else(PoisonError::into_inner)
                .done
                .is_some()
        })
    }

    /// Waits for it.
    pub(crate) async fn done(&self) {
        poll_fn(|context| {
            let Some(mapping) = &self.mapping else {
                return Poll::Ready(());
            };
            let mut mapping = mapping.lock().unwrap_or_else(PoisonError::into_inner);
            if mapping.done.is_some() {
                return Poll::Ready(());
            }
            mapping.waker = Some(context.waker().clone());
            Poll::Pending
        })
        .await;
    }

    /// Reads what arrived and makes the buffer idle; `None` when it did not arrive.
    pub(crate) fn take<T>(&mut self, read: impl FnOnce(&[u8]) -> T) -> Option<T> {
        let mapping = self.mapping.take()?;
        let done = mapping.lock().unwrap_or_else(PoisonError::into_inner).done;
        let value = match (done, self.buffer.get_mapped_range(..)) {
            (Some(true), Ok(bytes)) => Some(read(&bytes)),
            _ => None,
        };
        self.buffer.unmap();
        value
    }
}
