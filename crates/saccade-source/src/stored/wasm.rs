/// Computes; other tasks have their turn before.
pub(crate) async fn compute<T: 'static>(work: impl FnOnce() -> T + 'static) -> Option<T> {
    crate::maybe_send::sleep(std::time::Duration::ZERO).await;
    Some(work())
}
