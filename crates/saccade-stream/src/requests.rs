//! Requests as tasks in the background; what they find comes back through a queue.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};

use futures::StreamExt;
use futures::future::{AbortHandle, Aborted, abortable};
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
    }
}

fn spawn_abortable(future: impl Future<Output = ()> + MaybeSend + 'static) -> AbortHandle {
    let (future, handle) = abortable(future);
    spawn(async move {
        let (Ok(()) | Err(Aborted)) = future.await;
    });
    handle
}
