//! The acquisition archive, as the simulated microscope sees it.

use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

use saccade_archive::acquisition::{AcquisitionInfo, Cursor, Record, RecordReader, RecordWriter};

use super::SimulateError;

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
    pub(crate) fn open(folder: &Path, info: &AcquisitionInfo) -> Result<Self, SimulateError> {
        match AcquisitionInfo::read(folder) {
            Ok(found) if found != *info => {
                let say =
                    |info: &AcquisitionInfo| format!("{} of {} voxels", info.name, info.extent);
                let (found, wanted) = (say(&found), say(info));
                return Err(SimulateError::OtherArchive {
                    found,
                    wanted,
                    path: folder.to_owned(),
                });
            }
            Ok(_) => {}
            // Not there yet; whatever else is wrong, writing will say.
            Err(_) => info.write(folder)?,
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
                    Err(_) => {}
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
}
