/// Nothing to do: the browser runs callbacks between two turns of its event loop.
pub(crate) fn pump(_: &wgpu::Device) {}

/// Nothing to do: whoever waits returns to the event loop.
pub(crate) fn wait(_: &wgpu::Device) {}
