//! Follows the catalog.

use std::sync::{MutexGuard, PoisonError, Weak};
use std::time::Duration;

use saccade_archive::catalog::{Catalog, CatalogError, ChangeReason};
use saccade_core::voxel_box::VoxelBox;
use tokio::sync::watch;

use super::Inner;
#[cfg(test)]
use super::along_z::Reach;
use crate::Change;

/// When the catalog cannot be read, it is tried again after this.
const TRY_AGAIN: Duration = Duration::from_millis(500);

/// Up to where the catalog was read.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seen {
    /// The newest revision.
    pub(super) revision: u64,
    /// How often the catalog's file had been replaced by then.
    pub(super) replaced: u64,
}

/// How revisions are told. Those of a catalog that took another's place count anew, those that are told never go back.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Counted {
    /// By how much what is told is more than what the catalog says.
    ahead: u64,
    /// The first revision that was told of this catalog.
    from: u64,
}

/// Passes on changes until the source is dropped or the catalog closed.
pub(super) async fn follow(
    inner: Weak<Inner>,
    catalog: Catalog,
    mut news: watch::Receiver<u64>,
    mut seen: Seen,
) {
    let mut told = None;
    loop {
        news.borrow_and_update();
        match catch_up(&inner, &catalog, &mut seen).await {
            Ok(()) => {
                told = None;
                if news.changed().await.is_err() {
                    return;
                }
            }
            Err(error) => {
                let error = error.to_string();
                if told.as_ref() != Some(&error) {
                    log::warn!("changes cannot be read, trying again: {error}");
                    told = Some(error);
                }
                tokio::time::sleep(TRY_AGAIN).await;
            }
        }
        if inner.strong_count() == 0 {
            return;
        }
    }
}

async fn catch_up(
    inner: &Weak<Inner>,
    catalog: &Catalog,
    seen: &mut Seen,
) -> Result<(), CatalogError> {
    while let Some(name) = inner.upgrade().map(|inner| inner.volume.name.clone()) {
        let replaced = catalog.times_replaced();
        if replaced != seen.replaced {
            let entry = catalog.entry(&name).await?;
            let Some(inner) = inner.upgrade() else {
                return Ok(());
            };
            if entry.volume != *inner.volume {
                log::warn!(
                    "volume {name:?} of the catalog that is there now is another than before; open it anew: {}",
                    catalog.location()
                );
            }
            let revision = entry.revision;
            inner.builder.tiles().index().reload().await?;
            inner.builder.tiles().damaged().forget(|_| true);
            inner.count_anew(revision);
            *seen = Seen { revision, replaced };
            continue;
        }
        let changes = match catalog.changes_after(&name, seen.revision).await {
            Err(CatalogError::Missed { revision, .. }) => {
                let Some(inner) = inner.upgrade() else {
                    return Ok(());
                };
                inner.builder.tiles().index().reload().await?;
                inner.builder.tiles().damaged().forget(|_| true);
                inner.tell_missed(revision + inner.counted().ahead);
                seen.revision = revision;
                continue;
            }
            changes => changes?,
        };
        let Some(inner) = inner.upgrade().filter(|_| !changes.is_empty()) else {
            return Ok(());
        };
        // First what is known, then what was built of it, then the news: whoever reads after the
        // news gets neither.
        let (index, reaches) = (inner.builder.tiles().index(), inner.builder.reaches());
        let reached = index.apply(&changes, &reaches).await?;
        #[cfg(test)]
        let reached = match inner.wrong.get() {
            Some(super::tests::Wrong::Filled) => changes
                .iter()
                .map(|change| Reach::own(change.section))
                .collect(),
            _ => reached,
        };
        let changed = |section| changes.iter().any(|change| change.section == section);
        inner.builder.tiles().damaged().forget(changed);
        let ahead = inner.counted().ahead;
        let told = changes.iter().zip(&reached).map(|(change, reach)| Change {
            revision: change.revision + ahead,
            voxels: inner.builder.touched(change.voxels, reach),
            reason: reason(change.reason),
        });
        for change in merged(told.collect()) {
            inner.forget(change.voxels);
            inner.changes.send(change);
            seen.revision = change.revision - ahead;
        }
    }
    Ok(())
}

impl Inner {
    /// What has changed after a revision, as long as the catalog keeps it.
    pub(super) async fn changes_after(&self, revision: u64) -> Option<Vec<Change>> {
        let Counted { ahead, from } = *self.counted();
        // What was told before is of a catalog that is no more.
        let mut revision = revision.checked_sub(ahead).filter(|_| revision >= from)?;
        let (catalog, name) = (self.builder.tiles().index().catalog(), &self.volume.name);
        let mut all = Vec::new();
        let known = async {
            loop {
                let changes = catalog.changes_after(name, revision).await?;
                let Some(last) = changes.last() else {
                    // None are kept at all where this is another one.
                    return Ok(catalog.revision(name).await? == revision);
                };
                revision = last.revision;
                all.extend(changes.iter().map(|change| {
                    // Which sections had their first tile of a channel or lost their last is not kept: each may have.
                    let turned = change.reason != ChangeReason::Transform;
                    let depth = self.volume.extent().z;
                    let reaches = self.builder.reaches();
                    let reach = reaches.at_some_time(change.section, turned, depth);
                    Change {
                        revision: change.revision + ahead,
                        voxels: self.builder.touched(change.voxels, &reach),
                        reason: reason(change.reason),
                    }
                }));
            }
        };
        match known.await {
            Ok(true) => Some(merged(all)),
            Ok(false) => None,
            Err::<_, CatalogError>(error) => {
                log::info!("what has changed cannot be told: {error}");
                None
            }
        }
    }

    fn counted(&self) -> MutexGuard<'_, Counted> {
        self.counted.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Another catalog is at this revision: anything may be another, and what is told goes on from what was told.
    fn count_anew(&self, revision: u64) {
        let from = self.changes.revision() + 1;
        let ahead = from.saturating_sub(revision);
        *self.counted() = Counted { ahead, from };
        self.tell_missed(revision + ahead);
    }

    /// Away for longer than changes are kept: anything may be another.
    fn tell_missed(&self, revision: u64) {
        let voxels = VoxelBox::of_size(self.volume.extent());
        self.forget(voxels);
        self.changes.send(Change {
            revision,
            voxels,
            reason: crate::ChangeReason::Missed,
        });
    }
}

fn reason(reason: ChangeReason) -> crate::ChangeReason {
    match reason {
        ChangeReason::Tile => crate::ChangeReason::Tile,
        ChangeReason::Transform => crate::ChangeReason::Transform,
        ChangeReason::Deleted => crate::ChangeReason::Deleted,
    }
}

/// Changes that follow one another as one, where their common box is no larger than both: all tiles of
/// a section that is aligned anew become few boxes, however many they are.
fn merged(mut changes: Vec<Change>) -> Vec<Change> {
    loop {
        let before = changes.len();
        changes.dedup_by(|next, change| {
            let union = change.voxels.union(next.voxels);
            let both = change.voxels.voxels().saturating_add(next.voxels.voxels());
            let joins = change.reason == next.reason && union.voxels() <= both;
            if joins {
                (change.voxels, change.revision) = (union, next.revision);
            }
            joins
        });
        // Rows of tiles first, then rows of rows.
        if changes.len() == before {
            return changes;
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::UVec3;

    use super::*;

    fn change(revision: u64, min: [u32; 3], size: [u32; 3]) -> Change {
        let min = UVec3::from(min);
        Change {
            revision,
            voxels: VoxelBox::new(min, min + UVec3::from(size)),
            reason: crate::ChangeReason::Transform,
        }
    }

    #[test]
    fn a_section_is_one_change_and_what_lies_apart_is_not() {
        // Twenty by eighteen tiles that overlap by a tenth.
        let grid = (0..18).flat_map(|y| (0..20).map(move |x| (x, y)));
        let tiles = (1..).zip(grid);
        let tiles: Vec<_> = tiles
            .map(|(n, (x, y))| change(n, [x * 90, y * 90, 7], [100, 100, 1]))
            .collect();
        let one = merged(tiles.clone());
        assert_eq!(one, [change(360, [0, 0, 7], [1810, 1630, 1])]);

        let mut apart = vec![tiles[0], change(2, [300, 0, 7], [100, 100, 1])];
        assert_eq!(merged(apart.clone()), apart);
        apart[1] = change(2, [90, 0, 8], [100, 100, 1]);
        assert_eq!(merged(apart.clone()), apart, "another section");
        let mut other = tiles[1];
        other.reason = crate::ChangeReason::Tile;
        assert_eq!(merged(vec![tiles[0], other]).len(), 2);
        assert_eq!(merged(Vec::new()), []);
    }
}
