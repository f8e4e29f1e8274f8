//! Records are read as they are appended.

use std::fs::File;
use std::io::{self, BufReader, Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};

use super::prefix::{HEAD, MAX_LINE, Prefix, read_line};
use super::{BrokenRecord, Record, parse};
use crate::acquisition::text::unmarked;
use crate::acquisition::{AcquisitionError, refuse_link_out};
use crate::storage::open_regular;

/// How far the records were read, and which.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Cursor {
    /// Where the next line begins \[bytes\].
    pub offset: u64,
    /// Lines before it.
    pub line: u64,
    /// Checksums of the first bytes and of the last ones before `offset`; `None` where nobody looked: at the
    /// beginning, or in catalogs of earlier versions.
    pub seen: Option<u64>,
}

/// A line as it was read.
#[derive(Clone, Debug, PartialEq)]
pub struct RecordLine {
    /// Where the line begins \[bytes\]. Names the record for good: records are only appended.
    pub offset: u64,
    /// The reader's position after it.
    pub next: Cursor,
    /// What it says.
    pub record: Result<Record, BrokenRecord>,
}

/// Reads records as they are appended, from a cursor on.
#[derive(Debug)]
pub struct RecordReader {
    path: PathBuf,
    cursor: Cursor,
}

impl RecordReader {
    /// The file's name in the archive.
    pub const FILE: &str = "tiles.jsonl";

    /// Bytes from the beginning by which records are known as those that were read, if so many were: a file that is
    /// cut shorter may be any.
    pub const KNOWN_BY: u64 = HEAD as u64;

    /// A reader of an acquisition archive's records after `cursor`. Nothing is opened yet.
    pub fn new(folder: &Path, cursor: Cursor) -> Self {
        Self {
            path: folder.join(Self::FILE),
            cursor,
        }
    }

    /// Where the next line begins.
    pub fn cursor(&self) -> Cursor {
        self.cursor
    }

    /// A reader of the same records after another cursor.
    #[must_use]
    pub fn at(&self, cursor: Cursor) -> Self {
        let path = self.path.clone();
        Self { path, cursor }
    }

    /// Looks whether what lies before the cursor is what was read; a cursor that does not know what that was
    /// learns it. Returns the cursor.
    ///
    /// # Errors
    ///
    /// As [`Self::read`].
    pub fn recognize(&mut self) -> Result<Cursor, AcquisitionError> {
        let failed = |source| AcquisitionError::Read {
            source,
            path: self.path.clone(),
        };
        if let Some((_, prefix)) = self.open().map_err(failed)??
            && self.cursor.offset > 0
        {
            self.cursor.seen = Some(prefix.seen());
        }
        Ok(self.cursor)
    }

    /// Whether a line begins at the cursor, or the records begin or end there.
    ///
    /// # Errors
    ///
    /// As [`Self::read`].
    pub fn is_between_lines(&self) -> Result<bool, AcquisitionError> {
        let look = || {
            let mut file = match self.open()? {
                Ok(Some((file, _))) => file,
                Ok(None) => return Ok(Ok(true)),
                Err(error) => return Ok(Err(error)),
            };
            let Some(before) = self.cursor.offset.checked_sub(1) else {
                return Ok(Ok(true));
            };
            let mut last = [0];
            file.seek(SeekFrom::Start(before))?;
            file.read_exact(&mut last)?;
            Ok(Ok(last == *b"\n"))
        };
        look().map_err(|source| AcquisitionError::Read {
            source,
            path: self.path.clone(),
        })?
    }

    /// The next whole lines, at most `max`; empty lines are skipped. None if there is no file yet.
    ///
    /// A last line without its line feed is still being written, and is left for later.
    ///
    /// # Errors
    ///
    /// [`AcquisitionError::Read`], [`AcquisitionError::RecordsCut`] for a file that got shorter and, as far as can
    /// be told, begins as it did, and [`AcquisitionError::RecordsReplaced`] for one that begins otherwise, or holds
    /// other bytes before the cursor, than what was read.
    pub fn read(&mut self, max: usize) -> Result<Vec<RecordLine>, AcquisitionError> {
        self.read_lines(max)
            .map_err(|source| AcquisitionError::Read {
                source,
                path: self.path.clone(),
            })?
    }

    /// Bytes not yet read.
    pub fn remaining(&self) -> u64 {
        let len = std::fs::metadata(&self.path).map_or(0, |m| m.len());
        len.saturating_sub(self.cursor.offset)
    }

    /// Lines not yet read, as far as can be told without reading them: as many as of average length
    /// fit the bytes not yet read.
    pub fn remaining_lines(&self) -> u64 {
        let bytes = self.remaining();
        match self.cursor.line {
            0 => bytes.div_ceil(160),
            lines => bytes * lines / self.cursor.offset.max(1),
        }
    }

    /// The file at the cursor, and what lies before it; `None` if there is no file yet.
    fn open(&self) -> io::Result<Result<Option<(File, Prefix)>, AcquisitionError>> {
        let Cursor { offset, line, seen } = self.cursor;
        if let Err(leads_out) = refuse_link_out(&self.path) {
            return Ok(Err(leads_out));
        }
        let mut file = match open_regular(&self.path) {
            Ok(file) => file,
            Err(e) if e.kind() == io::ErrorKind::NotFound && offset == 0 => return Ok(Ok(None)),
            Err(e) => return Err(e),
        };
        let len = file.metadata()?.len();
        let path = || self.path.clone();
        if len < offset {
            let others = match seen {
                Some(seen) if len >= Self::KNOWN_BY => {
                    Prefix::read(&mut file, len)?.seen() >> 32 != seen >> 32
                }
                _ => false,
            };
            let (read, path) = (offset, path());
            return Ok(Err(match others {
                true => AcquisitionError::RecordsReplaced { line, path },
                false => AcquisitionError::RecordsCut { len, read, path },
            }));
        }
        let prefix = Prefix::read(&mut file, offset)?;
        // Before the beginning there is nothing that could be another's.
        if offset > 0 && seen.is_some_and(|seen| seen != prefix.seen()) {
            let path = path();
            return Ok(Err(AcquisitionError::RecordsReplaced { line, path }));
        }
        file.seek(SeekFrom::Start(offset))?;
        Ok(Ok(Some((file, prefix))))
    }

    fn read_lines(&mut self, max: usize) -> io::Result<Result<Vec<RecordLine>, AcquisitionError>> {
        let (file, mut prefix) = match self.open()? {
            Ok(Some(opened)) => opened,
            Ok(None) => return Ok(Ok(Vec::new())),
            Err(e) => return Ok(Err(e)),
        };
        let mut file = BufReader::new(file);
        let mut lines = Vec::new();
        let mut text = Vec::new();
        while lines.len() < max {
            text.clear();
            let read = read_line(&mut file, &mut text, &mut prefix)?;
            if !read.ended {
                break;
            }
            let offset = self.cursor.offset;
            self.cursor = Cursor {
                offset: offset + read.bytes,
                line: self.cursor.line + 1,
                seen: Some(prefix.seen()),
            };
            let said = match offset {
                0 => unmarked(&text),
                _ => &text,
            };
            if said.iter().all(u8::is_ascii_whitespace) {
                continue;
            }
            let record = if read.bytes > MAX_LINE as u64 {
                Err(format!("it has {} bytes, more than {MAX_LINE}", read.bytes))
            } else {
                parse(said)
            };
            let line = self.cursor.line;
            let record = record.map_err(|reason| BrokenRecord::of(said, line, reason));
            lines.push(RecordLine {
                offset,
                next: self.cursor,
                record,
            });
        }
        Ok(Ok(lines))
    }
}
