//! The list of records that a watch writes, by one process at a time.

use std::collections::VecDeque;
use std::fs::{self, File, TryLockError};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use saccade_archive::acquisition::{AcquisitionError, Record, RecordReader, RecordWriter};
use saccade_archive::storage::{Disk as _, SystemDisk};

use super::stamps::Stamps;
use super::{Untold, WatchError};

/// Name of the file that is locked while a process writes the list.
const LOCK: &str = "lock";

/// The list, open for appending.
pub(super) struct List {
    path: PathBuf,
    records: Box<dyn Append + Send>,
    /// Whether something was appended since the last sync.
    unsynced: bool,
    /// Held as long as this is; freed by the system however the process ends.
    _lock: File,
}

/// Where records go.
pub(super) trait Append {
    fn append(&mut self, record: &Record) -> Result<(), AcquisitionError>;
    fn sync(&self) -> Result<(), AcquisitionError>;
}

impl Append for RecordWriter {
    fn append(&mut self, record: &Record) -> Result<(), AcquisitionError> {
        Self::append(self, record)
    }

    fn sync(&self) -> Result<(), AcquisitionError> {
        Self::sync(self)
    }
}

impl List {
    /// The list in a folder; `None` while another process has it.
    pub(super) fn open(folder: &Path) -> Result<Option<Self>, WatchError> {
        use io::ErrorKind::{InvalidInput, Unsupported};
        let failed = |source, path: &Path| WatchError::Write {
            source,
            path: path.to_owned(),
        };
        let path = folder.join(LOCK);
        let lock = File::create(&path).map_err(|e| failed(e, &path))?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Ok(None),
            // Some shares know no locks: there, who starts two is told twice.
            Err(TryLockError::Error(e)) if e.kind() == Unsupported => {
                log::warn!("two processes that watch the same folder would not be noticed: {e}");
            }
            Err(TryLockError::Error(e)) => return Err(failed(e, &path)),
        }
        let path = folder.join(RecordReader::FILE);
        cut_unfinished(&path).map_err(|e| failed(e, &path))?;
        let records = RecordWriter::open(folder)?;
        // Records whose file loses its name at a power cut are lost, too, with what was acknowledged of them.
        for folder in [Some(folder), folder.parent()].into_iter().flatten() {
            match SystemDisk.sync_dir(folder) {
                Err(e) if !matches!(e.kind(), InvalidInput | Unsupported) => {
                    return Err(failed(e, folder));
                }
                Ok(()) | Err(_) => {}
            }
        }
        Ok(Some(Self {
            records: Box::new(records),
            path,
            unsynced: false,
            _lock: lock,
        }))
    }

    /// Appends a record, or nothing.
    pub(super) fn append(&mut self, record: &Record) -> Result<(), AcquisitionError> {
        let appended = self.records.append(record);
        self.unsynced = true;
        if appended.is_err()
            && let Err(e) = cut_unfinished(&self.path)
        {
            log::warn!("half a record remains in {}: {e}", self.path.display());
        }
        appended
    }

    /// Makes what was appended survive a power cut.
    pub(super) fn sync(&mut self) -> Result<(), AcquisitionError> {
        if self.unsynced {
            self.records.sync()?;
            self.unsynced = false;
        }
        Ok(())
    }

    #[cfg(test)]
    pub(super) fn replace(&mut self, records: Box<dyn Append + Send>) {
        self.records = records;
    }
}

/// Writes what is to be told, if this process is the one that writes; how much it was. What cannot be written is kept.
pub(super) fn tell(
    list: Option<&mut List>,
    untold: &mut VecDeque<Untold>,
    stamps: &mut Stamps,
) -> Result<u64, AcquisitionError> {
    let Some(list) = list else {
        return Ok(0);
    };
    let (mut told, mut seen) = (0, Vec::new());
    let written = loop {
        let Some((record, stamp)) = untold.front() else {
            break list.sync();
        };
        if let Err(e) = list.append(record) {
            break Err(e);
        }
        seen.extend(*stamp);
        untold.pop_front();
        told += 1;
    };
    stamps.add(&seen);
    written.map(|()| told)
}

/// Takes away the end of a line that was never written whole. Nobody reads it before that.
fn cut_unfinished(path: &Path) -> io::Result<()> {
    /// More than any record.
    const LONGEST: u64 = 1 << 20;
    let mut file = match fs::OpenOptions::new().read(true).write(true).open(path) {
        Ok(file) => file,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(e) => return Err(e),
    };
    let end = file.seek(SeekFrom::End(0))?;
    let start = end.saturating_sub(LONGEST);
    file.seek(SeekFrom::Start(start))?;
    let mut tail = Vec::new();
    file.read_to_end(&mut tail)?;
    let whole = tail.iter().rposition(|byte| *byte == b'\n');
    let whole = whole.map_or(start, |at| start + at as u64 + 1);
    if whole < end {
        file.set_len(whole)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_not_written_whole_is_taken_away() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        cut_unfinished(&path).unwrap();
        for (text, want) in [
            ("", ""),
            ("half", ""),
            ("one\n", "one\n"),
            ("one\ntwo\nthr", "one\ntwo\n"),
        ] {
            fs::write(&path, text).unwrap();
            cut_unfinished(&path).unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), want);
        }
    }
}
