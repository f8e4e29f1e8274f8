//! Answers that say no, as JSON.

use std::error::Error;
use std::time::Duration;

use axum::Json;
use axum::http::StatusCode;
use axum::http::header::{CACHE_CONTROL, RETRY_AFTER};
use axum::response::{IntoResponse, Response};
use saccade_archive::catalog::CatalogError;
use saccade_source::PieceError;
use saccade_source::remote::RemoteError;
use saccade_source::stitched::StitchError;
use serde::Serialize;
use utoipa::ToSchema;

/// An answer that says no.
#[derive(Serialize, ToSchema)]
pub(crate) struct Refusal {
    /// Why, in words for people.
    error: String,
    /// What is wrong and how to mend it, where the request is not to blame.
    #[serde(skip_serializing_if = "Option::is_none")]
    cause: Option<String>,
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
    answer(
        status,
        Refusal {
            error: error.into(),
            cause: None,
            known,
        },
    )
}

fn answer(status: StatusCode, refusal: Refusal) -> Response {
    // What is absent now may exist in a moment.
    (status, [(CACHE_CONTROL, "no-store")], Json(refusal)).into_response()
}

/// 404: no such thing; `known` lists what there is.
pub(crate) fn not_found(error: impl Into<String>, known: Vec<String>) -> Response {
    refusal(StatusCode::NOT_FOUND, error, known)
}

/// 503: ask again after this time.
pub(crate) fn try_again(error: impl Into<String>, after: Duration) -> Response {
    let response = refusal(StatusCode::SERVICE_UNAVAILABLE, error, Vec::new());
    with_retry(response, after)
}

fn with_retry(mut response: Response, after: Duration) -> Response {
    let seconds = after.as_secs() + u64::from(after.subsec_nanos() > 0);
    response
        .headers_mut()
        .insert(RETRY_AFTER, seconds.max(1).into());
    response
}

/// What the server works with fails, `cause` says how: 503 if it may pass by `after`, else `lasting`.
pub(crate) fn failing(
    error: impl Into<String>,
    cause: impl Into<String>,
    after: Option<Duration>,
    lasting: StatusCode,
) -> Response {
    let refusal = Refusal {
        error: error.into(),
        cause: Some(cause.into()),
        known: Vec::new(),
    };
    match after {
        Some(after) => with_retry(answer(StatusCode::SERVICE_UNAVAILABLE, refusal), after),
        None => answer(lasting, refusal),
    }
}

/// What is wrong and how to mend it, as far as clients may know: they need not be told where the server keeps
/// its things.
pub(crate) fn cause(error: &(dyn Error + 'static)) -> String {
    if let Some(error) = error.downcast_ref::<StitchError>() {
        error.without_place()
    } else if let Some(error) = error.downcast_ref::<CatalogError>() {
        error.without_place()
    } else if let Some(error) = error.downcast_ref::<PieceError>() {
        error.without_place()
    } else if let Some(error) = error.downcast_ref::<RemoteError>() {
        error.to_string()
    } else {
        "the server's messages say why".to_owned()
    }
}
