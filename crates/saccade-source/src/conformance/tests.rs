//! Negative controls: each wrong source breaks the rule it should break.

#![allow(clippy::cast_possible_truncation, reason = "test volumes are small")]

use std::sync::Arc;

use bytes::Bytes;
use futures::StreamExt;
use glam::{DVec3, UVec3};
use pollster::block_on;
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;

use super::*;
use crate::maybe_send::{BoxFuture, BoxStream};
use crate::memory::ArraySource;
use crate::{Change, ChangeReason, ValueRange};

/// What a wrong source does wrong.
#[derive(Clone, Copy, PartialEq)]
enum Wrong {
    Nothing,
    Short,
    Padding,
    Shifted,
    Unbounded,
    Range,
    Nowhere,
    Found,
    Stale,
    Backwards,
    PartlyMissed,
    Forgetful,
    AllKnowing,
    Ignorant,
}

struct WrongSource {
    inner: ArraySource,
    wrong: Wrong,
    stale: std::sync::Mutex<std::collections::HashMap<ChunkId, Chunk>>,
}

impl VolumeSource for WrongSource {
    fn volume(&self) -> &Arc<Volume> {
        self.inner.volume()
    }

    fn read(&self, id: ChunkId) -> BoxFuture<'_, Result<Chunk, ChunkError>> {
        Box::pin(async move {
            let full = self.volume().chunk.as_usizevec3().element_product();
            let answer = self.inner.read(id).await;
            if self.wrong == Wrong::Unbounded && answer.is_err() {
                return Ok(Chunk::Empty);
            }
            let Chunk::Voxels(bytes) = answer? else {
                return Ok(Chunk::Empty);
            };
            let mut bytes = bytes.to_vec();
            match self.wrong {
                Wrong::Short => bytes.truncate(full - 1),
                Wrong::Padding if bytes.ends_with(&[0]) => bytes[full - 1] = 1,
                Wrong::Shifted => bytes.rotate_right(1),
                _ => {}
            }
            let chunk = Chunk::Voxels(Bytes::from(bytes));
            if self.wrong == Wrong::Stale {
                let mut stale = self.stale.lock().unwrap();
                return Ok(stale.entry(id).or_insert(chunk).clone());
            }
            Ok(chunk)
        })
    }

    fn changes(&self) -> BoxStream<'static, Change> {
        let wrong = self.wrong;
        Box::pin(self.inner.changes().map(move |mut change| {
            match wrong {
                Wrong::Backwards => change.revision = 100 - change.revision,
                Wrong::PartlyMissed => {
                    change.reason = ChangeReason::Missed;
                    change.voxels.max.x -= 1;
                }
                _ => {}
            }
            change
        }))
    }

    fn revision(&self) -> u64 {
        self.inner.revision()
    }

    fn changes_after(&self, revision: u64) -> BoxFuture<'_, Option<Vec<Change>>> {
        Box::pin(async move {
            let mut told = self.inner.changes_after(revision).await;
            match (self.wrong, &mut told) {
                (Wrong::Forgetful, Some(told)) if !told.is_empty() => drop(told.remove(0)),
                (Wrong::AllKnowing, None) => told = Some(Vec::new()),
                (Wrong::Ignorant, told) => *told = None,
                _ => {}
            }
            told
        })
    }

    fn value_range(&self, id: ChunkId) -> Option<ValueRange> {
        let mut range = self.inner.value_range(id)?;
        range.max -= u16::from(self.wrong == Wrong::Range);
        Some(range)
    }

    fn find_value_range(
        &self,
        id: ChunkId,
    ) -> BoxFuture<'_, Result<Option<ValueRange>, ChunkError>> {
        Box::pin(async move {
            let mut found = self.inner.find_value_range(id).await;
            match (self.wrong, &mut found) {
                (Wrong::Nowhere, Ok(found)) => *found = None,
                (Wrong::Found, Ok(Some(found))) => found.min += 1,
                (Wrong::Unbounded, Err(_)) => return Ok(None),
                _ => {}
            }
            found
        })
    }
}

fn outcome(wrong: Wrong) -> Result<(), Violation> {
    let mut volume = Volume::new("v", UVec3::new(35, 9, 7), DVec3::new(4.0, 4.0, 8.0)).unwrap();
    volume.chunk = UVec3::new(16, 8, 4);
    let level0: Vec<u8> = (0..35 * 9 * 7).map(|n| (n % 251 + 1) as u8).collect();
    let truth = ArraySource::new(volume.clone(), level0.clone()).unwrap();
    let oracle = |id| block_on(read_bytes(&truth, id)).unwrap();
    let source = WrongSource {
        inner: ArraySource::new(volume, level0).unwrap(),
        wrong,
        stale: Default::default(),
    };
    let mut value = 0;
    let change = async || {
        value += 50;
        let touched = VoxelBox::of_size(source.volume().extent());
        let values = vec![value; touched.voxels() as usize];
        truth.set(touched, &values).unwrap();
        source.inner.set(touched, &values).unwrap();
        touched
    };
    block_on(async {
        check_reading(&source, oracle, 0).await?;
        check_changes(&source, 3, change, oracle, 0).await?;
        let mut x = 0;
        let change = async || {
            x += 3;
            let touched = VoxelBox::new(UVec3::new(x, 1, 1), UVec3::new(x + 2, 5, 6));
            let values = vec![7; touched.voxels() as usize];
            source.inner.set(touched, &values).unwrap();
            touched
        };
        check_changes_after(&source, change).await
    })
}

#[test]
fn a_right_source_conforms() {
    assert_eq!(outcome(Wrong::Nothing), Ok(()));
}

#[test]
fn wrong_sources_do_not() {
    for (wrong, rule) in [
        (Wrong::Short, "deliver full chunks"),
        (Wrong::Padding, "pad with 0 past the volume's end"),
        (Wrong::Shifted, "deliver the right voxels"),
        (Wrong::Unbounded, "refuse chunks that do not exist"),
        (Wrong::Range, "give bounds that hold"),
        (Wrong::Found, "give bounds that hold"),
        (
            Wrong::Nowhere,
            "say that nothing was acquired only where nothing was",
        ),
        (Wrong::Stale, "deliver the right voxels"),
        (Wrong::Backwards, "tell changes in order of revision"),
        (
            Wrong::PartlyMissed,
            "cover everything when changes were missed",
        ),
        (Wrong::Forgetful, "tell what has changed since a revision"),
        (Wrong::AllKnowing, "tell what has changed since a revision"),
        (Wrong::Ignorant, "tell what has changed since a revision"),
    ] {
        assert_eq!(outcome(wrong).unwrap_err().rule, rule);
    }
}
