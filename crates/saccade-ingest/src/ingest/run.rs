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
use saccade_archive::acquisition::RecordReader;
use saccade_archive::catalog::{CatalogError, Waiting, Worker};
use saccade_archive::clock::Clock;
use saccade_archive::storage::StorageError;
use tokio::sync::mpsc;

use super::begin::{Begun, begin};
use super::earlier::Earlier;
use super::enter::{COMMIT_AT_ONCE, Enter, SetAside};
use super::images::Images;
use super::prepare::{Context, Stored};
use super::reasons::{self, Called};
use super::supply::{Job, Supply};
use super::waiting::WaitingRoom;
use super::{IngestError, IngestOptions, process};
use crate::cancel::Cancel;
use crate::held_up::{Heard, HeldUp, Part};
use crate::progress::{Meter, Progress, State};

/// Longest pause between looks for workers of this machine that were killed.
const LOOK_FOR_THE_DEAD: Duration = Duration::from_secs(1);

/// Retired pyramids deleted per look.
const DELETE_AT_ONCE: u32 = 64;
/// How long ending waits for what was given up.
const SETTLING: Duration = Duration::from_secs(5);

/// What was done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Summary {
    /// Tiles entered, or entered again.
    pub tiles: u64,
    /// Those of them that took the place of one of their name in another section.
    pub elsewhere: u64,
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
        clock: archive.catalog().clock(),
    };
    let progress: &dyn Progress = &heard;
    let catalog = archive.catalog();
    let clock = catalog.clock();
    let begun = {
        let begin = pin!(begin(acquisition, archive, options, progress));
        match select(begin, pin!(cancel.cancelled())).await {
            Either::Left((begun, _)) => begun?,
            // Whoever it says is at work is gone, as others find.
            Either::Right(_) => return Ok(Summary::default()),
        }
    };
    let Begun {
        volume,
        reader,
        earlier,
        worker,
    } = begun;
    let (stored, why) = Stored::new(volume.dtype, volume.kind, options.encoding);
    if let Some(why) = why {
        progress.notice(why);
    }
    let images = Images::new(acquisition, options.linked.as_deref());
    let called = called(acquisition, archive, options);
    let mut ingest = Ingest {
        archive,
        options,
        context: Context {
            images,
            volume: &volume.name,
            extent: volume.extent(),
            channels: &volume.channels,
            stored,
            archive,
            options,
            progress,
            called: &called,
            set_aside: SetAside::default(),
        },
        worker: &worker,
        reader,
        room: WaitingRoom::new(options.patience, options.poll, Vec::new()),
        earlier,
        held_up: held_up.clone(),
        meter: Meter::new(clock.monotonic()),
        summary: Summary::default(),
        left: AtomicU64::new(0),
    };
    let done = {
        let work = pin!(ingest.follow());
        let cancelled = pin!(cancel.cancelled());
        let alive = pin!(keep_alive(archive, &worker));
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
    // What was given up in its midst would lie in an object store for ever.
    let settled = archive.storage().settled();
    if tokio::time::timeout(SETTLING, settled).await.is_err() {
        log::warn!("parts of what was being written may be left in the object store, unseen");
    }
    if let Err(error) = done {
        return Err(match error {
            IngestError::Catalog(error) => catalog.look_again(error).await.into(),
            other => other,
        });
    }
    ingest.summary.early = catalog.statistics(&volume.name).await?.early;
    Ok(ingest.summary)
}

/// What those who look from elsewhere need not know.
fn called(acquisition: &Path, archive: &VisualizationArchive, options: &IngestOptions) -> Called {
    let mut called = Called::default();
    // What lies in another comes first.
    called.call(&archive.catalog().location().to_string(), "the catalog");
    let folders = [
        (options.linked.as_deref(), "the acquisition's folder"),
        (Some(acquisition), "the acquisition's folder"),
        (options.folder.as_deref(), "the archive's folder"),
    ];
    for (path, name) in folders {
        if let Some(path) = path {
            called.call(&path.to_string_lossy(), name);
        }
    }
    called
}

/// Gives signs of life, until dropped. Without them, others take over: that is what they are for. Those of this
/// machine that can give none are looked for, however much there is to do.
async fn keep_alive(archive: &VisualizationArchive, worker: &Worker) {
    let pause = (worker.lease() / 4).min(LOOK_FOR_THE_DEAD);
    let clock = archive.catalog().clock();
    let mut sign = clock.monotonic();
    let mut look = sign;
    let mut told = None;
    loop {
        clock.sleep(pause).await;
        if clock.monotonic() - sign + pause > worker.lease() / 4 {
            sign = clock.monotonic();
            let why = archive.catalog().keep_alive(worker).await.err();
            let why = why.map(|e| e.to_string());
            // A disk may be full for days: once is enough.
            if let Some(why) = why.as_ref().filter(|_| told != why) {
                log::warn!("no sign of life could be given: {why}");
            }
            told = why;
        }
        if clock.monotonic() - look + pause > LOOK_FOR_THE_DEAD {
            look = clock.monotonic();
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
    earlier: Option<Earlier>,
    held_up: HeldUp,
    meter: Meter,
    summary: Summary,
    /// Records still to do, as far as this worker knows.
    left: AtomicU64,
}

impl Ingest<'_> {
    fn clock(&self) -> &dyn Clock {
        self.archive.catalog().clock()
    }

    async fn follow(&mut self) -> Result<(), IngestError> {
        loop {
            // Before anything is concluded from what the catalog says.
            self.context
                .retry(|| self.archive.catalog().verify())
                .await?;
            let images = self.context.images;
            let due = self.room.due(images, self.options.batch);
            for notice in self.room.news(images) {
                self.context.progress.notice(&notice);
            }
            if let Some(earlier) = &mut self.earlier {
                loop {
                    for waiting in earlier.read(images) {
                        self.room.look_for(waiting);
                    }
                    // Who waits for the end is not kept waiting for longer than it takes.
                    if !self.options.once || earlier.is_read() {
                        break;
                    }
                }
                if earlier.is_read() {
                    self.earlier = None;
                }
            }
            let came = self.room.came(images);
            let looks_on = !came.is_empty() || !self.room.has_looked_for_all();
            self.take_up(came).await?;
            let due: VecDeque<_> = due.into_iter().map(Job::from).collect();
            let worked = self.work(due).await?;
            let waits_for = self.room.waits_for(images);
            self.held_up
                .tell(Part::Images, waits_for.as_deref(), self.clock().now());
            self.delete_retired().await?;
            let (queued, waiting) = self.count().await?;
            // Whoever read them: what others did is in the queue.
            let cursor = || self.archive.catalog().cursor(self.context.volume);
            let read = self.context.retry(cursor).await?;
            let remaining = self.reader.at(read).remaining_lines();
            self.left.store(queued + remaining, Ordering::Relaxed);
            self.context.progress.update(&state(
                &self.summary,
                self.meter.mpixel_per_s(self.clock().monotonic()),
                &self.room,
                &self.left,
            ));
            if worked == 0 && queued + waiting > 0 {
                let bury = || bury_the_dead(self.archive);
                self.context.retry(bury).await?;
            }
            // Others may still be at work; should they die, it is this one's turn.
            if worked == 0 && self.options.once && queued + waiting == 0 && !looks_on {
                return Ok(());
            }
            if worked < self.options.batch {
                self.clock().sleep(self.options.poll).await;
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
                commit.take_up(waiting).await?;
            }
            commit.finish().await
        };
        self.context.retry(queue).await?;
        Ok(())
    }

    async fn count(&self) -> Result<(u64, u64), IngestError> {
        let count = || self.archive.catalog().queued(self.context.volume);
        Ok(self.context.retry(count).await?)
    }

    /// Deletes pyramids that nobody should be reading any more.
    async fn delete_retired(&mut self) -> Result<(), IngestError> {
        let catalog = self.archive.catalog();
        let before = self.clock().now().checked_sub(self.options.keep_retired);
        let before = before.unwrap_or(SystemTime::UNIX_EPOCH);
        let volume = self.context.volume;
        let list = || catalog.retired(volume, before, DELETE_AT_ONCE);
        let retired = self.context.retry(list).await?;
        let mut done = Vec::new();
        for old in retired {
            let named = || catalog.is_named(volume, &old.pyramid);
            if self.context.retry(named).await? {
                log::warn!(
                    "a tile names the pyramid {}, which was to be deleted: it is kept",
                    old.pyramid
                );
                done.push(old.pyramid);
                continue;
            }
            match self.archive.storage().delete(&old.pyramid).await {
                Ok(()) => done.push(old.pyramid),
                // There is none.
                Err(StorageError::Name { .. }) => done.push(old.pyramid),
                // They stay on the list. What is written next waits, and says so.
                Err(e) if e.is_outage() => break,
                Err(e) => log::warn!("cannot delete the replaced pyramid {}: {e}", old.pyramid),
            }
        }
        if done.is_empty() {
            return Ok(());
        }
        let forget = async || {
            let mut commit = catalog.begin(volume).await?;
            for pyramid in &done {
                commit.forget_retired(pyramid).await?;
            }
            commit.finish().await
        };
        self.context.retry(forget).await?;
        Ok(())
    }
}

pub(super) fn state(
    summary: &Summary,
    mpixel_per_s: f64,
    room: &WaitingRoom,
    left: &AtomicU64,
) -> State {
    State {
        tiles: summary.tiles,
        pixels: summary.pixels,
        queued: left.load(Ordering::Relaxed),
        waiting: room.len(),
        quarantined: summary.quarantined,
        mpixel_per_s,
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
