//! What was read of the records, as far as it takes to know it again.

use std::fs::File;
use std::io::{self, BufRead, Read as _, Seek as _, SeekFrom};

/// Bytes a line may have; a longer one is broken.
pub(super) const MAX_LINE: usize = 1 << 16;

/// Bytes at the beginning by which records are known again.
pub(super) const HEAD: usize = 4096;

/// Bytes before a cursor by which records are known again: about three tiles.
const TAIL: usize = 512;

/// What lies before a place in the records, as far as it takes to know it again. Other acquisitions of the same
/// volume differ from their first tiles on, or else where they were read up to.
#[derive(Clone, Debug, Default)]
pub(super) struct Prefix {
    pub(super) bytes: u64,
    head: crc32fast::Hasher,
    tail: Vec<u8>,
}

impl Prefix {
    /// Of a file's first `bytes`.
    pub(super) fn read(file: &mut File, bytes: u64) -> io::Result<Self> {
        let mut prefix = Self::default();
        // All of it: one that is cut meanwhile is not another.
        let mut part = |from: u64, len: usize| {
            file.seek(SeekFrom::Start(from))?;
            let mut part = vec![0; len];
            file.read_exact(&mut part)?;
            Ok::<_, io::Error>(part)
        };
        let most = |most: usize| usize::try_from(bytes).map_or(most, |bytes| bytes.min(most));
        prefix.push(&part(0, most(HEAD))?);
        let tail = most(TAIL);
        prefix.tail = part(bytes - tail as u64, tail)?;
        prefix.bytes = bytes;
        Ok(prefix)
    }

    pub(super) fn push(&mut self, part: &[u8]) {
        let head = usize::try_from(self.bytes).map_or(0, |bytes| HEAD.saturating_sub(bytes));
        self.head.update(&part[..head.min(part.len())]);
        self.bytes += part.len() as u64;
        self.tail
            .extend_from_slice(&part[part.len().saturating_sub(TAIL)..]);
        self.tail.drain(..self.tail.len().saturating_sub(TAIL));
    }

    pub(super) fn seen(&self) -> u64 {
        let head = self.head.clone().finalize();
        (u64::from(head) << 32) | u64::from(crc32fast::hash(&self.tail))
    }
}

pub(super) struct Line {
    pub(super) bytes: u64,
    pub(super) ended: bool,
}

/// Reads up to and including a line feed, but keeps no more than the longest sensible line.
pub(super) fn read_line(
    file: &mut impl BufRead,
    text: &mut Vec<u8>,
    prefix: &mut Prefix,
) -> io::Result<Line> {
    let mut line = Line {
        bytes: 0,
        ended: false,
    };
    while !line.ended {
        let mut part = Vec::new();
        file.by_ref()
            .take(MAX_LINE as u64)
            .read_until(b'\n', &mut part)?;
        if part.is_empty() {
            break;
        }
        line.bytes += part.len() as u64;
        prefix.push(&part);
        line.ended = part.ends_with(b"\n");
        if text.len() < MAX_LINE {
            text.append(&mut part);
        }
    }
    Ok(line)
}
