/// Browsers compile in a process of their own.
pub(super) const HAS_THREADS: bool = false;

/// There is no thread to do it in.
pub(super) fn spawn(_work: impl FnOnce() + 'static) -> bool {
    false
}
