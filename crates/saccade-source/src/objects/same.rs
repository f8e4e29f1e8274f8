//! Whether parts are of the same object: one may be replaced between two requests.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};

use quick_cache::sync::Cache;

use super::{ObjectError, Part};

/// Objects read in parts whose marks are remembered.
const MARKS: usize = 1 << 14;

/// What marked the objects that were read in parts, by key: another mark is another object. A shard whose index is of
/// one object and whose chunks are of another holds wrong voxels.
#[derive(Debug)]
pub(super) struct Marks<M> {
    marks: Cache<String, M>,
    /// How often another was found, of those of which one was. Held while marks change.
    replaced: Mutex<HashMap<String, u64>>,
}

impl<M: Clone> Default for Marks<M> {
    fn default() -> Self {
        Self {
            marks: Cache::new(MARKS),
            replaced: Mutex::default(),
        }
    }
}

impl<M: Clone + PartialEq> Marks<M> {
    /// Whether a part is of the same object as the parts before, as far as marks tell: a store that has no mark for it
    /// tells nothing. Another object is told once; the parts after it have to be of that one.
    pub(super) fn check(
        &self,
        key: &str,
        part: &Part,
        mark: Option<M>,
        location: impl FnOnce() -> String,
    ) -> Result<(), ObjectError> {
        let (Some(mark), false) = (mark, matches!(part, Part::Whole { .. })) else {
            return Ok(());
        };
        if self.marks.get(key).as_ref() == Some(&mark) {
            return Ok(());
        }
        // Of two that come at once, one is the first.
        let mut replaced = self.replaced.lock().unwrap_or_else(PoisonError::into_inner);
        let before = self.marks.get(key);
        if before.as_ref() == Some(&mark) {
            return Ok(());
        }
        if before.is_some() {
            // Counted before any part passes as one of the new object.
            *replaced.entry(key.to_owned()).or_default() += 1;
        }
        self.marks.insert(key.to_owned(), mark);
        match before {
            None => Ok(()),
            Some(_) => Err(ObjectError::Replaced {
                location: location(),
            }),
        }
    }

    /// How often another object was found in place of this one.
    pub(super) fn replacements(&self, key: &str) -> u64 {
        let replaced = self.replaced.lock().unwrap_or_else(PoisonError::into_inner);
        replaced.get(key).copied().unwrap_or(0)
    }
}

/// A tag as HTTP has it (`ETag`), if it is one of bytes: weak ones are of what is as good, not of the same bytes.
pub(super) fn strong(tag: &str) -> Option<String> {
    (!tag.is_empty() && !tag.starts_with("W/")).then(|| tag.to_owned())
}
