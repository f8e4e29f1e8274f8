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
