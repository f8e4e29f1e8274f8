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
//! stopped. Sixteen bytes are kept per file, and as many more for those that an earlier process told of, until
//! they are met; twice as many for those in folders whose names say the same, as all do where the pattern has `{}` for them;
//! and in a file, `stamps`, as many for each time that one was told of. A file counts as new when its
//! folder changed and its length or time did, or it is another file, so a microscope that images a tile again
//! writes it under a temporary name and renames it, or under another name. For half a minute after it was found or
//! changed, a file itself is looked at, each second, with half of the budget at most: one that was filled meanwhile
//! is told of again. Files that go away are not deletions: disks are cleared.

use std::collections::{HashMap, HashSet, VecDeque};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use glam::{DVec2, UVec2};
use saccade_archive::acquisition::{
    AcquisitionError, AcquisitionInfo, ChannelRef, Cursor, Record, RecordReader, TileRecord,
};
use saccade_archive::image::read_size;
use saccade_core::transform::SectionFromTile;

use crate::Cancel;
use crate::held_up::HeldUp;
use crate::simulate::settings::{Settings, difference, volume_differences};
use list::List;
use looking::{Looks, Passes, look_on};
use scan::Doubles;
use stamp::Seen;
use stamps::Stamps;

mod again;
mod list;
mod listed;
mod looking;
mod moved;
pub(crate) mod no_folder;
mod no_image;
mod pattern;
mod scan;
mod stamp;
mod stamps;
#[cfg(test)]
mod tests;

pub use listed::{ListConfig, ListError, ListWatch, Until, follow, kept_list};
pub use pattern::{Pattern, PatternError, Place};
pub use scan::{Counts, Disk, Entry, Folders, Found, Next, Scanner};
pub use stamp::Stamp;
#[cfg(any(test, fuzzing))]
pub(crate) use stamps::fuzz as fuzz_stamps;

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
    /// Whether the folder is the one that was watched, and has moved, whatever the times of its files say.
    pub moved: bool,
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
        "a folder is watched under this name already, otherwise: {differences}; give the same options, or take \
         this one in under another name (`saccade ingest --volume NAME`) or into another archive: {}",
        path.display()
    )]
    Other {
        /// What differs, in words.
        differences: String,
        /// What is kept.
        path: PathBuf,
    },
    /// The folder that was watched is gone, and this one, elsewhere, does not look like it.
    #[error(
        "the folder that is followed under this name, {}, is not there any more, and this one does not look like it: of {looked_for} images \
         that were taken in there {found} are here, {same} of them with the size and time that they had. Take it in under another name \
         (`saccade ingest --volume NAME`) or into another archive; if it is that folder, wait until it is copied, or, if its files got other \
         times, say --moved: {}",
        was.display(),
        folder.display()
    )]
    Another {
        /// Where the folder was.
        was: PathBuf,
        /// This one.
        folder: PathBuf,
        /// Images that were told of.
        looked_for: usize,
        /// Those of them that are in this one.
        found: usize,
        /// Those of them that look as they did.
        same: usize,
    },
    /// The folder that was watched is gone, and another process waits for it.
    #[error(
        "another process follows {} under this name, and waits for it to be there again: end that one first, if the folder has moved here: {}",
        was.display(),
        folder.display()
    )]
    Led {
        /// Where the folder was.
        was: PathBuf,
        /// This one.
        folder: PathBuf,
    },
}

impl WatchError {
    /// Whether there is no room for the records: what passes when somebody makes some.
    pub fn is_full(&self) -> bool {
        use io::ErrorKind::{QuotaExceeded, StorageFull};
        let full = |source: &io::Error| matches!(source.kind(), StorageFull | QuotaExceeded);
        match self {
            Self::Acquisition(AcquisitionError::Write { source, .. })
            | Self::Write { source, .. } => full(source),
            _ => false,
        }
    }
}

/// Name of the file that keeps what names meant when the folder was first watched.
const SETTINGS: &str = "watched.json";

/// A folder that is being watched.
pub struct Watch<F> {
    config: WatchConfig,
    scanner: Scanner<F>,
    folder: PathBuf,
    kept: PathBuf,
    /// The list of records, while this process is the one that writes it.
    list: Option<List>,
    /// Records that could not be written yet.
    untold: VecDeque<Untold>,
    /// What files looked like when they were told of.
    stamps: Stamps,
    /// Files whose size could not be read yet.
    unread: VecDeque<Unread>,
    /// Whether the folder was gone through once.
    seen: bool,
    /// Whether it is still to be said that no file fits the pattern.
    tells_misfits: bool,
    /// Where folders should be and others lie, as it was said last.
    blocked: Vec<String>,
    /// Why images cannot be looked at, as it was said last, and of how many more it was not said.
    lost: (Vec<String>, usize),
    /// Whether each of these is told as it is met.
    tells_missing: bool,
    held_up: HeldUp,
}

/// Whether nothing was told yet, and nobody is about to: then a mistake in an option binds nobody.
fn is_unused(kept: &Path) -> Result<bool, WatchError> {
    let records = fs::metadata(kept.join(RecordReader::FILE));
    let none = records.map_or(true, |meta| meta.len() == 0);
    Ok(none && List::open(kept)?.is_some())
}

/// A record that is to be written, and what to remember its file by.
type Untold = (Record, Option<(u64, Seen)>);

/// A file that is not written as far as its size.
struct Unread {
    found: Found,
    stamp: Option<Stamp>,
    /// When it was seen to change last.
    since: SystemTime,
}

/// The section of a tile whose number is before the first one, which is set aside with that reason.
pub(crate) const BEFORE_FIRST: u32 = u32::MAX;

/// Name of the link to the watched folder.
const LINK: &str = "files";

/// What is said where the folder that is watched is still there, and another is to be.
fn another(there: &Path, folder: &Path) -> String {
    let there = format!(
        "{}, which still exists (if what is followed has moved, rename or unmount that first),",
        there.display()
    );
    difference("folder", &there, &folder.to_string_lossy())
}

/// Makes the link to the folder that is watched; whether it led elsewhere. Of several that do so at once all succeed.
fn link(folder: &Path, kept: &Path) -> Result<bool, WatchError> {
    let link = kept.join(LINK);
    let linked = fs::read_link(&link).ok();
    if linked.as_deref() == Some(folder) {
        return Ok(false);
    }
    let old = match &linked {
        Some(_) => fs::remove_file(&link),
        None => Ok(()),
    };
    match old.and_then(|()| std::os::unix::fs::symlink(folder, &link)) {
        // Another that began at the same time was faster.
        Err(_) if fs::read_link(&link).is_ok_and(|now| now == folder) => {}
        made => made.map_err(|source| WatchError::Write { source, path: link })?,
    }
    Ok(linked.is_some())
}

/// The path in the watched folder of a file that a record names: without the link, of which people know nothing.
pub fn file_name(file: &str) -> &str {
    let inside = file.strip_prefix(LINK);
    inside
        .and_then(|inside| inside.strip_prefix('/'))
        .unwrap_or(file)
}

/// Whether `kept` holds the records of what is, or was, at `folder`.
pub fn was_followed(folder: &Path, kept: &Path) -> bool {
    let linked = fs::read_link(kept.join(LINK)).ok();
    // What is away has no canonical name, but the folder around it may.
    let around = folder
        .parent()
        .and_then(|around| around.canonicalize().ok());
    let moved = { around.zip(folder.file_name()) }.map(|(around, name)| around.join(name));
    let known = [
        folder.canonicalize().ok(),
        moved,
        std::path::absolute(folder).ok(),
    ];
    linked.is_some_and(|linked| known.contains(&Some(linked)))
}

/// Pauses for which a file whose head cannot be read may stay as it is, before ingest is told and sets it
/// aside.
const PATIENCE: u32 = 120;

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
        let info = AcquisitionInfo::read(kept).ok();
        let pitch = config.pitch.to_array();
        let pattern = config.pattern.to_string();
        let now = Settings::of_watch(&pattern, pitch, config.scale, config.first);
        let settings = Settings::read_from(kept.join(SETTINGS))?;
        let mut differences = Vec::new();
        if let Some(info) = &info {
            differences.extend(volume_differences(info, &config.info));
        }
        differences.extend(moved::still_there(&folder, kept).map(|there| another(&there, &folder)));
        if let Some(there) = &settings {
            differences.extend(now.differences(there));
        }
        if !differences.is_empty() && !is_unused(kept)? {
            return Err(WatchError::Other {
                differences: differences.join("; "),
                path: kept.to_owned(),
            });
        }
        if info.as_ref() != Some(&config.info) {
            config.info.write(kept)?;
        }
        let scanner = Scanner::new(folders, &folder, config.pattern.clone());
        let key = |file: &str| scanner.key(file);
        let stamps = moved::go_on(scanner.folders(), &folder, kept, config.moved, key)?;
        // Those of earlier versions did not keep them.
        if settings.as_ref() != Some(&now) {
            now.write_to(kept.join(SETTINGS))?;
        }
        let mut watch = Self {
            config,
            scanner,
            folder,
            kept: kept.to_owned(),
            list: None,
            untold: VecDeque::new(),
            stamps,
            unread: VecDeque::new(),
            seen: false,
            tells_misfits: false,
            blocked: Vec::new(),
            lost: (Vec::new(), 0),
            tells_missing: false,
            held_up: HeldUp::default(),
        };
        watch.take_over()?;
        Ok(watch)
    }

    /// The folder that is watched: where links of the records lead, see
    /// [`IngestOptions::linked`](crate::ingest::IngestOptions::linked).
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Tells what it waits for.
    #[must_use]
    pub fn telling(mut self, held_up: HeldUp) -> Self {
        self.held_up = held_up;
        self
    }

    /// Whether this process writes the records. If not, another does that watches the same folder, until it ends.
    pub fn leads(&self) -> bool {
        self.list.is_some()
    }

    /// Becomes the one that writes the records, if no other process is.
    fn take_over(&mut self) -> Result<bool, WatchError> {
        let Some(list) = List::open(&self.kept)? else {
            return Ok(false);
        };
        let told = fs::metadata(self.kept.join(RecordReader::FILE));
        if let Ok(told) = told.and_then(|meta| meta.modified()) {
            let mut reader = RecordReader::new(&self.kept, Cursor::default());
            self.scanner.told_until(told);
            // Tellings of a file of which it is not known what it looked like.
            let mut unknown: HashMap<u64, u32> = HashMap::new();
            loop {
                let lines = reader.read(4096)?;
                if lines.is_empty() {
                    break;
                }
                for line in lines {
                    if let Ok(Record::Tile(tile)) = line.record {
                        let key = self.scanner.told_key(file_name(&tile.file));
                        *unknown.entry(key).or_default() += 1;
                    }
                }
            }
            let scanner = &mut self.scanner;
            self.stamps.each(|key, seen| {
                scanner.remember_as(key, seen);
                if let Some(tellings) = unknown.get_mut(&key) {
                    *tellings = tellings.saturating_sub(1);
                }
            });
            // A process that died told of a file and kept no more: what it looked like before says nothing.
            for (key, _) in unknown.into_iter().filter(|(_, tellings)| *tellings > 0) {
                scanner.remember_nothing_of(key);
            }
        }
        self.list = Some(list);
        Ok(true)
    }

    /// Which images cannot be looked at though their names are there, and where folders of them should be and are not, in words.
    pub fn missing(&self) -> Option<String> {
        const SHOWN: usize = 3;
        let (whys, more) = &self.lost;
        let first = whys.iter().take(SHOWN).cloned();
        let more = match whys.len().saturating_sub(SHOWN) + more {
            0 => None,
            more => Some(format!("and {more} more such images")),
        };
        let mut blocked: Vec<_> = self.blocked.iter().take(SHOWN).cloned().collect();
        if let more @ 1.. = self.blocked.len() - blocked.len() {
            blocked.push(format!("and {more} more such folders"));
        }
        let said: Vec<_> = blocked.into_iter().chain(first).chain(more).collect();
        (!said.is_empty()).then(|| said.join("; "))
    }

    /// Why nothing is taken in: once the folder was gone through, and something is there, but no file whose name
    /// fits the pattern.
    pub fn unmatched(&self) -> Option<String> {
        let counts = self.scanner.counts();
        let (path, folder) = counts
            .other
            .as_ref()
            .filter(|_| self.seen && counts.fit == 0)?;
        let pattern = &self.config.pattern;
        let why = pattern.mismatch(path, *folder).unwrap_or_default();
        let Counts { files, folders, .. } = counts;
        Some(format!(
            "no file fits the pattern {pattern}; looked at were {files} files and {folders} folders below {}, \
             such as {path:?}: {why}",
            self.folder.display()
        ))
    }

    /// Which files came since this was asked last that mean a tile which another file means as well, or one that was there.
    pub fn doubles(&mut self) -> Option<String> {
        let Doubles { such_as, files } = self.scanner.doubles();
        let Found { file, place } = such_as?;
        Some(format!(
            "{files} files are named so that others of their folder, or of one whose name says the same, mean the same tiles, such as \
             {file:?} of tile {}: of such files the one that was found last and can be read counts, of those that were found at once the \
             one that was written last. Let the pattern say what tells them apart; or take away what is not to be seen, and touch what is, for a file \
             that is gone leaves its tile: {}",
            place.name(),
            self.folder.display()
        ))
    }

    /// Where the records are kept: what [`crate::ingest::run`] follows.
    pub fn acquisition(&self) -> &Path {
        &self.kept
    }

    /// Writes what is to be told; how much it was. What cannot be written is kept.
    fn tell(&mut self) -> Result<u64, WatchError> {
        let (list, untold, stamps) = (&mut self.list, &mut self.untold, &mut self.stamps);
        Ok(list::tell(list.as_mut(), untold, stamps)?)
    }

    /// One look; how many files were told of, and what to do next. While another process writes the records,
    /// there is nothing to do.
    ///
    /// # Errors
    ///
    /// [`WatchError`]; what was found is not lost, and told by a later look.
    pub fn look(&mut self) -> Result<(u64, Next), WatchError> {
        if !self.leads() && !self.take_over()? {
            return Ok((0, Next::Rest));
        }
        // Nothing more is found before there is room for what was.
        let before = self.tell()?;
        let seen = self.scanner.look(self.config.budget);
        let (found, mut next) = seen.map_err(|source| WatchError::Look {
            source,
            path: self.folder.clone(),
        })?;
        // Else what is put into the place of one later, of its size and time, would not be told from it.
        self.stamps.add(&self.scanner.learned());
        self.seen |= next != Next::More;
        let now = self.scanner.now();
        if !self.unread.is_empty() {
            let again: HashSet<&str> = found.iter().map(|found| &*found.file).collect();
            self.unread
                .retain(|unread| !again.contains(&*unread.found.file));
        }
        let new = found.into_iter().map(|found| Unread {
            stamp: self.scanner.stamp(&found.file),
            found,
            since: now,
        });
        let new: Vec<_> = new.collect();
        // However many there are, a look takes up so many of them.
        let again = self.unread.len().min(self.config.budget);
        let mut all: Vec<_> = self.unread.drain(..again).collect();
        all.extend(new);
        // In the order in which they were written, as who had followed the folder since then would have told of them.
        let written = |unread: &Unread| unread.stamp.map(|stamp| stamp.modified);
        all.sort_by(|a, b| { written(a).cmp(&written(b)) }.then(a.found.file.cmp(&b.found.file)));
        let patience = self.config.poll * PATIENCE;
        for mut unread in all {
            // Before anything is read: what changes later is seen to have changed.
            let stamp = match unread.since {
                since if since == now => unread.stamp,
                _ => self.scanner.stamp(&unread.found.file),
            };
            let size = match read_size(&self.folder.join(&unread.found.file)) {
                Ok([x, y]) => UVec2::new(x, y),
                // Nobody is about to write a pipe whole: ingest says what it is.
                Err(e) if e.is_of_no_file() => UVec2::ONE,
                Err(_) => {
                    if stamp != unread.stamp {
                        (unread.stamp, unread.since) = (stamp, now);
                    }
                    if now.duration_since(unread.since).unwrap_or_default() < patience {
                        self.unread.push_back(unread);
                        continue;
                    }
                    // Ingest finds out what is wrong, and says so.
                    UVec2::ONE
                }
            };
            if size == UVec2::ONE {
                self.scanner.expects_more_of(&unread.found);
            }
            let record = Record::Tile(self.record(&unread.found, size));
            let stamp = stamp.map(|stamp| self.scanner.tells(&unread.found.file, stamp));
            self.untold.push_back((record, stamp));
        }
        let told = before + self.tell()?;
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
            section: section.checked_sub(first).unwrap_or(BEFORE_FIRST),
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
/// [`WatchError`]: but a folder that cannot be listed is tried again, some times with `once` and else for as long as
/// it takes, and a full disk is waited out.
pub fn run<F: Folders>(
    watch: &mut Watch<F>,
    once: bool,
    cancel: &Cancel,
) -> Result<u64, WatchError> {
    // Who looks once is told by the caller.
    watch.tells_misfits = !once;
    watch.tells_missing = !once;
    look_on(watch, once, cancel, |_| false)
}

impl<F: Folders> Looks for Watch<F> {
    type Error = WatchError;

    const BACK: &'static str = "the folder can be looked into again";

    fn look(&mut self) -> Result<(u64, Next), WatchError> {
        let looked = Self::look(self);
        if self.tells_misfits
            && looked.is_ok()
            && let Some(why) = self.unmatched()
        {
            log::warn!("{why}; files that fit are waited for");
            self.tells_misfits = false;
        }
        if let Some(doubles) = self.doubles() {
            log::warn!("{doubles}");
        }
        let blocked = self.scanner.blocked();
        let lost = self.scanner.lost();
        let known = |why: &&String| self.blocked.contains(why) || self.lost.0.contains(why);
        for why in { blocked.iter() }.chain(&lost.0).filter(|why| !known(why)) {
            if self.tells_missing {
                log::warn!("{why}");
            }
        }
        (self.blocked, self.lost) = (blocked, lost);
        looked
    }

    fn poll(&self) -> Duration {
        self.config.poll
    }

    fn passes(&self, error: &WatchError) -> Passes {
        Passes::of(error)
    }

    fn waits_for(&self) -> Option<String> {
        let said: Vec<_> = { self.unmatched().into_iter() }
            .chain(self.missing())
            .collect();
        (!said.is_empty()).then(|| said.join("; "))
    }

    fn held_up(&self) -> &HeldUp {
        &self.held_up
    }
}
