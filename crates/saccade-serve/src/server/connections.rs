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
    waiting: BTreeMap<Turn, Arc<Notify>>,
}

/// When a connection has to leave, beside others.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Turn {
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
    pub(super) fn admit(self: &Arc<Self>) -> Option<Arc<Place>> {
        let mut state = self.state();
        if state.open >= self.most && !state.evict() {
            return None;
        }
        state.open += 1;
        let evicted = Arc::new(Notify::new());
        let turn = state.wait(false, evicted.clone());
        drop(state);
        Some(Arc::new(Place {
            all: self.clone(),
            evicted,
            turn: Mutex::new(Some(turn)),
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

    fn wait(&mut self, known: bool, evicted: Arc<Notify>) -> Turn {
        let since = self.now;
        self.now += 1;
        let turn = Turn { known, since };
        self.waiting.insert(turn, evicted);
        turn
    }
}

/// The place of one connection, until it is dropped.
#[derive(Debug)]
pub(super) struct Place {
    all: Arc<Connections>,
    evicted: Arc<Notify>,
    /// `None` while it is being answered.
    turn: Mutex<Option<Turn>>,
}

impl Place {
    /// Keeps its place until the answer is dropped.
    pub(super) fn answering(self: &Arc<Self>) -> Answering {
        let mut state = self.all.state();
        let mut own = lock(&self.turn);
        // One that had to go a moment ago is in no place any more, and the news is on its way.
        if own.is_some_and(|turn| state.waiting.remove(&turn).is_some()) {
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

impl Drop for Place {
    fn drop(&mut self) {
        let mut state = self.all.state();
        let was_waiting = lock(&self.turn).take();
        let evicted = was_waiting.is_some_and(|turn| state.waiting.remove(&turn).is_none());
        if !evicted {
            state.open -= 1;
        }
    }
}

/// An answer under way.
#[derive(Debug)]
pub(super) struct Answering(Arc<Place>);

impl Drop for Answering {
    fn drop(&mut self) {
        let Place { all, evicted, turn } = &*self.0;
        let mut state = all.state();
        let mut turn = lock(turn);
        if turn.is_none() {
            *turn = Some(state.wait(true, evicted.clone()));
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

    fn gone(connection: &Place) -> bool {
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
        let answers = kept.each_ref().map(Place::answering);
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
