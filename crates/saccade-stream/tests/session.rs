//! Sessions on a real device: from a source's chunks to pixels.

#![expect(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "helpers of tests are tests, too"
)]

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use glam::{DVec3, UVec2, UVec3};
use saccade_core::camera::Camera;
use saccade_core::space::Point;
use saccade_core::transfer::{ColorMap, OpacityPoint, TransferFunction};
use saccade_core::volume::{Polarity, Volume};
use saccade_core::voxel_box::VoxelBox;
use saccade_render::{Gpu, Image, View};
use saccade_source::maybe_send::{BoxFuture, BoxStream};
use saccade_source::memory::ArraySource;
use saccade_source::{Change, Chunk, ChunkError, ChunkId, ValueRange, VolumeSource};
use saccade_stream::policy::{Limits, Retry};
use saccade_stream::{Again, Detail, Session, SessionOptions, SettleError};

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

/// When a source tells values of chunks that were not read.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Tells {
    AtOnce,
    WhenAsked,
    Never,
}

/// Counts reads, and questions for bounds.
struct Ranged {
    inner: ArraySource,
    reads: AtomicU64,
    questions: AtomicU64,
    tells: Tells,
}

impl VolumeSource for Ranged {
    fn volume(&self) -> &Arc<Volume> {
        self.inner.volume()
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        self.reads.fetch_add(1, Ordering::Relaxed);
        self.inner.read(id)
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        self.inner.changes()
    }

    fn value_range(&self, id: ChunkId) -> Option<ValueRange> {
        (self.tells == Tells::AtOnce).then(|| self.inner.value_range(id))?
    }

    fn find_value_ranges<'a>(
        &'a self,
        ids: &'a [ChunkId],
    ) -> BoxFuture<'a, Vec<Result<Option<ValueRange>, ChunkError>>> {
        self.questions.fetch_add(1, Ordering::Relaxed);
        Box::pin(async move {
            tokio::time::sleep(Duration::from_millis(2)).await;
            let any = ValueRange { min: 1, max: 255 };
            let found = ids.iter().map(|id| match self.tells {
                Tells::Never => Ok(Some(any)),
                _ => Ok(self.inner.value_range(*id)),
            });
            found.collect()
        })
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_a_source_knows_to_be_hidden_is_not_read() {
    let Some(gpu) = test_gpu().await else { return };
    let extent = UVec3::new(150, 140, 70);
    let volume = Volume::new("corner", extent, DVec3::splat(4.0)).unwrap();
    let volume = Volume {
        chunk: UVec3::splat(32),
        ..volume
    };
    let corner = |at: UVec3| {
        if at.cmplt(UVec3::splat(20)).all() {
            230
        } else {
            30
        }
    };
    let voxels: Vec<u8> = VoxelBox::of_size(extent).iter().map(corner).collect();
    let point = |value, opacity| OpacityPoint { value, opacity };
    let transfer = TransferFunction {
        polarity: Polarity::Bright,
        color_map: ColorMap::Gray,
        window: [0.0, 1.0],
        opacity: vec![point(0.4, 0.0), point(0.6, 0.8)],
        opacity_length_nm: 20.0,
    };
    let mut seen = Vec::new();
    for tells in [Tells::AtOnce, Tells::Never, Tells::WhenAsked] {
        let source = Arc::new(Ranged {
            inner: ArraySource::new(volume.clone(), voxels.clone()).unwrap(),
            reads: AtomicU64::new(0),
            questions: AtomicU64::new(0),
            tells,
        });
        let view = View {
            lod_bias: -2.0,
            ..view(&*source)
        };
        let mut session = Session::new(&gpu, source.clone(), options()).unwrap();
        session.set_transfer_function(0, transfer.clone()).unwrap();
        let image = picture(&mut session, &view).await;
        let [reads, questions] =
            [&source.reads, &source.questions].map(|n| n.load(Ordering::Relaxed));
        let chunks = volume.chunks(0).element_product();
        assert!(questions <= 8, "{questions} questions for {chunks} chunks");
        assert_eq!(questions > 0, tells != Tells::AtOnce);
        seen.push((image, reads));
    }
    let [(with, few), (without, many), (asked, of_asked)] = &seen[..] else {
        unreachable!()
    };
    assert!(asked == with, "asked for or known, it is the same");
    assert_eq!(of_asked, few, "what is hidden is not read");
    assert!(
        with.rgba.chunks_exact(4).any(|p| p[0] > 50),
        "something is seen"
    );
    let differences = with
        .rgba
        .iter()
        .zip(&without.rgba)
        .map(|(a, b)| a.abs_diff(*b));
    assert!(differences.max() <= Some(1), "the same picture");
    assert!(
        few * 2 < *many,
        "{few} chunks were read, and {many} without ranges"
    );
}

/// Three channels of 16 bit, each an array of its own; counts reads per channel.
struct Stained {
    volume: Arc<Volume>,
    channels: [ArraySource; 3],
    reads: [AtomicU64; 3],
}

impl Stained {
    fn new() -> Self {
        let channel = |shift: u32| {
            let volume = source().volume().as_ref().clone();
            let shifted = |at: UVec3| value(at + UVec3::new(shift * 8, shift * 3, 0));
            let voxels = VoxelBox::of_size(EXTENT).iter().map(shifted).collect();
            ArraySource::new(volume, voxels).unwrap()
        };
        let channels = [channel(0), channel(1), channel(2)];
        let volume = Volume {
            dtype: saccade_core::volume::Dtype::Uint16,
            channels: ["nuclei", "actin", "tubulin"].map(str::to_owned).to_vec(),
            ..channels[0].volume().as_ref().clone()
        };
        Self {
            volume: Arc::new(volume),
            channels,
            reads: Default::default(),
        }
    }

    fn reads(&self) -> [u64; 3] {
        [0, 1, 2].map(|c: usize| self.reads[c].load(Ordering::Relaxed))
    }
}

impl VolumeSource for Stained {
    fn volume(&self) -> &Arc<Volume> {
        &self.volume
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        let channel = id.channel as usize;
        self.reads[channel].fetch_add(1, Ordering::Relaxed);
        Box::pin(async move {
            let of_one = ChunkId { channel: 0, ..id };
            Ok(match self.channels[channel].read(of_one).await? {
                // Twelve bits.
                Chunk::Voxels(voxels) => {
                    let deep = voxels
                        .iter()
                        .flat_map(|&v| (u16::from(v) * 16).to_le_bytes());
                    Chunk::Voxels(deep.collect())
                }
                Chunk::Empty => Chunk::Empty,
            })
        })
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        self.channels[0].changes()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn channels_are_read_when_they_are_seen() {
    let Some(gpu) = test_gpu().await else { return };
    let source = Arc::new(Stained::new());
    let view = view(&*source);
    let mut session = Session::new(&gpu, source.clone(), options()).unwrap();
    session.set_visible(1, false).unwrap();
    session.set_visible(2, false).unwrap();
    let first = picture(&mut session, &view).await;
    let [seen, hidden @ ..] = source.reads();
    assert!(seen > 0 && hidden == [0, 0], "{:?}", source.reads());
    // Twelve bits, and as bright as if they were all.
    assert_eq!(session.channels()[0].histogram.significant_bits(), 12);
    assert!(first.rgba.chunks(4).any(|p| p[1] > 60), "green is seen");
    assert!(
        first.rgba.chunks(4).all(|p| p[0] == 0 && p[2] == 0),
        "nothing else is"
    );

    session.set_visible(1, true).unwrap();
    let both = picture(&mut session, &view).await;
    assert!(both != first && both.rgba.chunks(4).any(|p| p[0] > 60));
    assert!(source.reads()[1] > 0 && source.reads()[2] == 0);

    // Back to one: nothing is read again.
    session.set_visible(1, false).unwrap();
    let reads = source.reads();
    assert!(picture(&mut session, &view).await == first);
    assert_eq!(source.reads(), reads);
    assert!(session.set_visible(3, true).is_err());
}

/// Counts reads.
struct Counted {
    inner: ArraySource,
    reads: AtomicU64,
}

impl Counted {
    fn new(inner: ArraySource) -> Arc<Self> {
        let reads = AtomicU64::new(0);
        Arc::new(Self { inner, reads })
    }

    fn reads(&self) -> u64 {
        self.reads.load(Ordering::Relaxed)
    }
}

impl VolumeSource for Counted {
    fn volume(&self) -> &Arc<Volume> {
        self.inner.volume()
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        self.reads.fetch_add(1, Ordering::Relaxed);
        self.inner.read(id)
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        self.inner.changes()
    }
}

/// Waves along x and y.
fn waves(wavelength: f64) -> Arc<ArraySource> {
    let extent = UVec3::new(160, 150, 90);
    let volume = Volume::new("waves", extent, DVec3::new(4.0, 4.0, 4.0)).unwrap();
    let wave = |x: u32| (f64::from(x) * std::f64::consts::TAU / wavelength).sin();
    #[expect(clippy::cast_possible_truncation, reason = "20 to 220")]
    #[expect(clippy::cast_sign_loss, reason = "20 to 220")]
    let value = |at: UVec3| (120.0 + 50.0 * wave(at.x) + 50.0 * wave(at.y)) as u8;
    let voxels = VoxelBox::of_size(extent).iter().map(value).collect();
    Arc::new(ArraySource::new(volume, voxels).unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_channel_is_drawn_as_finely_as_its_values_need() {
    let Some(gpu) = test_gpu().await else { return };
    let chosen = Detail::Chosen {
        levels: 0..=u32::MAX,
        coarser: 1,
    };
    for (wavelength, detail, finest) in [
        (40.0, Detail::Full, 0),
        (40.0, Detail::ByContent, 1),
        (4.0, Detail::ByContent, 0),
        (4.0, chosen, 1),
    ] {
        let source = waves(wavelength);
        let view = View {
            lod_bias: -20.0,
            ..view(source.as_ref())
        };
        let mut session = Session::new(&gpu, source, options()).unwrap();
        session.set_detail(0, detail.clone()).unwrap();
        assert!(session.set_detail(1, Detail::Full).is_err());
        let _ = picture(&mut session, &view).await;
        let status = session.frame(&view);
        let case = format!("waves of {wavelength} voxels, {detail:?}");
        assert_eq!(status.fidelity.level, Some(finest), "{case}");
        let by_content = detail == Detail::ByContent;
        let needed = if by_content { finest } else { 0 };
        assert_eq!(session.channels()[0].finest_needed, needed, "{case}");
        // Asked for in full again, it is drawn in full.
        session.set_detail(0, Detail::Full).unwrap();
        let _ = picture(&mut session, &view).await;
        assert_eq!(session.frame(&view).fidelity.level, Some(0), "{case}");
    }
}

/// The picture counts: where it takes more than an eighth of the memory, bricks have less, and where it leaves them too
/// little it is refused.
#[tokio::test(flavor = "multi_thread")]
async fn a_large_picture_fits_the_ceiling_or_is_refused() {
    let Some(gpu) = test_gpu().await else { return };
    let extent = UVec3::new(330, 290, 150);
    let volume = Volume::new("blobs", extent, DVec3::new(4.0, 4.0, 8.0)).unwrap();
    let voxels = VoxelBox::of_size(extent).iter().map(value).collect();
    let source = Arc::new(ArraySource::new(volume, voxels).unwrap());
    let ceiling = 5 << 20;
    let of_bytes = |gpu_bytes| SessionOptions {
        gpu_bytes,
        ..options()
    };
    let mut session = Session::new(&gpu, source.clone(), of_bytes(ceiling)).unwrap();
    // Few bricks: this is about the picture.
    let small = View {
        lod_bias: 2.0,
        ..view(source.as_ref())
    };
    let lit = |image: &Image| image.rgba.chunks(4).filter(|p| p[0] > 30).count();
    let first = lit(&picture(&mut session, &small).await);
    assert!(first > 200, "{first} pixels show blobs");
    let before = session.renderer().memory();
    let large = View {
        size: UVec2::new(640, 480),
        ..small
    };
    session.settle(&large, PATIENCE).await.unwrap();
    let memory = session.renderer().memory();
    assert_eq!((before.ceiling, memory.ceiling), (ceiling, ceiling));
    assert_eq!(memory.image, 640 * 480 * 4);
    assert!(
        memory.image > ceiling / 8,
        "an eighth would have been enough"
    );
    assert!(memory.total() <= ceiling, "{memory:?}");
    assert!(memory.total() > memory.image + memory.bricks);
    assert!(memory.brick_slots < before.brick_slots, "{memory:?}");

    let too_large = View {
        size: UVec2::new(1600, 1000),
        ..small
    };
    let refused = session.settle(&too_large, PATIENCE).await.unwrap_err();
    let SettleError::TooLarge { source: why } = &refused else {
        panic!("{refused:?}");
    };
    assert_eq!((why.size, why.ceiling), (too_large.size, ceiling));
    assert!(why.needed > ceiling && why.needed < 3 * ceiling, "{why}");
    let status = session.frame(&too_large);
    assert!(!status.drew && !status.complete && status.settled);
    assert_eq!(status.again, Again::WhenWoken);
    assert_eq!(status.progress.failure, Some(why.to_string()));
    assert_eq!(session.renderer().size(), large.size, "nothing was drawn");
    // With as much as was named it is drawn; and smaller ones are in any case.
    let mut allowed = Session::new(&gpu, source.clone(), of_bytes(why.needed)).unwrap();
    assert!(allowed.frame(&too_large).drew);
    let memory = allowed.renderer().memory();
    assert_eq!(memory.image, 1600 * 1000 * 4);
    assert!(memory.total() <= why.needed, "{memory:?}");
    let again = lit(&picture(&mut session, &small).await);
    assert!(again.abs_diff(first) < first / 20, "{again} and {first}");
    assert_eq!(session.frame(&small).progress.failure, None);
}

/// Nothing arrives any more when somebody chooses: what has arrived tells.
#[tokio::test(flavor = "multi_thread")]
async fn detail_by_content_may_be_chosen_when_all_is_there() {
    let Some(gpu) = test_gpu().await else { return };
    for (wavelength, finest) in [(40.0, 1), (4.0, 0)] {
        let source = waves(wavelength);
        let view = View {
            lod_bias: -20.0,
            ..view(source.as_ref())
        };
        let mut session = Session::new(&gpu, source, options()).unwrap();
        let _ = picture(&mut session, &view).await;
        let case = format!("waves of {wavelength} voxels");
        assert_eq!(session.frame(&view).fidelity.level, Some(0), "{case}");
        assert_eq!(session.channels()[0].finest_needed, 0, "not asked for");
        session.set_detail(0, Detail::ByContent).unwrap();
        assert_eq!(session.channels()[0].finest_needed, finest, "{case}");
        let _ = picture(&mut session, &view).await;
        assert_eq!(session.frame(&view).fidelity.level, Some(finest), "{case}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_lost_device_is_replaced_and_the_picture_returns() {
    let Some(gpu) = test_gpu().await else { return };
    let source = Counted::new(source());
    let view = view(&*source);
    let mut session = Session::new(&gpu, source.clone(), options()).unwrap();
    session.set_iso(0, Some(0.4)).unwrap();
    let before = picture(&mut session, &view).await;
    let channels = session.channels().to_vec();
    let reads = source.reads();
    let memory = session.renderer().memory();
    gpu.device().destroy();
    let turned = View {
        camera: view.camera.orbited(5.0, 0.0),
        ..view
    };
    // Nobody waits for a device that is gone.
    let lost = session.settle(&turned, PATIENCE).await;
    assert!(matches!(lost, Err(SettleError::Lost)), "{lost:?}");
    assert!(session.frame(&view).lost);
    assert!(session.renderer().read_pixels().await.is_err());

    let Some(other) = test_gpu().await else {
        return;
    };
    session.set_gpu(&other).unwrap();
    assert!(!session.frame(&view).lost);
    assert_eq!(session.renderer().memory().bricks_resident, 0, "made again");
    // However often: nothing is taken off what was allowed.
    for _ in 0..3 {
        session.set_gpu(&other).unwrap();
        let now = session.renderer().memory();
        assert_eq!(now.ceiling, memory.ceiling);
        assert_eq!(now.brick_slots, memory.brick_slots);
    }
    let after = picture(&mut session, &view).await;
    assert_eq!(after, before);
    assert_eq!(session.channels(), channels, "channels are kept");
    assert_eq!(source.reads(), reads, "main memory still had the chunks");
    assert_ne!(picture(&mut session, &turned).await, before);
}

/// Random places, distances and directions, each looked at for a few frames: nothing grows beyond what was allowed, and at the
/// end the picture is complete, in coarser levels where it has to be.
#[tokio::test(flavor = "multi_thread")]
async fn a_random_flight_stays_below_both_ceilings() {
    let Some(gpu) = test_gpu().await else { return };
    let extent = UVec3::new(330, 290, 150);
    let volume = Volume::new("blobs", extent, DVec3::new(4.0, 4.0, 8.0)).unwrap();
    let voxels = VoxelBox::of_size(extent).iter().map(value).collect();
    let source = Counted::new(ArraySource::new(volume, voxels).unwrap());
    let host_bytes = 3 << 20;
    let limits = Limits {
        host_bytes,
        ..options().limits
    };
    let options = SessionOptions {
        gpu_bytes: 5 << 20,
        limits,
        ..options()
    };
    let ceiling = options.gpu_bytes;
    let mut session = Session::new(&gpu, source.clone(), options).unwrap();
    let around = Camera::around(source.volume());
    let size_nm = source.volume().size_nm();
    let mut random = 88_172_645_463_325_252_u64;
    let mut next = || {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        (random >> 40) as f64 / f64::from(1_u32 << 24)
    };
    let (mut coarser, mut drawn, mut most) = (0.0_f32, 0, (0, 0));
    for _ in 0..60 {
        let camera = Camera {
            target: Point::new(size_nm * DVec3::new(next(), next(), next())),
            ..around.orbited(360.0 * next(), 180.0 * next() - 90.0)
        };
        let view = View {
            lod_bias: -2.0,
            ..View::new(camera.zoomed(0.5 + 8.0 * next()), UVec2::new(48, 36))
        };
        for _ in 0..6 {
            let status = session.frame(&view);
            assert!(status.memory.total() <= ceiling, "{:?}", status.memory);
            assert!(status.host_bytes <= host_bytes, "{}", status.host_bytes);
            most = (
                most.0.max(status.memory.bricks_resident),
                most.1.max(status.host_bytes),
            );
            coarser = coarser.max(status.memory_bias);
            drawn += u32::from(status.drew);
            tokio::time::sleep(Duration::from_millis(4)).await;
        }
    }
    assert!(drawn > 60, "{drawn} frames were drawn");
    let slots = session.renderer().memory().brick_slots;
    assert_eq!(most.0, slots, "the flight did not even fill the cache");
    assert!(most.1 > host_bytes / 2, "nor main memory: {}", most.1);

    // More than fits: found out, told, and then left alone.
    let all = View {
        lod_bias: -3.0,
        ..View::new(around.zoomed(1.5), UVec2::new(48, 36))
    };
    let see_through = TransferFunction {
        polarity: Polarity::Bright,
        color_map: ColorMap::Gray,
        window: [0.0, 1.0],
        opacity: vec![OpacityPoint {
            value: 0.0,
            opacity: 0.001,
        }],
        opacity_length_nm: 100.0,
    };
    session.set_transfer_function(0, see_through).unwrap();
    let status = session.settle(&all, PATIENCE).await.unwrap();
    assert!(status.complete && status.memory_bias > 0.0, "{status:?}");
    let reads = source.reads();
    for _ in 0..20 {
        session.frame(&all);
        tokio::time::sleep(Duration::from_millis(4)).await;
    }
    assert_eq!(source.reads(), reads, "bricks come and go");
    // And forgotten where all fits.
    let far = View::new(around.zoomed(0.02), UVec2::new(48, 36));
    let status = session.settle(&far, PATIENCE).await.unwrap();
    assert_eq!(status.memory_bias, 0.0);
}
