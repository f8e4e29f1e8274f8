//! The acquisition archive, as the simulated microscope sees it.

use std::collections::HashSet;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use saccade_archive::acquisition::{
    AcquisitionError, AcquisitionInfo, Cursor, Record, RecordReader, RecordWriter,
};

use super::SimulateError;
use super::settings::{Settings, volume_differences};

/// The acquisition archive being written.
pub(crate) struct Archive {
    pub(crate) folder: PathBuf,
    pub(crate) records: RecordWriter,
    /// Tiles already recorded, by name.
    pub(crate) written: HashSet<String>,
    /// Tiles already corrected, by name.
    pub(crate) corrected: HashSet<String>,
}

impl Archive {
    pub(crate) fn open(
        folder: &Path,
        info: &AcquisitionInfo,
        settings: &Settings,
    ) -> Result<Self, SimulateError> {
        if !Self::is_there(folder, info, settings)? {
            // The description last: it is what others wait for.
            settings.write(folder)?;
            info.write(folder)?;
        }
        let tiles = folder.join("tiles");
        fs::create_dir_all(&tiles).map_err(|source| SimulateError::Write {
            source,
            path: tiles,
        })?;
        let (mut written, mut corrected) = (HashSet::new(), HashSet::new());
        let mut reader = RecordReader::new(folder, Cursor::default());
        loop {
            let lines = reader.read(4096)?;
            if lines.is_empty() {
                break;
            }
            for line in lines {
                match line.record {
                    Ok(Record::Tile(tile)) => _ = written.insert(tile.tile),
                    Ok(Record::Transform(moved)) => _ = corrected.insert(moved.tile),
                    Ok(Record::Delete(_)) | Err(_) => {}
                }
            }
        }
        let records = RecordWriter::open(folder)?;
        Ok(Self {
            folder: folder.to_owned(),
            records,
            written,
            corrected,
        })
    }

    /// Whether the archive is there already. One that is there, and of anything else, is refused.
    /// Changes nothing.
    pub(crate) fn is_there(
        folder: &Path,
        info: &AcquisitionInfo,
        settings: &Settings,
    ) -> Result<bool, SimulateError> {
        let there = match AcquisitionInfo::read(folder) {
            Ok(there) => Some(there),
            Err(AcquisitionError::NoInfo { .. }) => None,
            Err(AcquisitionError::Read { source, .. })
                if source.kind() == io::ErrorKind::NotFound =>
            {
                None
            }
            Err(error) => return Err(error.into()),
        };
        let records = fs::metadata(folder.join(RecordReader::FILE)).map_or(0, |meta| meta.len());
        if there.is_none() && records == 0 {
            return Ok(false);
        }
        let path = folder.to_owned();
        let Some(known) = Settings::read(folder)? else {
            return Err(SimulateError::NotSimulated { path });
        };
        let mut differences = there
            .as_ref()
            .map_or_else(Vec::new, |there| volume_differences(there, info));
        differences.extend(settings.differences(&known));
        if !differences.is_empty() {
            let differences = differences.join("; ");
            return Err(SimulateError::OtherArchive { differences, path });
        }
        Ok(there.is_some())
    }
}
