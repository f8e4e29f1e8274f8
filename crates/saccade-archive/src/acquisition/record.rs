//! Records: what the microscope says of its tiles, one JSON object per line.

use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use glam::UVec2;
use saccade_core::transform::SectionFromTile;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{AcquisitionError, key, refuse_link_out};

/// Bytes a line may have; a longer one is broken.
const MAX_LINE: usize = 1 << 16;

/// Bytes at the beginning by which records are known again.
const HEAD: usize = 4096;

/// Bytes before a cursor by which records are known again: about three tiles.
const TAIL: usize = 512;

/// Keys of tiles' records, and first of them the one that may be left out.
const KEYS: [&str; 7] = [
    "channel",
    "record",
    "tile",
    "file",
    "section",
    "size",
    "transform",
];

/// One line of `tiles.jsonl`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "record", rename_all = "lowercase")]
pub enum Record {
    /// A tile was acquired, for the first time or again.
    Tile(TileRecord),
    /// A tile lies elsewhere than said before. May come before its tile.
    Transform(TransformRecord),
    /// A tile is no more. One of the same name that comes later is another.
    Delete(DeleteRecord),
}

/// Which channel of the volume a tile shows: its place in the list, or its name in it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ChannelRef {
    /// Place in the list, from 0.
    Index(u32),
    /// Name.
    Name(String),
}

/// A tile was acquired.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TileRecord {
    /// The tile's name, unique in the volume. The same name again replaces the tile.
    pub tile: String,
    /// The image, relative to the archive's folder.
    pub file: String,
    /// Section: z index of the volume.
    pub section: u32,
    /// Width and height \[pixels\].
    pub size: UVec2,
    /// Where the stage says it lies: to level-0 voxels from pixels.
    pub transform: SectionFromTile,
    /// The channel; the volume's first if it is not said.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub channel: Option<ChannelRef>,
}

impl TileRecord {
    /// The place of its channel among the volume's; `None` if there is no such channel.
    pub fn channel_among(&self, channels: &[String]) -> Option<u32> {
        let index = match &self.channel {
            None => Some(0),
            Some(ChannelRef::Index(index)) => usize::try_from(*index).ok(),
            Some(ChannelRef::Name(name)) => channels.iter().position(|c| c == name),
        };
        let index = index.filter(|&index| index < channels.len())?;
        u32::try_from(index).ok()
    }
}

/// A tile is no more.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeleteRecord {
    /// The tile's name.
    pub tile: String,
}

/// A tile's transform changed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TransformRecord {
    /// The tile's name.
    pub tile: String,
    /// To level-0 voxels from pixels.
    pub transform: SectionFromTile,
}

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

/// A line that is no record.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line} of {} is no record: {reason}", RecordReader::FILE)]
pub struct BrokenRecord {
    /// Line, from 1.
    pub line: u64,
    /// The image that it names, as far as it can be told.
    pub file: Option<String>,
    /// The tile that it names, as far as it can be told.
    pub tile: Option<String>,
    /// What is wrong with it.
    pub reason: String,
}

impl BrokenRecord {
    fn of(text: &[u8], line: u64, reason: String) -> Self {
        /// Of whatever else it says.
        #[derive(Deserialize)]
        struct Named {
            #[serde(default)]
            file: Value,
            #[serde(default)]
            tile: Value,
        }
        let (file, tile) = match serde_json::from_slice(text) {
            Ok(Named { file, tile }) => (file, tile),
            Err(_) => (Value::Null, Value::Null),
        };
        let name = |value: Value| match value {
            Value::String(name) if !name.trim().is_empty() => Some(name),
            _ => None,
        };
        Self {
            line,
            file: name(file),
            tile: name(tile),
            reason,
        }
    }
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
        let mut file = match File::open(&self.path) {
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
        if seen.is_some_and(|seen| seen != prefix.seen()) {
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
            if text.iter().all(u8::is_ascii_whitespace) {
                continue;
            }
            let record = if read.bytes > MAX_LINE as u64 {
                Err(format!("it has {} bytes, more than {MAX_LINE}", read.bytes))
            } else {
                parse(&text)
            };
            let line = self.cursor.line;
            let record = record.map_err(|reason| BrokenRecord::of(&text, line, reason));
            lines.push(RecordLine {
                offset,
                next: self.cursor,
                record,
            });
        }
        Ok(Ok(lines))
    }
}

/// A record, or what is wrong with it.
fn parse(text: &[u8]) -> Result<Record, String> {
    match serde_json::from_slice(text) {
        // A key that is needed is missed; this one would be the volume's first channel without a word.
        Ok(Record::Tile(tile)) if tile.channel.is_none() => match hint(text, &KEYS[..1]) {
            Some(hint) => Err(hint),
            None => Ok(Record::Tile(tile)),
        },
        Ok(record) => Ok(record),
        Err(error) => Err(match hint(text, &KEYS) {
            Some(hint) => format!("{error}; {hint}"),
            None => error.to_string(),
        }),
    }
}

/// A key that is almost one of these, as it is told.
fn hint(text: &[u8], known: &[&'static str]) -> Option<String> {
    let (key, meant) = key::misspelt(text, known)?;
    Some(format!(
        "{key:?} means nothing in a record; is {meant:?} meant? A key of the microscope's own needs a name that \
         is less like it"
    ))
}

/// What lies before a place in the records, as far as it takes to know it again. Other acquisitions of the same
/// volume differ from their first tiles on, or else where they were read up to.
#[derive(Clone, Debug, Default)]
struct Prefix {
    bytes: u64,
    head: crc32fast::Hasher,
    tail: Vec<u8>,
}

impl Prefix {
    /// Of a file's first `bytes`.
    fn read(file: &mut File, bytes: u64) -> io::Result<Self> {
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

    fn push(&mut self, part: &[u8]) {
        let head = usize::try_from(self.bytes).map_or(0, |bytes| HEAD.saturating_sub(bytes));
        self.head.update(&part[..head.min(part.len())]);
        self.bytes += part.len() as u64;
        self.tail
            .extend_from_slice(&part[part.len().saturating_sub(TAIL)..]);
        self.tail.drain(..self.tail.len().saturating_sub(TAIL));
    }

    fn seen(&self) -> u64 {
        let head = self.head.clone().finalize();
        (u64::from(head) << 32) | u64::from(crc32fast::hash(&self.tail))
    }
}

struct Line {
    bytes: u64,
    ended: bool,
}

/// Reads up to and including a line feed, but keeps no more than the longest sensible line.
fn read_line(file: &mut impl BufRead, text: &mut Vec<u8>, prefix: &mut Prefix) -> io::Result<Line> {
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

/// The microscope's side: appends records.
#[derive(Debug)]
pub struct RecordWriter {
    file: File,
    path: PathBuf,
}

impl RecordWriter {
    /// Opens an archive's records for appending. Folder and file are made if missing.
    ///
    /// # Errors
    ///
    /// [`AcquisitionError::Write`].
    pub fn open(folder: &Path) -> Result<Self, AcquisitionError> {
        let path = folder.join(RecordReader::FILE);
        let open = || {
            std::fs::create_dir_all(folder)?;
            let mut file = OpenOptions::new()
                .read(true)
                .append(true)
                .create(true)
                .open(&path)?;
            // A writer that died in a line must not spoil the next record.
            if file.seek(SeekFrom::End(0))? > 0 {
                file.seek(SeekFrom::End(-1))?;
                let mut last = [0];
                file.read_exact(&mut last)?;
                if last != *b"\n" {
                    file.write_all(b"\n")?;
                }
            }
            Ok(file)
        };
        match open() {
            Ok(file) => Ok(Self { file, path }),
            Err(source) => Err(AcquisitionError::Write { source, path }),
        }
    }

    /// Makes what was appended survive a power cut.
    ///
    /// # Errors
    ///
    /// [`AcquisitionError::Write`].
    pub fn sync(&self) -> Result<(), AcquisitionError> {
        self.file
            .sync_data()
            .map_err(|source| AcquisitionError::Write {
                source,
                path: self.path.clone(),
            })
    }

    /// Appends a record in a single write.
    ///
    /// # Errors
    ///
    /// [`AcquisitionError::Write`].
    pub fn append(&mut self, record: &Record) -> Result<(), AcquisitionError> {
        let mut line = serde_json::to_vec(record).expect("numbers and strings become JSON");
        line.push(b'\n');
        let written = self.file.write_all(&line).and_then(|()| self.file.flush());
        written.map_err(|source| AcquisitionError::Write {
            source,
            path: self.path.clone(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec2;

    fn tile(name: &str) -> Record {
        Record::Tile(TileRecord {
            tile: name.to_owned(),
            file: format!("tiles/{name}.tif"),
            section: 3,
            size: UVec2::new(300, 260),
            transform: SectionFromTile::translation(DVec2::new(10.0, -2.5)),
            channel: None,
        })
    }

    fn records(lines: &[RecordLine]) -> Vec<Record> {
        lines.iter().map(|l| l.record.clone().unwrap()).collect()
    }

    #[test]
    fn the_text_is_the_documented_one() {
        let json = serde_json::to_string(&tile("a")).unwrap();
        let want = r#"{"record":"tile","tile":"a","file":"tiles/a.tif","section":3,"size":[300,260],"transform":[1.0,0.0,0.0,1.0,10.0,-2.5]}"#;
        assert_eq!(json, want);
        let moved = r#"{"record":"transform","by":"someone","tile":"a","transform":[1,0,0,1,2,3]}"#;
        let Record::Transform(moved) = serde_json::from_str(moved).unwrap() else {
            panic!("not a transform")
        };
        assert_eq!(moved.transform.elements(), [1.0, 0.0, 0.0, 1.0, 2.0, 3.0]);
    }

    #[test]
    fn channels_are_named_or_counted() {
        let channels = ["membranes", "2"].map(str::to_owned);
        let of = |channel: &str| {
            let text = format!(
                r#"{{"tile":"a","file":"a","section":0,"size":[1,1],"transform":[1,0,0,1,0,0]{channel}}}"#
            );
            let record: TileRecord = serde_json::from_str(&text).unwrap();
            let again = serde_json::to_string(&record).unwrap();
            assert_eq!(serde_json::from_str::<TileRecord>(&again).unwrap(), record);
            record.channel_among(&channels)
        };
        assert_eq!(of(""), Some(0));
        assert_eq!(of(r#","channel":1"#), Some(1));
        assert_eq!(of(r#","channel":"membranes""#), Some(0));
        // A number in quotes is a name.
        assert_eq!(of(r#","channel":"2""#), Some(1));
        assert_eq!(of(r#","channel":2"#), None);
        assert_eq!(of(r#","channel":"gold""#), None);
        let deleted = r#"{"record":"delete","tile":"a"}"#;
        let tile = "a".to_owned();
        assert_eq!(
            serde_json::from_str::<Record>(deleted).unwrap(),
            Record::Delete(DeleteRecord { tile })
        );
    }

    #[test]
    fn a_half_line_waits_for_its_end() {
        let folder = tempfile::tempdir().unwrap();
        let mut reader = RecordReader::new(folder.path(), Cursor::default());
        assert_eq!(reader.read(9).unwrap(), [], "no file yet");

        let mut writer = RecordWriter::open(folder.path()).unwrap();
        writer.append(&tile("a")).unwrap();
        let text = serde_json::to_string(&tile("b")).unwrap();
        // Every place at which a writer may be interrupted.
        for cut in 0..text.len() {
            let (head, tail) = text.split_at(cut);
            writer.file.write_all(head.as_bytes()).unwrap();
            let mut reader = RecordReader::new(folder.path(), reader.cursor());
            let before = reader.read(9).unwrap();
            writer.file.write_all(tail.as_bytes()).unwrap();
            writer.file.write_all(b"\n").unwrap();
            let mut all = records(&before);
            all.extend(records(&reader.read(usize::MAX).unwrap()));
            assert_eq!(all.len(), cut + 2, "cut at {cut}");
        }
        let all = reader.read(usize::MAX).unwrap();
        let last = all.last().unwrap();
        assert_eq!(last.next, reader.cursor());
        assert_eq!(last.next.line, text.len() as u64 + 1);
        assert_eq!(reader.remaining(), 0);
    }

    #[test]
    fn a_broken_line_is_named_and_passed() {
        let folder = tempfile::tempdir().unwrap();
        let good = serde_json::to_string(&tile("a")).unwrap();
        let singular = good.replace("[1.0,0.0,0.0,1.0,", "[0,0,0,0,");
        let long = "x".repeat(3 * MAX_LINE);
        let text = format!(
            "{good}\n\nnonsense\r\n{singular}\n{{\"record\":\"song\"}}\n{long}\n{good}\r\n"
        );
        std::fs::write(folder.path().join(RecordReader::FILE), text).unwrap();
        let lines = RecordReader::new(folder.path(), Cursor::default())
            .read(99)
            .unwrap();
        let said: Vec<_> = lines
            .iter()
            .map(|l| l.record.as_ref().map_err(|b| b.line).err())
            .collect();
        assert_eq!(said, [None, Some(3), Some(4), Some(5), Some(6), None]);
        // What can be told of what it is about, is.
        let about = |n: usize| {
            let broken = lines[n].record.as_ref().unwrap_err();
            (broken.file.as_deref(), broken.tile.as_deref())
        };
        assert_eq!(about(1), (None, None));
        assert_eq!(about(2), (Some("tiles/a.tif"), Some("a")));
        assert_eq!(about(3), (None, None));
        let reason = |n: usize| lines[n].record.as_ref().unwrap_err().reason.clone();
        assert!(reason(2).contains("inverted"), "{}", reason(2));
        assert!(reason(4).contains("bytes"), "{}", reason(4));
    }

    #[test]
    fn a_key_that_is_almost_one_that_counts_sets_its_record_aside() {
        let read = |text: &str| {
            let folder = tempfile::tempdir().unwrap();
            std::fs::write(folder.path().join(RecordReader::FILE), format!("{text}\n")).unwrap();
            let mut reader = RecordReader::new(folder.path(), Cursor::default());
            reader.read(9).unwrap().remove(0).record
        };
        let good = serde_json::to_string(&tile("a")).unwrap();
        let with = |more: &str| format!("{},{more}}}", good.strip_suffix('}').unwrap());
        for key in ["chanel", "Channel", "channels", "chan_nel", "chnanel"] {
            let broken = read(&with(&format!(r#""{key}":"BSE""#))).unwrap_err();
            assert_eq!((broken.line, broken.tile.as_deref()), (1, Some("a")));
            let told = broken.to_string();
            for part in [&format!("{key:?}"), "is \"channel\" meant?"] {
                assert!(told.contains(part), "{part:?} is not in: {told}");
            }
        }
        // What the microscope says besides is its own, also beside what it is like.
        for own in [
            r#""kV":1.5,"files":2,"sizes":[],"tiles":1,"stage":{"chanel":1},"panel":"chanel""#,
            r#""transforms":[],"sections":4,"records":1"#,
        ] {
            assert_eq!(read(&with(own)), Ok(tile("a")), "{own}");
        }
        let both = read(&with(r#""channel":"BSE","chanel":1"#)).unwrap();
        let Record::Tile(both) = both else {
            panic!("not a tile")
        };
        assert_eq!(both.channel, Some(ChannelRef::Name("BSE".to_owned())));
        let moved = r#"{"record":"transform","tile":"a","transform":[1,0,0,1,2,3],"chanel":1}"#;
        assert!(read(moved).is_ok(), "it has no channel");
        // One that is needed is missed anyway.
        let broken = read(&good.replace("section", "secton")).unwrap_err();
        for part in ["missing field `section`", "is \"section\" meant?"] {
            assert!(broken.reason.contains(part), "{}", broken.reason);
        }
    }

    #[test]
    fn reading_in_pieces_equals_reading_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = RecordWriter::open(folder.path()).unwrap();
        for n in 0..20 {
            writer.append(&tile(&n.to_string())).unwrap();
        }
        let all = RecordReader::new(folder.path(), Cursor::default())
            .read(99)
            .unwrap();
        let mut pieces = Vec::new();
        let mut cursor = Cursor::default();
        while let Some(line) = RecordReader::new(folder.path(), cursor)
            .read(1)
            .unwrap()
            .pop()
        {
            cursor = line.next;
            pieces.push(line);
        }
        assert_eq!(pieces, all);
        assert_eq!(all.len(), 20);
    }

    #[test]
    fn a_writer_that_died_spoils_only_its_line() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(RecordReader::FILE), r#"{"record":"ti"#).unwrap();
        RecordWriter::open(folder.path())
            .unwrap()
            .append(&tile("b"))
            .unwrap();
        let lines = RecordReader::new(folder.path(), Cursor::default())
            .read(99)
            .unwrap();
        assert!(lines[0].record.is_err());
        assert_eq!(lines[1].record, Ok(tile("b")));
    }

    #[test]
    fn cut_records_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        RecordWriter::open(folder.path())
            .unwrap()
            .append(&tile("b"))
            .unwrap();
        let mut reader = RecordReader::new(
            folder.path(),
            Cursor {
                offset: 9999,
                line: 7,
                seen: None,
            },
        );
        assert!(matches!(
            reader.read(1),
            Err(AcquisitionError::RecordsCut { read: 9999, .. })
        ));
    }

    #[test]
    fn records_that_were_cut_are_told_from_others() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(RecordReader::FILE);
        let text = lines(300, |_| false);
        std::fs::write(&path, &text).unwrap();
        let mut reader = RecordReader::new(folder.path(), Cursor::default());
        reader.read(usize::MAX).unwrap();
        let other = lines(300, |n| n == 0);
        for len in [0, 1, HEAD - 1, HEAD, HEAD + 1, text.len() - 1] {
            std::fs::write(&path, &text[..len]).unwrap();
            let cut = reader.read(1).unwrap_err();
            assert!(
                matches!(cut, AcquisitionError::RecordsCut { .. }),
                "{len}: {cut}"
            );
            std::fs::write(&path, &other[..len]).unwrap();
            let refused = reader.read(1).unwrap_err();
            let known = matches!(refused, AcquisitionError::RecordsReplaced { line: 300, .. });
            assert_eq!(known, len >= HEAD, "{len}: {refused}");
        }
        std::fs::write(&path, &text).unwrap();
        assert_eq!(reader.read(1).unwrap(), []);
    }

    /// Of `count` lines, all as long as each other; `other` says which tiles are another acquisition's.
    fn lines(count: usize, other: impl Fn(usize) -> bool) -> String {
        let line = |n| {
            let name = if other(n) { 'b' } else { 'a' };
            serde_json::to_string(&tile(&format!("{name}{n:05}"))).unwrap() + "\n"
        };
        (0..count).map(line).collect()
    }

    #[test]
    fn other_records_in_the_same_place_are_known() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(RecordReader::FILE);
        for read in [1, 2, 5, 40, 300] {
            std::fs::write(&path, lines(read, |_| false)).unwrap();
            let mut reader = RecordReader::new(folder.path(), Cursor::default());
            assert_eq!(reader.read(usize::MAX).unwrap().len(), read);
            let cursor = reader.cursor();
            let mut later = RecordReader::new(folder.path(), cursor);
            assert_eq!(later.recognize().unwrap(), cursor);
            // As long, and longer; from the first line on, and only from the last one on.
            for (count, from) in [
                (read, 0),
                (read, read - 1),
                (read + 9, 0),
                (read + 9, read - 1),
            ] {
                std::fs::write(&path, lines(count, |n| n >= from)).unwrap();
                for refused in [
                    later.read(1).map(drop),
                    later.recognize().map(drop),
                    reader.read(1).map(drop),
                ] {
                    let replaced = matches!(
                        refused,
                        Err(AcquisitionError::RecordsReplaced { line, .. }) if line == read as u64
                    );
                    assert!(
                        replaced,
                        "{read} read, {count} lines, others from {from}: {refused:?}"
                    );
                }
                assert_eq!(later.cursor(), cursor, "nothing was read");
            }
            // The same, and more of them.
            std::fs::write(&path, lines(read + 3, |_| false)).unwrap();
            assert_eq!(later.read(9).unwrap().len(), 3);
        }
    }

    #[test]
    fn a_cursor_of_an_earlier_version_learns_what_was_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(RecordReader::FILE);
        let nothing = RecordReader::new(folder.path(), Cursor::default()).recognize();
        assert_eq!(nothing.unwrap(), Cursor::default(), "no file yet");
        std::fs::write(&path, lines(60, |_| false)).unwrap();
        let mut reader = RecordReader::new(folder.path(), Cursor::default());
        assert_eq!(reader.recognize().unwrap(), Cursor::default());
        let read = reader.read(50).unwrap();
        let old = Cursor {
            seen: None,
            ..reader.cursor()
        };
        let learned = RecordReader::new(folder.path(), old).recognize().unwrap();
        assert_eq!(learned, reader.cursor());
        // It is of the place, not of who read how much at once.
        let mut again = RecordReader::new(folder.path(), read[20].next);
        assert_eq!(again.read(29).unwrap().last().unwrap().next, learned);
    }
}
