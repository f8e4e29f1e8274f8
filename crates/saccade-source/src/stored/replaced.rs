//! Objects of several pieces that were found to be others than before: what was kept of their pieces is of no use any more.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use quick_cache::sync::Cache;
use saccade_core::voxel_box::VoxelBox;

use super::PieceError;
use crate::flights::{Flights, Weighed, Work};
use crate::objects::{ObjectError, Objects};

/// Indices that are known to have been missing.
const KNOWN: usize = 1 << 14;
/// Times that pieces are looked for in an object which is another each time.
pub(super) const ATTEMPTS: u32 = 4;

/// Several pieces' object, by level and number within it.
pub(crate) type ObjectId = (u32, u64);

/// An object that has taken the place of another, or has come.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Replaced {
    /// Whose pieces are others.
    pub(crate) object: ObjectId,
    /// Where they may be \[stored voxels of the level\].
    pub(crate) voxels: VoxelBox,
}

/// What an index was read from.
#[derive(Clone, Debug)]
pub(crate) struct Indexed<I> {
    /// `None` if there is none.
    pub(crate) index: Option<I>,
    /// How often its object had been replaced before it was read ([`Objects::replacements`]).
    pub(crate) version: u64,
}

impl<I: Weighed> Weighed for Indexed<I> {
    fn bytes(&self) -> u64 {
        self.index.as_ref().map_or(0, Weighed::bytes)
    }

    fn is_missing(&self) -> bool {
        self.index.is_none()
    }
}

/// Indices of objects, each of the object that is there now, as far as its store tells.
pub(crate) struct Indices<K, I> {
    flights: Arc<Flights<K, Indexed<I>, PieceError>>,
    missing: Cache<K, ()>,
    /// Of which version the newest index was.
    versions: Mutex<HashMap<ObjectId, u64>>,
    replaced: Mutex<Vec<Replaced>>,
}

impl<K, I> Indices<K, I>
where
    K: Copy + Eq + Hash + crate::maybe_send::MaybeSend + crate::maybe_send::MaybeSync + 'static,
    I: Clone + Weighed + crate::maybe_send::MaybeSend + crate::maybe_send::MaybeSync + 'static,
{
    /// Keeps up to `bytes` of them, of about `each` bytes, and missing ones for so long.
    pub(crate) fn new(bytes: u64, each: u64, missing_for: Duration) -> Self {
        Self {
            flights: Flights::new(bytes, each, missing_for),
            missing: Cache::new(KNOWN),
            versions: Mutex::default(),
            replaced: Mutex::default(),
        }
    }

    /// The index `id` of an object `of`, whose key is `key`; `read` makes work that reads it.
    pub(crate) async fn get(
        &self,
        id: K,
        objects: &dyn Objects,
        key: &str,
        of: Replaced,
        read: impl Fn(u64) -> Work<K, Indexed<I>, PieceError>,
    ) -> Result<Indexed<I>, PieceError> {
        let mut attempts = 0;
        loop {
            attempts += 1;
            let version = objects.replacements(key);
            let start = |missing: Vec<K>| match missing.is_empty() {
                true => Vec::new(),
                false => vec![(missing, read(version))],
            };
            let mut found = self.flights.get(&[id], start).await;
            let nothing = Indexed {
                index: None,
                version,
            };
            let found = found.pop().flatten().unwrap_or(Ok(nothing));
            let is_another = match &found {
                Ok(found) => found.version != objects.replacements(key),
                Err(error) => is_replaced(error),
            };
            if !is_another || attempts >= ATTEMPTS {
                if let Ok(found) = &found {
                    self.note(id, found, of);
                }
                return found;
            }
            self.flights.forget(|known| *known == id);
        }
    }

    /// Notes an object that is another than before.
    fn note(&self, id: K, found: &Indexed<I>, of: Replaced) {
        let mut versions = self.versions.lock().unwrap_or_else(PoisonError::into_inner);
        let before = versions.get(&of.object).copied().unwrap_or(0);
        let is_another = found.version > before;
        if is_another {
            versions.insert(of.object, found.version);
        }
        drop(versions);
        let has_come = match found.index {
            Some(_) => self.missing.remove(&id).is_some(),
            None => {
                self.missing.insert(id, ());
                false
            }
        };
        if is_another || has_come {
            let mut replaced = self.replaced.lock().unwrap_or_else(PoisonError::into_inner);
            replaced.push(of);
        }
    }

    /// Those that were noted since this was asked last.
    pub(crate) fn take_replaced(&self) -> Vec<Replaced> {
        let mut replaced = self.replaced.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::take(&mut *replaced)
    }
}

/// Whether what a piece lies in was replaced while it was read.
pub(super) fn is_replaced(error: &PieceError) -> bool {
    matches!(error, PieceError::Unread { source, .. } if matches!(**source, ObjectError::Replaced { .. }))
}

/// The error where an object is another each time that it is read.
pub(super) fn never_the_same(which: String, location: String) -> PieceError {
    PieceError::Unread {
        source: Arc::new(ObjectError::Unavailable {
            attempts: ATTEMPTS,
            reason: "it was replaced each time while it was read".to_owned(),
            location,
        }),
        which,
    }
}
