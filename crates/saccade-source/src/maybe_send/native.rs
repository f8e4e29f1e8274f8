use std::future::Future;

/// [`Send`] natively, nothing in browsers.
pub trait MaybeSend: Send {}
impl<T: Send> MaybeSend for T {}

/// [`Sync`] natively, nothing in browsers.
pub trait MaybeSync: Sync {}
impl<T: Sync> MaybeSync for T {}

/// A boxed future that may move between threads natively.
pub type BoxFuture<'a, T> = futures::future::BoxFuture<'a, T>;

/// A boxed stream that may move between threads natively.
pub type BoxStream<'a, T> = futures::stream::BoxStream<'a, T>;

/// Runs a future in the background, on the Tokio runtime whose context this is called in.
pub fn spawn(future: impl Future<Output = ()> + Send + 'static) {
    drop(tokio::spawn(future));
}

/// Returns after `duration`. Needs the timer of the Tokio runtime it is awaited in.
pub async fn sleep(duration: std::time::Duration) {
    tokio::time::sleep(duration).await;
}
