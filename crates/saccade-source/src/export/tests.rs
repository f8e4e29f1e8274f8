mod resumed;
mod slow;

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};

use futures::stream;
use glam::{DVec3, UVec3};
use saccade_archive::storage::{FaultyStorage, LocalStorage, MemoryStorage, Storage, WriteFault};
use saccade_core::volume::{Dtype, Volume};
use saccade_core::voxel_box::VoxelBox;
use zarrs::array::{Array, ArrayBytes, ArraySubset};
use zarrs::filesystem::FilesystemStore;
use zarrs::storage::store::MemoryStore;
use zarrs::storage::{StoreKey, WritableStorageTraits};

use super::*;
use crate::maybe_send::{BoxFuture, BoxStream};
use crate::memory::ArraySource;
use crate::{Change, Chunk, ChunkError, ChunkId};

fn run<T>(test: impl Future<Output = T>) -> T {
    let runtime = tokio::runtime::Builder::new_current_thread();
    { runtime }.enable_all().build().unwrap().block_on(test)
}

/// Where the whole of it lies.
const ORIGIN_NM: DVec3 = DVec3::new(-1000.0, 36.0, 0.5);

/// Two channels of 16 bit; what a voxel is worth follows from where it is. Nothing was acquired below
/// z = 4 of level 0's first channel.
struct Formula {
    volume: Arc<Volume>,
    failures: AtomicU32,
    transient: bool,
    /// An id that does not fit, and the level in which it is met first.
    wide: Option<(i128, u32)>,
    met: AtomicBool,
}

impl Formula {
    fn new(failures: u32, transient: bool) -> Arc<Self> {
        Self::with_ids(failures, transient, None)
    }

    fn with_ids(failures: u32, transient: bool, wide: Option<(i128, u32)>) -> Arc<Self> {
        let extent = UVec3::new(75, 53, 13);
        let mut volume = Volume::new("em", extent, DVec3::new(4.0, 4.0, 8.0)).unwrap();
        volume.channels = ["a", "b", "c"].map(Into::into).into();
        volume.dtype = Dtype::Uint16;
        volume.chunk = UVec3::new(9, 8, 4);
        volume.origin_nm = ORIGIN_NM;
        Arc::new(Self {
            volume: Arc::new(volume),
            failures: AtomicU32::new(failures),
            transient,
            wide,
            met: AtomicBool::new(false),
        })
    }

    fn value(level: u32, channel: u32, at: UVec3) -> u16 {
        if level == 0 && channel == 0 && at.z < 4 {
            return 0;
        }
        let mixed = (at.x * 7 + at.y * 131 + at.z * 1009 + level * 17 + channel * 4099) % 65_521;
        u16::try_from(mixed).unwrap() + 1
    }
}

impl VolumeSource for Formula {
    fn volume(&self) -> &Arc<Volume> {
        &self.volume
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        Box::pin(async move {
            let one_less = |left: u32| left.checked_sub(1);
            let (set, get) = (Ordering::SeqCst, Ordering::SeqCst);
            if self.failures.fetch_update(set, get, one_less).is_ok() {
                return Err(ChunkError::Failed {
                    id,
                    transient: self.transient,
                    source: Arc::new(std::io::Error::other("no luck")),
                });
            }
            if self.wide.is_some_and(|(_, level)| level == id.level) {
                self.met.store(true, Ordering::SeqCst);
            }
            let inside = id
                .voxels(&self.volume)
                .ok_or(ChunkError::OutOfRange { id })?;
            let min = id.chunk * self.volume.chunk;
            let mut bytes = Vec::new();
            for at in VoxelBox::new(min, min + self.volume.chunk).iter() {
                let value = if inside.contains(at) {
                    Self::value(id.level, id.channel, at)
                } else {
                    0
                };
                bytes.extend(value.to_le_bytes());
            }
            Ok(if bytes.iter().all(|byte| *byte == 0) {
                Chunk::Empty
            } else {
                Chunk::Voxels(bytes.into())
            })
        })
    }

    fn renamed_label(&self) -> Option<i128> {
        let (id, _) = self.wide?;
        self.met.load(Ordering::SeqCst).then_some(id)
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        stream::pending().boxed()
    }
}

/// All values of a channel of a level, as another library reads them, x fastest.
fn read_back(folder: &Path, level: usize, channel: u64) -> (UVec3, Vec<u16>) {
    let store = Arc::new(FilesystemStore::new(folder).unwrap());
    let array = Array::open(store, &format!("/{level}")).unwrap();
    let [_, z, y, x] = array.shape()[..] else {
        panic!("not four axes")
    };
    let all = ArraySubset::new_with_ranges(&[channel..channel + 1, 0..z, 0..y, 0..x]);
    let values = array.retrieve_array_subset::<Vec<u16>>(&all).unwrap();
    let size = [x, y, z].map(|n| u32::try_from(n).unwrap());
    (UVec3::from_array(size), values)
}

fn group(folder: &Path) -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(folder.join("zarr.json")).unwrap()).unwrap()
}

#[test]
fn every_voxel_of_every_level_is_where_it_was() {
    let parts = [
        (None, None, 0),
        (
            Some(VoxelBox::new(UVec3::new(11, 3, 5), UVec3::new(58, 999, 12))),
            Some(vec![2, 0]),
            0,
        ),
        (
            Some(VoxelBox::new(UVec3::new(31, 17, 2), UVec3::new(32, 18, 3))),
            Some(vec![1]),
            1,
        ),
    ];
    for (region, channels, finest) in parts {
        let folder = tempfile::tempdir().unwrap();
        let source: Arc<dyn VolumeSource> = Formula::new(0, true);
        let options = ExportOptions {
            region,
            channels: channels.clone(),
            finest,
            ..ExportOptions::default()
        };
        let storage = LocalStorage::new(folder.path()).unwrap();
        let done = run(export(&source, &storage, &options, &|_| {})).unwrap();
        assert_eq!((done.done, done.again, done.kept), (done.shards, 0, 0));

        let volume = source.volume();
        let whole = VoxelBox::of_size(volume.extent());
        let part = region.unwrap_or(whole).intersection(whole);
        let image = &group(folder.path())["attributes"]["ome"]["multiscales"][0];
        let datasets = image["datasets"].as_array().unwrap();
        for (n, dataset) in datasets.iter().enumerate() {
            let level = finest + u32::try_from(n).unwrap();
            let geometry = volume.levels[level as usize];
            let voxels = geometry.box_from_voxels(part);
            let transforms = &dataset["coordinateTransformations"];
            let placed = |axis: usize, i: usize| {
                let scale = transforms[0]["scale"][axis].as_f64().unwrap();
                let moved = transforms[1]["translation"][axis].as_f64().unwrap_or(0.0);
                // The first edge, from that of the volume [level-0 voxels].
                let edge = (moved - ORIGIN_NM[i] - scale / 2.0) / volume.voxel_nm[i] + 0.5;
                assert_eq!(edge, f64::from(voxels.min[i]) * geometry.downsampling[i]);
                assert_eq!(scale, volume.voxel_nm[i] * geometry.downsampling[i]);
            };
            for (axis, i) in [(3, 0), (2, 1), (1, 2)] {
                placed(axis, i);
            }
            for (c, channel) in channels
                .clone()
                .unwrap_or(vec![0, 1, 2])
                .into_iter()
                .enumerate()
            {
                let (size, values) = read_back(folder.path(), n, c as u64);
                assert_eq!(size, voxels.size());
                let expected = voxels.iter().map(|at| Formula::value(level, channel, at));
                assert!(
                    values.into_iter().eq(expected),
                    "level {level} channel {channel}"
                );
            }
        }
        assert!(!folder.path().join(UNFINISHED).exists());
    }
}

#[test]
fn what_was_not_acquired_takes_no_space() {
    let source: Arc<dyn VolumeSource> = Formula::new(0, true);
    let region = VoxelBox::new(UVec3::ZERO, UVec3::new(75, 53, 3));
    let options = ExportOptions {
        region: Some(region),
        channels: Some(vec![0]),
        ..ExportOptions::default()
    };
    let storage = MemoryStorage::new();
    let done = run(export(&source, &storage, &options, &|_| {})).unwrap();
    assert!(done.empty > 0 && done.empty < done.shards, "{done:?}");
    let shards = |level: u32| run(storage.list(&format!("{level}/c/"))).unwrap();
    assert_eq!(shards(0), Vec::<String>::new());
    assert!(!shards(1).is_empty());
}

fn names(storage: &dyn Storage) -> Vec<String> {
    run(storage.list("")).unwrap()
}

/// Names of all objects, and the image in them, decoded: where chunks are in a shard is left to chance.
fn image(storage: &dyn Storage) -> (Vec<String>, Vec<Vec<u8>>) {
    let (names, store) = (names(storage), Arc::new(MemoryStore::new()));
    for name in &names {
        let bytes = run(storage.read(name, None)).unwrap();
        store.set(&StoreKey::new(name).unwrap(), bytes).unwrap();
    }
    let arrays = names
        .iter()
        .filter_map(|name| name.strip_suffix("/zarr.json"));
    let levels = arrays.map(|level| {
        let array = Array::open(store.clone(), &format!("/{level}")).unwrap();
        let all = array.subset_all();
        let bytes = array.retrieve_array_subset::<ArrayBytes<'_>>(&all).unwrap();
        bytes.into_fixed().unwrap().into_owned()
    });
    let levels = levels.collect();
    (names, levels)
}

#[test]
fn an_export_that_was_killed_goes_on() {
    let source: Arc<dyn VolumeSource> = Formula::new(0, true);
    let options = ExportOptions::default();
    let whole = MemoryStorage::new();
    let all = run(export(&source, &whole, &options, &|_| {})).unwrap();
    let expected = image(&whole);
    assert!(expected.1.len() > 1 && expected.1.iter().all(|level| level.iter().any(|v| *v != 0)));
    let mut kept = Vec::new();
    for nth in 0..expected.0.len() as u64 + 1 {
        for fault in [WriteFault::CrashBefore, WriteFault::Full] {
            let inner = Arc::new(MemoryStorage::new());
            let storage = FaultyStorage::new(inner.clone());
            storage.fail_write(nth, fault);
            let failed = run(export(&source, &storage, &options, &|_| {}));
            let Err(ExportError::Write { .. }) = failed else {
                panic!("write {nth}: {failed:?}")
            };
            let whole = names(&*inner).contains(&GROUP.to_owned());
            assert!(!whole, "taken for whole after write {nth}");
            storage.restart();
            let done = run(export(&source, &storage, &options, &|_| {})).unwrap();
            assert!(image(&*inner) == expected, "after write {nth}");
            assert_eq!((done.shards, done.done), (all.shards, all.shards));
            kept.push(done.kept);
        }
    }
    assert_eq!(kept.iter().max(), Some(&(all.shards - all.empty)));
}

#[test]
fn what_is_there_is_not_mixed_with_something_else() {
    let source: Arc<dyn VolumeSource> = Formula::new(0, true);
    let options = ExportOptions::default();
    let storage = FaultyStorage::new(Arc::new(MemoryStorage::new()));
    storage.fail_write(3, WriteFault::Fail);
    run(export(&source, &storage, &options, &|_| {})).unwrap_err();
    let other = ExportOptions {
        compression: 0,
        ..options.clone()
    };
    let refused = run(export(&source, &storage, &other, &|_| {}));
    assert!(
        matches!(&refused, Err(ExportError::Other { differences }) if differences == "compression 3 there, none now"),
        "{refused:?}"
    );
    let other = ExportOptions {
        region: Some(VoxelBox::new(UVec3::new(1, 2, 3), UVec3::splat(20))),
        channels: Some(vec![1]),
        ..options.clone()
    };
    let refused = run(export(&source, &storage, &other, &|_| {})).unwrap_err();
    let text = refused.to_string();
    assert!(text.contains("channels 0,1,2 there, 1 now"), "{text}");
    assert!(text.contains("1,2,3,20,20,13 now"), "{text}");
    assert!(text.len() < 400, "{text}");
    let done = run(export(&source, &storage, &options, &|_| {})).unwrap();
    assert!(!done.was_whole);
    let before = image(&storage);
    let again = run(export(&source, &storage, &options, &|_| {})).unwrap();
    assert!(again.was_whole && again.done == again.shards && again.bytes == 0);
    assert!(image(&storage) == before);
    for (other, there) in [(other, &storage as &dyn Storage), (options, &foreign())] {
        let refused = run(export(&source, there, &other, &|_| {}));
        assert!(matches!(refused, Err(ExportError::Exists)), "{refused:?}");
    }
}

/// An image that somebody else wrote.
fn foreign() -> MemoryStorage {
    let storage = MemoryStorage::new();
    run(storage.write_durable(GROUP, "{\"attributes\": {}}".into())).unwrap();
    storage
}

#[test]
fn ids_without_room_are_not_written() {
    let storage = MemoryStorage::new();
    let options = ExportOptions::default();
    // Met in the finest level, after the coarse ones are written.
    let source = || -> Arc<dyn VolumeSource> { Formula::with_ids(0, true, Some((70_000, 0))) };
    for _ in 0..2 {
        let refused = run(export(&source(), &storage, &options, &|_| {})).unwrap_err();
        assert!(
            refused.to_string().contains("ids such as 70000"),
            "{refused}"
        );
        let finest = run(storage.list("0/c/")).unwrap();
        assert!(
            finest.is_empty(),
            "an attempt that goes on would keep them: {finest:?}"
        );
        assert!(!names(&storage).contains(&GROUP.to_owned()));
    }
    let allowed = ExportOptions {
        rename_labels: true,
        ..options.clone()
    };
    // What was written has only ids that fit, so that it is kept.
    let coarse = run(storage.list("1/c/")).unwrap().len() as u64;
    let done = run(export(&source(), &storage, &allowed, &|_| {})).unwrap();
    assert!(coarse > 0 && done.kept >= coarse, "{done:?}");
    let fresh = MemoryStorage::new();
    run(export(&source(), &fresh, &allowed, &|_| {})).unwrap();
    assert!(image(&storage) == image(&fresh));
    let narrow: Arc<dyn VolumeSource> = Formula::new(0, true);
    run(export(&narrow, &MemoryStorage::new(), &options, &|_| {})).unwrap();
}

/// Without a word nobody's ids become others, also not where somebody had allowed it before.
#[test]
fn what_may_have_other_ids_is_not_gone_on_with_as_if_it_had_not() {
    let storage = FaultyStorage::new(Arc::new(MemoryStorage::new()));
    let source: Arc<dyn VolumeSource> = Formula::with_ids(0, true, Some((70_000, 0)));
    let allowed = ExportOptions {
        rename_labels: true,
        ..ExportOptions::default()
    };
    storage.fail_write(3, WriteFault::Fail);
    run(export(&source, &storage, &allowed, &|_| {})).unwrap_err();
    let strict = ExportOptions::default();
    let other = run(export(&source, &storage, &strict, &|_| {})).unwrap_err();
    assert!(
        other.to_string().contains("renamed: true there, false now"),
        "{other}"
    );
    run(export(&source, &storage, &allowed, &|_| {})).unwrap();
    let taken = run(export(&source, &storage, &strict, &|_| {})).unwrap_err();
    assert!(matches!(taken, ExportError::Exists), "{taken:?}");

    // One that is whole though it was not allowed is what it would be if it were, also begun before and gone on with.
    let narrow: Arc<dyn VolumeSource> = Formula::new(0, true);
    let storage = FaultyStorage::new(Arc::new(MemoryStorage::new()));
    storage.fail_write(3, WriteFault::Fail);
    run(export(&narrow, &storage, &strict, &|_| {})).unwrap_err();
    storage.fail_write(1, WriteFault::Fail);
    run(export(&narrow, &storage, &allowed, &|_| {})).unwrap_err();
    let other = run(export(&narrow, &storage, &strict, &|_| {})).unwrap_err();
    assert!(matches!(other, ExportError::Other { .. }), "{other:?}");
    let storage = MemoryStorage::new();
    run(export(&narrow, &storage, &strict, &|_| {})).unwrap();
    let again = run(export(&narrow, &storage, &allowed, &|_| {})).unwrap();
    assert!(again.was_whole);
}

/// That it was whole once does not mean that it is.
#[test]
fn what_was_taken_from_a_whole_export_is_exported_again() {
    let source: Arc<dyn VolumeSource> = Formula::new(0, true);
    let region = VoxelBox::new(UVec3::ZERO, UVec3::new(75, 53, 3));
    let options = ExportOptions {
        region: Some(region),
        ..ExportOptions::default()
    };
    let storage = MemoryStorage::new();
    let again = || run(export(&source, &storage, &options, &|_| {})).unwrap();
    let first = again();
    assert!(
        first.empty > 0,
        "what holds nothing is not missed: {first:?}"
    );
    let whole = image(&storage);
    assert!(again().was_whole);
    let shards = run(storage.list("0/c/1/")).unwrap();
    run(storage.delete(&shards[0])).unwrap();
    let mended = again();
    assert!(!mended.was_whole && mended.bytes > 0, "{mended:?}");
    assert_eq!(mended.kept + mended.empty + 1, mended.shards);
    assert!(image(&storage) == whole);
    assert!(again().was_whole);
    run(storage.delete("1/zarr.json")).unwrap();
    let mended = again();
    assert_eq!((mended.was_whole, mended.bytes), (false, 0));
    assert!(image(&storage) == whole && again().was_whole);
    // What is left of a shard, and a description that somebody edited.
    let shard = &run(storage.list("0/c/1/")).unwrap()[0];
    let bytes = run(storage.read(shard, None)).unwrap();
    let mut flipped = bytes.to_vec();
    let in_index = flipped.len() - 9;
    flipped[in_index] ^= 1;
    let (half, short) = (bytes.slice(..bytes.len() / 2), bytes.slice(..3));
    for spoilt in [half, short, Bytes::new(), flipped.into()] {
        run(storage.write_durable(shard, spoilt)).unwrap();
        let mended = again();
        assert!(
            !mended.was_whole && mended.bytes == bytes.len() as u64,
            "{mended:?}"
        );
        assert!(image(&storage) == whole && again().was_whole);
    }
    run(storage.write_durable("1/zarr.json", Bytes::from_static(b"{}"))).unwrap();
    assert!(!again().was_whole);
    assert!(image(&storage) == whole && again().was_whole);
}

#[test]
fn passing_failures_are_waited_out_and_others_named() {
    let options = ExportOptions {
        retry: Duration::from_millis(1),
        ..ExportOptions::default()
    };
    let source: Arc<dyn VolumeSource> = Formula::new(7, true);
    run(export(&source, &MemoryStorage::new(), &options, &|_| {})).unwrap();
    for (failures, transient) in [(1, false), (100_000, true)] {
        let source: Arc<dyn VolumeSource> = Formula::new(failures, transient);
        let failed = run(export(&source, &MemoryStorage::new(), &options, &|_| {}));
        let Err(ExportError::Read { source, .. }) = failed else {
            panic!("{failed:?}")
        };
        assert!(source.to_string().contains("chunk"), "{source}");
    }
}

#[test]
fn what_cannot_be_is_refused_in_words() {
    let source: Arc<dyn VolumeSource> = Formula::new(0, true);
    let refused = |options: ExportOptions| {
        let storage = MemoryStorage::new();
        let refused = run(export(&source, &storage, &options, &|_| {})).unwrap_err();
        assert!(names(&storage).is_empty(), "something was written");
        refused.to_string()
    };
    let default = ExportOptions::default;
    let outside = VoxelBox::new(UVec3::new(75, 0, 0), UVec3::new(80, 5, 5));
    let options = ExportOptions {
        region: Some(outside),
        ..default()
    };
    let told = refused(options);
    assert!(
        told.contains("x 75 to 80, y 0 to 5, z 0 to 5: the volume is x 0 to 75"),
        "{told}"
    );
    for channels in [vec![3], vec![1, 1]] {
        let options = ExportOptions {
            channels: Some(channels),
            ..default()
        };
        assert!(refused(options).contains("a, b, c"));
    }
    let options = ExportOptions {
        finest: 9,
        ..default()
    };
    assert!(refused(options).contains("0 to "));
}

pub(super) fn array(extent: UVec3) -> ArraySource {
    let mut volume = Volume::new("em", extent, DVec3::splat(8.0)).unwrap();
    volume.chunk = UVec3::splat(16);
    let voxels = VoxelBox::of_size(extent).iter();
    let values = voxels.map(|at| u8::try_from((at.x * 3 + at.y + at.z) % 199 + 1).unwrap());
    ArraySource::new(volume, values.collect()).unwrap()
}

#[test]
fn what_changes_meanwhile_is_exported_again() {
    let options = ExportOptions {
        quiet: Duration::from_millis(10),
        ..ExportOptions::default()
    };
    let extent = UVec3::new(300, 40, 20);
    let fixed = array(extent);
    let live = Arc::new(array(extent));
    let changed = VoxelBox::new(UVec3::new(290, 3, 3), UVec3::new(295, 9, 8));
    let new_values = vec![77; usize::try_from(changed.voxels()).unwrap()];
    fixed.set(changed, &new_values).unwrap();
    let expected = MemoryStorage::new();
    let fixed: Arc<dyn VolumeSource> = Arc::new(fixed);
    run(export(&fixed, &expected, &options, &|_| {})).unwrap();

    let storage = MemoryStorage::new();
    let source: Arc<dyn VolumeSource> = live.clone();
    let when = Mutex::new(Some(()));
    let changes_late = |at: ExportProgress| {
        if at.done + 1 == at.shards && when.lock().unwrap().take().is_some() {
            live.set(changed, &new_values).unwrap();
        }
    };
    let done = run(export(&source, &storage, &options, &changes_late)).unwrap();
    assert!(done.again > 0 && done.again < done.shards / 2, "{done:?}");
    assert_eq!(done.done, done.shards);
    assert!(image(&storage) == image(&expected), "a mixture of states");
    let before: Arc<dyn VolumeSource> = Arc::new(array(extent));
    let other = MemoryStorage::new();
    run(export(&before, &other, &options, &|_| {})).unwrap();
    assert!(
        image(&other) != image(&expected),
        "the change does not show"
    );

    // What was exported is of the state after the change, and not of a later one.
    let again = |source| run(export(source, &storage, &options, &|_| {}));
    assert!(again(&source).unwrap().was_whole);
    live.set(changed, &new_values).unwrap();
    let refused = again(&source).unwrap_err().to_string();
    let (there, now) = (live.revision() - 1, live.revision());
    let words = format!("revision {there}; the volume is at {now}");
    assert!(refused.contains(&words), "{refused}");

    // One of which nothing is as it was when it began is begun anew.
    let storage = FaultyStorage::new(Arc::new(MemoryStorage::new()));
    storage.fail_write(4, WriteFault::Fail);
    let exported = || run(export(&source, &storage, &options, &|_| {}));
    exported().unwrap_err();
    assert!(names(&storage).len() > 1, "no shard to keep");
    let whole = VoxelBox::of_size(extent);
    let other_values = vec![78; usize::try_from(whole.voxels()).unwrap()];
    live.set(whole, &other_values).unwrap();
    assert_eq!(exported().unwrap().kept, 0);
    let fresh = MemoryStorage::new();
    run(export(&source, &fresh, &options, &|_| {})).unwrap();
    assert!(image(&storage) == image(&fresh));
}
