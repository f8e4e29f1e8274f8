//! Misses in, requests out; answers in, bricks out.
//!
//! The pull as a state machine: it reads no clock, starts no task and waits for nothing, so that
//! every order of events can be tested. [`crate::Session`] connects it to a source and a renderer.
//!
//! A brick's state follows from the states of its chunks; the README has the table.
//!
//! # While the volume grows
//!
//! A coarse chunk may change more often than it can be read. What changed meanwhile is therefore
//! delivered as it is, marked as out of date, and then asked for again: each answer is newer than
//! the one before, and only what was asked for after the last change ends the asking.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use saccade_core::brick::{BRICK_STORED_VOXELS, BrickId};
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_render::BrickVoxels;
use saccade_source::{Chunk, ChunkError, ChunkId};

use crate::brick::{Assembler, chunks_of};
use crate::host_cache::{HostCache, bytes_of, is_touched};
use crate::policy::{Budget, Limits};

/// Names one request: an answer to any other is out of date.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Ticket(u64);

/// A chunk to be asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Request {
    /// To be given back with the answer.
    pub ticket: Ticket,
    /// What to read.
    pub id: ChunkId,
}

/// What to do about the source now.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Actions {
    /// Requests to start, most wanted first.
    pub start: Vec<Request>,
    /// Requests to drop; their answers will be ignored.
    pub cancel: Vec<Ticket>,
}

/// Where a brick is on its way to the renderer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BrickState {
    /// The newest report does not name it, or it was delivered since.
    NotWanted,
    /// Its turn has not come.
    Wanted,
    /// Some of its chunks are in flight or just arrived.
    Loading,
    /// A chunk failed for a passing reason and will be asked for again.
    Waiting,
    /// All its chunks are here.
    Ready,
    /// A chunk failed for good. Stays so until a change touches it.
    Failed,
}

/// How far the pull is.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Progress {
    /// Bricks that the newest report misses and that can still come.
    pub wanted: usize,
    /// Bricks that it misses and that cannot come before something changes.
    pub failed: usize,
    /// Chunk requests in flight.
    pub in_flight: usize,
    /// Chunk requests that wait to be repeated.
    pub waiting: usize,
    /// The newest failure, in words; none since the last change or success of the same chunk.
    pub failure: Option<String>,
    /// When to look again if nothing else happens.
    pub retry_at: Option<Duration>,
}

/// What one call handed to the renderer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Delivery {
    /// Bricks handed over.
    pub bricks: usize,
    /// Whether the budget ended it: there may be more.
    pub cut: bool,
}

/// Whether a delivered brick is what the volume holds now, as far as is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Freshness {
    /// Nothing changed since its chunks were asked for.
    Current,
    /// Something did.
    Outdated,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Readiness {
    /// A chunk is missing, or is no newer than what was delivered.
    NotYet,
    /// It can be delivered, and is up to date.
    Current,
    /// It can be delivered, but is not up to date.
    Outdated,
}

#[derive(Debug)]
struct InFlight {
    ticket: Ticket,
    /// Whether its voxels changed after it was asked for.
    outdated: bool,
    /// Report that last wanted it.
    wanted_in: u64,
    attempts: u32,
}

#[derive(Debug)]
struct Backoff {
    until: Duration,
    attempts: u32,
}

/// A chunk of the bricks being loaded.
#[derive(Clone, Debug)]
struct Loaded {
    chunk: Chunk,
    /// Whether its voxels changed after it was asked for.
    outdated: bool,
    /// The number of its answer; 0 if it comes from the cache.
    arrived: u64,
}

/// The pull of one volume.
pub struct Pull {
    volume: Arc<Volume>,
    limits: Limits,
    /// Most wanted first.
    wanted: Vec<BrickId>,
    /// Frame whose misses `wanted` holds.
    wanted_frame: Option<u64>,
    reports: u64,
    /// Bricks given to the renderer before this frame was drawn: older reports miss them in vain.
    delivered: HashMap<BrickId, u64>,
    /// Chunks of the bricks being loaded.
    window: HashMap<ChunkId, Loaded>,
    /// Answers so far.
    answers: u64,
    /// Wanted bricks that were delivered out of date, and the answers there had been by then.
    outdated: HashMap<BrickId, u64>,
    in_flight: BTreeMap<ChunkKey, InFlight>,
    tickets: HashMap<Ticket, ChunkId>,
    backoff: BTreeMap<ChunkKey, Backoff>,
    failed: HashSet<ChunkId>,
    failure: Option<(ChunkId, String)>,
    cache: HostCache,
    assembler: Assembler,
    next_ticket: u64,
}

/// Failures kept in mind; beyond, all are forgotten and asked for again.
const MAX_FAILED: usize = 1 << 16;

/// A chunk id with an order: what happens must not depend on hash seeds.
type ChunkKey = (u32, u32, [u32; 3]);

fn key(id: ChunkId) -> ChunkKey {
    (id.channel, id.level, id.chunk.to_array())
}

fn id_of((channel, level, chunk): ChunkKey) -> ChunkId {
    ChunkId {
        channel,
        level,
        chunk: chunk.into(),
    }
}

impl Pull {
    /// A pull that wants nothing yet.
    pub fn new(volume: Arc<Volume>, limits: Limits) -> Self {
        let cache = HostCache::new(limits.host_bytes / 2, chunk_bytes(&volume) as u64);
        Self {
            volume,
            limits,
            wanted: Vec::new(),
            wanted_frame: None,
            reports: 0,
            delivered: HashMap::new(),
            window: HashMap::new(),
            answers: 0,
            outdated: HashMap::new(),
            in_flight: BTreeMap::new(),
            tickets: HashMap::new(),
            backoff: BTreeMap::new(),
            failed: HashSet::new(),
            failure: None,
            cache,
            assembler: Assembler::default(),
            next_ticket: 0,
        }
    }

    /// Another renderer begins: it has no bricks yet, and counts its frames anew. Chunks stay.
    pub fn restart(&mut self) {
        self.wanted_frame = None;
        self.delivered.clear();
        self.outdated.clear();
    }

    /// The misses of a frame, most wanted first. They replace those of earlier frames; a report
    /// older than the newest is ignored.
    pub fn want(&mut self, frame: u64, misses: &[BrickId]) {
        if self.wanted_frame.is_some_and(|newest| frame < newest) {
            return;
        }
        self.wanted_frame = Some(frame);
        self.reports += 1;
        self.delivered.retain(|_, before| *before > frame);
        let mut seen = HashSet::with_capacity(misses.len());
        let fresh = |id: &&BrickId| !self.delivered.contains_key(*id) && seen.insert(**id);
        self.wanted = misses.iter().filter(fresh).copied().collect();
        self.outdated.retain(|id, _| seen.contains(id));
    }

    /// What to ask the source for now, and what no longer.
    ///
    /// The most wanted bricks whose chunks fit the memory for loading form a window: only their
    /// chunks are asked for. At least one brick is in it, however small the memory.
    pub fn plan(&mut self, now: Duration) -> Actions {
        let mut actions = Actions::default();
        let wanted = self.window_chunks();
        let repeated = self.exhausted();
        let mut window = HashMap::with_capacity(wanted.len());
        for &id in &wanted {
            let here = self.window.remove(&id).or_else(|| self.cached(id));
            if let Some(chunk) = here {
                window.insert(id, chunk);
                if !repeated.contains(&id) {
                    continue;
                }
            }
            if let Some(in_flight) = self.in_flight.get_mut(&key(id)) {
                in_flight.wanted_in = self.reports;
            } else if self.in_flight.len() < self.limits.in_flight {
                let backoff = self.backoff.get(&key(id));
                if backoff.is_none_or(|b| b.until <= now) {
                    actions.start.push(self.start(id));
                }
            }
        }
        self.window = window;
        let (reports, grace) = (self.reports, self.limits.grace);
        let mut cancel = |request: &InFlight| {
            let forgotten = reports - request.wanted_in > grace;
            if forgotten {
                self.tickets.remove(&request.ticket);
                actions.cancel.push(request.ticket);
            }
            !forgotten
        };
        self.in_flight.retain(|_, request| cancel(request));
        // Nobody waits for a repetition of what nobody wants.
        let wanted: HashSet<ChunkId> = wanted.into_iter().collect();
        self.backoff
            .retain(|&chunk, _| wanted.contains(&id_of(chunk)));
        actions
    }

    fn cached(&self, id: ChunkId) -> Option<Loaded> {
        let chunk = self.cache.get(id)?.clone();
        Some(Loaded {
            chunk,
            outdated: false,
            arrived: 0,
        })
    }

    fn start(&mut self, id: ChunkId) -> Request {
        let ticket = Ticket(self.next_ticket);
        self.next_ticket += 1;
        let attempts = self.backoff.remove(&key(id)).map_or(0, |b| b.attempts);
        self.in_flight.insert(
            key(id),
            InFlight {
                ticket,
                outdated: false,
                wanted_in: self.reports,
                attempts,
            },
        );
        self.tickets.insert(ticket, id);
        Request { ticket, id }
    }

    /// Chunks of the most wanted bricks, in order of need, each once.
    fn window_chunks(&self) -> Vec<ChunkId> {
        let room = self.limits.host_bytes / 2;
        let mut bytes = 0;
        let mut chunks = Vec::new();
        let mut seen: HashSet<ChunkId> = HashSet::new();
        for &brick in &self.wanted {
            if self.has_failed(brick) {
                continue;
            }
            let new: Vec<ChunkId> = chunks_of(brick, &self.volume)
                .filter(|id| !seen.contains(id))
                .collect();
            bytes += new.iter().map(|&id| self.bytes_expected(id)).sum::<u64>();
            if bytes > room && !chunks.is_empty() {
                break;
            }
            seen.extend(&new);
            chunks.extend(new);
        }
        chunks
    }

    fn bytes_expected(&self, id: ChunkId) -> u64 {
        let known = self.window.get(&id).map(|loaded| &loaded.chunk);
        let known = known.or_else(|| self.cache.get(id));
        known.map_or_else(|| chunk_bytes(&self.volume) as u64, bytes_of)
    }

    fn has_failed(&self, brick: BrickId) -> bool {
        !self.failed.is_empty()
            && chunks_of(brick, &self.volume).any(|id| self.failed.contains(&id))
    }

    /// Takes an answer. One that was cancelled is dropped.
    pub fn answer(&mut self, ticket: Ticket, answer: Result<Chunk, ChunkError>, now: Duration) {
        let Some(id) = self.tickets.remove(&ticket) else {
            return;
        };
        let Some(request) = self.in_flight.remove(&key(id)) else {
            return;
        };
        let InFlight {
            attempts, outdated, ..
        } = request;
        self.answers += 1;
        match answer {
            // What was wrong then may be right now: it is asked for again.
            Err(error) if outdated && !error.is_transient() => {}
            Ok(Chunk::Voxels(voxels)) if voxels.len() != chunk_bytes(&self.volume) => {
                let want = chunk_bytes(&self.volume);
                let message = format!("{id} has {} bytes instead of {want}", voxels.len());
                self.fail(id, message);
            }
            Ok(chunk) => {
                if self.failure.as_ref().is_some_and(|(of, _)| *of == id) {
                    self.failure = None;
                }
                if !outdated {
                    self.cache.insert(id, chunk.clone());
                }
                let loaded = Loaded {
                    chunk,
                    outdated,
                    arrived: self.answers,
                };
                self.window.insert(id, loaded);
            }
            Err(error) if error.is_transient() => {
                let asked = error.retry_after();
                let attempts = attempts.saturating_add(1);
                let until = now + self.limits.retry.delay(attempts, asked);
                self.backoff.insert(key(id), Backoff { until, attempts });
                // A source that asks for patience has not failed.
                if !matches!(error, ChunkError::NotReady { .. }) {
                    self.failure = Some((id, in_words(&error)));
                }
            }
            Err(error) => self.fail(id, in_words(&error)),
        }
    }

    fn fail(&mut self, id: ChunkId, message: String) {
        if self.failed.len() >= MAX_FAILED {
            self.failed.clear();
        }
        self.failed.insert(id);
        self.failure = Some((id, message));
    }

    /// Voxels of level 0 changed: chunks that hold them, and requests for them that are in flight,
    /// are out of date.
    pub fn change(&mut self, voxels: VoxelBox) {
        let volume = &self.volume;
        let touched = |id: ChunkId| is_touched(id, volume, voxels);
        self.cache.invalidate(volume, voxels);
        self.backoff.retain(|&chunk, _| !touched(id_of(chunk)));
        self.failed.retain(|&id| !touched(id));
        if self.failure.as_ref().is_some_and(|(id, _)| touched(*id)) {
            self.failure = None;
        }
        #[expect(clippy::iter_over_hash_type, reason = "each is marked for itself")]
        for (&id, loaded) in &mut self.window {
            loaded.outdated |= touched(id);
        }
        for (&chunk, request) in &mut self.in_flight {
            request.outdated |= touched(id_of(chunk));
        }
    }

    /// Whether a chunk that is here takes a brick any further: one out of date does so once.
    fn serves(&self, brick: BrickId, loaded: &Loaded) -> bool {
        let before = self.outdated.get(&brick);
        !loaded.outdated || before.is_none_or(|&before| loaded.arrived > before)
    }

    /// Chunks that are here and have to come once more.
    fn exhausted(&self) -> HashSet<ChunkId> {
        let again = self
            .wanted
            .iter()
            .filter(|id| self.outdated.contains_key(*id));
        let chunks = again.flat_map(|&brick| {
            let chunks = chunks_of(brick, &self.volume);
            chunks.filter(move |id| {
                let here = self.window.get(id);
                here.is_some_and(|loaded| !self.serves(brick, loaded))
            })
        });
        chunks.collect()
    }

    fn readiness(&self, brick: BrickId) -> Readiness {
        let mut readiness = Readiness::Current;
        for id in chunks_of(brick, &self.volume) {
            match self.window.get(&id) {
                Some(loaded) if !self.serves(brick, loaded) => return Readiness::NotYet,
                Some(loaded) if loaded.outdated => readiness = Readiness::Outdated,
                Some(_) => {}
                None => return Readiness::NotYet,
            }
        }
        readiness
    }

    /// Hands ready bricks to `sink`, most wanted first, within the budget, and says of each whether
    /// it is up to date. One that is not is to be missed again by the frames that draw it.
    ///
    /// `frame` is the next frame to be drawn: the first that will not miss them. `clock` tells the
    /// time as given elsewhere.
    pub fn deliver(
        &mut self,
        frame: u64,
        clock: impl Fn() -> Duration,
        mut sink: impl FnMut(BrickId, BrickVoxels<'_>, Freshness),
    ) -> Delivery {
        let mut budget = Budget::new(&self.limits, clock());
        let wanted = std::mem::take(&mut self.wanted);
        let before = wanted.len();
        let mut open = true;
        for brick in wanted {
            open = open && budget.allows(BRICK_STORED_VOXELS, clock());
            let readiness = if open {
                self.readiness(brick)
            } else {
                Readiness::NotYet
            };
            let freshness = match readiness {
                Readiness::Current => Freshness::Current,
                Readiness::Outdated => Freshness::Outdated,
                Readiness::NotYet => {
                    self.wanted.push(brick);
                    continue;
                }
            };
            let window = &self.window;
            let chunk = |id| window.get(&id).map(|loaded| &loaded.chunk);
            let Some(voxels) = self.assembler.assemble(brick, &self.volume, chunk) else {
                self.wanted.push(brick);
                continue;
            };
            budget.spend(match voxels {
                BrickVoxels::Voxels(voxels) => voxels.len(),
                BrickVoxels::Empty => 64,
            });
            sink(brick, voxels, freshness);
            self.delivered.insert(brick, frame);
            match freshness {
                Freshness::Current => self.outdated.remove(&brick),
                Freshness::Outdated => self.outdated.insert(brick, self.answers),
            };
        }
        Delivery {
            bricks: before - self.wanted.len(),
            cut: !open,
        }
    }

    /// Where a brick is.
    pub fn state(&self, brick: BrickId) -> BrickState {
        if !self.wanted.contains(&brick) {
            return BrickState::NotWanted;
        }
        if self.has_failed(brick) {
            return BrickState::Failed;
        }
        if self.readiness(brick) != Readiness::NotYet {
            return BrickState::Ready;
        }
        let mut state = BrickState::Wanted;
        for id in chunks_of(brick, &self.volume) {
            let chunk = if self.backoff.contains_key(&key(id)) {
                return BrickState::Waiting;
            } else {
                self.in_flight.contains_key(&key(id)) || self.window.contains_key(&id)
            };
            if chunk {
                state = BrickState::Loading;
            }
        }
        state
    }

    /// How far it is.
    pub fn progress(&self) -> Progress {
        let failed = self
            .wanted
            .iter()
            .filter(|&&brick| self.has_failed(brick))
            .count();
        Progress {
            wanted: self.wanted.len() - failed,
            failed,
            in_flight: self.in_flight.len(),
            waiting: self.backoff.len(),
            failure: self.failure.as_ref().map(|(_, message)| message.clone()),
            retry_at: self.backoff.values().map(|b| b.until).min(),
        }
    }

    /// Whether bricks are on their way that were not delivered yet.
    pub fn has_more(&self) -> bool {
        self.wanted.iter().any(|&brick| !self.has_failed(brick))
    }

    /// Memory that chunks take \[bytes\]. One that is both being loaded and kept counts twice, though
    /// it is there once.
    pub fn host_bytes(&self) -> u64 {
        let window = self.window.values().map(|loaded| bytes_of(&loaded.chunk));
        let window = window.sum::<u64>();
        window + self.cache.bytes()
    }
}

/// Bytes of a full chunk.
fn chunk_bytes(volume: &Volume) -> usize {
    let [x, y, z] = volume.chunk.to_array().map(|edge| edge as usize);
    x.saturating_mul(y)
        .saturating_mul(z)
        .saturating_mul(volume.dtype.bytes())
}

/// An error with its sources, on one line.
fn in_words(error: &dyn std::error::Error) -> String {
    let mut words = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        words.push_str(": ");
        words.push_str(&cause.to_string());
        source = cause.source();
    }
    words
}

#[cfg(test)]
mod simulation;
#[cfg(test)]
mod tests;
