//! Tells any number of listeners about changes, in order of revision.

use std::sync::Mutex;

use futures::stream;
use saccade_core::voxel_box::VoxelBox;
use tokio::sync::broadcast;
use tokio::sync::broadcast::error::RecvError;

use crate::maybe_send::BoxStream;
use crate::{Change, ChangeReason};

/// Changes a listener may fall behind by before it is told that some were missed.
pub(crate) const BACKLOG: usize = 1024;

/// Hands each change to every listener; one that falls behind gets [`ChangeReason::Missed`].
pub(crate) struct Changes {
    sender: broadcast::Sender<Change>,
    /// Held while sending, so that listeners see revisions in order.
    revision: Mutex<u64>,
    whole: VoxelBox,
}

impl Changes {
    /// For a volume of these level-0 voxels, now at `revision`.
    pub(crate) fn new(whole: VoxelBox, revision: u64) -> std::sync::Arc<Self> {
        let (sender, _) = broadcast::channel(BACKLOG);
        std::sync::Arc::new(Self {
            sender,
            revision: Mutex::new(revision),
            whole,
        })
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, u64> {
        self.revision
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    /// Revision of the newest change.
    pub(crate) fn revision(&self) -> u64 {
        *self.lock()
    }

    /// Numbers a change with the next revision and sends it. Apply it before.
    pub(crate) fn send_next(&self, voxels: VoxelBox, reason: ChangeReason) -> u64 {
        let mut revision = self.lock();
        *revision += 1;
        self.send_locked(*revision, voxels, reason);
        *revision
    }

    /// Sends a change that somebody else numbered; one older than the last is dropped.
    ///
    /// A `Missed` one never is: what was missed has no number of its own.
    pub(crate) fn send(&self, change: Change) {
        let mut revision = self.lock();
        if change.revision >= *revision || change.reason == ChangeReason::Missed {
            *revision = change.revision.max(*revision);
            self.send_locked(*revision, change.voxels, change.reason);
        }
    }

    fn send_locked(&self, revision: u64, voxels: VoxelBox, reason: ChangeReason) {
        let change = Change {
            revision,
            voxels,
            reason,
        };
        // Nobody listening is no error.
        let _ = self.sender.send(change);
    }

    /// Changes from this call on.
    pub(crate) fn stream(self: &std::sync::Arc<Self>) -> BoxStream<'static, Change> {
        let start = (self.sender.subscribe(), std::sync::Arc::downgrade(self));
        let whole = self.whole;
        Box::pin(stream::unfold(
            start,
            move |(mut receiver, changes)| async move {
                match receiver.recv().await {
                    Ok(change) => Some((change, (receiver, changes))),
                    Err(RecvError::Closed) => None,
                    Err(RecvError::Lagged(_)) => {
                        // Go on from the newest; the lock keeps new ones out in between.
                        let revision = {
                            let changes = changes.upgrade()?;
                            let revision = changes.lock();
                            receiver = receiver.resubscribe();
                            *revision
                        };
                        let missed = Change {
                            revision,
                            voxels: whole,
                            reason: ChangeReason::Missed,
                        };
                        Some((missed, (receiver, changes)))
                    }
                }
            },
        ))
    }
}
