//! The second half of the pipeline: what became of records is entered in the catalog.

use std::collections::BTreeMap;
use std::future::Future;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;

use saccade_archive::VisualizationArchive;
use saccade_archive::acquisition::RecordReader;
use saccade_archive::catalog::{
    CatalogError, Commit, DeleteOutcome, Quarantined, TileOutcome, TransformOutcome, Worker,
};
use saccade_archive::clock::Clock;

use super::prepare::{Backoff, Context, Outcome};
use super::run::{Summary, state};
use super::waiting::WaitingRoom;
use super::{IngestError, IngestOptions};
use crate::progress::{Meter, Progress};
use crate::sense::{CHECK, nonsense};

/// Most records in one transaction: a sync for each would be slow for small tiles, and a
/// transaction for thousands would keep other writers waiting.
pub(super) const COMMIT_AT_ONCE: usize = 64;

/// A claimed record that is ready to be entered.
pub(super) struct Ready {
    pub(super) position: u64,
    pub(super) outcome: Outcome,
}

/// Enters records.
pub(super) struct Enter<'a> {
    pub(super) archive: &'a VisualizationArchive,
    pub(super) context: &'a Context<'a>,
    pub(super) worker: &'a Worker,
    pub(super) room: &'a mut WaitingRoom,
    pub(super) meter: &'a mut Meter,
    pub(super) summary: &'a mut Summary,
    pub(super) left: &'a AtomicU64,
}

/// What became of what is set aside.
pub(super) enum Change {
    /// A file or record was set aside: that of a tile, if it is known of which.
    SetAside(Option<String>),
    /// All that was set aside of a tile is of no account any more: it is there, or is not to be.
    Ended(String),
}

/// What this run has set aside and nobody has mended since: how many of each tile.
#[derive(Debug, Default)]
pub(super) struct SetAside(Mutex<BTreeMap<Option<String>, u64>>);

impl SetAside {
    pub(super) fn note(&self, changes: Vec<Change>) {
        let mut tiles = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        for change in changes {
            match change {
                Change::SetAside(tile) => *tiles.entry(tile).or_default() += 1,
                Change::Ended(tile) => _ = tiles.remove(&Some(tile)),
            }
        }
    }

    pub(super) fn count(&self) -> u64 {
        let tiles = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        tiles.values().sum()
    }
}

/// What a transaction did.
#[derive(Default)]
pub(super) struct Done {
    pub(super) summary: Summary,
    /// The first tile that took the place of one in another section, in words.
    elsewhere: Option<String>,
    /// Pyramids that no tile names.
    orphans: Vec<String>,
    pub(super) notices: Vec<String>,
    /// What it changed of what is set aside, in order.
    pub(super) changes: Vec<Change>,
    /// Records that are another worker's now.
    lost: Vec<u64>,
}

impl Enter<'_> {
    pub(super) async fn commit(&mut self, ready: Vec<Ready>) -> Result<(), IngestError> {
        let progress = self.context.progress;
        let mut done = self.context.retry(|| self.transaction(&ready)).await?;
        for notice in &done.notices {
            progress.notice(notice);
        }
        for orphan in &done.orphans {
            if let Err(e) = self.archive.storage().delete(orphan).await {
                log::warn!("cannot delete the unused pyramid {orphan}: {e}");
            }
        }
        // Once a run: where names mean several tiles, all but the first sections say so.
        if let Some(told) = done
            .elsewhere
            .take()
            .filter(|_| self.summary.elsewhere == 0)
        {
            progress.notice(&told);
        }
        self.summary.elsewhere += done.summary.elsewhere;
        self.summary.tiles += done.summary.tiles;
        self.summary.pixels += done.summary.pixels;
        self.summary.moved += done.summary.moved;
        self.summary.deleted += done.summary.deleted;
        self.context
            .set_aside
            .note(std::mem::take(&mut done.changes));
        self.summary.quarantined = self.context.set_aside.count();
        let now = self.archive.catalog().clock().monotonic();
        self.meter.add(now, done.summary.pixels);
        let left = self.left.load(Ordering::Relaxed);
        let left = left.saturating_sub(ready.len() as u64);
        self.left.store(left, Ordering::Relaxed);
        for Ready { position, outcome } in ready {
            match outcome {
                Outcome::Wait {
                    waiting,
                    look,
                    kind,
                } if !done.lost.contains(&position) => self.room.admit(waiting, look, kind),
                _ => self.room.leave(position),
            }
        }
        progress.update(&state(
            self.summary,
            self.meter.mpixel_per_s(now),
            self.room,
            self.left,
        ));
        Ok(())
    }

    async fn transaction(&self, ready: &[Ready]) -> Result<Done, CatalogError> {
        let mut done = Done::default();
        let mut commit = self.archive.catalog().begin(self.context.volume).await?;
        for Ready { position, outcome } in ready {
            // One that was away for longer than its lease has nothing to say any more. What it wrote
            // has the name that the other one's has, and stays.
            if !commit.holds(self.worker, *position).await? {
                done.lost.push(*position);
                continue;
            }
            if let Outcome::Quarantine { what, pyramid } = outcome
                && let Some(tile) = &what.tile
                && commit.has_newer(tile, *position).await?
            {
                // What became of its image is no matter any more.
                done.orphans.extend(pyramid.clone());
            } else {
                let now = self.archive.catalog().clock().now();
                done.apply(&mut commit, outcome, now).await?;
            }
            if !matches!(outcome, Outcome::Wait { .. }) {
                commit.wait_no_more(*position).await?;
            }
        }
        commit.finish().await?;
        Ok(done)
    }
}

/// What is said of a tile that was in another section before.
fn one_name(tile: &str, from: u32, to: u32) -> String {
    format!(
        "warn: tile {tile:?} was in section {from}, and its newest record has it in section {to}: it is no more where it was, for a name means one \
         tile of the whole volume. If these are two tiles, name them so in the records, such as \"s{to}_{tile}\""
    )
}

impl Done {
    /// Enters what became of a record.
    pub(super) async fn apply(
        &mut self,
        commit: &mut Commit<'_>,
        outcome: &Outcome,
        now: SystemTime,
    ) -> Result<(), CatalogError> {
        match outcome {
            Outcome::Tile { tile, pixels } => match commit.tile(tile, now).await? {
                TileOutcome::Superseded => self.orphans.push(tile.pyramid.clone()),
                entered => {
                    self.summary.tiles += 1;
                    self.summary.pixels += pixels;
                    self.changes.push(Change::Ended(tile.name.clone()));
                    if let TileOutcome::Elsewhere { from } = entered {
                        self.summary.elsewhere += 1;
                        self.elsewhere
                            .get_or_insert_with(|| one_name(&tile.name, from, tile.section));
                    }
                }
            },
            Outcome::Transform { record, position } => {
                let misplaced = |reason| Quarantined {
                    file: RecordReader::FILE.to_owned(),
                    tile: Some(record.tile.clone()),
                    reason,
                    bytes: None,
                    at: now,
                    awaited: None,
                };
                if let Some(nonsense) = nonsense(record.transform) {
                    let reason = format!(
                        "{nonsense}; check {CHECK}, and append the record again; until then the tile stays where it is"
                    );
                    return self.quarantine(commit, &misplaced(reason)).await;
                }
                let moved = commit.transform(&record.tile, record.transform, Some(*position));
                match moved.await {
                    Ok(TransformOutcome::Moved) => self.summary.moved += 1,
                    Ok(TransformOutcome::Unchanged | TransformOutcome::Kept) => {}
                    Err(outside @ CatalogError::OutsideVolume { .. }) => {
                        let what = misplaced(format!("{outside}; until then it stays where it is"));
                        self.quarantine(commit, &what).await?;
                    }
                    Err(e) => return Err(e),
                }
            }
            Outcome::Delete { record, position } => {
                let deleted = commit.delete(&record.tile, *position, now).await?;
                if deleted == DeleteOutcome::Deleted {
                    self.summary.deleted += 1;
                }
                if deleted != DeleteOutcome::Unchanged {
                    self.changes.push(Change::Ended(record.tile.clone()));
                }
            }
            Outcome::Wait { waiting, .. } => commit.wait(waiting).await?,
            Outcome::Quarantine { what, pyramid } => {
                self.quarantine(commit, &what.set_aside(now)).await?;
                self.orphans.extend(pyramid.clone());
            }
        }
        Ok(())
    }

    async fn quarantine(
        &mut self,
        commit: &mut Commit<'_>,
        what: &Quarantined,
    ) -> Result<(), CatalogError> {
        commit.quarantine(what).await?;
        self.changes.push(Change::SetAside(what.tile.clone()));
        let tile = what
            .tile
            .as_deref()
            .map_or_else(String::new, |t| format!(" (tile {t})"));
        self.notices
            .push(format!("quarantined {}{tile}: {}", what.file, what.reason));
        Ok(())
    }
}

/// Tries a transaction again: some times if the failure may pass, and as long as the disk is full or
/// the server away.
pub(super) async fn retry<T, F>(
    clock: &dyn Clock,
    options: &IngestOptions,
    progress: &dyn Progress,
    mut transaction: impl FnMut() -> F,
) -> Result<T, CatalogError>
where
    F: Future<Output = Result<T, CatalogError>>,
{
    let mut backoff = Backoff::new(options.retry, clock);
    let mut over = "";
    loop {
        match transaction().await {
            Ok(value) => {
                backoff.over(progress, over);
                return Ok(value);
            }
            Err(e) => {
                if !backoff.may_go_on(e.is_outage(), e.is_transient()) {
                    return Err(e);
                }
                over = match &e {
                    CatalogError::Full { .. } => "there is space for the catalog again",
                    _ => "the catalog can be used again",
                };
                backoff.say_and_wait(progress, &e).await;
            }
        }
    }
}
