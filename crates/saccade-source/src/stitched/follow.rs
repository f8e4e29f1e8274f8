//! Follows the catalog.

use std::sync::Weak;
use std::time::Duration;

use saccade_archive::catalog::{Catalog, CatalogChange, CatalogError, ChangeReason};
use saccade_core::voxel_box::VoxelBox;
use tokio::sync::watch;

use super::Inner;
use crate::Change;

/// When the catalog cannot be read, it is tried again after this.
const TRY_AGAIN: Duration = Duration::from_millis(500);

/// Passes on changes until the source is dropped or the catalog closed.
pub(super) async fn follow(
    inner: Weak<Inner>,
    catalog: Catalog,
    mut news: watch::Receiver<u64>,
    mut seen: u64,
) {
    loop {
        news.borrow_and_update();
        match catch_up(&inner, &catalog, &mut seen).await {
            Ok(()) => {
                if news.changed().await.is_err() {
                    return;
                }
            }
            Err(error) => {
                log::warn!("changes cannot be read, trying again: {error}");
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
    seen: &mut u64,
) -> Result<(), CatalogError> {
    while let Some(name) = inner.upgrade().map(|inner| inner.volume.name.clone()) {
        let changes = catalog.changes_after(&name, *seen).await?;
        let Some(inner) = inner.upgrade().filter(|_| !changes.is_empty()) else {
            return Ok(());
        };
        // First what is known, then what was built of it, then the news: whoever reads after the
        // news gets neither.
        let turned = inner.builder.tiles().index().apply(&changes).await;
        for change in changes {
            let all = turned.contains(&change.section);
            inner.tell(&change, inner.builder.touched(change.voxels, all));
            *seen = change.revision;
        }
    }
    Ok(())
}

impl Inner {
    fn tell(&self, change: &CatalogChange, voxels: VoxelBox) {
        self.forget(voxels);
        self.changes.send(Change {
            revision: change.revision,
            voxels,
            reason: match change.reason {
                ChangeReason::Tile => crate::ChangeReason::Tile,
                ChangeReason::Transform => crate::ChangeReason::Transform,
                ChangeReason::Deleted => crate::ChangeReason::Deleted,
            },
        });
    }
}
