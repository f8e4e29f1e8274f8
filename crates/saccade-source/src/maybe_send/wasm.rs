use std::future::Future;

use wasm_bindgen::JsCast;

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

/// Returns after `duration`, at once where the page has no timer.
pub async fn sleep(duration: std::time::Duration) {
    let millis = duration.as_secs_f64() * 1e3;
    let promise = js_sys::Promise::new(&mut |resolve, _| {
        let global = js_sys::global();
        let timer = js_sys::Reflect::get(&global, &"setTimeout".into());
        let timer = timer.and_then(|timer| timer.dyn_into::<js_sys::Function>());
        let started = timer.and_then(|timer| timer.call2(&global, &resolve, &millis.into()));
        if started.is_err() {
            // Only a page that removed setTimeout gets here; waiting for ever would be worse.
            let _ = resolve.call0(&global);
        }
    });
    // A promise that is never rejected.
    let _ = wasm_bindgen_futures::JsFuture::from(promise).await;
}
