//! The loop: read what is new, claim records, work on several at once, enter them as they get ready.

use std::collections::VecDeque;
use std::path::Path;
use std::pin::pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use futures::TryStreamExt;
use futures::future::{Either, select};
use futures::stream::FuturesUnordered;
use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{
    AcquisitionInfo, Cursor, Record, RecordLine, RecordReader, TileRecord,
};
use saccade_archive::catalog::{CatalogError, Claim, Quarantined, Waiting, Worker};
use saccade_core::volume::check_name;
use tokio::sync::mpsc;
use tokio::time::Instant;

use super::enter::{COMMIT_AT_ONCE, Done, Enter, Ready, SetAside, retry};
use super::images::Images;
use super::prepare::{Context, Outcome, Stored, quarantine};
use super::records::patiently;
use super::waiting::{Due, WaitingRoom};
use super::{IngestError, IngestOptions, process, reasons};
use crate::cancel::Cancel;
use crate::held_up::Heard;
use crate::progress::{Meter, Progress, State};

/// Longest pause between looks for workers of this machine that were killed.
const LOOK_FOR_THE_DEAD: Duration = Duration::from_secs(1);

/// Retired pyramids deleted per look.
const DELETE_AT_ONCE: u32 = 64;

/// Workers that ended with a record in hand, after which it is worked on alone, so that if it ends another, no
/// other comes under suspicion.
const SUSPECT: u32 = 2;

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
    /// Files and records put in quarantine, without those that were mended since.
    pub quarantined: u64,
    /// Transforms that wait for a tile that has not come, also those of earlier runs.
    pub early: u64,
}

/// Ingests an acquisition archive, until cancelled or, with `once`, until all that is there is done.
///
/// The volume is made if the catalog does not have it. A tile is acknowledged, in `progress` and by
/// the volume's revision, once its pyramid and its catalog entry would survive a power cut. When
/// the returned future is dropped, it ends like a killed process: safely. Any number may work on one
/// volume, in one process or on several machines that share catalog and storage: each record is
/// worked on by one of them.
///
/// # Errors
///
/// [`IngestError`]; never for a bad tile, and not for a full disk or a catalog's server that is away,
/// which are waited out.
pub async fn run(
    acquisition: &Path,
    archive: &VisualizationArchive,
    options: &IngestOptions,
    progress: &dyn Progress,
    cancel: &Cancel,
) -> Result<Summary, IngestError> {
    let held_up = options.held_up.clone().unwrap_or_default();
    let heard = Heard {
        inner: progress,
        reasons: held_up.clone(),
    };
    let progress: &dyn Progress = &heard;
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
    let catalog = archive.catalog();
    retry(options, progress, || catalog.create_volume(&volume)).await?;
    // Before anything is worked on: what is in the queue may be of another acquisition.
    let cursor = retry(options, progress, || catalog.cursor(&volume.name)).await?;
    let mut reader = RecordReader::new(acquisition, cursor);
    let known = patiently(options, progress, || reader.recognize()).await?;
    if known != cursor {
        let learn = async || {
            let mut commit = catalog.begin(&volume.name).await?;
            // If another has read on, it has learned it as well.
            commit.advance(cursor, known).await?;
            commit.finish().await
        };
        retry(options, progress, learn).await?;
    }
    let (stored, why) = Stored::new(volume.dtype, volume.kind, options.encoding);
    if let Some(why) = why {
        progress.notice(why);
    }
    let (name, process) = (worker_name(), process::this().unwrap_or_default());
    let register = || catalog.register_process(&name, &process, options.lease);
    let worker = retry(options, progress, register).await?;
    let mut ingest = Ingest {
        archive,
        options,
        context: Context {
            images: Images::new(acquisition, options.linked.as_deref()),
            volume: &volume.name,
            extent: volume.extent(),
            channels: &volume.channels,
            stored,
            storage: archive.storage().as_ref(),
            catalog,
            options,
            progress,
            set_aside: SetAside::default(),
        },
        worker: &worker,
        reader,
        room: WaitingRoom::new(options.patience, options.poll, Vec::new()),
        meter: Meter::new(),
        summary: Summary::default(),
        left: AtomicU64::new(0),
    };
    let done = {
        let work = pin!(ingest.follow());
        let cancelled = pin!(cancel.cancelled());
        let alive = pin!(keep_alive(archive, &worker));
        let called = called(acquisition, archive, options);
        let told = pin!(reasons::tell(
            archive,
            &volume.name,
            &worker,
            &held_up,
            &called
        ));
        match select(work, select(cancelled, select(alive, told))).await {
            Either::Left((done, _)) => done,
            Either::Right(_) => Ok(()),
        }
    };
    // Others need not wait for the lease. If this fails, they do.
    let release = catalog.release(&worker);
    match tokio::time::timeout(options.lease, release).await {
        Ok(Ok(())) => {}
        Ok(Err(e)) => log::warn!("claimed records are free again when the lease is over: {e}"),
        Err(_) => log::warn!("claimed records are free again when the lease is over"),
    }
    done?;
    ingest.summary.early = catalog.statistics(&volume.name).await?.early;
    Ok(ingest.summary)
}

/// What those who look from elsewhere need not know.
fn called(
    acquisition: &Path,
    archive: &VisualizationArchive,
    options: &IngestOptions,
) -> reasons::Called {
    let catalog = archive.catalog().location().to_string();
    let linked = options.linked.as_deref().unwrap_or(acquisition);
    let folders = [linked, acquisition].map(|path| path.display().to_string());
    let [linked, acquisition] = folders.map(|path| (path, "the acquisition's folder"));
    vec![(catalog, "the catalog"), linked, acquisition]
}

/// What people call this worker.
pub(super) fn worker_name() -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    format!("{}:{}", host.trim(), std::process::id())
}

/// Gives signs of life, until dropped. Without them, others take over: that is what they are for. Those of this
/// machine that can give none are looked for, however much there is to do.
async fn keep_alive(archive: &VisualizationArchive, worker: &Worker) {
    let pause = (worker.lease() / 4).min(LOOK_FOR_THE_DEAD);
    let (mut sign, mut look) = (Instant::now(), Instant::now());
    loop {
        tokio::time::sleep(pause).await;
        if sign.elapsed() + pause > worker.lease() / 4 {
            sign = Instant::now();
            if let Err(e) = archive.catalog().keep_alive(worker).await {
                log::warn!("no sign of life could be given: {e}");
            }
        }
        if look.elapsed() + pause > LOOK_FOR_THE_DEAD {
            look = Instant::now();
            if let Err(e) = bury_the_dead(archive).await {
                log::debug!("workers that have ended could not be looked for: {e}");
            }
        }
    }
}

/// Frees what workers have claimed that were killed on this machine. The leases of others are waited for.
async fn bury_the_dead(archive: &VisualizationArchive) -> Result<(), CatalogError> {
    let catalog = archive.catalog();
    for process in catalog.processes().await? {
        if process::is_gone(&process) {
            catalog.bury(&process).await?;
            log::info!("a worker has ended without leave, its records are free: {process}");
        }
    }
    Ok(())
}

struct Ingest<'a> {
    archive: &'a VisualizationArchive,
    options: &'a IngestOptions,
    context: Context<'a>,
    worker: &'a Worker,
    reader: RecordReader,
    room: WaitingRoom,
    meter: Meter,
    summary: Summary,
    /// Records still to do, as far as this worker knows.
    left: AtomicU64,
}

/// A claimed record on its way.
struct Job {
    position: u64,
    work: Work,
}

enum Work {
    Tile(TileRecord),
    Done(Outcome),
}

impl Ingest<'_> {
    async fn follow(&mut self) -> Result<(), IngestError> {
        loop {
            let images = self.context.images;
            let due = self.room.due(images, self.options.batch);
            for notice in self.room.news(images) {
                self.context.progress.notice(&notice);
            }
            let came = self.room.came(images);
            self.take_up(came).await?;
            let due: VecDeque<_> = due.into_iter().map(Job::from).collect();
            let worked = self.work(due).await?;
            self.delete_retired().await?;
            let (queued, waiting) = self.count().await?;
            self.left
                .store(queued + self.reader.remaining_lines(), Ordering::Relaxed);
            self.context.progress.update(&state(
                &self.summary,
                &self.meter,
                &self.room,
                &self.left,
            ));
            if worked == 0 && queued + waiting > 0 {
                let bury = || bury_the_dead(self.archive);
                retry(self.options, self.context.progress, bury).await?;
            }
            // Others may still be at work; should they die, it is this one's turn.
            if worked == 0 && self.options.once && queued + waiting == 0 {
                return Ok(());
            }
            if worked < self.options.batch {
                tokio::time::sleep(self.options.poll).await;
            }
        }
    }

    /// Works on records that are due, and on new ones, a batch at most: prepares several at once, and
    /// enters them as they get ready. Returns how many records were worked on or read.
    async fn work(&mut self, due: VecDeque<Job>) -> Result<usize, IngestError> {
        let mut supply = Supply {
            archive: self.archive,
            options: self.options,
            context: &self.context,
            worker: self.worker,
            reader: &mut self.reader,
            left: &self.left,
            queue: due,
            suspects: Vec::new(),
            budget: self.options.batch.max(1),
            worked: 0,
            blocked: false,
            summary: Summary::default(),
        };
        // What says where tiles lie, and which are gone, is not kept behind other tiles' images.
        supply.read_ahead().await?;
        let mut enter = Enter {
            archive: self.archive,
            options: self.options,
            context: &self.context,
            worker: self.worker,
            room: &mut self.room,
            meter: &mut self.meter,
            summary: &mut self.summary,
            left: &self.left,
        };
        enter_all(&mut supply, &mut enter, self.options.workers.max(1)).await?;
        for suspect in std::mem::take(&mut supply.suspects) {
            supply.queue.push_back(suspect);
            supply.budget = 0;
            enter_all(&mut supply, &mut enter, 1).await?;
        }
        // What waits for others is still to be done.
        let worked = supply.worked.max(usize::from(supply.blocked));
        let read = supply.summary;
        self.summary.moved += read.moved;
        self.summary.deleted += read.deleted;
        self.summary.quarantined = self.context.set_aside.count();
        Ok(worked)
    }

    /// Puts records in the queue whose image came after they were set aside.
    async fn take_up(&self, came: Vec<Waiting>) -> Result<(), IngestError> {
        if came.is_empty() {
            return Ok(());
        }
        let catalog = self.archive.catalog();
        let queue = async || {
            let mut commit = catalog.begin(self.context.volume).await?;
            for waiting in &came {
                commit.enqueue(waiting).await?;
            }
            commit.finish().await
        };
        retry(self.options, self.context.progress, queue).await?;
        Ok(())
    }

    async fn count(&self) -> Result<(u64, u64), IngestError> {
        let count = || self.archive.catalog().queued(self.context.volume);
        Ok(retry(self.options, self.context.progress, count).await?)
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
                // They stay on the list. What is written next waits, and says so.
                Err(e) if e.is_outage() => break,
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
}

pub(super) fn state(
    summary: &Summary,
    meter: &Meter,
    room: &WaitingRoom,
    left: &AtomicU64,
) -> State {
    State {
        tiles: summary.tiles,
        pixels: summary.pixels,
        queued: left.load(Ordering::Relaxed),
        waiting: room.len(),
        quarantined: summary.quarantined,
        mpixel_per_s: meter.mpixel_per_s(),
    }
}

/// Where work comes from.
struct Supply<'a> {
    archive: &'a VisualizationArchive,
    options: &'a IngestOptions,
    context: &'a Context<'a>,
    worker: &'a Worker,
    reader: &'a mut RecordReader,
    left: &'a AtomicU64,
    queue: VecDeque<Job>,
    /// To be worked on alone, at the end.
    suspects: Vec<Job>,
    /// Records that may still be claimed before it is time to look after those that wait.
    budget: usize,
    worked: usize,
    /// Whether there are records that have to wait for others.
    blocked: bool,
    /// Of what was done while reading.
    summary: Summary,
}

impl Supply<'_> {
    async fn next(&mut self) -> Result<Option<Job>, IngestError> {
        if self.queue.is_empty() && self.budget > 0 && self.suspects.is_empty() {
            let mut claimed = self.claim().await?;
            if claimed == 0 && self.read_ahead().await? {
                claimed = self.claim().await?;
            }
            self.budget = self.budget.saturating_sub(claimed);
        }
        let job = self.queue.pop_front();
        self.worked += usize::from(job.is_some());
        if let Some(Job { position, .. }) = job {
            // Should it end this worker, it is known to have been in hand.
            let (catalog, volume) = (self.archive.catalog(), self.context.volume);
            let begin = || catalog.begin_record(volume, self.worker, position);
            retry(self.options, self.context.progress, begin).await?;
        }
        Ok(job)
    }

    async fn claim(&mut self) -> Result<usize, IngestError> {
        let (options, progress) = (self.options, self.context.progress);
        // A few more than are worked on at once: each claim is a question to the catalog, but what is
        // claimed and waits is nobody else's.
        let most = (4 * options.workers.max(1)).min(self.budget);
        let most = u32::try_from(most).unwrap_or(u32::MAX);
        let (catalog, volume) = (self.archive.catalog(), self.context.volume);
        let claim = || catalog.claim(volume, self.worker, most);
        let claims = retry(options, progress, claim).await?;
        let claimed = claims.len();
        if claimed > 0 {
            // Somebody may have read them from another acquisition since this one last looked.
            self.catch_up().await?;
        }
        for claim in claims {
            let deaths = claim.deaths;
            let job = Job::claimed(claim, options, self.context.images);
            if deaths >= SUSPECT {
                self.suspects.push(job);
            } else {
                self.queue.push_back(job);
            }
        }
        Ok(claimed)
    }

    /// Goes to where the volume's records were read up to, whoever did, if they are these: what is in the queue is not
    /// to be looked for in another acquisition's images.
    async fn catch_up(&mut self) -> Result<Cursor, IngestError> {
        let (options, progress) = (self.options, self.context.progress);
        let (catalog, volume) = (self.archive.catalog(), self.context.volume);
        let from = retry(options, progress, || catalog.cursor(volume)).await?;
        if self.reader.cursor() != from {
            *self.reader = self.reader.at(from);
        }
        patiently(options, progress, || self.reader.recognize()).await?;
        Ok(from)
    }

    /// Reads new records: tiles are put in the queue, the rest is done with at once, up to one that
    /// speaks of a tile whose older records are still in the queue. Whether there were any.
    async fn read_ahead(&mut self) -> Result<bool, IngestError> {
        let (options, progress) = (self.options, self.context.progress);
        let (catalog, volume) = (self.archive.catalog(), self.context.volume);
        let batch = options.batch.max(1);
        // Another worker may have read on.
        let from = self.catch_up().await?;
        let (queued, _) = retry(options, progress, || catalog.queued(volume)).await?;
        if queued >= batch as u64 {
            return Ok(false);
        }
        let lines = patiently(options, progress, || self.reader.read(batch)).await?;
        self.blocked = false;
        if lines.is_empty() {
            self.left.store(queued, Ordering::Relaxed);
            return Ok(false);
        }
        let lines: Vec<_> = lines.into_iter().map(|l| (l.next, New::from(l))).collect();
        let (taken, done) = retry(options, progress, async || {
            let mut commit = catalog.begin(volume).await?;
            let mut done = Done::default();
            let (mut taken, mut to) = (0, from);
            for (next, line) in &lines {
                match line {
                    New::Tile(waiting) => commit.enqueue(waiting).await?,
                    New::Done(outcome) => {
                        // It is about what the tile is once all that came before is done.
                        let tile = outcome.tile();
                        if tile.is_some() && commit.is_queued(tile.unwrap_or_default()).await? {
                            break;
                        }
                        done.apply(&mut commit, outcome).await?;
                    }
                }
                (taken, to) = (taken + 1, *next);
            }
            if taken == 0 || !commit.advance(from, to).await? {
                return Ok((0, Done::default()));
            }
            commit.finish().await?;
            Ok((taken, done))
        })
        .await?;
        self.context.set_aside.note(done.changes);
        self.blocked = taken < lines.len();
        for notice in &done.notices {
            progress.notice(notice);
        }
        let at_once = lines[..taken]
            .iter()
            .filter(|(_, l)| matches!(l, New::Done(_)));
        self.worked += at_once.count();
        self.summary.moved += done.summary.moved;
        self.summary.deleted += done.summary.deleted;
        let left = queued + lines.len() as u64 + self.reader.remaining_lines();
        self.left.store(left, Ordering::Relaxed);
        Ok(taken > 0)
    }
}

/// Works on all there is, `workers` at once.
async fn enter_all(
    supply: &mut Supply<'_>,
    enter: &mut Enter<'_>,
    workers: usize,
) -> Result<(), IngestError> {
    let context = supply.context;
    let (sender, mut receiver) = mpsc::channel(COMMIT_AT_ONCE);
    let prepare = async {
        // Moved in, so that it closes when the last record is ready.
        let sender = sender;
        // They end in whatever order they get ready: what becomes of a tile follows from its records.
        let mut busy = FuturesUnordered::new();
        loop {
            while busy.len() < workers
                && let Some(job) = supply.next().await?
            {
                busy.push(job.prepare(context));
            }
            let Some(ready) = busy.try_next().await? else {
                break;
            };
            if sender.send(ready).await.is_err() {
                break;
            }
        }
        Ok::<_, IngestError>(())
    };
    let commit = async {
        let mut ready = Vec::new();
        while receiver.recv_many(&mut ready, COMMIT_AT_ONCE).await > 0 {
            enter.commit(std::mem::take(&mut ready)).await?;
        }
        Ok(())
    };
    // Both in this task: the work itself runs on blocking threads.
    futures::try_join!(prepare, commit)?;
    Ok(())
}

/// A record that was read just now.
enum New {
    Tile(Waiting),
    Done(Outcome),
}

impl From<RecordLine> for New {
    fn from(line: RecordLine) -> Self {
        let position = line.offset;
        match line.record {
            Ok(Record::Tile(record)) => Self::Tile(Waiting {
                position,
                record,
                reason: "its turn has not come".to_owned(),
            }),
            Ok(Record::Transform(record)) => Self::Done(Outcome::Transform { record, position }),
            Ok(Record::Delete(record)) => Self::Done(Outcome::Delete { record, position }),
            Err(broken) => {
                // By the image, if the line names one: that is what people look for.
                let what = Quarantined {
                    file: broken
                        .file
                        .clone()
                        .unwrap_or_else(|| RecordReader::FILE.to_owned()),
                    tile: broken.tile.clone(),
                    reason: format!("{broken}; append the record again as it should be"),
                    bytes: Some(line.next.offset - line.offset),
                    at: SystemTime::now(),
                };
                Self::Done(Outcome::Quarantine {
                    what,
                    pyramid: None,
                })
            }
        }
    }
}

impl From<Due> for Job {
    fn from(due: Due) -> Self {
        match due {
            Due::Retry(waiting) => Self {
                position: waiting.position,
                work: Work::Tile(waiting.record),
            },
            Due::GiveUp { position, outcome } => Self {
                position,
                work: Work::Done(outcome),
            },
        }
    }
}

impl Job {
    fn claimed(claim: Claim, options: &IngestOptions, images: Images<'_>) -> Self {
        let Claim {
            waiting: Waiting {
                position, record, ..
            },
            deaths,
            ..
        } = claim;
        let work = if deaths >= options.attempts {
            let then = if images.are_watched() {
                "write it again as another"
            } else {
                "append its record again"
            };
            let reason = format!(
                "{deaths} workers ended while they worked on it; look at the image, and {then}"
            );
            Work::Done(quarantine(images, &record, reason, None, None))
        } else {
            Work::Tile(record)
        };
        Self { position, work }
    }

    async fn prepare(self, context: &Context<'_>) -> Result<Ready, IngestError> {
        let Self { position, work } = self;
        let outcome = match work {
            Work::Tile(record) => context.tile(record, position).await?,
            Work::Done(outcome) => outcome,
        };
        Ok(Ready { position, outcome })
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
