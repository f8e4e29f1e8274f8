//! Exports that were interrupted, of volumes that changed before they went on.

use super::*;
use crate::ChangeReason;

/// Remembers what has changed, unless it forgets.
struct Live {
    array: ArraySource,
    changed: Mutex<Vec<Change>>,
    forgets: bool,
}

impl Live {
    fn new(forgets: bool) -> Arc<Self> {
        Arc::new(Self {
            array: array(UVec3::new(300, 140, 20)),
            changed: Mutex::default(),
            forgets,
        })
    }

    fn set(&self, voxels: VoxelBox, value: u8) {
        let values = vec![value; usize::try_from(voxels.voxels()).unwrap()];
        let revision = self.array.set(voxels, &values).unwrap();
        self.changed.lock().unwrap().push(Change {
            revision,
            voxels,
            reason: ChangeReason::Tile,
        });
    }
}

impl VolumeSource for Live {
    fn volume(&self) -> &Arc<Volume> {
        self.array.volume()
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        self.array.read(id)
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        self.array.changes()
    }

    fn revision(&self) -> u64 {
        self.array.revision()
    }

    fn changes_after(&self, revision: u64) -> BoxFuture<'_, Option<Vec<Change>>> {
        let changed = self.changed.lock().unwrap();
        let after = changed.iter().filter(|change| change.revision > revision);
        let after = (!self.forgets).then(|| after.copied().collect());
        Box::pin(std::future::ready(after))
    }
}

fn exported(source: &Arc<Live>, storage: &dyn Storage) -> Result<ExportProgress, ExportError> {
    let source: Arc<dyn VolumeSource> = source.clone();
    run(export(&source, storage, &ExportOptions::default(), &|_| {}))
}

fn corner() -> VoxelBox {
    VoxelBox::new(UVec3::new(290, 3, 3), UVec3::new(295, 9, 8))
}

fn touched(source: &Live, voxels: VoxelBox) -> Vec<String> {
    let plan = Plan::new(source.volume(), &ExportOptions::default()).unwrap();
    plan.touched(voxels).map(ShardId::key).collect()
}

/// Wherever it ended before, and wherever the second attempt ends: what is there at last is of one state.
#[test]
fn what_has_changed_is_exported_again_and_nothing_else() {
    let (mut most, mut most_outdated) = (0, 0);
    for forgets in [false, true] {
        for first in 2..12 {
            for second in [None, Some(0), Some(1), Some(2), Some(5)] {
                let source = Live::new(forgets);
                source.set(VoxelBox::new(UVec3::ZERO, UVec3::splat(9)), 200);
                let storage = FaultyStorage::new(Arc::new(MemoryStorage::new()));
                storage.fail_write(first, WriteFault::CrashBefore);
                exported(&source, &storage).unwrap_err();
                storage.restart();
                let before = names(&storage);
                source.set(corner(), 77);
                if let Some(nth) = second {
                    storage.fail_write(nth, WriteFault::CrashBefore);
                    let failed = exported(&source, &storage);
                    storage.restart();
                    if failed.is_ok() {
                        continue;
                    }
                }
                let case = format!("{forgets} {first} {second:?}");
                let done = exported(&source, &storage).unwrap();
                let fresh = MemoryStorage::new();
                exported(&source, &fresh).unwrap();
                assert!(image(&storage) == image(&fresh), "a mixture: {case}");
                if second.is_some() {
                    continue;
                }
                let there = before.iter().filter(|name| name.contains("/c/"));
                let touched = touched(&source, corner());
                let (outdated, right): (Vec<_>, Vec<_>) =
                    there.partition(|name| touched.contains(name));
                let kept = if forgets { 0 } else { right.len() as u64 };
                assert_eq!(done.kept, kept, "{case}: {before:?}");
                assert_eq!(done.done, done.shards, "{case}");
                (most, most_outdated) = (most.max(kept), most_outdated.max(outdated.len()));
            }
        }
    }
    assert!(most > 3 && most_outdated > 1, "{most} {most_outdated}");
}

/// A volume that is at an earlier revision than the export was begun at is another, or was restored.
#[test]
fn a_volume_that_went_back_is_exported_anew() {
    let (earlier, later) = (Live::new(false), Live::new(false));
    later.set(corner(), 77);
    let storage = FaultyStorage::new(Arc::new(MemoryStorage::new()));
    storage.fail_write(6, WriteFault::Fail);
    exported(&later, &storage).unwrap_err();
    let done = exported(&earlier, &storage).unwrap();
    assert_eq!(done.kept, 0);
    let fresh = MemoryStorage::new();
    exported(&earlier, &fresh).unwrap();
    assert!(image(&storage) == image(&fresh));
}

/// The root's description can be lost as anything can; what is exported is said beside the finest level, too.
#[test]
fn an_export_that_lost_its_root_goes_on() {
    let source = Live::new(false);
    source.set(VoxelBox::new(UVec3::ZERO, UVec3::splat(9)), 200);
    let storage = MemoryStorage::new();
    exported(&source, &storage).unwrap();
    let whole = image(&storage);
    for missing in [GROUP, "1/zarr.json"] {
        run(storage.delete(missing)).unwrap();
    }
    let shards = run(storage.list("0/c/")).unwrap();
    run(storage.delete(&shards[0])).unwrap();
    let mended = exported(&source, &storage).unwrap();
    assert_eq!((mended.was_whole, mended.again), (false, 0));
    assert_eq!(mended.kept + mended.empty + 1, mended.shards, "{mended:?}");
    assert!(image(&storage) == whole);
    assert!(exported(&source, &storage).unwrap().was_whole);

    // Not as another export, nor with what has changed since.
    run(storage.delete(GROUP)).unwrap();
    let volume: Arc<dyn VolumeSource> = source.clone();
    let other = ExportOptions {
        compression: 0,
        ..ExportOptions::default()
    };
    let refused = run(export(&volume, &storage, &other, &|_| {})).unwrap_err();
    assert!(
        matches!(&refused, ExportError::Other { differences } if differences.contains("compression")),
        "{refused:?}"
    );
    source.set(corner(), 77);
    let outdated = touched(&source, corner()).len() as u64;
    let done = exported(&source, &storage).unwrap();
    assert_eq!(done.kept + done.empty + outdated, done.shards, "{done:?}");
    let fresh = MemoryStorage::new();
    exported(&source, &fresh).unwrap();
    assert!(image(&storage) == image(&fresh));

    // Where that is lost, too, or was never there, nobody knows what the shards are of.
    for group in [GROUP, "0/zarr.json"] {
        run(storage.delete(group)).unwrap();
    }
    let refused = exported(&source, &storage).unwrap_err();
    assert!(matches!(refused, ExportError::Exists), "{refused:?}");
}

/// What earlier versions wrote says so in its root alone.
#[test]
fn an_export_whose_levels_do_not_say_what_they_are_of_is_whole() {
    let source = Live::new(false);
    source.set(VoxelBox::new(UVec3::ZERO, UVec3::splat(9)), 200);
    let storage = MemoryStorage::new();
    exported(&source, &storage).unwrap();
    let said = run(storage.read("0/zarr.json", None)).unwrap();
    let mut said: serde_json::Value = serde_json::from_slice(&said).unwrap();
    assert!(said["attributes"][OURS].is_object());
    said["attributes"] = serde_json::json!({});
    run(storage.write_durable("0/zarr.json", pretty(&said))).unwrap();
    assert!(exported(&source, &storage).unwrap().was_whole);
    said["attributes"] = serde_json::json!({"note": "edited"});
    run(storage.write_durable("0/zarr.json", pretty(&said))).unwrap();
    assert!(!exported(&source, &storage).unwrap().was_whole);
}
