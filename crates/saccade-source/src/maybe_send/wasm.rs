use std::future::Future;

/// [`Send`] natively, nothing in browsers.
pub trait MaybeSend {}
impl<T> MaybeSend for T {}

/// [`Sync`] natively, nothing in browsers.
pub trait MaybeSync {}
impl<T> MaybeSync for T {}

/// A boxed future that may move between threads natively.
pub type BoxFuture<'a, T> = futures::future::LocalBoxFuture<'a, T>;

/// A boxed stream that may move between threads natively.
pub type BoxStream<'a, T> = futures::stream::LocalBoxStream<'a, T>;

/// Runs a future in the background, on the browser's event loop.
pub fn spawn(future: impl Future<Output = ()> + 'static) {
    wasm_bindgen_futures::spawn_local(future);
}
