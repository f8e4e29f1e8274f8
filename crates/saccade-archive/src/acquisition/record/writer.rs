//! The microscope's side of the records.

use std::fs::{File, OpenOptions};
use std::io::{Read as _, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};

use super::{Record, RecordReader};
use crate::acquisition::AcquisitionError;

/// The microscope's side: appends records.
#[derive(Debug)]
pub struct RecordWriter {
    pub(super) file: File,
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
