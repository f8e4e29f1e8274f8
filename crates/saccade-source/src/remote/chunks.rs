//! Chunks by HTTP.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use futures::StreamExt;
use reqwest::{StatusCode, Url, header};
use saccade_core::voxel_box::VoxelBox;

use super::{NOTHING_ACQUIRED, RENAMED_LABEL, RemoteError, RemoteSource, joined, refusal, within};
use crate::objects::Pace;
use crate::{Change, ChangeReason, Chunk, ChunkError, ChunkId};

/// When to ask again, where the server does not say.
const RETRY: Duration = Duration::from_secs(1);
/// Longest wait that a server is believed.
const LONGEST_RETRY: Duration = Duration::from_secs(60);
/// Changes remembered one by one.
const REMEMBERED: usize = 512;

/// The revision that each part of the volume was last changed in.
///
/// It becomes part of a chunk's address, so that no HTTP cache on the way answers with voxels from
/// before a change, while chunks that did not change may still come from caches.
pub(super) struct Revisions(Mutex<State>);

struct State {
    /// Of all that no remembered change touched.
    base: u64,
    recent: Vec<(VoxelBox, u64)>,
}

impl Revisions {
    pub(super) fn new(revision: u64) -> Self {
        Self(Mutex::new(State {
            base: revision,
            recent: Vec::new(),
        }))
    }

    pub(super) fn record(&self, change: Change) {
        let mut state = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if change.reason == ChangeReason::Missed || state.recent.len() >= REMEMBERED {
            // Also of those that are forgotten: no address that a cache may know comes back.
            let forgotten = state.recent.drain(..).map(|(_, revision)| revision);
            let newest = forgotten.fold(change.revision, u64::max);
            state.base = state.base.max(newest);
        } else {
            state.recent.push((change.voxels, change.revision));
        }
    }

    /// Of a box of level-0 voxels.
    pub(super) fn of(&self, voxels: VoxelBox) -> u64 {
        let state = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let touching = state.recent.iter().filter(|(b, _)| b.intersects(voxels));
        touching.map(|(_, r)| *r).fold(state.base, u64::max)
    }
}

/// What a server's answer means.
enum Answer {
    Voxels(Bytes),
    Empty,
    /// Ask again; with what is wrong, if anything is.
    Later(Duration, Option<String>),
}

impl RemoteSource {
    pub(super) async fn fetch(&self, id: ChunkId) -> Result<Chunk, ChunkError> {
        let voxels = id.voxels(&self.volume);
        let voxels = voxels.ok_or(ChunkError::OutOfRange { id })?;
        let level = self.volume.levels[id.level as usize];
        // A neighbouring change may reach in by interpolation.
        let revision = self.revisions.of(level.voxels_from_box(voxels.grown(1)));
        let url = chunk_url(&self.url, id, revision);
        match self.get(url).await {
            Ok(Answer::Voxels(bytes)) => Ok(Chunk::Voxels(bytes)),
            Ok(Answer::Empty) => Ok(Chunk::Empty),
            Ok(Answer::Later(retry_after, None)) => Err(ChunkError::NotReady { id, retry_after }),
            Ok(Answer::Later(retry_after, Some(reason))) => Err(ChunkError::Hindered {
                id,
                retry_after,
                reason,
            }),
            Err(error) => Err(ChunkError::Failed {
                id,
                transient: error.is_transient(),
                source: Arc::new(error),
            }),
        }
    }

    async fn get(&self, url: Url) -> Result<Answer, RemoteError> {
        let idle = self.options.idle;
        let http = |source: reqwest::Error| RemoteError::Http {
            source: source.without_url(),
            url: url.clone(),
        };
        let answer = self.client.get(url.clone()).send();
        let answer = within(idle, &url, answer).await?.map_err(http)?;
        if let Some(id) = renamed_label(answer.headers()) {
            // Whichever is the first.
            let _ = self.renamed.set(id);
        }
        match answer.status() {
            StatusCode::OK => {}
            StatusCode::NOT_FOUND if answer.headers().contains_key(NOTHING_ACQUIRED) => {
                return Ok(Answer::Empty);
            }
            StatusCode::SERVICE_UNAVAILABLE | StatusCode::TOO_MANY_REQUESTS => {
                let retry_after = retry_after(answer.headers());
                let cause = within(idle, &url, refusal(answer)).await?.cause;
                return Ok(Answer::Later(retry_after, cause));
            }
            status => {
                let reason = within(idle, &url, refusal(answer)).await?.reason();
                let url = url.clone();
                return Err(RemoteError::Status {
                    status,
                    reason,
                    url,
                });
            }
        }
        let expected = self.chunk_bytes;
        let mut bytes = BytesMut::with_capacity(expected);
        let mut body = answer.bytes_stream();
        let pace = Pace::new(idle, self.options.slowest);
        while let Some(more) = within(idle, &url, body.next()).await? {
            bytes.extend_from_slice(&more.map_err(http)?);
            // Never more than a chunk and a piece, whatever is sent.
            if bytes.len() > expected {
                break;
            }
            if pace.is_too_slow(bytes.len() as u64) {
                let (come, url) = (bytes.len(), url.clone());
                return Err(RemoteError::Slow {
                    come,
                    expected,
                    url,
                });
            }
        }
        if bytes.len() == expected {
            Ok(Answer::Voxels(bytes.freeze()))
        } else {
            let (got, url) = (bytes.len(), url.clone());
            Err(RemoteError::Length { expected, got, url })
        }
    }
}

/// Chunks are served as those of an OME-Zarr image: `zarr/LEVEL/c/CHANNEL/Z/Y/X`.
fn chunk_url(volume: &Url, id: ChunkId, revision: u64) -> Url {
    let [x, y, z] = id.chunk.to_array();
    let numbers = [id.level, id.channel, z, y, x].map(|n| n.to_string());
    let [level, channel, z, y, x] = numbers.each_ref().map(String::as_str);
    let mut url = joined(volume, &["zarr", level, "c", channel, z, y, x]);
    url.set_query(Some(&format!("r={revision}")));
    url
}

/// An id of labels that is another number in the server's volume, if it has met one.
fn renamed_label(headers: &header::HeaderMap) -> Option<i128> {
    headers.get(RENAMED_LABEL)?.to_str().ok()?.parse().ok()
}

fn retry_after(headers: &header::HeaderMap) -> Duration {
    let value = headers.get(header::RETRY_AFTER);
    let seconds = value.and_then(|v| v.to_str().ok()?.trim().parse().ok());
    seconds.map_or(RETRY, |s| Duration::from_secs(s).min(LONGEST_RETRY))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::UVec3;

    fn change(x: u32, revision: u64, reason: ChangeReason) -> Change {
        let min = UVec3::new(x, 0, 0);
        Change {
            revision,
            voxels: VoxelBox::new(min, min + 1),
            reason,
        }
    }

    #[test]
    fn only_what_changed_gets_a_new_address() {
        let at = |x| VoxelBox::new(UVec3::new(x, 0, 0), UVec3::new(x + 1, 1, 1));
        let revisions = Revisions::new(3);
        revisions.record(change(5, 4, ChangeReason::Tile));
        assert_eq!((revisions.of(at(5)), revisions.of(at(6))), (4, 3));
        revisions.record(change(5, 9, ChangeReason::Missed));
        assert_eq!((revisions.of(at(5)), revisions.of(at(6))), (9, 9));
        for n in 10..2_000 {
            revisions.record(change(7, n, ChangeReason::Transform));
            assert_eq!(revisions.of(at(7)), n);
        }
        // A server that has started again counts from where it likes.
        revisions.record(change(7, 12, ChangeReason::Missed));
        assert_eq!(revisions.of(at(7)), 1_999);
        let kept = revisions.0.lock().unwrap().recent.len();
        assert!(kept <= REMEMBERED, "{kept} changes are kept");
    }

    #[test]
    fn addresses_are_those_of_the_zarr_image() {
        let id = ChunkId {
            channel: 1,
            level: 2,
            chunk: UVec3::new(3, 4, 5),
        };
        let volume = super::super::address("http://host/sub/", &["v", "a b/c"]).unwrap();
        assert_eq!(
            chunk_url(&volume, id, 7).as_str(),
            "http://host/sub/v/a%20b%2Fc/zarr/2/c/1/5/4/3?r=7"
        );
    }
}
