//! Whether a folder is still the one that was opened.

use std::io;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use super::Disk;
use crate::storage::FolderId;
use crate::{IDENTITY, read_identity};

/// By what a root is known again.
#[derive(Debug, Default)]
pub(super) struct Root(Mutex<Option<Known>>);

#[derive(Debug)]
struct Known {
    /// `None` where folders cannot be told apart: then it only has to be there.
    id: Option<FolderId>,
    /// The archive that it was of when this was last known to be the folder.
    mark: Option<String>,
}

/// The archive's identity, as the folder has it.
fn mark(disk: &dyn Disk, root: &Path) -> Option<String> {
    let bytes = disk.read(&root.join(IDENTITY), None).ok()?;
    read_identity(&bytes)
}

impl Root {
    /// Notes which folder is there now.
    pub(super) fn remember(&self, disk: &dyn Disk, root: &Path) -> io::Result<()> {
        let id = disk.folder_id(root)?;
        let mark = mark(disk, root);
        *self.known() = Some(Known { id, mark });
        Ok(())
    }

    /// Whether a folder was noted.
    pub(super) fn is_known(&self) -> bool {
        self.known().is_some()
    }

    /// Whether it is there. What cannot be found out counts as yes: reading and writing tell why.
    pub(super) fn is_there(&self, disk: &dyn Disk, root: &Path) -> bool {
        let now = match disk.folder_id(root) {
            Ok(now) => now,
            Err(e) => return !is_away(&e),
        };
        let mut known = self.known();
        let Some(known) = &mut *known else {
            return true;
        };
        let same = known.id == now;
        // Numbers of file systems may be others when they are mounted again.
        if !same && (known.mark.is_none() || known.mark != mark(disk, root)) {
            return false;
        }
        known.id = now;
        if known.mark.is_none() {
            known.mark = mark(disk, root);
        }
        true
    }

    fn known(&self) -> std::sync::MutexGuard<'_, Option<Known>> {
        // Every change is a single assignment: whole even after a panic.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Whether nothing is there, or what was there is cut off.
fn is_away(error: &io::Error) -> bool {
    use io::ErrorKind::{NotADirectory, NotConnected, NotFound, StaleNetworkFileHandle};
    matches!(
        error.kind(),
        NotFound | NotADirectory | NotConnected | StaleNetworkFileHandle
    )
}
