//! Where work comes from: records that wait, claims, and what is read of the acquisition archive.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};

use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::{Cursor, Record, RecordLine, RecordReader, TileRecord};
use saccade_archive::catalog::{Claim, Waiting, Worker};

use super::enter::{Done, Ready};
use super::images::Images;
use super::prepare::{Context, Outcome, Unfit, quarantine};
use super::records::patiently;
use super::run::Summary;
use super::waiting::Due;
use super::{IngestError, IngestOptions};

/// Workers that ended with a record in hand, after which it is worked on alone, so that if it ends another, no
/// other comes under suspicion.
const SUSPECT: u32 = 2;

/// A claimed record on its way.
pub(super) struct Job {
    position: u64,
    work: Work,
}

enum Work {
    Tile(TileRecord),
    Done(Outcome),
}

/// Where work comes from.
pub(super) struct Supply<'a> {
    pub(super) archive: &'a VisualizationArchive,
    pub(super) options: &'a IngestOptions,
    pub(super) context: &'a Context<'a>,
    pub(super) worker: &'a Worker,
    pub(super) reader: &'a mut RecordReader,
    pub(super) left: &'a AtomicU64,
    pub(super) queue: VecDeque<Job>,
    /// To be worked on alone, at the end.
    pub(super) suspects: Vec<Job>,
    /// Records that may still be claimed before it is time to look after those that wait.
    pub(super) budget: usize,
    pub(super) worked: usize,
    /// Whether there are records that have to wait for others.
    pub(super) blocked: bool,
    /// Of what was done while reading.
    pub(super) summary: Summary,
}

impl Supply<'_> {
    /// The next record to work on; from here on it is known who has it in hand.
    pub(super) async fn next(&mut self) -> Result<Option<Job>, IngestError> {
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
            self.context.retry(begin).await?;
        }
        Ok(job)
    }

    async fn claim(&mut self) -> Result<usize, IngestError> {
        let options = self.options;
        // A few more than are worked on at once: each claim is a question to the catalog, but what is
        // claimed and waits is nobody else's.
        let most = (4 * options.workers.max(1)).min(self.budget);
        let most = u32::try_from(most).unwrap_or(u32::MAX);
        let (catalog, volume) = (self.archive.catalog(), self.context.volume);
        let claim = || catalog.claim(volume, self.worker, most);
        let claims = self.context.retry(claim).await?;
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
        let from = self.context.retry(|| catalog.cursor(volume)).await?;
        if self.reader.cursor() != from {
            *self.reader = self.reader.at(from);
        }
        let clock = catalog.clock();
        patiently(clock, options, progress, || self.reader.recognize()).await?;
        Ok(from)
    }

    /// Reads new records: tiles are put in the queue, the rest is done with at once, up to one that
    /// speaks of a tile whose older records are still in the queue. Whether there were any.
    pub(super) async fn read_ahead(&mut self) -> Result<bool, IngestError> {
        let (options, progress) = (self.options, self.context.progress);
        let (catalog, volume) = (self.archive.catalog(), self.context.volume);
        let batch = options.batch.max(1);
        let (queued, _) = self.context.retry(|| catalog.queued(volume)).await?;
        // Another worker may have read on.
        let from = self.catch_up().await?;
        if queued >= batch as u64 {
            return Ok(false);
        }
        let clock = catalog.clock();
        let lines = patiently(clock, options, progress, || self.reader.read(batch)).await?;
        self.blocked = false;
        if lines.is_empty() {
            self.left.store(queued, Ordering::Relaxed);
            return Ok(false);
        }
        let lines: Vec<_> = lines.into_iter().map(|l| (l.next, New::from(l))).collect();
        let ask = async || {
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
                        done.apply(&mut commit, outcome, clock.now()).await?;
                    }
                }
                (taken, to) = (taken + 1, *next);
            }
            if taken == 0 || !commit.advance(from, to).await? {
                return Ok((0, Done::default()));
            }
            commit.finish().await?;
            Ok((taken, done))
        };
        let (taken, done) = self.context.retry(ask).await?;
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
                let what = Unfit {
                    file: broken
                        .file
                        .clone()
                        .unwrap_or_else(|| RecordReader::FILE.to_owned()),
                    tile: broken.tile.clone(),
                    reason: format!("{broken}; append the record again as it should be"),
                    bytes: Some(line.next.offset - line.offset),
                    awaited: None,
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

    /// Does the work of it, but for what the catalog is to know.
    pub(super) async fn prepare(self, context: &Context<'_>) -> Result<Ready, IngestError> {
        let Self { position, work } = self;
        let outcome = match work {
            Work::Tile(record) => context.tile(record, position).await?,
            Work::Done(outcome) => outcome,
        };
        Ok(Ready { position, outcome })
    }
}
