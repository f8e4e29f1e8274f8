//! One record on its own: everything up to the catalog. Never fails for what the record says; that
//! becomes an outcome.

use std::fs;
use std::future::Future;
use std::io;
use std::path::Path;
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use glam::{UVec2, UVec3};
use saccade_archive::acquisition::{DeleteRecord, TileRecord, TransformRecord};
use saccade_archive::catalog::{CatalogError, NewTile, Quarantined, Waiting, place};
use saccade_archive::clock::Clock;
use saccade_archive::image::{self, Image, ImageError, Wanted};
use saccade_archive::pyramid::{self, EncodeError, Encoding};
use saccade_archive::storage::StorageError;
use saccade_archive::{ArchiveError, VisualizationArchive};
use saccade_core::volume::{Dtype, VoxelKind};

use super::enter::{SetAside, retry};
use super::images::Images;
use super::reasons::Called;
use super::{IngestError, IngestOptions};
use crate::progress::Progress;
use crate::sense::{CHECK, nonsense};
use crate::watch::{BEFORE_FIRST, Stamp, no_folder};
use crate::words::with_causes;

/// What a file looks like from outside; another look means that someone writes to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Look {
    pub(super) bytes: u64,
    modified: Option<SystemTime>,
    /// When the system last noted a change: who copies a file may say that it is old.
    changed: Option<SystemTime>,
}

/// Looks at a file; `None` if there is none, or none that may be seen.
pub(super) fn look(path: &Path) -> Option<Look> {
    let metadata = fs::metadata(path).ok()?;
    Some(Look {
        bytes: metadata.len(),
        modified: metadata.modified().ok(),
        changed: Stamp::of(&metadata).ok().and_then(|stamp| stamp.changed),
    })
}

/// What became of a record.
#[derive(Debug)]
pub(super) enum Outcome {
    /// The pyramid is durable; the tile can be entered.
    Tile { tile: NewTile, pixels: u64 },
    /// The tile moves.
    Transform {
        record: TransformRecord,
        position: u64,
    },
    /// The tile is no more.
    Delete { record: DeleteRecord, position: u64 },
    /// The file is not whole yet.
    Wait {
        waiting: Waiting,
        look: Option<Look>,
        kind: WaitKind,
    },
    /// It cannot become a tile.
    Quarantine {
        what: Unfit,
        pyramid: Option<String>,
    },
}

/// What cannot become a tile.
#[derive(Debug)]
pub(super) struct Unfit {
    pub(super) file: String,
    pub(super) tile: Option<String>,
    pub(super) reason: String,
    pub(super) bytes: Option<u64>,
    /// Position of its record, if only its image did not come.
    pub(super) awaited: Option<u64>,
}

impl Unfit {
    /// As it is entered.
    pub(super) fn set_aside(&self, at: SystemTime) -> Quarantined {
        Quarantined {
            file: self.file.clone(),
            tile: self.tile.clone(),
            reason: self.reason.clone(),
            bytes: self.bytes,
            at,
            awaited: self.awaited,
        }
    }
}

impl Outcome {
    /// The tile of a record that is about one which is there already.
    pub(super) fn tile(&self) -> Option<&str> {
        match self {
            Self::Transform { record, .. } => Some(&record.tile),
            Self::Delete { record, .. } => Some(&record.tile),
            Self::Tile { .. } | Self::Wait { .. } | Self::Quarantine { .. } => None,
        }
    }
}

/// How long to wait for a file that does not change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum WaitKind {
    /// It ends early: as long as the options say.
    Incomplete,
    /// It is damaged: until the next look, in case it was only being written.
    Broken,
}

/// What becomes of pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Stored {
    dtype: Dtype,
    kind: VoxelKind,
    encoding: Encoding,
}

impl Stored {
    /// How the tiles of a volume are stored, and what to say where that is not what was asked for.
    pub(super) fn new(
        dtype: Dtype,
        kind: VoxelKind,
        asked: Encoding,
    ) -> (Self, Option<&'static str>) {
        let (encoding, why) = match asked {
            Encoding::Jpeg { .. } if kind == VoxelKind::Labels => {
                let why = "labels are stored losslessly: JPEG keeps numbers only roughly";
                (Encoding::Lossless, Some(why))
            }
            Encoding::Jpeg { .. } if dtype != Dtype::Uint8 => {
                let why = "tiles of 16 bits are stored losslessly: JPEG holds 8 bits";
                (Encoding::Lossless, Some(why))
            }
            asked => (asked, None),
        };
        let stored = Self {
            dtype,
            kind,
            encoding,
        };
        (stored, why)
    }

    fn wanted(self, size: UVec2) -> Wanted {
        Wanted {
            size: Some(size),
            dtype: self.dtype,
            labels: self.kind == VoxelKind::Labels,
        }
    }

    fn encode(self, image: &Image) -> Result<Bytes, EncodeError> {
        match (image, self.kind) {
            (Image::Uint8(image), VoxelKind::Intensity) => pyramid::encode(image, &self.encoding),
            (Image::Uint16(image), VoxelKind::Intensity) => pyramid::encode(image, &self.encoding),
            (Image::Uint8(image), VoxelKind::Labels) => pyramid::encode_labels(image),
            (Image::Uint16(image), VoxelKind::Labels) => pyramid::encode_labels(image),
        }
    }
}

/// What all records share.
pub(super) struct Context<'a> {
    /// Where the images are.
    pub(super) images: Images<'a>,
    pub(super) volume: &'a str,
    pub(super) extent: UVec3,
    /// Names of the volume's channels.
    pub(super) channels: &'a [String],
    pub(super) stored: Stored,
    pub(super) archive: &'a VisualizationArchive,
    pub(super) options: &'a IngestOptions,
    pub(super) progress: &'a dyn Progress,
    /// What paths are called where others read of them.
    pub(super) called: &'a Called,
    pub(super) set_aside: SetAside,
}

impl Context<'_> {
    /// Asks the catalog, again and again while it is away.
    pub(super) async fn retry<T, F>(&self, ask: impl FnMut() -> F) -> Result<T, CatalogError>
    where
        F: Future<Output = Result<T, CatalogError>>,
    {
        retry(
            self.archive.catalog().clock(),
            self.options,
            self.progress,
            ask,
        )
        .await
    }

    /// Makes a tile of a record, up to its durable pyramid. Why it cannot be is said without paths of this machine: those
    /// who look at the volume read it, wherever they are.
    pub(super) async fn tile(
        &self,
        record: TileRecord,
        position: u64,
    ) -> Result<Outcome, IngestError> {
        let mut outcome = self.make(record, position).await?;
        if let Outcome::Wait {
            waiting: Waiting { reason, .. },
            ..
        }
        | Outcome::Quarantine {
            what: Unfit { reason, .. },
            ..
        } = &mut outcome
        {
            *reason = self.called.told(reason);
        }
        Ok(outcome)
    }

    async fn make(&self, record: TileRecord, position: u64) -> Result<Outcome, IngestError> {
        let refused = |reason, bytes| Ok(quarantine(self.images, &record, reason, bytes, None));
        let watched = self.images.are_watched();
        let Some(path) = self.images.path(&record.file) else {
            let reason = "the record names a file outside the acquisition archive; put the image \
                          into the archive and name it relative to its folder";
            return refused(reason.to_owned(), None);
        };
        if !self.images.hold(&path) {
            let (out_of, then) = if watched {
                ("watched folder", "")
            } else {
                ("acquisition archive", ", and append the record again")
            };
            let reason = format!(
                "the image is a link, or lies behind one, that leads out of the {out_of}; such links are not \
                 followed: put the image itself there{then}"
            );
            return refused(reason, None);
        }
        let (section, size, transform) = (record.section, record.size, record.transform);
        let before = look(&path);
        let bytes = before.map(|l| l.bytes);
        if size.min_element() == 0 {
            let reason = format!(
                "the record says {} x {} pixels, but the size must be at least 1 x 1 pixels; append \
                 the record again with the size of its image",
                size.x, size.y,
            );
            return refused(reason, bytes);
        }
        if record.tile.trim().is_empty() {
            let reason = "the record's tile has no name, by which later records could speak of it; append \
                          it again with one";
            return refused(reason.to_owned(), bytes);
        }
        if let Some(nonsense) = nonsense(transform) {
            let check = if watched {
                "--pixel: it is the size of a pixel in level-0 voxels"
            } else {
                CHECK
            };
            return refused(format!("{nonsense}; check {check}"), bytes);
        }
        if watched && section == BEFORE_FIRST {
            let reason = "the number of its section is less than that of the first one; give the smallest with \
                          --first";
            return refused(reason.to_owned(), bytes);
        }
        if place(self.extent, section, size, transform).is_none() {
            let check = if watched {
                "its name, --first and --pitch, or the list; if the volume is too small, take the folder in under another \
                 name (--volume NAME), with a larger --extent, and of a list with --origin"
            } else {
                "its section, transform and the extent in volume.json"
            };
            let reason = format!(
                "the tile lies wholly outside the volume of {} voxels (section {section}, transform \
                 {:?}); check {check}",
                self.extent,
                transform.elements(),
            );
            return refused(reason, bytes);
        }
        let Some(channel) = record.channel_among(self.channels) else {
            let mend = if watched {
                "name the file as one of them, or take the folder in under another name (--volume NAME), with this \
                 one among --channels as well"
            } else {
                "mend the record's channel and append it again, or list the channel in the volume.json of a new \
                 acquisition"
            };
            let channels = self.channels;
            let reason = format!("the volume has no such channel; it has {channels:?}: {mend}");
            return refused(reason, bytes);
        };
        let name = self.unused_name(&record, position).await?;
        let pyramid = {
            let (path, record, stored) = (path.clone(), record.clone(), self.stored);
            let work = move || build(&path, &record, stored, watched);
            tokio::task::spawn_blocking(work).await
        };
        let unmade = |reason, name| {
            let pyramid = Some(name);
            Ok(quarantine(self.images, &record, reason, bytes, pyramid))
        };
        let wait = |reason, kind| {
            let waiting = Waiting {
                position,
                record: record.clone(),
                reason,
            };
            Ok(Outcome::Wait {
                waiting,
                look: before,
                kind,
            })
        };
        // Space that was set aside and is being filled looks whole.
        let written_to = look(&path) != before;
        let pyramid = match pyramid {
            Ok(Ok(_)) if written_to => {
                let reason = "it was written to while it was read".to_owned();
                return wait(reason, WaitKind::Incomplete);
            }
            Ok(Ok(pyramid)) => pyramid,
            Ok(Err(Refusal::Incomplete(reason))) => return wait(reason, WaitKind::Incomplete),
            Ok(Err(Refusal::Broken(reason))) => return wait(reason, WaitKind::Broken),
            Ok(Err(Refusal::Never(reason))) => return unmade(reason, name),
            Err(panicked) => {
                let reason = format!("decoding the image failed unexpectedly: {panicked}");
                return unmade(reason, name);
            }
        };
        let pyramid = match pyramid::named(pyramid, &name) {
            Ok(pyramid) => pyramid,
            Err(e) => return unmade(e.to_string(), name),
        };
        if let Err(occupied) = self.write(&record.tile, &name, pyramid).await? {
            let then = if watched {
                "write the image again"
            } else {
                "append the record again"
            };
            let reason = format!("its pyramid cannot be written: {occupied}; then {then}");
            return refused(reason, bytes);
        }
        let pixels = u64::from(size.x) * u64::from(size.y);
        let tile = NewTile {
            name: record.tile,
            section,
            channel,
            size,
            transform,
            pyramid: name,
            position,
        };
        Ok(Outcome::Tile { tile, pixels })
    }

    /// A name for the pyramid of a record that no entered pyramid has: one that is made anew, since it was damaged, is
    /// another, so that whoever has kept something of the damaged one does not take it for this.
    async fn unused_name(&self, record: &TileRecord, position: u64) -> Result<String, IngestError> {
        // Also of a tile of which nothing else can be understood, which this record mends.
        let catalog = self.archive.catalog();
        let entered = || catalog.tile_pyramid(self.volume, &record.tile);
        let entered = self.retry(entered).await?;
        let attempt = entered.map_or(0, |pyramid| attempt_after(&pyramid, position));
        Ok(pyramid_name(self.volume, record, position, attempt))
    }

    /// Writes a pyramid; waits as long as the disk is full or the object store away. Where something else has its
    /// name, and always will, that is told.
    async fn write(
        &self,
        tile: &str,
        name: &str,
        pyramid: Bytes,
    ) -> Result<Result<(), StorageError>, IngestError> {
        let clock = self.archive.catalog().clock();
        let mut backoff = Backoff::new(self.options.retry, clock);
        loop {
            let error = match self.write_once(name, pyramid.clone()).await {
                Ok(()) => {
                    backoff.over(self.progress, &format!("tile {tile} is written now"));
                    return Ok(Ok(()));
                }
                Err(ArchiveError::Storage(occupied @ StorageError::Occupied { .. })) => {
                    return Ok(Err(occupied));
                }
                Err(error) => error,
            };
            if !backoff.may_go_on(error.is_outage(), error.is_transient()) {
                let tile = tile.to_owned();
                return Err(match error {
                    ArchiveError::Storage(source) => IngestError::Storage { source, tile },
                    ArchiveError::Catalog(error) => error.into(),
                    other => IngestError::Archive {
                        source: Box::new(other),
                        tile,
                    },
                });
            }
            backoff.say_and_wait(self.progress, &error).await;
        }
    }

    /// Writes a pyramid to where the archive's lie: nothing is written elsewhere if that can be helped, and only what lies with
    /// the others is entered.
    async fn write_once(&self, name: &str, pyramid: Bytes) -> Result<(), ArchiveError> {
        self.archive.verify_storage().await?;
        self.archive.storage().write_durable(name, pyramid).await?;
        self.archive.verify_storage().await
    }
}

/// Why there is no pyramid.
enum Refusal {
    Incomplete(String),
    Broken(String),
    Never(String),
}

fn build(
    path: &Path,
    record: &TileRecord,
    stored: Stored,
    watched: bool,
) -> Result<Bytes, Refusal> {
    // Reading a pipe waits for ever, and some devices never end.
    if fs::metadata(path).is_ok_and(|meta| !meta.is_file()) {
        let reason =
            "this is no regular file (a folder, a pipe or a device); put the image itself there";
        let then = if watched {
            ""
        } else {
            ", and append the record again"
        };
        return Err(Refusal::Never(format!("{reason}{then}")));
    }
    let image = image::decode_file_as(path, stored.wanted(record.size)).map_err(|e| match e {
        ImageError::Incomplete { .. } => Refusal::Incomplete(e.to_string()),
        // Of a file that is just being written, the head may be half there.
        ImageError::Broken { .. } | ImageError::TooLarge { .. } => Refusal::Broken(e.to_string()),
        ImageError::Read { ref source, .. } => {
            let blocked = match source.kind() {
                io::ErrorKind::NotADirectory => no_folder::why_on_the_way(path),
                _ => None,
            };
            Refusal::Incomplete(blocked.unwrap_or_else(|| format!("{e}: {source}")))
        }
        // Who has neither volume.json nor records has options.
        ImageError::Depth { bits, volume } if watched => Refusal::Never(format!(
            "the image has {bits} bits per sample, but the volume has {volume}; convert it to {volume} bit grey, or \
             take the folder in with other --bits under another name (--volume NAME)"
        )),
        ImageError::Size { width, height, .. } if watched => Refusal::Never(format!(
            "the image has {width} x {height} pixels, but had others when it was found; rename whole images into \
             the folder"
        )),
        ImageError::Unsupported { what } => {
            let depth = match 8 * stored.dtype.bytes() {
                8 => "an 8-bit".to_owned(),
                bits => format!("a {bits}-bit"),
            };
            let then = if watched {
                "rename that over this file"
            } else {
                "append the record again"
            };
            Refusal::Never(format!(
                "this kind of image cannot be read ({what}); convert it to {depth} grey TIFF or PNG, and {then}"
            ))
        }
        _ => Refusal::Never(e.to_string()),
    })?;
    stored
        .encode(&image)
        .map_err(|e| Refusal::Never(e.to_string()))
}

pub(super) fn quarantine(
    images: Images<'_>,
    record: &TileRecord,
    reason: String,
    bytes: Option<u64>,
    pyramid: Option<String>,
) -> Outcome {
    Outcome::Quarantine {
        what: unfit(images, record, reason, bytes),
        pyramid,
    }
}

pub(super) fn unfit(
    images: Images<'_>,
    record: &TileRecord,
    reason: String,
    bytes: Option<u64>,
) -> Unfit {
    Unfit {
        file: images.name(&record.file),
        tile: Some(record.tile.clone()),
        reason,
        bytes,
        awaited: None,
    }
}

/// The pyramid's name in the storage: the same for the same record, another for another record of
/// the same tile, so that a pyramid that is being read is never written to; of a record whose pyramid is made anew, with the
/// number of that attempt.
pub(super) fn pyramid_name(
    volume: &str,
    record: &TileRecord,
    position: u64,
    attempt: u32,
) -> String {
    let plain = |c: char| {
        if c.is_ascii_alphanumeric() || "-_".contains(c) {
            c
        } else {
            '_'
        }
    };
    let tile: String = record.tile.chars().take(100).map(plain).collect();
    let attempt = match attempt {
        0 => String::new(),
        attempt => format!("-again{attempt}"),
    };
    format!(
        "tiles/{volume}/{:06}/{tile}{attempt}-{position:x}.tif",
        record.section
    )
}

/// The attempt that follows the one of which a pyramid of this name is; 0 if it is of another record.
fn attempt_after(pyramid: &str, position: u64) -> u32 {
    let end = format!("-{position:x}.tif");
    let Some(before) = pyramid.strip_suffix(&end) else {
        return 0;
    };
    let attempt = before
        .rsplit_once("-again")
        .and_then(|(_, n)| n.parse().ok());
    attempt.unwrap_or(0_u32).saturating_add(1)
}

/// Pauses between attempts: doubling, up to sixteen times the first. What is waited out, however long, is looked
/// for more often: when it is there again, work goes on soon.
pub(super) struct Backoff<'a> {
    clock: &'a dyn Clock,
    first: Duration,
    pause: Duration,
    outage: bool,
    pub(super) failures: u32,
}

impl<'a> Backoff<'a> {
    /// Attempts at what may be a passing failure, before it counts as lasting.
    const ATTEMPTS: u32 = 10;

    pub(super) fn new(first: Duration, clock: &'a dyn Clock) -> Self {
        Self {
            clock,
            first,
            pause: first,
            outage: false,
            failures: 0,
        }
    }

    /// Counts a failure. An outage is waited out; what may pass is tried some times.
    pub(super) fn may_go_on(&mut self, outage: bool, transient: bool) -> bool {
        self.failures += 1;
        self.outage = outage;
        outage || (transient && self.failures < Self::ATTEMPTS)
    }

    /// It worked: if it did not at first, `notice` says so.
    pub(super) fn over(&self, progress: &dyn Progress, notice: &str) {
        if self.failures > 0 {
            progress.held_up(None);
            progress.notice(notice);
        }
    }

    pub(super) async fn say_and_wait(
        &mut self,
        progress: &dyn Progress,
        error: &(dyn std::error::Error + Send + Sync + 'static),
    ) {
        let why = with_causes(error);
        if self.failures == 1 {
            progress.notice(&format!("{why}; trying again"));
        }
        progress.held_up(Some(&why));
        let pause = self.next_pause();
        self.clock.sleep(pause).await;
    }

    fn next_pause(&mut self) -> Duration {
        let longest = self.first * if self.outage { 2 } else { 16 };
        let pause = self.pause.min(longest);
        self.pause = (self.pause * 2).min(longest);
        pause
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use saccade_archive::clock::SystemClock;
    use saccade_archive::storage::check_name;
    use saccade_core::transform::SectionFromTile;

    #[test]
    fn outages_are_looked_after_often_and_other_failures_ever_less() {
        let first = Duration::from_secs(1);
        let pauses = |outage| {
            let mut backoff = Backoff::new(first, &SystemClock);
            let pause = |_| {
                assert!(backoff.may_go_on(outage, true));
                backoff.next_pause().as_secs()
            };
            (0..7).map(pause).collect::<Vec<_>>()
        };
        assert_eq!(pauses(true), [1, 2, 2, 2, 2, 2, 2]);
        assert_eq!(pauses(false), [1, 2, 4, 8, 16, 16, 16]);
    }

    #[test]
    fn every_record_has_its_own_pyramid_name() {
        let record = |tile: &str| TileRecord {
            tile: tile.to_owned(),
            file: "a.tif".to_owned(),
            section: 3,
            size: UVec2::ONE,
            transform: SectionFromTile::IDENTITY,
            channel: None,
        };
        let wild = [
            "a",
            "../..",
            "a/b",
            "a\\b:c",
            "",
            ".",
            "Zelle 7 µm",
            &"n".repeat(999),
        ];
        let mut names: Vec<_> = (0..)
            .zip(wild)
            .flat_map(|(n, tile)| {
                let again = [(n, 0), (n, 1), (n, 2), (n + 100, 0)];
                again.map(|(at, attempt)| pyramid_name("v.1", &record(tile), at, attempt))
            })
            .collect();
        for name in &names {
            check_name(name).unwrap();
            assert!(name.starts_with("tiles/v.1/000003/"), "{name}");
        }
        names.sort();
        names.dedup();
        assert_eq!(names.len(), 4 * wild.len());
        for attempt in 0..12 {
            let name = pyramid_name("v", &record("a-b"), 0x7a, attempt);
            assert_eq!(attempt_after(&name, 0x7a), attempt + 1, "{name}");
            assert_eq!(attempt_after(&name, 0x17a), 0, "another record");
        }
    }
}
