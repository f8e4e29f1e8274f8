//! Watches a bare folder whose file names say what lies where, and writes the records that its microscope
//! does not.
//!
//! [`Watch`] keeps an acquisition archive of its own beside what is watched: `volume.json`, a link to the
//! folder, and `tiles.jsonl`, to which a line is appended for every file that is new or was replaced. From
//! there on everything is as with any acquisition archive: [`crate::ingest`] follows it, waits for what is
//! half written, and goes on where it was. The watched folder is never changed.
//!
//! # Cost
//!
//! Folders of sections are cursors: one look asks at most [`WatchConfig::budget`] folders and files what
//! they are, lists only folders that changed since they were last listed, and goes on where the last look
//! stopped. Sixteen bytes are kept per file. A file counts as new when its folder changed and its length or
//! time did, so a microscope that images a tile again writes it under a temporary name and renames it, or
//! under another name. Files that go away are not deletions: disks are cleared.

use std::collections::HashMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use glam::{DVec2, UVec2};
use saccade_archive::acquisition::{
    AcquisitionError, AcquisitionInfo, ChannelRef, Cursor, Record, RecordReader, RecordWriter,
    TileRecord,
};
use saccade_archive::image::read_size;
use saccade_core::transform::SectionFromTile;

use crate::Cancel;

mod pattern;
mod scan;
#[cfg(test)]
mod tests;

pub use pattern::{Pattern, PatternError, Place};
pub use scan::{Disk, Entry, Folders, Found, Next, Scanner, Stamp};

/// How a folder is watched.
#[derive(Clone, Debug, PartialEq)]
pub struct WatchConfig {
    /// What file names mean.
    pub pattern: Pattern,
    /// The volume that the files show.
    pub info: AcquisitionInfo,
    /// From a tile's corner to that of the next column and row \[level-0 voxels\].
    pub pitch: DVec2,
    /// Size of a tile's pixel \[level-0 voxels\].
    pub scale: f64,
    /// Number of the first section, row and column.
    pub first: u32,
    /// Pause between looks.
    pub poll: Duration,
    /// Folders and files asked per look.
    pub budget: usize,
}

impl WatchConfig {
    /// Folders and files that are asked per look, if nothing else is said.
    pub const BUDGET: usize = 10_000;
}

/// Why a folder cannot be watched.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WatchError {
    /// The records cannot be kept.
    #[error(transparent)]
    Acquisition(#[from] AcquisitionError),
    /// The folder cannot be listed.
    #[error("cannot look into the folder; check that it exists and that you may: {}", path.display())]
    Look {
        /// What the system says.
        source: io::Error,
        /// The folder.
        path: PathBuf,
    },
    /// What is kept beside it cannot be written.
    #[error("cannot write {}; check permissions and free space", path.display())]
    Write {
        /// What the system says.
        source: io::Error,
        /// What.
        path: PathBuf,
    },
    /// It was watched before as something else.
    #[error(
        "this folder was watched before as another volume, or by another link; use another archive, or \
         the same folder, extent and voxel size: {}",
        path.display()
    )]
    Other {
        /// What is kept.
        path: PathBuf,
    },
}

/// A folder that is being watched.
pub struct Watch<F> {
    config: WatchConfig,
    scanner: Scanner<F>,
    folder: PathBuf,
    kept: PathBuf,
    records: RecordWriter,
    /// Files whose size could not be read yet, and since when.
    unread: HashMap<String, (Found, SystemTime)>,
}

/// Name of the link to the watched folder.
const LINK: &str = "files";

/// Pauses for which a file whose head cannot be read is kept, before ingest is told and waits or sets it
/// aside.
const PATIENCE: u32 = 4;

impl<F: Folders> Watch<F> {
    /// Begins, or goes on, to watch `folder`; the records are kept in `kept`.
    ///
    /// # Errors
    ///
    /// [`WatchError`].
    pub fn open(
        config: WatchConfig,
        folders: F,
        folder: &Path,
        kept: &Path,
    ) -> Result<Self, WatchError> {
        let look = |source| WatchError::Look {
            source,
            path: folder.to_owned(),
        };
        let folder = folder.canonicalize().map_err(look)?;
        let other = || WatchError::Other {
            path: kept.to_owned(),
        };
        let link = kept.join(LINK);
        match AcquisitionInfo::read(kept) {
            Ok(info) if info == config.info => {}
            Ok(_) => return Err(other()),
            Err(_) => config.info.write(kept)?,
        }
        match fs::read_link(&link) {
            Ok(to) if to == folder => {}
            Ok(_) => return Err(other()),
            Err(_) => std::os::unix::fs::symlink(&folder, &link)
                .map_err(|source| WatchError::Write { source, path: link })?,
        }
        let mut scanner = Scanner::new(folders, &folder, config.pattern.clone());
        let told = fs::metadata(kept.join(RecordReader::FILE)).and_then(|meta| meta.modified());
        let mut reader = RecordReader::new(kept, Cursor::default());
        loop {
            let lines = reader.read(4096)?;
            if lines.is_empty() {
                break;
            }
            for line in lines {
                if let Ok(Record::Tile(tile)) = line.record
                    && let Some(file) = tile.file.strip_prefix(LINK)
                    && let Ok(told) = told
                {
                    scanner.remember(file.trim_start_matches('/'), told);
                }
            }
        }
        Ok(Self {
            config,
            scanner,
            folder,
            kept: kept.to_owned(),
            records: RecordWriter::open(kept)?,
            unread: HashMap::new(),
        })
    }

    /// Where the records are kept: what [`crate::ingest::run`] follows.
    pub fn acquisition(&self) -> &Path {
        &self.kept
    }

    /// One look; how many files were told of, and what to do next.
    ///
    /// # Errors
    ///
    /// [`WatchError`].
    pub fn look(&mut self) -> Result<(u64, Next), WatchError> {
        let seen = self.scanner.look(self.config.budget);
        let (found, mut next) = seen.map_err(|source| WatchError::Look {
            source,
            path: self.folder.clone(),
        })?;
        let (mut told, now) = (0, self.scanner.now());
        let again: Vec<_> = self.unread.drain().map(|(_, unread)| unread).collect();
        let mut all: Vec<_> = found
            .into_iter()
            .map(|found| (found, now))
            .chain(again)
            .collect();
        all.sort_by(|a, b| (&a.0.file, a.1).cmp(&(&b.0.file, b.1)));
        all.dedup_by(|a, b| a.0.file == b.0.file);
        let patience = self.config.poll * PATIENCE;
        for (found, since) in all {
            let size = match read_size(&self.folder.join(&found.file)) {
                Ok([x, y]) => UVec2::new(x, y),
                Err(_) if now.duration_since(since).unwrap_or_default() < patience => {
                    self.unread.insert(found.file.clone(), (found, since));
                    continue;
                }
                // Ingest finds out what is wrong, and says so.
                Err(_) => UVec2::ONE,
            };
            self.records
                .append(&Record::Tile(self.record(&found, size)))?;
            told += 1;
        }
        if told > 0 {
            self.records.sync()?;
        }
        if next == Next::Rest && !self.unread.is_empty() {
            next = Next::Again;
        }
        Ok((told, next))
    }

    fn record(&self, found: &Found, size: UVec2) -> TileRecord {
        let Place {
            section,
            row,
            column,
            channel,
        } = &found.place;
        let first = self.config.first;
        let step = |at: &u32| f64::from(*at) - f64::from(first);
        let corner = DVec2::new(step(column), step(row)) * self.config.pitch;
        let scale = self.config.scale;
        let transform = SectionFromTile::new([scale, 0.0, 0.0, scale, corner.x, corner.y])
            .unwrap_or(SectionFromTile::IDENTITY);
        TileRecord {
            tile: found.place.name(),
            file: format!("{LINK}/{}", found.file),
            // A number before the first lies outside, and is set aside with that reason.
            section: section.checked_sub(first).unwrap_or(u32::MAX),
            size,
            transform,
            channel: channel.clone().map(ChannelRef::Name),
        }
    }
}

/// Looks until it is cancelled or, with `once`, until a look finds nothing more. Blocks.
///
/// # Errors
///
/// [`WatchError`]: but a folder that cannot be listed for a while is tried again.
pub fn run<F: Folders>(
    watch: &mut Watch<F>,
    once: bool,
    cancel: &Cancel,
) -> Result<u64, WatchError> {
    let mut told = 0;
    let mut failures = 0;
    while !cancel.is_cancelled() {
        match watch.look() {
            Ok((new, next)) => {
                failures = 0;
                told += new;
                match next {
                    Next::More => continue,
                    Next::Rest if once => break,
                    Next::Again | Next::Rest => {}
                }
            }
            Err(WatchError::Look { source, path }) if failures < 10 => {
                failures += 1;
                log::warn!(
                    "cannot look into {}, trying again: {source}",
                    path.display()
                );
            }
            Err(e) => return Err(e),
        }
        let mut left = watch.config.poll;
        while !left.is_zero() && !cancel.is_cancelled() {
            let nap = left.min(Duration::from_millis(50));
            std::thread::sleep(nap);
            left -= nap;
        }
    }
    Ok(told)
}
