//! Sessions on a real device: from a source's chunks to pixels.

#![expect(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "helpers of tests are tests, too"
)]

mod detail;
mod limits;
mod reads;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use glam::{DVec3, UVec2, UVec3};
use saccade_core::camera::Camera;
use saccade_core::transfer::TransferFunction;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_render::{Gpu, Image, View};
use saccade_source::maybe_send::{BoxFuture, BoxStream};
use saccade_source::memory::ArraySource;
use saccade_source::{Change, Chunk, ChunkError, ChunkId, VolumeSource};
use saccade_stream::policy::{Limits, Retry};
use saccade_stream::{Again, Session, SessionOptions, SettleError};

const EXTENT: UVec3 = UVec3::new(90, 70, 50);
const PATIENCE: Duration = Duration::from_secs(60);

/// The test adapter. Without one the test is skipped, unless `SACCADE_GPU_TESTS=require`.
async fn test_gpu() -> Option<Gpu> {
    let gpu = Gpu::headless().await;
    let required = std::env::var("SACCADE_GPU_TESTS").is_ok_and(|v| v == "require");
    match gpu {
        Ok(gpu) => Some(gpu),
        Err(error) => {
            assert!(!required, "SACCADE_GPU_TESTS=require: {error}");
            println!("skipped: {error}");
            None
        }
    }
}

/// Bright blobs in a dim field.
fn value(at: UVec3) -> u8 {
    let near = (at % 24).as_ivec3() - 12;
    if near.length_squared() < 40 {
        220
    } else {
        40 + u8::try_from(at.x % 10).unwrap()
    }
}

fn source() -> ArraySource {
    let volume = Volume::new("blobs", EXTENT, DVec3::new(4.0, 4.0, 8.0)).unwrap();
    let volume = Volume {
        chunk: UVec3::new(40, 32, 20),
        ..volume
    };
    let voxels = VoxelBox::of_size(EXTENT).iter().map(value).collect();
    ArraySource::new(volume, voxels).unwrap()
}

fn view(source: &dyn VolumeSource) -> View {
    View::new(Camera::around(source.volume()), UVec2::new(97, 61))
}

fn options() -> SessionOptions {
    let retry = Retry {
        first: Duration::from_millis(2),
        longest: Duration::from_millis(20),
    };
    let limits = Limits {
        retry,
        ..Limits::default()
    };
    SessionOptions {
        gpu_bytes: 64 << 20,
        limits,
        ..SessionOptions::default()
    }
}

async fn picture(session: &mut Session, view: &View) -> Image {
    let status = session.settle(view, PATIENCE).await.unwrap();
    assert!(status.complete && status.settled);
    session.renderer().read_pixels().await.unwrap()
}

/// Delays and fails some reads, by their number.
struct Unreliable {
    inner: ArraySource,
    reads: AtomicU64,
    answer: fn(u64, ChunkId) -> Result<Duration, ChunkError>,
}

impl Unreliable {
    fn new(answer: fn(u64, ChunkId) -> Result<Duration, ChunkError>) -> Self {
        Self {
            inner: source(),
            reads: AtomicU64::new(0),
            answer,
        }
    }
}

impl VolumeSource for Unreliable {
    fn volume(&self) -> &Arc<Volume> {
        self.inner.volume()
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        let number = self.reads.fetch_add(1, Ordering::Relaxed);
        let answer = (self.answer)(number, id);
        Box::pin(async move {
            tokio::time::sleep(answer?).await;
            self.inner.read(id).await
        })
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        self.inner.changes()
    }
}

fn failed(id: ChunkId, transient: bool) -> ChunkError {
    let source = Arc::new(std::io::Error::other("unplugged"));
    ChunkError::Failed {
        id,
        transient,
        source,
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_volume_is_seen_and_then_nothing_is_drawn() {
    let Some(gpu) = test_gpu().await else { return };
    let source = Arc::new(source());
    let view = view(&*source);
    let mut session = Session::new(&gpu, source, options()).unwrap();
    let image = picture(&mut session, &view).await;
    assert!(session.channels()[0].automatic);
    assert!(session.channels()[0].histogram.total() > 0);
    let lit = image.rgba.chunks(4).filter(|p| p[0] > 30).count();
    assert!(lit > 200, "{lit} pixels show blobs");

    let drawn = session.frame(&view).frame;
    for _ in 0..10 {
        let status = session.frame(&view);
        assert_eq!(
            (status.drew, status.frame, status.again),
            (false, drawn, Again::WhenWoken)
        );
    }
    let turned = View {
        camera: view.camera.orbited(40.0, 0.0),
        ..view
    };
    assert!(session.frame(&turned).drew);
    assert_ne!(
        picture(&mut session, &turned).await,
        image,
        "the comparison notices a turn"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn delays_and_failures_do_not_show() {
    let Some(gpu) = test_gpu().await else { return };
    let plain = Arc::new(source());
    let view = view(&*plain);
    let mut session = Session::new(&gpu, plain, options()).unwrap();
    let want = picture(&mut session, &view).await;

    let unreliable = Unreliable::new(|number, id| match number % 5 {
        1 => Err(failed(id, true)),
        3 => Err(ChunkError::NotReady {
            id,
            retry_after: Duration::from_millis(5),
        }),
        n => Ok(Duration::from_millis(n * 3)),
    });
    let mut session = Session::new(&gpu, Arc::new(unreliable), options()).unwrap();
    let got = picture(&mut session, &view).await;
    assert!(got == want, "the same voxels give the same picture");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_change_appears_in_the_same_session() {
    let Some(gpu) = test_gpu().await else { return };
    let source = Arc::new(source());
    let view = view(&*source);
    let mut session = Session::new(&gpu, source.clone(), options()).unwrap();
    let before = picture(&mut session, &view).await;

    let corner = VoxelBox::new(UVec3::splat(0), UVec3::new(45, 35, 25));
    let voxels = vec![230; usize::try_from(corner.voxels()).unwrap()];
    let revision = source.set(corner, &voxels).unwrap();
    while session.frame(&view).revision < revision {
        tokio::task::yield_now().await;
    }
    let after = picture(&mut session, &view).await;
    assert_ne!(before, after);

    let fresh = ArraySource::new(
        Volume::clone(source.volume()),
        VoxelBox::of_size(EXTENT)
            .iter()
            .map(|at| if corner.contains(at) { 230 } else { value(at) })
            .collect(),
    );
    let mut session = Session::new(&gpu, Arc::new(fresh.unwrap()), options()).unwrap();
    assert!(
        picture(&mut session, &view).await == after,
        "as if it had always been so"
    );
}

/// A growing volume changes faster than its coarse chunks can be read.
#[tokio::test(flavor = "multi_thread")]
async fn a_volume_that_never_stops_changing_is_seen() {
    let Some(gpu) = test_gpu().await else { return };
    let slow = Arc::new(Unreliable::new(|_, _| Ok(Duration::from_millis(60))));
    let view = view(&*slow);
    let mut session = Session::new(&gpu, slow.clone(), options()).unwrap();
    let (mut changes, mut seen) = (0_u8, false);
    let started = tokio::time::Instant::now();
    let whole = VoxelBox::of_size(EXTENT);
    while !seen && started.elapsed() < PATIENCE {
        changes = changes.wrapping_add(1) | 128;
        let voxels: Vec<u8> = whole.iter().map(|at| value(at).max(changes)).collect();
        slow.inner.set(whole, &voxels).unwrap();
        let status = session.frame(&view);
        assert!(!status.complete, "it changed a moment ago");
        tokio::time::sleep(Duration::from_millis(10)).await;
        let image = session.renderer().read_pixels().await.unwrap();
        seen = image.rgba.chunks_exact(4).any(|p| p != &image.rgba[..4]);
    }
    assert!(seen, "nothing was drawn");
    picture(&mut session, &view).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn lasting_failures_end_the_wait_and_say_why() {
    let Some(gpu) = test_gpu().await else { return };
    let broken = Unreliable::new(|_, id| match id.chunk.x {
        1 => Err(failed(id, false)),
        _ => Ok(Duration::ZERO),
    });
    let view = view(&broken);
    let mut session = Session::new(&gpu, Arc::new(broken), options()).unwrap();
    let error = session.settle(&view, PATIENCE).await.unwrap_err();
    assert!(matches!(error, SettleError::Failed { .. }), "{error}");
    assert!(error.to_string().contains("unplugged"), "{error}");
    assert!(
        session.renderer().read_pixels().await.is_ok(),
        "the rest can be seen"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_source_that_never_answers_is_not_waited_for() {
    let Some(gpu) = test_gpu().await else { return };
    let silent = Unreliable::new(|_, _| Ok(PATIENCE));
    let view = view(&silent);
    let mut session = Session::new(&gpu, Arc::new(silent), options()).unwrap();
    let error = session
        .settle(&view, Duration::from_millis(300))
        .await
        .unwrap_err();
    assert!(matches!(error, SettleError::Timeout { .. }), "{error}");
    assert!(!error.to_string().contains("failure"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn who_waited_in_vain_learns_what_failed() {
    let Some(gpu) = test_gpu().await else { return };
    let broken = Arc::new(Unreliable::new(|_, id| Err(failed(id, true))));
    let view = view(&*broken);
    let mut session = Session::new(&gpu, broken, options()).unwrap();
    let waited = Duration::from_secs(2);
    let error = session.settle(&view, waited).await.unwrap_err();
    assert!(matches!(error, SettleError::Timeout { .. }), "{error}");
    assert!(error.to_string().contains("unplugged"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_users_transfer_function_stays() {
    let Some(gpu) = test_gpu().await else { return };
    let source = Arc::new(source());
    let view = view(&*source);
    let mut session = Session::new(&gpu, source, options()).unwrap();
    let automatic = picture(&mut session, &view).await;
    let size = session.volume().size_nm();
    let chosen: TransferFunction =
        saccade_core::transfer::Histogram::default().transfer_function(size);
    session.set_transfer_function(0, chosen.clone()).unwrap();
    let other = picture(&mut session, &view).await;
    assert_ne!(other, automatic);
    assert_eq!(&session.channels()[0].transfer, &chosen);
    session.set_automatic_transfer_function(0).unwrap();
    assert!(picture(&mut session, &view).await == automatic);
}
