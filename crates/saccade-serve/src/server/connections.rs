//! How many connections there may be, and which one goes when another comes.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;

/// The connections of a server.
#[derive(Debug)]
pub(super) struct Connections {
    most: usize,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    open: usize,
    /// Counts what happens: later is more.
    now: u64,
    /// Those that are not being answered, in the order in which they go.
    waiting: BTreeMap<Place, Arc<Notify>>,
}

/// Where a connection stands in the order of leaving.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Place {
    /// Whether it was ever answered: who never asked anything goes first.
    known: bool,
    since: u64,
}

impl Connections {
    pub(super) fn new(most: usize) -> Arc<Self> {
        Arc::new(Self {
            most,
            state: Mutex::default(),
        })
    }

    /// One more connection, perhaps in place of another. `None` where all are being answered.
    pub(super) fn admit(self: &Arc<Self>) -> Option<Arc<Connection>> {
        let mut state = self.state();
        if state.open >= self.most && !state.evict() {
            return None;
        }
        state.open += 1;
        let evicted = Arc::new(Notify::new());
        let place = state.wait(false, evicted.clone());
        drop(state);
        Some(Arc::new(Connection {
            all: self.clone(),
            evicted,
            place: Mutex::new(Some(place)),
        }))
    }

    /// Makes room, where one is not being answered.
    pub(super) fn evict(&self) {
        self.state().evict();
    }

    fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }
}

impl State {
    fn evict(&mut self) -> bool {
        let Some((_, gone)) = self.waiting.pop_first() else {
            return false;
        };
        self.open -= 1;
        gone.notify_one();
        true
    }

    fn wait(&mut self, known: bool, evicted: Arc<Notify>) -> Place {
        let since = self.now;
        self.now += 1;
        let place = Place { known, since };
        self.waiting.insert(place, evicted);
        place
    }
}

/// One connection, until it is dropped.
#[derive(Debug)]
pub(super) struct Connection {
    all: Arc<Connections>,
    evicted: Arc<Notify>,
    /// `None` while it is being answered.
    place: Mutex<Option<Place>>,
}

impl Connection {
    /// Keeps its place until the answer is dropped.
    pub(super) fn answering(self: &Arc<Self>) -> Answering {
        let mut state = self.all.state();
        let mut own = lock(&self.place);
        // One that had to go a moment ago is in no place any more, and the news is on its way.
        if own.is_some_and(|place| state.waiting.remove(&place).is_some()) {
            *own = None;
        }
        drop(own);
        Answering(self.clone())
    }

    /// Done when another took its place.
    pub(super) async fn evicted(&self) {
        self.evicted.notified().await;
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        let mut state = self.all.state();
        let was_waiting = lock(&self.place).take();
        let evicted = was_waiting.is_some_and(|place| state.waiting.remove(&place).is_none());
        if !evicted {
            state.open -= 1;
        }
    }
}

/// An answer under way.
#[derive(Debug)]
pub(super) struct Answering(Arc<Connection>);

impl Drop for Answering {
    fn drop(&mut self) {
        let Connection {
            all,
            evicted,
            place,
        } = &*self.0;
        let mut state = all.state();
        let mut place = lock(place);
        if place.is_none() {
            *place = Some(state.wait(true, evicted.clone()));
        }
    }
}

/// Nothing is left half-changed by a panic elsewhere.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use futures::FutureExt;

    fn gone(connection: &Connection) -> bool {
        connection.evicted().now_or_never().is_some()
    }

    fn open(connections: &Connections) -> usize {
        connections.state().open
    }

    #[test]
    fn those_that_ask_nothing_go_first_then_the_longest_silent() {
        let all = Connections::new(3);
        let known = all.admit().unwrap();
        drop(known.answering());
        let [silent, asking] = [(); 2].map(|()| all.admit().unwrap());
        let answer = asking.answering();
        let fourth = all.admit().unwrap();
        assert!(gone(&silent) && !gone(&known) && !gone(&asking));
        drop(answer);
        drop(fourth.answering());
        // All are known now; this one has been silent longest.
        let _fifth = all.admit().unwrap();
        assert!(gone(&known) && !gone(&asking) && !gone(&fourth));
        assert_eq!(open(&all), 3);
    }

    #[test]
    fn those_being_answered_stay() {
        let all = Connections::new(2);
        let kept = [(); 2].map(|()| all.admit().unwrap());
        let answers = kept.each_ref().map(Connection::answering);
        assert!(all.admit().is_none());
        drop(answers);
        assert!(all.admit().is_some());
    }

    #[test]
    fn every_place_is_given_back_once() {
        let all = Connections::new(2);
        for _ in 0..5 {
            let [a, b, c] = [(); 3].map(|()| all.admit().unwrap());
            assert!(gone(&a));
            // Evicted while its request came in.
            let late = a.answering();
            drop((late, a));
            assert_eq!(open(&all), 2);
            let answer = b.answering();
            drop(b);
            assert_eq!(open(&all), 2, "the answer keeps it");
            drop((answer, c));
            assert_eq!((open(&all), all.state().waiting.len()), (0, 0));
        }
    }
}
