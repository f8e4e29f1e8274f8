//! `saccade ingest`: from what a microscope writes to what can be looked at.

use std::path::{Path, PathBuf};
use std::pin::pin;
use std::process::ExitCode;

use anyhow::Result;
use clap::Args;
use saccade_archive::acquisition::AcquisitionInfo;
use saccade_archive::catalog::Catalog;
use saccade_archive::clock::{Clock as _, SystemClock};
use saccade_archive::pyramid::{Encoding, PyramidIndex};
use saccade_archive::{ArchiveLocation, CatalogLocation, VisualizationArchive};
use saccade_core::volume::{Dtype, VoxelKind, check_name};
use saccade_ingest::ingest::{IngestOptions, Summary, run, wait_until_there};
use saccade_ingest::watch::{self, Disk, ListWatch, Until, Watch};
use saccade_ingest::{Cancel, HeldUp};
use tokio::task::JoinHandle;

use super::followed::{Bare, Followed, is_being_written};
use crate::arguments::{Archive, volume_name};
use crate::folders::overlap;
use crate::interrupt::{INTERRUPTED, cancel_when_interrupted};
use crate::open::waited_for;
use crate::progress::Shown;
use crate::report::say;

/// Follow an acquisition archive, or a folder with a list of its tiles' places (Fiji, Render, TrakEM2, or `file x y
/// z`), and make each tile's pyramid and catalog entry as it arrives.
#[derive(Args)]
pub(crate) struct Ingest {
    /// Folder that the microscope writes to
    acquisition: PathBuf,

    #[command(flatten)]
    archive: Archive,

    /// End once everything that is there is done, instead of following; with 3 while images are set aside, or if records were, or images of a
    /// list are missing
    #[arg(long)]
    once: bool,

    #[command(flatten)]
    stored: Stored,

    /// Name of the volume [default: as the acquisition archive says]
    #[arg(long, value_parser = volume_name)]
    volume: Option<String>,

    #[command(flatten)]
    bare: Bare,

    /// Tiles in work at the same time [default: 2]
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u16).range(1..))]
    workers: Option<u16>,
}

/// How pyramids are stored.
#[derive(Args)]
#[group(multiple = false)]
pub(crate) struct Stored {
    /// Store as JPEG of this quality, 1 to 100 [default: 85]
    #[arg(long, value_name = "NUMBER", value_parser = clap::value_parser!(u8).range(1..=100))]
    quality: Option<u8>,

    /// Store every voxel as it is
    #[arg(long)]
    lossless: bool,
}

impl Stored {
    pub(crate) fn encoding(&self) -> Encoding {
        match self.quality {
            _ if self.lossless => Encoding::Lossless,
            Some(quality) => Encoding::Jpeg { quality },
            None => IngestOptions::DEFAULT.encoding,
        }
    }
}

/// What was taken in stays as it is stored: one that is asked for otherwise would be of both kinds.
async fn refuse_other_encoding(
    archive: &VisualizationArchive,
    volume: &str,
    stored: &Stored,
) -> Result<()> {
    let Ok(Some(pyramid)) = archive.catalog().pyramid_of(volume).await else {
        return Ok(());
    };
    // A damaged one is told by others.
    let Ok(index) = PyramidIndex::open(archive.storage().as_ref(), &pyramid).await else {
        return Ok(());
    };
    let is = archive.catalog().volume(volume).await?;
    let jpeg_can = is.dtype == Dtype::Uint8 && is.kind == VoxelKind::Intensity;
    let (option, stored_as) = match (index.is_lossless(), stored.lossless, stored.quality) {
        (false, true, _) => ("--lossless", "as JPEG"),
        (true, _, Some(_)) if jpeg_can => ("--quality", "losslessly"),
        _ => return Ok(()),
    };
    anyhow::bail!(
        "the tiles of volume {volume:?} that are there are stored {stored_as}, and {option} would not change them: leave \
         it out, or take all in anew under another name (--volume NAME) or into another archive"
    )
}

/// The acquisition archive is only read: nothing is made in or around it.
fn refuse_same_folder(acquisition: &Path, archive: &Path) -> Result<()> {
    anyhow::ensure!(
        !overlap(acquisition, archive)?,
        "the microscope's folder is only read: name another folder for the archive than {}",
        archive.display()
    );
    Ok(())
}

/// A volume's name from a folder's.
fn named_after(folder: &Path) -> String {
    let name = folder
        .file_name()
        .map(|name| name.to_string_lossy().into_owned());
    let name = name.filter(|name| check_name(name).is_ok());
    name.unwrap_or_else(|| NAMELESS.to_owned())
}

/// The volume of a folder by whose name none can be called.
const NAMELESS: &str = "volume";

/// What the command ends with when all was done once, but not all could be taken in.
const SET_ASIDE: u8 = 3;

/// The first of many, and how many more.
fn first<T>(all: &[T], say: impl Fn(&T) -> String) -> String {
    const SHOWN: usize = 3;
    let mut words: Vec<_> = all.iter().take(SHOWN).map(say).collect();
    if all.len() > SHOWN {
        words.push(format!("and {} more", all.len() - SHOWN));
    }
    words.join("; ")
}

/// Says what is set aside, and what still waits. How many images are: records that made no sense are past.
async fn say_what_is_left(
    catalog: &Catalog,
    volume: &str,
    quarantined: u64,
    watched: bool,
) -> Result<usize> {
    let all = catalog.quarantined(volume).await?;
    let before = all.len().saturating_sub(usize::try_from(quarantined)?);
    let status = format!("/v/{volume}/status.json of `saccade serve`");
    let parts = [
        (
            &all[..before],
            format!("set aside before, for reasons told by {status}"),
        ),
        (
            &all[before..],
            format!("set aside, for reasons told above and by {status}"),
        ),
    ];
    for (part, what) in parts {
        let named = first(part, |one| match &one.tile {
            Some(tile) => format!("{} (tile {tile})", one.file),
            None => one.file.clone(),
        });
        if !named.is_empty() {
            say(&format!("{what}: {named}"));
        }
    }
    let waiting = catalog.waiting(volume).await?;
    if !waiting.is_empty() {
        let named = first(&waiting, |one| {
            let (record, reason) = (&one.record, &one.reason);
            let file = match watched {
                true => watch::file_name(&record.file),
                false => &record.file,
            };
            format!("{file} (tile {}): {reason}", record.tile)
        });
        let count = waiting.len();
        say(&format!(
            "{count} unfinished, taken up when it is started again: {named}"
        ));
    }
    let images = all.iter().filter(|one| one.is_of_an_image());
    Ok(images.count())
}

/// Where what is found in folders without records is kept.
pub(super) fn beside(location: &ArchiveLocation) -> Option<PathBuf> {
    match (location.catalog(), location.folder()) {
        (CatalogLocation::File(file), _) => Some(file.with_file_name("watched")),
        (CatalogLocation::Postgres(_), folder) => folder.map(|folder| folder.join("watched")),
    }
}

/// A folder without records that is followed.
struct Begun {
    /// Where its images are.
    folder: PathBuf,
    /// Whoever goes on following it.
    watching: Option<JoinHandle<Result<u64>>>,
    /// Which images are not there, in words, where nobody waits for them.
    missing: Option<String>,
}

impl Ingest {
    /// Follows a folder without records; `None` if that was cancelled before it was known what it shows.
    async fn begin(
        &self,
        followed: Followed,
        kept: &Path,
        cancel: &Cancel,
        held_up: HeldUp,
    ) -> Result<Option<Begun>> {
        let shared = |leads: bool| {
            if !leads {
                say(
                    "another process watches this folder; what it finds is shared, and should it end, this one goes on",
                );
            }
        };
        let (once, cancel) = (self.once, cancel.clone());
        Ok(match followed {
            Followed::Records => None,
            Followed::Pattern(config) => {
                let mut watch =
                    Watch::open(config, Disk, &self.acquisition, kept)?.telling(held_up);
                shared(watch.leads());
                let folder = watch.folder().to_owned();
                let (mut watching, mut missing) = (None, None);
                if once {
                    watch::run(&mut watch, true, &cancel)?;
                    if let Some(why) = watch.unmatched() {
                        anyhow::bail!("{why}; give --pattern as the files are named");
                    }
                    missing = watch.missing();
                } else {
                    let looks = move || Ok(watch::run(&mut watch, false, &cancel)?);
                    watching = Some(tokio::task::spawn_blocking(looks));
                }
                Some(Begun {
                    folder,
                    watching,
                    missing,
                })
            }
            Followed::List(config) => {
                let watch = ListWatch::open(config, Disk, &self.acquisition, kept)?;
                let mut watch = watch.telling(held_up);
                shared(watch.leads());
                let until = if once { Until::End } else { Until::Known };
                let ends = cancel.clone();
                let begin = move || {
                    let begun = watch::follow(&mut watch, until, once, &ends);
                    begun.map(|_| watch)
                };
                let mut watch = tokio::task::spawn_blocking(begin).await??;
                if !watch.is_known() {
                    return Ok(None);
                }
                let folder = watch.folder().to_owned();
                let missing = watch.missing().filter(|_| once);
                let watching = (!once).then(|| {
                    let looks = move || Ok(watch::follow(&mut watch, Until::End, false, &cancel)?);
                    tokio::task::spawn_blocking(looks)
                });
                Some(Begun {
                    folder,
                    watching,
                    missing,
                })
            }
        })
    }

    /// Waits for a folder or a list that was followed before and is not there, as one that is followed is waited for.
    async fn wait_for_what_is_away(
        &self,
        location: &ArchiveLocation,
        name: &str,
        kept: &Path,
        cancel: &Cancel,
    ) -> Result<()> {
        let away = || self.bare.away(&self.acquisition, kept);
        let Some((path, what)) = away() else {
            return Ok(());
        };
        let path = path.display();
        log::warn!(
            "{what} that was followed before is not there, and is waited for; check its disk or network, or end this with \
             Ctrl-C: {path}"
        );
        let opened = waited_for(|| VisualizationArchive::create(location));
        let archive = tokio::select! {
            archive = opened => archive?,
            () = cancel.cancelled() => return Ok(()),
        };
        let why =
            format!("{what} that was followed before is not there; check its disk or network");
        let options = IngestOptions::DEFAULT;
        wait_until_there(&archive, name, &why, &options, || away().is_none(), cancel).await;
        archive.catalog().close().await;
        if !cancel.is_cancelled() {
            log::warn!("{what} is there again: {path}");
        }
        Ok(())
    }

    /// How it ends when it is interrupted: who follows ends only so; of who looks once, something may be left.
    fn interrupted(&self) -> ExitCode {
        if !self.once {
            return ExitCode::SUCCESS;
        }
        say("interrupted; the same command takes in what is left");
        ExitCode::from(INTERRUPTED)
    }

    /// What to follow; `None` if that was cancelled. What says it may be about to be written: it is read again, unless all
    /// is said to be there.
    async fn followed(
        &self,
        name: &str,
        kept: Option<&Path>,
        cancel: &Cancel,
    ) -> Result<Option<Followed>> {
        /// Looks at the same mistake after which it is told where another one was: each part of a file that is being
        /// written may show one of its own.
        const LOOKS: u32 = 12;
        let settled = self.bare.settled();
        let (mut said, mut wrong, mut looks) = (String::new(), String::new(), 0);
        loop {
            let found = self.bare.followed(&self.acquisition, name, kept);
            let found = found.and_then(|followed| {
                if matches!(followed, Followed::Records) {
                    let named = self.volume.as_deref();
                    AcquisitionInfo::read_volume(&self.acquisition, named)?;
                }
                Ok(followed)
            });
            let error = match found {
                Ok(followed) => return Ok(Some(followed)),
                Err(error) if self.once || !is_being_written(&error, settled) => return Err(error),
                Err(error) => error,
            };
            let now = format!("{error:#}");
            looks = if now == wrong { looks + 1 } else { 0 };
            wrong = now;
            if wrong != said && (said.is_empty() || looks >= LOOKS) {
                said.clone_from(&wrong);
                log::warn!(
                    "{said}; it was written just now, and is read again in case it is not whole yet, until it has not changed \
                     for {} s",
                    settled.as_secs()
                );
            }
            tokio::select! {
                () = SystemClock.sleep(IngestOptions::DEFAULT.poll) => {}
                () = cancel.cancelled() => return Ok(None),
            }
        }
    }

    pub(crate) async fn run(self) -> Result<ExitCode> {
        // Before the archive is made: a wrong first folder should not leave a second one behind.
        let name = self
            .volume
            .clone()
            .unwrap_or_else(|| named_after(&self.acquisition));
        let location = self.archive.location()?;
        let beside = beside(&location);
        let kept = beside.as_ref().map(|beside| beside.join(&name));
        let cancel = cancel_when_interrupted();
        // Who waits for the end is told that there is nothing, rather than kept.
        if let Some(kept) = kept.as_ref().filter(|_| !self.once) {
            self.wait_for_what_is_away(&location, &name, kept, &cancel)
                .await?;
            if cancel.is_cancelled() {
                return Ok(self.interrupted());
            }
        }
        let followed = self.followed(&name, kept.as_deref(), &cancel).await?;
        let Some(followed) = followed else {
            return Ok(self.interrupted());
        };
        if let Some(folder) = location.folder() {
            refuse_same_folder(&self.acquisition, folder)?;
        }
        let opened = waited_for(|| VisualizationArchive::create(&location));
        let archive = tokio::select! {
            archive = opened => archive?,
            () = cancel.cancelled() => return Ok(self.interrupted()),
        };
        let mut options = IngestOptions {
            volume: self.volume.clone(),
            folder: location.folder().map(Path::to_owned),
            encoding: self.stored.encoding(),
            once: self.once,
            workers: self
                .workers
                .map_or(IngestOptions::DEFAULT.workers, usize::from),
            ..IngestOptions::DEFAULT
        };
        let mut acquisition = self.acquisition.clone();
        let mut watching = None;
        let mut missing = None;
        if !matches!(followed, Followed::Records) {
            if self.volume.is_none() && name == NAMELESS && !self.acquisition.ends_with(NAMELESS) {
                say(&format!(
                    "the volume is called {NAMELESS:?}, for the folder's name cannot name one (ASCII letters, digits, '-', '_' and '.'): \
                     --volume gives it another, and each further such folder needs one"
                ));
            }
            let Some(kept) = kept else {
                anyhow::bail!(
                    "what is found in a folder without records is kept beside the pyramids or the catalog, which \
                     are both elsewhere: name a file with --catalog, or a folder as archive"
                );
            };
            acquisition.clone_from(&kept);
            let held_up = HeldUp::default();
            options.held_up = Some(held_up.clone());
            let begun = self.begin(followed, &kept, &cancel, held_up).await?;
            let Some(begun) = begun.filter(|_| !cancel.is_cancelled()) else {
                return Ok(self.interrupted());
            };
            options.linked = Some(begun.folder);
            (watching, missing) = (begun.watching, begun.missing);
        }
        let into = options.volume.clone();
        let into = into.or_else(|| {
            AcquisitionInfo::read(&acquisition)
                .ok()
                .map(|info| info.name)
        });
        if let Some(volume) = &into {
            refuse_other_encoding(&archive, volume, &self.stored).await?;
        }
        let shown = Shown::new("ingest", None);
        let mut taken_in = pin!(run(&acquisition, &archive, &options, &shown, &cancel));
        let done = match &mut watching {
            None => taken_in.await,
            // Whichever fails first is told; both end when they are cancelled, and what is being written is given up in order.
            Some(watching) => tokio::select! {
                done = &mut taken_in => done,
                ended = watching => {
                    cancel.cancel();
                    let done = taken_in.await;
                    ended??;
                    done
                }
            },
        };
        let is_interrupted = cancel.is_cancelled();
        cancel.cancel();
        shown.finish();
        let Summary {
            tiles,
            elsewhere,
            moved,
            deleted,
            quarantined,
            early,
            ..
        } = done?;
        let volume = match &options.volume {
            Some(name) => Some(name.clone()),
            None => AcquisitionInfo::read(&acquisition)
                .ok()
                .map(|info| info.name),
        };
        let mut set_aside = usize::try_from(quarantined)?;
        if let Some(volume) = volume {
            let watched = options.linked.is_some();
            match say_what_is_left(archive.catalog(), &volume, quarantined, watched).await {
                Ok(images) => set_aside = set_aside.max(images),
                Err(e) => log::warn!("what is left cannot be told: {e}"),
            }
        }
        archive.catalog().close().await;
        let mut done = format!("{tiles} tiles taken in, {moved} moved, {quarantined} set aside");
        if elsewhere > 0 {
            done.push_str(&format!(
                ", {elsewhere} in the place of one of their name in another section"
            ));
        }
        if deleted > 0 {
            done.push_str(&format!(", {deleted} deleted"));
        }
        if early > 0 {
            done.push_str(&format!(", {early} transforms of tiles that have not come"));
        }
        say(&format!("{done}: {location}"));
        if let Some(missing) = &missing {
            say(&format!(
                "{missing}; those that are there by then are taken in when it is started again"
            ));
        }
        if is_interrupted {
            return Ok(self.interrupted());
        }
        let all = !self.once || (set_aside == 0 && missing.is_none());
        Ok(if all {
            ExitCode::SUCCESS
        } else {
            ExitCode::from(SET_ASIDE)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Those that the help names.
    #[test]
    fn defaults_are_as_told() {
        let default = IngestOptions::DEFAULT;
        assert_eq!(default.workers, 2);
        assert_eq!(default.encoding, Encoding::Jpeg { quality: 85 });
    }

    #[test]
    fn the_microscope_keeps_its_folder() {
        let folder = tempfile::tempdir().unwrap();
        let acquisition = folder.path().join("acquisition");
        std::fs::create_dir(&acquisition).unwrap();
        let inside = acquisition.join("a/b");
        let around = acquisition.join("../acquisition");
        for bad in [acquisition.as_path(), &inside, &around, folder.path()] {
            assert!(
                refuse_same_folder(&acquisition, bad).is_err(),
                "{}",
                bad.display()
            );
        }
        for good in ["archive", "acquisition2", "deep/archive"] {
            assert!(
                refuse_same_folder(&acquisition, &folder.path().join(good)).is_ok(),
                "{good}"
            );
        }
    }
}
