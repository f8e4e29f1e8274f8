//! A volume behind a Saccade server, by HTTP. The same code natively and in browsers.

mod chunks;
mod event_parser;
mod events;
#[cfg(all(any(test, fuzzing), not(target_family = "wasm")))]
pub(crate) mod fuzz_targets;
mod ranges;
mod since;
mod status;

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use futures::StreamExt;
use futures::future::{AbortHandle, Abortable, Either, select};
use reqwest::{Client, StatusCode, Url};
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use serde::Deserialize;
use serde::de::DeserializeOwned;

use crate::changes::Changes;
use crate::conformance::check_volume;
use crate::maybe_send::{BoxFuture, BoxStream, sleep, spawn};
use crate::objects::{Patience, client, is_passing, is_to_be_told};
use crate::{Change, Chunk, ChunkError, ChunkId, SourceError, ValueRange, VolumeSource};
use chunks::Revisions;

pub use status::{Quarantined, Status, StatusReader};

/// Header of a server's answers that names an id of labels which is another number in the volume, once it has met one: see
/// [`VolumeSource::renamed_label`].
pub const RENAMED_LABEL: &str = "saccade-renamed-label";
/// Header of a server's answer (404) for a chunk in which nothing was acquired: a volume that is not there is answered 404 as
/// well.
pub const NOTHING_ACQUIRED: &str = "saccade-nothing-acquired";
/// Longest description that a server may give \[bytes\].
const LARGEST_JSON: usize = 16 << 20;
/// Largest chunk a server may announce \[bytes\].
const LARGEST_CHUNK: u64 = 1 << 28;

/// How patient a [`RemoteSource`] is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RemoteOptions {
    /// A chunk of which nothing more came for so long has failed.
    pub idle: Duration,
    /// A chunk must come faster than this, counted from its beginning on, after `idle` has passed \[bytes/s\].
    pub slowest: u32,
    /// An event stream on which nothing came for so long, not even a comment, is opened anew.
    pub events_idle: Duration,
    /// Wait before the first attempt to open the event stream anew; it doubles with each failure.
    pub reconnect: Duration,
    /// Longest wait between attempts.
    pub reconnect_at_most: Duration,
}

impl Default for RemoteOptions {
    fn default() -> Self {
        Self {
            idle: Duration::from_secs(30),
            slowest: 4096,
            events_idle: Duration::from_secs(60),
            reconnect: Duration::from_millis(250),
            reconnect_at_most: Duration::from_secs(10),
        }
    }
}

/// What went wrong between here and the server.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RemoteError {
    /// No address.
    #[error(
        "{address:?} is no address of a Saccade server; give one such as http://localhost:8080"
    )]
    Address {
        /// As given.
        address: String,
    },
    /// The request failed or the connection broke.
    #[error("no answer from {url}; is the server running?")]
    Http {
        /// What went wrong.
        source: reqwest::Error,
        /// What was asked for.
        url: Url,
    },
    /// The server answered, but not with what was asked for.
    #[error("the server answered {status} for {url}{}", said(reason.as_deref()))]
    Status {
        /// Its answer.
        status: StatusCode,
        /// What it says is wrong, if it is a Saccade server.
        reason: Option<String>,
        /// What was asked for.
        url: Url,
    },
    /// Nothing more came.
    #[error("nothing came for {} s from {url}", waited.as_secs_f32())]
    Idle {
        /// For so long.
        waited: Duration,
        /// What was asked for.
        url: Url,
    },
    /// It came, but so slowly that it would hardly end.
    #[error("no more than {come} of {expected} bytes came in time from {url}")]
    Slow {
        /// Bytes that came.
        come: usize,
        /// Bytes of a chunk.
        expected: usize,
        /// What was asked for.
        url: Url,
    },
    /// A chunk is not as long as the volume's chunks are.
    #[error("{got} bytes or more came instead of {expected} from {url}")]
    Length {
        /// Bytes of a chunk.
        expected: usize,
        /// Bytes that came, as far as they were read.
        got: usize,
        /// What was asked for.
        url: Url,
    },
    /// The answer is not what a Saccade server says.
    #[error("cannot understand the answer from {url}; are server and client of the same version?")]
    Answer {
        /// What went wrong.
        source: Box<dyn std::error::Error + Send + Sync>,
        /// What was asked for.
        url: Url,
    },
}

impl RemoteError {
    /// Whether it says nothing of what is there.
    fn passes(&self) -> bool {
        match self {
            Self::Status { status, .. } => is_passing(*status),
            error => error.is_transient(),
        }
    }

    /// Whether asking again may help.
    fn is_transient(&self) -> bool {
        match self {
            Self::Http { .. } | Self::Idle { .. } | Self::Slow { .. } => true,
            // A server that has started again offers its volumes one by one.
            Self::Status { status, .. } => {
                status.is_server_error() || *status == StatusCode::NOT_FOUND
            }
            // Cut short by somebody on the way; too long is a misunderstanding.
            Self::Length { expected, got, .. } => got < expected,
            Self::Address { .. } | Self::Answer { .. } => false,
        }
    }
}

/// A volume that a Saccade server offers.
///
/// One connection for events is kept for as long as the source lives, and reopened when it breaks.
pub struct RemoteSource {
    volume: Arc<Volume>,
    chunk_bytes: usize,
    client: Client,
    /// `.../v/NAME`, without a slash at the end.
    url: Url,
    options: RemoteOptions,
    changes: Arc<Changes>,
    revisions: Arc<Revisions>,
    /// What the server says of how the volume is shown.
    notes: Vec<String>,
    /// What the server says of [`RENAMED_LABEL`], if it does.
    renamed: OnceLock<i128>,
    events: AbortHandle,
}

impl Drop for RemoteSource {
    fn drop(&mut self) {
        self.events.abort();
    }
}

#[derive(Deserialize)]
struct VolumeJson {
    volume: Volume,
    revision: u64,
    #[serde(default)]
    notes: Vec<String>,
}

#[derive(Deserialize)]
struct VolumesJson {
    volumes: Vec<NamedVolume>,
}

#[derive(Deserialize)]
struct NamedVolume {
    name: String,
}

/// Names of the volumes a server offers, at its `base` address. What passes is asked again, as of objects.
///
/// # Errors
///
/// [`SourceError::Open`] if there is no server or it does not answer as one.
pub async fn volumes(base: &str) -> Result<Vec<String>, SourceError> {
    volumes_with(base, Patience::default()).await
}

/// Like [`volumes`], with other patience.
///
/// # Errors
///
/// As [`volumes`].
pub async fn volumes_with(base: &str, patience: Patience) -> Result<Vec<String>, SourceError> {
    let options = RemoteOptions {
        idle: patience.idle,
        ..RemoteOptions::default()
    };
    let list = async {
        let url = address(base, &["volumes.json"])?;
        let client = client();
        let (mut attempts, mut wait) = (0, patience.first_wait);
        loop {
            attempts += 1;
            match get_json::<VolumesJson>(&client, url.clone(), options).await {
                Err(error) if error.passes() && attempts < patience.attempts => {
                    if is_to_be_told() {
                        log::warn!("trying again: {error}");
                    }
                }
                list => break list,
            }
            sleep(wait).await;
            wait = (wait * 2).min(patience.longest_wait);
        }
    };
    let list: Result<VolumesJson, RemoteError> = list.await;
    let list = list.map_err(|error| open_error(error, base))?;
    Ok(list.volumes.into_iter().map(|v| v.name).collect())
}

impl RemoteSource {
    /// Opens the volume `name` of the server at `base`, such as `http://localhost:8080`.
    ///
    /// # Errors
    ///
    /// [`SourceError::NoVolume`] if the server has none of that name, [`SourceError::Open`] if
    /// there is no server, or its description makes no sense.
    pub async fn open(base: &str, name: &str) -> Result<Self, SourceError> {
        Self::open_with(base, name, RemoteOptions::default()).await
    }

    /// Like [`Self::open`], with other patience.
    ///
    /// # Errors
    ///
    /// As [`Self::open`].
    pub async fn open_with(
        base: &str,
        name: &str,
        options: RemoteOptions,
    ) -> Result<Self, SourceError> {
        let client = client();
        let described = Self::describe(&client, base, name, options).await;
        let (url, described) = match described {
            Ok(described) => described,
            Err(RemoteError::Status { status, .. }) if status == StatusCode::NOT_FOUND => {
                let known = volumes(base).await?;
                let name = name.to_owned();
                return Err(SourceError::NoVolume { name, known });
            }
            Err(error) => return Err(open_error(error, base)),
        };
        let VolumeJson {
            volume,
            revision,
            notes,
        } = described;
        let changes = Changes::new(VoxelBox::of_size(volume.extent()), revision);
        let revisions = Arc::new(Revisions::new(revision));
        let (events, registration) = AbortHandle::new_pair();
        let follow = events::Follower {
            client: client.clone(),
            url: url.clone(),
            options,
            changes: changes.clone(),
            revisions: revisions.clone(),
            whole: VoxelBox::of_size(volume.extent()),
        };
        spawn(async move {
            // The error only says that the source was dropped.
            let _ = Abortable::new(follow.run(revision), registration).await;
        });
        let chunk_bytes = volume.chunk.as_usizevec3().element_product() * volume.dtype.bytes();
        Ok(Self {
            volume: Arc::new(volume),
            chunk_bytes,
            client,
            url,
            options,
            changes,
            revisions,
            notes,
            renamed: OnceLock::new(),
            events,
        })
    }

    async fn describe(
        client: &Client,
        base: &str,
        name: &str,
        options: RemoteOptions,
    ) -> Result<(Url, VolumeJson), RemoteError> {
        let url = address(base, &["v", name])?;
        let json = joined(&url, &["volume.json"]);
        let described: VolumeJson = get_json(client, json.clone(), options).await?;
        match check_described(&described.volume) {
            Ok(()) => Ok((url, described)),
            Err(source) => Err(RemoteError::Answer { source, url: json }),
        }
    }
}

impl VolumeSource for RemoteSource {
    fn volume(&self) -> &Arc<Volume> {
        &self.volume
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        Box::pin(self.fetch(id))
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        self.changes.stream()
    }

    /// Asks the server; `None` where it does not know, or does not answer in a few attempts.
    fn changes_after(&self, revision: u64) -> BoxFuture<'_, Option<Vec<Change>>> {
        Box::pin(self.since(revision))
    }

    fn renamed_label(&self) -> Option<i128> {
        self.renamed.get().copied()
    }

    fn find_value_range(
        &self,
        id: ChunkId,
    ) -> BoxFuture<'_, Result<Option<ValueRange>, ChunkError>> {
        Box::pin(async move {
            let mut found = self.ranges(&[id]).await;
            found.pop().unwrap_or(Err(ChunkError::OutOfRange { id }))
        })
    }

    /// Asks the server; where it does not answer, everything is possible.
    fn find_value_ranges<'a>(
        &'a self,
        ids: &'a [ChunkId],
    ) -> BoxFuture<'a, Vec<Result<Option<ValueRange>, ChunkError>>> {
        Box::pin(self.ranges(ids))
    }

    fn revision(&self) -> u64 {
        self.changes.revision()
    }

    fn notes(&self) -> &[String] {
        &self.notes
    }
}

/// Refuses what no server's volume can be.
fn check_described(volume: &Volume) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
    check_volume(volume)?;
    let axes = volume.chunk.to_array().map(u64::from);
    let bytes = volume.dtype.bytes() as u64;
    let bytes = axes.iter().try_fold(bytes, |n, edge| n.checked_mul(*edge));
    if bytes.is_none_or(|bytes| bytes > LARGEST_CHUNK) {
        return Err(format!("chunks of {} voxels are too large", volume.chunk).into());
    }
    Ok(())
}

fn open_error(error: RemoteError, location: &str) -> SourceError {
    SourceError::Open {
        source: Arc::new(error),
        location: location.to_owned(),
    }
}

/// The address of `parts` below a server's `base`.
fn address(base: &str, parts: &[&str]) -> Result<Url, RemoteError> {
    let error = || RemoteError::Address {
        address: base.to_owned(),
    };
    let mut url = Url::parse(base).map_err(|_| error())?;
    if url.cannot_be_a_base() || !url.has_host() {
        return Err(error());
    }
    url.set_query(None);
    url.set_fragment(None);
    Ok(joined(&url, parts))
}

/// The address of `parts` below `url`; each part is escaped.
fn joined(url: &Url, parts: &[&str]) -> Url {
    let mut url = url.clone();
    if let Ok(mut path) = url.path_segments_mut() {
        path.pop_if_empty().extend(parts);
    }
    url
}

/// What a server says where it cannot do what is asked for.
#[derive(Default, Deserialize)]
struct RefusalJson {
    #[serde(default)]
    error: Option<String>,
    /// What is wrong, where the request is not.
    #[serde(default)]
    cause: Option<String>,
}

impl RefusalJson {
    fn reason(self) -> Option<String> {
        self.cause.or(self.error)
    }
}

/// Longest refusal that is read \[bytes\].
const LONGEST_REFUSAL: usize = 64 << 10;

/// What a refusal says; nothing where it is not a Saccade server's.
async fn refusal(answer: reqwest::Response) -> RefusalJson {
    let mut bytes = Vec::new();
    let mut body = answer.bytes_stream();
    while let Some(Ok(more)) = body.next().await {
        bytes.extend_from_slice(&more);
        if bytes.len() > LONGEST_REFUSAL {
            return RefusalJson::default();
        }
    }
    serde_json::from_slice(&bytes).unwrap_or_default()
}

fn said(reason: Option<&str>) -> String {
    reason.map_or_else(String::new, |reason| format!(": {reason}"))
}

async fn get_json<T: DeserializeOwned>(
    client: &Client,
    url: Url,
    options: RemoteOptions,
) -> Result<T, RemoteError> {
    let http = |source: reqwest::Error, url| {
        let source = source.without_url();
        RemoteError::Http { source, url }
    };
    let get = async {
        let answer = client.get(url.clone()).send().await;
        let answer = answer.map_err(|e| http(e, url.clone()))?;
        if !answer.status().is_success() {
            let status = answer.status();
            return Err(RemoteError::Status {
                status,
                reason: refusal(answer).await.reason(),
                url: url.clone(),
            });
        }
        let mut bytes = Vec::new();
        let mut body = answer.bytes_stream();
        while let Some(more) = body.next().await {
            bytes.extend_from_slice(&more.map_err(|e| http(e, url.clone()))?);
            if bytes.len() > LARGEST_JSON {
                let source = std::io::Error::other("it is longer than any Saccade server's");
                let (source, url) = (source.into(), url.clone());
                return Err(RemoteError::Answer { source, url });
            }
        }
        Ok(bytes)
    };
    let bytes = within(options.idle, &url, get).await??;
    serde_json::from_slice(&bytes).map_err(|source| {
        let source = source.into();
        RemoteError::Answer { source, url }
    })
}

/// What `future` returns, unless it takes longer than `limit`; then it is dropped.
async fn within<T>(
    limit: Duration,
    url: &Url,
    future: impl Future<Output = T>,
) -> Result<T, RemoteError> {
    let (future, timer) = (std::pin::pin!(future), std::pin::pin!(sleep(limit)));
    match select(future, timer).await {
        Either::Left((done, _)) => Ok(done),
        Either::Right(_) => Err(RemoteError::Idle {
            waited: limit,
            url: url.clone(),
        }),
    }
}

#[cfg(all(test, not(target_family = "wasm")))]
mod tests;
