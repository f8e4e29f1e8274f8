//! Whether parts are of the same object: one may be replaced between two requests.

use std::convert::Infallible;

use quick_cache::sync::Cache;

use super::{ObjectError, Part};

/// Objects read in parts whose marks are remembered.
const MARKS: usize = 1 << 14;

/// What marked the objects that were read in parts, by key: another mark is another object. A shard whose index is of
/// one object and whose chunks are of another holds wrong voxels.
#[derive(Debug)]
pub(super) struct Marks<M>(Cache<String, M>);

impl<M: Clone> Default for Marks<M> {
    fn default() -> Self {
        Self(Cache::new(MARKS))
    }
}

impl<M: Clone + PartialEq> Marks<M> {
    /// Whether a part is of the same object as the parts before, as far as marks tell: a store that has no mark for it
    /// tells nothing.
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
        // Of two that come at once, one is the first.
        let first = || Ok::<_, Infallible>(mark.clone());
        let Ok(before) = self.0.get_or_insert_with(key, first);
        match before == mark {
            true => Ok(()),
            false => Err(ObjectError::Replaced {
                location: location(),
            }),
        }
    }
}

/// A tag as HTTP has it (`ETag`), if it is one of bytes: weak ones are of what is as good, not of the same bytes.
pub(super) fn strong(tag: &str) -> Option<String> {
    (!tag.is_empty() && !tag.starts_with("W/")).then(|| tag.to_owned())
}
