//! The stream of changes, as server-sent events.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::http::{HeaderMap, HeaderName};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures::future::select;
use futures::{Stream, StreamExt, stream};
use saccade_source::Change;
use tokio::sync::watch;

use crate::api::ChangeDocument;
use crate::server::StreamPlace;
use crate::volumes::Published;

/// So that proxies keep a quiet stream, and clients notice a dead one.
const KEEP_ALIVE: Duration = Duration::from_secs(10);

/// Answers with every change after the one a client has seen last, as they come.
pub(crate) fn events(
    published: Arc<Published>,
    headers: &HeaderMap,
    mut closing: watch::Receiver<bool>,
    place: StreamPlace,
) -> Response {
    let seen = headers.get("last-event-id").map(|id| {
        // An id that is not ours cannot be caught up from: 0 is before every revision we keep.
        id.to_str()
            .ok()
            .and_then(|id| id.trim().parse().ok())
            .unwrap_or(0)
    });
    let evicted = place.evicted();
    let events = changes(published, seen).map(move |change| {
        // Given back when the stream ends.
        let _ = &place;
        let event = Event::default()
            .event("change")
            .id(change.revision.to_string());
        // A change is numbers and an enum: it always has a JSON form.
        Ok::<_, Infallible>(
            event
                .json_data(ChangeDocument::from(change))
                .unwrap_or_default(),
        )
    });
    let closed = async move {
        // An error means that the server is gone: closed just the same.
        drop(closing.wait_for(|closing| *closing).await);
    };
    // Whoever is cut off comes back with the revision it has seen.
    let ended = select(Box::pin(closed), Box::pin(evicted));
    let stream = Sse::new(events.take_until(ended));
    let unbuffered = [(HeaderName::from_static("x-accel-buffering"), "no")];
    (
        unbuffered,
        stream.keep_alive(KeepAlive::new().interval(KEEP_ALIVE)),
    )
        .into_response()
}

/// Changes after the revision `seen`, or from now on. Ends when the volume is no longer offered.
fn changes(published: Arc<Published>, seen: Option<u64>) -> impl Stream<Item = Change> {
    let end = published.end();
    let cursor = published.history().cursor(seen);
    // Not the volume itself: a client must not keep one alive that was replaced.
    let published = Arc::downgrade(&published);
    let state = (VecDeque::new(), cursor, end, published);
    stream::unfold(
        state,
        |(mut ready, mut cursor, mut end, published)| async move {
            loop {
                if let Some(change) = ready.pop_front() {
                    return Some((change, (ready, cursor, end, published)));
                }
                end.borrow_and_update();
                let (unseen, next) = published.upgrade()?.history().since(cursor);
                (ready, cursor) = (unseen.into(), next);
                if ready.is_empty() {
                    end.changed().await.ok()?;
                }
            }
        },
    )
}
