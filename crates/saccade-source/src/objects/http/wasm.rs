use js_sys::{Function, Object, Promise, Reflect};
use reqwest::{Client, RequestBuilder};
use wasm_bindgen::{JsCast as _, JsValue};
use wasm_bindgen_futures::JsFuture;

use crate::objects::ObjectError;
use crate::objects::error::Failure;

/// Browsers ask another host for permission before they ask it for the last bytes, and many hosts know no such question.
/// A range from a known byte needs none.
pub(super) const SUFFIXES: bool = false;

/// Browsers have decoded what is encoded, but tell its encoded length.
pub(super) const DECODES: bool = true;

/// The browser's own, with its own rules.
pub(super) fn client() -> Client {
    Client::new()
}

/// Browsers decode what they ask for compressed.
pub(super) fn unencoded(request: RequestBuilder) -> RequestBuilder {
    request
}

/// What it means that no answer came. A browser tells pages nothing; by what it does tell, three cases differ.
///
/// `heard` says that an answer of the same store could be read before.
pub(super) async fn unanswered(_: reqwest::Error, location: &str, heard: bool) -> Failure {
    let denied = |advice| {
        Failure::Final(ObjectError::Denied {
            advice,
            location: location.to_owned(),
        })
    };
    if is_mixed(location) {
        return denied(
            "this page came by https, and from such pages browsers read nothing by http; give an address with \
             https, or open the page itself by http://localhost",
        );
    }
    match answers_at_all(location).await {
        true if heard => Failure::again(
            "the browser lets this page read some of the server's answers, but not this one; if it stays so, the \
             server must send Access-Control-Allow-Origin with every answer, errors included, and allow the header \
             Range (CORS)",
        ),
        true => denied(
            "the server answers, but does not let pages of other hosts read it (CORS); it must send the header \
             Access-Control-Allow-Origin: * with every answer, also for objects that it does not have",
        ),
        false => Failure::again(
            "no answer came; is the address right, and can this computer reach the server?",
        ),
    }
}

/// Whether a browser would refuse to ask, as the page came by a safer way.
fn is_mixed(location: &str) -> bool {
    let page = Reflect::get(&js_sys::global(), &"location".into());
    let scheme = page.and_then(|page| Reflect::get(&page, &"protocol".into()));
    let local = ["http://localhost", "http://127.0.0.1", "http://[::1]"];
    scheme.is_ok_and(|scheme| scheme == "https:")
        && location.starts_with("http://")
        && !local.iter().any(|local| location.starts_with(local))
}

/// Whether anything answers there: asked so that the browser need not be allowed to read it.
async fn answers_at_all(location: &str) -> bool {
    let ask = || -> Result<Promise, JsValue> {
        let how = Object::new();
        Reflect::set(&how, &"method".into(), &"HEAD".into())?;
        Reflect::set(&how, &"mode".into(), &"no-cors".into())?;
        let global = js_sys::global();
        let fetch: Function = Reflect::get(&global, &"fetch".into())?.dyn_into()?;
        fetch.call2(&global, &location.into(), &how)?.dyn_into()
    };
    match ask() {
        Ok(answer) => JsFuture::from(answer).await.is_ok(),
        Err(_) => false,
    }
}
