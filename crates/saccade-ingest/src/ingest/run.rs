//! The loop: look, prepare several records at once, commit them in order.

use std::fs::File;
use std::future::Future;
use std::path::Path;
use std::pin::pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::SystemTime;

use futures::future::{Either, select};
use futures::{StreamExt, TryStreamExt};
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{
    AcquisitionError, AcquisitionInfo, Cursor, Record, RecordLine, RecordReader, TileRecord,
};
use saccade_archive::catalog::{
    CatalogError, CatalogLocation, DeleteOutcome, Quarantined, TileOutcome, TransformOutcome,
};
use saccade_core::volume::check_name;
use tokio::sync::mpsc;

use super::prepare::{Backoff, Context, Outcome, Stored};
use super::waiting::{Due, WaitingRoom};
use super::{IngestError, IngestOptions};
use crate::cancel::Cancel;
use crate::progress::{Meter, Progress, State};

/// Most records in one transaction: a sync for each would be slow for small tiles, and a
/// transaction for thousands would keep other writers waiting.
const COMMIT_AT_ONCE: usize = 64;

/// Retired pyramids deleted per look.
const DELETE_AT_ONCE: u32 = 64;

/// Attempts at reading the records when all that is there is to be done once.
const ATTEMPTS_ONCE: u32 = 4;

/// What was done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Summary {
    /// Tiles entered, or entered again.
    pub tiles: u64,
    /// Their pixels.
    pub pixels: u64,
    /// Tiles moved by transform records.
    pub moved: u64,
    /// Tiles deleted by records that say so.
    pub deleted: u64,
    /// Files and records put in quarantine.
    pub quarantined: u64,
    /// Transforms that wait for a tile that has not come, also those of earlier runs.
    pub early: u64,
}

/// Ingests an acquisition archive, until cancelled or, with `once`, until all that is there is done.
///
/// The volume is made if the catalog does not have it. A tile is acknowledged, in `progress` and by
/// the volume's revision, once its pyramid and its catalog entry would survive a power cut. When
/// the returned future is dropped, it ends like a killed process: safely.
///
/// # Errors
///
/// [`IngestError`]; never for a bad tile, and not for a full disk, which is waited out.
pub async fn run(
    acquisition: &Path,
    archive: &VisualizationArchive,
    options: &IngestOptions,
    progress: &dyn Progress,
    cancel: &Cancel,
) -> Result<Summary, IngestError> {
    let info = AcquisitionInfo::read(acquisition)?;
    let impossible = |source| IngestError::Volume {
        source,
        path: acquisition.join(AcquisitionInfo::FILE),
    };
    let mut volume = info.volume().map_err(impossible)?;
    match &options.volume {
        // The catalog looks at it; the file is not to blame.
        Some(name) => volume.name.clone_from(name),
        None => check_name(&volume.name).map_err(impossible)?,
    }
    archive.catalog().create_volume(&volume).await?;
    let _lock = lock(archive, &volume.name)?;

    let catalog = archive.catalog();
    let (stored, why) = Stored::new(volume.dtype, info.kind, options.encoding);
    if let Some(why) = why {
        progress.notice(why);
    }
    let cursor = catalog.cursor(&volume.name).await?;
    let waiting = catalog.waiting(&volume.name).await?;
    let mut ingest = Ingest {
        archive,
        options,
        context: Context {
            folder: acquisition,
            volume: &volume.name,
            extent: volume.extent(),
            channels: &volume.channels,
            stored,
            storage: archive.storage().as_ref(),
            retry: options.retry,
            progress,
        },
        reader: RecordReader::new(acquisition, cursor),
        room: WaitingRoom::new(options.patience, options.poll, waiting),
        meter: Meter::new(),
        summary: Summary::default(),
        left: AtomicU64::new(0),
    };
    {
        let work = pin!(ingest.follow());
        let stop = pin!(cancel.cancelled());
        match select(work, stop).await {
            Either::Left((result, _)) => result?,
            Either::Right(_) => {}
        }
    }
    ingest.summary.early = catalog.statistics(&volume.name).await?.early;
    Ok(ingest.summary)
}

/// One ingest at a time per volume. The system lets go of the lock when the process ends.
fn lock(archive: &VisualizationArchive, volume: &str) -> Result<Option<File>, IngestError> {
    let CatalogLocation::File(catalog) = archive.catalog().location() else {
        return Ok(None);
    };
    let path = catalog.with_file_name(format!("ingest-{volume}.lock"));
    let file = match File::create(&path) {
        Ok(file) => file,
        Err(source) => return Err(IngestError::Lock { source, path }),
    };
    match file.try_lock() {
        Ok(()) => Ok(Some(file)),
        Err(std::fs::TryLockError::WouldBlock) => Err(IngestError::AlreadyRunning {
            volume: volume.to_owned(),
            path,
        }),
        // Where there are no locks, the user keeps the order.
        Err(std::fs::TryLockError::Error(e)) => {
            log::warn!("cannot lock {}: {e}", path.display());
            Ok(Some(file))
        }
    }
}

struct Ingest<'a> {
    archive: &'a VisualizationArchive,
    options: &'a IngestOptions,
    context: Context<'a>,
    reader: RecordReader,
    room: WaitingRoom,
    meter: Meter,
    summary: Summary,
    /// Records read but not committed.
    left: AtomicU64,
}

/// A record on its way.
struct Job {
    position: u64,
    /// Where reading goes on after it; `None` for one that has waited.
    next: Option<Cursor>,
    work: Work,
}

enum Work {
    Tile(TileRecord),
    Done(Outcome),
}

/// A record that is ready to be committed.
struct Ready {
    position: u64,
    next: Option<Cursor>,
    outcome: Outcome,
}

impl Ingest<'_> {
    async fn follow(&mut self) -> Result<(), IngestError> {
        loop {
            let lines = self.read().await?;
            let read = lines.len();
            let folder = self.context.folder;
            let due = self.room.due(folder, self.options.batch);
            let jobs: Vec<_> = due
                .into_iter()
                .map(Job::from)
                .chain(lines.into_iter().map(Job::from))
                .collect();
            self.process(jobs).await?;
            self.delete_retired().await?;
            self.report();
            if read == 0 && self.options.once && self.room.len() == 0 {
                return Ok(());
            }
            if read < self.options.batch {
                tokio::time::sleep(self.options.poll).await;
            }
        }
    }

    /// The next records. A share that fails for a moment does not end the stream.
    async fn read(&mut self) -> Result<Vec<RecordLine>, IngestError> {
        let mut backoff = Backoff::new(self.options.retry);
        loop {
            match self.reader.read(self.options.batch.max(1)) {
                Ok(lines) => return Ok(lines),
                Err(e) => {
                    // Who waits for the end is told, rather than kept.
                    let patient = !self.options.once || backoff.failures < ATTEMPTS_ONCE;
                    let passing = patient && matches!(e, AcquisitionError::Read { .. });
                    if !backoff.may_go_on(false, passing) {
                        return Err(e.into());
                    }
                    backoff.say_and_wait(self.context.progress, &e).await;
                }
            }
        }
    }

    /// Prepares records, several at once, and commits them in order as they get ready.
    async fn process(&mut self, jobs: Vec<Job>) -> Result<(), IngestError> {
        if jobs.is_empty() {
            return Ok(());
        }
        self.left.store(jobs.len() as u64, Ordering::Relaxed);
        let (sender, mut receiver) = mpsc::channel(COMMIT_AT_ONCE);
        let context = &self.context;
        let prepare = async {
            // Moved in, so that it closes when the last record is ready.
            let sender = sender;
            let prepared = futures::stream::iter(jobs)
                .map(|job| job.prepare(context))
                .buffered(self.options.workers.max(1));
            let mut prepared = pin!(prepared);
            while let Some(ready) = prepared.try_next().await? {
                if sender.send(ready).await.is_err() {
                    break;
                }
            }
            Ok::<_, IngestError>(())
        };
        let mut committer = Committer {
            archive: self.archive,
            options: self.options,
            context: &self.context,
            reader: &self.reader,
            room: &mut self.room,
            meter: &mut self.meter,
            summary: &mut self.summary,
            left: &self.left,
        };
        let commit = async {
            let mut ready = Vec::new();
            while receiver.recv_many(&mut ready, COMMIT_AT_ONCE).await > 0 {
                committer.commit(std::mem::take(&mut ready)).await?;
            }
            Ok(())
        };
        // Both in this task: the work itself runs on blocking threads.
        futures::try_join!(prepare, commit)?;
        Ok(())
    }

    /// Deletes pyramids that nobody should be reading any more.
    async fn delete_retired(&mut self) -> Result<(), IngestError> {
        let catalog = self.archive.catalog();
        let before = SystemTime::now().checked_sub(self.options.keep_retired);
        let before = before.unwrap_or(SystemTime::UNIX_EPOCH);
        let volume = self.context.volume;
        let list = || catalog.retired(volume, before, DELETE_AT_ONCE);
        let retired = retry(self.options, self.context.progress, list).await?;
        let mut deleted = Vec::new();
        for old in retired {
            match self.archive.storage().delete(&old.pyramid).await {
                Ok(()) => deleted.push(old.pyramid),
                // It stays on the list.
                Err(e) => log::warn!("cannot delete the replaced pyramid {}: {e}", old.pyramid),
            }
        }
        if deleted.is_empty() {
            return Ok(());
        }
        retry(self.options, self.context.progress, async || {
            let mut commit = catalog.begin(volume).await?;
            for pyramid in &deleted {
                commit.forget_retired(pyramid).await?;
            }
            commit.finish().await
        })
        .await?;
        Ok(())
    }

    fn report(&self) {
        self.context.progress.update(&state(
            &self.summary,
            &self.meter,
            &self.room,
            self.reader.remaining_lines(),
        ));
    }
}

fn state(summary: &Summary, meter: &Meter, room: &WaitingRoom, queued: u64) -> State {
    State {
        tiles: summary.tiles,
        pixels: summary.pixels,
        queued,
        waiting: room.len(),
        quarantined: summary.quarantined,
        mpixel_per_s: meter.mpixel_per_s(),
    }
}

/// Tries a transaction again while the disk is full, and some times if the failure may pass.
async fn retry<T, F>(
    options: &IngestOptions,
    progress: &dyn Progress,
    mut transaction: impl FnMut() -> F,
) -> Result<T, CatalogError>
where
    F: Future<Output = Result<T, CatalogError>>,
{
    let mut backoff = Backoff::new(options.retry);
    loop {
        match transaction().await {
            Ok(value) => return Ok(value),
            Err(e) => {
                if !backoff.may_go_on(e.is_outage(), e.is_transient()) {
                    return Err(e);
                }
                backoff.say_and_wait(progress, &e).await;
            }
        }
    }
}

impl From<RecordLine> for Job {
    fn from(line: RecordLine) -> Self {
        let position = line.offset;
        let work = match line.record {
            Ok(Record::Tile(record)) => Work::Tile(record),
            Ok(Record::Transform(record)) => Work::Done(Outcome::Transform { record, position }),
            Ok(Record::Delete(record)) => Work::Done(Outcome::Delete { record, position }),
            Err(broken) => {
                let what = Quarantined {
                    file: RecordReader::FILE.to_owned(),
                    tile: None,
                    reason: format!("{broken}; append the record again as it should be"),
                    bytes: Some(line.next.offset - line.offset),
                    at: SystemTime::now(),
                };
                Work::Done(Outcome::Quarantine {
                    what,
                    pyramid: None,
                })
            }
        };
        Self {
            position,
            next: Some(line.next),
            work,
        }
    }
}

impl From<Due> for Job {
    fn from(due: Due) -> Self {
        match due {
            Due::Retry(waiting) => Self {
                position: waiting.position,
                next: None,
                work: Work::Tile(waiting.record),
            },
            Due::GiveUp { position, outcome } => Self {
                position,
                next: None,
                work: Work::Done(outcome),
            },
        }
    }
}

impl Job {
    async fn prepare(self, context: &Context<'_>) -> Result<Ready, IngestError> {
        let Self {
            position,
            next,
            work,
        } = self;
        let outcome = match work {
            Work::Tile(record) => context.tile(record, position).await?,
            Work::Done(outcome) => outcome,
        };
        Ok(Ready {
            position,
            next,
            outcome,
        })
    }
}

/// The second half of the pipeline.
struct Committer<'a> {
    archive: &'a VisualizationArchive,
    options: &'a IngestOptions,
    context: &'a Context<'a>,
    reader: &'a RecordReader,
    room: &'a mut WaitingRoom,
    meter: &'a mut Meter,
    summary: &'a mut Summary,
    left: &'a AtomicU64,
}

/// What a transaction did.
#[derive(Default)]
struct Done {
    summary: Summary,
    /// Pyramids that no tile names.
    orphans: Vec<String>,
    notices: Vec<String>,
}

impl Committer<'_> {
    async fn commit(&mut self, ready: Vec<Ready>) -> Result<(), IngestError> {
        let progress = self.context.progress;
        let done = retry(self.options, progress, || self.transaction(&ready)).await?;
        for notice in &done.notices {
            progress.notice(notice);
        }
        for orphan in &done.orphans {
            if let Err(e) = self.archive.storage().delete(orphan).await {
                log::warn!("cannot delete the unused pyramid {orphan}: {e}");
            }
        }
        self.summary.tiles += done.summary.tiles;
        self.summary.pixels += done.summary.pixels;
        self.summary.moved += done.summary.moved;
        self.summary.deleted += done.summary.deleted;
        self.summary.quarantined += done.summary.quarantined;
        self.meter.add(done.summary.pixels);
        let left = self.left.fetch_sub(ready.len() as u64, Ordering::Relaxed);
        let left = left - ready.len() as u64;
        for Ready {
            position, outcome, ..
        } in ready
        {
            match outcome {
                Outcome::Wait {
                    waiting,
                    look,
                    kind,
                } => self.room.admit(waiting, look, kind),
                _ => self.room.leave(position),
            }
        }
        let queued = left + self.reader.remaining_lines();
        progress.update(&state(self.summary, self.meter, self.room, queued));
        Ok(())
    }

    async fn transaction(&self, ready: &[Ready]) -> Result<Done, CatalogError> {
        let mut done = Done::default();
        let mut commit = self.archive.catalog().begin(self.context.volume).await?;
        for Ready {
            position,
            next,
            outcome,
        } in ready
        {
            match outcome {
                Outcome::Tile { tile, pixels } => {
                    match commit.tile(tile, SystemTime::now()).await? {
                        TileOutcome::New | TileOutcome::Replaced => {
                            done.summary.tiles += 1;
                            done.summary.pixels += pixels;
                        }
                        TileOutcome::Superseded => done.orphans.push(tile.pyramid.clone()),
                    }
                }
                Outcome::Transform { record, position } => {
                    let moved = commit.transform(&record.tile, record.transform, Some(*position));
                    match moved.await {
                        Ok(TransformOutcome::Moved) => done.summary.moved += 1,
                        Ok(TransformOutcome::Unchanged | TransformOutcome::Kept) => {}
                        Err(outside @ CatalogError::OutsideVolume { .. }) => {
                            let what = Quarantined {
                                file: RecordReader::FILE.to_owned(),
                                tile: Some(record.tile.clone()),
                                reason: format!("{outside}; until then it stays where it is"),
                                bytes: None,
                                at: SystemTime::now(),
                            };
                            done.quarantine(&mut commit, &what).await?;
                        }
                        Err(e) => return Err(e),
                    }
                }
                Outcome::Delete { record, position } => {
                    let now = SystemTime::now();
                    match commit.delete(&record.tile, *position, now).await? {
                        DeleteOutcome::Deleted => done.summary.deleted += 1,
                        DeleteOutcome::Unchanged | DeleteOutcome::Noted => {}
                    }
                }
                Outcome::Wait { waiting, .. } => commit.wait(waiting).await?,
                Outcome::Quarantine { what, pyramid } => {
                    done.quarantine(&mut commit, what).await?;
                    done.orphans.extend(pyramid.clone());
                }
            }
            match (next, outcome) {
                (Some(next), _) => commit.cursor(*next).await?,
                (None, Outcome::Wait { .. }) => {}
                (None, _) => commit.wait_no_more(*position).await?,
            }
        }
        commit.finish().await?;
        Ok(done)
    }
}

impl Done {
    async fn quarantine(
        &mut self,
        commit: &mut saccade_archive::catalog::Commit<'_>,
        what: &Quarantined,
    ) -> Result<(), CatalogError> {
        commit.quarantine(what).await?;
        self.summary.quarantined += 1;
        let tile = what
            .tile
            .as_deref()
            .map_or_else(String::new, |t| format!(" (tile {t})"));
        self.notices
            .push(format!("quarantined {}{tile}: {}", what.file, what.reason));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The binary runs it beside a server.
    #[test]
    fn it_can_be_spawned() {
        fn is_send<T: Send>(
            _: impl FnOnce(&'static VisualizationArchive, &'static IngestOptions) -> T,
        ) {
        }
        is_send(|archive, options| async move {
            run(Path::new(""), archive, options, &(), &Cancel::new()).await
        });
    }
}
