//! Answers that say no, as JSON.

use std::time::Duration;

use axum::Json;
use axum::http::StatusCode;
use axum::http::header::{CACHE_CONTROL, RETRY_AFTER};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

/// An answer that says no.
#[derive(Serialize, ToSchema)]
pub(crate) struct Refusal {
    /// Why, in words for people.
    error: String,
    /// What could have been asked for instead.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    known: Vec<String>,
}

/// An answer that says no, and why; `known` lists what could have been asked for instead.
pub(crate) fn refusal(
    status: StatusCode,
    error: impl Into<String>,
    known: Vec<String>,
) -> Response {
    let body = Json(Refusal {
        error: error.into(),
        known,
    });
    // What is absent now may exist in a moment.
    (status, [(CACHE_CONTROL, "no-store")], body).into_response()
}

/// 404: no such thing; `known` lists what there is.
pub(crate) fn not_found(error: impl Into<String>, known: Vec<String>) -> Response {
    refusal(StatusCode::NOT_FOUND, error, known)
}

/// 503: ask again after this time.
pub(crate) fn try_again(error: impl Into<String>, after: Duration) -> Response {
    let seconds = after.as_secs() + u64::from(after.subsec_nanos() > 0);
    let mut response = refusal(StatusCode::SERVICE_UNAVAILABLE, error, Vec::new());
    response
        .headers_mut()
        .insert(RETRY_AFTER, seconds.max(1).into());
    response
}

/// 500: failed for good.
pub(crate) fn internal(error: impl Into<String>) -> Response {
    refusal(StatusCode::INTERNAL_SERVER_ERROR, error, Vec::new())
}
