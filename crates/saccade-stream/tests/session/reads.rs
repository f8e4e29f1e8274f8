//! What is read, and what is not: hidden values, channels that nobody looks at.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use glam::{DVec3, UVec3};
use saccade_core::transfer::{ColorMap, OpacityPoint, TransferFunction};
use saccade_core::volume::{Polarity, Volume};
use saccade_core::voxel_box::VoxelBox;
use saccade_render::View;
use saccade_source::maybe_send::{BoxFuture, BoxStream};
use saccade_source::memory::ArraySource;
use saccade_source::{Change, Chunk, ChunkError, ChunkId, ValueRange, VolumeSource};
use saccade_stream::Session;

use crate::{EXTENT, options, picture, source, test_gpu, value, view};

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
