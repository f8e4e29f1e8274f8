//! The browser application, embedded.

use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE, ETAG};
use axum::http::{HeaderMap, HeaderValue};
use axum::response::{Html, IntoResponse, Response};
use rust_embed::{EmbeddedFile, RustEmbed};

use crate::http::Tag;
use crate::server::Compressible;

/// The bundle as it was when this crate was built; empty where there was none.
#[derive(RustEmbed)]
#[folder = "$OUT_DIR/web"]
struct Bundle;

/// What `/` says without a bundle.
const MISSING: &str = include_str!("assets/missing.html");

/// The file at a path of the application; `None` for no such file.
pub(crate) fn asset(path: &str, request: &HeaderMap) -> Option<Response> {
    let path = if path == "/" {
        "index.html"
    } else {
        path.trim_start_matches('/')
    };
    match Bundle::get(path) {
        Some(file) => Some(answer(path, file, request)),
        None if path == "index.html" => Some(Html(MISSING).into_response()),
        None => None,
    }
}

fn answer(path: &str, file: EmbeddedFile, request: &HeaderMap) -> Response {
    let hash = file.metadata.sha256_hash();
    let tag = Tag::new(
        &hash[..12]
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect::<String>(),
    );
    let mut response = match tag.precondition(request) {
        Some(answer) => answer,
        None => {
            let body = axum::body::Bytes::from(file.data.into_owned());
            let headers = [
                (CONTENT_TYPE, HeaderValue::from_static(media_type(path))),
                (ETAG, tag.header()),
            ];
            (headers, body).into_response()
        }
    };
    // After an update of the server, its own application, not an older one.
    response
        .headers_mut()
        .insert(CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    response.extensions_mut().insert(Compressible::Large);
    response
}

fn media_type(path: &str) -> &'static str {
    match path.rsplit('.').next().unwrap_or_default() {
        "css" => "text/css; charset=utf-8",
        "html" => "text/html; charset=utf-8",
        "ico" => "image/x-icon",
        "js" | "mjs" => "text/javascript; charset=utf-8",
        "json" | "map" => "application/json",
        "png" => "image/png",
        "svg" => "image/svg+xml",
        "txt" => "text/plain; charset=utf-8",
        "wasm" => "application/wasm",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_front_page_always_exists_and_nothing_else_is_invented() {
        assert!(asset("/", &HeaderMap::new()).is_some());
        for path in ["/../Cargo.toml", "/nothing.js", "//etc/hostname", "/.."] {
            assert!(asset(path, &HeaderMap::new()).is_none(), "{path}");
        }
    }

    #[test]
    fn browsers_compile_wasm_only_by_its_media_type() {
        assert_eq!(media_type("view_bg.wasm"), "application/wasm");
        assert!(media_type("view.js").starts_with("text/javascript"));
    }
}
