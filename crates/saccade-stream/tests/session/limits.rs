//! Ceilings on memory, and devices that are lost.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use glam::{DVec3, UVec2, UVec3};
use saccade_core::camera::Camera;
use saccade_core::space::Point;
use saccade_core::transfer::{ColorMap, OpacityPoint, TransferFunction};
use saccade_core::volume::{Polarity, Volume};
use saccade_core::voxel_box::VoxelBox;
use saccade_render::{ChannelError, Image, RendererError, View};
use saccade_source::maybe_send::{BoxFuture, BoxStream};
use saccade_source::memory::ArraySource;
use saccade_source::{Change, Chunk, ChunkError, ChunkId, VolumeSource};
use saccade_stream::policy::Limits;
use saccade_stream::{Again, Session, SessionError, SessionOptions, SettleError};

use crate::{PATIENCE, options, picture, source, test_gpu, value, view};

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

/// Sixteen channels of a volume that is seen through.
struct Channels(Arc<Volume>);

impl VolumeSource for Channels {
    fn volume(&self) -> &Arc<Volume> {
        &self.0
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        let voxels = self.0.chunk.as_usizevec3().element_product();
        let of = u8::try_from(60 + id.channel).unwrap();
        let voxels = (0..voxels).map(|n| of + u8::try_from(n % 97).unwrap());
        let voxels: Vec<u8> = voxels.collect();
        Box::pin(async move { Ok(Chunk::Voxels(voxels.into())) })
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        Box::pin(futures::stream::pending())
    }
}

/// The least memory depends on how many channels are seen, and the figure that is named is enough.
#[tokio::test(flavor = "multi_thread")]
async fn channels_that_do_not_fit_are_refused_and_what_would_do_does() {
    let Some(gpu) = test_gpu().await else { return };
    let extent = UVec3::new(1_000, 900, 300);
    let volume = Volume::new("many", extent, DVec3::new(4.0, 4.0, 8.0)).unwrap();
    let source = Arc::new(Channels(Arc::new(Volume {
        channels: (0..16).map(|n| format!("stain {n}")).collect(),
        ..volume
    })));
    let of = |gpu_bytes, seen: u32| SessionOptions {
        gpu_bytes,
        seen: Some((0..seen).collect()),
        ..options()
    };
    let refused = Session::new(&gpu, source.clone(), of(1 << 20, 1)).err();
    let Some(SessionError::Renderer {
        source: RendererError::Ceiling { needed: one, .. },
        ..
    }) = refused
    else {
        panic!("{refused:?}")
    };
    let refused = Session::new(&gpu, source.clone(), of(one, 16)).err();
    let Some(SessionError::Channels {
        source: ChannelError::Memory {
            got, most, needed, ..
        },
    }) = refused
    else {
        panic!("{refused:?}")
    };
    assert!(got == 16 && (1..16).contains(&most) && needed > one);
    for (bytes, seen) in [(one, u32::try_from(most).unwrap()), (needed, 16)] {
        let mut session = Session::new(&gpu, source.clone(), of(bytes, seen)).unwrap();
        let view = View {
            lod_bias: -2.0,
            ..view(source.as_ref())
        };
        let status = session.settle(&view, PATIENCE).await.unwrap();
        assert!(status.complete && status.memory.total() <= bytes);
        assert!(status.memory_bias > 0.0, "all fits anyway");
        // One more is refused, and those that are seen stay.
        if let Err(error) = session.set_visible(seen, true) {
            let is = session.channels().iter().filter(|c| c.visible).count();
            assert_eq!(is, seen as usize, "{error}");
        } else {
            assert!(seen < 16, "there is no seventeenth");
            panic!("{} channels fit", seen + 1);
        }
    }
}

/// An image without coarser levels.
#[tokio::test(flavor = "multi_thread")]
async fn what_no_level_makes_fit_ends_the_wait_and_says_what_would() {
    let Some(gpu) = test_gpu().await else { return };
    let extent = UVec3::new(330, 290, 150);
    let volume = Volume::new("flat", extent, DVec3::new(4.0, 4.0, 8.0)).unwrap();
    let source = Arc::new(Channels(Arc::new(Volume {
        levels: volume.levels[..1].to_vec(),
        ..volume
    })));
    let of = |gpu_bytes| SessionOptions {
        gpu_bytes,
        ..options()
    };
    let see_through = TransferFunction {
        polarity: Polarity::Bright,
        color_map: ColorMap::Gray,
        window: [0.0, 1.0],
        opacity: vec![OpacityPoint {
            value: 0.0,
            opacity: 0.001,
        }],
        opacity_length_nm: 1e5,
    };
    let all = view(source.as_ref());
    let mut session = Session::new(&gpu, source.clone(), of(6 << 20)).unwrap();
    session
        .set_transfer_function(0, see_through.clone())
        .unwrap();
    let refused = session.settle(&all, PATIENCE).await.unwrap_err();
    let SettleError::TooMuch { source: why, .. } = refused else {
        panic!("{refused:?}")
    };
    let status = session.frame(&all);
    assert!(status.settled && !status.complete && !status.drew);
    assert_eq!(status.again, Again::WhenWoken, "nothing is tried for ever");
    assert_eq!(status.progress.failure, Some(why.to_string()));
    let near = View {
        camera: all.camera.zoomed(40.0),
        ..all
    };
    let status = session.settle(&near, PATIENCE).await.unwrap();
    assert!(status.complete && status.progress.failure.is_none());
    let needed = why.needed.unwrap();
    let mut session = Session::new(&gpu, source, of(needed)).unwrap();
    session.set_transfer_function(0, see_through).unwrap();
    assert!(session.settle(&all, PATIENCE).await.unwrap().complete);
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
