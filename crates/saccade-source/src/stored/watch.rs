//! Notices that what is stored has changed.
//!
//! Nobody tells of changes in files. But what is read again, since there was no room to keep it, may be another than it was: then
//! those who have kept it elsewhere, under a tag, have to hear of that. An object of several pieces (a shard) that is found to be
//! another, or to have come, is told as a whole ([`super::Replaced`]), and nothing is kept of its pieces.

use std::collections::HashMap;
use std::sync::Arc;

use quick_cache::sync::Cache;
use saccade_core::voxel_box::VoxelBox;

use super::{Piece, PieceError, PieceId, Pieces};
use crate::changes::Changes;
use crate::limits::KNOWN_PIECES;
use crate::maybe_send::BoxStream;
use crate::{Change, ChangeReason};

/// What pieces held when they were read last.
#[derive(Clone)]
pub(super) struct Watch {
    known: Arc<Cache<PieceId, u64>>,
    changes: Arc<Changes>,
}

impl Watch {
    /// For a volume of these level-0 voxels.
    pub(super) fn new(whole: VoxelBox) -> Self {
        Self {
            known: Arc::new(Cache::new(KNOWN_PIECES)),
            changes: Changes::new(whole, 0),
        }
    }

    pub(super) fn revision(&self) -> u64 {
        self.changes.revision()
    }

    pub(super) fn stream(&self) -> BoxStream<'static, Change> {
        self.changes.stream()
    }

    /// The same work, of which it is told what has changed before anybody gets it. `places` are the level-0 voxels of pieces.
    pub(super) fn over(&self, places: Arc<HashMap<PieceId, VoxelBox>>, work: Pieces) -> Pieces {
        let this = self.clone();
        Box::pin(async move {
            let done = work.await;
            for (id, outcome) in &done {
                if let Some(voxels) = places.get(id) {
                    this.see(*id, outcome, *voxels);
                }
            }
            done
        })
    }

    /// Tells that an object of several pieces is another; which of them are, nobody knows.
    pub(super) fn replaced(&self, is_in: impl Fn(&PieceId) -> bool, voxels: VoxelBox) {
        self.known.retain(|id, _| !is_in(id));
        log::info!("voxels were replaced, or came, where the image is kept: {voxels}");
        self.changes.send_next(voxels, ChangeReason::Tile);
    }

    fn see(&self, id: PieceId, outcome: &Result<Piece, PieceError>, voxels: VoxelBox) {
        // What fails says nothing of what is there.
        let Ok(piece) = outcome else { return };
        let now = mark(piece);
        let before = self.known.get(&id);
        if before == Some(now) {
            return;
        }
        self.known.insert(id, now);
        if before.is_some() {
            log::info!("voxels were replaced where the image is kept: {voxels}");
            self.changes.send_next(voxels, ChangeReason::Tile);
        }
    }
}

/// Tells what pieces hold apart, as good as certainly: the checksums of both halves.
fn mark(piece: &Piece) -> u64 {
    match piece {
        Piece::Uniform(value) => u64::from(*value),
        Piece::Values(values) => {
            let (first, second) = values.split_at(values.len() / 2);
            u64::from(crc32c::crc32c(first)) << 32 | u64::from(crc32c::crc32c(second))
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;
    use std::time::Duration;

    use bytes::Bytes;
    use futures::{FutureExt as _, StreamExt as _};
    use glam::{DVec3, UVec3};
    use pollster::block_on;
    use saccade_core::volume::Volume;

    use super::super::{Place, Placed, Stored, StoredSource};
    use super::*;
    use crate::values::{Number, Values};
    use crate::{Chunk, ChunkId, VolumeSource as _};

    const PIECE: UVec3 = UVec3::new(8, 8, 4);

    /// Two pieces beside each other in each of two levels.
    struct Shelf {
        volume: Arc<Volume>,
        values: Values,
        pieces: Arc<Mutex<HashMap<PieceId, Option<u8>>>>,
    }

    impl Stored for Shelf {
        fn volume(&self) -> &Arc<Volume> {
            &self.volume
        }

        fn values(&self) -> &Values {
            &self.values
        }

        fn placed(&self, level: u32) -> Placed {
            let extent = self.volume.levels[level as usize].extent;
            Placed::new(extent, DVec3::ZERO, 0.5)
        }

        fn touched(&self, _: u32, level: u32, voxels: VoxelBox) -> Vec<(PieceId, Place)> {
            let each = voxels.cells(PIECE).map(|at| {
                let min = at * PIECE;
                let place = Place {
                    voxels: VoxelBox::new(min, min + PIECE),
                    strides: [1, 8, 64],
                    offset: 0,
                };
                let number = u64::from(at.x);
                (PieceId { level, number }, place)
            });
            each.collect()
        }

        fn read(self: &Arc<Self>, pieces: Vec<PieceId>) -> Vec<(Vec<PieceId>, Pieces)> {
            let stored = self.pieces.lock().unwrap();
            let one = |id: &PieceId| match stored[id] {
                Some(value) => {
                    let values = vec![value; PIECE.element_product() as usize];
                    (*id, Ok(Piece::Values(Bytes::from(values))))
                }
                None => (*id, Ok(Piece::Uniform(0))),
            };
            let done: Vec<_> = pieces.iter().map(one).collect();
            vec![(pieces, Box::pin(std::future::ready(done)))]
        }
    }

    #[test]
    fn what_is_another_when_it_is_read_again_is_told() {
        let mut volume = Volume::new("v", UVec3::new(32, 8, 4), DVec3::splat(4.0)).unwrap();
        volume.chunk = UVec3::new(16, 8, 4);
        let mut coarse = volume.levels[0];
        (coarse.extent, coarse.downsampling) = (UVec3::new(16, 8, 4), DVec3::new(2.0, 1.0, 1.0));
        volume.levels = vec![volume.levels[0], coarse];
        let pieces = Arc::new(Mutex::new(HashMap::new()));
        for (level, number) in [(0, 0), (0, 1), (0, 2), (0, 3), (1, 0), (1, 1)] {
            pieces
                .lock()
                .unwrap()
                .insert(PieceId { level, number }, Some(7));
        }
        let shelf = Shelf {
            volume: Arc::new(volume),
            values: Values::kept(Number::U8, false).unwrap(),
            pieces: pieces.clone(),
        };
        // Nothing is kept: what there was no room for is read again.
        let source = StoredSource::keeping(shelf, 0, 1, Duration::ZERO);
        let mut changes = source.changes();
        let mut read = |level, x| {
            let id = ChunkId {
                channel: 0,
                level,
                chunk: UVec3::new(x, 0, 0),
            };
            let read = block_on(source.read(id)).unwrap();
            let told = changes.next().now_or_never().flatten();
            let Chunk::Voxels(voxels) = read else {
                panic!("it is empty")
            };
            (
                (voxels[0], voxels[15]),
                told.map(|change| (change.revision, change.voxels)),
            )
        };
        for _ in 0..2 {
            for (level, x) in [(0, 0), (0, 1), (1, 0)] {
                assert_eq!(read(level, x), ((7, 7), None));
            }
        }
        let put = |level, number, value| {
            pieces
                .lock()
                .unwrap()
                .insert(PieceId { level, number }, value);
        };
        put(0, 3, Some(9));
        assert_eq!(read(0, 0), ((7, 7), None));
        let piece = VoxelBox::new(UVec3::new(24, 0, 0), UVec3::new(32, 8, 4));
        assert_eq!(read(0, 1), ((7, 9), Some((1, piece))));
        assert_eq!(read(0, 1), ((7, 9), None));
        // Gone, and of another level.
        put(1, 0, None);
        let piece = VoxelBox::new(UVec3::ZERO, UVec3::new(16, 8, 4));
        assert_eq!(read(1, 0), ((0, 7), Some((2, piece))));
        assert_eq!(source.revision(), 2);
    }
}
