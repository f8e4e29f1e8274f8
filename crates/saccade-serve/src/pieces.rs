//! The voxels of one object, as an HTTP answer.

use std::sync::Arc;
use std::time::Duration;

use axum::http::header::{
    ACCEPT_RANGES, CACHE_CONTROL, CONTENT_RANGE, CONTENT_TYPE, ETAG, HeaderMap, RANGE,
};
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use futures::FutureExt;
use futures::future::try_join_all;
use glam::UVec3;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_source::remote::{NOTHING_ACQUIRED, RENAMED_LABEL};
use saccade_source::{Chunk, ChunkError, ChunkId};

use crate::formats::Piece;
use crate::http::{Requested, Tag, cause, failing, not_found, requested, try_again};
use crate::lingering::Lingers;
use crate::server::Compressible;
use crate::volumes::Published;

/// Keep it, and ask each time whether it is still true.
const REVALIDATE: HeaderValue = HeaderValue::from_static("no-cache");
/// What a voxel depends on is damaged for good. Clients repeat what is answered 500, some of them for ever, and take 404 for
/// the fill value.
const DAMAGED: StatusCode = StatusCode::FAILED_DEPENDENCY;
/// Its address names its state: it will never be anything else.
const KEEP: HeaderValue = HeaderValue::from_static("public, max-age=86400, immutable");

/// Reads an object's voxels, within `patience`, and answers as the request's conditions ask. As soon as an id of labels is known that
/// is another number in the volume, every answer names it.
///
/// `version` is the version of the volume that the address names, if any.
pub(crate) async fn piece(
    published: &Arc<Published>,
    piece: &Piece,
    version: Option<&str>,
    headers: &HeaderMap,
    patience: Duration,
) -> Response {
    let mut response = conditional(published, piece, version, headers, patience).await;
    if let Some(id) = published.source.renamed_label() {
        let id = HeaderValue::try_from(id.to_string()).expect("digits");
        response.headers_mut().insert(RENAMED_LABEL, id);
    }
    response
}

async fn conditional(
    published: &Arc<Published>,
    piece: &Piece,
    version: Option<&str>,
    headers: &HeaderMap,
    patience: Duration,
) -> Response {
    let place = (piece.level, piece.chunk);
    let tag = published.tag(place);
    let looks = published.source.notices_by_reading();
    if !looks && let Some(answer) = tag.precondition(headers) {
        return answer;
    }
    let mut reading = Box::pin(read(published.clone(), piece.clone()));
    let outcome = tokio::time::timeout(patience, &mut reading).await;
    if outcome.is_err() {
        let what = Lingers::Piece(piece.level, piece.chunk, piece.channels.clone());
        published.lingering.go_on(what, reading.map(drop));
    }
    // It may be the read that noticed a change: then the news is on its way.
    let is_known = published.is_caught_up().await;
    // What could not be read is not known to be another.
    if looks
        && is_known
        && let Some(answer) = published.tag(place).precondition(headers)
    {
        return answer;
    }
    let voxels = match outcome {
        Ok(Ok(Some(voxels))) => voxels,
        Ok(Ok(None)) => {
            let (level, chunk) = place;
            let why = format!("nothing was acquired in level {level} chunk {chunk}");
            let mut answer = not_found(why, Vec::new());
            let is_so = HeaderValue::from_static("1");
            answer.headers_mut().insert(NOTHING_ACQUIRED, is_so);
            return answer;
        }
        Ok(Err(error)) => return failed(published, &error),
        Err(_) => return late(published, place, patience),
    };
    // A change during the read leaves open which state this is: then it goes without a tag.
    let tag = Some(tag).filter(|tag| is_known && published.tag(place) == *tag);
    let lasts = tag.is_some() && version.is_some_and(|v| published.is_as_in(v, place));
    let cache = if lasts { KEEP } else { REVALIDATE };
    answer(voxels, tag.as_ref(), cache, headers)
}

/// The bytes of an object; `None` where nothing was acquired.
async fn read(published: Arc<Published>, piece: Piece) -> Result<Option<Bytes>, ChunkError> {
    let volume = published.volume();
    let reads = piece.channels.clone().map(|channel| {
        published.source.read(ChunkId {
            channel,
            level: piece.level,
            chunk: piece.chunk,
        })
    });
    let chunks = try_join_all(reads).await?;
    Ok(joined(volume, piece.voxels, &chunks))
}

/// The voxels of a box of each channel's chunk, channel after channel, x fastest.
fn joined(volume: &Volume, voxels: VoxelBox, chunks: &[Chunk]) -> Option<Bytes> {
    if chunks.iter().all(|chunk| *chunk == Chunk::Empty) {
        return None;
    }
    if let [Chunk::Voxels(all)] = chunks
        && voxels == VoxelBox::of_size(volume.chunk)
    {
        return Some(all.clone());
    }
    let size = voxels.size().as_usizevec3();
    let of_chunk = volume.chunk.as_usizevec3();
    let row = size.x * volume.dtype.bytes();
    let mut bytes = Vec::with_capacity(chunks.len() * row * size.y * size.z);
    for chunk in chunks {
        match chunk {
            Chunk::Empty => bytes.resize(bytes.len() + row * size.y * size.z, 0),
            Chunk::Voxels(all) => {
                let rows = VoxelBox::of_size(UVec3::new(1, voxels.size().y, voxels.size().z));
                for first in rows.iter() {
                    let first = (voxels.min + first).as_usizevec3();
                    let at = (first.z * of_chunk.y + first.y) * of_chunk.x + first.x;
                    let at = at * volume.dtype.bytes();
                    bytes.extend_from_slice(&all[at..at + row]);
                }
            }
        }
    }
    Some(bytes.into())
}

fn answer(voxels: Bytes, tag: Option<&Tag>, cache: HeaderValue, request: &HeaderMap) -> Response {
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
    headers.insert(CACHE_CONTROL, cache);
    if let Some(tag) = tag {
        headers.insert(ETAG, tag.header());
    }
    if !request.contains_key(RANGE) {
        response.extensions_mut().insert(Compressible::Large);
    }
    response
}

/// The answer where a source has not delivered in time.
fn late(published: &Published, (level, chunk): (u32, UVec3), patience: Duration) -> Response {
    let error = format!("level {level} chunk {chunk} takes long");
    let seconds = patience.as_secs_f32();
    let cause = format!(
        "level {level} chunk {chunk} was not read within {seconds} s: what it is read from answers slowly or not at all, or \
         more is asked for than can be done"
    );
    if published.is_to_tell_of_late() {
        log::warn!("volume {:?}: {cause}", published.volume().name);
    }
    failing(error, cause, Some(Duration::from_secs(1)), DAMAGED)
}

/// The answer where a source could not deliver.
pub(crate) fn failed(published: &Published, error: &ChunkError) -> Response {
    match error {
        ChunkError::NotReady { retry_after, .. } => try_again(error.to_string(), *retry_after),
        other => {
            // Of chunks that one damaged tile is in, the first is told.
            if published.is_to_tell_of(&why(other)) {
                log::warn!("volume {:?}: {}", published.volume().name, chain(other));
            }
            let after = other.is_transient().then_some(Duration::from_secs(1));
            let after = other.retry_after().or(after);
            let cause = match other {
                ChunkError::Failed { source, .. } => cause(&**source),
                other => other.to_string(),
            };
            failing(other.to_string(), cause, after, DAMAGED)
        }
    }
}

/// What is behind an error, whatever chunk it was met in.
fn why(error: &ChunkError) -> String {
    match std::error::Error::source(error) {
        Some(source) => chain(source),
        None => error.to_string(),
    }
}

/// An error and its causes, on one line, each said once: some libraries repeat their cause in their own message.
pub(crate) fn chain(error: &dyn std::error::Error) -> String {
    let mut said: Vec<String> = Vec::new();
    for cause in std::iter::successors(Some(error), |error| error.source()) {
        let cause = cause.to_string();
        if !said.iter().any(|before| before.contains(&cause)) {
            said.push(cause);
        }
    }
    said.join(": ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use saccade_core::volume::Dtype;

    /// A chunk of 3 x 2 x 2 voxels of 16 bit; values count up.
    fn chunk(first: u8) -> (Volume, Chunk) {
        let mut volume = Volume::new("v", UVec3::new(5, 2, 2), DVec3::ONE).unwrap();
        (volume.chunk, volume.dtype) = (UVec3::new(3, 2, 2), Dtype::Uint16);
        let bytes: Vec<u8> = (first..first + 12).flat_map(|v| [v, 0]).collect();
        (volume, Chunk::Voxels(bytes.into()))
    }

    fn values(bytes: Bytes) -> Vec<u8> {
        assert!(bytes.chunks(2).all(|v| v[1] == 0), "values were torn");
        bytes.iter().step_by(2).copied().collect()
    }

    #[test]
    fn whole_chunks_are_passed_on() {
        let (volume, chunk) = chunk(0);
        let whole = joined(&volume, VoxelBox::of_size(volume.chunk), &[chunk]).unwrap();
        assert_eq!(values(whole), (0..12).collect::<Vec<_>>());
    }

    #[test]
    fn parts_keep_rows_and_channels_follow_each_other() {
        let (volume, one) = chunk(0);
        let (_, other) = chunk(100);
        let part = VoxelBox::of_size(UVec3::new(2, 1, 2));
        let got = joined(&volume, part, &[one, Chunk::Empty, other]).unwrap();
        assert_eq!(values(got), [0, 1, 6, 7, 0, 0, 0, 0, 100, 101, 106, 107]);
    }

    #[test]
    fn nothing_in_all_channels_is_nothing() {
        let (volume, chunk) = chunk(0);
        let whole = VoxelBox::of_size(volume.chunk);
        assert_eq!(joined(&volume, whole, &[Chunk::Empty, Chunk::Empty]), None);
        assert!(joined(&volume, whole, &[Chunk::Empty, chunk]).is_some());
    }
}
