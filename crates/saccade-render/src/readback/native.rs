/// Lets callbacks of finished work run.
pub(crate) fn pump(device: &wgpu::Device) {
    if let Err(error) = device.poll(wgpu::PollType::Poll) {
        log::debug!("polling the GPU: {error}");
    }
}

/// Blocks until all submitted work is done and its callbacks have run.
pub(crate) fn wait(device: &wgpu::Device) {
    if let Err(error) = device.poll(wgpu::PollType::wait_indefinitely()) {
        log::error!("waiting for the GPU: {error}");
    }
}
