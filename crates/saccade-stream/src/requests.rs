//! Requests as tasks in the background; what they find comes back through a queue.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};

use futures::StreamExt;
use futures::future::{AbortHandle, Aborted, abortable};
use saccade_core::volume::Dtype;
use saccade_source::maybe_send::{MaybeSend, spawn};
use saccade_source::{Change, Chunk, ChunkError, ChunkId, ValueRange, VolumeSource};
use tokio::sync::Notify;

use crate::histogram::{Sample, sample};
use crate::policy::Retry;
use crate::pull::{Actions, Ticket};
use crate::session::Wake;

/// Something that happened in the background.
pub(crate) enum Event {
    Answer {
        ticket: Ticket,
        answer: Result<Chunk, ChunkError>,
    },
    Change(Change),
    /// Bounds of chunks' values; `None` where nothing was acquired.
    Ranges {
        number: u64,
        ranges: Vec<(ChunkId, Option<ValueRange>)>,
    },
    /// Values of some channels were counted.
    Sample {
        number: u64,
        samples: Vec<(u32, Sample)>,
    },
}

/// The background of one session. Dropping it stops everything in it.
pub(crate) struct Requests {
    source: Arc<dyn VolumeSource>,
    wake: Wake,
    sender: Sender<Event>,
    events: Receiver<Event>,
    in_flight: HashMap<Ticket, AbortHandle>,
    changes: AbortHandle,
    /// Number and handle of the count that is running.
    sample: Option<(u64, AbortHandle)>,
    samples: u64,
    /// Number and handle of the search for bounds that is running.
    finding: Option<(u64, AbortHandle)>,
    searches: u64,
    #[cfg(not(target_family = "wasm"))]
    woken: Arc<Notify>,
}

impl Requests {
    /// Listens to changes from now on. `wake` is called after each event.
    pub(crate) fn new(source: Arc<dyn VolumeSource>, wake: Wake) -> Self {
        let (sender, events) = channel();
        let woken = Arc::new(Notify::new());
        let wake: Wake = {
            let woken = woken.clone();
            Arc::new(move || {
                woken.notify_one();
                wake();
            })
        };
        let mut stream = source.changes();
        let (to, tell) = (sender.clone(), wake.clone());
        let changes = spawn_abortable(async move {
            while let Some(change) = stream.next().await {
                if to.send(Event::Change(change)).is_err() {
                    return;
                }
                tell();
            }
        });
        let in_flight = HashMap::new();
        Self {
            source,
            wake,
            sender,
            events,
            in_flight,
            changes,
            sample: None,
            samples: 0,
            finding: None,
            searches: 0,
            #[cfg(not(target_family = "wasm"))]
            woken,
        }
    }

    pub(crate) fn apply(&mut self, actions: Actions) {
        self.cancel(&actions.cancel);
        for request in actions.start {
            let (source, to) = (self.source.clone(), self.sender.clone());
            let wake = self.wake.clone();
            let ticket = request.ticket;
            let handle = spawn_abortable(async move {
                let answer = source.read(request.id).await;
                // The session may be gone: then nobody waits for the answer.
                drop(to.send(Event::Answer { ticket, answer }));
                wake();
            });
            self.in_flight.insert(ticket, handle);
        }
    }

    pub(crate) fn cancel(&mut self, tickets: &[Ticket]) {
        for ticket in tickets {
            if let Some(handle) = self.in_flight.remove(ticket) {
                handle.abort();
            }
        }
    }

    /// Bounds of a chunk's values, if the source knows them without reading it.
    pub(crate) fn value_range(&self, id: ChunkId) -> Option<ValueRange> {
        self.source.value_range(id)
    }

    /// Starts to look up the bounds of chunks' values; an earlier search that has not ended is dropped.
    pub(crate) fn find_ranges(&mut self, ids: Vec<ChunkId>) {
        let (source, to, wake) = (self.source.clone(), self.sender.clone(), self.wake.clone());
        self.searches += 1;
        let number = self.searches;
        let handle = spawn_abortable(async move {
            let found = source.find_value_ranges(&ids).await;
            // Where it failed, everything is possible: who reads the chunk learns why.
            let any = ValueRange {
                min: 1,
                max: match source.volume().dtype {
                    Dtype::Uint8 => u16::from(u8::MAX),
                    _ => u16::MAX,
                },
            };
            let found = found.into_iter().map(|range| range.unwrap_or(Some(any)));
            let ranges = ids.into_iter().zip(found).collect();
            drop(to.send(Event::Ranges { number, ranges }));
            wake();
        });
        if let Some((_, earlier)) = self.finding.replace((number, handle)) {
            earlier.abort();
        }
    }

    /// Whether bounds are being looked up.
    pub(crate) fn is_finding(&self) -> bool {
        self.finding.is_some()
    }

    /// Bounds that are being looked up may be out of date.
    pub(crate) fn drop_ranges(&mut self) {
        if let Some((_, search)) = self.finding.take() {
            search.abort();
        }
    }

    /// Starts counting values of channels; an earlier count that has not ended is dropped.
    pub(crate) fn sample(&mut self, channels: Vec<u32>, retry: Retry) {
        let (source, to, wake) = (self.source.clone(), self.sender.clone(), self.wake.clone());
        self.samples += 1;
        let number = self.samples;
        let handle = spawn_abortable(async move {
            let mut samples = Vec::with_capacity(channels.len());
            for channel in channels {
                samples.push((channel, sample(&*source, channel, retry).await));
            }
            drop(to.send(Event::Sample { number, samples }));
            wake();
        });
        if let Some((_, earlier)) = self.sample.replace((number, handle)) {
            earlier.abort();
        }
    }

    /// Whether values are being counted.
    pub(crate) fn is_sampling(&self) -> bool {
        self.sample.is_some()
    }

    /// Resolves after the next event, or at once if one came since the last time.
    #[cfg(not(target_family = "wasm"))]
    pub(crate) async fn woken(&self) {
        self.woken.notified().await;
    }

    /// The next event, if one has arrived.
    pub(crate) fn next(&mut self) -> Option<Event> {
        let event = self.events.try_recv().ok()?;
        match &event {
            Event::Answer { ticket, .. } => drop(self.in_flight.remove(ticket)),
            Event::Sample { number, .. } => {
                self.sample.take_if(|(running, _)| running == number);
            }
            // Of an older search, dropped meanwhile: of the time before a change.
            Event::Ranges { number, .. } => {
                let running = self.finding.take_if(|(running, _)| running == number);
                if running.is_none() {
                    return self.next();
                }
            }
            Event::Change(_) => {}
        }
        Some(event)
    }
}

impl Drop for Requests {
    fn drop(&mut self) {
        #[expect(clippy::iter_over_hash_type, reason = "all are aborted, in any order")]
        for handle in self.in_flight.values() {
            handle.abort();
        }
        self.changes.abort();
        if let Some((_, sample)) = &self.sample {
            sample.abort();
        }
        self.drop_ranges();
    }
}

fn spawn_abortable(future: impl Future<Output = ()> + MaybeSend + 'static) -> AbortHandle {
    let (future, handle) = abortable(future);
    spawn(async move {
        let (Ok(()) | Err(Aborted)) = future.await;
    });
    handle
}
