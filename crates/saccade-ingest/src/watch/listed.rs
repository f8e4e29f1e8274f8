//! Follows a folder of images with a list that says where each of them lies, and writes the records that its
//! microscope does not.
//!
//! [`ListWatch`] keeps an acquisition archive of its own, as [`Watch`](super::Watch) does of a bare folder. The list is
//! read again whenever its file has changed and rests: tiles that are new in it are told of once their image is there,
//! those that lie elsewhere get a transform, those that are in it no more are deleted. Where registration has found
//! better places, in Fiji's twin of the list, in Render's transforms or in a TrakEM2 project, these count. A twin may know
//! some of the tiles only: the others stay where the list has them.
//!
//! A list that names tiles no more may be half of one that is being written. Nothing of it counts before it has rested for
//! [`ListConfig::drop_after`]. Neither does one whose last line may be cut within a number.
//!
//! # Channels
//!
//! Tile specifications of Render name an image for each channel; else the images' names may say it, as a pattern reads
//! them. Which channels there are is settled with the frame. A volume that was begun without any goes on so.
//!
//! # Frame
//!
//! Lists count pixels from anywhere. Where the volume's corner and its first section lie, and how large it is, is
//! settled when the list is first read, as replay settles it, and kept: what is listed later lies in the same frame.
//! Registration counts from anywhere, too, and each time from elsewhere: its places are moved by their median distance
//! from the list's, anew whenever it has put a tile elsewhere, not when it only knows more tiles than before.
//!
//! # Cost
//!
//! Half a kilobyte is kept per tile, and sixteen bytes per file of the folder. Files are asked for as those of a bare
//! folder are: when their folder changed, and for half a minute after they came.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use glam::{DVec2, UVec2};
use saccade_archive::acquisition::{AcquisitionError, ChannelRef};
use saccade_core::transform::SectionFromTile;

use super::again::Again;
use super::list::List;
use super::stamp::{Seen, Stamp};
use super::stamps::Stamps;
use super::{Folders, Next, Untold, WatchError, moved};
use crate::held_up::HeldUp;
use frame::Frame;
use index::{Index, Sought, base, key, names};
use source::{Adopted, Files};

mod channels;
mod config;
mod counted;
mod follow;
mod frame;
mod index;
mod reading;
mod records;
mod source;

pub use config::{ListConfig, ListError};
pub use follow::{Until, follow};
pub use frame::kept_list;

/// Whether a tile's image was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Image {
    Missing,
    /// It is there, and to be told of.
    Unread,
    Told,
}

/// A tile as the list has it.
#[derive(Debug)]
struct Wanted {
    file: String,
    section: u32,
    transform: SectionFromTile,
    channel: Option<ChannelRef>,
    image: Image,
}

/// A tile as the records have it.
#[derive(Debug)]
struct Told {
    /// Below the followed folder.
    file: String,
    section: u32,
    size: UVec2,
    transform: SectionFromTile,
    channel: Option<ChannelRef>,
}

#[derive(Debug, Default)]
struct Tile {
    wanted: Option<Wanted>,
    told: Option<Told>,
}

/// A tile whose image is there.
struct Unread {
    tile: Arc<str>,
    stamp: Option<Stamp>,
    /// When it was seen to change last.
    since: SystemTime,
}

/// What is wrong with the list as it was read last.
#[derive(Clone)]
enum Trouble {
    Unreadable(Arc<AcquisitionError>),
    Empty,
}

/// Images that are not there of which it is asked why, at most.
const MOST_ASKED: usize = 64;

/// A folder with a list that is being followed.
pub struct ListWatch<F> {
    config: ListConfig,
    disk: F,
    folder: PathBuf,
    kept: PathBuf,
    /// Whether all is said to be there: it is followed to its end, once.
    once: bool,
    index: Index,
    files: Files,
    trouble: Option<Trouble>,
    frame: Option<Frame>,
    adopted: Option<Adopted>,
    /// Where registration's places are, as it was said last.
    registration_said: Option<PathBuf>,
    /// How far registration's places are moved, as it was said last.
    shift_said: Option<DVec2>,
    /// The list of records, while this process is the one that writes it.
    records: Option<List>,
    tiles: BTreeMap<Arc<str>, Tile>,
    /// Which tiles may have images of a name, by its hash.
    by_name: HashMap<u64, BTreeSet<Arc<str>>>,
    /// Tiles whose image was not found.
    missing: BTreeSet<Arc<str>>,
    /// When one of them came last.
    progress: SystemTime,
    /// What was said of them.
    missing_said: Option<String>,
    /// Those of which it is not clear which image is theirs.
    unclear: BTreeSet<Arc<str>>,
    /// How many that were when it was said, and how.
    unclear_said: Option<(usize, String)>,
    /// What is said of a list that may not be whole, until it is read.
    unsure: Option<String>,
    /// How many tiles registration does not know, as it was said last.
    unsolved_said: usize,
    /// Whether it was said why a solution is not used.
    unused_said: bool,
    /// What is said of images whose names do not say the channel.
    unfit: Option<String>,
    /// What was said of the list as it was read last.
    notes_said: Vec<String>,
    held_up: HeldUp,
    unread: VecDeque<Unread>,
    /// Records that could not be written yet.
    untold: VecDeque<Untold>,
    /// What files looked like when they were told of, by the hash of their path; `None` if that is not known.
    seen: HashMap<u64, Option<Seen>>,
    /// Those of which that was not known, or not all, and that are the same by what is.
    learned: Vec<(u64, Seen)>,
    told_until: SystemTime,
    stamps: Stamps,
    again: Again<String>,
    whole: bool,
}

impl<F: Folders> ListWatch<F> {
    /// Begins, or goes on, to follow the list of the images below `folder`; the records are kept in `kept`.
    ///
    /// # Errors
    ///
    /// [`ListError`]: also if something else is kept there, or the same otherwise.
    pub fn open(
        config: ListConfig,
        disk: F,
        folder: &Path,
        kept: &Path,
    ) -> Result<Self, ListError> {
        let look = |source| WatchError::Look {
            source,
            path: folder.to_owned(),
        };
        let folder = folder.canonicalize().map_err(look)?;
        let list = std::path::absolute(&config.list).unwrap_or_else(|_| config.list.clone());
        let config = ListConfig {
            list: list.canonicalize().unwrap_or(list),
            ..config
        };
        fs::create_dir_all(kept).map_err(|source| WatchError::Write {
            source,
            path: kept.to_owned(),
        })?;
        let frame = Frame::open(&config, &folder, kept)?;
        let stamps = moved::go_on(&disk, &folder, kept, config.moved, key)?;
        let now = disk.now();
        let mut watch = Self {
            once: false,
            index: Index::new(&folder).of_channels(config.channel_in.clone()),
            files: Files::new(&config.list),
            trouble: None,
            adopted: frame.as_ref().and_then(|_| frame::adopted(&folder, kept)),
            frame,
            registration_said: None,
            shift_said: None,
            records: None,
            tiles: BTreeMap::new(),
            by_name: HashMap::new(),
            missing: BTreeSet::new(),
            progress: now,
            missing_said: None,
            unclear: BTreeSet::new(),
            unclear_said: None,
            unsure: None,
            unsolved_said: 0,
            unused_said: false,
            unfit: None,
            notes_said: Vec::new(),
            held_up: HeldUp::default(),
            unread: VecDeque::new(),
            untold: VecDeque::new(),
            seen: HashMap::new(),
            learned: Vec::new(),
            told_until: SystemTime::UNIX_EPOCH,
            stamps,
            again: Again::default(),
            whole: false,
            kept: kept.to_owned(),
            config,
            disk,
            folder,
        };
        watch.take_over()?;
        Ok(watch)
    }

    /// The folder whose images are listed, see [`IngestOptions::linked`](crate::ingest::IngestOptions::linked).
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Tells what it waits for.
    #[must_use]
    pub fn telling(mut self, held_up: HeldUp) -> Self {
        self.held_up = held_up;
        self
    }

    /// Where the records are kept: what [`crate::ingest::run`] follows, once the volume [`is_known`](Self::is_known).
    pub fn acquisition(&self) -> &Path {
        &self.kept
    }

    /// Whether this process writes the records. If not, another does, until it ends.
    pub fn leads(&self) -> bool {
        self.records.is_some()
    }

    /// Whether it is settled what the volume is.
    pub fn is_known(&self) -> bool {
        self.frame.is_some()
    }

    /// Which images are not there, in words, if any are not.
    pub fn missing(&self) -> Option<String> {
        const SHOWN: usize = 3;
        let odd = self.index.odd();
        let (mut absent, mut blocked, mut strange, mut whys) = (0_usize, None, 0, Vec::new());
        let mut examples = Vec::new();
        for tile in self.missing.difference(&self.unclear) {
            let Some(wanted) = self.tiles.get(tile).and_then(|tile| tile.wanted.as_ref()) else {
                continue;
            };
            let file = &wanted.file;
            let there = names(file).find_map(|name| odd.get(&*name).copied());
            let Some(path) = there.or_else(|| self.index.folder(file)) else {
                if examples.len() < SHOWN {
                    let is_listed = |name: &str| self.by_name.contains_key(&key(name));
                    let why = self.not_taken(file);
                    let why = why.or_else(|| self.index.nearly(file, is_listed));
                    let why = why.map_or_else(String::new, |why| format!(" ({why})"));
                    examples.push(format!("{file:?}{why}"));
                }
                if absent < MOST_ASKED && blocked.is_none() {
                    blocked = self.index.blocked(file).map(|why| (file, why));
                }
                absent += 1;
                continue;
            };
            strange += 1;
            if whys.len() < SHOWN {
                whys.push(format!("{:?} is {}", path, self.index.why(path)));
            }
        }
        let all = self.tiles.len();
        let mut said = Vec::new();
        if strange > 0 {
            let more = match strange - whys.len() {
                0 => String::new(),
                more => format!(", and {more} more"),
            };
            let whys = whys.join(", ");
            said.push(format!(
                "{strange} of the {all} images that the list names cannot be read: {whys}{more}"
            ));
        }
        if absent > 0 {
            // One of which it can be told why says most.
            let such_as = match blocked {
                Some((file, why)) => format!("{file:?} ({why})"),
                None => examples.join(", "),
            };
            said.push(format!(
                "{absent} of the {all} images that the list names are not found below {}, such as {such_as}",
                self.folder.display()
            ));
        }
        said.extend(self.unclear());
        said.extend(self.unfit.clone());
        (!said.is_empty()).then(|| said.join("; "))
    }

    /// Why an image that has the name of one that is missing is not taken for it, in words; nothing, if it is another one's.
    fn not_taken(&self, file: &str) -> Option<String> {
        let (path, why) = self.index.not_taken(file)?;
        let called = path.to_str()?;
        let mut named = self.by_name.get(&key(base(called)))?.iter();
        let is_anothers = named.any(|tile| {
            let wanted = self.tiles.get(tile).and_then(|tile| tile.wanted.as_ref());
            wanted.is_some_and(|Wanted { file, .. }| {
                let sought = || self.index.sought(file);
                self.index.may_be(called, file) && sought() == Sought::There(path.clone())
            })
        });
        (!is_anothers).then_some(why)
    }

    /// Which images are in several folders, in words.
    fn unclear(&self) -> Option<String> {
        let mut of = self.unclear.iter().filter_map(|tile| {
            let wanted = self.tiles.get(tile)?.wanted.as_ref()?;
            match self.index.sought(&wanted.file) {
                Sought::Several(places) => Some((&wanted.file, places)),
                Sought::There(_) | Sought::Missing => None,
            }
        });
        let (file, [one, other]) = of.next()?;
        let (count, all, list) = (self.unclear.len(), self.tiles.len(), &self.config.list);
        let mut files = [file].into_iter().chain(of.map(|(file, _)| file));
        let blocked = { files.by_ref().take(MOST_ASKED) }
            .find_map(|file| Some((file, self.index.blocked(file)?)));
        if let Some((file, why)) = blocked {
            return Some(format!(
                "{count} of the {all} images that the list names are in other folders than it says, such as {file:?} ({why})"
            ));
        }
        Some(format!(
            "{count} of the {all} images that the list names are in several folders, such as {file:?}, which may be \
             {one:?} or {other:?}; name them with their folders in the list: {}",
            list.display()
        ))
    }

    /// Takes over what was settled before, by whichever process.
    fn open_frame(&mut self) -> Result<(), ListError> {
        self.frame = Frame::open(&self.config, &self.folder, &self.kept)?;
        if self.frame.is_some() {
            self.adopted = frame::adopted(&self.folder, &self.kept);
        }
        Ok(())
    }

    /// One look; how many records were written, and what to do next. While another process writes the records,
    /// there is nothing to do.
    ///
    /// # Errors
    ///
    /// [`ListError`]; what was found is not lost, and told by a later look.
    pub fn look(&mut self) -> Result<(u64, Next), ListError> {
        if !self.leads() {
            if self.frame.is_none() {
                self.open_frame()?;
            }
            if !self.take_over()? {
                return Ok((0, Next::Rest));
            }
        }
        // Nothing more is found before there is room for what was.
        let before = self.tell()?;
        let seen = self.index.look(&self.disk, self.config.budget);
        let (met, mut next) = seen.map_err(|source| WatchError::Look {
            source,
            path: self.folder.clone(),
        })?;
        let now = self.disk.now();
        for file in met {
            self.met(&file, now);
        }
        if !self.index.is_whole() {
            return Ok((before, next));
        }
        if next == Next::Again {
            // One of several may be gone.
            for tile in self.unclear.clone() {
                self.look_for(&tile, now);
            }
        }
        if !std::mem::replace(&mut self.whole, true) {
            for tile in self.missing.clone() {
                self.look_for(&tile, now);
            }
        }
        let listed = self.read_list(now);
        self.look_again(now);
        self.read_images(now);
        self.say_what_is_missing(now);
        let told = before + self.tell()?;
        let waits = listed? || !self.unread.is_empty() || self.again.waits();
        if next == Next::Rest && waits {
            next = Next::Again;
        }
        Ok((told, next))
    }

    /// A file of a folder that changed.
    fn met(&mut self, file: &str, now: SystemTime) {
        let Some(tiles) = self.by_name.get(&key(base(file))).cloned() else {
            return;
        };
        let mut of_it = Vec::new();
        for name in tiles {
            let Some(Tile { wanted, told }) = self.tiles.get(&name) else {
                continue;
            };
            match wanted.as_ref().map(|wanted| (wanted.image, &wanted.file)) {
                // There may be as many images of its name as sections.
                Some((Image::Missing, wanted)) => {
                    if self.index.may_be(file, wanted) {
                        self.look_for(&name, now);
                    }
                }
                Some((Image::Unread, _)) => {}
                // The list has it, or was not read yet.
                Some((Image::Told, _)) | None => {
                    let is_it = told.as_ref().is_some_and(|told| told.file == file);
                    let fits_better = |(told, wanted): (&Told, &Wanted)| {
                        self.index.fits_better(file, &told.file, &wanted.file)
                    };
                    if told.as_ref().zip(wanted.as_ref()).is_some_and(fits_better) {
                        self.look_for(&name, now);
                    }
                    of_it.extend(is_it.then_some(name));
                }
            }
        }
        if !of_it.is_empty() && self.is_replaced(file, now) {
            for name in of_it {
                self.tell_again(&name, now);
            }
        }
    }

    /// Whether a file that was told of is another now, or has another content; if it may still change, it is to be
    /// looked at again.
    fn is_replaced(&mut self, file: &str, now: SystemTime) -> bool {
        let Ok(stamp) = self.disk.stamp(&self.folder.join(file)) else {
            return false;
        };
        let (key, seen) = (key(file), Seen::of(&stamp));
        if self.again.holds(key) {
            return false;
        }
        let before = self.seen.insert(key, Some(seen)).flatten();
        let same = match before {
            Some(before) => !before.is_replaced_by(seen),
            None => stamp.modified <= self.told_until,
        };
        if same && before.is_none_or(Seen::is_of_any_file) {
            self.learned.push((key, seen));
        }
        if stamp.is_young(now) || (!same && self.whole) {
            self.again.add(key, &file.to_owned(), now);
        }
        !same
    }

    /// Looks for the image of a tile.
    fn look_for(&mut self, tile: &Arc<str>, now: SystemTime) {
        let Some(wanted) = self.tiles.get_mut(tile).and_then(|t| t.wanted.as_mut()) else {
            return;
        };
        let sought = match self.whole {
            true => self.index.find(&wanted.file),
            false => Sought::Missing,
        };
        match sought {
            Sought::Several(_) => _ = self.unclear.insert(Arc::clone(tile)),
            Sought::There(_) | Sought::Missing => _ = self.unclear.remove(tile),
        }
        if let Sought::There(_) = sought {
            self.missing.remove(tile);
            (self.progress, self.missing_said) = (now, None);
            wanted.image = Image::Unread;
            self.unread.push_back(Unread {
                tile: Arc::clone(tile),
                stamp: None,
                since: now,
            });
        } else {
            wanted.image = Image::Missing;
            self.missing.insert(Arc::clone(tile));
        }
    }

    /// The image of a tile is another.
    fn tell_again(&mut self, tile: &Arc<str>, now: SystemTime) {
        let Some(Tile { wanted, told }) = self.tiles.get_mut(tile) else {
            return;
        };
        match wanted {
            Some(wanted) if wanted.image == Image::Told => {
                wanted.image = Image::Unread;
                self.unread.push_back(Unread {
                    tile: Arc::clone(tile),
                    stamp: None,
                    since: now,
                });
            }
            Some(_) => {}
            // Found out again once the list is read.
            None => {
                if let Some(told) = told {
                    told.size = UVec2::ZERO;
                }
            }
        }
    }

    /// Looks at files again that somebody may still be writing to, with half of the questions at most.
    fn look_again(&mut self, now: SystemTime) {
        let mut most = self.config.budget.div_ceil(2);
        while most > 0
            && let Some(mut file) = self.again.due(now)
        {
            most -= 1;
            let stamp = self.disk.stamp(&self.folder.join(&file.found)).ok();
            let known = self.seen.get(&file.key).copied().flatten();
            // One that is gone may be on its way to be another.
            if let Some((stamp, known)) = stamp.zip(known)
                && file.is_whole_again(known, Seen::of(&stamp), now)
            {
                self.seen.insert(file.key, Some(Seen::of(&stamp)));
                let tiles = self.by_name.get(&key(base(&file.found))).cloned();
                for tile in tiles.unwrap_or_default() {
                    let told = self.tiles.get(&tile).and_then(|tile| tile.told.as_ref());
                    if told.is_some_and(|told| told.file == file.found) {
                        self.tell_again(&tile, now);
                    }
                }
            }
            self.again.put_back(file, now);
        }
    }

    /// Once, when no image has come for a while; that it is not clear which one is meant, at once.
    fn say_what_is_missing(&mut self, now: SystemTime) {
        const AFTER: Duration = Duration::from_secs(30);
        let count = self.unclear.len();
        if self.unclear_said.as_ref().map_or(0, |(said, _)| *said) != count {
            self.unclear_said = self.unclear().map(|said| (count, said));
            if let Some((_, said)) = &self.unclear_said {
                log::warn!("{said}");
            }
        }
        let rests = now
            .duration_since(self.progress)
            .is_ok_and(|age| age > AFTER);
        if self.missing.is_empty() {
            self.missing_said = None;
        } else if rests
            && self.missing_said.is_none()
            && let Some(missing) = self.missing()
        {
            log::warn!("{missing}; they are waited for");
            self.missing_said = Some(missing);
        }
    }
}
