//! One chunk as an HTTP answer.

use std::time::Duration;

use axum::http::header::{
    ACCEPT_RANGES, CACHE_CONTROL, CONTENT_RANGE, CONTENT_TYPE, ETAG, HeaderMap, RANGE,
};
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use saccade_source::{Chunk, ChunkError, ChunkId};

use crate::http::{Requested, Tag, internal, not_found, requested, try_again};
use crate::server::Compressible;
use crate::volumes::Published;

/// Reads a chunk, within `patience`, and answers as the request's conditions ask.
pub(crate) async fn chunk(
    published: &Published,
    id: ChunkId,
    headers: &HeaderMap,
    patience: Duration,
) -> Response {
    let Some(tag) = published.tag(id) else {
        return no_such_chunk(published, id);
    };
    if let Some(answer) = tag.precondition(headers) {
        return answer;
    }
    let read = tokio::time::timeout(patience, published.source.read(id));
    let voxels = match read.await {
        Ok(Ok(Chunk::Voxels(voxels))) => voxels,
        Ok(Ok(Chunk::Empty)) => {
            return not_found(format!("nothing was acquired in {id}"), Vec::new());
        }
        Ok(Err(error)) => return failed(published, &error),
        Err(_) => return try_again(format!("{id} takes long"), Duration::from_secs(1)),
    };
    // A change during the read leaves open which state this is: then it goes without a tag.
    let tag = Some(tag).filter(|tag| published.tag(id).as_ref() == Some(tag));
    answer(voxels, tag.as_ref(), headers)
}

fn answer(voxels: Bytes, tag: Option<&Tag>, request: &HeaderMap) -> Response {
    let len = voxels.len();
    let mut response = match requested(request, len, tag) {
        Requested::Whole => voxels.into_response(),
        Requested::Part(part) => {
            let range = format!("bytes {}-{}/{len}", part.start, part.end - 1);
            let body = voxels.slice(part);
            (StatusCode::PARTIAL_CONTENT, [(CONTENT_RANGE, range)], body).into_response()
        }
        Requested::Outside => {
            let range = format!("bytes */{len}");
            (StatusCode::RANGE_NOT_SATISFIABLE, [(CONTENT_RANGE, range)]).into_response()
        }
    };
    let headers = response.headers_mut();
    headers.insert(
        CONTENT_TYPE,
        HeaderValue::from_static("application/octet-stream"),
    );
    headers.insert(ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    // Keep it, and ask each time whether it is still true.
    headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    if let Some(tag) = tag {
        headers.insert(ETAG, tag.header());
    }
    if !request.contains_key(RANGE) {
        response.extensions_mut().insert(Compressible::Large);
    }
    response
}

fn no_such_chunk(published: &Published, id: ChunkId) -> Response {
    let volume = published.volume();
    let levels = volume.levels.iter().enumerate().map(|(level, _)| {
        let chunks = volume.chunks(level);
        let (c, z, y, x) = (volume.channels.len(), chunks.z, chunks.y, chunks.x);
        format!("level {level}: {c} x {z} x {y} x {x} chunks of channel, z, y, x")
    });
    not_found(
        format!("volume {:?} has no {id}", volume.name),
        levels.collect(),
    )
}

fn failed(published: &Published, error: &ChunkError) -> Response {
    match error {
        ChunkError::OutOfRange { id } => no_such_chunk(published, *id),
        ChunkError::NotReady { retry_after, .. } => try_again(error.to_string(), *retry_after),
        other => {
            log::warn!("volume {:?}: {}", published.volume().name, chain(other));
            if other.is_transient() {
                try_again(other.to_string(), Duration::from_secs(1))
            } else {
                internal(other.to_string())
            }
        }
    }
}

/// An error and its causes, on one line.
fn chain(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    causes
        .map(ToString::to_string)
        .collect::<Vec<_>>()
        .join(": ")
}
