//! What every [`VolumeSource`] must do, as checks that any of them can run.
//!
//! A check returns the first [`Violation`] it finds. None of them waits by the clock: run them
//! under a time limit if a source may hang.

mod changes;
mod reading;

pub use changes::{check_changes, check_changes_after, check_missed};
pub use reading::{check_reading, check_volume};

use std::fmt;

use crate::{Chunk, ChunkError, ChunkId, VolumeSource};

/// A rule that a source broke.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a source must {rule}: {detail}")]
pub struct Violation {
    /// The rule, continuing "a source must".
    pub rule: &'static str,
    /// What was seen instead.
    pub detail: String,
}

fn ensure(
    holds: bool,
    rule: &'static str,
    detail: impl FnOnce() -> String,
) -> Result<(), Violation> {
    if holds {
        Ok(())
    } else {
        Err(violation(rule, detail()))
    }
}

fn violation(rule: &'static str, detail: impl fmt::Display) -> Violation {
    let detail = detail.to_string();
    Violation { rule, detail }
}

/// What a chunk should hold: all bytes of a full chunk, padding included, x fastest.
pub trait Oracle: Fn(ChunkId) -> Vec<u8> {}
impl<F: Fn(ChunkId) -> Vec<u8>> Oracle for F {}

/// A full chunk's bytes, whatever the source answered.
async fn read_bytes(source: &dyn VolumeSource, id: ChunkId) -> Result<Vec<u8>, Violation> {
    let volume = source.volume();
    let length = chunk_bytes(source);
    match source.read(id).await {
        Ok(Chunk::Empty) => Ok(vec![0; length]),
        Ok(Chunk::Voxels(bytes)) => {
            ensure(bytes.len() == length, "deliver full chunks", || {
                let got = bytes.len();
                format!("{id} of {:?} has {got} bytes, not {length}", volume.name)
            })?;
            Ok(bytes.to_vec())
        }
        Err(error) => Err(violation("deliver chunks", Chain(&error))),
    }
}

/// An error with all its causes.
struct Chain<'a>(&'a ChunkError);

impl fmt::Display for Chain<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)?;
        let mut error: &dyn std::error::Error = self.0;
        while let Some(source) = error.source() {
            write!(f, ": {source}")?;
            error = source;
        }
        Ok(())
    }
}

fn chunk_bytes(source: &dyn VolumeSource) -> usize {
    let volume = source.volume();
    let chunk = volume.chunk.as_usizevec3();
    chunk.x * chunk.y * chunk.z * volume.dtype.bytes()
}

/// Compares a chunk with the oracle's. Whether a voxel is 0 must agree exactly.
fn compare(
    source: &dyn VolumeSource,
    id: ChunkId,
    got: &[u8],
    want: &[u8],
    tolerance: u8,
) -> Result<(), Violation> {
    assert_eq!(
        want.len(),
        chunk_bytes(source),
        "the oracle gives full chunks"
    );
    let wrong =
        |(got, want): (&u8, &u8)| got.abs_diff(*want) > tolerance || (*got == 0) != (*want == 0);
    let count = got.iter().zip(want).filter(|p| wrong(*p)).count();
    ensure(count == 0, "deliver the right voxels", || {
        let at = got.iter().zip(want).position(wrong).unwrap_or(0);
        format!(
            "{id} has {count} wrong bytes of {}; at byte {at}: {} instead of {}",
            got.len(),
            got[at],
            want[at]
        )
    })
}

#[cfg(test)]
mod tests;
