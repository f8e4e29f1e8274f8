use std::thread::Builder;

/// Whether anything runs beside the drawing thread.
pub(super) const HAS_THREADS: bool = true;

/// Does something beside the drawing thread; whether it will.
pub(super) fn spawn(work: impl FnOnce() + Send + 'static) -> bool {
    let thread = Builder::new().name("compile".to_owned()).spawn(work);
    if let Err(error) = &thread {
        log::warn!("no thread to compile shaders in: {error}");
    }
    thread.is_ok()
}
