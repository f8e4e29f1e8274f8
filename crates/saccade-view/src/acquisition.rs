//! How the acquisition is coming along, asked for now and then.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use saccade_source::maybe_send::{BoxFuture, spawn};
use saccade_source::remote::{Status, StatusReader};
use saccade_stream::Wake;

/// Asks for the state of a volume's acquisition; `None` when it could not be told.
#[cfg(not(target_family = "wasm"))]
pub type AcquisitionReader = Arc<dyn Fn() -> BoxFuture<'static, Option<Status>> + Send + Sync>;
/// Asks for the state of a volume's acquisition; `None` when it could not be told.
#[cfg(target_family = "wasm")]
pub type AcquisitionReader = Arc<dyn Fn() -> BoxFuture<'static, Option<Status>>>;

/// A reader that asks a server.
pub(crate) fn from_server(reader: StatusReader) -> AcquisitionReader {
    Arc::new(move || {
        let reader = reader.clone();
        Box::pin(async move {
            let status = reader.read().await;
            status
                .inspect_err(|error| log::warn!("no state of the acquisition: {error}"))
                .ok()
        })
    })
}

/// The last state known; asks again when the volume changed, but not too often.
pub(crate) struct Acquisition {
    reader: Option<AcquisitionReader>,
    status: Option<Status>,
    asked_for: Option<u64>,
    next: Duration,
    waiting: bool,
    to: Sender<Option<Status>>,
    from: Receiver<Option<Status>>,
}

/// Between two questions.
const DISTANCE: Duration = Duration::from_secs(2);

impl Acquisition {
    pub(crate) fn new(reader: Option<AcquisitionReader>) -> Self {
        let (to, from) = channel();
        let next = Duration::ZERO;
        Self {
            reader,
            status: None,
            asked_for: None,
            next,
            waiting: false,
            to,
            from,
        }
    }

    /// The last state known.
    pub(crate) fn status(&self) -> Option<&Status> {
        self.status.as_ref()
    }

    /// Takes an answer and asks again where `revision` is news. Returns when to be called again.
    pub(crate) fn update(&mut self, revision: u64, now: Duration, wake: &Wake) -> Option<Duration> {
        while let Ok(answer) = self.from.try_recv() {
            self.waiting = false;
            self.status = answer.or(self.status.take());
        }
        let reader = self.reader.as_ref()?;
        if self.waiting || self.asked_for == Some(revision) {
            return None;
        }
        if now < self.next {
            return Some(self.next - now);
        }
        self.asked_for = Some(revision);
        self.next = now + DISTANCE;
        self.waiting = true;
        let (question, to, wake) = (reader(), self.to.clone(), wake.clone());
        spawn(async move {
            // Nobody waits for the answer when the window is gone.
            drop(to.send(question.await));
            wake();
        });
        None
    }
}
