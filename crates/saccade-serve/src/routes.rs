//! Which address is answered by what.

use std::future::ready;
use std::net::SocketAddr;
use std::ops::Deref;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::rejection::PathRejection;
use axum::extract::{ConnectInfo, Path, Request, State};
use axum::http::header::{
    ACCEPT_RANGES, CACHE_CONTROL, CONTENT_ENCODING, CONTENT_LENGTH, CONTENT_RANGE, ETAG, HeaderMap,
    RANGE, RETRY_AFTER,
};
use axum::http::{Extensions, HeaderName, Method, StatusCode, Uri, Version};
use axum::middleware::{Next, from_fn_with_state, map_request, map_response};
use axum::response::{IntoResponse, Redirect, Response};
use axum::routing::get;
use axum::{Json, Router};
use glam::UVec3;
use saccade_core::volume::{Dtype, Volume};
use saccade_source::remote::{NOTHING_ACQUIRED, RENAMED_LABEL};
use saccade_source::{Change, ChunkId};
use tokio::sync::{Semaphore, watch};
use tower_http::CompressionLevel;
use tower_http::compression::CompressionLayer;
use tower_http::cors::{AllowOrigin, Any, CorsLayer};
use utoipa::OpenApi;

use crate::api::{
    ChangeList, Document, FailingVolume, RangeList, VolumeDescription, VolumeEntry, VolumeList,
};
use crate::assets::asset;
use crate::events;
use crate::formats::{Entry, Format, Unknown};
use crate::http::{Refusal, cause, failing, mark_encoding, not_found, refusal, try_again};
use crate::index::index;
use crate::pieces::piece;
use crate::server::{Compress, Compressible, Gate, Options, Origins, Streams};
use crate::status::Status;
use crate::thumbnail::thumbnail;
use crate::volumes::{Published, Volumes};

/// When to ask again for a volume that cannot be opened.
const REOPENED: Duration = Duration::from_secs(2);

/// What every handler needs.
#[derive(Clone)]
pub(crate) struct App(Arc<Shared>);

pub(crate) struct Shared {
    volumes: Volumes,
    options: Options,
    closing: watch::Receiver<bool>,
    gate: Gate,
    requests: Semaphore,
    streams: Arc<Streams>,
}

impl App {
    pub(crate) fn new(volumes: Volumes, options: Options, closing: watch::Receiver<bool>) -> Self {
        Self(Arc::new(Shared {
            volumes,
            closing,
            gate: Gate::new(&options.access),
            requests: Semaphore::new(options.limits.requests),
            streams: Streams::new(options.limits.streams),
            options,
        }))
    }
}

impl Deref for App {
    type Target = Shared;

    fn deref(&self) -> &Shared {
        &self.0
    }
}

/// All addresses, with what they share: compression, tags, and access from pages of other origins.
pub(crate) fn router(app: App) -> Router {
    let allowed = match &app.options.access.origins {
        Origins::Any => AllowOrigin::any(),
        // What is no header value is no origin either.
        Origins::Only(list) => AllowOrigin::list(list.iter().filter_map(|o| o.parse().ok())),
    };
    let shared = CorsLayer::new()
        .allow_origin(allowed)
        .allow_methods([Method::GET, Method::HEAD])
        .allow_headers(Any)
        .expose_headers([
            ACCEPT_RANGES,
            CONTENT_ENCODING,
            CONTENT_LENGTH,
            CONTENT_RANGE,
            ETAG,
            RETRY_AFTER,
            HeaderName::from_static(RENAMED_LABEL),
            HeaderName::from_static(NOTHING_ACQUIRED),
        ])
        .max_age(Duration::from_secs(86_400));
    let marked = |_: StatusCode, _: Version, _: &HeaderMap, extensions: &Extensions| {
        extensions.get::<Compressible>().is_some()
    };
    let gzip = CompressionLayer::new()
        .quality(CompressionLevel::Fastest)
        .compress_when(marked);
    let mut router = Router::new();
    for format in Format::ALL {
        let now = move |app, Path((name, key)): Path<(String, String)>, headers| {
            object(app, format, name, None, key, headers)
        };
        let then = move |app, Path((name, at, key)): Path<(String, String, String)>, headers| {
            object(app, format, name, Some(at), key, headers)
        };
        let folder = format.folder();
        // For people: clients of these formats never ask for a folder.
        let below = move || ready(Redirect::to(format.root()));
        let beside = move || ready(Redirect::to(&format!("{folder}/{}", format.root())));
        for place in ["/v/{name}", "/v/{name}/at/{version}"] {
            router = router
                .route(&format!("{place}/{folder}"), get(beside))
                .route(&format!("{place}/{folder}/"), get(below));
        }
        router = router
            .route(&format!("/v/{{name}}/{folder}/{{*key}}"), get(now))
            .route(
                &format!("/v/{{name}}/at/{{version}}/{folder}/{{*key}}"),
                get(then),
            );
    }
    router
        .route("/volumes", get(list))
        .route("/openapi.json", get(api))
        .route("/volumes.json", get(volumes))
        .route("/v/{name}/volume.json", get(volume))
        .route("/v/{name}/status.json", get(status))
        .route("/v/{name}/events", get(changes))
        .route("/v/{name}/changes/{revision}", get(changes_after))
        .route("/v/{name}/thumbnail.png", get(picture))
        .route("/v/{name}/ranges/{channel}/{level}/{chunks}", get(ranges))
        .fallback(get(other))
        .layer(map_request(whole_heads))
        .layer(from_fn_with_state(app.clone(), spare_near_clients))
        .layer(gzip)
        .layer(map_response(mark_encoding))
        .layer(from_fn_with_state(app.clone(), admit))
        .layer(shared)
        .with_state(app)
}

/// Refuses strangers, and more requests at once than can be answered.
async fn admit(State(app): State<App>, request: Request, next: Next) -> Response {
    let (version, target) = (request.version(), request.uri().host());
    if let Some(refusal) = app.gate.refuse(version, target, request.headers()) {
        return refusal;
    }
    match app.requests.try_acquire() {
        Ok(_answering) => next.run(request).await,
        Err(_) => too_much("the server is busy"),
    }
}

fn too_much(error: &str) -> Response {
    try_again(error, Duration::from_secs(1))
}

/// A part is asked for with GET only; of the whole is what every other answer tells.
async fn whole_heads(mut request: Request) -> Request {
    if request.method() != Method::GET {
        request.headers_mut().remove(RANGE);
    }
    request
}

/// Compression costs a client on the same computer more than it saves.
async fn spare_near_clients(
    State(app): State<App>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    request: Request,
    next: Next,
) -> Response {
    let head = request.method() == Method::HEAD;
    let mut response = next.run(request).await;
    let far = match app.options.compress {
        Compress::Always => true,
        Compress::FarClients => !peer.ip().to_canonical().is_loopback(),
    };
    let extensions = response.extensions_mut();
    let large = matches!(extensions.get(), Some(Compressible::Large));
    if head || (large && !far) {
        extensions.remove::<Compressible>();
    }
    response
}

fn described(value: impl serde::Serialize) -> Response {
    let mut response = ([(CACHE_CONTROL, "no-cache")], Json(value)).into_response();
    response.extensions_mut().insert(Compressible::Small);
    response
}

/// The volumes on offer.
#[utoipa::path(get, tag = "volumes", path = "/volumes.json", responses((status = 200, body = VolumeList)))]
pub(crate) async fn volumes(State(app): State<App>) -> Response {
    let entry = |published: &Arc<Published>| VolumeEntry {
        name: published.volume().name.clone(),
        revision: published.history().revision(),
    };
    let volumes = app.volumes.all().iter().map(entry).collect();
    let failing = { app.volumes.failing().into_iter() }
        .map(|(name, cause)| FailingVolume { name, cause })
        .collect();
    described(VolumeList { volumes, failing })
}

/// What a volume is, and which state of it is offered now.
#[utoipa::path(
    get,
    tag = "volumes",
    path = "/v/{name}/volume.json",
    params(("name" = String, Path, description = "name of the volume")),
    responses(
        (status = 200, body = VolumeDescription),
        (status = 404, body = Refusal, description = "no such volume")
    )
)]
pub(crate) async fn volume(State(app): State<App>, Path(name): Path<String>) -> Response {
    let published = match find(&app, &name) {
        Ok(published) => published,
        Err(refusal) => return *refusal,
    };
    // Together: a change must not come between them.
    let (revision, version) = published.state();
    described(VolumeDescription {
        volume: (&**published.volume()).into(),
        revision,
        version,
        notes: published.source.notes().to_vec(),
    })
}

/// How the acquisition of a volume is coming along.
#[utoipa::path(
    get,
    tag = "volumes",
    path = "/v/{name}/status.json",
    params(("name" = String, Path, description = "name of the volume")),
    responses(
        (status = 200, body = Status),
        (status = 404, body = Refusal, description = "no such volume"),
        (status = 500, body = Refusal, description = "the catalog cannot be read"),
        (status = 503, body = Refusal, description = "the catalog cannot be used now; ask again after Retry-After")
    )
)]
pub(crate) async fn status(State(app): State<App>, Path(name): Path<String>) -> Response {
    let published = match find(&app, &name) {
        Ok(published) => published,
        Err(refusal) => return *refusal,
    };
    match &published.status {
        None => {
            let revision = published.history().revision();
            let status = Status {
                revision,
                ..Status::default()
            };
            described(status.with_damage(published.source.damage()))
        }
        Some(source) => match source.status().await {
            Ok(status) => {
                // The catalog may be ahead of what is served.
                let revision = published.history().revision();
                let status = Status { revision, ..status };
                described(status.with_damage(published.source.damage()))
            }
            Err(error) => {
                let cause = cause(&*error.source);
                log::warn!("{error}: {}", error.source);
                let after = error.transient.then_some(Duration::from_secs(1));
                failing(
                    error.to_string(),
                    cause,
                    after,
                    StatusCode::INTERNAL_SERVER_ERROR,
                )
            }
        },
    }
}

/// Every change from now on, or after the revision in `Last-Event-ID`: events `change` whose data is a
/// `Change` in JSON and whose id is its revision.
#[utoipa::path(
    get,
    tag = "volumes",
    path = "/v/{name}/events",
    params(
        ("name" = String, Path, description = "name of the volume"),
        ("Last-Event-ID" = Option<u64>, Header, description = "the revision seen last")
    ),
    responses(
        (status = 200, body = String, content_type = "text/event-stream"),
        (status = 404, body = Refusal, description = "no such volume"),
        (status = 503, body = Refusal, description = "too many clients listen; ask again after Retry-After")
    )
)]
pub(crate) async fn changes(
    State(app): State<App>,
    Path(name): Path<String>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
) -> Response {
    let published = match find(&app, &name) {
        Ok(published) => published,
        Err(refusal) => return *refusal,
    };
    match app.streams.admit(peer.ip()) {
        Some(place) => events::events(published, &headers, app.closing.clone(), place),
        None => too_much("too many clients listen"),
    }
}

/// Changes that are listed at most: more are told as fewer, larger ones.
const MOST_CHANGES: usize = 16_384;

/// What has changed after a revision, for clients that come back after longer than a stream of changes could be resumed.
#[utoipa::path(
    get,
    tag = "volumes",
    path = "/v/{name}/changes/{revision}",
    params(
        ("name" = String, Path, description = "name of the volume"),
        ("revision" = u64, Path, description = "a revision that the volume had")
    ),
    responses(
        (status = 200, body = ChangeList),
        (status = 400, body = Refusal, description = "the revision is no number"),
        (status = 404, body = Refusal, description = "no such volume"),
        (status = 503, body = Refusal, description = "not known in time; ask again after Retry-After")
    )
)]
pub(crate) async fn changes_after(
    State(app): State<App>,
    path: Result<Path<(String, u64)>, PathRejection>,
) -> Response {
    let Ok(Path((name, revision))) = path else {
        return bad_request(
            "the revision is to be a whole number, as volume.json has it".to_owned(),
        );
    };
    let published = match find(&app, &name) {
        Ok(published) => published,
        Err(refusal) => return *refusal,
    };
    // Before it is asked, so that nothing up to it is missing.
    let now = published.history().revision();
    let asked = published.source.changes_after(revision);
    match tokio::time::timeout(app.options.patience, asked).await {
        Ok(changes) => {
            let listed = |changes| grouped(changes, MOST_CHANGES);
            let changes = changes.map(|all| listed(all).into_iter().map(Into::into).collect());
            described(ChangeList {
                revision: now,
                changes,
            })
        }
        Err(_) => too_much("what has changed takes long to look up"),
    }
}

/// The same changes, or no more than `most` whose boxes hold theirs.
fn grouped(changes: Vec<Change>, most: usize) -> Vec<Change> {
    // Those that follow each other mostly lie beside each other.
    let join = |group: &[Change]| {
        group.iter().copied().reduce(|all, next| Change {
            voxels: all.voxels.union(next.voxels),
            ..next
        })
    };
    let size = changes.len().div_ceil(most).max(1);
    changes.chunks(size).filter_map(join).collect()
}

/// The description of all this.
async fn api() -> Response {
    described(Document::openapi())
}

async fn list(State(app): State<App>, headers: HeaderMap) -> Response {
    index(&app.volumes, &headers)
}

/// A section near the middle, from afar.
#[utoipa::path(
    get,
    tag = "volumes",
    path = "/v/{name}/thumbnail.png",
    params(("name" = String, Path, description = "name of the volume")),
    responses(
        (status = 200, body = Vec<u8>, content_type = "image/png"),
        (status = 404, body = Refusal, description = "no such volume, or nothing was acquired yet"),
        (status = 424, body = Refusal, description = "what it is drawn from is damaged; asking again does not help"),
        (status = 503, body = Refusal, description = "not ready; ask again after Retry-After")
    )
)]
pub(crate) async fn picture(
    State(app): State<App>,
    Path(name): Path<String>,
    headers: HeaderMap,
) -> Response {
    match find(&app, &name) {
        Ok(published) => thumbnail(&published, &headers, app.options.patience).await,
        Err(refusal) => *refusal,
    }
}

/// An object of a volume in a format, as it is now, whatever version the address names.
async fn object(
    State(app): State<App>,
    format: Format,
    name: String,
    version: Option<String>,
    key: String,
    headers: HeaderMap,
) -> Response {
    let published = match find(&app, &name) {
        Ok(published) => published,
        Err(refusal) => return *refusal,
    };
    match format.entry(published.volume(), &key) {
        Ok(Entry::Metadata(metadata)) => described(metadata),
        Ok(Entry::Piece(wanted)) => {
            let patience = app.options.patience;
            piece(&published, &wanted, version.as_deref(), &headers, patience).await
        }
        Err(Unknown { known }) => {
            let folder = format.folder();
            not_found(
                format!("there is no {key:?} in {folder}/ of volume {name:?}"),
                known,
            )
        }
    }
}

/// The application's files, and everything that does not exist.
async fn other(State(app): State<App>, uri: Uri, headers: HeaderMap) -> Response {
    asset(uri.path(), &headers).unwrap_or_else(|| {
        let mut known = ["/", "/volumes", "/volumes.json", "/openapi.json"]
            .map(str::to_owned)
            .to_vec();
        for name in app.volumes.names() {
            let files = ["volume.json", "status.json", "events", "thumbnail.png"];
            known.extend(files.map(|file| format!("/v/{name}/{file}")));
            let roots = Format::ALL.map(|f| format!("/v/{name}/{}/{}", f.folder(), f.root()));
            known.extend(roots);
        }
        not_found(format!("there is nothing at {:?}", uri.path()), known)
    })
}

/// Chunks whose bounds can be asked for at once.
const MOST_RANGES: usize = 256;

/// Bounds of chunks' values, looked up without building the chunks: what a client does not show, it need
/// not ask for.
///
/// Of the channel and level, chunks as x,y,z with semicolons between them, 256 at most. 400 where there are no
/// such chunks, or too many.
#[utoipa::path(
    get,
    tag = "volumes",
    path = "/v/{name}/ranges/{channel}/{level}/{chunks}",
    params(
        ("name" = String, Path, description = "name of the volume"),
        ("channel" = u32, Path, description = "channel, from 0"),
        ("level" = u32, Path, description = "level, 0 the finest"),
        ("chunks" = String, Path, description = "x,y,z of chunks, with semicolons between them, 256 at most")
    ),
    responses(
        (status = 200, body = RangeList),
        (status = 400, body = Refusal, description = "the volume has not all of these chunks, they are too many, or a number is none"),
        (status = 404, body = Refusal, description = "no such volume")
    )
)]
pub(crate) async fn ranges(
    State(app): State<App>,
    path: Result<Path<(String, u32, u32, String)>, PathRejection>,
) -> Response {
    let Ok(Path((name, channel, level, chunks))) = path else {
        return bad_request("channel and level are to be whole numbers".to_owned());
    };
    let published = match find(&app, &name) {
        Ok(published) => published,
        Err(refusal) => return *refusal,
    };
    let volume = published.volume().clone();
    let ids = match listed(&volume, (channel, level), &chunks) {
        Ok(ids) => ids,
        Err(error) => return bad_request(error),
    };
    let most = match volume.dtype {
        Dtype::Uint8 => u16::from(u8::MAX),
        _ => u16::MAX,
    };
    let found = published.source.find_value_ranges(&ids);
    let ranges = match tokio::time::timeout(app.options.patience, found).await {
        Ok(found) => { found.into_iter() }
            .map(|range| match range {
                Ok(range) => range.map(|range| [range.min, range.max]),
                // Whoever reads the chunk learns what is wrong with it.
                Err(_) => Some([1, most]),
            })
            .collect(),
        // To know less costs less than to wait.
        Err(_) => vec![Some([1, most]); ids.len()],
    };
    described(RangeList { ranges })
}

/// Chunks as `x,y,z`, with semicolons between them; or why there are no such.
fn listed(
    volume: &Volume,
    (channel, level): (u32, u32),
    chunks: &str,
) -> Result<Vec<ChunkId>, String> {
    let parse = |text: &str| {
        let mut axes = text.split(',').map(|n| n.parse().ok());
        let mut axis = || axes.next()?;
        let chunk = UVec3::new(axis()?, axis()?, axis()?);
        let id = ChunkId {
            channel,
            level,
            chunk,
        };
        (axes.next().is_none() && id.voxels(volume).is_some()).then_some(id)
    };
    let ids = chunks.split(';').map(parse).take(MOST_RANGES + 1);
    let ids: Option<Vec<ChunkId>> = ids.collect();
    let ids = ids.ok_or_else(|| format!("the volume has not all of these chunks: {chunks:?}"))?;
    match ids.len() > MOST_RANGES {
        true => Err(format!("ask for {MOST_RANGES} chunks at most")),
        false => Ok(ids),
    }
}

/// Chunks whose bounds are asked for: all that are listed lie in the volume, and listed again they are the same.
#[cfg(any(test, fuzzing))]
pub(crate) fn fuzz(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    let size = UVec3::new(1000, 900, 50);
    let volume = Volume::new("em", size, glam::DVec3::new(4.0, 4.0, 40.0)).expect("a volume");
    for of in [(0, 0), (0, 1), (1, 0), (0, u32::MAX)] {
        let Ok(ids) = listed(&volume, of, text) else {
            continue;
        };
        assert_eq!(of.0, 0, "there is one channel");
        assert!((1..=MOST_RANGES).contains(&ids.len()));
        assert!(
            { ids.iter() }.all(|id| (id.channel, id.level) == of && id.voxels(&volume).is_some())
        );
        let again = ids.iter().map(|id| {
            let [x, y, z] = id.chunk.to_array();
            format!("{x},{y},{z}")
        });
        let again: Vec<_> = again.collect();
        assert_eq!(listed(&volume, of, &again.join(";")), Ok(ids));
    }
}

fn bad_request(error: String) -> Response {
    refusal(StatusCode::BAD_REQUEST, error, Vec::new())
}

fn find(app: &App, name: &str) -> Result<Arc<Published>, Box<Response>> {
    app.volumes.get(name).ok_or_else(|| {
        let answer = match app.volumes.failure(name) {
            Some(cause) => {
                let error = format!("volume {name:?} cannot be opened now");
                failing(error, cause, Some(REOPENED), StatusCode::NOT_FOUND)
            }
            None => not_found(format!("there is no volume {name:?}"), app.volumes.names()),
        };
        Box::new(answer)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use saccade_core::voxel_box::VoxelBox;
    use saccade_source::ChangeReason;

    #[test]
    fn many_changes_are_told_as_fewer_that_hold_them() {
        let change = |n: u32| {
            let min = UVec3::new(n * 10, n % 7, 0);
            Change {
                revision: u64::from(n) + 5,
                voxels: VoxelBox::new(min, min + 4),
                reason: ChangeReason::Tile,
            }
        };
        for (count, most) in [(0, 3), (3, 3), (4, 3), (10, 3), (100, 7)] {
            let all: Vec<Change> = (0..count).map(change).collect();
            let few = grouped(all.clone(), most);
            assert!(few.len() <= most && few.is_empty() == all.is_empty());
            assert!(few.is_sorted_by_key(|change| change.revision));
            assert_eq!(
                few.last().map(|change| change.revision),
                all.last().map(|change| change.revision)
            );
            for change in all {
                let held = |few: &Change| few.voxels.intersection(change.voxels) == change.voxels;
                assert!(few.iter().any(held), "{change:?}");
            }
        }
        let all: Vec<Change> = (0..3).map(change).collect();
        assert_eq!(grouped(all.clone(), 3), all);
    }
}
