//! Objects that others wrote, by key: files below a folder, answers below an address, objects in a bucket.
//!
//! Formats of chunked images ([`crate::zarr`], [`crate::precomputed`]) ask for whole objects, for ranges, and for
//! ends. All stores answer alike, and pass [`conformance`].

pub mod conformance;
mod error;
#[cfg(not(target_family = "wasm"))]
mod folder;
mod http;
mod location;
mod memory;
mod refusals;
mod retry;
#[cfg(not(target_family = "wasm"))]
mod s3;
mod same;
mod transport;

use std::fmt;
use std::ops::Range;

use bytes::Bytes;

use crate::maybe_send::{BoxFuture, MaybeSend, MaybeSync};

pub use error::ObjectError;
#[cfg(not(target_family = "wasm"))]
pub use folder::FolderObjects;
pub use http::HttpObjects;
#[cfg(not(target_family = "wasm"))]
pub(crate) use http::chain;
pub(crate) use http::{client, is_passing};
pub use location::{Location, LocationError};
pub use memory::MemoryObjects;
pub(crate) use retry::Pace;
pub use retry::Patience;
pub(crate) use retry::is_to_be_told;
#[cfg(not(target_family = "wasm"))]
pub use s3::S3Objects;

/// What is read of an object.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Part {
    /// All of it, which must be no more than so many bytes.
    Whole {
        /// Longest that is read \[bytes\].
        most: u64,
    },
    /// These bytes, all of which must be there.
    Range(Range<u64>),
    /// So many bytes at its end; fewer if it has fewer.
    Last(u64),
}

/// Objects that can be read, and do not change while they are.
pub trait Objects: MaybeSend + MaybeSync + fmt::Debug {
    /// Reads an object or a part of it; `None` if there is no such object. Keys are relative, their
    /// parts separated by `/`. Dropping the future ends the request.
    ///
    /// # Errors
    ///
    /// [`ObjectError`], after as many attempts as make sense.
    fn read<'a>(
        &'a self,
        key: &'a str,
        part: Part,
    ) -> BoxFuture<'a, Result<Option<Bytes>, ObjectError>>;

    /// Where an object is, for messages.
    fn location(&self, key: &str) -> String;

    /// Names of the folders that they lie in, outermost first, the last their own: formats have places. Empty where there
    /// are none.
    fn folders(&self) -> Vec<String> {
        Vec::new()
    }

    /// How to mend it, if all that was asked for so far was forbidden: then nothing is known of what is there.
    fn denied(&self) -> Option<&'static str> {
        None
    }

    /// From here on what is forbidden is an error ([`ObjectError::Unclear`]), also where it may just be missing: for those to whom a
    /// hole that is none does lasting harm. Stores that always know the difference need not do anything.
    fn stop_guessing(&self) {}

    /// How often another object was found in place of this one, which each time one reader was told
    /// ([`ObjectError::Replaced`]). What was read of its parts while this was another number was of another object.
    fn replacements(&self, _key: &str) -> u64 {
        0
    }

    /// What beginning another read takes, as bytes that could have been read meanwhile: parts of an
    /// object that lie closer together are better read as one.
    fn read_cost(&self) -> u64;

    /// Whether bytes may be damaged on their way here, so that reading them again may help.
    fn is_remote(&self) -> bool {
        true
    }
}

/// Whether a key has only parts that name something below.
pub(crate) fn is_key(key: &str) -> bool {
    let good = |part: &str| !part.is_empty() && part != "." && part != ".." && !part.contains('\\');
    !key.contains('\0') && key.split('/').all(good)
}

/// The bytes of a part, of an object that is at hand.
fn part_of(
    bytes: &Bytes,
    part: &Part,
    location: impl Fn() -> String,
) -> Result<Bytes, ObjectError> {
    let length = bytes.len() as u64;
    let index = |at: u64| usize::try_from(at).expect("within the object");
    match part {
        Part::Whole { most } if length > *most => Err(ObjectError::TooLong {
            most: *most,
            location: location(),
        }),
        Part::Whole { .. } => Ok(bytes.clone()),
        Part::Range(range) if range.start > range.end || range.end > length => {
            Err(ObjectError::TooShort {
                wanted: range.clone(),
                location: location(),
            })
        }
        Part::Range(range) => Ok(bytes.slice(index(range.start)..index(range.end))),
        Part::Last(count) => Ok(bytes.slice(index(length.saturating_sub(*count))..)),
    }
}
